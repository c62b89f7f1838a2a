"""A whole run on a clock of virtual time: its steps in order, what it reports, and what goes wrong around its loop."""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from support.small_pipeline import pipeline
from trilane.errors import BadInputError, UnwrittenError
from trilane.pipeline import cpu_use, run, surroundings
from trilane.pipeline.controls import FrameRequestQueue
from trilane.pipeline.cpu_use import CpuTimes
from trilane.pipeline.journal import (
    Accounted,
    Begun,
    Counted,
    Ended,
    JournalWriter,
    Said,
    Sampled,
    Stepped,
    Worked,
    read_journal,
)
from trilane.pipeline.result import RunResult
from trilane.pipeline.run import DdSketch
from trilane.pipeline.run_metrics import metrics_of
from trilane.pipeline.run_record import JournalFile, memory_bytes
from trilane.scheduler.events import Outcome, OutcomeKind, Settings, StageAlone
from trilane.scheduler.stats import energy_score
from trilane.scheduler.virtual import VirtualDriver
from trilane.transport.messages import Done

MS = 1_000_000
STAGE_NS = {"in": MS, "mid": 4 * MS, "out": MS}
PIPELINE = pipeline().with_rule("double")


@dataclass
class World:
    """In place of everything round a run; `steps`: what it did, in order. What is `told` changes it."""

    steps: list[Any] = field(default_factory=list)
    told: dict[str, Any] = field(default_factory=dict)
    first: list[Any] = field(default_factory=list)
    count: int = 0
    core: Any = None

    # The parts that a run is made of.
    def processes(self, given: Any, assets: Any, starter: Any, _kind: Any) -> Any:
        self.steps.append(("processes", given is PIPELINE, assets, starter))
        pids = {"left": 11, "right": 12}
        return contextlib.nullcontext(SimpleNamespace(pids=pids, why_ended=lambda unit: f": {unit} is broken"))

    def clock(self, core: Any, _processes: Any, _interrupts: Any, log: Any, *others: Any) -> Any:
        self.core, self.log, self.others = core, log, others
        driver = VirtualDriver(core.graph, core.settings, lambda stage, *_: STAGE_NS[stage], keep=True)
        driver.core = core
        self.driver = driver
        cpu = CpuTimes({"left": 2, "right": 2})
        for number in range(4):
            cpu.add("right", "mid", Done(number, 0, 0, 0, 0, 0, 0, 0, 3 * MS, 0, {}), 0)
        metrics = {"mid": Counter({"visible": 12.0}), "none": Counter({"x": 5.0})}
        reported = {"mid": Counter({"visible": 40}), "none": Counter({"x": 1})}
        said = {"metrics": metrics, "reported": reported, "first": self.first}

        class Clock(SimpleNamespace):
            @property
            def waiting(self) -> int:
                return len(driver.jobs)

            def ended(self) -> list[Worked]:
                found, driver.jobs[:] = [Worked(job, {"n": 1.0}) for job in driver.jobs], []
                return found

        return Clock(cpu=cpu, finish=lambda: self.steps.append("finish"), driver=driver, **said)

    def run_loop(self, core: Any, clock: Any, recording: Any) -> Outcome:
        self.steps.append("loop")
        outcome = run_loop(core, clock.driver, recording)
        self.count = self.told.get("interrupts", 0)
        return self.told.get("outcome", outcome)

    def chain(self, _graph: Any, processes: Any, _interrupts: Any, *, whole: bool) -> Any:
        assert set(processes) == {"left", "right"} and not whole
        return SimpleNamespace(frame=lambda number: self.steps.append(("frame", number)))

    def rungs(self, _chain: Any, frames: list[int], rungs: int, follow: tuple[str, ...]) -> list[StageAlone]:
        self.steps.append(("rungs", frames, rungs, follow))
        return [StageAlone("mid", rung, (3 - rung) * MS) for rung in range(rungs)]

    def start(self, _processes: Any, units: Any, _interrupts: Any) -> dict[str, float]:
        self.steps.append(("start", tuple(units)))
        return {"left": 1.5, "right": 2.5}

    def close(self, *_: Any) -> None:
        self.steps.append("close")


