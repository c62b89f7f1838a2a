"""Every hard number keeps its bound on this machine, and there are as many as the progress bar says."""

from __future__ import annotations

import pytest

from trilane.apps.experiments.hard_numbers import COUNT, hard_numbers

pytestmark = pytest.mark.slow


def test_every_hard_number_keeps_its_bound() -> None:
    rows = list(hard_numbers())
    assert [(row["name"], row["error"], row["bound"]) for row in rows if not row["passed"]] == []
    assert len(rows) == len({row["name"] for row in rows}) == COUNT
