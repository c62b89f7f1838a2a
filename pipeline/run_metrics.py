"""The figures of a run as validated data: the keys of report.json for a run of any pipeline.

Rule: the fields have the order of the file's keys, and an unknown key is an error. An optional field that was not set
is left out of the file. Times are in ms, shares from 0 to 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Literal, Self

from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_validator

from trilane.errors import BadInputError
from trilane.pipeline.description import Model

#: Keys that only older reports have: isolated times of stages, a second computation of the shares in `units`, and
#: whether the core was compiled.
GONE: Final = frozenset({"isolated_ms", "accounts", "scheduler_core"})


class Record(Model):
    """Base class of everything that is written to report.json."""

    def as_json(self) -> dict[str, Any]:
        """Return the fields that were set, by their keys in report.json, as JSON values in the order of the fields."""
        return self.model_dump(mode="json", by_alias=True, exclude_unset=True)

    @model_validator(mode="before")
    @classmethod
    def _leave_out_what_is_gone(cls, document: Any) -> Any:
        """Return the document without the keys in GONE."""
        if not isinstance(document, dict):
            return document
        return {key: value for key, value in document.items() if key not in GONE}


class FrameCounts(Record):
    """Counts of a run's frames: every requested frame is presented, lost, dropped, or not begun.

    `requested`: number of frames that the run was asked for.
    `presented`: number of frames that reached the end of the last stage.
    `lost`: number of frames in flight whose unit died, hung or was given up, whose stage failed, or whose run was
    aborted.
    `lost_by_cause`: numbers of lost frames by `cause:unit`, `failed:stage` or `aborted`.
    `dropped`: numbers of dropped frames, by `edge:cause`.
    `not_begun`: number of frames that no stage took before the run ended; null in older reports.
    `skipped`: number of presented frames that took the pipeline's bypass; absent without a bypass.
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
        """Check that every requested frame is counted once."""
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
    """Statistics of times in ms: `mean`, percentiles `p50` to `p99`, and `max`; all are null without times.

    `samples`: number of times; null in older reports. p90 needs 29 times, p95 59, p99 299
    (`trilane.scheduler.stats.samples_needed`).
    """

    mean: float | None
    p50: float | None
    p90: float | None
    p95: float | None
    p99: float | None
    max: float | None
    samples: int | None = None

    @model_validator(mode="before")
    @classmethod
    def _know_nothing_of_no_times(cls, document: Any) -> Any:
        """Replace the zeros of a summary without times by null. Ledgers and older reports have these zeros."""
        if not isinstance(document, dict) or document.get("samples") != 0:
            return document
        return {key: value if key == "samples" else None for key, value in document.items()}


class FrameTimes(TimeSummary):
    """Times between presented frames, in ms.

    `ema20_min`, `ema20_max`: smallest and largest exponential average over 20 frames; null without a frame time.
    `jitter`: mean absolute difference of successive frame times; null for fewer than two.
    `mean_low`, `mean_high`: bounds of the 95 % interval of the mean, from batch means of this run's frames; null if
    there are too few frames.
    """

    ema20_min: float | None
    ema20_max: float | None
    jitter: float | None
    mean_low: float | None = None
    mean_high: float | None = None


class XrBench(Record):
    """XRBench's scores (Kwon et al., MLSys 2023, section 3), from 0 (worst) to 1 (best).

    `real_time`: score that is 1 if all frames came long before their deadlines; null if no frame had a deadline.
    `qoe`: quality of experience: presented frames divided by requested frames.
    `energy`: energy score; null if the power is not known.
    """

    real_time: float | None
    qoe: float
    energy: float | None


class MovedBytes(Record):
    """Mean bytes that were moved for a presented frame (`trilane.pipeline.memory`).

    `read`: bytes read from slots, shared assets and samples.
    `written`: bytes written into slots and files.
    `uploaded`, `read_back`: bytes moved into the GPU's memory, and out of it.
    `least`: bytes that a frame needs, without copies.
    `ratio`: all moved bytes, without `least`, divided by `least`; null if `least` is 0.
    """

    read: float
    written: float
    uploaded: float
    read_back: float
    least: float
    ratio: float | None

    @property
    def all(self) -> float:
        """The sum of all bytes that passed through the memories."""
        return self.read + self.written + self.uploaded + self.read_back


