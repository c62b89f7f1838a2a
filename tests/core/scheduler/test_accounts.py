"""Where the time of a run goes: timelines of five frames worked out by hand, and the same accounts from the trace."""

from __future__ import annotations

import random
from typing import Any

import pytest

from support.second_accounts import drawn_run, largest_difference, second_accounts
from trilane.pipeline.journal import records_of
from trilane.pipeline.timeline import ExplainedJob, Timeline
from trilane.scheduler.core import Core
from trilane.scheduler.events import (
    Event,
    FrameRequest,
    JobDone,
    Pinged,
    SetDuty,
    Settings,
    Stop,
    UnitDied,
    UnitReady,
    chain,
)
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.recording import Recording
from trilane.scheduler.virtual import Simulation, simulate

MS = 1_000_000
TWO_UNITS = (("a", "u"), ("b", "v"))
#: (busy, starved, blocked, throttled, preempted, overhead) in ms.
Parts = tuple[float, float, float, float, float, float]


def run(edge: str = "single", policy: str = "pipelined", *, b: int = 5, **options: Any) -> Simulation:
    """Five frames through a (2 ms) and b on two units."""
    settings = Settings(5, policy, **options.pop("settings", {}))
    graph, service = chain(TWO_UNITS, edge, "b"), {"a": 2 * MS, "b": b * MS}
    return simulate(graph, settings, lambda stage, *_: service[stage], keep=True, **options)


def parts(report: dict[str, Any], unit: str) -> Parts:
    row, total = report["units"][unit], report["duration_s"] * 1e3
    return tuple(round(share * total, 6) for share in (row["busy"], *row["idle"].values()))  # type: ignore[return-value]


def times(done: Simulation, stage: str) -> list[tuple[float, ...]]:
    """(frame, ready, begin, end) in ms of each job that ended."""
    rows = [
        (job.frame, job.ready_ns / MS, job.begin_ns / MS, job.end_ns / MS) for job in done.jobs if job.stage == stage
    ]
    return sorted(rows)


def agrees(done: Simulation) -> None:
    assert done.recording is not None
    second = second_accounts(done.recording, done.jobs)
    assert largest_difference(done.report["units"], second) < 1e-12
    assert all(sum(row.values()) == pytest.approx(1, abs=1e-12) for row in second.values())


def always(ms: float) -> dict[str, float]:
    """The summary of five frames that all took `ms`."""
    return {**dict.fromkeys(("mean", "p50", "p90", "p95", "p99", "max"), ms), "samples": 5}


def test_five_frames_through_one_slot() -> None:
    """A message takes 1 ms each way. The slot is held from a's dispatch until b's end is heard: the units take turns.

    Frame n: a is handed it at 11n, runs from 11n + 1 to 11n + 3 and is heard at 11n + 4; b is handed it then, runs from
    11n + 5 to 11n + 10 and is heard at 11n + 11. So a has a job for 4 ms of 11 and works for 2; for the other 7 it is
    blocked, in the last round without a frame to come: starved. b is starved for 4 of 11 and works for 5 of the rest.
    """
    done = run(message_delay_ns=MS, target_period_ns=10 * MS)
    assert times(done, "a") == [(n, 11 * n, 11 * n + 1, 11 * n + 3) for n in range(5)]
    assert times(done, "b") == [(n, 11 * n + 3, 11 * n + 5, 11 * n + 10) for n in range(5)]
    report = done.report
    assert report["duration_s"] == 0.055
    assert parts(report, "u") == (10, 7, 28, 0, 0, 10)
    assert parts(report, "v") == (25, 20, 0, 0, 0, 10)
    assert report["stages"]["a"]["wait_ms"] == always(1.0)
    assert report["stages"]["b"]["wait_ms"] == always(2.0)
    assert report["stages"]["b"]["service_ms"] == always(5.0)
    assert report["latency_ms"] == always(9.0)  # from a's begin at 11n + 1 to b's end at 11n + 10
    assert (report["frame_time_ms"]["mean"], report["fps"]) == (11.0, pytest.approx(1000 / 11))
    assert report["deadline_misses"] == 4  # four intervals of 11 ms, each above 10
    agrees(done)


