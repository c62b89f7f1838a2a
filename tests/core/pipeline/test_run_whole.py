"""A whole run on a clock of virtual time: what it reports, what its journal has, and a journal that fails."""

from __future__ import annotations

import contextlib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from support.small_pipeline import pipeline
from trilane.errors import BadInputError, UnwrittenError
from trilane.pipeline import realtime_clock, run
from trilane.pipeline.journal import (
    Accounted,
    Begun,
    Counted,
    Ended,
    JournalWriter,
    Said,
    Sampled,
    Stepped,
    Stopped,
    Worked,
    read_journal,
)
from trilane.pipeline.realtime_clock import CpuTimes
from trilane.pipeline.result import JournalFile, RunResult
from trilane.pipeline.run import DdSketch
from trilane.pipeline.run_metrics import ProcessorState, RunMetrics
from trilane.scheduler.events import Outcome, OutcomeKind, Settings, StageAlone
from trilane.scheduler.virtual import VirtualDriver
from trilane.transport.messages import Done

MS = 1_000_000
STAGE_NS = {"in": MS, "mid": 4 * MS, "out": MS}
PIPELINE = pipeline().with_rule("double")


@dataclass
class World:
    """In place of everything round a run. `outcome`: of its loop, None: the true one; `first`: what its core hears."""

    outcome: Outcome | None = None
    first: list[Any] = field(default_factory=list)
    core: Any = None

    def processes(self, *_: Any) -> Any:
        pids = {"left": 11, "right": 12}
        return contextlib.nullcontext(SimpleNamespace(pids=pids, why_ended=lambda unit: f": {unit} is broken"))

    def clock(self, core: Any, _processes: Any, _interrupts: Any, _log: Any, *others: Any) -> Any:
        self.core, self.others = core, others
        driver = VirtualDriver(core.graph, core.settings, lambda stage, *_: STAGE_NS[stage], keep=True)
        driver.core = core
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

            def stopped(self) -> list[Stopped]:
                return []

        return Clock(cpu=cpu, finish=lambda: None, driver=driver, **said)

    def run_loop(self, core: Any, clock: Any, recording: Any) -> Outcome:
        outcome = run_loop(core, clock.driver, recording)
        return self.outcome or outcome


def rungs(_chain: Any, frames: list[int], rungs: int, follow: tuple[str, ...]) -> list[StageAlone]:
    """On rung n a stage takes so many ms fewer than there are frames."""
    return [StageAlone(stage, rung, (len(frames) - rung) * MS) for stage in follow for rung in range(rungs)]


run_loop = run.run_loop


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    world = World()

    for name, part in (
        ("check_cores", lambda _pipeline: None),
        ("on_cores", contextlib.nullcontext),
        ("unit_processes", world.processes),
        ("prompt_answers", contextlib.nullcontext),
        ("awake", lambda _prompt: contextlib.nullcontext("kept awake")),
        ("Interrupts", lambda: contextlib.nullcontext(SimpleNamespace(count=0))),
        ("RealtimeClock", world.clock),
        ("Chain", lambda *_, **__: SimpleNamespace(frame=lambda _number: None)),
        ("on_rungs", rungs),
        ("run_loop", world.run_loop),
        ("start_units", lambda *_: {"left": 1.5, "right": 2.5}),
        ("close_units", lambda *_: None),
        ("beside_units", lambda cores, pids: lambda now: 0.25 if (cores, pids == now) == ((0, 1, 3), True) else None),
        ("processor_of", lambda cores: lambda: ProcessorState(throttles=len(cores))),
    ):
        monkeypatch.setattr(run, name, part)
    monkeypatch.setattr(realtime_clock, "counts_run_delay", lambda: True)
    return world


def go(frames: int = 60, **options: Any) -> RunResult:
    return run.run_pipeline(PIPELINE, frames, **options)


@pytest.mark.usefixtures("world")
def test_the_report_of_a_run() -> None:
    """mid, on the right, takes the 4 ms of a frame."""
    result = go()
    assert (result.requested, result.presented, result.lost, result.dropped) == (60, 60, {}, {})
    assert (result.pids, result.startup_ms) == ({"left": 11, "right": 12}, {"left": 1.5, "right": 2.5})
    assert (len(result.jobs), result.messages, result.interrupted, result.failure) == (180, (), False, None)
    assert result.metrics == {"mid": {"visible": 0.3}, "none": {"x": 5.0}}
    assert result.recording.steps and result.recording.settings == Settings(60, "pipelined", hang_ns=10_000_000_000)
    report = result.report
    assert (report.clock, report.policy, report.edge) == ("host", "pipelined", "double")
    assert report.idle_cores == "kept awake"
    assert (report.frame_time_ms.mean, report.other_programs) == (4.0, 0.25)
    assert report.processor == ProcessorState(throttles=3)
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
    assert world.others[-2] is DdSketch and result.report.percentiles == kept.report.percentiles == "exact"
    begun, *records, ended = read_journal(tmp_path / "j")
    assert isinstance(begun, Begun)
    assert (begun.graph, begun.settings, begun.facts["made"]) == (PIPELINE.graph(), kept.recording.settings, "today")
    assert (begun.facts["clock"], begun.facts["began_at"][-6:]) == ("host", "+00:00")
    assert begun.facts["target_period_ns"] == round(1e9 / 30)
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
    assert isinstance(ended, Ended) and RunMetrics.model_validate(ended.report) == result.report


def test_messages_and_frames_left_out_are_in_the_journal(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(realtime_clock, "counts_run_delay", lambda: False)
    governor: Any = SimpleNamespace(is_prompt=True, power_w=None, report=dict, temperatures_c={"device": 30.0})
    go(journal=JournalFile(tmp_path / "j", {}), policy="latest", fps=2000.0, governor=governor)
    records = list(read_journal(tmp_path / "j"))
    assert [each.text for each in records if isinstance(each, Said)] == [realtime_clock.NO_RUN_DELAY]
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


def test_a_ladder_of_work_is_measured_before_a_run_at_a_rate(world: World) -> None:
    """Four frames of nine, on both rungs. Without a rate there is no ladder."""
    result = go(9, policy="latest", fps=50.0, works=(1000, 250), follow=("mid",))
    assert world.first == [StageAlone("mid", 0, 4 * MS), StageAlone("mid", 1, 3 * MS)]
    assert (world.core.settings.works, world.core.settings.follow) == ((1000, 250), ("mid",))
    assert (result.rungs, result.rung_switches) == ({0: 9}, 0)
    world.first.clear()
    without = go(9, works=(1000, 250), follow=("mid",))
    assert (world.first, world.core.ladder, without.rungs) == ([], None, {})


def test_a_unit_that_cannot_be_kept_alive_is_named(world: World) -> None:
    world.outcome = Outcome(OutcomeKind.GAVE_UP, "right")
    result = go()
    assert result.failure is not None
    assert result.failure.message == "unit right could not be kept alive: right is broken"