run_loop = run.run_loop


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    world = World()

    @contextlib.contextmanager
    def awake(prompt: bool) -> Iterator[str]:
        world.steps.append(("awake", prompt))
        yield "kept awake"

    @contextlib.contextmanager
    def interrupts() -> Iterator[Any]:
        yield world

    @contextlib.contextmanager
    def on_cores(cores: Any) -> Iterator[None]:
        world.steps.append(("cores", cores))
        yield

    for name, part in (
        ("check_cores", lambda given: world.steps.append(("check cores", given is PIPELINE))),
        ("check_open_files", lambda: world.steps.append("check files")),
        ("refuse_in_a_unit", lambda: world.steps.append("refuse")),
        ("on_cores", on_cores),
        ("unit_processes", world.processes),
        ("prompt_answers", contextlib.nullcontext),
        ("awake", awake),
        ("Interrupts", interrupts),
        ("RealtimeClock", world.clock),
        ("Chain", world.chain),
        ("on_rungs", world.rungs),
        ("run_loop", world.run_loop),
        ("start_units", world.start),
        ("close_units", world.close),
        ("beside_units", lambda cores, pids: lambda now: 0.25 if (cores, pids == now) == ([0, 1, 3], True) else None),
    ):
        monkeypatch.setattr(run, name, part)
    monkeypatch.setattr(cpu_use, "counts_run_delay", lambda: True)
    return world


def go(frames: int = 60, **options: Any) -> RunResult:
    return run.run_pipeline(PIPELINE, frames, **options)


def test_the_steps_of_a_run_and_its_report(world: World) -> None:
    """The first frame warms up before the loop; mid, on the right, takes the 4 ms of a frame."""
    result = go(assets={"a": 1}, starter="starter")
    assert world.steps == [
        *("refuse", "check files", ("check cores", True), ("cores", PIPELINE.scheduler_cores), ("awake", True)),
        ("processes", True, {"a": 1}, "starter"),
        ("start", ("left", "right")),
        *(("frame", 0), "loop", "finish", "close"),
    ]
    assert (result.requested, result.presented, result.lost, result.dropped) == (60, 60, {}, {})
    assert (result.pids, result.startup_ms) == ({"left": 11, "right": 12}, {"left": 1.5, "right": 2.5})
    assert (len(result.jobs), result.messages, result.interrupted, result.failure) == (180, (), False, None)
    assert result.metrics == {"mid": {"visible": 0.3}, "none": {"x": 5.0}}
    assert result.recording.steps and result.recording.settings == Settings(60, "pipelined", hang_ns=10_000_000_000)
    report = result.report
    assert (report.clock, report.policy, report.edge, report.idle_cores) == (
        "host",
        "pipelined",
        "double",
        "kept awake",
    )
    assert (report.frame_time_ms.mean, report.other_programs) == (4.0, 0.25)
    assert report.deadline_misses == 0
    # of 4 ms right works 4 and left 2; each may run on two cores, and they have three in all
    assert report.efficiency == pytest.approx(1 - 1 / (59 * 4))  # but for the way out of the last frame
    assert report.core_efficiency == pytest.approx(0.5, rel=0.01)
    assert report.machine_efficiency == pytest.approx(6 / (3 * 4), rel=0.01)
    assert report.bound is not None and report.bound.stage is not None
    assert (report.bottleneck, report.bound.unit.name, report.bound.stage.name) == ("right", "right", "mid")
    assert report.bound.stage.share == pytest.approx(1 - 1 / (59 * 4))
    left, right = report.units["left"], report.units["right"]
    assert (left.pid, left.cores, left.threads, left.spin) == (11, (1, 0), 2, False)
    assert (right.pid, right.cores, right.threads, right.spin) == (12, (3, 1), 1, True)
    assert (left.cpu_s, right.cpu_s, right.cpu_in_jobs_s) == (0.0, 0.012, 0.012)
    assert report.stages["mid"].cpu_ms is not None and report.stages["mid"].cpu_ms.mean == 3.0
    assert [(row.cores, row.units) for row in report.core_shares] == [
        ((0, 1), ("left",)),
        ((1, 3), ("right",)),
        ((0, 1, 3), ("left", "right")),
    ]
    assert report.core_shares[1].cpu == pytest.approx(0.012 / (2 * report.duration_s))
    assert (report.caps, report.xrbench.energy) == (None, None)


