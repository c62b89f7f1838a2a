"""Graphs worked out on paper: periods, latencies, jobs, drops and losses are written down here. Times are in ms.

Periods and latencies of chains, joins and detectors, and closed forms of queues: hw_profiles/test_pipeline_prediction.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from trilane.scheduler.core import Core
from trilane.scheduler.events import (
    Dispatch,
    Graph,
    Input,
    JobDone,
    Settings,
    StageSpec,
    UnitReady,
    chain,
    unpacked,
)
from trilane.scheduler.virtual import Simulation, simulate
from trilane.unexpected_value import UnexpectedValue

MS = 1_000_000
DRIVER = ("message_delay_ns", "restart_ns", "faults", "inputs")
CHAIN_MS = {"a": 2, "b": 3, "c": 5, "d": 4, "e": 1}


def stage(name: str, unit: str, *inputs: str | Input, every: int = 1) -> StageSpec:
    return StageSpec(name, unit, tuple(Input(i) if isinstance(i, str) else i for i in inputs), every)


def graph(*stages: StageSpec, rule: str = "double", **rules: str) -> Graph:
    """`rule` for every stream but those in `rules`; the latency ends at the last stage."""
    read = {each.stage for reader in stages for each in reader.inputs or ()}
    edges = tuple(rules.get(s.name, rule) for s in stages if s.name in read)
    return Graph(stages, edges, stages[-1].name)


def run(described: Graph, times_ms: Mapping[str, float], frames: int = 60, **options: Any) -> Simulation:
    """`options`: of the driver; the others are settings."""
    driver = {key: value for key, value in options.items() if key in DRIVER}
    given = {key: value for key, value in options.items() if key not in DRIVER}
    return simulate(
        described, Settings(frames, **given), lambda name, *_: round(times_ms[name] * MS), keep=True, **driver
    )


def ends(done: Simulation, name: str) -> dict[int, float]:
    """End of each frame at the stage."""
    return {job.frame: job.end_ns / MS for job in done.jobs if job.stage == name}


def begins(done: Simulation, name: str) -> dict[int, float]:
    return {job.frame: job.begin_ns / MS for job in done.jobs if job.stage == name}


def period(done: Simulation, name: str, over: int = 1) -> float:
    """The time between two ends at the stage, once it is the same for ever; of `over` frames together."""
    at = list(ends(done, name).values())
    steps = {round(later - earlier, 9) for earlier, later in zip(at[20:], at[20 + over :], strict=False)}
    assert len(steps) == 1
    return steps.pop() / over


def test_a_chain_with_its_inputs_written_down_takes_the_steps_of_the_chain() -> None:
    names = list(CHAIN_MS)
    done = run(
        graph(*(stage(name, name, *names[max(place - 1, 0) : place]) for place, name in enumerate(names))), CHAIN_MS
    )
    same = simulate(
        chain([(name, name) for name in CHAIN_MS], "double", "e"),
        Settings(60),
        lambda name, *_: CHAIN_MS[name] * MS,
        keep=True,
    )
    assert done.recording is not None
    assert same.recording is not None
    assert done.recording.steps == same.recording.steps
    assert done.report == same.report


# A fork and a join

DEPTH = [
    stage("frame", "isp"),
    stage("depth", "dsp", "frame"),
    stage("seg", "gpu", "frame"),
    stage("composite", "cpu", "depth", "seg"),
]
DEPTH_MS = {"frame": 2, "depth": 14, "seg": 10, "composite": 3}


def test_a_unit_that_has_some_inputs_of_a_frame_idles_for_the_join() -> None:
    """Five frames, one in 20 ms: seg ends at 12, depth at 16, composite at 19."""
    row = run(graph(*DEPTH), DEPTH_MS, frames=5, period_ns=20 * MS).report["units"]["cpu"]
    total = 4 * 20 + 19
    shares = {cause: round(share * total, 9) for cause, share in row["idle"].items()}
    assert (row["busy"] * total, shares["join"]) == pytest.approx((5 * 3, 5 * 4))
    assert shares["starved"] == total - 5 * 7


def test_branches_of_one_unit_take_turns_by_frame() -> None:
    """The DSP has 3 + 4 ms a frame, and the first join ends at 2 + 3 + 4 + 1."""
    shared = graph(stage("src", "cpu"), stage("a", "dsp", "src"), stage("b", "dsp", "src"), stage("j", "cpu", "a", "b"))
    done = run(shared, {"src": 2, "a": 3, "b": 4, "j": 1})
    assert list(ends(done, "j").values()) == [10 + 7 * frame for frame in range(60)]


@pytest.mark.parametrize(("rule", "expected"), [("single", 15), ("double", 7.5), ("fifo:3", 6)])
def test_a_stream_that_skips_stages_needs_their_slots(rule: str, expected: float) -> None:
    """a -> b -> c -> d, and a -> d: a's slots are held for 3 + 4 + 6 + 2 ms; c takes 6."""
    skip = [stage("a", "a"), stage("b", "b", "a"), stage("c", "c", "b"), stage("d", "d", "c", "a")]
    done = run(graph(*skip, a=rule), {"a": 3, "b": 4, "c": 6, "d": 2})
    assert period(done, "d", over=2) == expected


