"""Runs with a bypass, worked out on paper: every job, slot, wait, latency and idle share is written down here."""

from __future__ import annotations

from typing import Any

import pytest

from trilane.scheduler.assignment import earliest_completion_ns
from trilane.scheduler.core import Core
from trilane.scheduler.events import Dispatch, Graph, Job, JobDone, Settings, StageSpec, Start, UnitDied, UnitReady
from trilane.scheduler.state import FrameState
from trilane.scheduler.virtual import simulate
from trilane.transport.slots import EdgeSlots, edge_rule
from trilane.unexpected_value import UnexpectedValue

MS = 1_000_000
STAGES = (StageSpec("pose", "cpu"), StageSpec("net", "dsp"), StageSpec("show", "gpu"))
GRAPH = Graph(STAGES, ("double", "double"), "show", ("pose", "show"))
TIMES = {"pose": 3 * MS, "net": 7 * MS, "show": 1 * MS}
#: Five frames of which 2 and 3 skip `net`. One row per job, in ms: stage, frame, ready, dispatch, begin, end.
#: Both slots behind pose are taken from 0 on. Frame 2 has one from 10 on and waits in it from 13, for frame 1 is before
#: it; the other comes free with net 1 (17), so pose 3 begins then. Frame 3 has no frame before it. Slot of pose 4: 19.
FIVE_FRAMES = [
    ("pose", 0, 0, 0, 0, 3),
    ("pose", 1, 0, 0, 3, 6),
    ("net", 0, 3, 3, 3, 10),
    ("show", 0, 10, 10, 10, 11),
    ("pose", 2, 10, 10, 10, 13),
    ("net", 1, 6, 6, 10, 17),
    ("show", 1, 17, 17, 17, 18),
    ("show", 2, 13, 17, 18, 19),
    ("pose", 3, 17, 17, 17, 20),
    ("show", 3, 20, 20, 20, 21),
    ("pose", 4, 19, 19, 20, 23),
    ("net", 4, 23, 23, 23, 30),
    ("show", 4, 30, 30, 30, 31),
]
#: Slots in and out, and whether the job is fresh; the two slots behind pose count on after the two before show.
SLOTS = {
    ("pose", 0): (-1, 0, True),
    ("pose", 1): (-1, 1, False),
    ("pose", 2): (-1, 0, False),
    ("pose", 3): (-1, 1, False),
    ("pose", 4): (-1, 0, False),
    ("show", 0): (0, -1, False),
    ("show", 1): (1, -1, False),
    ("show", 2): (2, -1, False),
    ("show", 3): (3, -1, False),
}


def five_frames() -> Any:
    return simulate(
        GRAPH, Settings(5), lambda stage, *_: TIMES[stage], skips=lambda frame, _fresh: frame in (2, 3), keep=True
    )