def test_a_run_with_a_journal_keeps_nothing_and_writes_the_same(world: World, tmp_path: Path) -> None:
    """Steps, jobs and accounts are those of the same run in memory; each job follows the step that heard its end."""
    kept = go()
    file = JournalFile(tmp_path / "j", {"made": "today", "clock": "host"}, lambda: {"temperature_c.sensor": 41.5})
    result = go(journal=file)
    assert (result.jobs, result.recording.steps, result.recording.accounts) == ((), [], [])
    assert world.others[-1] is DdSketch and result.report.percentiles == kept.report.percentiles == "exact"
    begun, *records, ended = read_journal(tmp_path / "j")
    assert isinstance(begun, Begun)
    assert (begun.graph, begun.settings, begun.facts["made"]) == (PIPELINE.graph(), kept.recording.settings, "today")
    assert (begun.facts["clock"], begun.facts["began_at"][-6:]) == ("host", "+00:00")
    assert [tuple(each) for each in records if isinstance(each, Stepped)] == kept.recording.steps
    assert [tuple(each) for each in records if isinstance(each, Accounted)] == kept.recording.accounts
    assert sorted(each.job for each in records if isinstance(each, Worked)) == sorted(kept.jobs)
    now_ns = 0
    for each in records:
        now_ns = each.now_ns if isinstance(each, Stepped) else now_ns
        assert not isinstance(each, Worked) or (each.job.end_ns, each.figures) == (now_ns, {"n": 1.0})
    samples = [each for each in records if isinstance(each, Sampled)]
    assert len(samples) == 1  # the run takes a quarter of a second
    assert samples[0].values["temperature_c.sensor"] == 41.5
    assert samples[0].values["memory_bytes.scheduler"] > 1 << 20
    assert isinstance(ended, Ended) and metrics_of(ended.report) == result.report


def test_messages_and_frames_left_out_are_in_the_journal(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cpu_use, "counts_run_delay", lambda: False)
    governor: Any = SimpleNamespace(is_prompt=True, power_w=None, report=dict, temperatures_c={"device": 30.0})
    go(journal=JournalFile(tmp_path / "j", {}), policy="latest", fps=2000.0, governor=governor)
    records = list(read_journal(tmp_path / "j"))
    assert [each.text for each in records if isinstance(each, Said)] == [cpu_use.NO_RUN_DELAY]
    counts = [each for each in records if isinstance(each, Counted)]
    assert counts[-1].dropped == world.core.ledger.dropped_by_cause and counts[-1].lost == {}
    assert [sum(each.dropped.values()) for each in counts] == sorted({sum(each.dropped.values()) for each in counts})
    sampled = next(each for each in records if isinstance(each, Sampled))
    assert (sampled.values["duty.left"], sampled.values["temperature_c.device"]) == (1.0, 30.0)


@pytest.mark.usefixtures("world")
def test_a_journal_that_cannot_be_begun_or_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BadInputError, match="a place that can be written"):
        go(journal=JournalFile(tmp_path / "none" / "j", {}))

    def full(self: Any, record: Any) -> None:
        if isinstance(record, Stepped):
            self.failure = UnwrittenError(tmp_path / "j", OSError(28, "No space left on device"))
            raise self.failure

    monkeypatch.setattr(JournalWriter, "add", full)
    with pytest.raises(UnwrittenError, match=f"{tmp_path}/j: no space left on device"):
        go(journal=JournalFile(tmp_path / "j", {}))


def test_memory_of_a_process_that_has_ended_is_none() -> None:
    assert memory_bytes(1 << 30) == 0


def test_a_frame_time_above_the_rates_is_a_missed_deadline(world: World) -> None:
    """4 ms a frame; at 251 frames a second each may take 3.98."""
    assert go(fps=251.0).report.deadline_misses == 59
    assert go(fps=250.0).report.deadline_misses == 0
    assert world.core.settings.deadline_ns == 0


def test_a_governor_is_reported_with_its_energy(world: World) -> None:
    """2 W at 250 frames a second are 8 mJ a frame."""
    temperature = {"kind": "modelled"}
    governor: Any = SimpleNamespace(
        is_prompt=False, power_w=2.0, report=lambda: {"caps": {"how": "told"}, "temperature_c": temperature}
    )
    report = go(governor=governor).report
    assert ("awake", False) in world.steps
    assert report.caps is not None and report.caps.how == "told"
    assert report.temperature_c is not None and report.temperature_c.kind == "modelled"
    assert report.xrbench.energy == pytest.approx(energy_score(8.0))
    governor.power_w = None
    assert go(governor=governor).report.xrbench.energy is None
    governor.power_w = 2.0
    assert go(1, governor=governor).report.xrbench.energy is None  # one frame has no rate


def test_a_ladder_of_work_is_measured_before_a_run_at_a_rate(world: World) -> None:
    """Four frames of nine, on both rungs, before the loop, which is told of it. Without a rate there is no ladder."""
    result = go(9, policy="latest", fps=50.0, works=(1000, 250), follow=("mid",))
    assert world.steps.index(("rungs", [0, 2, 4, 6], 2, ("mid",))) < world.steps.index("loop")
    assert world.first == [StageAlone("mid", 0, 3 * MS), StageAlone("mid", 1, 2 * MS)]
    assert (world.core.settings.works, world.core.settings.follow) == ((1000, 250), ("mid",))
    assert (result.rungs, result.rung_switches) == ({0: 9}, 0)
    world.first.clear()
    without = go(9, works=(1000, 250), follow=("mid",))
    assert (world.first, world.core.ladder, without.rungs) == ([], None, {})


