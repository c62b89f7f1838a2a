"""What slowing a stage costs, against the theory of pipelines on cores that are full."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest

from trilane.apps.explain.reasons import bound_text
from trilane.pipeline.journal import records_of
from trilane.pipeline.reckoning import MOST_BLOCKS, SLOWER, reckoned
from trilane.scheduler.events import SetDuty, Settings, chain
from trilane.scheduler.placement import Place, Placement
from trilane.scheduler.shared_units import Member, simulate_beside
from trilane.scheduler.stats import LEAST_BATCHES, LEAST_FRAMES
from trilane.scheduler.virtual import Simulation, simulate

MS, FRAMES = 1_000_000, 100
STAGES = [("pose", "cpu"), ("raster", "gpu"), ("infer", "dsp"), ("composite", "gpu")]
GRAPH, UNIT_OF = chain(STAGES, "double", "composite"), dict(STAGES)
STAGE_MS = {"pose": 3.0, "raster": 5.0, "infer": 9.0, "composite": 7.0}
ON_0, ON_1 = Place((0,), 1), Place((1,), 1)
OWN: Placement = {"cpu": ON_0, "gpu": ON_1, "dsp": Place((2,), 1)}
SHARED: Placement = {"cpu": ON_0, "gpu": ON_1, "dsp": ON_0}


def bound_of(run: Simulation, places: Placement = OWN) -> dict[str, Any]:
    assert run.recording is not None
    records = records_of(run.recording, run.jobs)
    figures = reckoned(run.recording.graph, run.recording.settings, places, records).figures
    assert figures["bottleneck"] == figures["bound"]["unit"]["name"]
    return dict(figures["bound"])


def ran(ms: Mapping[str, float], settings: Settings | None = None, **driver: Any) -> Simulation:
    """A run whose units have cores of their own."""
    return simulate(GRAPH, settings or Settings(FRAMES), lambda stage, *_: round(ms[stage] * MS), keep=True, **driver)


def ran_shared(ms: Mapping[str, float]) -> Simulation:
    """A run in which the CPU unit and the DSP have equal shares of core 0."""
    seats = {"cpu": "core 0", "dsp": "core 0", "gpu": "core 1"}
    member = Member(GRAPH, Settings(FRAMES), lambda stage, *_: round(ms[stage] * MS), seats)
    return simulate_beside([member], divided=["core 0"], keep=True)[0]


def frame_ms(ms: Mapping[str, float], places: Placement) -> float:
    """What a frame takes on cores of which one is full: the largest sum of the stages on a core, or of a unit."""
    of_unit: dict[str, float] = {}
    of_core: dict[int, float] = {}
    for stage, unit in STAGES:
        (core,) = places[unit].cores
        of_unit[unit] = of_unit.get(unit, 0.0) + ms[stage]
        of_core[core] = of_core.get(core, 0.0) + ms[stage]
    return max(*of_unit.values(), *of_core.values())


@pytest.mark.parametrize(
    ("places", "ms"),
    [
        (OWN, STAGE_MS),
        (OWN, STAGE_MS | {"infer": 14.0}),
        (OWN, STAGE_MS | {"pose": 13.0}),
        (SHARED, STAGE_MS | {"raster": 3.0, "composite": 4.0}),
        (SHARED, STAGE_MS | {"pose": 13.0, "raster": 3.0, "composite": 4.0}),
    ],
)
def test_a_stage_costs_what_theory_says_and_the_one_that_costs_most_is_the_bound(
    places: Placement, ms: dict[str, float]
) -> None:
    run = ran(ms) if places is OWN else ran_shared(ms)
    bound, before = bound_of(run, places), frame_ms(ms, places)
    expected = {stage: frame_ms(ms | {stage: ms[stage] * (1 + SLOWER)}, places) / before - 1 for stage in ms}
    found = {stage: row["cost"] for stage, row in bound["slowed"]["costs"].items()}
    assert found == pytest.approx(expected, abs=0.01)
    assert bound["slowed"]["is_trusted"] and bound["slowed"]["over_measured"] == pytest.approx(1, abs=0.01)
    worst = max(expected, key=expected.__getitem__)
    assert (bound["stage"]["name"], bound["stage"]["rivals"]) == (worst, [])
    assert bound["stage"]["cost"] == pytest.approx(expected[worst], abs=0.01)
    assert bound["stage"]["cost_low"] <= bound["stage"]["cost"] <= bound["stage"]["cost_high"]
    of_unit = sum(cost for stage, cost in expected.items() if UNIT_OF[stage] == UNIT_OF[worst])
    assert bound["unit"]["name"] == UNIT_OF[worst] and bound["unit"]["cost"] == pytest.approx(of_unit, abs=0.02)


def test_what_costs_most_is_the_bound_though_another_has_more_of_the_path() -> None:
    """The GPU unit takes 12.5 ms a frame and the DSP 12.4: all of the path is the GPU's.

    But composite's share of the path is 6.5 / 12.5, and a fifth more of it costs 1.3 ms, while a fifth more of infer
    makes a frame 14.88 ms long. Both stages of the GPU unit together cost a fifth.
    """
    bound = bound_of(ran(STAGE_MS | {"raster": 6.0, "infer": 12.4, "composite": 6.5}))
    assert (bound["unit"]["name"], bound["stage"]["name"]) == ("gpu", "infer")
    assert bound["unit"]["cost"] == pytest.approx(0.2, abs=0.01)
    assert bound["stage"]["cost"] == pytest.approx(14.88 / 12.5 - 1, abs=0.01)
    assert bound["stage"]["share"] == pytest.approx(0, abs=0.05)
    assert (bound["path"]["unit"]["name"], bound["path"]["stage"]["name"]) == ("gpu", "composite")
    assert bound["path"]["stage"]["share"] == pytest.approx(6.5 / 12.5, abs=0.05)
    said = bound_text(bound)
    assert said.startswith("gpu costs 20% (") and ", and of stages most infer costs 19% (" in said
    assert "; most of the path: gpu 9" in said and ", composite 5" in said


def test_a_replay_that_is_far_from_the_run_names_nothing() -> None:
    """A cap lets the DSP work for half of the time, so a frame takes 18 ms. Without it 12, and the GPU unit bounds."""
    run = ran(STAGE_MS, inputs=[(0, SetDuty("dsp", 500))])
    bound = bound_of(run)
    assert bound["slowed"]["over_measured"] == pytest.approx(12 / 18, abs=0.01)
    assert not bound["slowed"]["is_trusted"]
    assert (bound["unit"]["name"], bound["unit"].get("cost"), "path" in bound) == ("dsp", None, False)


def test_with_time_to_spare_nothing_costs_and_the_path_names_the_bound() -> None:
    bound = bound_of(ran(STAGE_MS, Settings(FRAMES, period_ns=60 * MS)))
    assert [row["cost"] for row in bound["slowed"]["costs"].values()] == pytest.approx([0.0] * 4, abs=1e-3)
    assert (bound["unit"]["name"], bound["stage"]["name"]) == ("release", "infer")


@pytest.mark.parametrize(
    ("frames", "has_costs", "has_interval"),
    [
        (2 * LEAST_FRAMES - 1, False, False),
        (2 * LEAST_FRAMES, True, False),
        ((LEAST_BATCHES + 1) * LEAST_FRAMES - 1, True, False),
        ((LEAST_BATCHES + 1) * LEAST_FRAMES, True, True),
    ],
)
def test_short_runs_have_no_interval_and_shorter_ones_no_costs(
    frames: int, has_costs: bool, has_interval: bool
) -> None:
    bound = bound_of(ran(STAGE_MS, Settings(frames)))
    assert ("slowed" in bound) == has_costs
    assert (bound["stage"].get("cost_low") is not None) == has_interval
    assert (bound["stage"]["rivals"] is not None) == has_interval


def test_of_a_long_run_as_many_frames_are_replayed_and_equal_journals_give_equal_costs() -> None:
    """The second half of the run has another bound; what is replayed is of both."""
    run = simulate(
        GRAPH,
        Settings(800),
        lambda stage, _, frame, __: round(STAGE_MS[stage] * (3 if stage == "infer" and frame >= 400 else 1) * MS),
        keep=True,
    )
    bound = bound_of(run)
    assert bound["slowed"]["frames"] == (MOST_BLOCKS - 1) * LEAST_FRAMES
    assert bound["slowed"]["costs"]["infer"]["cost"] > 0.02 < bound["slowed"]["costs"]["composite"]["cost"]
    assert bound_of(run) == bound


def test_stages_whose_costs_may_be_equal_are_rivals() -> None:
    """raster and composite take 5 and 7 ms, and after ten frames the other way round."""
    turns = {"raster": (5, 7), "composite": (7, 5)}
    run = simulate(
        GRAPH,
        Settings(FRAMES),
        lambda stage, _, frame, __: MS * turns.get(stage, (int(STAGE_MS[stage]),) * 2)[frame // LEAST_FRAMES % 2],
        keep=True,
    )
    stage = bound_of(run)["stage"]
    assert {stage["name"], *stage["rivals"]} == {"raster", "composite"}


def test_a_journal_without_cpu_times_and_units_without_cores_are_not_replayed() -> None:
    run = ran(STAGE_MS)
    old = replace(run, jobs=tuple(job._replace(cpu_ns=0) for job in run.jobs))
    assert "slowed" not in bound_of(old)
    assert "slowed" not in bound_of(run, {"cpu": ON_0})


def of_infer(run: Simulation, **fields: Any) -> Simulation:
    """The run with other times of the jobs of infer: functions of the job."""
    jobs = tuple(
        job._replace(**{name: value(job) for name, value in fields.items()}) if job.stage == "infer" else job
        for job in run.jobs
    )
    return replace(run, jobs=jobs)


def test_time_in_which_a_device_works_is_slowed_as_well() -> None:
    """Of infer's 14 ms 4 are CPU time. All of a frame is infer, so a fifth more of it is a fifth more of the frame."""
    run = of_infer(ran(STAGE_MS | {"infer": 14.0}), cpu_ns=lambda _: 4 * MS)
    assert bound_of(run)["stage"]["cost"] == pytest.approx(0.2, abs=0.01)