def test_every_job_is_where_it_was_worked_out() -> None:
    run = five_frames()
    rows = [
        (job.stage, job.frame, *(ns // MS for ns in (job.ready_ns, job.dispatch_ns, job.begin_ns, job.end_ns)))
        for job in run.jobs
    ]
    assert sorted(rows) == sorted(FIVE_FRAMES)
    jobs = [action.job for _, _, actions in run.recording.steps for action in actions if isinstance(action, Dispatch)]
    found = {(job.stage, job.frame): (job.slot_in, job.slot_out, job.fresh) for job in jobs}
    assert {key: found[key] for key in SLOTS} == SLOTS


def test_the_report_is_the_one_worked_out() -> None:
    """Presented at 11, 18, 19, 21, 31; poses at 0, 3, 10, 17, 20."""
    report = five_frames().report
    assert report["frames"] == {
        "requested": 5, "presented": 5, "lost": 0, "lost_by_cause": {}, "dropped": {}, "not_begun": 0,
        "skipped": 2,
    }  # fmt: skip
    assert (report["duration_s"], report["frame_time_ms"]["mean"], report["frame_time_ms"]["max"]) == (0.031, 5, 10)
    assert (report["latency_ms"]["mean"], report["latency_ms"]["max"]) == (10, 15)  # 11 15 9 4 11
    stages = report["stages"]
    assert [stages[name]["jobs"] for name in TIMES] == [5, 3, 5]
    assert [stages[name]["wait_ms"]["mean"] for name in TIMES] == pytest.approx([4 / 5, 4 / 3, 5 / 5], abs=1e-6)
    assert [stages[name]["wait_ms"]["max"] for name in TIMES] == [3, 4, 5]
    idle = {
        "cpu": {"busy": 15, "starved": 8, "blocked": 8},  # no slot 6-10 and 13-17, no frame 23-31
        "dsp": {"busy": 21, "starved": 10, "blocked": 0},  # 0-3, 17-23, 30-31
        "gpu": {"busy": 5, "starved": 26, "blocked": 0},  # that frame 2 waits from 13 to 17 is no input yet
    }
    for unit, expected in idle.items():
        row = {"busy": report["units"][unit]["busy"], **report["units"][unit]["idle"]}
        assert {cause: round(row[cause] * 31, 9) for cause in expected} == expected
        assert row["throttled"] == row["preempted"] == 0
        assert row["overhead"] == pytest.approx(0)


def test_what_is_lost_before_the_end_makes_the_next_frame_fresh() -> None:
    """Frame 1 skips and waits for 0, which dies with the DSP; then 1 dies with the GPU, whose picture is gone."""
    core = Core(GRAPH, Settings(9))
    for unit in ("cpu", "dsp"):
        assert core.step(0, (UnitReady(unit),)).actions == ()
    assert core.step(0, (UnitReady("gpu"),)).actions == (
        Dispatch(Job(0, "cpu", "pose", 0, -1, 0, 0, True)),
        Dispatch(Job(1, "cpu", "pose", 1, -1, 1, 0, False)),
    )
    assert core.step(10, (JobDone("cpu", 0, 0, 9, 0),)).actions == (Dispatch(Job(2, "dsp", "net", 0, 0, 0, 0)),)
    assert core.step(20, (JobDone("cpu", 1, 10, 19, 10, skips=True),)).actions == ()
    assert set(core.step(30, (UnitDied("dsp"),)).actions) == {
        Start("dsp"),
        Dispatch(Job(3, "cpu", "pose", 2, -1, 0, 1, True)),
        Dispatch(Job(4, "gpu", "show", 1, 3, -1, 1)),
    }
    assert core.ledger.lost_by_cause == {"died:dsp": 1}
    # both slots behind pose are free or written by it; the second restart in a row of no unit is due
    assert set(core.step(40, (UnitDied("gpu"),)).actions) == {
        Start("gpu"),
        Dispatch(Job(5, "cpu", "pose", 3, -1, 1, 2, True)),
    }
    assert core.ledger.lost_by_cause == {"died:dsp": 1, "died:gpu": 1}
    core.step(50, (UnitReady("gpu"),))
    skipped = core.step(60, (JobDone("cpu", 3, 31, 59, 31, skips=True),))
    assert skipped.actions == (Dispatch(Job(6, "gpu", "show", 2, 2, -1, 2)),)
    done = core.step(70, (JobDone("gpu", 6, 61, 69, 0),))
    assert done.actions == (Dispatch(Job(7, "cpu", "pose", 4, -1, 0, 2, False)),)
    assert core.ledger.skipped == 1


def test_the_bound_on_a_frame_that_will_skip_is_that_of_its_own_way() -> None:
    """Frame 0 is at net, 1 and 2 at pose. 2 skips after pose 1 and 2 (6), and waits for net 0 (7): show ends at 8.

    If none skips, net does 0 and 1 (14), then 2 (21), show ends at 22. Frame 0 itself: 7 + 1.
    """
    core = Core(GRAPH, Settings(9))
    for stage in core.stages:
        stage.estimate_ns = TIMES[stage.name]
    for number, position in enumerate((1, 0, 0)):
        core.frames[number] = FrameState(0, 0, todo=0b111 >> position << position)
        core.frames[number].position = position
    assert earliest_completion_ns(0, 2, core.stages, core.frames, 0b111, core.bypass) == 8 * MS
    assert earliest_completion_ns(0, 2, core.stages, core.frames, 0b111) == 22 * MS
    assert earliest_completion_ns(0, 0, core.stages, core.frames, 0b110, core.bypass) == 8 * MS


def test_frames_at_and_before_the_stage_at_which_a_bypass_begins_are_taken_to_skip() -> None:
    """read 5, pose 3, net 20, show 1; the bypass begins at pose. Frame 0 is at net, 1 at pose, 2 at read.

    1 and 2 skip: net does 0 alone (20), and 2 can be shown at 21 at the earliest. Without a bypass net does 0 and 1
    (40), then 2 (60), shown at 61.
    """
    times = {"read": 5 * MS, "pose": 3 * MS, "net": 20 * MS, "show": MS}
    stages = tuple(StageSpec(name, unit) for name, unit in zip(times, ("io", "cpu", "dsp", "gpu"), strict=True))
    core = Core(Graph(stages, ("double",) * 3, "show", ("pose", "show")), Settings(9))
    for stage in core.stages:
        stage.estimate_ns = times[stage.name]
    for number, position in enumerate((2, 1, 0)):
        core.frames[number] = FrameState(0, 0, todo=0b1111 >> position << position)
        core.frames[number].position = position
    assert earliest_completion_ns(0, 2, core.stages, core.frames, 0b1111, core.bypass) == 21 * MS
    assert earliest_completion_ns(0, 2, core.stages, core.frames, 0b1111) == 61 * MS
    assert earliest_completion_ns(0, 1, core.stages, core.frames, 0b1110, core.bypass) == 21 * MS


def test_a_frame_that_skips_where_no_bypass_begins_is_a_drivers_defect() -> None:
    core = Core(Graph(STAGES, ("double", "double"), "show"), Settings(1))
    core.step(0, tuple(UnitReady(unit) for unit in ("cpu", "dsp", "gpu")))
    with pytest.raises(ValueError, match="stage pose skips, but no bypass begins there"):
        core.step(5, (JobDone("cpu", 0, 0, 5, 0, skips=True),))


@pytest.mark.parametrize("bypass", [("pose", "net"), ("show", "pose"), ("pose", "none"), ("pose", "pose")])
def test_a_bypass_skips_a_stage_at_least(bypass: tuple[str, str]) -> None:
    with pytest.raises(UnexpectedValue, match="bypass"):
        Graph(STAGES, ("double", "double"), "show", bypass)
    with pytest.raises(UnexpectedValue, match="latency to 'net', which bypass"):
        Graph(STAGES, ("double", "double"), "net", ("pose", "show"))


def test_slots_of_frames_that_skip_wait_apart() -> None:
    """Four of a pool: two skip, one waits for the consumer, one is read. The oldest that skips is evicted first."""
    edge = EdgeSlots(edge_rule("orphan:4"), lines=2)
    for frame, line in ((0, 0), (1, 0), (2, 1), (3, 1)):
        slot, _ = edge.claim(frame)
        edge.commit(slot, (line,))
    edge.take(0)
    assert (list(edge.ready), list(edge.lines[1])) == ([1], [2, 3])
    assert edge.claim(4) == (2, 2)
    edge.take(3, 1)
    assert edge.claim(5) == (1, 1)
    assert not edge.can_claim()
    edge.give_back(3, 1)
    assert list(edge.lines[1]) == [3] and edge.can_claim()


def test_a_mailbox_keeps_the_newest_of_each_line() -> None:
    edge = EdgeSlots(edge_rule("triple"), lines=2)
    replaced = []
    for frame, line in ((0, 0), (1, 1), (2, 1), (3, 0)):
        slot, evicted = edge.claim(frame)
        assert evicted is None
        replaced.append(edge.commit(slot, (line,)))
    assert replaced == [[], [], [1], [0]]
