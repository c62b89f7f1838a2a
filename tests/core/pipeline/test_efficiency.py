"""Efficiencies of the CPU time of jobs: by hand, never above 1 of what a kernel can do, and moved as the truth is."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping, Sequence

import pytest

from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage, UnitSettings
from trilane.pipeline.job_times import lost_in_job
from trilane.pipeline.journal import Begun, records_of
from trilane.pipeline.reckoning import Reckoned, RunEfficiencies, WhatIf, places_of, reckoned
from trilane.scheduler.events import Settings, chain
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.placement import Place
from trilane.scheduler.shared_units import Member, simulate_beside
from trilane.scheduler.virtual import Simulation, simulate

ON_0, ON_1, ON_BOTH, FLOATS = Place((0,), 1), Place((1,), 1), Place((0, 1), 2), Place((0, 1), 1)


def job(unit: str, begin_ns: int, end_ns: int, cpu_ns: int, **lost: int) -> JobRecord:
    asleep_ns = max(end_ns - begin_ns - lost.get("preempted_ns", 0) - cpu_ns, 0)
    times = {"preempted_ns": 0, "asleep_ns": asleep_ns, "cpu_ns": cpu_ns} | lost
    return JobRecord(f"{unit}-stage", unit, 0, begin_ns, begin_ns, begin_ns, end_ns, **times)


def figures(places: Mapping[str, Place], jobs: list[tuple[JobRecord, bool]]) -> tuple[float | None, ...]:
    """Efficiency of the slowest unit, of the fullest cores, of the machine."""
    told = RunEfficiencies(places)
    for one, presents in jobs:
        told.add(one, presents=presents)
    return tuple(told.close().values())


def test_three_units_on_two_cores() -> None:
    """Presented at 100 and 200: a and b share core 0 and work 30 and 50 of it, c works 60 of core 1."""
    jobs = [
        (job("c", 0, 100, 100), True),
        (job("a", 100, 140, 30, preempted_ns=10), False),
        (job("b", 100, 180, 50, preempted_ns=30), False),
        (job("c", 140, 200, 60), True),
    ]
    assert figures({"a": ON_0, "b": ON_0, "c": ON_1}, jobs) == (0.6, 0.8, (30 + 50 + 60) / 200)


def test_threads_share_a_units_work_and_a_floating_unit_can_be_anywhere() -> None:
    """Over 100 ns b has 80 of two threads, a 50 of core 0: the two cores are full to 65, whichever thread was where."""
    jobs = [(job("a", 0, 100, 100), True), (job("b", 110, 160, 80), False), (job("a", 100, 200, 50), True)]
    assert figures({"a": ON_0, "b": ON_BOTH}, jobs) == (0.5, 0.65, 0.65)
    floating = [(job("a", 0, 100, 100), True), (job("b", 110, 190, 80), False), (job("a", 100, 200, 50), True)]
    assert figures({"a": ON_0, "b": FLOATS}, floating) == (0.8, 0.65, 0.65)


def test_a_device_works_while_its_units_threads_sleep() -> None:
    """The job slept for nothing: all of its 100 ns were busy, with 7 of CPU time."""
    jobs = [(job("a", 0, 100, 7, asleep_ns=0), True), (job("a", 100, 200, 7, asleep_ns=0), True)]
    assert figures({"a": ON_0}, jobs) == (1.0, 0.07, 0.07)


@pytest.mark.parametrize(
    ("cpu_ns", "work_ns"),
    [(0, 100), (40, 20 + 60), (98, 49 + 2), (99, 49.5 + 1), (100, 50), (101, 50.5), (102, 51), (200, 100)],
)
def test_a_device_beside_two_threads_adds_what_both_slept_through(cpu_ns: int, work_ns: float) -> None:
    """Of 100 ns in which the job was busy two threads had so much; the device worked alone in the rest at least.

    A ns more of CPU time is at most half a ns of work more or less: nothing jumps where it passes the busy time.
    """
    jobs = [(job("a", 0, 100, 100, asleep_ns=0), True), (job("a", 100, 200, cpu_ns, asleep_ns=0), True)]
    assert figures({"a": ON_BOTH}, jobs)[0] == pytest.approx(work_ns / 100)


@pytest.mark.parametrize("cpu_ns", [30, 99, 101, 150])
def test_a_unit_that_is_held_to_a_pace_works_all_the_while_whatever_its_threads_have(cpu_ns: int) -> None:
    """Held for 100 ns: of two threads that had 30 or 150 of them the chip that it stands for knows nothing."""
    units = {"a": UnitSettings(cores=(0, 1), threads=2), "b": UnitSettings(cores=(0, 1), threads=2)}
    stages = [PipelineStage(name=f"{unit}-stage", unit=unit, factory="json:loads") for unit in units]
    held = stages[0].model_copy(update={"pace_ns": 100})
    pipeline = Pipeline(stages=(held, stages[1]), edges=(PipelineEdge(payload_bytes=1),), units=units)
    config = {"units": {unit: {"cores": [0, 1], "threads": 2} for unit in units}, "pace_ns": {"a-stage": 100}}
    graph = chain([("a-stage", "a"), ("b-stage", "b")], "double", "b-stage")
    places = places_of(Begun(1, graph, Settings(1), {"config": config}))
    assert places == pipeline.places() == {"a": FLOATS, "b": ON_BOTH}
    jobs = [(job("a", 0, 100, 100), True), (job("a", 100, 200, cpu_ns, asleep_ns=0), True)]
    assert figures(places, jobs)[0] == 1


def test_of_a_job_across_the_edges_only_what_must_lie_within_counts() -> None:
    """Between 100 and 200. b began 20 ns before and worked 50 of 60 ns: 30 at least lie within. c ended 30 after the
    last frame, with 40 of 50: 10 at least. One that ended before does not count at all."""
    jobs = [
        (job("b", 10, 80, 70), False),
        (job("a", 0, 100, 100), True),
        (job("b", 80, 140, 50), False),
        (job("a", 110, 200, 90), True),
        (job("c", 180, 230, 40), False),
    ]
    assert figures({"a": ON_0, "b": ON_1, "c": ON_1}, jobs) == (0.9, 0.9, (90 + 30 + 10) / 200)


def test_fewer_than_two_frames_have_none() -> None:
    assert figures({"a": ON_0}, []) == (None, None, None)
    assert figures({"a": ON_0}, [(job("a", 0, 9, 9), True)]) == (None, None, None)


class Thread:
    """Of a unit in the kernel below: its job's CPU time to do, and what it had since the job began."""

    def __init__(self, unit: str, place: Place) -> None:
        self.unit, self.place = unit, place
        self.begin = self.need = self.had = self.waited = self.rest = 0

    def jobs(self, now: int, running: int, draw: random.Random) -> Iterator[JobRecord]:
        """A tick of time in which so many of its cores ran it."""
        if self.rest:
            self.rest -= 1
            if not self.rest:
                self.begin, self.need = now + 1, draw.randrange(1, 40)
                self.had = self.waited = 0
            return
        self.had += running
        self.waited += running == 0
        if self.had >= self.need:
            wall = now + 1 - self.begin
            preempted, asleep = lost_in_job(wall, self.had, self.waited, len(self.place.cores), has_device=False)
            lost = {"preempted_ns": preempted, "asleep_ns": asleep}
            yield job(self.unit, self.begin, now + 1, self.had, **lost)
            self.rest = draw.choice((1, 1, 1, 9))


