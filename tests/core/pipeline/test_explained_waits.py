"""Why jobs waited: each cause from a handful of records, worked out by hand, and the sum over whole runs."""

from __future__ import annotations

import random
from collections.abc import Iterable

import pytest

from trilane.pipeline.journal import Accounted, Counted, Record, Stepped, Worked, journal_of
from trilane.pipeline.timeline import Down, ExplainedJob, Gone, Timeline
from trilane.scheduler.events import Dispatch, Graph, Job, JobDone, Kill, Settings, UnitDied, UnitReady, chain
from trilane.scheduler.ledger import ASSIGNED, BLOCKED, STARVED, THROTTLED, JobRecord
from trilane.scheduler.virtual import simulate

GRAPH = chain([("draw", "gpu"), ("infer", "dsp"), ("mix", "gpu")], "double", "mix")
UP = Stepped(0, (UnitReady("gpu"), UnitReady("dsp")), ())


def job(number: int, stage: str, unit: str, frame: int, rung: int = 0) -> Dispatch:
    return Dispatch(Job(number, unit, stage, frame, 0, 0, 0, rung=rung))


def jobs_of(timeline: Timeline, records: Iterable[Record]) -> list[ExplainedJob]:
    return [fact for record in records for fact in timeline.add(record) if isinstance(fact, ExplainedJob)]


def explained(*records: Record, graph: Graph = GRAPH, kept: int = 100) -> list[ExplainedJob]:
    return jobs_of(Timeline(graph, Settings(1000), waits=True, kept=kept), (UP, *records))


def before_infer(*accounts: tuple[int, int]) -> list[Record]:
    """draw of frame 0 ends at 100 and is heard of at 110; from then on the dsp's time is as `accounts` say."""
    return [
        Stepped(10, (), (job(0, "draw", "gpu", 0),)),
        Stepped(110, (JobDone("gpu", 0, 20, 100, 20),), ()),
        Accounted(110, "gpu", STARVED),
        Worked(JobRecord("draw", "gpu", 0, 10, 10, 20, 100), {"texels": 7.0}),
        *(Accounted(now_ns, "dsp", account) for now_ns, account in accounts),
    ]


def infer(ready_ns: int, dispatch_ns: int, begin_ns: int, preempted_before_ns: int = 0) -> list[Record]:
    """infer of frame 0, handed over at `dispatch_ns`, which runs for 50 ns."""
    end_ns = begin_ns + 50
    lost = {"preempted_before_ns": preempted_before_ns}
    return [
        Stepped(dispatch_ns, (), (job(1, "infer", "dsp", 0, rung=2),)),
        Accounted(dispatch_ns, "dsp", ASSIGNED),
        Stepped(end_ns + 5, (JobDone("dsp", 1, begin_ns, end_ns, 0, 0, 0, preempted_before_ns),), ()),
        Worked(JobRecord("infer", "dsp", 0, ready_ns, dispatch_ns, begin_ns, end_ns, **lost), {}),
    ]


@pytest.mark.parametrize(
    ("account", "cause"), [(BLOCKED, "blocked"), (THROTTLED, "throttled"), (STARVED, "held"), (ASSIGNED, "overhead")]
)
def test_what_the_unit_had_no_job_for_is_why_the_job_waited(account: int, cause: str) -> None:
    """Ready at 100, heard of at 110, handed over at 300, begun at 320: 190 ns by the account, 10 + 20 on the way."""
    draw, found = explained(*before_infer((110, account)), *infer(100, 300, 320))
    assert draw.waits_ns == {"overhead": 10}
    assert draw.figures == {"texels": 7.0}
    expected = {"overhead": 220} if cause == "overhead" else {cause: 190, "overhead": 30}
    assert found.waits_ns == expected
    assert (found.cause, found.behind, found.rung, found.presented) == (cause, None, 2, None)


def test_accounts_that_change_are_told_apart() -> None:
    _, found = explained(*before_infer((110, BLOCKED), (200, THROTTLED), (260, STARVED)), *infer(100, 300, 300))
    assert found.waits_ns == {"overhead": 10, "blocked": 90, "throttled": 60, "held": 40}


