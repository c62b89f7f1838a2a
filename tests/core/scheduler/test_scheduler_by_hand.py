"""Runs worked out on paper: every job, wait, latency, idle share, deadline, epoch and action is written down here."""

from __future__ import annotations

from typing import Any

import pytest

from trilane.scheduler.core import Core
from trilane.scheduler.events import (
    NEVER,
    Action,
    Dispatch,
    Event,
    Finish,
    FrameRequest,
    Graph,
    Job,
    JobDone,
    JobFailed,
    Kill,
    Outcome,
    OutcomeKind,
    Pinged,
    Pong,
    SchedulerStalled,
    SetDuty,
    Settings,
    StageSpec,
    Start,
    Stop,
    UnitDied,
    UnitReady,
    chain,
)
from trilane.scheduler.ledger import Ledger
from trilane.scheduler.policy import Candidate, earliest_deadline, furthest_stage, oldest_frame
from trilane.scheduler.state import READY, STOPPING
from trilane.scheduler.virtual import VirtualDriver, simulate

MS = 1_000_000
TWO = chain([("draw", "gpu"), ("show", "cpu")], "double", "show")
#: Five frames through TWO: draw takes 3 ms, show 5 ms, a message 1 ms each way. One row per job, in ms:
#: stage, frame, ready, dispatch, begin, end. Its end is known 1 ms after it. The edge's two slots let draw 1 be handed
#: over with draw 0; draw 2 waits until show 0 has given its slot back (12); draw 4 until show 2 has (24).
FIVE_FRAMES = [
    ("draw", 0, 0, 0, 1, 4),
    ("draw", 1, 0, 0, 4, 7),
    ("show", 0, 4, 5, 6, 11),
    ("show", 1, 7, 8, 11, 16),
    ("draw", 2, 12, 12, 13, 16),
    ("draw", 3, 17, 17, 18, 21),
    ("show", 2, 16, 17, 18, 23),
    ("show", 3, 21, 22, 23, 28),
    ("draw", 4, 24, 24, 25, 28),
    ("show", 4, 28, 29, 30, 35),
]
#: What the units did from 0 to 36 ms. gpu: jobs 0-8, 12-22, 24-29; no slot 8-12, 22-24; no frame left 29-36.
#: cpu: no input 0-5; jobs 5-36.
GPU = {"busy": 15, "starved": 7, "blocked": 6, "throttled": 0, "overhead": 8}
CPU = {"busy": 25, "starved": 5, "blocked": 0, "throttled": 0, "overhead": 6}


def five_frames(**more: Any) -> Any:
    times = {"draw": 3 * MS, "show": 5 * MS}
    return simulate(TWO, Settings(5), lambda stage, *_: times[stage], message_delay_ns=MS, keep=True, **more)


def shares_ms(row: dict[str, Any], total_ms: int) -> dict[str, float]:
    shares = {"busy": row["busy"], **row["idle"]}
    return {cause: round(shares[cause] * total_ms, 9) for cause in GPU}