def test_the_cpu_time_of_several_threads_is_divided_among_them() -> None:
    run = of_infer(ran(STAGE_MS | {"infer": 14.0}), cpu_ns=lambda job: 2 * (job.end_ns - job.begin_ns))
    bound = bound_of(run, {**OWN, "dsp": Place((2, 3), 2)})
    assert bound["slowed"]["over_measured"] == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("skipped", [False, True])
def test_messages_take_the_time_that_they_took_and_skipped_stages_none(skipped: bool) -> None:
    """One frame at a time, 2 ms each way: 24 ms of work and 16 of messages; of every other frame 10 and 8, if it skips.

    Most of the path is overhead, and so is the bottleneck. A fifth more of infer is 1.8 ms of a full frame.
    """
    graph = replace(GRAPH, bypass=("pose", "composite"))
    run = simulate(
        graph,
        Settings(FRAMES, "sequential"),
        lambda stage, *_: round(STAGE_MS[stage] * MS),
        message_delay_ns=2 * MS,
        skips=lambda frame, _fresh: skipped and frame % 2 == 1,
        keep=True,
    )
    bound, frame = bound_of(run), (40 + 18) / 2 if skipped else 40
    assert run.report["frame_time_ms"]["mean"] == pytest.approx(frame, abs=0.2)
    assert bound["slowed"]["over_measured"] == pytest.approx(1, abs=0.01)
    assert bound["slowed"]["costs"]["infer"]["cost"] == pytest.approx((0.5 if skipped else 1) * 1.8 / frame, abs=0.002)
    assert (bound["unit"]["name"], bound["unit"].get("cost"), bound["stage"]["name"]) == (
        ("overhead", None, "composite" if skipped else "infer")
    )
