"""Counters of jobs: tried with events that the kernel itself counts, so that a machine without counters can tell."""

from __future__ import annotations

import errno
import mmap
import os
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from trilane import machine
from trilane.machine import Machine
from trilane.pipeline.job_times import (
    ATTR,
    KINDS,
    ROW,
    CountedEvent,
    HardwareCounters,
    NoCounters,
    absence,
    availability,
    counters_here,
    remedy,
)

SOFTWARE, PAGE_FAULTS, MINOR_FAULTS = 1, 2, 5
FAULTS = (CountedEvent("faults", SOFTWARE, PAGE_FAULTS), CountedEvent("minor", SOFTWARE, MINOR_FAULTS))
PAGES = 200


def touch(pages: int = PAGES) -> None:
    """Every page of new memory is a fault, and a minor one."""
    with mmap.mmap(-1, pages * mmap.PAGESIZE) as memory:
        for page in range(pages):
            memory[page * mmap.PAGESIZE] = 1


@pytest.fixture
def faults() -> Iterator[HardwareCounters]:
    try:
        counters = HardwareCounters(FAULTS)
    except OSError as error:
        pytest.skip(f"perf_event_open: {error}")
    with closing(counters):
        yield counters


def test_each_counter_counts_what_a_job_did_and_nothing_before_it(faults: HardwareCounters) -> None:
    touch()
    faults.begin()
    touch()
    found = faults.figures()
    assert PAGES <= found["minor"] <= found["faults"] + 1 < 1.5 * PAGES  # the two files are read one after the other
    faults.begin()
    assert faults.figures()["faults"] < PAGES / 2


def test_threads_that_begin_later_count_too_also_when_they_have_ended(faults: HardwareCounters) -> None:
    faults.begin()
    for _ in range(3):
        thread = threading.Thread(target=touch)
        thread.start()
        thread.join()
        touch()
    assert faults.figures()["faults"] >= 6 * PAGES


class ToldCounters:
    """Counters whose files say, one after the other, the rows of each event; an OSError in place of a row is raised."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **rows: list[Any]) -> None:
        self.rows = {kind.config: iter(rows[kind.name]) for kind in KINDS if kind.name in rows}
        self.files: dict[int, int] = {}
        monkeypatch.setattr(machine.here, "open_counter", self.open)
        monkeypatch.setattr(machine.here, "read_counter", self.read)

    def open(self, attributes: bytes, flags: int) -> int:
        kind, size, config, _, _, read_format, bits, *_ = ATTR.unpack(attributes)
        assert (kind, size, read_format, bits, flags) == (0, 64, 1 | 2, 2 | 32 | 64, 8)  # no group, inherited
        if config not in self.rows:
            raise OSError(errno.ENOENT, os.strerror(errno.ENOENT))
        file = os.open(os.devnull, os.O_RDONLY)
        self.files[file] = config
        return file

    def read(self, file: int, size: int) -> bytes:
        row = next(self.rows[self.files[file]])
        if isinstance(row, OSError):
            raise row
        return ROW.pack(*row)[:size] if row else b""


def test_counts_are_scaled_to_the_time_in_which_there_was_a_counter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of two counters has the processor for its own share: a quarter of 100 ns, half of 80 ns; then for none."""
    ToldCounters(
        monkeypatch,
        instructions=[(10, 1000, 500), (13, 1100, 525), (13, 1200, 525)],
        cache_misses=[(20, 100, 50), (24, 180, 90), (24, 280, 90)],
    )
    with closing(HardwareCounters()) as counters:
        assert counters.figures() == {"instructions": 12.0, "cache_misses": 8.0}
    ToldCounters(monkeypatch, instructions=[(13, 1100, 525), (13, 1200, 525)])
    with closing(HardwareCounters()) as counters:
        assert counters.figures() == {}


@pytest.mark.parametrize(
    "unread", [ChildProcessError(errno.ECHILD, "No child processes"), OSError(errno.EIO, "Input/output error"), None]
)
def test_a_counter_that_cannot_be_read_is_missing_and_fails_no_job(
    monkeypatch: pytest.MonkeyPatch, unread: OSError | None
) -> None:
    """Of three jobs the second has no reading at its end, and the third begins with one again; None: an ended file."""
    ToldCounters(
        monkeypatch,
        instructions=[(0, 0, 0), (5, 10, 10), (5, 10, 10), unread, (9, 30, 30), (11, 40, 40), unread, (12, 50, 50)],
        cache_misses=[(0, 0, 0), (1, 10, 10), (1, 10, 10), (2, 20, 20), (2, 30, 30), (4, 40, 40), unread, unread],
    )
    with closing(HardwareCounters()) as counters:
        found = [counters.figures()]
        for _ in range(3):
            counters.begin()
            found.append(counters.figures())
    assert found == [
        {"instructions": 5, "cache_misses": 1},
        {"cache_misses": 1},
        {"instructions": 2, "cache_misses": 2},
        {},
    ]


def test_of_what_a_processor_counts_in_part_that_part_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    told = ToldCounters(monkeypatch, instructions=[(0, 0, 0)] * 3)
    assert absence() is None
    assert availability() == "instructions"
    counters = counters_here()
    counters.close()
    for file in told.files:
        with pytest.raises(OSError, match="Bad file"):
            os.fstat(file)


@pytest.mark.parametrize(
    ("code", "level", "said", "mend"),
    [
        (errno.ENOENT, "2", "this machine shows no counters of its processor, as most virtual machines", "machine of"),
        (errno.EACCES, "4", "kernel.perf_event_paranoid is 4", "sysctl kernel.perf_event_paranoid=2"),
        (errno.EPERM, "2", "this process may not call perf_event_open, as in many containers", "allow perf_event"),
        (errno.EPERM, "", "this process may not call perf_event_open, as in many containers", "allow perf_event"),
        (errno.ENOSYS, "2", "perf_event_open: function not implemented", "allow perf_event_open"),
    ],
)
def test_why_there_are_none(
    code: int, level: str, said: str, mend: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refuse(*_: Any) -> int:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(machine, "here", Machine(tmp_path))
    monkeypatch.setattr(machine.here, "open_counter", refuse)
    (tmp_path / "proc/sys/kernel").mkdir(parents=True)
    (tmp_path / "proc/sys/kernel/perf_event_paranoid").write_text(level)
    assert absence() == said
    assert availability() == f"absent: {said}"
    assert mend in remedy(said)
    counters = counters_here()
    assert isinstance(counters, NoCounters)
    counters.begin()
    assert counters.figures() == {}


def test_an_unknown_processor_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "here", Machine())
    monkeypatch.setattr(machine.here, "architecture", lambda: "vax")
    assert absence() == "perf_event_open: no number of perf_event_open is known for vax"


def test_a_loop_of_this_machine_is_counted_where_its_processor_counts() -> None:
    """On whatever machine this runs: what is said to be counted is what is counted, or nothing is."""
    with closing(counters_here()) as counters:
        counters.begin()
        sum(range(100_000))
        figures = counters.figures()
    assert availability() in (", ".join(figures), f"absent: {absence()}")
    assert figures.get("instructions", 1e6) > 100_000
