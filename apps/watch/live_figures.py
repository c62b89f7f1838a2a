"""Computes the figures of a run at any moment, from its growing journal.

Rule: `LiveFigures` reads neither files nor clocks. All times of the last `WINDOW_NS` are kept, so that their
percentiles are exact. For the whole run, only sums and counts are kept. The time of a unit is divided as in the ledger
(scheduler/ledger.py). Time in which a job was assigned, but neither ran nor was preempted, is overhead. `looks` yields
the figures repeatedly until a live run ends, and once for a finished run.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Generator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

from trilane.apps.run.report import REPORT_FILE, read_report
from trilane.apps.run.verdict import Verdict, judged
from trilane.apps.run.verdict_facts import facts_of, facts_so_far, verdict_of
from trilane.apps.watch.figures import (
    DropCount,
    FrameFigures,
    MomentFigures,
    Moved,
    Note,
    Shares,
    StageFigures,
    TimeHistogram,
    UnitFigures,
)
from trilane.apps.watch.followed_run import EXPECTED, NO_RECORD, FollowedRun, RunState
from trilane.errors import BadInputError
from trilane.pipeline.journal import (
    Accounted,
    Begun,
    Counted,
    Ended,
    Record,
    Said,
    Sampled,
    Stepped,
    Worked,
    config_of,
    target_period_ns,
)
from trilane.pipeline.reckoning import Reckoning, places_of
from trilane.pipeline.run_metrics import RunMetrics, metrics_in
from trilane.pipeline.timeline import EndedJob, ExplainedJob, Presented, Timeline
from trilane.pipeline.unit_history import BUSY, JOIN, OVERHEAD, PREEMPTED
from trilane.scheduler.events import NEVER, Finish, JobDone, Start
from trilane.scheduler.ledger import NAMES, STARVED, idle_causes
from trilane.scheduler.stats import due_ns, summary_ms
from trilane.units import COMPUTED, MEASURED, NS_PER_MS, NS_PER_S

WINDOW_NS: Final = 5_000_000_000
WINDOW: Final = f"last {WINDOW_NS / NS_PER_S:g} s"
MOST_NOTES = 5
BYTES, LEAST = "bytes_", "least"  # prefix of a stage's metrics of bytes moved; the kind of the least bytes
LEAST_KEY = f"stages.*.bytes.{LEAST}"
TEMPERATURE, DUTY, MEMORY = "temperature_c.", "duty.", "memory_bytes."
SENSOR = "sensor"  # place with this machine's measured temperature; the temperatures of other places are modelled
#: Keys that are measured in a run on the host clock, and computed on the virtual clock.
OF_THE_RUN = (
    "fps",
    "run_fps",
    "frame_time_ms",
    "latency_ms",
    "frames",
    "units",
    "stages",
    "frame_times",
    "latencies",
    "bound",
    "memory_bytes",
)
ASSIGNED = "assigned"
PARTS = (ASSIGNED, *NAMES.values(), BUSY, PREEMPTED)


class LiveFigures:
    """Collects the figures of a run. `add` takes the records after `begun`, in order; `now` returns the figures.

    `begun`: first record of the journal.
    `finds_bound`: whether to find the bound of the run, which takes three times as long as all else. A finished run
    needs no search, because the last record of its journal has the bound.
    """

    def __init__(self, begun: Begun, *, finds_bound: bool = True) -> None:
        self._graph, self._facts, self._settings = begun.graph, begun.facts, begun.settings
        self._timeline = line = Timeline(begun.graph, begun.settings, waits=finds_bound)
        self._reckoning = Reckoning(begun.graph, begun.settings, places_of(begun), line) if finds_bound else None
        self._begun = begun
        self._report: RunMetrics | None = None
        self._late, self._target_ns = 0, target_period_ns(begun)
        self._first_ns: int | None = None
        self._last_ns = 0
        self._finished_ns = NEVER
        self._times: dict[str, _UnitTime] = {}
        self._jobs, self._restarts = Counter[str](), Counter[str]()
        self._stages = {stage.name: _StageBook() for stage in begun.graph.stages}
        self._recent: deque[Presented] = deque()
        self._between_ns = self._intervals = 0
        self._frame_times, self._latencies = TimeHistogram(), TimeHistogram()
        self._lost: Mapping[str, int] = {}
        self._dropped: Mapping[str, int] = {}
        self._sampled: dict[str, float] = {}
        self._notes: deque[Note] = deque(maxlen=MOST_NOTES)
        self._adders: dict[type[Any], Callable[[Any], None]] = {
            Stepped: self._add_step,
            Accounted: self._add_account,
            Worked: self._add_work,
            Counted: self._add_counts,
            Sampled: self._add_sample,
            Said: self._add_note,
            Ended: self._add_end,
        }

    @property
    def last_ns(self) -> int:
        """Return the time of the last step or of the run's end, ns; 0 before the first step."""
        return self._last_ns

    @property
    def is_over(self) -> bool:
        """Return whether the last record of the run was added."""
        return self._report is not None

    def add(self, record: Record) -> None:
        """Add the next record of the journal after `begun`."""
        facts = self._timeline.add(record)
        self._adders[type(record)](record)
        for fact in facts:
            if isinstance(fact, EndedJob):
                self._jobs[fact.handed.job.unit] += 1
                self._times[fact.handed.job.unit].add_job(fact.event)
            elif isinstance(fact, Presented):
                self._add_presented(fact)
            elif isinstance(fact, ExplainedJob) and self._reckoning is not None:
                self._reckoning.add(fact)

    def now(self, now_ns: int | None = None, state: RunState | None = None) -> MomentFigures:
        """Return the figures at a time of the run's clock.

        `now_ns`: the time; None for `last_ns`. A time before `last_ns` counts as `last_ns`. A time after the step that
        finished the run counts as the time of this step.
        `state`: state of the run, because the journal of a killed run does not show it; None to take the state from the
        journal.
        """
        now_ns = min(max(now_ns or 0, self._last_ns), self._finished_ns)
        start_ns = now_ns if self._timeline.start_ns is None else self._timeline.start_ns
        window_s = min(now_ns - start_ns, WINDOW_NS) / NS_PER_S
        recent = [each for each in self._recent if each.end_ns > now_ns - WINDOW_NS]
        clock = str(self._facts.get("clock", ""))
        state = state or (RunState.FINISHED if self.is_over else RunState.GOES_ON)
        goes_on = state is RunState.GOES_ON and not self.is_over
        run_fps = self._run_fps()
        figures = MomentFigures(
            t_ms=self._since_first_ms(now_ns),
            window_s=window_s,
            run_s=(now_ns - start_ns) / NS_PER_S,
            clock=clock,
            is_over=self.is_over,
            state=state.value,
            fps=run_fps if state is RunState.FINISHED else len(recent) / window_s if window_s else 0.0,
            run_fps=run_fps,
            frame_time_ms=summary_ms(each.interval_ns for each in recent if each.interval_ns is not None),
            latency_ms=summary_ms(each.latency_ns for each in recent if each.latency_ns is not None),
            frames=self._frame_figures(),
            units={unit: self._unit_figures(unit, now_ns, goes_on) for unit in self._graph.units},
            stages=self._stage_figures(now_ns),
            temperature_c=self._values(TEMPERATURE),
            duty=self._values(DUTY),
            memory_bytes=self._values(MEMORY),
            notes=tuple(self._notes),
            bound=(self._report and self._report.bound) or (self._reckoning.bound if self._reckoning else None),
            verdict=None,
            frame_times=self._frame_times.now(),
            latencies=self._latencies.now(),
            began_at=str(self._facts.get("began_at", "")),
            accuracy=self._facts.get("accuracy") or {},
            sources=self._sources(clock),
        )
        return replace(figures, verdict=self._verdict(figures) if self._timeline.presented > 1 else None)

    def _verdict(self, figures: MomentFigures) -> Verdict:
        """Return the verdict on the run so far. For a run that is over, the figures in its last record decide."""
        config = config_of(self._begun)
        if self._report is not None:
            return judged(facts_of(self._report, config, figures.accuracy))
        return judged(facts_so_far(figures, self._late, config, self._settings.policy))

    # records

    def _add_step(self, step: Stepped) -> None:
        self._last_ns = step.now_ns
        if self._first_ns is None:
            self._first_ns = step.now_ns
        if not self._times and self._timeline.start_ns is not None:
            units = self._timeline.units.values()
            self._times = {unit.name: _UnitTime(step.now_ns, WINDOW_NS, unit.account) for unit in units}
        for action in step.actions:
            if type(action) is Start:
                self._restarts[action.unit] += 1
            elif type(action) is Finish:
                self._finished_ns = step.now_ns

    def _add_presented(self, presented: Presented) -> None:
        if presented.interval_ns is not None:
            self._frame_times.add(presented.interval_ns)
            self._between_ns += presented.interval_ns
            self._intervals += 1
        if presented.latency_ns is not None:
            self._latencies.add(presented.latency_ns)
        deadline_ns = self._settings.due_from_ns(presented.release_ns)
        self._late += presented.end_ns > due_ns(deadline_ns, presented.before_ns, self._target_ns)
        self._recent.append(presented)
        while self._recent[0].end_ns < presented.end_ns - WINDOW_NS:
            self._recent.popleft()

    def _add_account(self, entry: Accounted) -> None:
        if entry.unit in self._times:
            self._times[entry.unit].enter(entry.now_ns, entry.account)

    def _add_work(self, work: Worked) -> None:
        job = work.job
        moved = {name.removeprefix(BYTES): value for name, value in work.figures.items() if name.startswith(BYTES)}
        self._stages[job.stage].add(_Work(job.end_ns, job.end_ns - job.begin_ns, moved))

    def _add_counts(self, counts: Counted) -> None:
        self._lost, self._dropped = counts.lost, counts.dropped

    def _add_sample(self, sample: Sampled) -> None:
        self._sampled.update(sample.values)

    def _add_note(self, said: Said) -> None:
        self._notes.append(Note(self._since_first_ms(said.now_ns), said.text))

    def _add_end(self, ended: Ended) -> None:
        self._last_ns = max(self._last_ns, ended.now_ns)
        self._report = metrics_in(ended.report, "the journal, last record")

    # figures

    @property
    def has_frames(self) -> bool:
        """Whether the run has presented a frame."""
        return self._timeline.presented > 0

    def _since_first_ms(self, now_ns: int) -> float:
        return 0.0 if self._first_ns is None else (now_ns - self._first_ns) / NS_PER_MS

    def _run_fps(self) -> float | None:
        return self._intervals * NS_PER_S / self._between_ns if self._between_ns else None

    def _frame_figures(self) -> FrameFigures:
        line = self._timeline
        dropped = tuple(_drop_count(key, count) for key, count in self._dropped.items())
        counts = (self._settings.frames, line.presented, line.skipped, len(line.frames), line.not_begun)
        return FrameFigures(*counts, dict(self._lost), dropped)

    def _unit_figures(self, name: str, now_ns: int, goes_on: bool) -> UnitFigures:
        unit = self._timeline.units[name]
        held = unit.held[0] if unit.held else None
        times = self._times.get(name) or _UnitTime(now_ns, WINDOW_NS)
        window, run = times.shares(now_ns, held and held.at_ns)
        stage, frame = (held.job.stage, held.job.frame) if held else ("", -1)
        return UnitFigures(window, run, self._jobs[name], self._restarts[name], goes_on and unit.is_up, stage, frame)

    def _stage_figures(self, now_ns: int) -> dict[str, StageFigures]:
        line = self._timeline
        return {
            stage.name: self._stages[stage.name].now(
                stage.unit, 0 if line.is_over else len(line.waiting(stage.name)), now_ns - WINDOW_NS
            )
            for stage in self._graph.stages
        }

    def _values(self, prefix: str) -> dict[str, float]:
        return {name.removeprefix(prefix): value for name, value in self._sampled.items() if name.startswith(prefix)}

    def _sources(self, clock: str) -> dict[str, str]:
        """Return the source of the figures below each key. If several keys fit a figure, the longest key decides."""
        sources = dict.fromkeys(OF_THE_RUN, COMPUTED if clock == "virtual" else MEASURED)
        sources |= {
            LEAST_KEY: COMPUTED,
            "temperature_c": COMPUTED,
            f"{TEMPERATURE}{SENSOR}": MEASURED,
            "duty": COMPUTED,
        }
        accuracy = self._facts.get("accuracy") or {}
        return sources | {f"accuracy.{name}": facts["source"] for name, facts in accuracy.items() if "source" in facts}