@pytest.mark.parametrize("seed", range(40))
def test_none_can_pass_1_whatever_a_kernel_does(seed: int) -> None:
    """Three or four units on up to three cores, placed at random, that nearly always have work; a core runs one thread
    at a time. Frames are presented from the first job on that a unit ends, at its edges all others are within jobs."""
    draw = random.Random(seed)
    cores = range(draw.choice((1, 2, 3)))
    units = [f"u{number}" for number in range(draw.choice((3, 4)))]
    places = {}
    for unit in units:
        own = tuple(sorted(draw.sample(cores, draw.randrange(1, len(cores) + 1))))
        places[unit] = Place(own, draw.choice((1, len(own))))
    threads = [Thread(unit, places[unit]) for unit in units]
    for thread in threads:
        thread.rest = 1
    jobs = []
    for now in range(3000):
        ran = dict.fromkeys(units, 0)
        for core in cores:
            ready = [each for each in threads if core in each.place.cores and not each.rest]
            ready = [each for each in ready if ran[each.unit] < each.place.threads]
            if ready:
                ran[draw.choice(ready).unit] += 1
        for thread in threads:
            jobs += [(one, thread.unit == "u0") for one in thread.jobs(now, ran[thread.unit], draw)]
    found = figures(places, jobs)
    assert all(value is not None and 0.2 < value <= 1 for value in found), found


