"""What the records of a journal mean, from a handful of them, worked out by hand."""

from __future__ import annotations

from collections.abc import Iterable

from trilane.pipeline.journal import Counted, Record, Stepped
from trilane.pipeline.timeline import EndedJob, Fact, Gone, Presented, Timeline
from trilane.scheduler.events import (
    Dispatch,
    Event,
    Finish,
    Graph,
    Hold,
    Job,
    JobDone,
    Kill,
    Outcome,
    OutcomeKind,
    Settings,
    StageSpec,
    UnitDied,
    UnitReady,
    chain,
)

TWO = chain((("a", "u"), ("b", "v")), "double", "b")
UP = Stepped(0, (UnitReady("u"), UnitReady("v")), ())


def job(number: int, stage: str, frame: int, rung: int = 0) -> Dispatch:
    return Dispatch(Job(number, "u" if stage == "a" else "v", stage, frame, 0, 0, 0, rung=rung))


def told(timeline: Timeline, records: Iterable[Record]) -> list[Fact]:
    return [fact for record in records for fact in timeline.add(record) if not isinstance(fact, EndedJob)]


def test_a_frame_is_told_with_its_times_and_its_work() -> None:
    """A frame every 100; the second one is sampled at 112 and its picture ends at 170, 110 after the first one."""
    timeline = Timeline(TWO, Settings(2, period_ns=100))
    records = [
        UP._replace(actions=(job(0, "a", 0),)),
        Stepped(20, (JobDone("u", 0, 1, 18, 3),), (job(1, "b", 0),)),
        Stepped(61, (JobDone("v", 1, 21, 60, 0),), ()),
        Stepped(105, (), (job(2, "a", 1, rung=2),)),
        Stepped(130, (JobDone("u", 2, 110, 128, 112),), (job(3, "b", 1, rung=2),)),
        Stepped(171, (JobDone("v", 3, 131, 170, 0),), (Finish(Outcome(OutcomeKind.DONE)),)),
    ]
    assert told(timeline, records) == [
        Presented(0, 0, 60, None, 60 - 3, skips=False, rung=0),
        Presented(1, 100, 170, 110, 170 - 112, skips=False, rung=2),
    ]
    assert (timeline.presented, timeline.skipped, timeline.not_begun, timeline.frames) == (2, 0, 0, {})
    assert timeline.span == (0, 171)


def test_a_frame_that_takes_the_bypass_says_so() -> None:
    graph = Graph((StageSpec("a", "u"), StageSpec("x", "u"), StageSpec("b", "v")), ("double",) * 2, "b", ("a", "b"))
    timeline = Timeline(graph, Settings(1))
    records = [UP._replace(actions=(job(0, "a", 0),)), Stepped(20, (JobDone("u", 0, 1, 18, 3, skips=True),), ())]
    assert told(timeline, records) == []
    assert (timeline.waiting("x"), timeline.waiting("b")) == ([], [0])
    records = [Stepped(25, (), (job(1, "b", 0),)), Stepped(61, (JobDone("v", 1, 26, 60, 0),), ())]
    assert told(timeline, records) == [Presented(0, 0, 60, None, 57, skips=True, rung=0)]
    assert timeline.skipped == 1


def test_a_job_that_ends_before_its_killed_unit_does_counts() -> None:
    """v is to be killed at 50; at 60 it still ends its job, at 70 it is gone, with the job that it only held."""
    timeline = Timeline(TWO, Settings(9))
    told(timeline, [UP._replace(actions=(job(0, "a", 0),))])
    told(timeline, [Stepped(20, (JobDone("u", 0, 1, 18, 3),), (job(1, "a", 1), job(2, "b", 0)))])
    told(timeline, [Stepped(40, (JobDone("u", 1, 20, 38, 21),), (job(3, "b", 1),))])
    told(timeline, [Stepped(50, (), (Kill("v"),))])
    assert not timeline.units["v"].is_up
    found = told(timeline, [Stepped(60, (JobDone("v", 2, 21, 58, 0), UnitReady("v")), ())])
    assert [type(fact) for fact in found] == [Presented]
    assert not timeline.units["v"].is_up, "it is ready too late: its end is under way"
    told(timeline, [Stepped(70, (UnitDied("v"),), ())])
    assert told(timeline, [Counted(70, {"hung:v": 1}, {})]) == [Gone(1, 20, 70, "lost", "hung:v")]
    told(timeline, [Stepped(90, (UnitReady("v"),), ())])
    assert timeline.units["v"].is_up
    assert list(timeline.downs) == [("v", 50, 90)]


def test_a_pause_is_no_slow_frame() -> None:
    """Frames end every 20; the run is held at 70, one more frame comes by itself at 80, and it goes on at 500."""
    timeline = Timeline(TWO, Settings(9))
    timeline.add(UP)
    found, number = [], 0
    for frame, end_ns in enumerate([40, 60, 80, 520, 540]):
        for hold_ns, frames in ((70, 0), (500, -1)):
            if end_ns - 20 <= hold_ns < end_ns:
                timeline.add(Stepped(hold_ns, (Hold(frames),), ()))
        timeline.add(Stepped(end_ns - 9, (), (job(number, "a", frame),)))
        timeline.add(Stepped(end_ns - 5, (JobDone("u", number, 0, end_ns - 6, 1),), (job(number + 1, "b", frame),)))
        found += told(timeline, [Stepped(end_ns + 1, (JobDone("v", number + 1, 0, end_ns, 0),), ())])
        number += 2
    assert [fact.interval_ns for fact in found if isinstance(fact, Presented)] == [None, 20, None, None, 20]


def test_a_held_run_releases_what_it_is_asked_for() -> None:
    """A frame every 100; held from 150 on, one is let through at 170, and from 900 on the rate goes on."""
    timeline = Timeline(TWO, Settings(9, period_ns=100))
    timeline.add(UP)
    moments: list[tuple[int, tuple[Event, ...], list[int]]] = [
        (110, (), [0, 1]),
        (150, (Hold(0),), [0, 1]),
        (170, (Hold(1),), [0, 1, 2]),
        (800, (), [0, 1, 2]),
        (900, (Hold(-1),), [0, 1, 2, 3]),
        (999, (), [0, 1, 2, 3]),
        (1000, (), [0, 1, 2, 3, 4]),
    ]
    for now_ns, events, waiting in moments:
        timeline.add(Stepped(now_ns, events, ()))
        assert timeline.waiting("a") == waiting, now_ns
