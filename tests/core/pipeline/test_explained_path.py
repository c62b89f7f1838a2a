"""What bounds the frame time: paths and budgets of runs whose critical path is known by hand."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Mapping
from itertools import chain as chain_of
from itertools import pairwise

import pytest

from trilane.pipeline.critical_path import MARGIN, TAKEN, Budget, Paths, Piece, Sharing, parts
from trilane.pipeline.journal import Record, Stepped, Stopped, Worked, journal_of
from trilane.pipeline.timeline import ExplainedJob, Timeline
from trilane.pipeline.unit_history import PREEMPTED
from trilane.scheduler.events import Graph, JobDone, SchedulerStalled, Settings, chain
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.virtual import Simulation, simulate

STAGES = [("draw", "gpu"), ("infer", "dsp"), ("show", "cpu")]
TIMES = {"draw": 20, "infer": 50, "show": 10}
GRAPH = chain(STAGES, "double", "show")


def simulated(
    settings: Settings, times: Mapping[str, int] = TIMES, graph: Graph = GRAPH, **driver: object
) -> Simulation:
    return simulate(graph, settings, lambda stage, *_: times[stage], keep=True, **driver)


Changed = Callable[[Record], Iterable[Record]]


def walked(
    run: Simulation, kept: int = 4096, changed: Changed = lambda record: [record]
) -> tuple[Paths, Budget, list[ExplainedJob]]:
    """All jobs of a run through the paths; and the jobs that presented a frame. `changed`: what a record becomes."""
    assert run.recording is not None
    records = chain_of.from_iterable(map(changed, journal_of(run.recording, run.jobs, {}, {})))
    next(records)
    timeline = Timeline(run.recording.graph, run.recording.settings, waits=True)
    paths = Paths(run.recording.graph, run.recording.settings, timeline.downs, timeline.stalls, kept)
    budget, shown = Budget(paths), []
    for one in (fact for record in records for fact in timeline.add(record) if isinstance(fact, ExplainedJob)):
        paths.add(one)
        if one.presented is not None:
            shown.append(one)
            budget.present(one)
    return paths, budget, shown


def summed(paths: Paths, shown: ExplainedJob, before: ExplainedJob) -> dict[tuple[str, str], int]:
    found: dict[tuple[str, str], int] = {}
    for piece in paths.walk(shown, before.job.end_ns):
        for part, ns in parts(piece, 0, shown.job.end_ns).items():
            found[part] = found.get(part, 0) + ns
    return found


def test_a_pipelined_run_is_bounded_by_its_slowest_stage() -> None:
    """Frames come every 50 ns; but for the first frame's way in and the last one's way out, infer is all of it."""
    _, budget, shown = walked(simulated(Settings(100)))
    found = budget.close()
    assert sum(found.values()) == shown[-1].job.end_ns - shown[0].job.end_ns == 99 * 50
    assert found == {("work", "infer"): 99 * 50 - 10, ("work", "show"): 10}


def test_a_sequential_run_is_bounded_by_every_stage() -> None:
    _, budget, _ = walked(simulated(Settings(100, "sequential")))
    assert budget.close() == {("work", "draw"): 99 * 20, ("work", "infer"): 99 * 50, ("work", "show"): 99 * 10}


def test_messages_are_overhead_before_the_stage_that_they_are_for() -> None:
    """3 ns to the scheduler and 3 back between any two stages, one frame at a time."""
    _, budget, _ = walked(simulated(Settings(50, "sequential"), message_delay_ns=3))
    found = budget.close()
    assert {part: ns for part, ns in found.items() if part[0] == "overhead"} == {
        ("overhead", name): 49 * 6 for name in TIMES
    }


def test_a_time_in_which_the_scheduler_did_not_run_is_told_from_messages() -> None:
    """It hears 3 ns late that infer of frame 20 has ended, and was stopped then; the other 48 gaps are messages."""

    def stalled(record: Record) -> list[Record]:
        heard = isinstance(record, Stepped) and [event for event in record.events if isinstance(event, JobDone)]
        if not heard or heard[0].unit != "dsp" or heard[0].job != 3 * 20 + 1:
            return [record]
        return [record._replace(events=(SchedulerStalled(3), *record.events))]

    _, budget, _ = walked(simulated(Settings(50, "sequential"), message_delay_ns=3), changed=stalled)
    found = budget.close()
    assert (found["stalled", "show"], found["overhead", "show"]) == (6, 48 * 6)
    largest = budget.largest(budget.names({"draw": "gpu", "infer": "dsp", "show": "cpu"})["unit"])
    assert largest is not None and largest["name"] == "dsp"


@pytest.mark.parametrize(
    ("since_ns", "part"),
    [
        (7, {("stopped", "infer"): 30, ("asleep", "infer"): 0, ("overhead", "infer"): 49 * 6}),
        (-1, {("stopped", "infer"): 6, ("asleep", "infer"): 30, ("overhead", "infer"): 48 * 6}),
        (-7, {("stopped", "infer"): 0, ("asleep", "infer"): 30, ("overhead", "infer"): 49 * 6}),
    ],
)
def test_a_unit_that_a_signal_stopped_neither_sleeps_nor_waits_for_messages(
    since_ns: int, part: dict[tuple[str, str], int]
) -> None:
    """infer of frame 20 slept for 30 ns, and its unit was seen stopped `since_ns` after its begin, or before."""

    def stopped(record: Record) -> list[Record]:
        if not isinstance(record, Worked) or (record.job.stage, record.job.frame) != ("infer", 20):
            return [record]
        job = record.job._replace(asleep_ns=30)
        return [Stopped(job.begin_ns + since_ns, "dsp"), record._replace(job=job)]

    _, budget, _ = walked(simulated(Settings(50, "sequential"), message_delay_ns=3), changed=stopped)
    found = budget.close()
    assert {each: found.get(each, 0) for each in part} == part


def test_a_slot_that_gets_free_late_hands_the_path_to_the_stage_behind() -> None:
    """With one slot between stages, draw of a frame begins when infer has released it: infer and draw take turns."""
    run = simulated(Settings(100), graph=chain(STAGES, "single", "show"))
    _, budget, shown = walked(run)
    found = budget.close()
    period = (shown[-1].job.end_ns - shown[49].job.end_ns) / 50
    assert period == 20 + 50
    assert found["work", "draw"] == pytest.approx(99 * 20, abs=20)
    assert found["work", "infer"] == pytest.approx(99 * 50, abs=50)


def test_a_rate_from_outside_is_told_from_work() -> None:
    """A frame every 200 ns that takes 80: the rest is before its release."""
    _, budget, _ = walked(simulated(Settings(40, "latest", period_ns=200, deadline_ns=600)))
    found = budget.close()
    assert found == {
        ("release", "draw"): 39 * 120,
        ("work", "draw"): 39 * 20,
        ("work", "infer"): 39 * 50,
        ("work", "show"): 39 * 10,
    }


def test_a_restart_is_part_of_the_path() -> None:
    run = simulated(Settings(60), faults=[(1000, "dsp")], restart_ns=7000)
    _, budget, _ = walked(run)
    found = budget.close()
    assert found["down", "infer"] == pytest.approx(7000, abs=100)


def test_a_unit_that_is_down_is_told_from_a_late_release() -> None:
    """Frames that were released while the dsp was down were dropped; the frame after them was released in time."""
    settings = Settings(60, "deadline", period_ns=200, deadline_ns=600)
    _, budget, shown = walked(simulated(settings, faults=[(1000, "dsp")], restart_ns=4000))
    found = budget.close()
    assert found["down", "infer"] == pytest.approx(4000, abs=400)
    assert sum(found.values()) == shown[-1].job.end_ns - shown[0].job.end_ns


def test_late_latching_is_held_and_no_overhead() -> None:
    """draw waits so that its frames are new; every fifth takes 100 ns more than is expected, and is waited for."""

    def service(stage: str, _unit: str, frame: int, _begin_ns: int) -> int:
        return TIMES[stage] + (100 if stage == "draw" and frame % 5 == 4 else 0)

    run = simulate(GRAPH, Settings(60, latch_ns=5), service, keep=True)
    _, budget, _ = walked(run)
    found = budget.close()
    assert found["held", "draw"] > 0
    assert ("overhead", "draw") not in found


def test_a_frame_is_bounded_by_its_own_way_since_the_frame_before() -> None:
    """infer of frame 7 takes 500 instead of 50: so do the ends of frames 6 and 7, but for show."""

    def service(stage: str, _unit: str, frame: int, _begin_ns: int) -> int:
        return 500 if (stage, frame) == ("infer", 7) else TIMES[stage]

    run = simulate(GRAPH, Settings(20), service, keep=True)
    paths, _, shown = walked(run)
    assert summed(paths, shown[7], shown[6]) == {("work", "infer"): 490, ("work", "show"): 10}
    assert summed(paths, shown[6], shown[5]) == {("work", "infer"): 40, ("work", "show"): 10}


def test_bounded_memory_finds_the_same_path() -> None:
    """Only as many jobs as lie between two looks, and their margin, are needed."""
    run = simulated(Settings(1000), message_delay_ns=2)
    _, whole, _ = walked(run)
    _, bounded, _ = walked(run, kept=3 * (2 * MARGIN + 8))
    assert whole.close() == bounded.close()


@pytest.mark.parametrize("seed", range(12))
def test_pieces_follow_each_other_without_gap_and_sum_to_the_run(seed: int) -> None:
    """Any chain, policy and edge, with units that die: the budget is the time from the first frame to the last."""
    random.seed(seed)
    units = [random.choice(("cpu", "gpu", "dsp")) for _ in range(4)]
    edge = random.choice(("single", "double", "triple", "fifo:3", "orphan"))
    policy = random.choice(("sequential", "pipelined", "latest", "deadline"))
    paced = {"period_ns": 1500, "deadline_ns": 9000} if policy in ("latest", "deadline") else {}
    run = simulate(
        chain([(f"stage {place}", unit) for place, unit in enumerate(units)], edge, "stage 3"),
        Settings(120, policy, hang_ns=10**9, **paced),
        lambda *_: random.randrange(200, 2000),
        message_delay_ns=random.randrange(50),
        restart_ns=5000,
        faults=[(random.randrange(60_000), random.choice(units)) for _ in range(2)],
        keep=True,
    )
    paths, budget, shown = walked(run)
    for before, one in pairwise(shown):
        pieces = [piece for piece in paths.walk(one, before.job.end_ns) if piece.end_ns > piece.begin_ns]
        assert [pieces[0].end_ns, pieces[-1].begin_ns] == [one.job.end_ns, before.job.end_ns]
        assert all(later.begin_ns == earlier.end_ns for later, earlier in pairwise(pieces))
        assert all(piece.what != "unknown" for piece in pieces)
    assert sum(budget.close().values()) == shown[-1].job.end_ns - shown[0].job.end_ns


def test_a_job_is_divided_by_its_share_without_a_core_and_asleep() -> None:
    """Of 100 ns the unit had no core for 30 and slept for 20; half of the job lies in the time that is asked about."""
    job = JobRecord("draw", "gpu", 0, 0, 0, 0, 100, preempted_ns=30, asleep_ns=20)
    found = parts(Piece("work", "draw", job, 0, 100), 50, 200)
    assert found == {("work", "draw"): 25, ("preempted", "draw"): 15, ("asleep", "draw"): 10}
    assert parts(Piece("work", "draw", job, 0, 100), 100, 200) == {}


CORES = {"cpu": (0,), "dsp": (0, 1), "gpu": (1,)}


def test_units_that_share_a_core_are_named_in_proportion_to_what_they_did() -> None:
    """pose of the cpu had no core for 60 of 100 ns; the dsp, which may use its core too, worked for 40 of these."""
    pose = JobRecord("pose", "cpu", 0, 0, 0, 100, 200, preempted_ns=60)
    sharing = Sharing(CORES)
    sharing.add(JobRecord("infer", "dsp", 0, 0, 0, 80, 140))
    sharing.add(JobRecord("draw", "gpu", 0, 0, 0, 100, 200))  # on another core
    sharing.add(pose)
    assert sharing.taken("cpu", 100, 200, 60) == {"infer": 40}
    assert sharing.taken("cpu", 120, 130, 10) == {"infer": 10}
    waited = Piece(PREEMPTED, "pose", pose, 100, 160)  # of 60 ns that it lacked, half are asked about: 20 of 40 ns
    assert parts(waited, 100, 130, sharing) == {(TAKEN, "infer"): 20, (PREEMPTED, "pose"): 10}
    row = sharing.close()["pose"]
    assert (row.jobs, row.service_ns, row.preempted_ns, row.of, row.other_ns) == (1, 100, 60, {"infer": 40}, 20)


def test_no_more_is_taken_than_the_job_lacked() -> None:
    """Both others ran for all of the job, the gpu unit with a core for half of it: 40 ns are divided 2 to 1."""
    infer = JobRecord("infer", "dsp", 0, 0, 0, 100, 200, preempted_ns=40)
    sharing = Sharing(CORES)
    sharing.add(JobRecord("pose", "cpu", 0, 0, 0, 0, 300))
    sharing.add(infer)
    sharing.add(JobRecord("draw", "gpu", 0, 0, 0, 100, 200, preempted_ns=50))
    taken = sharing.close()["infer"]
    assert (taken.of, taken.other_ns) == ({"pose": 26, "draw": 13}, 1)


def test_without_known_cores_nobody_is_named() -> None:
    pose = JobRecord("pose", "cpu", 0, 0, 0, 100, 200, preempted_ns=60)
    sharing = Sharing({})
    sharing.add(JobRecord("infer", "dsp", 0, 0, 0, 80, 140))
    sharing.add(pose)
    assert sharing.close()["pose"].other_ns == 60