def test_after_the_hand_over_the_unit_may_lack_its_core() -> None:
    """Of 60 ns after the hand-over the unit had no core for 45; it cannot have lacked it for longer than that."""
    _, found = explained(*before_infer((110, STARVED)), *infer(100, 110, 170, preempted_before_ns=45))
    assert found.waits_ns == {"overhead": 10 + 15, "preempted": 45}
    _, found = explained(*before_infer((110, STARVED)), *infer(100, 110, 170, preempted_before_ns=1000))
    assert found.waits_ns == {"overhead": 10, "preempted": 60}


def test_a_unit_that_is_busy_names_the_job_that_it_does() -> None:
    """mix of frame 0 is ready at 150; its unit draws frame 1 until 190 and frame 2 from 195 to 400."""
    found = explained(
        *before_infer((110, STARVED)),
        Stepped(110, (), (job(2, "draw", "gpu", 1), job(3, "draw", "gpu", 2))),
        Accounted(110, "gpu", ASSIGNED),
        *infer(100, 110, 110)[:-1],
        Worked(JobRecord("infer", "dsp", 0, 100, 110, 110, 150), {}),
        Stepped(191, (JobDone("gpu", 2, 115, 190, 115),), ()),
        Worked(JobRecord("draw", "gpu", 1, 110, 110, 115, 190), {}),
        Stepped(200, (), (job(4, "mix", "gpu", 0),)),
        Stepped(401, (JobDone("gpu", 3, 195, 400, 195),), ()),
        Worked(JobRecord("draw", "gpu", 2, 110, 110, 195, 400), {}),
        Stepped(500, (JobDone("gpu", 4, 404, 490, 0),), ()),
        Worked(JobRecord("mix", "gpu", 0, 150, 200, 404, 490), {}),
    )[-1]
    assert found.waits_ns == {"busy": 40 + 205, "overhead": 5 + 4}
    assert found.behind is not None
    assert (found.behind.stage, found.behind.frame) == ("draw", 2)


def test_a_job_that_is_lost_with_its_process_and_the_restart_are_told_apart() -> None:
    """infer of frame 0 hangs from its hand-over at 110 until its unit is killed at 400; the unit is up again at 900."""
    timeline = Timeline(GRAPH, Settings(9), waits=True)
    records: list[Record] = [
        UP,
        *before_infer((110, STARVED)),
        Stepped(110, (), (job(1, "infer", "dsp", 0),)),
        Accounted(110, "dsp", ASSIGNED),
        Stepped(120, (), (job(2, "infer", "dsp", 1),)),  # ahead; it is handed over again
        Stepped(400, (), (Kill("dsp"),)),
        Stepped(410, (UnitDied("dsp"),), ()),
        Stepped(900, (UnitReady("dsp"),), (job(3, "infer", "dsp", 1),)),
        Stepped(960, (JobDone("dsp", 3, 905, 950, 0),), ()),
        Worked(JobRecord("infer", "dsp", 1, 112, 900, 905, 950), {}),
    ]
    found = jobs_of(timeline, records)[-1]
    assert found.waits_ns == {"lost": 400 - 112, "down": 500, "overhead": 5}
    assert list(timeline.downs) == [Down("dsp", 400, 900)]


def test_time_without_a_core_is_counted_once() -> None:
    """Handed over at 110; 10 ns until another job from 120 to 200, 30 ns after it; 25 ns without a core in all."""
    found = explained(
        *before_infer((110, ASSIGNED)),
        Stepped(110, (), (job(9, "infer", "dsp", 9),)),
        Stepped(201, (JobDone("dsp", 9, 120, 200, 0),), ()),
        Worked(JobRecord("infer", "dsp", 9, 110, 110, 120, 200), {}),
        *infer(100, 110, 230, preempted_before_ns=25),
    )[-1]
    assert found.waits_ns == {"overhead": 10 + 40 - 25, "preempted": 25, "busy": 80}


def test_input_that_comes_while_the_unit_is_down_waits_for_the_unit() -> None:
    """The dsp is down from 50 to 900; draw of frame 0 ends at 100, of which the scheduler hears at 110."""
    found = explained(
        Stepped(50, (UnitDied("dsp"),), ()),
        *before_infer(),
        Stepped(900, (UnitReady("dsp"),), ()),
        *infer(100, 900, 905),
    )[-1]
    assert found.waits_ns == {"down": 800, "overhead": 5}


