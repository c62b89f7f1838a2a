"""What a rehearsal measures of units that are told here, and how a placement that follows is chosen and explained."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from trilane.hw_profiles.host import described, placement_of, predictions, unit_rows
from trilane.pipeline import rehearsal
from trilane.pipeline.rehearsal import Chain, on_rungs, timed, works_of
from trilane.pipeline.result import UnitError
from trilane.scheduler.events import StageAlone, chain
from trilane.scheduler.placement import CpuCore, Place, Ranked, UnitWork
from trilane.stages.placing import MEASURED, _reason, considered, thread_counts
from trilane.transport.messages import Done, PongMessage, RunJob

STAGES = (("pose", "cpu"), ("raster", "gpu"), ("infer", "dsp"), ("present", "cpu"))
GRAPH = chain(STAGES, "double", "present")
PIPELINE: Any = SimpleNamespace(
    units={"cpu": SimpleNamespace(threads=1), "gpu": SimpleNamespace(threads=1), "dsp": SimpleNamespace(threads=2)},
    stages_of=lambda unit: [SimpleNamespace(name=name) for name, of in STAGES if of == unit],
)
#: Microseconds of a job: by stage, and what is told of its frame and rung beside.
BASE_US = {"pose": 1000, "raster": 2000, "infer": 4000, "present": 3000}


class Units:
    """Answers each job: 100 us of its time were another's, and the threads' CPU time is `cpu` of the rest.

    `more_us`: of a stage, frame and rung.
    """

    def __init__(self, cpu: float = 0.5) -> None:
        self.places = {name: place for place, (name, _) in enumerate(STAGES)}
        self.jobs: list[tuple[str, RunJob]] = []
        self.cpu = cpu
        self.more_us: dict[tuple[str, int, int], int] = {}

    def send(self, unit: str, job: RunJob) -> None:
        assert STAGES[job.stage][1] == unit and job.id == len(self.jobs) + 1
        self.jobs.append((STAGES[job.stage][0], job))

    def answers(self, *_: object) -> list[Any]:
        name, job = self.jobs[-1]
        own_ns = 1000 * (BASE_US[name] + self.more_us.get((name, job.frame, job.rung), 0))
        unit, cpu_ns = STAGES[job.stage][1], int(self.cpu * own_ns)
        times = {"preempted_ns": 100_000, "asleep_ns": 0, "preempted_before_ns": 0, "skips": 0}
        own = {"t_begin_ns": 5, "t_end_ns": 5 + own_ns + 100_000, "t_sampled_ns": 5, "metrics": {}}
        done = Done(id=job.id, cpu_ns=cpu_ns, cpu_before_ns=0, **own, **times)
        return [("gpu" if unit != "gpu" else "cpu", done._replace(t_end_ns=5)), (unit, PongMessage()), (unit, done)]

    def chain(self, *, whole: bool = True) -> Chain:
        processes: Any = dict.fromkeys(("cpu", "gpu", "dsp"), self)
        nobody: Any = SimpleNamespace(count=0)
        return Chain(GRAPH, processes, nobody, whole=whole)


@pytest.fixture
def units(monkeypatch: pytest.MonkeyPatch) -> Units:
    units = Units()
    monkeypatch.setattr(rehearsal, "listen_before_run", units.answers)
    return units


def test_works_are_medians_over_the_frames_that_do_not_warm_up(units: Units) -> None:
    """Of five frames two warm up, however slow; of the others infer takes 10, 70 and 20 us more than its 4000."""
    units.more_us = {("infer", 0, 0): 9999, ("infer", 1, 0): 9999}
    units.more_us |= {("infer", 2, 0): 10, ("infer", 3, 0): 70, ("infer", 4, 0): 20}
    works = works_of(PIPELINE, timed(units.chain(), [0, 1, 2, 3, 4]))
    assert works == {
        "cpu": UnitWork(4_000_000, 2_000_000, 2),
        "gpu": UnitWork(2_000_000, 1_000_000, 1),
        "dsp": UnitWork(4_020_000, 4_020_000 // 4, 1),  # half of it is CPU time, of two threads
    }


def test_cpu_time_is_never_more_than_the_time_it_took(units: Units) -> None:
    units.cpu = 3.0
    works = works_of(PIPELINE, timed(units.chain(), [0]))
    assert works["gpu"] == UnitWork(2_000_000, 2_000_000, 1)
    assert works["dsp"] == UnitWork(4_000_000, 4_000_000, 1)  # 3 / 2 of it for each thread


def test_what_a_stage_takes_on_each_rung_is_its_median_over_the_frames_after_the_first(units: Units) -> None:
    """infer is followed on two rungs: of frames 4, 8, 9 it takes 4030, 4020, 4900 us on 0; 3000, 3500, 3100 on 1."""
    units.more_us = {("infer", 0, 0): 9999, ("infer", 4, 0): 30, ("infer", 8, 0): 20, ("infer", 9, 0): 900}
    units.more_us |= {("infer", 0, 1): -3999, ("infer", 4, 1): -1000, ("infer", 8, 1): -500, ("infer", 9, 1): -900}
    found = on_rungs(units.chain(whole=False), [0, 4, 8, 9], 2, ["infer"])
    assert found == [StageAlone("infer", 0, 4_030_000), StageAlone("infer", 1, 3_100_000)]
    followed = [(job.frame, job.rung) for name, job in units.jobs if name == "pose"]
    assert followed == [(frame, rung) for rung in (0, 1) for frame in (0, 4, 8, 9)], "no frame follows itself"


def test_nothing_is_said_of_a_stage_that_takes_no_less_on_a_further_rung(units: Units) -> None:
    """One frame, which counts: pose takes less on the second rung, infer does not."""
    units.more_us = {("pose", 0, 1): -1}
    found = on_rungs(units.chain(whole=False), [0], 2, ["infer", "pose"])
    assert found == [StageAlone("pose", 0, 1_000_000), StageAlone("pose", 1, 999_000)]


def test_a_unit_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rehearsal, "listen_before_run", lambda *_: [])
    monkeypatch.setattr(rehearsal, "START_S", 0.0)
    with pytest.raises(UnitError, match=r"^unit cpu did not end a job within 0 s$"):
        Units().chain().frame(0)


def test_the_network_is_measured_with_every_number_of_threads_that_it_may_have() -> None:
    rule = {"cpu": Place((0,), 1), "gpu": Place((1,), 1), "dsp": Place((0, 1, 2), 3)}
    assert thread_counts(12, rule) == {"cpu": [], "gpu": [], "dsp": [2, 3, 4, 6, 10, 11, 12]}
    assert thread_counts(1, {**rule, "dsp": Place((0,), 1)})["dsp"] == []
    assert thread_counts(2, {**rule, "cpu": Place((0, 1), 2)})["cpu"] == [2]


def test_of_many_cores_one_of_each_physical_is_considered() -> None:
    """Up to eight all; of more, the first sibling of each, sixteen of them; those that were asked for stay."""
    siblings = [CpuCore(number, number // 2) for number in range(40)]
    assert considered(siblings[:8], {}) == siblings[:8]
    assert considered(siblings[:10], {}) == siblings[:10:2]
    assert considered(siblings, {}) == siblings[:32:2]
    asked = {"dsp": Place((3, 39), 2), "gpu": Place((4,), 1)}
    assert [core.number for core in considered(siblings, asked)] == sorted([*range(0, 32, 2), 3, 39])


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


def test_no_frame_is_begun_when_the_time_is_up_and_warming_up_is_not_part_of_it(
    units: Units, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rehearsal, "LIMIT_S", -1.0)
    assert len(timed(units.chain(), [0, 1, 2, 3])) == 1
    assert {job.frame for _, job in units.jobs} == {0, 1, 2}
    units.jobs.clear()
    assert len(timed(units.chain(), [5])) == 1
    assert {job.frame for _, job in units.jobs} == {5}
