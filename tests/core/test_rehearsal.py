"""What a rehearsal measures of units that are told here, and how a placement that follows is chosen and explained."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from trilane.hw_profiles.placement_facts import described, placement_of, predictions, unit_rows
from trilane.pipeline import rehearsal
from trilane.pipeline.rehearsal import _in_proportion, _Rehearsal
from trilane.pipeline.run_log import UnitError
from trilane.scheduler.placement import Ranked
from trilane.scheduler.places import Core, Place, Work
from trilane.stages.placing import MEASURED, _reason, considered, thread_counts, times_rows
from trilane.transport.messages import Done, Pong, RunJob

STAGES = (("pose", "cpu"), ("raster", "gpu"), ("infer", "dsp"), ("present", "cpu"))
PIPELINE: Any = SimpleNamespace(
    stages=[SimpleNamespace(name=name, unit=unit) for name, unit in STAGES],
    units={"cpu": SimpleNamespace(threads=1), "gpu": SimpleNamespace(threads=1), "dsp": SimpleNamespace(threads=2)},
    stages_of=lambda unit: [SimpleNamespace(name=name) for name, of in STAGES if of == unit],
)
#: Microseconds of a job: by stage, and one more with each job that the rehearsal asks for, the first of which is 1.
BASE_US = {"pose": 1000, "raster": 2000, "infer": 4000, "present": 3000}


class Units:
    """Answers each job: 100 us of its time were another's, and the threads' CPU time is `cpu` of the rest."""

    def __init__(self, cpu: float = 0.5) -> None:
        self.places = {name: place for place, (name, _) in enumerate(STAGES)}
        self.jobs: list[tuple[str, RunJob]] = []
        self.cpu = cpu

    def send(self, unit: str, job: RunJob) -> None:
        assert STAGES[job.stage][1] == unit and job.id == len(self.jobs) + 1
        self.jobs.append((STAGES[job.stage][0], job))

    def answers(self, *_: object) -> list[Any]:
        name, job = self.jobs[-1]
        own_ns = 1000 * (BASE_US[name] + job.id)
        unit, cpu_ns = STAGES[job.stage][1], int(self.cpu * own_ns)
        times = {"preempted_ns": 100_000, "asleep_ns": 0, "preempted_before_ns": 0, "skips": 0}
        own = {"t_begin_ns": 5, "t_end_ns": 5 + own_ns + 100_000, "t_sampled_ns": 5, "metrics": {}}
        done = Done(id=job.id, cpu_ns=cpu_ns, cpu_before_ns=0, **own, **times)
        return [("gpu" if unit != "gpu" else "cpu", done._replace(t_end_ns=5)), (unit, Pong()), (unit, done)]


@pytest.fixture
def units(monkeypatch: pytest.MonkeyPatch) -> Units:
    units = Units()
    monkeypatch.setattr(rehearsal, "listen_before_run", units.answers)
    return units


def test_a_frame_goes_through_every_stage_and_then_each_unit_works_alone(units: Units) -> None:
    """Jobs 1 to 4 are the chain. The CPU unit's rounds are the jobs 5 6, 7 8, 9 10, 11 12, of which the first warms up:
    the shortest pose is job 7, the shortest present job 8. The GPU unit's are 13 to 16, the DSP's 17 to 20."""
    works, last = _Rehearsal(PIPELINE, units, SimpleNamespace()).measure([40])  # type: ignore[arg-type]
    assert last == 40
    assert [name for name, _ in units.jobs] == [
        *("pose", "raster", "infer", "present"),
        *(("pose", "present") * 4),
        *(("raster",) * 4),
        *(("infer",) * 4),
    ]
    assert works == {
        "cpu": Work(1_007_000 + 3_008_000, (1_007_000 + 3_008_000) // 2, 2),
        "gpu": Work(2_014_000, 1_007_000, 1),
        "dsp": Work(4_018_000, 4_018_000 // 4, 1),  # half of it is CPU time, of two threads
    }
    by_name = {name: job for name, job in units.jobs}
    ends = {name: (job.slot_in, job.slot_out) for name, job in by_name.items()}
    assert ends == {"pose": (-1, 0), "raster": (0, 0), "infer": (0, 0), "present": (0, -1)}
    assert {(job.frame, job.epoch, job.fresh) for _, job in units.jobs} == {(40, 0, 1)}


def test_works_are_means_over_frames_and_no_frame_is_begun_when_the_time_is_up(
    units: Units, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second frame's jobs come 20 later, so its work is 20 us more for a stage, 10 in the mean."""
    rehearsed = _Rehearsal(PIPELINE, units, SimpleNamespace())  # type: ignore[arg-type]
    works, last = rehearsed.measure([4, 9])
    assert last == 9
    assert [works[unit].serial_ns for unit in ("cpu", "gpu", "dsp")] == [4_035_000, 2_024_000, 4_028_000]
    assert rehearsed.works["gpu", 4].serial_ns == 2_014_000 and rehearsed.works["gpu", 9].serial_ns == 2_034_000
    monkeypatch.setattr(rehearsal, "LIMIT_S", -1.0)
    units.jobs.clear()
    assert _Rehearsal(PIPELINE, units, SimpleNamespace()).measure([4, 9])[1] == 4  # type: ignore[arg-type]
    assert len(units.jobs) == 20