class MovedInAll(MovedBytes):
    """Mean bytes that all stages together moved for a presented frame.

    `gb_per_second`: all moved bytes divided by the time of the run, in 1e9 bytes a second.
    """

    gb_per_second: float | None


class StageTimes(Record):
    """Times of one stage.

    `unit`: name of the unit that ran the stage.
    `jobs`: number of the stage's jobs that have ended.
    `service_ms`: times from a job's begin to its end, including time in which another thread had the core.
    `wait_ms`: times from when a job's input was there to the job's begin.
    `cpu_ms`: CPU times of the jobs over all threads of the unit; on the host clock.
    `bytes`: bytes that the stage moved for a presented frame; absent if it does not count them.
    """

    unit: str
    jobs: int = 0
    service_ms: TimeSummary
    wait_ms: TimeSummary
    cpu_ms: TimeSummary | None = None
    bytes: MovedBytes | None = None


class IdleShares(Record):
    """Shares of the run's time in which a unit did not work, by cause.

    `starved`: share in which the unit had no input.
    `blocked`: share in which the unit had input, but no output slot was free, the limit of frames in flight was
    reached, or late latching delayed the job.
    `throttled`: share in which the unit's duty did not let it work.
    `preempted`: share in which the unit had a job, but no core; null if the kernel does not count it.
    `overhead`: share in which a job was on its way to the unit, the unit slept within a job, or its process was down.
    `join`: share in which the unit had some inputs of a frame, but not all; absent if no branches meet at the unit.
    """

    starved: float
    blocked: float
    throttled: float
    preempted: float | None = None
    overhead: float
    join: float = 0.0


class UnitShares(Record):
    """Shares and figures of one unit; `busy` and all parts of `idle` sum to 1.

    On the virtual clock `cpu_s` and the fields after it are not set.

    `busy`: share of the time in which a job ran.
    `idle`: shares of the time in which no job ran, by cause.
    `jobs`: number of the unit's jobs that have ended.
    `restarts`: number of the unit's processes after the first.
    `cpu_s`: CPU time in seconds of all the unit's threads in the run, including threads that spin between jobs.
    `cpu_in_jobs_s`: part of `cpu_s` within jobs.
    `pid`: process id of the unit's last process.
    `cores`: numbers of the cores that the unit may use.
    `threads`: number of threads that the unit's stages may use.
    `spin`: whether these threads may spin between jobs.
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
    """Use of a set of cores by the units that may run only on these cores.

    `cores`: numbers of the cores.
    `units`: names of the units.
    `cpu`: CPU time of the units as a share of the time that the cores had; at most 1.
    `busy`: busy time of the units as a share of the time that the cores had; at most 1 if no unit has a device.
    """

    cores: tuple[int, ...]
    units: tuple[str, ...]
    cpu: float
    busy: float


class UnitCap(Record):
    """The cap of one unit: the corner that the governor allowed it, and the duty that follows from the corner.

    `corner`: corner at the run's end.
    `duty`: duty at the run's end, 0 to 1.
    `duty_mean`: mean duty over the run, 0 to 1.
    """

    corner: str
    duty: float
    duty_mean: float


class Caps(Record):
    """The caps of the units (`UnitCap`). All fields but `how` are present only if a performance profile was requested.

    `how`: meaning of a cap on this clock, or a note that there was none.
    `profile`: name of the hardware profile whose corners and limits were used.
    `performance_profile`: name of the requested performance profile.
    `governor`: name of the rule that lowers and raises corners.
    `units`: cap of each unit, by name.
    `power_w`: mean modelled power in watts; null if the run was too short.
    `throttled_share`: share of the time in which a unit was below its requested corner.
    `first_throttled_s`: time in seconds at which a unit was first below its requested corner; null if none was.
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
    """Temperatures in degrees Celsius. All fields except `sensor` are present only if temperatures were modelled.

    `kind`: how the temperatures were modelled.
    `device_end`: temperature of the device's body at the end of the run.
    `device_max`: highest temperature of the device's body.
    `junction_max`: highest temperature of any unit's junction.
    `sensor`: temperature of this machine's hottest sensor at the end of the run; null if the system has no sensor.
    """

    kind: str = ""
    device_end: float | None = None
    device_max: float | None = None
    junction_max: float | None = None
    sensor: float | None = None