def test_what_a_clock_is_given(world: World) -> None:
    governor: Any = SimpleNamespace(is_prompt=True, power_w=None, report=dict)
    progress: Any = "progress"
    go(governor=governor, on_progress=progress)
    assert world.others == (None, governor, "progress", None)


def test_a_run_that_was_interrupted_says_so(world: World) -> None:
    world.told = {"outcome": Outcome(OutcomeKind.STOPPED), "interrupts": 1}
    result = go()
    assert result.interrupted
    assert world.steps[-1] == "close"
    world.told["interrupts"] = 0
    assert not go().interrupted  # it was its requests' end that stopped it


def test_a_run_that_was_aborted_closes_nothing(world: World) -> None:
    world.told = {"outcome": Outcome(OutcomeKind.ABORTED), "interrupts": 2}
    assert go().interrupted
    assert "close" not in world.steps


def test_a_unit_that_cannot_be_kept_alive_is_named(world: World) -> None:
    world.told = {"outcome": Outcome(OutcomeKind.GAVE_UP, "right"), "interrupts": 1}
    result = go()
    assert result.failure is not None
    assert result.failure.message == "unit right could not be kept alive: right is broken"
    assert not result.interrupted
    assert world.steps[-1] == "close"


def test_settings_that_make_no_sense(world: World) -> None:
    with pytest.raises(BadInputError, match=r"^the run's settings: found policy 'warp', expected one of"):
        go(policy="warp")
    with pytest.raises(BadInputError, match="frames: found 0"):
        go(0)
    assert "start" not in [step[0] for step in world.steps]


def test_settings_reach_the_core(world: World) -> None:
    go(3, policy="deadline", fps=50.0, latch_ms=2.5, hang_ns=7 * MS * 1000)
    settings = world.core.settings
    assert (settings.period_ns, settings.deadline_ns, settings.latch_ns) == (20 * MS, 60 * MS, 2_500_000)
    assert settings.hang_ns == 7 * MS * 1000
    go(3, pace_fps=100.0)
    assert (world.core.settings.policy, world.core.settings.period_ns) == ("pipelined", 10 * MS)


def test_frames_that_will_not_come_are_told_once() -> None:
    told: list[Any] = []
    queue = FrameRequestQueue(lambda _: None, lambda: None, told.append)
    for causes in ({}, {"raster->infer:stale": 1}, {"raster->infer:stale": 2}):
        queue.tell_unanswered(causes)
    queue.close()
    assert told == [{"raster->infer:stale": 1}]


def test_memory_and_processes_are_closed_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Units first, then the slots, the assets and, where the run made it, the fork server."""
    steps: list[Any] = []

    def part(name: str) -> Any:
        @contextlib.contextmanager
        def entered(*arguments: Any) -> Iterator[str]:
            steps.append((name, *arguments))
            yield name
            steps.append(f"{name} closed")

        return entered

    class Units:
        def __init__(self, *arguments: Any) -> None:
            steps.append(("units", *arguments))

        def close(self) -> None:
            steps.append("units closed")

    monkeypatch.setattr(surroundings, "UnitStarter", part("server"))
    monkeypatch.setattr(surroundings, "edge_regions", part("regions"))
    monkeypatch.setattr(surroundings, "share_assets", lambda assets: steps.append(("assets", assets)) or 77)
    monkeypatch.setattr(os, "close", lambda fd: steps.append(("close", fd)))
    assets: Any = {"a": 1}
    kind: Any = Units
    with surroundings.unit_processes(PIPELINE, assets, None, kind) as processes:
        steps.append("inside")
    assert isinstance(processes, Units)
    made = [("assets", assets), ("regions", PIPELINE)]
    ended = ["inside", "units closed", "regions closed", ("close", 77)]
    begun = [("server", PIPELINE.preload), *made, ("units", PIPELINE, "regions", 77, "server")]
    assert steps == [*begun, *ended, "server closed"]
    steps.clear()
    starter: Any = "mine"
    with surroundings.unit_processes(PIPELINE, assets, starter, kind):
        steps.append("inside")
    assert steps == [*made, ("units", PIPELINE, "regions", 77, "mine"), *ended]