class RunLook(NamedTuple):
    """A look at a run at one moment: its final name, its state and its figures."""

    name: str
    state: RunState
    figures: MomentFigures

    def as_json(self) -> dict[str, Any]:
        """Return the fields of `MomentFigures`, and the name of the run as `run`, ready for JSON."""
        return {"run": self.name, **self.figures.as_json()}


def looks(run: FollowedRun, pause: Callable[[], None]) -> Generator[RunLook]:
    """Yield a look at `run` now, and after every call of `pause` until the run has ended.

    Raises BadInputError for a broken journal or report, or if the run has ended and its journal has no record.
    """
    figures: LiveFigures | None = None
    while True:
        state = run.state  # before the journal is read: the journal of an ended run is complete
        for record in run.new():
            if isinstance(record, Begun):
                figures = LiveFigures(record, finds_bound=state is not RunState.FINISHED)
            elif figures is not None:
                figures.add(record)
        if figures is not None:
            now = figures.now(figures.last_ns + run.silent_ns, state)
            yield RunLook(run.name, state, _as_reported(now, run.folder) if state is RunState.FINISHED else now)
        elif state is not RunState.GOES_ON:
            raise BadInputError(run.folder, NO_RECORD, EXPECTED)
        if state is not RunState.GOES_ON:
            return
        pause()