class ProcessorState(Record):
    """The state of the run's cores; a field is null if the kernel does not show it.

    `clock_begin_ghz`, `clock_end_ghz`: clock of the fastest core in GHz, before the first and after the last frame.
    `throttles`: how often heat slowed a core between the first and the last frame.
    """

    clock_begin_ghz: float | None = None
    clock_end_ghz: float | None = None
    throttles: int | None = None


class SlowedCost(Record):
    """The cost of jobs that take longer by the share `Slowed.by`, from replays (`trilane.pipeline.reckoning`).

    `cost`: growth of the frame time, as a share of the frame time.
    `cost_low`, `cost_high`: bounds of the 95 % interval of `cost`, from the scatter over the run's frames; null for
    fewer than 60 frames.
    """

    cost: float | None = None
    cost_low: float | None = None
    cost_high: float | None = None


class PathShare(SlowedCost):
    """A unit, a stage or another owner of time, with its share of the critical path.

    `trilane.pipeline.critical_path` finds the path. The inherited fields are costs of slowing this unit or stage. They
    are absent if the bound was found from the path alone.

    `name`: name of the unit or stage, or of time that belongs to neither, such as `overhead`.
    `share`: share of the path that belongs to this name, 0 to 1.
    `share_low`, `share_high`: bounds of the 95 % interval of `share`, from the scatter of this run's frames; null for
    fewer than 51 frames.
    `rivals`: other names whose cost may be as large; without costs, names whose share may be as large.
    """

    name: str
    share: float
    share_low: float | None = None
    share_high: float | None = None
    rivals: list[str] | None = None

    @property
    def names(self) -> str:
        """The names that may be the bound: this one and its rivals."""
        return " or ".join([self.name, *(self.rivals or [])])


class PathShares(Record):
    """The largest parts of the critical path.

    `unit`: unit with the largest share, or another owner of time whose share is larger.
    `stage`: stage with the largest share; null if no stage is on the path.
    """

    unit: PathShare
    stage: PathShare | None = None


class FramesBehind(Record):
    """Numbers of frames by which a taken frame was older than the frame of the job that took it: `mean` and `max`."""

    mean: float
    max: int


class NewestTaken(Record):
    """Ages of the frames that inputs with `latest` took from one stream.

    `age_ms`: times from the sampling of a taken frame to the hand-over of the job that took this frame.
    `frames_behind`: numbers of frames by which a taken frame was older than the job's own frame.
    """

    age_ms: TimeSummary
    frames_behind: FramesBehind


class Slowed(Record):
    """The cost of slowing each stage, from replays of the run.

    `by`: share by which all jobs of a stage take longer.
    `frames`: number of the run's frames that were replayed.
    `over_measured`: frame time of a replay without a slower stage, divided by the frame time of the run.
    `is_trusted`: whether the costs decide the bound, because the replay is near the run and slowing a stage costs time.
    `costs`: cost of each stage.
    """

    by: float
    frames: int
    over_measured: float
    is_trusted: bool
    costs: dict[str, SlowedCost]