def test_cpu_time_is_never_more_than_the_time_it_took(units: Units) -> None:
    units.cpu = 3.0
    works, _ = _Rehearsal(PIPELINE, units, SimpleNamespace()).measure([0])  # type: ignore[arg-type]
    assert works["gpu"] == Work(2_014_000, 2_014_000, 1)
    assert works["dsp"] == Work(4_018_000, 4_018_000, 1)  # 3 / 2 of it for each thread


def test_a_unit_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rehearsal, "listen_before_run", lambda *_: [])
    monkeypatch.setattr(rehearsal, "START_S", 0.0)
    with pytest.raises(UnitError, match=r"^unit cpu did not end a job within 0 s$"):
        _Rehearsal(PIPELINE, Units(), SimpleNamespace()).measure([0])  # type: ignore[arg-type]


def test_other_settings_change_the_mean_as_they_change_one_frame() -> None:
    """That frame takes 6 where it took 8, and 5 of a core where it took 2: three quarters of 100, and 50 by 5 / 2."""
    assert _in_proportion(Work(100, 50, 3), Work(8, 2, 3), Work(6, 5, 3)) == Work(75, 125, 3)
    assert _in_proportion(Work(100, 50, 3), Work(0, 0, 3), Work(6, 5, 3)) == Work(600, 250, 3)


def test_the_network_is_measured_with_every_number_of_threads_that_it_may_have() -> None:
    rule = {"cpu": Place((0,), 1), "gpu": Place((1,), 1), "dsp": Place((0, 1, 2), 3)}
    assert thread_counts(12, rule) == {"cpu": [], "gpu": [], "dsp": [2, 3, 4, 6, 10, 11, 12]}
    assert thread_counts(1, {**rule, "dsp": Place((0,), 1)})["dsp"] == []
    assert thread_counts(2, {**rule, "cpu": Place((0, 1), 2)})["cpu"] == [2]


def test_of_many_cores_one_of_each_physical_is_considered() -> None:
    """Up to eight all; of more, the first sibling of each, sixteen of them; those that were asked for stay."""
    siblings = [Core(number, number // 2) for number in range(40)]
    assert considered(siblings[:8], {}) == siblings[:8]
    assert considered(siblings[:10], {}) == siblings[:10:2]
    assert considered(siblings, {}) == siblings[:32:2]
    asked = {"dsp": Place((3, 39), 2), "gpu": Place((4,), 1)}
    assert [core.number for core in considered(siblings, asked)] == sorted([*range(0, 32, 2), 3, 39])


def test_times_are_rows_in_milliseconds() -> None:
    times = {
        "cpu": {1: Work(2_500_000, 500_000)},
        "dsp": {1: Work(9_000_000, 8_000_000), 2: Work(5_000_000, 4_500_000)},
    }
    assert times_rows(times) == [
        {"unit": "cpu", "threads": 1, "ms": 2.5, "core_ms": 0.5},
        {"unit": "dsp", "threads": 1, "ms": 9.0, "core_ms": 8.0},
        {"unit": "dsp", "threads": 2, "ms": 5.0, "core_ms": 4.5},
    ]


ONE, TWO, THREE, RULE = (
    {"cpu": Place((0,), 1), "gpu": Place((1,), 1), "dsp": dsp}
    for dsp in (Place((0,), 1), Place((1,), 1), Place((0, 1), 1), Place((0, 1), 2))
)


@pytest.mark.parametrize(
    ("best", "found", "said"),
    [
        pytest.param(
            ONE,
            [ONE, TWO, THREE, RULE],
            "; cpu 0, gpu 1, dsp 0,1 (2 threads): 9.0; cpu 0, gpu 1, dsp 1: 5.0; cpu 0, gpu 1, dsp 0,1 (1 thread): 6.0",
            id="the rule's is told first where it is not among the next two",
        ),
        pytest.param(
            ONE,
            [ONE, RULE, TWO, THREE],
            "; cpu 0, gpu 1, dsp 0,1 (2 threads): 9.0; cpu 0, gpu 1, dsp 1: 5.0",
            id="the rule's is the next",
        ),
        pytest.param(
            RULE,
            [RULE, ONE, TWO, THREE],
            "; cpu 0, gpu 1, dsp 0: 4.0; cpu 0, gpu 1, dsp 1: 5.0",
            id="the rule's is taken",
        ),
    ],
)
def test_a_placement_is_explained_by_its_rivals(best: Any, found: list[Any], said: str) -> None:
    ms = {described(each): value for each, value in zip((ONE, TWO, THREE, RULE), (4.0, 5.0, 6.0, 9.0), strict=True)}
    listed = [Ranked(each, round(1e6 * ms[described(each)])) for each in found]
    rule = next(each for each in listed if each.placement == RULE)
    facts = {"how": MEASURED, "why": "the least", "units": unit_rows(best), "measured_at": "noon"}
    facts |= predictions(Ranked(best, 3_500_000), rule, listed)
    assert _reason(facts) == f"3.5 ms, the least; by times of noon{said}"
    assert _reason({"how": "rule", "why": "there is one core"}) == "there is one core"
    assert placement_of(unit_rows(RULE)) == RULE
