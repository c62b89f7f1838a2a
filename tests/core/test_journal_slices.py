"""A run cut while it goes on has the slices of the whole, each as soon as nothing before it can follow."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest

from support.second_accounts import idle_slices
from trilane.pipeline.journal import (
    Accounted,
    Begun,
    Counted,
    Ended,
    Record,
    Stepped,
    Worked,
    journal_of,
)
from trilane.pipeline.journal_values import RunValues
from trilane.pipeline.timeline import Span, Timeline
from trilane.pipeline.unit_history import UNEXPLAINED, IdleSlice
from trilane.scheduler.events import Settings, UnitReady, chain
from trilane.scheduler.ledger import ASSIGNED, JobRecord
from trilane.scheduler.virtual import Simulation, simulate
from trilane.unexpected_value import UnexpectedValue

MS = 1_000_000
TWO = chain((("a", "u"), ("b", "v")), "double", "b")


def a_run(frames: int = 5, **options: object) -> Simulation:
    """a takes 2 ms, b 5; v dies at 9 ms and is back at 29."""
    service = {"a": 2 * MS, "b": 5 * MS}
    faults = [(9 * MS, "v")] if not options else []
    return simulate(
        TWO,
        Settings(frames, **options),  # type: ignore[arg-type]
        lambda stage, *_: service[stage],
        keep=True,
        restart_ns=20 * MS,
        faults=faults,
    )


def records(done: Simulation) -> Iterator[Record]:
    assert done.recording is not None
    return journal_of(done.recording, done.jobs, {"clock": "virtual"}, done.report)


def test_slices_come_as_soon_as_they_are_known() -> None:
    """(unit, cause, begin, end) in ms, by the time of the step with which they were handed back.

    The timeline is that of test_accounts.py: u is blocked from 4 to 7 and from 11 to 34, v down from 9 to 29.
    """
    timeline, seen = Timeline(TWO, Settings(5), idle=True), []
    for record in records(a_run()):
        found = [fact for fact in timeline.add(record) if isinstance(fact, IdleSlice)]
        assert not found or isinstance(record, Stepped)
        if isinstance(record, Stepped):
            seen += [(record.now_ns // MS, one.unit, one.cause, one.begin_ns // MS, one.end_ns // MS) for one in found]
    rest = [(one.unit, one.cause, one.begin_ns // MS, one.end_ns // MS) for one in timeline.end()]
    assert seen == [
        (4, "v", "starved", 0, 2),
        (9, "u", "blocked", 4, 7),
        (36, "v", "overhead", 7, 29),
        (36, "u", "blocked", 11, 34),
    ]
    assert rest == [("u", "starved", 36, 44)]
    assert timeline.span == Span(0, 44 * MS)


@pytest.mark.parametrize("seed", range(12))
def test_slices_are_in_the_order_of_their_ends_and_units_never_overlap(seed: int) -> None:
    rng = random.Random(seed)
    service = {"a": rng.randint(1, 9) * MS, "b": rng.randint(1, 9) * MS}
    faults = sorted((rng.randint(0, 200) * MS, rng.choice("uv")) for _ in range(3))
    done = simulate(
        TWO,
        Settings(30),
        lambda stage, *_: service[stage] + rng.randint(0, MS),
        keep=True,
        faults=faults,
        restart_ns=7 * MS,
        message_delay_ns=MS // 3,
    )
    assert done.recording is not None
    slices, _ = idle_slices(done.recording, done.jobs)
    assert [one.end_ns for one in slices] == sorted(one.end_ns for one in slices)
    for unit in "uv":
        pieces = [(one.begin_ns, one.end_ns) for one in (*slices, *done.jobs) if one.unit == unit]
        ends = [0, *(end for _, end in sorted(pieces))]
        assert all(begin >= end for (begin, _), end in zip(sorted(pieces), ends, strict=False))


def test_a_run_in_memory_as_a_journal() -> None:
    """Each job follows the step that heard its end; frames left out are told when there are more."""
    done = a_run()
    first, *middle, last = records(done)
    assert isinstance(first, Begun) and first.facts == {"clock": "virtual"}
    assert last == Ended(44 * MS, done.report)
    jobs = [record.job for record in middle if isinstance(record, Worked)]
    assert sorted(jobs) == sorted(done.jobs)
    now_ns = 0
    for record in middle:
        if isinstance(record, Stepped):
            now_ns = record.now_ns
        elif isinstance(record, Worked):
            assert record.job.end_ns == now_ns
    assert [record for record in middle if isinstance(record, Counted)] == [Counted(9 * MS, {"died:v": 1}, {})]


def test_what_is_held_of_a_long_run_is_what_is_in_flight() -> None:
    """Of 400 frames no more slices wait for their turn than of 40."""
    most = []
    for frames in (40, 400):
        timeline, held = Timeline(TWO, Settings(frames, in_flight=1), idle=True), 0
        for record in records(a_run(frames, in_flight=1)):
            timeline.add(record)
            held = max(held, len(timeline._cutter._held))
        most.append(held)
    assert most[0] == most[1] < 5


def test_time_that_nobody_explains_has_its_own_name() -> None:
    """A unit that is up and has no job, whose account says that it has one."""
    timeline = Timeline(chain((("a", "u"),), "single", "a"), Settings(1), idle=True)
    told = (Stepped(5, (UnitReady("u"),), ()), Accounted(5, "u", ASSIGNED), Stepped(9, (), ()))
    assert [timeline.add(record) for record in told] == [[], [], []]
    assert timeline.end() == [IdleSlice("u", UNEXPLAINED, 5, 9)]


def test_a_journal_of_before_jobs_had_their_cpu_time_is_read() -> None:
    row = ("a", "u", 3, 1, 2, 3, 9, 0, 1, 0)
    assert RunValues(TWO).job(row) == JobRecord(*row, cpu_ns=0)
    assert RunValues(TWO).job((*row, 4)).cpu_ns == 4
    with pytest.raises(UnexpectedValue, match="texts and whole numbers"):
        RunValues(TWO).job(row[:-1])
