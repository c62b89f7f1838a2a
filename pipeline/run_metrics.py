"""What a run measured, as checked data: the keys of report.json that a run of any pipeline knows.

Rule: the fields stand in the order of the file's keys; an unknown key is an error; an optional field that was not set
is left out of the file. Times are in ms, shares between 0 and 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Literal, Self

from pydantic import Field, model_validator

from trilane.pipeline.description import Model

#: Stages measured by themselves, the shares of `units` computed a second time, and whether the core was compiled.
GONE: Final = frozenset({"isolated_ms", "accounts", "scheduler_core"})


class Record(Model):
    """Base of everything that is written to report.json."""

    def as_json(self) -> dict[str, Any]:
        """The keys that were set, as JSON takes them, in the order of the fields."""
        return self.model_dump(mode="json", by_alias=True, exclude_unset=True)

    @model_validator(mode="before")
    @classmethod
    def _leave_out_what_is_gone(cls, document: Any) -> Any:
        """Older Trilanes wrote keys that nobody makes now."""
        if not isinstance(document, dict):
            return document
        return {key: value for key, value in document.items() if key not in GONE}


class FrameCounts(Record):
    """Frames of a run, counted: all that were requested are presented, lost, dropped, or not begun.

    `requested`: asked for.
    `presented`: that reached the last stage's end.
    `lost`: begun and never presented, because a unit died or a stage failed.
    `lost_by_cause`: the same by `cause:unit`.
    `dropped`: left out by the policy, by `edge:cause`.
    `not_begun`: never taken, because the run ended before; null in reports of before it was counted.
    `skipped`: of those presented, how many took the pipeline's bypass; absent where it has none.
    """

    requested: int
    presented: int
    lost: int
    lost_by_cause: dict[str, int]
    dropped: dict[str, int]
    not_begun: int | None = None
    skipped: int = 0

    @model_validator(mode="after")
    def _add_up(self) -> Self:
        """Every requested frame became one thing."""
        if self.not_begun is None:
            return self
        dropped = sum(self.dropped.values())
        if self.requested != self.presented + self.lost + dropped + self.not_begun:
            raise ValueError(
                f"{self.requested} frames were requested, but {self.presented} presented, {self.lost} lost, "
                f"{dropped} dropped and {self.not_begun} not begun"
            )
        return self


class TimeSummary(Record):
    """Statistics of times in ms: `mean`, percentiles `p50` to `p99`, and `max`; all 0 when there were none.

    `samples`: how many times they are of; null in reports of before it was counted. p90 needs 29 of them, p95 59, p99
    299 (`trilane.scheduler.stats.samples_needed`).
    """

    mean: float
    p50: float
    p90: float
    p95: float
    p99: float
    max: float
    samples: int | None = None


class FrameTimes(TimeSummary):
    """Times between presented frames, ms.

    `ema20_min`, `ema20_max`: smallest and largest exponential average over 20 frames.
    `jitter`: mean absolute difference of successive frame times.
    `mean_low`, `mean_high`: 95 % interval of the mean by the scatter of this run's frames (batch means), null when they
    are too few to tell.
    """

    ema20_min: float
    ema20_max: float
    jitter: float
    mean_low: float | None = None
    mean_high: float | None = None


class XrBench(Record):
    """XRBench's scores (Kwon et al., MLSys 2023, section 3), 0 to 1.

    `real_time`: how well frames kept their deadlines; null when none had one.
    `qoe`: quality of experience, presented over requested frames.
    `energy`: null where the power is not known.
    """

    real_time: float | None
    qoe: float
    energy: float | None


class MovedBytes(Record):
    """Bytes that were moved for a presented frame, means (`trilane.pipeline.moved_bytes`).

    `read`: from slots, shared assets, samples.
    `written`: into slots and files.
    `uploaded`, `read_back`: into the GPU's memory, and out of it.
    `least`: what the frames needed.
    `ratio`: the first four in sum over the least; null where that is 0.
    """

    read: float
    written: float
    uploaded: float
    read_back: float
    least: float
    ratio: float | None

    @property
    def all(self) -> float:
        """That passed through the memories."""
        return self.read + self.written + self.uploaded + self.read_back


class MovedInAll(MovedBytes):
    """The same of all stages. `gb_per_second`: of what was moved, over the time of the run, in 1e9 bytes a second."""

    gb_per_second: float | None


class StageTimes(Record):
    """One stage.

    `unit`: that ran it.
    `jobs`: how many it ended.
    `service_ms`: of its jobs, from begin to end, the time included in which another process had the core.
    `wait_ms`: from a job's input to its begin.
    `cpu_ms`: CPU time of its jobs, of all threads of the unit; on the host clock.
    `bytes`: that it moved for a presented frame; absent where it does not count them.
    """

    unit: str
    jobs: int = 0
    service_ms: TimeSummary
    wait_ms: TimeSummary
    cpu_ms: TimeSummary | None = None
    bytes: MovedBytes | None = None


class IdleShares(Record):
    """Why a unit did not work, as shares of the run's time.

    `starved`: it had no input.
    `blocked`: it had input, but no free output slot, or the limit of frames in flight was reached.
    `throttled`: its cap held it.
    `preempted`: it had a job, but not its core; null where the kernel does not say how long threads wait for one.
    `overhead`: a job was on its way to it, it slept within a job, or its process was down.
    """

    starved: float
    blocked: float
    throttled: float
    preempted: float | None = None
    overhead: float


class UnitShares(Record):
    """One unit; `busy` and the five parts of `idle` sum to 1.

    `busy`: share of the time in which a job ran.
    `idle`: the rest, by cause.
    `jobs`: that it ended.
    `restarts`: new processes after the first.
    `cpu_s`: CPU time of all its threads in the run, those included that spin between jobs; on the host clock, as what
    follows.
    `cpu_in_jobs_s`: the part of it in jobs.
    `pid`: of its last process.
    `cores`: that it may use.
    `threads`: that its stages may use.
    `spin`: whether those threads may spin between jobs.
    """

    busy: float
    idle: IdleShares
    jobs: int
    restarts: int
    cpu_s: float | None = None
    cpu_in_jobs_s: float | None = None
    pid: int | None = None
    cores: tuple[int, ...] = ()
    threads: int = 0
    spin: bool = False


class CoreShare(Record):
    """Units that may run on `cores` and nowhere else.

    `cpu`: their CPU time as a share of the time that these cores had; at most 1.
    `busy`: their busy shares as a share of the same; at most 1 where no unit has a device of its own.
    """

    cores: tuple[int, ...]
    units: tuple[str, ...]
    cpu: float
    busy: float


class UnitCap(Record):
    """The cap of one unit. `corner`: at the run's end; `duty`: share of the time then; `duty_mean`: over the run."""

    corner: str
    duty: float
    duty_mean: float


