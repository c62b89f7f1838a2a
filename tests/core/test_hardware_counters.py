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

from trilane.pipeline import hardware_counters
from trilane.pipeline.hardware_counters import (
    KINDS,
    Counted,
    HardwareCounters,
    NoCounters,
    absence,
    availability,
    counters_here,
    remedy,
)

SOFTWARE, PAGE_FAULTS, MINOR_FAULTS = 1, 2, 5
FAULTS = (Counted("faults", SOFTWARE, PAGE_FAULTS), Counted("minor", SOFTWARE, MINOR_FAULTS))
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


def test_a_group_counts_what_a_job_did_and_nothing_before_it(faults: HardwareCounters) -> None:
    touch()
    faults.begin()
    touch()
    found = faults.figures()
    assert found["faults"] == found["minor"]
    assert PAGES <= found["faults"] < 1.5 * PAGES
    faults.begin()
    assert faults.figures()["faults"] < PAGES / 2


def test_threads_that_begin_later_count_too(faults: HardwareCounters) -> None:
    faults.begin()
    thread = threading.Thread(target=touch)
    thread.start()
    thread.join()
    assert faults.figures()["faults"] >= PAGES


def test_counts_are_scaled_to_the_time_in_which_there_was_a_counter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two counts, for 25 of 100 ns; then for none."""
    rows = iter([(2, 1000, 500, 10, 20), (2, 1100, 525, 13, 21), (2, 1200, 525, 13, 21)])
    monkeypatch.setattr(hardware_counters, "_open", lambda *_: os.open(os.devnull, os.O_RDONLY))
    monkeypatch.setattr(HardwareCounters, "_read", lambda self: self._row.pack(*next(rows)))
    with closing(HardwareCounters(FAULTS)) as counters:
        before = counters._before
        assert counters.figures() == {"faults": 12.0, "minor": 4.0}
        counters._before = counters._row.pack(2, 1100, 525, 13, 21)
        assert counters.figures() == {}
    assert before


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

    (tmp_path / "paranoid").write_text(level)
    monkeypatch.setattr(hardware_counters, "PARANOID", tmp_path / "paranoid")
    monkeypatch.setattr(hardware_counters, "_open", refuse)
    assert absence() == said
    assert availability() == f"absent: {said}"
    assert mend in remedy(said)
    counters = counters_here()
    assert isinstance(counters, NoCounters)
    counters.begin()
    assert counters.figures() == {}


def test_no_file_is_left_open_where_the_second_counter_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[int] = []

    def once(_kind: Counted, leader: int) -> int:
        if leader >= 0:
            raise OSError(errno.EINVAL, "no")
        opened.append(os.open(os.devnull, os.O_RDONLY))
        return opened[0]

    monkeypatch.setattr(hardware_counters, "_open", once)
    assert absence() is not None
    with pytest.raises(OSError, match="Bad file"):
        os.fstat(opened[0])


def test_an_unknown_processor_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hardware_counters.platform, "machine", lambda: "vax")
    assert absence() == "perf_event_open: no number of perf_event_open is known for vax"


def test_what_is_said_is_what_is_counted() -> None:
    """On whatever machine this runs."""
    with closing(counters_here()) as counters:
        counters.begin()
        sum(range(100_000))
        figures = counters.figures()
    if absence() is None:
        assert availability() == "instructions, cache_misses"
        assert figures["instructions"] > 100_000
    else:
        assert availability() == f"absent: {absence()}"
        assert figures == {}
    assert [kind.name for kind in KINDS] == ["instructions", "cache_misses"]