def test_what_was_lost_began_after_the_last_job() -> None:
    """Two jobs are handed over at 110; the first ends at 300, the second is lost with the process at 400."""
    found = explained(
        *before_infer((110, ASSIGNED)),
        Stepped(110, (), (job(8, "infer", "dsp", 8), job(9, "infer", "dsp", 9))),
        Stepped(301, (JobDone("dsp", 8, 110, 300, 0),), ()),
        Worked(JobRecord("infer", "dsp", 8, 110, 110, 110, 300), {}),
        Stepped(400, (UnitDied("dsp"),), ()),
        Stepped(600, (UnitReady("dsp"),), ()),
        *infer(100, 600, 600),
    )[-1]
    assert found.waits_ns == {"overhead": 10, "busy": 190, "lost": 100, "down": 200}


def test_frames_that_never_come_to_an_end_are_forgotten() -> None:
    """Their first jobs are heard of and dropped before they are booked; of those that ended, the last ten are kept."""
    timeline = Timeline(GRAPH, Settings(100), waits=True, kept=10)
    timeline.add(UP)
    for number in range(100):
        timeline.add(Stepped(number, (), (job(number, "draw", "gpu", number),)))
        timeline.add(Stepped(number, (JobDone("gpu", number, number, number, 0),), ()))
        (gone,) = timeline.add(Counted(number, {}, {"draw->infer:stale": number + 1}))
        assert gone == Gone(number, number, number, "dropped", "draw->infer:stale")
    assert (len(timeline._ended), timeline.frames, timeline._track._heard_ns, timeline.waiting("infer")) == (
        10,
        {},
        {},
        [],
    )


def test_the_ends_that_were_heard_of_in_the_step_of_the_hand_over_are_kept() -> None:
    records = before_infer()
    records[1] = Stepped(110, (JobDone("gpu", 0, 20, 100, 20),), (job(1, "infer", "dsp", 0),))
    done = Stepped(200, (JobDone("dsp", 1, 120, 190, 0, skips=True),), ())
    _, found = explained(*records, done, Worked(JobRecord("infer", "dsp", 0, 100, 110, 120, 190), {}))
    assert (found.after, found.skips) == ((("draw", 0),), True)


def test_what_is_no_longer_kept_is_unknown() -> None:
    """Two jobs of the unit are kept, the older from 300 on: the 200 ns of the wait before that are unknown."""
    others: list[Record] = []
    for number, begin_ns in enumerate((110, 300, 400), start=10):
        others += [
            Stepped(begin_ns, (), (job(number, "infer", "dsp", number),)),
            Stepped(begin_ns + 90, (JobDone("dsp", number, begin_ns, begin_ns + 90, 0),), ()),
            Worked(JobRecord("infer", "dsp", number, begin_ns, begin_ns, begin_ns, begin_ns + 90), {}),
        ]
    found = explained(*before_infer(), *others, *infer(100, 495, 500), kept=2)[-1]
    assert found.waits_ns == {"unknown": 200, "busy": 180, "held": 10 + 5, "overhead": 5}


@pytest.mark.parametrize("seed", range(12))
def test_causes_sum_to_the_wait_in_runs_with_faults(seed: int) -> None:
    """Any chain, policy and edge, with units that die: every ns of every wait has one cause, and none is unknown."""
    random.seed(seed)
    units = [random.choice(("cpu", "gpu", "dsp")) for _ in range(5)]
    edge = random.choice(("single", "double", "triple", "fifo:3", "orphan"))
    graph = chain([(f"stage {place}", unit) for place, unit in enumerate(units)], edge, "stage 4")
    policy = random.choice(("sequential", "pipelined", "latest", "deadline"))
    paced = {"period_ns": 3000, "deadline_ns": 12_000} if policy in ("latest", "deadline") else {}
    run = simulate(
        graph,
        Settings(60, policy, hang_ns=10**9, **paced),
        lambda *_: random.randrange(200, 2000),
        message_delay_ns=random.randrange(50),
        restart_ns=5000,
        faults=[(random.randrange(60_000), random.choice(units)) for _ in range(3)],
        keep=True,
    )
    assert run.recording is not None
    records = journal_of(run.recording, run.jobs, {}, {})
    next(records)
    found = jobs_of(Timeline(graph, run.recording.settings, waits=True), records)
    assert [one.job for one in found] == list(run.jobs)
    for one in found:
        assert sum(one.waits_ns.values()) == one.job.begin_ns - one.job.ready_ns
        assert all(ns > 0 for ns in one.waits_ns.values())
        assert "unknown" not in one.waits_ns