# Several sources, and stages that take some frames


def test_the_latency_of_two_sources_begins_with_the_first_of_them() -> None:
    """b takes 0-5, 5-10, 10-15; a 0-3, 3-6, and 9-12 when c gave its slot back. c ends at 9, 14, 19."""
    two = graph(stage("a", "a"), stage("b", "b"), stage("c", "c", "a", "b"))
    done = run(two, {"a": 3, "b": 5, "c": 4}, frames=3)
    assert begins(done, "a") == {0: 0, 1: 3, 2: 9}
    assert begins(done, "b") == {0: 0, 1: 5, 2: 10}
    assert ends(done, "c") == {0: 9, 1: 14, 2: 19}
    assert done.report["latency_ms"]["mean"] == (9 + 11 + 10) / 3
    paced = run(two, {"a": 3, "b": 5, "c": 4}, period_ns=10 * MS).report
    assert (paced["latency_ms"]["mean"], paced["latency_ms"]["max"]) == (9, 9)


def test_a_join_takes_the_frames_that_all_its_inputs_have() -> None:
    """Of every second and every third frame it takes every sixth; nobody waits for the others."""
    sixth = graph(
        stage("cam", "a"),
        stage("slow", "b", "cam", every=2),
        stage("fast", "c", "cam", every=3),
        stage("join", "d", "slow", "fast"),
    )
    done = run(sixth, {"cam": 1, "slow": 5, "fast": 2, "join": 3}, frames=13, period_ns=4 * MS)
    assert ends(done, "join") == {frame: 4 * frame + 1 + 5 + 3 for frame in (0, 6, 12)}
    assert list(ends(done, "slow")) == [0, 2, 4, 6, 8, 10, 12]
    assert list(ends(done, "fast")) == [0, 3, 6, 9, 12]
    assert done.report["frames"]["dropped"] == {"join:every": 10}
    assert done.report["latency_ms"]["mean"] == 9


# The newest frame

BOXES = Input("det", latest=True)


def boxes(max_age_ms: int = 0) -> Graph:
    """cam -> det on every second frame; trk takes cam's frame and det's newest."""
    newest = Input("det", latest=True, max_age_ns=max_age_ms * MS)
    return graph(stage("cam", "a"), stage("det", "b", "cam", every=2), stage("trk", "c", "cam", newest), cam="fifo:3")


BOXES_MS = {"cam": 1, "det": 12, "trk": 2}


