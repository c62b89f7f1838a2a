"""The figures of a run at one moment, as the dashboard, `trilane watch` and `/metrics` show them.

Rule: plain typed data. "The window" is the last `window_s` seconds before the moment. "The run" is all time since every
unit was ready. No speed is shown without the sources of the figures and the avatars' error. The bounds of a histogram
never change, so that counts of different runs can be added up.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from trilane.apps.run.verdict import Verdict
from trilane.pipeline.run_metrics import Bound
from trilane.units import NS_PER_S

#: Upper bounds of a histogram's bins in seconds: dense for rates from 200 to 10 frames a second, sparse outside.
BOUNDS_S = (
    *(0.001, 0.002, 0.003, 0.004, 0.005, 0.006, 0.008),
    *(0.01, 0.0125, 0.015, 0.0175, 0.02, 0.025, 0.03, 0.035, 0.04, 0.05, 0.06, 0.075),
    *(0.1, 0.15, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0),
)


@dataclass(frozen=True)
class Shares:
    """Shares of a unit's time: `busy`, and `idle` by cause. They add up to 1. For no time at all, every share is 0."""

    busy: float
    idle: Mapping[str, float]


@dataclass(frozen=True)
class UnitFigures:
    """The figures of one unit.

    `window`, `run`: shares of its time in the window and in the run; a job that still runs counts as busy.
    `jobs`: number of ended jobs in the run.
    `restarts`: number of restarts of its process in the run.
    `is_up`: whether its process is there and ready; false once the run is over.
    `stage`, `frame`: stage and frame number of its present job; "" and -1 without a job.
    """

    window: Shares
    run: Shares
    jobs: int
    restarts: int
    is_up: bool
    stage: str
    frame: int


@dataclass(frozen=True)
class Moved:
    """Bytes of one kind that a stage moved.

    `total`: bytes in the run.
    `per_job`: mean bytes per job, over the jobs in the window.
    """

    total: float
    per_job: float


@dataclass(frozen=True)
class StageFigures:
    """The figures of one stage.

    `unit`: unit of the stage.
    `waiting`: number of frames that wait for the stage.
    `service_ms`: mean service time of the jobs in the window, 0 without jobs.
    `bytes`: moved bytes by kind.
    """

    unit: str
    waiting: int
    service_ms: float
    bytes: Mapping[str, Moved]


@dataclass(frozen=True)
class DropCount:
    """The number of frames that were dropped at one edge for one cause.

    `edge`: the edge, as "producer->consumer".
    `cause`: cause of the drops.
    `frames`: number of frames.
    """

    edge: str
    cause: str
    frames: int


@dataclass(frozen=True)
class FrameFigures:
    """Numbers of frames of the run. Each requested frame is presented, lost, dropped, in flight, or not begun.

    `skipped`: number of presented frames that took the bypass.
    `lost`: number of lost frames by cause.
    `dropped`: number of dropped frames for each edge and cause.
    """

    requested: int
    presented: int
    skipped: int
    in_flight: int
    not_begun: int
    lost: Mapping[str, int]
    dropped: tuple[DropCount, ...]


@dataclass(frozen=True)
class Histogram:
    """A histogram of times of the whole run.

    `bounds_s`: upper bounds of the bins, ascending.
    `counts`: number of times in each bin: `counts[i]` counts times above `bounds_s[i - 1]`, up to `bounds_s[i]`. One
    more count at the end is for times above all bounds.
    `sum_s`: sum of the times.
    """

    bounds_s: tuple[float, ...]
    counts: tuple[int, ...]
    sum_s: float

    @property
    def count(self) -> int:
        """Return the number of times."""
        return sum(self.counts)


@dataclass(frozen=True)
class Note:
    """A message for a person. `t_ms`: time of the message, since the first step."""

    t_ms: float
    text: str


@dataclass(frozen=True)
class MomentFigures:
    """All figures at one moment. None is null in JSON.

    `t_ms`: time since the first step.
    `window_s`: length of the window, which ends at the moment; it equals `run_s` at the beginning of a run.
    `run_s`: length of the run until the moment.
    `clock`: "host" or "virtual"; "" if the journal does not say.
    `is_over`: whether the journal has the run's end.
    `state`: "goes on", "finished", "killed" if the process died and left a partial folder, or "removed" if the run
    folder is gone.
    `fps`: `run_fps` for a finished run; otherwise presented frames a second in the window.
    `run_fps`: presented frames a second, from the first presented frame to the last, as in report.json; None for fewer
    than two.
    `frame_time_ms`, `latency_ms`: mean, p50, p90, p95, p99 and max of the times in the window, all exact; 0 without
    times. The key `samples` has the number of these times.
    `frames`: numbers of frames of the run, by what became of them.
    `units`, `stages`: figures by name, in the order of the pipeline.
    `temperature_c`: last temperatures by place. `duty`: last duties by unit, from 0 to 1.
    `memory_bytes`: last memory of each process, by unit; `scheduler` is the scheduler's process.
    `notes`: the last few messages.
    `bound`: what bounds the run so far; None before 63 frames, and if it is not computed.
    `verdict`: verdict on the run so far; None before the second presented frame.
    `frame_times`, `latencies`: histograms of the whole run.
    `began_at`: UTC, ISO 8601; "" if the journal has no such time.
    `accuracy`: error by avatar, as in report.json; empty if the journal has no errors.
    `sources`: source of figures by key, such as "computed", as in report.json. A source applies to all figures below
    its key. If several keys fit a figure, the longest key decides.
    """

    t_ms: float
    window_s: float
    run_s: float
    clock: str
    is_over: bool
    state: str
    fps: float | None
    run_fps: float | None
    frame_time_ms: Mapping[str, float]
    latency_ms: Mapping[str, float]
    frames: FrameFigures
    units: Mapping[str, UnitFigures]
    stages: Mapping[str, StageFigures]
    temperature_c: Mapping[str, float]
    duty: Mapping[str, float]
    memory_bytes: Mapping[str, float]
    notes: tuple[Note, ...]
    bound: Bound | None
    verdict: Verdict | None
    frame_times: Histogram
    latencies: Histogram
    began_at: str
    accuracy: Mapping[str, Mapping[str, Any]]
    sources: Mapping[str, str]

    def as_json(self) -> dict[str, Any]:
        """Return the figures as nested mappings with the names of the fields, ready for JSON.

        `bound` and `verdict` are as in report.json; `verdict` also has `lines` for people.
        """
        told = {"bound": self.bound and self.bound.as_json(), "verdict": self.verdict and self.verdict.shown()}
        return asdict(replace(self, bound=None, verdict=None)) | told


class TimeHistogram:
    """A histogram of times that grows; `now` returns a `Histogram`."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._sum_ns = 0

    def add(self, time_ns: int) -> None:
        """Count a time in ns. A time equal to a bound counts as below the bound."""
        self._counts[bisect_left(BOUNDS_S, time_ns / NS_PER_S)] += 1
        self._sum_ns += time_ns

    def now(self) -> Histogram:
        """Return the histogram of all times that were added until now."""
        return Histogram(BOUNDS_S, tuple(self._counts), self._sum_ns / NS_PER_S)