def test_five_frames_of_which_two_are_replaced_by_newer_ones() -> None:
    """`latest` through a mailbox, a frame every 10 ms, b takes 25 and no message takes time.

    b runs frame 0 from 2 to 27, holds frame 1 since 12 (it did not know yet how long a job takes) and runs it to 52.
    Frame 2 waits from 22 and is replaced by 3 at 32, which is replaced by 4 at 42. b runs 4 until 77. Deadlines are at
    35, 45 and 75: the second and the last are missed.
    """
    done = run("triple", "latest", b=25, settings={"period_ns": 10 * MS, "deadline_ns": 35 * MS})
    assert times(done, "a") == [(n, 10 * n, 10 * n, 10 * n + 2) for n in range(5)]
    assert times(done, "b") == [(0, 2, 2, 27), (1, 12, 27, 52), (4, 42, 52, 77)]
    report = done.report
    assert report["frames"]["dropped"] == {"a->b:stale": 2}
    assert (report["frames"]["presented"], report["frames"]["lost"]) == (3, 0)
    assert parts(report, "u") == (10, 67, 0, 0, 0, 0)
    assert parts(report, "v") == (75, 2, 0, 0, 0, 0)
    assert report["stages"]["b"]["wait_ms"]["mean"] == pytest.approx((0 + 15 + 10) / 3, abs=1e-5)
    assert (report["stages"]["b"]["wait_ms"]["p50"], report["stages"]["b"]["wait_ms"]["max"]) == (10, 15)
    assert report["latency_ms"]["mean"] == pytest.approx((27 + 42 + 37) / 3, abs=1e-5)
    assert report["latency_ms"]["max"] == 42
    assert report["deadline_misses"] == 2
    agrees(done)


def test_five_frames_with_a_unit_that_dies() -> None:
    """v dies at 9, two ms into frame 1, and is back at 29. What it worked for then, and its absence, are overhead.

    a fills both slots, is blocked from 4 until b ends frame 0 at 7, fills the slot again, and the one that the death
    freed at 9; from 11 on both hold waiting frames, and it is blocked until b has ended frame 2, from 29 to 34.
    """
    done = run("double", faults=[(9 * MS, "v")], restart_ns=20 * MS)
    assert times(done, "a") == [(0, 0, 0, 2), (1, 0, 2, 4), (2, 7, 7, 9), (3, 9, 9, 11), (4, 34, 34, 36)]
    assert times(done, "b") == [(0, 2, 2, 7), (2, 9, 29, 34), (3, 11, 34, 39), (4, 36, 39, 44)]
    report = done.report
    assert report["frames"]["lost_by_cause"] == {"died:v": 1}
    assert parts(report, "u") == (10, 8, 26, 0, 0, 0)
    assert parts(report, "v") == (20, 2, 0, 0, 0, 2 + 20)
    assert report["units"]["v"]["restarts"] == 1
    assert report["stages"]["b"]["wait_ms"]["mean"] == (0 + 20 + 23 + 3) / 4
    agrees(done)


def test_a_unit_at_half_duty_is_throttled_half_of_the_time() -> None:
    """b rests after each job as long as it took: 5 of 10 ms; the last rest is after the run's end.

    a fills a slot at once when b has ended the job that read it, so its input is always there when b has rested.
    """
    done = run("double", inputs=[(0, SetDuty("v", 500))])
    assert times(done, "b") == [(0, 2, 2, 7), (1, 4, 12, 17), (2, 9, 22, 27), (3, 19, 32, 37), (4, 29, 42, 47)]
    assert parts(done.report, "v") == (25, 2, 0, 20, 0, 0)
    agrees(done)


def fed(settings: Settings, steps: list[tuple[int, tuple[Event, ...]]], jobs: list[JobRecord]) -> dict[str, Any]:
    """The report of a core with one stage on one unit that hears `steps`; `jobs` are those that they end."""
    graph = chain((("a", "u"),), "single", "a")
    core, recording = Core(graph, settings), Recording(graph, settings)
    for now_ns, events in steps:
        recording.add(now_ns, events, core.step(now_ns, events).actions, core)
    report = core.report(clock="host")
    assert largest_difference(report["units"], second_accounts(recording, jobs)) < 1e-12
    return report


def test_a_unit_that_answers_no_ping_is_overhead_from_its_killing_on() -> None:
    """It is starved until it is killed at 10; its end is heard at 13, it is back at 20, starved, and stopped at 24."""
    settings = Settings(5, asked=True, hang_ns=10 * MS)
    steps: list[tuple[int, tuple[Event, ...]]] = [
        (0, (UnitReady("u"), Pinged("u"))),
        (10 * MS, ()),
        (13 * MS, (UnitDied("u"),)),
        (13 * MS, ()),
        (20 * MS, (UnitReady("u"),)),
        (24 * MS, (Stop(),)),
    ]
    assert parts(fed(settings, steps, []), "u") == (0, 10 + 4, 0, 0, 0, 3 + 7)


