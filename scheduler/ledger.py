"""Where the time went. Rule: every nanosecond of a unit is busy or idle for one stated cause; the six sum to the run.

busy: a job runs. starved: no input. blocked: input, but no free output slot, or the limit of frames in flight.
throttled: held by the cap. preempted: the unit has a job, but not its core. overhead: a job is assigned but does not
run (messages, scheduling, it sleeps), or the unit is down. On the virtual clock no unit is preempted here: those on one
core are one unit to the scheduler, whose share trilane.hw_profiles.application divides.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, Final, NamedTuple

from trilane.scheduler.causes import Drop, Loss
from trilane.scheduler.events import NEVER, Graph, Job
from trilane.scheduler.stats import NS_PER_MS, ema_range_ms, jitter_ms, real_time_score, summary_ms
from trilane.scheduler.uncertainty import fps_interval, frame_interval_ms

ASSIGNED: Final = 0
STARVED: Final = 1
BLOCKED: Final = 2
THROTTLED: Final = 3


class JobRecord(NamedTuple):
    """One finished job. Times in ns of the run's clock; `ready` is when its input was there.

    `preempted_ns`, `asleep_ns`, `preempted_before_ns`: as in `JobDone`.
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


class _UnitBook:
    def __init__(self) -> None:
        self.state = STARVED
        self.since_ns = 0
        self.totals = [0, 0, 0, 0]
        self.busy_ns = self.preempted_ns = 0
        self.last_end_ns = 0
        self.jobs = 0
        self.restarts = 0

    def add_job(self, begin_ns: int, end_ns: int, preempted_ns: int, asleep_ns: int, preempted_before_ns: int) -> None:
        """Book a job, and what was lost of the time before it in which the unit had it and did no other."""
        self.jobs += 1
        held_from_ns = max(self.last_end_ns, self.since_ns)
        if begin_ns > held_from_ns:
            self.preempted_ns += min(preempted_before_ns, begin_ns - held_from_ns)
        if end_ns > self.last_end_ns:
            ran_ns = end_ns - max(begin_ns, self.last_end_ns)
            self.last_end_ns = end_ns
            self.preempted_ns += min(preempted_ns, ran_ns)
            self.busy_ns += ran_ns - min(preempted_ns + asleep_ns, ran_ns)

    def shares(self) -> dict[str, Any]:
        total = sum(self.totals) or 1
        assigned, starved, blocked, throttled = self.totals
        idle = {
            "starved": starved,
            "blocked": blocked,
            "throttled": throttled,
            "preempted": self.preempted_ns,
            "overhead": assigned - self.busy_ns - self.preempted_ns,
        }
        return {
            "busy": self.busy_ns / total,
            "idle": {cause: ns / total for cause, ns in idle.items()},
            "jobs": self.jobs,
            "restarts": self.restarts,
        }


class _StageBook:
    def __init__(self) -> None:
        self.service_ns: list[int] = []
        self.wait_ns: list[int] = []
        self.on_core_ns: list[int] = []  # the service times without the time in which another thread had the core
        self.skipping_ns: list[int] = []  # the same of jobs whose frame took the bypass