def newest(done: Simulation) -> dict[int, bool]:
    """For each frame of trk whether it got boxes."""
    assert done.recording is not None
    jobs = [a.job for step in done.recording.steps for a in step[2] if isinstance(a, Dispatch) and a.job.stage == "trk"]
    return {job.frame: unpacked(job.slot_in, 2)[1] >= 0 for job in jobs}


@pytest.mark.parametrize(
    ("max_age_ms", "with_boxes"),
    [(0, [2, 3, 4, 5]), (31, [2, 3, 4, 5]), (30, [2, 4]), (21, [2, 4]), (20, [])],
)
def test_the_newest_boxes_age_until_they_are_too_old(max_age_ms: int, with_boxes: list[int]) -> None:
    """One frame in 10 ms: det 0 ends at 13, det 2 at 33. trk begins at 1, 11, 21…: boxes of 21, 31, 21, 31 ms."""
    done = run(boxes(max_age_ms), BOXES_MS, frames=6, period_ns=10 * MS)
    assert [frame for frame, has in newest(done).items() if has] == with_boxes
    assert ends(done, "trk") == {frame: 10 * frame + 3 for frame in range(6)}
    assert ends(done, "det") == {0: 13, 2: 33, 4: 53}


def test_the_report_has_the_age_of_the_newest_boxes() -> None:
    ages = run(boxes(), BOXES_MS, frames=6, period_ns=10 * MS).report["streams"]["det"]
    assert ages["age_ms"]["mean"] == (21 + 31 + 21 + 31) / 4
    assert ages["age_ms"]["max"] == 31
    assert ages["frames_behind"]["mean"] == (2 + 3 + 2 + 3) / 4


def test_a_branch_of_side_work_that_dies_takes_only_a_frame_that_is_not_shown() -> None:
    """det dies at 5, when frame 0 is shown (3): nothing is lost. At 22 trk still has frame 2, and it is lost."""
    later = run(boxes(), BOXES_MS, frames=6, period_ns=10 * MS, faults=[(5 * MS, "b")], restart_ns=3 * MS)
    assert later.report["frames"]["lost_by_cause"] == {}
    assert ends(later, "det") == {2: 33, 4: 53}
    assert [frame for frame, has in newest(later).items() if has] == [4, 5]
    worse = run(boxes(), BOXES_MS, frames=6, period_ns=10 * MS, faults=[(22 * MS, "b")], restart_ns=3 * MS)
    assert worse.report["frames"]["lost_by_cause"] == {"died:b": 1}
    assert worse.report["frames"]["presented"] == 5
    assert [frame for frame, has in newest(worse).items() if has] == [2, 3, 4, 5]  # det 0 is still the newest
    assert list(ends(worse, "det")) == [0, 4]


def test_a_single_slot_cannot_hold_the_newest_and_be_written() -> None:
    with pytest.raises((UnexpectedValue, ValueError), match="det"):
        run(graph(stage("det", "b"), stage("trk", "c", BOXES), det="single"), {"det": 1, "trk": 1})


# Drops and losses

FORK = [stage("src", "s"), stage("a", "a", "src"), stage("b", "b", "src"), stage("j", "j", "a", "b")]


@pytest.mark.parametrize("rule", ["double", "fifo:3", "fifo:8"])
def test_branches_agree_on_the_frames_that_they_show(rule: str) -> None:
    """A 10, B 11, a frame in 6 ms: a frame per 11 ms, which B needs.

    Without the rule each branch drops other frames, and hardly any pair meets: 17.4 ms with three slots or more. Two
    slots are too few for a frame to be stale.
    """
    times = {"src": 0.001, "a": 10, "b": 11, "j": 0.001}
    done = run(graph(*FORK, rule=rule), times, 1000, period_ns=6 * MS, policy="latest")
    shown = list(ends(done, "j").values())
    assert 11 <= (shown[-1] - shown[0]) / (len(shown) - 1) < 11.05
    frames = done.report["frames"]
    assert frames["presented"] + sum(frames["dropped"].values()) == 1000