def test_what_a_unit_waited_for_a_core_before_it_had_a_job_is_not_preempted() -> None:
    """It waited for 8 ms since its last job, in 2 of which it had the next one: the frame was asked for at 10."""
    spans = [(0, 4), (12, 15)]
    done = [JobDone("u", n, begin * MS, end * MS, 0, 0, 0, 8 * MS * n) for n, (begin, end) in enumerate(spans)]
    jobs = [JobRecord("a", "u", n, 0, 0, b * MS, e * MS, 0, 0, 8 * MS * n) for n, (b, e) in enumerate(spans)]
    steps: list[tuple[int, tuple[Event, ...]]] = [
        (0, (UnitReady("u"), FrameRequest(1))),
        (4 * MS, (done[0],)),
        (10 * MS, (FrameRequest(1),)),
        (15 * MS, (done[1],)),
    ]
    assert parts(fed(Settings(2, asked=True), steps, jobs), "u") == (4 + 3, 6, 0, 0, 2, 0)


def test_a_frame_that_is_released_late_is_overhead_since_it_was_due() -> None:
    """A frame every 10 ms. The second is due at 10 and the scheduler looks at 13; the third comes in time, at 20."""
    spans = [(0, 2), (13, 15), (20, 21)]
    done = [JobDone("u", n, begin * MS, end * MS, 0) for n, (begin, end) in enumerate(spans)]
    due = [0, 10, 20]
    jobs = [JobRecord("a", "u", n, due[n] * MS, b * MS, b * MS, e * MS) for n, (b, e) in enumerate(spans)]
    steps: list[tuple[int, tuple[Event, ...]]] = [
        (0, (UnitReady("u"),)),
        (2 * MS, (done[0],)),
        (13 * MS, ()),
        (15 * MS, (done[1],)),
        (20 * MS, ()),
        (21 * MS, (done[2],)),
    ]
    settings = Settings(3, period_ns=10 * MS)
    assert parts(fed(settings, steps, jobs), "u") == (2 + 2 + 1, 8 + 5, 0, 0, 0, 3)
    graph = chain((("a", "u"),), "single", "a")
    core, recording = Core(graph, settings), Recording(graph, settings)
    timeline = Timeline(graph, settings, waits=True)
    for now_ns, events in steps:
        recording.add(now_ns, events, core.step(now_ns, events).actions, core)
    facts = [fact for record in records_of(recording, jobs) for fact in timeline.add(record)]
    explained = [fact for fact in facts if isinstance(fact, ExplainedJob)]
    assert [dict(one.waits_ns) for one in explained] == [{}, {"overhead": 3 * MS}, {}]


def test_what_a_unit_lost_is_booked_under_its_causes() -> None:
    """One stage, jobs as a unit reports them, in ms: (begin, end, preempted, asleep, preempted before).

    Before the first the unit waited 1 of 2 ms for its core; in it, it ran for 4 of 8. Nothing lies between the first
    and the second, so what is said of that time counts for nothing; before the third no more than the 5 ms that lie
    there. The fourth slept. The end of the last is heard a ms later.
    """
    reported = [(2, 10, 3, 1, 1), (10, 20, 0, 0, 4), (25, 30, 5, 0, 9), (30, 40, 0, 10, 0), (42, 50, 0, 0, 0)]
    steps: list[tuple[int, tuple[Event, ...]]] = [(0, (UnitReady("u"),))]
    jobs = []
    for number, (begin, end, *lost) in enumerate(reported):
        spans = begin * MS, end * MS
        done = JobDone("u", number, *spans, begin * MS, *(ms * MS for ms in lost))
        jobs.append(JobRecord("a", "u", number, 0, 0, *spans, *(ms * MS for ms in lost)))
        steps.append(((end + (number == 4)) * MS, (done,)))
    report = fed(Settings(5), steps, jobs)
    assert parts(report, "u") == (4 + 10 + 0 + 0 + 8, 0, 0, 0, 1 + 3 + 5 + 5, 1 + 1 + 10 + 2 + 1)
    assert report["stages"]["a"]["service_ms"]["mean"] == (8 + 10 + 5 + 10 + 8) / 5  # the wall's time


@pytest.mark.parametrize("seed", range(50))
def test_the_timeline_adds_up_to_the_ledger_in_random_runs(seed: int) -> None:
    done = drawn_run(random.Random(seed), 40)
    agrees(done)
    for row in done.report["units"].values():
        assert min(row["busy"], *row["idle"].values()) >= 0
        assert row["busy"] + sum(row["idle"].values()) == pytest.approx(1, abs=1e-12)


# One of the two computations is wrong: the comparison shows it.


def test_a_job_that_is_too_long_or_missing_shows() -> None:
    done = run("double", faults=[(9 * MS, "v")], restart_ns=20 * MS, message_delay_ns=MS)
    assert done.recording is not None
    first, *others = done.jobs
    share = 1e6 / (done.report["duration_s"] * 1e9)
    for jobs in ([first._replace(begin_ns=first.begin_ns - MS), *others], others):
        assert largest_difference(done.report["units"], second_accounts(done.recording, jobs)) >= share - 1e-12
