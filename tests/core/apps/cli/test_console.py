"""What goes to stdout: results alone, whatever libraries print; and how facts are shown to people."""

from __future__ import annotations

import errno
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from trilane.apps.cli.console import (
    print_facts,
    print_json,
    stderr_console,
    stdout_console,
    stdout_kept,
    verdict_text,
)


def open_descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_what_a_library_prints_is_no_result(capfd: pytest.CaptureFixture[str]) -> None:
    before = open_descriptors()
    with stdout_kept():
        os.write(1, b"a library says hello\n")
    print_json({"answer": 42})
    out, err = capfd.readouterr()
    assert json.loads(out) == {"answer": 42}
    assert "a library says hello" in err
    assert open_descriptors() == before


def test_what_was_printed_before_and_inside_goes_where_it_was_meant_to() -> None:
    """What Python still holds back is written out at both ends of the block."""
    program = """
import os, sys
from trilane.apps.cli.console import stdout_kept
sys.stdout.write("before;")
try:
    with stdout_kept():
        sys.stdout.write("inside;")
        os.write(1, b"library;")
        raise KeyError
except KeyError:
    sys.stdout.write("after")
"""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment)
    assert (done.stdout, done.stderr) == ("before;after", "library;inside;")


FACTS = {
    "name": "tiny",
    "files": {"body": {"bytes": 1234567}, "share": {"a": {"b": 1 / 3}}},
    "layers": [{"name": "stem", "sqnr_db": 12.5}, {"name": "head", "kind": "conv"}, {"sqnr_db": 1.0}],
    "empty": [],
    "numbers": [1, 2],
    "shares": [1 / 3, 0.0, True],
    "large": 123456.789,
    "flag": True,
    "none": None,
}


def test_facts_are_a_row_for_every_key(capsys: pytest.CaptureFixture[str]) -> None:
    print_facts(FACTS, as_json=False)
    assert [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()] == [
        "name tiny",
        "files.body.bytes 1234567",
        "files.share.a.b 0.3333",
        "stem sqnr_db 12.5",
        "head kind conv",
        "layers.3 sqnr_db 1",
        "empty []",
        "numbers [1, 2]",
        "shares [0.3333, 0, True]",
        "large 1.235e+05",
        "flag True",
        "none None",
    ]
    print_facts(FACTS, as_json=True)
    assert json.loads(capsys.readouterr().out) == FACTS


def test_a_name_is_printed_as_it_is_in_a_table_too(capsys: pytest.CaptureFixture[str]) -> None:
    """It may look like Rich's markup or like the name of an emoji."""
    print_facts({"file": "a[/b] :key: [red]"}, as_json=False)
    for console in (stdout_console(), stderr_console()):
        console.print("mine [/b] :key: [red]")
    shown = "mine [/b] :key: [red]\n"
    out, err = capsys.readouterr()
    assert [" ".join(line.split()) for line in out.splitlines()] == ["file a[/b] :key: [red]", shown.strip()]
    assert err == shown


@pytest.mark.parametrize("width", [1, 6, 7])
def test_a_verdict_has_a_place_in_the_narrowest_terminal(width: int) -> None:
    assert verdict_text([("PASS", "30 fps"), ("TRY", "")], width).plain == "PASS  30\n      fps\nTRY"


def test_numbers_in_sentences_have_no_colour(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rich would paint them on a terminal."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert stderr_console().stderr
    for console in (stdout_console(), stderr_console()):
        console.file = io.StringIO()
        console.print("found 12, expected 'x'")
        assert console.file.getvalue() == "found 12, expected 'x'\n"


def test_what_is_written_to_a_terminal_that_is_gone_is_lost_and_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any other error is told."""
    lines: list[str] = []

    class Terminal(io.StringIO):
        error = 0

        def write(self, text: str) -> int:
            if self.error:
                raise OSError(self.error, "no")
            lines.append(text)
            return len(text)

        def flush(self) -> None:
            self.write("")

    for name, console in (("stderr", stderr_console), ("stdout", stdout_console)):
        terminal = Terminal()
        monkeypatch.setattr(sys, name, terminal)
        console().print("seen")
        terminal.error = errno.EIO
        console().print("lost")
        terminal.error = errno.ENOSPC
        with pytest.raises(OSError, match="no"):
            console().print("told")
    assert "".join(lines) == "seen\nseen\n"