class Bound(PathShares):
    """The unit and the stage that bounded the frame time: those whose slowing costs most.

    If no replay can be trusted, the largest shares of the critical path decide.

    `unit`: unit that bounded the run; its name is the report's `bottleneck`.
    `stage`: stage that bounded the run; null if no stage did.
    `path`: largest parts of the path; absent if they have the names of `unit` and `stage`.
    `stages`: share of each stage in the path, the largest first; absent in older reports.
    `slowed`: cost of slowing each stage; absent if the run was not replayed.
    """

    path: PathShares | None = None
    stages: dict[str, float] = Field(default={})
    slowed: Slowed | None = None


class PolicyMetrics(Record):
    """The figures by which runs of two policies can be compared.

    `frames`: counts of frames: presented, lost, dropped or not begun.
    `frame_time_ms`: times between presented frames.
    `latency_ms`: times from a frame's sampling, or release, to the end of the stage that the pipeline names.
    `fps`: presented frames a second; null for fewer than two.
    `fps_low`, `fps_high`: bounds of the 95 % interval of `fps`, from the interval of the mean frame time; null if there
    are too few frames.
    `deadline_misses`: number of frames presented after their deadline, or of frame times above the target.
    `stages`: times of each stage, in the order of the pipeline.
    `bytes`: bytes that all stages moved for a presented frame; absent if no stage counts them.
    `units`: shares of each unit.
    `efficiency`: work of the slowest unit's jobs, as a share of the time from first to last presented frame; null for
    fewer than two.
    `core_efficiency`: CPU time of the jobs on the fullest set of cores, as a share of the time that this set had.
    `machine_efficiency`: CPU time of all jobs, as a share of the time that all cores of the run had.
    `bottleneck`: name of the bound of the frame time: a unit, or another owner of time, such as `other programs`,
    `release`, `overhead` or `held`; null without a path.
    `bound`: unit and stage that bounded the frame time, costs of slowing them, and their shares of the critical path.
    `core_shares`: use of each set of cores that a unit has, and of all cores; on the host clock.
    `policy`: policy of the scheduler.
    """

    frames: FrameCounts
    frame_time_ms: FrameTimes
    latency_ms: TimeSummary
    fps: float | None
    fps_low: float | None = None
    fps_high: float | None = None
    deadline_misses: int
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

    @field_validator("fps")
    @classmethod
    def _know_no_rate_of_one_frame(cls, fps: float | None, known: ValidationInfo) -> float | None:
        """Return None if fewer than two frames were presented; ledgers and older reports have the rate 0 then."""
        frames = known.data.get("frames")
        return fps if frames is None or frames.presented > 1 else None


class RunMetrics(PolicyMetrics):
    """All figures of a run.

    `clock`: `host`, measured on this machine, or `virtual`, computed from a hardware profile.
    `duration_s`: time in seconds from when all units are ready to the end of the run.
    `percentiles`: text that says whether percentiles are exact or from a sketch, with its error; on the host clock.
    `xrbench`: XRBench's scores.
    `edge`: edge rule; if edges have different rules, all rules, joined by commas.
    `idle_cores`: text that says whether cores without work stayed awake, or why not; on the host clock.
    `other_programs`: share of other programs in the time of the run's cores; null if a unit died.
    `processor`: clock and throttling of the run's cores; null in virtual time and in older reports.
    `streams`: ages of the newest frames that jobs took from a stream, by the name of the stage that writes it.
    `caps`, `temperature_c`: caps and temperatures of a capped run.
    """

    clock: Literal["host", "virtual"]
    duration_s: float
    percentiles: str = ""
    xrbench: XrBench
    edge: str = ""
    idle_cores: str = ""
    other_programs: float | None = None
    processor: ProcessorState | None = None
    streams: dict[str, NewestTaken] = Field(default={})
    caps: Caps | None = None
    temperature_c: Temperature | None = None


def metrics_in(report: Mapping[str, Any], where: str) -> RunMetrics:
    """Return the figures in the last record of a journal. Raises BadInputError for figures of a wrong form.

    `report`: report of the record. `where`: journal and record, as errors name them.
    """
    try:
        return RunMetrics.model_validate(report)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise BadInputError(f"{where}: {key}", first["msg"].lower(), "the figures of a run") from None
