"""Accounts for the time of each unit: every nanosecond of the run is busy, or idle for one stated cause.

A unit is busy while a job runs. `CAUSES` is the one table of the causes of idle time; all other lists follow from it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from trilane.scheduler.events import NEVER, Drop, Graph, Job, Loss
from trilane.scheduler.stats import FrameTimeSamples, Lateness, Samples, Sketch, due_ns
from trilane.units import NS_PER_S

ASSIGNED: Final = 0
STARVED: Final = 1
BLOCKED: Final = 2
THROTTLED: Final = 3
JOIN: Final = 4
PREEMPTED: Final = "preempted"
OVERHEAD: Final = "overhead"


class IdleCause(NamedTuple):
    """A cause of a unit's idle time.

    `name`: its key in reports and traces.
    `account`: account that gets its time; ASSIGNED for a part of the time in which a job was assigned.
    `meaning`: why the unit is idle, in the dashboard's words.
    `told`: what a comparison says of the unit.
    `joins`: whether only a unit with a stage of several inputs has this cause.
    """

    name: str
    account: int
    meaning: str
    told: str
    joins: bool = False


CAUSES: Final = (
    IdleCause("starved", STARVED, "no input", "is starved"),
    IdleCause("blocked", BLOCKED, "no free slot behind, or as many frames in flight as may be", "is blocked"),
    IdleCause("throttled", THROTTLED, "held by its duty", "is held by its cap"),
    IdleCause(PREEMPTED, ASSIGNED, "it has a job, but another thread has its core", "has no core"),
    IdleCause(
        OVERHEAD,
        ASSIGNED,
        "a job is assigned but does not run yet, or the process is down",
        "waits for messages or its process",
    ),
    IdleCause(
        "join", JOIN, "some inputs of a frame are there, others not", "waits for the other inputs of a frame", True
    ),
)
#: The name of each cause of time without a job, by the account that gets this time.
NAMES: Final = {cause.account: cause.name for cause in CAUSES if cause.account != ASSIGNED}


def idle_causes(*, joins: bool) -> tuple[str, ...]:
    """Return the names of the causes of idle time. `joins`: whether a stage of the unit has several inputs."""
    return tuple(cause.name for cause in CAUSES if joins or not cause.joins)


class FrameLeft(NamedTuple):
    """A frame that left the run.

    `frame`: its number.
    `cause`: report key of the cause of its drop or loss; empty for a presented frame.
    `end_ns`, `latency_ns`, `rung`: as in `Ledger.presented`; 0 for a frame that was not presented.
    """

    frame: int
    release_ns: int
    cause: str = ""
    end_ns: int = 0
    latency_ns: int = 0
    rung: int = 0


class JobRecord(NamedTuple):
    """One finished job; times in ns of the run's clock.

    `ready_ns`: time from which its inputs were there.
    `dispatch_ns`: time of its hand-over to the unit.
    `preempted_ns`, `asleep_ns`, `preempted_before_ns`: as in `JobDone`.
    `cpu_ns`: CPU time of all threads of the unit in the job; 0 in journals older than this field. On the virtual clock,
    it is the service time without preemption.
    """

    stage: str
    unit: str
    frame: int
    ready_ns: int
    dispatch_ns: int
    begin_ns: int
    end_ns: int
    preempted_ns: int = 0
    asleep_ns: int = 0
    preempted_before_ns: int = 0
    cpu_ns: int = 0


class _NewestBook:
    """Ages of the frames that inputs with `latest` took from one stream."""

    def __init__(self, sketch: Callable[[], Sketch] | None) -> None:
        self.age, self.behind = Samples(sketch), Counter[int]()

    def row(self) -> dict[str, Any]:
        taken = sum(self.behind.values())
        frames = sum(behind * count for behind, count in self.behind.items())
        return {
            "age_ms": self.age.summary_ms(),
            "frames_behind": {"mean": frames / taken if taken else 0.0, "max": max(self.behind, default=0)},
        }


class _UnitBook:
    def __init__(self) -> None:
        self.state = STARVED
        self.since_ns = 0
        self.totals = [0] * (1 + len(NAMES))
        self.busy_ns = self.preempted_ns = 0
        self.last_end_ns = 0
        self.jobs = 0
        self.restarts = 0

    def add_job(self, begin_ns: int, end_ns: int, preempted_ns: int, asleep_ns: int, preempted_before_ns: int) -> None:
        """Book a job. All times are in ns; the last three are as in `JobDone`.

        Time before the job counts as preempted if the unit held the job, did no other job and had no core.
        """
        self.jobs += 1
        last_end_ns = self.last_end_ns
        if preempted_before_ns and begin_ns > (held_from_ns := max(last_end_ns, self.since_ns)):
            self.preempted_ns += min(preempted_before_ns, begin_ns - held_from_ns)
        if end_ns > last_end_ns:
            ran_ns = end_ns - (begin_ns if begin_ns > last_end_ns else last_end_ns)
            self.last_end_ns = end_ns
            self.busy_ns += ran_ns
            if preempted_ns or asleep_ns:
                self.preempted_ns += min(preempted_ns, ran_ns)
                self.busy_ns -= min(preempted_ns + asleep_ns, ran_ns)

    def shares(self, joins: bool) -> dict[str, Any]:
        """Return the keys `busy`, `idle`, `jobs`, `restarts` of the unit in report.json, with their values.

        `joins`: whether one of its stages has several inputs, so that `idle` has the cause `join`.
        """
        total = sum(self.totals) or 1
        idle = {name: self.totals[account] for account, name in NAMES.items()}
        idle[PREEMPTED] = self.preempted_ns
        idle[OVERHEAD] = self.totals[ASSIGNED] - self.busy_ns - self.preempted_ns
        return {
            "busy": self.busy_ns / total,
            "idle": {cause: idle[cause] / total for cause in idle_causes(joins=joins)},
            "jobs": self.jobs,
            "restarts": self.restarts,
        }


@dataclass(frozen=True)
class Books:
    """Settings of a ledger.

    `target_period_ns`: longest frame time that counts as in time; 0: the frames' deadlines count.
    `sketch`: function that makes a sketch for the percentiles of many values; None: all values are kept.
    """

    target_period_ns: int = 0
    sketch: Callable[[], Sketch] | None = None


class _StageBook:
    def __init__(self, sketch: Callable[[], Sketch] | None) -> None:
        self.service = Samples(sketch)
        self.wait = Samples(sketch)


class Ledger:
    """The accounts of a run, written by the core alone; times in ns of the run's clock.

    `presented_count`: number of presented frames.
    `skipped`: number of presented frames that took the bypass.
    `rungs`: number of presented frames on each rung of work.
    `rung_switches`: how often a frame had another rung than the frame before.
    `left`: list that gets a record of every frame that leaves the run; None: no records are kept.
    `presented_frames`, `presented_ns`: numbers and times of the presented frames, in order; filled only for a run that
    keeps all values.
    `lateness_ns`: lateness of the presented frames that have a deadline, in order; also filled only for such a run.
    """

    def __init__(self, graph: Graph, books: Books | None = None) -> None:
        self._graph, self._books = graph, books or Books()
        sketch = self._books.sketch
        self._units = {unit: _UnitBook() for unit in graph.units}
        self._stages = {stage.name: _StageBook(sketch) for stage in graph.stages}
        reads = [(stage, graph.inputs_of(place)) for place, stage in enumerate(graph.stages)]
        self._joining = {stage.unit for stage, inputs in reads if sum(not each.latest for each in inputs) > 1}
        self._newest = {each.stage: _NewestBook(sketch) for _, inputs in reads for each in inputs if each.latest}
        self.start_ns = self.end_ns = 0
        self.left: list[FrameLeft] | None = None
        self.lost: Counter[Loss] = Counter()
        self.dropped: Counter[Drop] = Counter()
        self.skipped = self.presented_count = 0
        self.rungs: Counter[int] = Counter()
        self.rung_switches = 0
        self.lateness_ns: list[int] = []
        self.presented_frames: list[int] = []
        self.presented_ns: list[int] = []
        self._rung = -1
        self._last_ns = self._between_ns = 0
        self._is_held = self._was_held = False
        self._frame_times, self._latency, self._lateness = FrameTimeSamples(sketch), Samples(sketch), Lateness()

    def start(self, now_ns: int) -> None:
        self.start_ns = now_ns
        for book in self._units.values():
            book.since_ns = now_ns

    def close(self, now_ns: int) -> None:
        self.end_ns = now_ns
        for unit, book in self._units.items():
            self.enter(unit, now_ns, book.state)

    def enter(self, unit: str, now_ns: int, state: int) -> None:
        book = self._units[unit]
        book.totals[book.state] += now_ns - book.since_ns
        book.state, book.since_ns = state, now_ns

    def job(
        self,
        job: Job,
        ready_ns: int,
        begin_ns: int,
        end_ns: int,
        preempted_ns: int = 0,
        asleep_ns: int = 0,
        preempted_before_ns: int = 0,
    ) -> None:
        """Book a job that has ended. `ready_ns`: time from which its inputs were there. Other times: see `JobDone`."""
        stage = self._stages[job.stage]
        stage.service.add(end_ns - begin_ns)
        stage.wait.add(begin_ns - ready_ns)
        self._units[job.unit].add_job(begin_ns, end_ns, preempted_ns, asleep_ns, preempted_before_ns)

    def lose(self, frame: int, release_ns: int, loss: Loss) -> None:
        """Book the loss of a frame. `release_ns`: time of its release. `loss`: reason."""
        self.lost[loss] += 1
        if self.left is not None:
            self.left.append(FrameLeft(frame, release_ns, str(loss)))

    def drop(self, frame: int, release_ns: int, drop: Drop) -> None:
        """Book the drop of a frame. `release_ns`: time of its release. `drop`: reason."""
        self.dropped[drop] += 1
        if self.left is not None:
            self.left.append(FrameLeft(frame, release_ns, str(drop)))

    def newest(self, stream: str, age_ns: int, behind: int) -> None:
        """Book that a job takes the newest frame of a stream.

        `age_ns`: time since that frame was sampled.
        `behind`: number of frames by which the taken frame is older than the job's frame.
        """
        book = self._newest[stream]
        book.age.add(age_ns)
        book.behind[behind] += 1

    @property
    def busy_ns(self) -> dict[str, int]:
        """The busy time in ns of each unit so far, in jobs that have ended."""
        return {unit: book.busy_ns for unit, book in self._units.items()}

    def restart(self, unit: str) -> None:
        self._units[unit].restarts += 1

    def hold(self, is_held: bool) -> None:
        """Note whether somebody holds the run from now on.

        If the run was held between two presented frames, the time between them does not count as a frame time.
        """
        self._is_held, self._was_held = is_held, True

    def presented(
        self,
        frame: int,
        end_ns: int,
        latency_ns: int,
        deadline_ns: int,
        skipped: bool = False,
        rung: int = 0,
        release_ns: int = 0,
    ) -> None:
        """Book a presented frame.

        `end_ns`: time of its presentation.
        `latency_ns`: its latency; below 0 if the frame does not go through the stage at which the latency ends.
        `deadline_ns`: time of its deadline; NEVER without one.
        `skipped`: whether it took the bypass.
        `rung`: rung of its work.
        `release_ns`: time of its release.
        """
        self.skipped += skipped
        self.rungs[rung] += 1
        self.rung_switches += rung != self._rung and self.presented_count > 0
        self._rung = rung
        before_ns = self._last_ns if self.presented_count and not self._was_held else None
        if before_ns is not None:
            self._between_ns += end_ns - before_ns
            self._frame_times.add(end_ns - before_ns)
        if (until_ns := due_ns(deadline_ns, before_ns, self._books.target_period_ns)) != NEVER:
            self._lateness.add(end_ns - until_ns)
        self._last_ns, self._was_held = end_ns, self._is_held
        self.presented_count += 1
        if latency_ns >= 0:
            self._latency.add(latency_ns)
        if self._books.sketch is None:
            self.presented_frames.append(frame)
            self.presented_ns.append(end_ns)
            if deadline_ns != NEVER:
                self.lateness_ns.append(end_ns - deadline_ns)
        if self.left is not None:
            self.left.append(FrameLeft(frame, release_ns, "", end_ns, latency_ns, rung))

    @property
    def shown_ns(self) -> dict[int, int]:
        """The time in ns of each presentation, by the frame's number; empty for a run that does not keep all values."""
        return dict(zip(self.presented_frames, self.presented_ns, strict=True))

    @property
    def left_out(self) -> int:
        """The number of frames that were lost or dropped so far."""
        return sum(self.lost.values()) + sum(self.dropped.values())

    @property
    def lost_by_cause(self) -> dict[str, int]:
        """The number of lost frames by the cause's key in the report."""
        return dict(sorted((str(loss), count) for loss, count in self.lost.items()))

    @property
    def dropped_by_cause(self) -> dict[str, int]:
        """The number of dropped frames by the cause's key in the report."""
        return dict(sorted((str(drop), count) for drop, count in self.dropped.items()))

    @property
    def latency_ns(self) -> list[int]:
        """The latency in ns of each presented frame, in order; only for a run that keeps all values."""
        return [*self._latency.kept]

    @property
    def is_exact(self) -> bool:
        """Whether all percentiles are computed from all values, not from a sketch."""
        books = self._stages.values()
        samples = [*[book.service for book in books], *[book.wait for book in books], self._latency]
        return self._frame_times.samples.is_exact and all([each.is_exact for each in samples])

    def report(self, *, clock: str, requested: int, not_begun: int) -> dict[str, Any]:
        """Return the ledger's keys of report.json, with their values.

        `clock`: "host" or "virtual".
        `requested`: number of frames that were asked for.
        `not_begun`: number of requested frames that never left the source.
        """
        intervals, span_ns = self._frame_times.samples.count, self._between_ns
        streams = {name: book.row() for name, book in self._newest.items()}
        return {
            "clock": clock,
            "frames": {
                "requested": requested,
                "presented": self.presented_count,
                "lost": sum(self.lost.values()),
                "lost_by_cause": self.lost_by_cause,
                "dropped": self.dropped_by_cause,
                "not_begun": not_begun,
                **({"skipped": self.skipped} if self._graph.bypass else {}),
            },
            "duration_s": (self.end_ns - self.start_ns) / NS_PER_S,
            "frame_time_ms": self._frame_times.row(),
            "latency_ms": self._latency.summary_ms(),
            "fps": intervals * NS_PER_S / span_ns if span_ns else 0.0,
            **self._frame_times.fps_interval(),
            "deadline_misses": self._lateness.missed,
            "xrbench": {
                "real_time": self._lateness.real_time_score,
                "qoe": self.presented_count / requested if requested else 0.0,
                "energy": None,  # a caller that knows the power fills it in
            },
            "stages": {stage.name: self._stage_row(stage.name, stage.unit) for stage in self._graph.stages},
            "units": {unit: book.shares(unit in self._joining) for unit, book in self._units.items()},
            **({"streams": streams} if streams else {}),
        }

    def _stage_row(self, name: str, unit: str) -> dict[str, Any]:
        book = self._stages[name]
        times = {"service_ms": book.service.summary_ms(), "wait_ms": book.wait.summary_ms()}
        return {"unit": unit, "jobs": book.service.count, **times}