class Caps(Record):
    """What held the units; all but `how` is there when a performance profile was asked for.

    `how`: what a cap is on this clock, or that there was none.
    `profile`: hardware profile whose corners and limits hold.
    `performance_profile`: that was asked for.
    `governor`: name of the rule that lowers and raises corners.
    `units`: the cap of each.
    `power_w`: mean modelled power, null when the run was too short for one.
    `throttled_share`: share of the time in which a unit was below the corner that was asked for.
    `first_throttled_s`: when that began, null when it never did.
    """

    how: str
    profile: str = ""
    performance_profile: str | None = None
    governor: str = ""
    units: dict[str, UnitCap] = Field(default={})
    power_w: float | None = None
    throttled_share: float = 0.0
    first_throttled_s: float | None = None


class Temperature(Record):
    """Degrees Celsius; all but `sensor` is there when the temperature was modelled.

    `kind`: how it was modelled.
    `device_end`: of the device's body at the end of the run.
    `device_max`: the highest of the device's body.
    `junction_max`: the highest of any unit.
    `sensor`: this machine's hottest sensor at the end of the run, null where the system shows none.
    """

    kind: str = ""
    device_end: float | None = None
    device_max: float | None = None
    junction_max: float | None = None
    sensor: float | None = None


class PathShare(Record):
    """What the critical path was for most of its time (`trilane.pipeline.critical_path`).

    `name`: of the unit or the stage, or what it was instead. `share`: of the path. `share_low`, `share_high`: 95 %
    interval by the scatter of this run's frames; null for fewer than 51. `rivals`: names whose share may be as large.
    """

    name: str
    share: float
    share_low: float | None = None
    share_high: float | None = None
    rivals: list[str] | None = None

    @property
    def names(self) -> str:
        """What may be the largest part: the name and its rivals."""
        return " or ".join([self.name, *(self.rivals or [])])