def test_side_work_that_joins_goes_on_with_the_frames_that_no_branch_of_it_left_out() -> None:
    """slow leaves out most frames, and so does both, which reads it; quick has done all of them, and holds none."""
    side = graph(
        stage("cam", "a"),
        stage("slow", "b", "cam"),
        stage("quick", "c", "cam"),
        stage("both", "d", "slow", "quick"),
        stage("trk", "e", "cam", Input("both", latest=True)),
        rule="fifo:8",
    )
    times = {"cam": 1, "slow": 20, "quick": 2, "both": 1, "trk": 2}
    done = run(side, times, 40, period_ns=5 * MS, policy="latest")
    assert done.report["frames"]["presented"] == 40
    assert len(ends(done, "quick")) == 40
    assert list(ends(done, "both")) == list(ends(done, "slow")) != list(range(40))


def test_a_join_is_ready_since_its_last_input_whichever_message_comes_first() -> None:
    core = Core(graph(*FORK), Settings(1))
    for unit in core.units:
        core.step(0, (UnitReady(unit),))
    core.step(3, (JobDone("s", 0, 0, 2, 0),))
    core.step(13, (JobDone("b", 2, 3, 12, 0),))
    (dispatch,) = core.step(14, (JobDone("a", 1, 3, 10, 0),)).actions
    assert isinstance(dispatch, Dispatch)
    assert (dispatch.job.stage, core.ready_ns(dispatch.job)) == ("j", 12)


def test_only_complete_frames_are_stale_at_a_join() -> None:
    """A frame in 4 ms is complete 4 ms after its release. The join has no estimate at 8 and takes frame 1 at once.

    Later it looks 1 ms before its end: at 23, 33, 43, 53 and 63, when frames 4, 7, 9, 12 and 14 are the newest.
    """
    times = {"src": 1, "a": 2, "b": 3, "j": 10}
    done = run(graph(*FORK, rule="fifo:8"), times, 16, period_ns=4 * MS, policy="latest")
    assert ends(done, "j") == {0: 14, 1: 24, 4: 34, 7: 44, 9: 54, 12: 64, 14: 74, 15: 84}
    assert sum(done.report["frames"]["dropped"].values()) == 16 - 8
    assert list(ends(done, "a")) == list(ends(done, "b")) == list(range(16))


def paced_fork(rule: str, b_ms: float, frames: int) -> Simulation:
    """A frame in 4 ms, which src has done after 1; a takes 11."""
    times = {"src": 1, "a": 11, "b": b_ms, "j": 1}
    return run(graph(*FORK, rule="fifo:8", src=rule), times, frames, period_ns=4 * MS)


def test_a_triple_stream_keeps_the_newest_for_all_its_readers() -> None:
    """The branches work on frame 0, and have 1 at 5 and 2 at 12: the third slot changes hands until 23, and until 34.

    Frame 3 is evicted at 16 and 4 at 20, so that both branches take 5 at 23; then 6 at 28, 7 at 32, and they take 8.
    """
    done = paced_fork("triple", 11, 9)
    assert ends(done, "j") == {0: 13, 1: 24, 2: 35, 5: 46, 8: 57}
    assert done.report["frames"]["dropped"] == {"src->a,b:stale": 4}


def test_a_triple_stream_keeps_a_frame_that_one_branch_has_begun() -> None:
    """b, which takes 5, has frame 3 at 13. So src waits at 16 until a gives the slot of frame 1 back at 23.

    It then makes up for 20 and 24: frames 4 and 5 are evicted when they end. b has frame 6 at 26, and src waits again.
    """
    done = paced_fork("triple", 5, 8)
    assert begins(done, "src") == {0: 0, 1: 4, 2: 8, 3: 12, 4: 23, 5: 24, 6: 25, 7: 34}
    assert begins(done, "b") == {0: 1, 1: 6, 2: 11, 3: 16, 6: 26, 7: 35}
    assert ends(done, "j") == {0: 13, 1: 24, 2: 35, 3: 46, 6: 57, 7: 68}
    assert done.report["frames"]["dropped"] == {"src->a,b:stale": 2}