class Ledger:
    """Fed by the core alone. Times in ns of the run's clock."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._units = {unit: _UnitBook() for unit in graph.units}
        self._stages = {stage.name: _StageBook() for stage in graph.stages}
        self.start_ns = self.end_ns = 0
        self.lost: Counter[Loss] = Counter()
        self.dropped: Counter[Drop] = Counter()
        self.skipped = 0
        self.presented_frames: list[int] = []
        self.rungs: list[int] = []
        self.presented_ns: list[int] = []
        self.latency_ns: list[int] = []
        self.lateness_ns: list[int] = []

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
        skips: bool = False,
    ) -> None:
        """Book a job that has ended: `ready_ns` is when its input was there, the rest is as in `JobDone`.

        `skips`: its frame takes the bypass.
        """
        stage = self._stages[job.stage]
        stage.on_core_ns.append(end_ns - begin_ns - preempted_ns)
        if skips:
            stage.skipping_ns.append(end_ns - begin_ns - preempted_ns)
        stage.service_ns.append(end_ns - begin_ns)
        stage.wait_ns.append(begin_ns - ready_ns)
        self._units[job.unit].add_job(begin_ns, end_ns, preempted_ns, asleep_ns, preempted_before_ns)

    @property
    def busy_ns(self) -> dict[str, int]:
        """How long each unit has worked so far: jobs that have ended."""
        return {unit: book.busy_ns for unit, book in self._units.items()}

    def restart(self, unit: str) -> None:
        self._units[unit].restarts += 1

    def presented(
        self, frame: int, end_ns: int, latency_ns: int, deadline_ns: int, skipped: bool = False, rung: int = 0
    ) -> None:
        """`deadline_ns`: NEVER when the frame has none. `skipped`: it took the bypass. `rung`: of its work."""
        self.skipped += skipped
        self.rungs.append(rung)
        self.presented_frames.append(frame)
        self.presented_ns.append(end_ns)
        self.latency_ns.append(latency_ns)
        if deadline_ns != NEVER:
            self.lateness_ns.append(end_ns - deadline_ns)

    @property
    def left_out(self) -> int:
        """How many frames were lost or dropped so far."""
        return sum(self.lost.values()) + sum(self.dropped.values())

    @property
    def lost_by_cause(self) -> dict[str, int]:
        """Frames lost, by the cause's key in the report."""
        return dict(sorted((str(loss), count) for loss, count in self.lost.items()))

    @property
    def dropped_by_cause(self) -> dict[str, int]:
        """Frames dropped, by the cause's key in the report."""
        return dict(sorted((str(drop), count) for drop, count in self.dropped.items()))

    @property
    def frame_times_ns(self) -> list[int]:
        return [after - before for before, after in pairwise(self.presented_ns)]

    def report(
        self,
        *,
        clock: str,
        requested: int,
        target_period_ns: int = 0,
        isolated_ns: Mapping[str, float] | None = None,
    ) -> dict[str, Any]:
        """The keys of report.json. `isolated_ns`: mean service time of each stage measured isolated; efficiency is null
        without it. `target_period_ns`: frame times above it count as deadline misses when frames have no deadline."""
        intervals = self.frame_times_ns
        span = self.presented_ns[-1] - self.presented_ns[0] if intervals else 0
        late_ns = [interval - target_period_ns for interval in intervals] if target_period_ns else self.lateness_ns
        return {
            "clock": clock,
            "frames": {
                "requested": requested,
                "presented": len(self.presented_ns),
                "lost": sum(self.lost.values()),
                "lost_by_cause": self.lost_by_cause,
                "dropped": self.dropped_by_cause,
                **({"skipped": self.skipped} if self._graph.bypass else {}),
            },
            "duration_s": (self.end_ns - self.start_ns) / 1e9,
            "frame_time_ms": {
                **summary_ms(intervals),
                **ema_range_ms(intervals),
                "jitter": jitter_ms(intervals),
                **frame_interval_ms(intervals),
            },
            "latency_ms": summary_ms(self.latency_ns),
            "fps": len(intervals) * 1e9 / span if span else 0.0,
            **fps_interval(intervals),
            "deadline_misses": sum(late > 0 for late in late_ns),
            "xrbench": {
                "real_time": real_time_score(late_ns),
                "qoe": len(self.presented_ns) / requested if requested else 0.0,
                "energy": None,  # filled in by a caller that knows the power
            },
            "stages": {stage.name: self._stage_row(stage.name, stage.unit) for stage in self._graph.stages},
            "units": {unit: book.shares() for unit, book in self._units.items()},
            **self._efficiency(isolated_ns, span / len(intervals) if intervals else 0.0),
        }

    def _stage_row(self, name: str, unit: str) -> dict[str, Any]:
        book = self._stages[name]
        times = {"service_ms": summary_ms(book.service_ns), "wait_ms": summary_ms(book.wait_ns)}
        return {"unit": unit, "jobs": len(book.service_ns), **times}

    def _efficiency(self, isolated_ns: Mapping[str, float] | None, interval_ns: float) -> dict[str, Any]:
        """Isolated service time of the slowest unit over the mean interval between presented frames.

        A stage that was not measured isolated (it writes files) counts with its mean in the run, without the time in
        which another thread had its core; so do, of frames that took the bypass, their jobs, which are none of the
        stages that it skips.
        """
        if not isolated_ns or not interval_ns:
            return {"efficiency": None, "isolated_ms": {}}
        per_unit: dict[str, float] = dict.fromkeys(self._units, 0.0)
        share = self.skipped / len(self.presented_ns)
        for stage in self._graph.stages:
            book = self._stages[stage.name]
            isolated = isolated_ns.get(stage.name)
            if isolated is None:
                per_unit[stage.unit] += _mean(book.on_core_ns)
            else:
                per_unit[stage.unit] += (1 - share) * isolated + share * _mean(book.skipping_ns)
        return {
            "efficiency": max(per_unit.values()) / interval_ns,
            "bottleneck": max(per_unit, key=per_unit.__getitem__),
            "isolated_ms": {name: ns / NS_PER_MS for name, ns in isolated_ns.items()},
        }


def _mean(times_ns: list[int]) -> float:
    return sum(times_ns) / max(len(times_ns), 1)