# A stage made slower by a known part. Virtual time, one unit a core: theory says what a frame takes.

STAGES = [("pose", "cpu"), ("raster", "gpu"), ("infer", "dsp"), ("composite", "gpu")]
STAGE_NS = {"pose": 3000, "raster": 5000, "infer": 9000, "composite": 7000}


GRAPH, SETTINGS = chain(STAGES, "double", "composite"), Settings(200)
PLACES = {"cpu": ON_0, "gpu": ON_1, "dsp": Place((2,), 1)}


def found_of(
    run: Simulation, places: Mapping[str, Place] = PLACES, jobs: Sequence[JobRecord] | None = None
) -> Reckoned:
    """What is reckoned of the run; `jobs`: in place of its own."""
    assert run.recording is not None
    records = records_of(run.recording, run.jobs if jobs is None else jobs)
    return reckoned(run.recording.graph, run.recording.settings, places, records)


def ran(times: Mapping[str, int], frames: int = 200) -> tuple[float, Reckoned]:
    """Mean frame time, and what is reckoned of a pipelined run in which stages take so long."""
    run = simulate(GRAPH, Settings(frames), lambda stage, *_: times[stage], keep=True)
    return 1e6 * run.report["frame_time_ms"]["mean"], found_of(run)


@pytest.mark.parametrize("slower", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("stage", STAGE_NS)
def test_a_stage_made_slower_moves_frame_time_bound_and_efficiency_as_theory_says(stage: str, slower: float) -> None:
    """A frame takes what the slowest unit takes for one: before 12 us of the GPU unit (raster and composite)."""
    times = STAGE_NS | {stage: round(STAGE_NS[stage] * (1 + slower))}
    unit_ns = {"cpu": times["pose"], "gpu": times["raster"] + times["composite"], "dsp": times["infer"]}
    slowest = max(unit_ns, key=unit_ns.__getitem__)
    frame_ns, found = ran(times)
    assert frame_ns == pytest.approx(unit_ns[slowest], rel=0.01)
    bound = found.figures["bound"]
    assert (found.figures["bottleneck"], bound["unit"]["name"]) == (slowest, slowest)
    assert bound["unit"]["share"] == pytest.approx(1, abs=0.02)
    assert bound["stage"]["name"] == max(
        (name for name, unit in STAGES if unit == slowest), key=lambda name: times[name]
    )
    assert found.figures["efficiency"] == pytest.approx(1, abs=0.01)
    assert found.figures["machine_efficiency"] == pytest.approx(sum(times.values()) / frame_ns / 3, rel=0.01)


def test_the_bounds_share_has_an_interval_that_holds_it_and_short_runs_have_none() -> None:
    part = ran(STAGE_NS)[1].figures["bound"]["stage"]
    assert 0 <= part["share_low"] <= part["share"] <= part["share_high"] <= 1
    assert part["share"] == pytest.approx(7 / 12, abs=0.02)
    short = ran(STAGE_NS, 50)[1].figures["bound"]["stage"]
    assert (short["share_low"], short["share_high"]) == (None, None)
    assert ran(STAGE_NS, 51)[1].figures["bound"]["stage"]["share_low"] is not None


@pytest.mark.parametrize("replayed", [True, False], ids=["by cost", "by share"])
def test_stages_that_may_bound_equally_are_rivals_and_a_surely_smaller_one_is_none(
    replayed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """raster and composite take 5 and 7 us, and after ten frames the other way round, so 6 us each in the mean.

    Replays tell what each stage costs. Without them, the shares of the path decide.
    """
    if not replayed:
        monkeypatch.setattr(WhatIf, "close", lambda _: None)
    turns = {"raster": (5000, 7000), "composite": (7000, 5000)}

    def service(stage: str, _unit: str, frame: int, _begin_ns: int) -> int:
        return turns.get(stage, (STAGE_NS[stage],) * 2)[frame // 10 % 2]

    stage = found_of(simulate(GRAPH, SETTINGS, service, keep=True)).figures["bound"]["stage"]
    assert {stage["name"], *stage["rivals"]} == {"raster", "composite"}
    assert ran(STAGE_NS)[1].figures["bound"]["stage"]["rivals"] == []
    assert ran(STAGE_NS, 50)[1].figures["bound"]["stage"]["rivals"] is None


def test_time_that_another_stage_had_a_core_is_that_stages_and_the_rest_is_nobodys() -> None:
    """infer shares core 0 with pose: of its 10 ns on the path pose had the core for 4 and nobody of the run for 2."""
    graph = chain([("pose", "cpu"), ("infer", "dsp")], "double", "infer")
    run = simulate(graph, SETTINGS, lambda stage, *_: {"pose": 4, "infer": 10}[stage], keep=True)
    jobs = [
        one._replace(preempted_ns=6, cpu_ns=4) if one.stage == "infer" and one.frame < 198 else one for one in run.jobs
    ]
    found = found_of(run, {"cpu": ON_0, "dsp": ON_0}, jobs)
    total = sum(found.budget.values())
    shares = {part: ns / total for part, ns in found.budget.items()}
    assert shares == {
        ("work", "infer"): pytest.approx(0.4, abs=0.02),
        ("taken", "pose"): pytest.approx(0.4, abs=0.02),
        ("preempted", "infer"): pytest.approx(0.2, abs=0.02),
    }
    assert found.taken["infer"].of.keys() == {"pose"}
    assert found.figures["core_efficiency"] == pytest.approx(0.8, abs=0.02)


@pytest.mark.parametrize("slower", [0.0, 0.2, 0.5, 1.0])
def test_a_stage_that_shares_a_core_costs_what_it_takes_though_nothing_waits_for_its_frames(slower: float) -> None:
    """pose and infer have equal shares of core 0, which is full: a frame takes the sum of both, and each has of the
    path what it has of the core, pose nearly all of it as what infer lacked."""
    times = {"pose": round(4000 * (1 + slower)), "raster": 3000, "infer": 9000, "composite": 4000}
    seats = {"cpu": "core 0", "dsp": "core 0", "gpu": "core 1"}
    member = Member(GRAPH, SETTINGS, lambda stage, *_: times[stage], seats)
    (run,) = simulate_beside([member], divided=["core 0"], keep=True)
    both_ns = times["pose"] + times["infer"]
    assert 1e6 * run.report["frame_time_ms"]["mean"] == pytest.approx(both_ns, rel=0.01)
    found = found_of(run, {"cpu": ON_0, "gpu": ON_1, "dsp": ON_0})
    total = sum(found.budget.values())
    of_pose = sum(ns for (_, stage), ns in found.budget.items() if stage == "pose") / total
    of_infer = sum(ns for (_, stage), ns in found.budget.items() if stage == "infer") / total
    assert (of_pose, of_infer) == pytest.approx((times["pose"] / both_ns, times["infer"] / both_ns), abs=0.03)
    assert found.budget["taken", "pose"] / total > of_pose / 2
    assert found.figures["core_efficiency"] == pytest.approx(1, abs=0.01)
    assert found.figures["core_efficiency"] <= 1
    assert found.figures["efficiency"] == pytest.approx(times["infer"] / both_ns, rel=0.02)
    assert found.figures["bound"]["stage"]["name"] == "infer"