def test_an_orphan_stream_gives_up_its_oldest_frame() -> None:
    """Four slots, so that two frames wait. Frame 3 goes at 20, and the branches take 4 at 23; 5 and 6, and they take 7;
    8 and 9, and they take 10.
    """
    done = paced_fork("orphan:4", 11, 12)
    assert ends(done, "j") == {0: 13, 1: 24, 2: 35, 4: 46, 7: 57, 10: 68, 11: 79}
    assert done.report["frames"]["dropped"] == {"src->a,b:pool": 5}


def test_a_source_that_is_always_ready_evicts_before_a_triple_stream_is_read() -> None:
    """src is handed its next frame when it ends one, before the branches are looked at: it has two slots of three.

    While the branches have frame 0, to 13, each frame that src ends is evicted in that instant: 1 at 4, 2 at 6 and so
    on. At 14 src takes the slot of frame 0, so that frame 6 is read. The last two frames evict nothing.
    """
    done = run(graph(*FORK, src="triple"), {"src": 2, "a": 11, "b": 5, "j": 1}, 16)
    assert begins(done, "src") == {frame: 2 * frame for frame in range(16)}
    assert ends(done, "j") == {0: 14, 6: 26, 12: 38, 14: 49, 15: 60}


def test_two_branches_that_die_lose_the_frames_that_they_work_on() -> None:
    """At 6 a works on frame 0 and b on 1. Both are up again at 9, when frame 2 is there since 7, and 3 since 8."""
    times = {"src": 1, "a": 10, "b": 4, "j": 2}
    done = run(graph(*FORK), times, 4, faults=[(6 * MS, "a"), (6 * MS, "b")], restart_ns=3 * MS)
    assert done.report["frames"]["lost_by_cause"] == {"died:a": 1, "died:b": 1}
    assert begins(done, "src") == {0: 0, 1: 1, 2: 6, 3: 7}
    assert begins(done, "b") == {0: 1, 2: 9, 3: 13}
    assert ends(done, "j") == {2: 21, 3: 31}


def test_a_frame_that_two_branches_lose_is_lost_once() -> None:
    """At 3 both work on frame 0, and both are handed frame 1, which waits again. They are up at 6."""
    times = {"src": 1, "a": 10, "b": 4, "j": 2}
    done = run(graph(*FORK), times, 3, faults=[(3 * MS, "a"), (3 * MS, "b")], restart_ns=3 * MS)
    assert done.report["frames"]["lost_by_cause"] == {"died:a": 1}
    assert ends(done, "a") == {1: 16, 2: 26}
    assert ends(done, "j") == {1: 18, 2: 28}


def test_what_a_lost_frame_wrote_is_thrown_away() -> None:
    """a dies at 3. b ends frame 0 at 5 all the same, and the join never waits for it."""
    done = run(graph(*FORK), {"src": 1, "a": 10, "b": 4, "j": 2}, 2, faults=[(3 * MS, "a")], restart_ns=3 * MS)
    assert ends(done, "b") == {0: 5, 1: 9}
    assert ends(done, "j") == {1: 18}


def test_a_source_that_dies_before_a_fork_loses_both_frames_that_it_was_handed() -> None:
    """At 3 src works on frame 1, and has frame 2."""
    times = {"src": 2, "a": 3, "b": 1, "j": 1}
    done = run(graph(*FORK, src="fifo:3"), times, 4, faults=[(3 * MS, "s")], restart_ns=3 * MS)
    assert done.report["frames"]["lost_by_cause"] == {"died:s": 2}
    assert ends(done, "j") == {0: 6, 3: 12}
