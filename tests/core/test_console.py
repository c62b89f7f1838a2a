"""What goes to stdout: results alone, whatever libraries print."""

from __future__ import annotations

import json
import os

import pytest

from trilane.apps.cli.console import print_json, stdout_kept


def test_what_a_library_prints_is_no_result(capfd: pytest.CaptureFixture[str]) -> None:
    with stdout_kept():
        os.write(1, b"a library says hello\n")
    print_json({"answer": 42})
    out, err = capfd.readouterr()
    assert json.loads(out) == {"answer": 42}
    assert "a library says hello" in err
