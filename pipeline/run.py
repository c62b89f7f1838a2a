"""Runs a pipeline on this machine. Rule: whatever happens, the units' processes are gone when `run_pipeline` returns.

A run with a journal keeps at most MOST_EXACT times of each kind. Percentiles of more times come from the library
ddsketch, within RELATIVE_ERROR of the exact values. Source: Masson, Rim, Lee, "DDSketch: A Fast and Fully-Mergeable
Quantile Sketch with Relative-Error Guarantees", PVLDB 12 (2019). The sketch counts values in bins. Each bin is wider
than the bin before by the same factor, so each value is known within this factor. The _BINS bins reach from a
nanosecond to 19 years.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from ddsketch import LogCollapsingLowestDenseDDSketch

from trilane.errors import BadInputError, UnwrittenError
from trilane.machine import awake
from trilane.pipeline.controls import FrameRequestQueue, Interrupts, RunControls
from trilane.pipeline.description import Pipeline
from trilane.pipeline.memory import BYTES, Assets, add_bytes
from trilane.pipeline.realtime_clock import ClockGovernor, RealtimeClock, add_accounts
from trilane.pipeline.rehearsal import Chain, on_rungs
from trilane.pipeline.result import JournalFile, RunLog, RunRecord, RunResult, recorded
from trilane.pipeline.run_metrics import ProcessorState, RunMetrics
from trilane.pipeline.surroundings import (
    beside_units,
    check_cores,
    check_open_files,
    check_positive,
    on_cores,
    processor_of,
    prompt_answers,
    refuse_in_a_unit,
    unit_processes,
)
from trilane.pipeline.unit_processes import UnitProcesses, close_units, start_units
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.core import Core, run_loop
from trilane.scheduler.events import HANG_NS, Abort, Outcome, OutcomeKind, Settings
from trilane.scheduler.ledger import Books
from trilane.scheduler.policy import run_settings
from trilane.scheduler.stats import MOST_EXACT, energy_score
from trilane.unexpected_value import UnexpectedValue
from trilane.units import NS_PER_MS, NS_PER_S, TARGET_FPS

RELATIVE_ERROR = 0.005
_BINS = 4096
EXACT = "exact"
SKETCHED = f"of more than {MOST_EXACT} samples by ddsketch, within {RELATIVE_ERROR:.1%}; of fewer exact"


class DdSketch:
    """A `trilane.scheduler.stats.Sketch` of values that are not negative."""

    def __init__(self) -> None:
        self._sketch = LogCollapsingLowestDenseDDSketch(RELATIVE_ERROR, _BINS)

    def add(self, value: int) -> None:
        self._sketch.add(value)

    def percentile(self, share: float) -> float:
        return self._sketch.get_quantile_value(share) or 0.0


FRAMES_ON_RUNGS = 4  # frames that measure each rung before the run; the first one warms up


class ReportingGovernor(ClockGovernor, Protocol):
    """The governor of a run, which also reports power, temperatures and caps."""

    @property
    def is_prompt(self) -> bool:
        """Whether idle cores should stay awake, so that a message wakes a unit sooner."""

    @property
    def power_w(self) -> float | None:
        """The mean power of the run so far in watts; None if it is not known."""

    @property
    def temperatures_c(self) -> Mapping[str, float]:
        """The temperatures on which the governor's decisions depend, in degrees Celsius, by name."""

    def report(self) -> dict[str, Any]:
        """Return the keys `caps` and `temperature_c` of report.json with their values."""