class Bound(Record):
    """What bounded the frame time. `unit`: its name is the report's `bottleneck`. `stage`: null where no stage did."""

    unit: PathShare
    stage: PathShare | None = None


class RunMetrics(Record):
    """What a run measured.

    `clock`: `host`, measured on this machine, or `virtual`, computed from a hardware profile.
    `frames`: counted by what became of them.
    `duration_s`: from the first job to the end of the run.
    `percentiles`: whether they are exact, or which are of a sketch and within what error; on the host clock.
    `frame_time_ms`: between presented frames.
    `latency_ms`: from the sampled pose to the end of the stage that the pipeline names (the composited frame).
    `fps`: presented frames a second; 0 for fewer than two.
    `fps_low`, `fps_high`: its 95 % interval, from that of the mean frame time; null when there are too few frames.
    `deadline_misses`: frames presented after their deadline, or frame times above the target.
    `xrbench`: XRBench's scores.
    `stages`: times of each, in the order of the pipeline.
    `bytes`: moved for a presented frame by all stages that count them; absent where none does.
    `units`: shares of each.
    `efficiency`: work of the slowest unit's jobs, as a share of the time from the first presented frame to the last;
    null for fewer than two. `core_efficiency`: of the fullest cores. `machine_efficiency`: of all cores of the run.
    `bottleneck`: what most of the critical path is: a unit, `other programs`, `release`, `overhead`, or `held`; null
    without a path.
    `bound`: its share of the path, and the stage that has most of it.
    `core_shares`: what was done on each set of cores that a unit has, and on all; on the host clock.
    `policy`, `edge`: of the scheduler; `idle_cores`: whether cores without work stayed awake; on the host clock.
    `other_programs`: their share of the time of the run's cores; null where a unit died.
    `caps`, `temperature_c`: of a capped run.
    """

    clock: Literal["host", "virtual"]
    frames: FrameCounts
    duration_s: float
    percentiles: str = ""
    frame_time_ms: FrameTimes
    latency_ms: TimeSummary
    fps: float
    fps_low: float | None = None
    fps_high: float | None = None
    deadline_misses: int
    xrbench: XrBench
    stages: dict[str, StageTimes]
    bytes: MovedInAll | None = None
    units: dict[str, UnitShares]
    efficiency: float | None = None
    core_efficiency: float | None = None
    machine_efficiency: float | None = None
    bottleneck: str | None = None
    bound: Bound | None = None
    core_shares: tuple[CoreShare, ...] = ()
    policy: str = ""
    edge: str = ""
    idle_cores: str = ""
    other_programs: float | None = None
    caps: Caps | None = None
    temperature_c: Temperature | None = None


def metrics_of(ledger_report: Mapping[str, Any]) -> RunMetrics:
    """`Ledger.report()`, and what the run added to it, checked. Raises ValueError naming a wrong or unknown key."""
    return RunMetrics.model_validate(ledger_report)
