"""The figures of a moment of a run, as the dashboard, `trilane top` and `/metrics` show them. Rule: plain typed data.

"The window" is the last `window_s` seconds before the moment, "the run" all since every unit was ready. What a figure
comes from stands in `sources`, and the avatar's error in `accuracy`: no speed is shown without them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Shares:
    """Shares of a unit's time: `busy`, and `idle` by cause; they add up to 1, or are all 0 of no time at all."""

    busy: float
    idle: Mapping[str, float]


@dataclass(frozen=True)
class UnitFigures:
    """One unit.

    `window`, `run`: where its time went; a job that still runs counts as busy.
    `jobs`: that it ended, in the run.
    `restarts`: of its process, in the run.
    `is_up`: whether its process is there and ready; never of a run that is over.
    `stage`, `frame`: of the job that it does, "" and -1 without one.
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
    """Bytes of one kind that a stage moved: `total` of the run, `per_job` the mean of the window's jobs."""

    total: float
    per_job: float


@dataclass(frozen=True)
class StageFigures:
    """One stage. `waiting`: frames before it. `service_ms`: mean of the window's jobs, 0 of none. `bytes`: by kind."""

    unit: str
    waiting: int
    service_ms: float
    bytes: Mapping[str, Moved]


@dataclass(frozen=True)
class DropCount:
    """Frames dropped at `edge`, "producer->consumer", for `cause`."""

    edge: str
    cause: str
    frames: int


@dataclass(frozen=True)
class FrameFigures:
    """Frames of the run, counted: what is requested is presented, lost, dropped, in flight, or not begun.

    `lost`: by cause. `skipped`: of those presented, how many took the bypass.
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
    """Times of the whole run. `counts[i]`: those of at most `bounds_s[i]` and more than the bound before.

    The last count, for which there is no bound, is of those above all.
    """

    bounds_s: tuple[float, ...]
    counts: tuple[int, ...]
    sum_s: float

    @property
    def count(self) -> int:
        """How many times there are."""
        return sum(self.counts)


@dataclass(frozen=True)
class Note:
    """A message to a person, `t_ms` after the first step."""

    t_ms: float
    text: str


@dataclass(frozen=True)
class Figures:
    """Figures at one moment.

    `t_ms`: since the first step. `window_s`, `run_s`: how long the window and the run have been.
    `clock`: "host" or "virtual". `is_over`: whether the journal has the run's end.
    `state`: of the run, "goes on", "finished", "killed" or "removed".
    `fps`: frames presented in the window, a second. `run_fps`: between the first and last presented frame.
    `frame_time_ms`, `latency_ms`: mean, p50, p90, p95, p99, max and samples, exact, of the window.
    `units`, `stages`: in the order of the pipeline.
    `temperature_c`, `duty`: by place and unit, as last looked at. `memory_bytes`: of the processes, by unit.
    `notes`: the last few messages.
    `bound`: of the run so far, as in report.json; null before 63 frames, and where it is not looked for.
    `frame_times`, `latencies`: of the run.
    `began_at`: UTC, ISO 8601; "" where the journal does not say.
    `accuracy`: by avatar, as in report.json; empty where the journal does not say.
    `sources`: key to where the figures below it come from, as in report.json.
    """

    t_ms: float
    window_s: float
    run_s: float
    clock: str
    is_over: bool
    state: str
    fps: float
    run_fps: float
    frame_time_ms: Mapping[str, float]
    latency_ms: Mapping[str, float]
    frames: FrameFigures
    units: Mapping[str, UnitFigures]
    stages: Mapping[str, StageFigures]
    temperature_c: Mapping[str, float]
    duty: Mapping[str, float]
    memory_bytes: Mapping[str, float]
    notes: tuple[Note, ...]
    bound: Mapping[str, Any] | None
    frame_times: Histogram
    latencies: Histogram
    began_at: str
    accuracy: Mapping[str, Mapping[str, Any]]
    sources: Mapping[str, str]

    def as_json(self) -> dict[str, Any]:
        """The same names and values as JSON takes them."""
        return asdict(self)