def run_pipeline(
    pipeline: Pipeline,
    frames: int,
    *,
    policy: str = "pipelined",
    fps: float = TARGET_FPS,
    pace_fps: float | None = None,
    assets: Assets | None = None,
    hang_ns: int = HANG_NS,
    latch_ms: float = 0.0,
    works: tuple[int, ...] = (),
    follow: tuple[str, ...] = (),
    settings: Settings | None = None,
    requests: FrameRequestQueue | None = None,
    controls: RunControls | None = None,
    governor: ReportingGovernor | None = None,
    journal: JournalFile | None = None,
    starter: UnitStarter | None = None,
    on_progress: Callable[[int, int], None] | None = None,
    on_message: Callable[[str], None] | None = None,
) -> RunResult:
    """Run `frames` frames through the units of `pipeline`, and return the result.

    `policy`: name in `trilane.scheduler.policy.POLICIES`.
    `fps`: target rate in frames a second. If frames have no deadline, a frame time above 1 / `fps` counts as a missed
    deadline.
    `pace_fps`: rate at which frames are released, in frames a second. None: under `latest` and `deadline` frames are
    released at the rate `fps`, under other policies as soon as they can be taken.
    `assets`: arrays that every stage may read.
    `hang_ns`: longest time of a job in ns; a unit whose job takes longer is restarted.
    `latch_ms`: margin in ms by which the first stage should end before the second can take its frame; 0: the first
    stage begins at once.
    `works`: work of each rung of a ladder in thousandths of all the work, from 1000 downwards; empty: no ladder. A
    ladder counts only if frames are released at a rate. A frame that would be late gets less work
    (`trilane.scheduler.policy`), and the first stage gets the rung (`SteppedStage`).
    `follow`: names of the stages that take less time for less work.
    `settings`: settings of the scheduler, which replace all parameters above but `pipeline`, `fps` and `assets`.
    `requests`: queue of frame requests, at most `frames` in sum; this function closes it.
    `controls`: requests to the run; this function closes them. With `controls` or `requests`, only released frames
    count as requested in the report.
    `governor`: governor that holds the units to shares of the time, and adds caps and temperatures to the report.
    `journal`: file that records the run while it goes on. With a journal, `RunResult.recording` and `RunResult.jobs`
    stay empty; without one, they have all steps and jobs.
    `starter`: fork server that was started earlier; None: one is made for this run.
    `on_progress(presented, requested)`: function that is called, in this thread, with numbers of frames.
    `on_message(text)`: function that is called, in this thread, with each message about a problem.

    In the main thread, SIGINT and the other signals of `trilane.signals.that_end` end the run cleanly; its result is
    `interrupted`. A second signal ends the units at once. Before the first frame, a signal raises KeyboardInterrupt.

    Raises BadInputError for bad settings, and if a unit's process calls this function. Raises TrilaneError, with the
    exit code of the unit's error, if a unit cannot start; a later failure is in `RunResult.failure`.
    """
    refuse_in_a_unit()
    check_open_files()
    check_cores(pipeline)
    if settings is None:
        settings = _settings(policy, frames, fps, pace_fps, hang_ns, latch_ms, requests)
        if works and settings.period_ns:  # without a rate no frame can be late
            settings = replace(settings, works=works, follow=follow)
        target_ns = 0 if settings.deadline_ns else round(NS_PER_S / fps)
    else:
        target_ns = 0 if settings.deadline_ns else settings.period_ns or round(NS_PER_S / fps)
    if not pipeline.graph().is_chain and (settings.latch_ns or settings.works or requests is not None):
        expected = "a chain of stages, or none of latching, a ladder of work and requests for frames"
        raise BadInputError("the run's settings", "a pipeline with stages that have a list of inputs", expected)
    with recorded(journal, pipeline.graph(), settings, governor, target_ns) as record:
        log = RunLog(record.say, *([on_message] if on_message is not None else []))
        with (
            contextlib.closing(requests) if requests is not None else contextlib.nullcontext(),
            contextlib.closing(controls) if controls is not None else contextlib.nullcontext(),
            Interrupts() as interrupts,
            on_cores(pipeline.scheduler_cores),
            prompt_answers(),
            awake(governor is None or governor.is_prompt) as idle_cores,
            unit_processes(pipeline, assets or {}, starter, UnitProcesses) as processes,
        ):
            # A run with a journal may last for days, so the ledger keeps sketches instead of all values.
            sketch = None if journal is None else DdSketch
            core = Core(pipeline.graph(), settings, Books(target_ns, sketch))
            clock = RealtimeClock(core, processes, interrupts, log, requests, governor, on_progress, sketch, controls)
            run = _Run(core, clock, processes, interrupts, log, record, pipeline.run_cores, pipeline.warms_up)
            run.execute()
        is_open = requests is not None or controls is not None
        report = core.report(clock="host", requested=core.source.released if is_open else None)
        report["percentiles"] = EXACT if core.ledger.is_exact else SKETCHED
        report.update(policy=settings.policy, edge=pipeline.rule, idle_cores=idle_cores)
        report.update(other_programs=run.other_programs, processor=run.processor)
        if governor is not None:
            report.update(governor.report())
            if governor.power_w is not None and report["fps"]:
                report["xrbench"]["energy"] = energy_score(1e3 * governor.power_w / report["fps"])
        for unit, row in report["units"].items():
            row.update(pid=run.pids[unit], **pipeline.units[unit].model_dump(mode="json"))
        report.update(record.reckoned(pipeline.places()).figures)
        add_accounts(report, pipeline, clock.cpu, log)
        add_bytes(report, clock.metrics)
        metrics = RunMetrics.model_validate(report)
        record.end(metrics.as_json())
        if record.failure is not None:
            log.fail(str(record.failure))
    return run.result(metrics)