def _as_reported(figures: MomentFigures, folder: Path) -> MomentFigures:
    """Return `figures` with the verdict of the report in `folder`, because a report has more facts than a journal.

    If `folder` has no report, return `figures` unchanged. Raises BadInputError for a report that cannot be read.
    """
    if not (folder / REPORT_FILE).is_file():
        return figures
    return replace(figures, verdict=verdict_of(read_report(folder), str(folder)))


class _Span(NamedTuple):
    """A span of a unit's time, from `begin_ns` to `end_ns`.

    `name`: the use of the time, one of `PARTS`.
    `ns`: nanoseconds that were used so, at unknown places in the span.
    """

    begin_ns: int
    end_ns: int
    name: str
    ns: int


class _UnitTime:
    """Counts where the time of one unit goes: as sums over the run, and as spans of the newest `window_ns`.

    `begin_ns`: time at which the count begins.
    `window_ns`: length of the window.
    `account`: account of the ledger that is charged from `begin_ns` on.
    """

    def __init__(self, begin_ns: int, window_ns: int, account: int = STARVED) -> None:
        self._begin_ns, self._window_ns = begin_ns, window_ns
        self._state, self._since_ns = NAMES.get(account, ASSIGNED), begin_ns
        self._last_end_ns = 0
        self._spans: deque[_Span] = deque()
        self._totals = dict.fromkeys(PARTS, 0)

    def enter(self, now_ns: int, account: int) -> None:
        """Charge the unit's time from `now_ns` on to `account` of the ledger."""
        self._keep(self._since_ns, now_ns, self._state, now_ns - self._since_ns)
        self._state, self._since_ns = NAMES.get(account, ASSIGNED), now_ns

    def add_job(self, job: JobDone) -> None:
        """Count a job that has ended.

        The time before the job's begin counts as preempted only if the unit had this job and ran no other job.
        """
        begin_ns, end_ns = job.t_begin_ns, job.t_end_ns
        held_from_ns = max(self._last_end_ns, self._since_ns)
        if begin_ns > held_from_ns:
            self._keep(held_from_ns, begin_ns, PREEMPTED, min(job.preempted_before_ns, begin_ns - held_from_ns))
        if end_ns > self._last_end_ns:
            begin_ns = max(begin_ns, self._last_end_ns)
            ran_ns = end_ns - begin_ns
            self._last_end_ns = end_ns
            self._keep(begin_ns, end_ns, BUSY, ran_ns - min(job.preempted_ns + job.asleep_ns, ran_ns))
            self._keep(begin_ns, end_ns, PREEMPTED, min(job.preempted_ns, ran_ns))

    def shares(self, now_ns: int, running_since_ns: int | None) -> tuple[Shares, Shares]:
        """Return two `Shares` of the unit's time, both up to `now_ns`: of the newest `window_ns`, and of the whole run.

        `running_since_ns`: time at which the unit got its present job; None without a job.
        """
        opened = [_Span(self._since_ns, now_ns, self._state, now_ns - self._since_ns)]
        if running_since_ns is not None:
            begin_ns = min(max(running_since_ns, self._last_end_ns, self._since_ns), now_ns)
            opened.append(_Span(begin_ns, now_ns, BUSY, now_ns - begin_ns))
        from_ns = max(now_ns - self._window_ns, self._begin_ns)
        run, window = dict(self._totals), dict.fromkeys(PARTS, 0)
        for span in opened:
            run[span.name] += span.ns
        for begin_ns, end_ns, name, ns in (*self._spans, *opened):
            if begin_ns >= from_ns:
                window[name] += ns
            elif end_ns > from_ns:
                window[name] += ns * (end_ns - from_ns) // (end_ns - begin_ns)
        return _shares(window, now_ns - from_ns), _shares(run, now_ns - self._begin_ns)

    def _keep(self, begin_ns: int, end_ns: int, name: str, ns: int) -> None:
        if ns:
            self._totals[name] += ns
            self._spans.append(_Span(begin_ns, end_ns, name, ns))
            while self._spans[0].end_ns < end_ns - self._window_ns:
                self._spans.popleft()


