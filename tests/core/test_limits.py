"""docs/limits.md states each limit and deadline as the code has it: who reads 120 s waits for 120 s."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest

TABLE = Path(__file__).resolve().parents[2] / "docs" / "limits.md"
#: Seconds of a unit in the table, and of one in the ending of a constant's name.
UNITS = {"": None, "s": 1.0, "ms": 1e-3, "us": 1e-6}
ENDINGS = {"_S": 1.0, "_MS": 1e-3, "_NS": 1e-9}
ROW = re.compile(r"^\| `([\w.]+)\.([A-Z_]+)` \| ([\d.]+) ?(s|ms|us|) \| \S.* \|$", re.MULTILINE)
ROWS = {f"{module}.{name}": (float(number), unit) for module, name, number, unit in ROW.findall(TABLE.read_text())}


def test_every_row_of_the_table_is_read() -> None:
    assert len(ROWS) == sum(line.startswith("| `") for line in TABLE.read_text().splitlines()) > 40


@pytest.mark.parametrize("name", ROWS)
def test_the_code_has_what_the_table_says(name: str) -> None:
    number, unit = ROWS[name]
    module, _, constant = name.rpartition(".")
    try:
        value = getattr(import_module(f"trilane.{module}"), constant)
    except ModuleNotFoundError as error:
        if str(error.name).startswith("trilane"):
            raise
        pytest.skip(f"{module} needs {error.name}, of an extra")
    if unit:
        assert value * ENDINGS[re.search(r"_[A-Z]+$", constant)[0]] == pytest.approx(number * UNITS[unit], rel=1e-12)
    else:
        assert value == number


def test_what_follows_from_one_another() -> None:
    """A unit that is asked at each ping is heard of before the scheduler takes itself for stopped."""
    from trilane.pipeline import fork_server, isolated, realtime_clock
    from trilane.transport import job_pipe

    assert realtime_clock.LONGEST_STEP_NS > realtime_clock.PING_NS
    assert isolated.AT_ONCE == job_pipe.PACKETS - 4 == 12
    assert tuple(f"{name}_NUM_THREADS" for name in ("OMP", "OPENBLAS", "MKL", "NUMEXPR")) == fork_server.THREAD_LIMITS