class _Run:
    """The steps of one run: start the units, warm up with a frame, run the scheduler's loop, close."""

    def __init__(
        self,
        core: Core,
        clock: RealtimeClock,
        processes: UnitProcesses,
        interrupts: Interrupts,
        log: RunLog,
        record: RunRecord,
        cores: Sequence[int],
        warms_up: bool,
    ) -> None:
        self._core, self._clock, self._processes, self._cores = core, clock, processes, cores
        self._warms_up = warms_up and core.graph.is_chain  # a graph's stages may count their calls
        self._interrupts, self._log, self._record = interrupts, log, record
        self.pids: dict[str, int] = {}
        self.other_programs: float | None = None
        self.processor: ProcessorState | None = None
        self._startup_ms: dict[str, float] = {}
        self._outcome = Outcome(OutcomeKind.ABORTED)

    def execute(self) -> None:
        """Do all steps of the run. Raises as `run_pipeline` does."""
        self._startup_ms = start_units(self._processes, self._core.graph.units, self._interrupts)
        self.pids = self._processes.pids
        graph, settings = self._core.graph, self._core.settings
        if self._warms_up:
            # The last stage writes files, so the frames before the run leave it out.
            chain = Chain(graph, dict.fromkeys(graph.units, self._processes), self._interrupts, whole=False)
            if settings.works:
                count = min(FRAMES_ON_RUNGS, settings.frames)
                few = [index * settings.frames // count for index in range(count)]
                self._clock.first += on_rungs(chain, few, len(settings.works), settings.follow)
            chain.frame(0)
        others, processor = beside_units(self._cores, self.pids), processor_of(self._cores)
        self._record.begin(self._clock, lambda: self._processes.pids)
        try:
            self._outcome = run_loop(self._core, self._clock, self._record)
        except UnwrittenError:  # the record keeps it as its `failure`
            self._core.step(self._core.now_ns, (Abort(),))
        self.other_programs, self.processor = others(self._processes.pids), processor()
        self._clock.finish()
        if self._outcome.kind is OutcomeKind.GAVE_UP:
            unit = self._outcome.unit
            self._log.fail(f"unit {unit} could not be kept alive{self._processes.why_ended(unit)}")
        self.pids = {**self.pids, **self._processes.pids}
        if self._outcome.kind is not OutcomeKind.ABORTED:
            close_units(self._processes, self._log, self._interrupts)

    def result(self, report: RunMetrics) -> RunResult:
        ledger, reported = self._core.ledger, self._clock.reported
        stopped = self._outcome.kind in (OutcomeKind.STOPPED, OutcomeKind.ABORTED)
        return RunResult(
            report=report,
            requested=report.frames.requested,
            presented=ledger.presented_count,
            lost=dict(ledger.lost),
            dropped=dict(ledger.dropped),
            pids=self.pids,
            startup_ms=self._startup_ms,
            jobs=tuple(self._record.jobs),
            recording=self._record.recording,
            metrics={
                stage: {name: total / reported[stage][name] for name, total in sums.items() if name not in BYTES}
                for stage, sums in self._clock.metrics.items()
            },
            rungs=dict(ledger.rungs) if self._core.ladder is not None else {},
            rung_switches=ledger.rung_switches,
            messages=tuple(self._log.messages),
            interrupted=stopped and self._interrupts.count > 0,
            failure=self._log.failure,
        )


def _settings(
    policy: str,
    frames: int,
    fps: float,
    pace_fps: float | None,
    hang_ns: int,
    latch_ms: float,
    requests: FrameRequestQueue | None,
) -> Settings:
    check_positive(frames=frames, fps=fps, pace_fps=pace_fps, hang_ns=hang_ns)
    try:
        return run_settings(
            policy,
            frames,
            round(NS_PER_S / fps),
            round(NS_PER_S / pace_fps) if pace_fps else 0,
            hang_ns=hang_ns,
            asked=requests is not None,
            latch_ns=round(latch_ms * NS_PER_MS),
        )
    except UnexpectedValue as error:
        raise BadInputError.at("the run's settings", error) from None