def _shares(sums: Mapping[str, int], total_ns: int) -> Shares:
    causes = idle_causes(joins=sums[JOIN] > 0)
    if total_ns <= 0:
        return Shares(0.0, dict.fromkeys(causes, 0.0))
    overhead_ns = max(sums[ASSIGNED] - sums[BUSY] - sums[PREEMPTED], 0)  # rounding of cut spans may make it negative
    idle_ns = {**sums, OVERHEAD: overhead_ns}
    return Shares(sums[BUSY] / total_ns, {cause: idle_ns[cause] / total_ns for cause in causes})


class _Work(NamedTuple):
    """An ended job of a stage: time of its end, service time, and moved bytes by kind."""

    end_ns: int
    service_ns: int
    bytes: Mapping[str, float]


class _StageBook:
    """The jobs of one stage.

    `recent`: jobs that ended at most `WINDOW_NS` before the last added job, in the order of adding.
    `bytes`: bytes that all jobs of the run moved, by kind.
    """

    def __init__(self) -> None:
        self.recent: deque[_Work] = deque()
        self.bytes: Counter[str] = Counter()

    def add(self, work: _Work) -> None:
        self.bytes.update(work.bytes)
        self.recent.append(work)
        while self.recent[0].end_ns < work.end_ns - WINDOW_NS:
            self.recent.popleft()

    def now(self, unit: str, waiting: int, from_ns: int) -> StageFigures:
        works = [work for work in self.recent if work.end_ns > from_ns]
        count = max(len(works), 1)
        moved = {
            kind: Moved(float(total), sum(work.bytes.get(kind, 0.0) for work in works) / count)
            for kind, total in sorted(self.bytes.items())
        }
        return StageFigures(unit, waiting, sum(work.service_ns for work in works) / count / NS_PER_MS, moved)


def _drop_count(key: str, frames: int) -> DropCount:
    edge, _, cause = key.rpartition(":")
    return DropCount(edge, cause, frames)