def test_every_job_of_five_frames_is_where_it_was_worked_out() -> None:
    rows = [
        (job.stage, job.frame, *(ns // MS for ns in (job.ready_ns, job.dispatch_ns, job.begin_ns, job.end_ns)))
        for job in five_frames().jobs
    ]
    assert rows == FIVE_FRAMES


def test_the_report_of_five_frames_is_the_one_worked_out() -> None:
    """Presented at 11, 16, 23, 28, 35: intervals of 5, 7, 5, 7. Poses at 1, 4, 13, 18, 25."""
    report = five_frames(target_period_ns=6 * MS).report
    times = {key: report["frame_time_ms"][key] for key in ("mean", "p50", "max", "jitter")}
    assert times == {"mean": 6, "p50": 6, "max": 7, "jitter": 2}
    assert (report["clock"], report["duration_s"]) == ("virtual", 0.036)
    assert report["fps"] == pytest.approx(1000 / 6)
    assert (report["latency_ms"]["mean"], report["latency_ms"]["max"], report["latency_ms"]["p50"]) == (10.4, 12, 10)
    assert report["deadline_misses"] == 2
    assert report["xrbench"] == {"real_time": pytest.approx(0.5), "qoe": 1, "energy": None}
    assert report["frames"] == {
        "requested": 5, "presented": 5, "lost": 0, "lost_by_cause": {}, "dropped": {}, "not_begun": 0,
    }  # fmt: skip
    stages = report["stages"]
    assert [stages[name]["unit"] for name in ("draw", "show")] == ["gpu", "cpu"]
    assert [stages[name]["service_ms"]["mean"] for name in ("draw", "show")] == [3, 5]
    assert [stages[name]["wait_ms"]["mean"] for name in ("draw", "show")] == [1.6, 2.4]  # 1 4 1 1 1, 2 4 2 2 2
    assert shares_ms(report["units"]["gpu"], 36) == GPU
    assert shares_ms(report["units"]["cpu"], 36) == CPU
    assert [(report["units"][unit]["jobs"], report["units"][unit]["restarts"]) for unit in ("gpu", "cpu")] == [
        (5, 0)
    ] * 2


def test_a_run_without_frames_divides_by_nothing() -> None:
    report = Ledger(TWO).report(clock="virtual", requested=0, not_begun=0)
    assert (report["fps"], report["xrbench"]["qoe"]) == (0, 0)
    assert report["xrbench"]["real_time"] is None
    assert shares_ms(report["units"]["gpu"], 1) == dict.fromkeys(GPU, 0)


def test_a_frame_has_until_its_deadline_and_not_longer() -> None:
    """Frames at 0, 10, 20 take 8 ms each; the deadline is 8 ms after the release: met to the instant, three times."""
    graph = chain([("draw", "gpu")], "double", "draw")
    for deadline_ms, misses in ((8, 0), (7, 3)):
        settings = Settings(3, period_ns=10 * MS, deadline_ns=deadline_ms * MS)
        report = simulate(graph, settings, lambda *_: 8 * MS).report
        assert report["deadline_misses"] == misses
        assert shares_ms(report["units"]["gpu"], 28) == {**dict.fromkeys(GPU, 0), "busy": 24, "starved": 4}


def test_overlapping_jobs_count_once_and_jobs_in_jobs_not_at_all() -> None:
    """0-10 and 5-15 are 15 ns; 11-12 lies within."""
    ledger = Ledger(TWO)
    for begin_ns, end_ns in ((0, 10), (5, 15), (11, 12), (20, 21)):
        ledger.job(Job(0, "gpu", "draw", 0, -1, 0, 0), 0, begin_ns, end_ns)
    assert ledger.busy_ns == {"gpu": 16, "cpu": 0}


A, B = (("a", "cpu"), ("b", "dsp"))
RESTART = 175 + 100_000_000  # the second death in a row waits for 0.1 s


def job(number: int, stage: str, frame: int, slot_in: int, slot_out: int, epoch: int) -> Dispatch:
    return Dispatch(Job(number, dict((A, B))[stage], stage, frame, slot_in, slot_out, epoch))


#: A run of a -> b over a double edge, with the longest job 100 ns and the longest start 50 ns, in which the CPU hangs,
#: the DSP hangs, starts too slowly and starts again, and a stage fails. Rows: time, events, actions, next look.
LIFE: list[tuple[int, tuple[Event, ...], tuple[Action, ...], int]] = [
    (0, (UnitReady("cpu"),), (), NEVER),
    (0, (UnitReady("dsp"),), (job(0, "a", 0, -1, 0, 0), job(1, "a", 1, -1, 1, 0)), 100),
    (10, (JobDone("cpu", 0, 0, 9, 0),), (job(2, "b", 0, 0, -1, 0),), 100),
    (100, (), (), 110),  # the alarm was found too early: both jobs began at 10
    (109, (), (), 110),
    (110, (), (Kill("cpu"), Kill("dsp")), NEVER),
    (115, (UnitDied("cpu"),), (Start("cpu"),), 165),
    (120, (JobDone("dsp", 2, 11, 119, 0),), (), 165),  # it was being killed, and still ended its job
    (121, (UnitDied("dsp"),), (Start("dsp"),), 165),
    (130, (UnitReady("cpu"),), (job(3, "a", 2, -1, 0, 2), job(4, "a", 3, -1, 1, 2)), 171),
    (171, (), (Kill("dsp"),), 230),
    (175, (UnitDied("dsp"),), (), 230),
    (180, (JobDone("cpu", 3, 131, 179, 131),), (), 230),
    (230, (), (), 280),
    (240, (JobFailed("cpu", 4),), (), 280),
    (250, (Pinged("cpu"),), (), 280),
    (280, (), (), 350),
    (300, (Pong("cpu"),), (), 350),
    (350, (), (), RESTART),
    (RESTART - 1, (), (), RESTART),
    (RESTART, (), (Start("dsp"),), RESTART + 50),
    (RESTART + 10, (UnitReady("dsp"),), (job(5, "b", 2, 0, -1, 3),), RESTART + 110),
    (RESTART + 15, (JobDone("dsp", 5, RESTART + 11, RESTART + 14, 0),), (Finish(Outcome(OutcomeKind.STOPPED)),), NEVER),
]


def test_hung_slow_and_failed_units_are_killed_started_and_given_jobs_as_worked_out() -> None:
    """Frame 0 is presented, 1 hangs with the CPU, 2 waits for the DSP, 3 fails; then the run stops.

    CPU: a job until 110; killed, down and starting until 130; jobs until 240; then nothing more to begin.
    DSP: no input until 10; its job until 120; down but for the end, where it has frame 2.
    """
    core = Core(chain([A, B], "double", "b"), Settings(10, hang_ns=100, start_ns=50, max_failures=2))
    for now_ns, events, actions, next_ns in LIFE:
        assert core.step(now_ns, events) == (actions, next_ns), now_ns
    report = core.report(clock="virtual")
    assert core.ledger.presented_frames == [0, 2]
    assert core.ledger.lost_by_cause == {"failed:a": 1, "hung:cpu": 1}
    assert [core.ledger.latency_ns, core.ledger.lateness_ns] == [[119, RESTART + 14 - 131], []]
    assert [report["units"][unit]["restarts"] for unit in ("cpu", "dsp")] == [1, 2]
    total = RESTART + 15
    cpu, dsp = (shares_ms(report["units"][unit], total) for unit in ("cpu", "dsp"))
    assert cpu == pytest.approx({"busy": 57, "starved": total - 240, "blocked": 0, "throttled": 0, "overhead": 183})
    assert dsp == pytest.approx({"busy": 111, "starved": 10, "blocked": 0, "throttled": 0, "overhead": total - 121})


@pytest.mark.parametrize("failing", ["b", "c"])
def test_the_slots_of_a_job_that_failed_serve_the_frames_behind_it(failing: str) -> None:
    """The edge from b to c has one slot: frame 1, which is under way, needs the one that frame 0 held."""
    stages = tuple(StageSpec(name, unit) for name, unit in (("a", "cpu"), ("b", "gpu"), ("c", "dsp")))
    core = Core(Graph(stages, ("double", "single"), "c"), Settings(9))
    actions = list(core.step(0, tuple(UnitReady(unit) for unit in core.units)).actions)
    for now_ns in range(10, 100, 10):
        if not isinstance(actions[0], Dispatch):
            break
        job = actions.pop(0).job  # type: ignore[union-attr]
        failed = (job.stage, job.frame) == (failing, 0)
        event = JobFailed(job.unit, job.id) if failed else JobDone(job.unit, job.id, now_ns - 10, now_ns, now_ns - 10)
        actions += core.step(now_ns, (event,)).actions
    assert actions == [Finish(Outcome(OutcomeKind.STOPPED))]
    assert core.ledger.lost_by_cause == {f"failed:{failing}": 1}
    assert core.ledger.presented_frames == ([1] if failing == "b" else [1, 2])


def test_a_unit_that_fails_too_often_ends_the_run_and_its_frames() -> None:
    """The DSP works on frame 0 and holds none; frames 1 and 2 are on the CPU."""
    core = Core(chain([A, B], "fifo:3", "b"), Settings(10, max_failures=0))
    core.step(0, (UnitReady("cpu"), UnitReady("dsp")))
    core.step(10, (JobDone("cpu", 0, 0, 9, 0),))
    outcome = Outcome(OutcomeKind.GAVE_UP, "dsp")
    assert core.step(20, (UnitDied("dsp"),)) == ((Finish(outcome),), NEVER)
    assert core.ledger.lost_by_cause == {"died:dsp": 1, "gave_up:dsp": 2}
    assert (core.outcome, str(core.outcome), core.ledger.end_ns) == (outcome, "gave_up:dsp", 20)


def test_of_the_frames_that_were_released_meanwhile_the_newest_is_taken() -> None:
    """A frame every millisecond; when frame 0 is done, at 8 ms, 1 to 7 are stale and 8 is taken."""
    core = Core(chain([("b", "dsp")], "double", "b"), Settings(9, "latest", period_ns=MS))
    (first,) = core.step(0, (UnitReady("dsp"),)).actions
    (second,) = core.step(8 * MS, (JobDone("dsp", first.job.id, 0, 8 * MS, 0),)).actions
    assert [first.job.frame, second.job.frame] == [0, 8]
    assert core.ledger.dropped_by_cause == {"source->b:stale": 7}


def test_a_next_job_is_handed_over_a_lead_before_the_end_that_is_expected() -> None:
    """Jobs take 8 ms, the lead is 1 ms: 7 ms after the begin; 2 ms in which the scheduler stood still put that off."""
    core = Core(chain([("b", "dsp")], "double", "b"), Settings(100, "latest", asked=True, hang_ns=100 * MS))
    core.step(0, (UnitReady("dsp"),))
    assert core.step(0, (FrameRequest(1),)).next_deadline_ns == 100 * MS
    assert core.step(8 * MS, (JobDone("dsp", 0, 0, 8 * MS, 0),)).actions == ()
    assert core.step(10 * MS, (FrameRequest(2),)).next_deadline_ns == 17 * MS
    assert core.ledger.dropped_by_cause == {"source->b:stale": 1}
    core.step(11 * MS, (FrameRequest(1),))
    assert core.step(12 * MS, (SchedulerStalled(2 * MS),)).next_deadline_ns == 19 * MS
    assert core.step(19 * MS - 1).actions == ()
    assert [action.job.frame for action in core.step(19 * MS).actions] == [3]


@pytest.mark.parametrize(("permille", "duty"), [(-5, 1), (0, 1), (1, 1), (999, 999), (1000, 1000), (5000, 1000)])
def test_a_duty_is_between_a_thousandth_and_all_of_the_time(permille: int, duty: int) -> None:
    core = Core(TWO, Settings(1))
    core.step(0, (SetDuty("gpu", permille),))
    assert core.units["gpu"].duty == duty


CANDIDATES = [Candidate(4, 1, 50), Candidate(3, 2, 50), Candidate(2, 0, 60), Candidate(5, 3, 40), Candidate(6, 4, 70)]


@pytest.mark.parametrize(
    ("choose", "frame"), [(oldest_frame, 2), (furthest_stage, 6), (earliest_deadline, 5)], ids=lambda x: str(x)[:22]
)
def test_a_policy_takes_the_candidate_that_it_says(choose: Any, frame: int) -> None:
    assert choose(CANDIDATES).frame == frame
    assert earliest_deadline(CANDIDATES[:3]).frame == 3  # the older of two with one deadline


def test_a_run_of_which_nothing_can_come_says_so() -> None:
    driver = VirtualDriver(TWO, Settings(2, asked=True), lambda *_: 1)
    with pytest.raises(RuntimeError, match="the simulation stands still: no event and no deadline is left"):
        driver.run()


def test_a_stop_ends_the_frames_in_flight_and_releases_no_other() -> None:
    """Frames every 10 ms, jobs of 8 ms; stopped at 15, when frame 1 is drawn: it is shown at 18, and that is all."""
    graph = chain([("draw", "gpu")], "double", "draw")
    result = simulate(graph, Settings(9, period_ns=10 * MS), lambda *_: 8 * MS, inputs=[(15 * MS, Stop())])
    assert (result.outcome, result.report["duration_s"]) == (Outcome(OutcomeKind.STOPPED), 0.018)
    assert result.report["frames"]["presented"] == 2


def test_a_graph_knows_its_units_in_order_and_its_edges_by_name() -> None:
    graph = Graph((StageSpec("a", "x"), StageSpec("b", "y"), StageSpec("c", "x")), ("single", "fifo:3"), "b")
    assert (graph.units, [graph.edge_name(0), graph.edge_name(1)]) == (("x", "y"), ["a->b", "b->c"])
    assert chain([A, B], "triple", "a") == Graph((StageSpec(*A), StageSpec(*B)), ("triple",), "a")
    for stages in ((), (StageSpec("a", "x"), StageSpec("a", "y"))):
        with pytest.raises(ValueError, match=r"found stages \[.*\], expected different names"):
            Graph(stages, ("single",) * (len(stages) - 1), "a")
    with pytest.raises(ValueError, match=r"found 1 edges and latency to 'b' for .*expected 0 edges, and latency"):
        Graph((StageSpec("b", "x"),), ("single",), "b")


def test_a_job_that_is_handed_over_to_units_at_rest_is_watched_from_then_on() -> None:
    core = Core(TWO, Settings(9, asked=True, hang_ns=100))
    assert core.step(3, (UnitReady("gpu"), UnitReady("cpu"))) == ((), NEVER)
    assert core.step(5, (FrameRequest(1),)).next_deadline_ns == 105
    assert core.step(15, (JobDone("gpu", 0, 6, 14, 6),)).next_deadline_ns == 105
    assert core.step(20, (JobDone("cpu", 1, 16, 19, 0),)).next_deadline_ns == 105
    assert core.step(105) == ((), NEVER)
    assert core.step(200, (Pinged("cpu"),)).next_deadline_ns == 300


def test_a_simulated_unit_that_hangs_is_killed_and_back_after_its_restart() -> None:
    """Jobs of 4 ms, but frame 1 never ends: handed over at 0, begun at 4, killed at 14, up again at 34.

    Frame 2, which the unit only held, is lost with it, for it was in no slot yet; then frames 3 and 4 take 8 ms.
    """
    graph = chain([("draw", "gpu")], "double", "draw")
    result = simulate(
        graph,
        Settings(5, hang_ns=10 * MS),
        lambda _stage, _unit, frame, _begin: 10**15 if frame == 1 else 4 * MS,
        restart_ns=20 * MS,
        keep=True,
    )
    assert [(job.frame, job.begin_ns, job.end_ns) for job in result.jobs] == [
        (0, 0, 4 * MS),
        (3, 34 * MS, 38 * MS),
        (4, 38 * MS, 42 * MS),
    ]
    assert result.report["frames"]["lost_by_cause"] == {"hung:gpu": 2}
    assert (result.report["duration_s"], result.report["units"]["gpu"]["restarts"]) == (0.042, 1)
    assert shares_ms(result.report["units"]["gpu"], 42) == {**dict.fromkeys(GPU, 0), "busy": 12, "overhead": 30}


def test_a_unit_that_is_being_killed_has_room_for_no_job_and_is_asked_nothing() -> None:
    core = Core(TWO, Settings(9, asked=True, hang_ns=100))
    core.step(0, (UnitReady("gpu"), UnitReady("cpu")))
    gpu = core.units["gpu"]
    assert (gpu.life, gpu.awaits_nothing, gpu.queue_capacity) == (READY, True, 2)
    core.step(1, (Pinged("gpu"),))
    assert (gpu.life, gpu.awaits_nothing) == (READY, False)
    assert core.step(101, (FrameRequest(0),)).actions == (Kill("gpu"),)
    assert (gpu.life, gpu.awaits_nothing, gpu.queue_capacity) == (STOPPING, False, 0)
    assert core.step(102, (FrameRequest(1),)).actions == ()
