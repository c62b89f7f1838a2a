"""Predictions as typed records: an application on a chip (`predict.py`), and a network by itself (`network_time.py`).

Rule: fields stand in the order of the document of `trilane predict --json`. A field that was not set is left out of it.
"""

from __future__ import annotations

from typing import Any, Final, Literal

from pydantic import Field

from trilane.hw_profiles.rates import DevicePower, FrameInterval, HeldRate, PowerLimit
from trilane.pipeline.run_metrics import Record, Temperature, TimeSummary
from trilane.units import UnitName

#: Relative error by which two computations of the same rate may differ.
ROUNDED: Final = 1e-6


class ChipName(Record):
    """A chip. `profile`: name of its hardware profile. `title`: title for a person."""

    profile: str
    title: str


class PredictedConfig(Record):
    """The application that was predicted.

    `avatar`, `network`, `encoder`, `norm`: keys that identify the network; the other keys are absent.
    `size`: HxW of its tensor. `channels`, `layout`: channels of the tensor, and their layout.
    `fps`: rate that limits the application, or at which the policy releases frames.
    `gpu_share`: share of the network on the GPU. `minutes`: virtual time from a cold start.
    The other fields are the policy, and the options of the same names.
    """

    avatar: str = ""
    network: str = ""
    encoder: str = ""
    norm: str = ""
    size: str
    channels: int
    layout: str
    unit: UnitName
    policy: str
    edge: str
    batch: int
    fps: float
    gpu_share: float
    performance_profile: str
    minutes: float
    governor: str


class PredictedNetwork(Record):
    """The network of an application.

    `parameters_m`, `gmac`: millions of parameters, and billions of multiplications.
    `alone_ms`: time of one inference by itself, the sum of `parts_ms`.
    `low_ms`, `high_ms`: 80 % interval of this time, null if unknown. `why`: reasons for the interval's width.
    """

    parameters_m: float
    gmac: float
    alone_ms: float
    parts_ms: dict[str, int | float]
    low_ms: float | None
    high_ms: float | None
    why: tuple[str, ...]


class PredictedTimes(TimeSummary):
    """Times between shown frames in ms: mean, percentiles and maximum over the moments of the course over minutes.

    `ema20_min`, `ema20_max`: range of the exponential average over 20 frames.
    `low`, `high`: 80 % interval of the mean; null if unknown.
    """

    mean: float
    ema20_min: float
    ema20_max: float
    low: float | None
    high: float | None


class MeanTime(Record):
    """A mean time in ms; null if it is not known."""

    mean: float | None


class PredictedStage(Record):
    """A stage. `unit`: its unit. `service_ms`: time of a job."""

    unit: UnitName
    service_ms: MeanTime


class PredictedUnit(Record):
    """A unit. `busy`: share of the time in which it works. `idle`: shares of the rest of the time, by cause."""

    busy: float
    idle: dict[str, float]


class Throttling(Record):
    """How long heat lowered a unit.

    `throttled_share`: share of the time in which a unit was throttled.
    `first_throttled_s`: time of the first throttled moment in seconds; null without one.
    """

    throttled_share: float
    first_throttled_s: float | None


class ApplicationPrediction(Record):
    """The prediction of one configuration, with the keys of report.json and further keys.

    `machine`, `config`, `network`: chip, application and network.
    `frame_time_ms`, `fps`, `power_w`: with a course over minutes, means over it. `latency_ms`, `stages`, `units`,
    `efficiency`: at the corners of the performance profile.
    `fps_start`, `fps_settled`: rate at the first moment, and in the last fifth of the moments.
    `display_capped`: whether the display or the wanted rate limits the rate at the first moment.
    `stages`, `units`: by name. `efficiency`: time of the slowest unit's stages, divided by the frame time.
    `power_w`: power of the device, watts. `base_power_w`: its part without the units.
    `base_power_kind`: kind of the profile's number. `power`: power of the settled device.
    `temperature_c`, `caps`, `timeline`: course over minutes; without one, no temperature is set.
    `rate`, `power_limit`: answers about the rate and the limit that were wanted.
    `expected_error`: relative error of the network's time; null if unknown.
    `confidence`: 1 - `expected_error`, at least 0; null if unknown.
    `placement`: cores of this machine's units; absent for a chip. `notes`: sentences for the reader of the figures.
    `alternatives`: rows of `what_if`; absent if nobody asked for them.
    """

    schema_: Literal[1] = Field(alias="schema")
    clock: Literal["virtual"]
    machine: ChipName
    config: PredictedConfig
    network: PredictedNetwork
    frame_time_ms: PredictedTimes
    latency_ms: MeanTime
    fps: float
    fps_start: float
    fps_settled: float
    display_capped: bool
    stages: dict[str, PredictedStage]
    units: dict[UnitName, PredictedUnit]
    efficiency: float
    power_w: float
    base_power_w: float
    base_power_kind: str
    power: DevicePower
    energy_mj_per_frame: float
    xrbench: dict[str, float]
    temperature_c: Temperature
    caps: Throttling
    timeline: tuple[dict[str, Any], ...]
    rate: HeldRate | None = None
    power_limit: PowerLimit | None = None
    expected_error: float | None
    confidence: float | None
    placement: dict[str, Any] = Field(default={})
    notes: tuple[str, ...]
    alternatives: tuple[dict[str, Any], ...] = ()

    @property
    def frame(self) -> FrameInterval:
        """The mean frame time, with its interval."""
        return FrameInterval(self.frame_time_ms.mean, self.frame_time_ms.low, self.frame_time_ms.high)

    @property
    def is_capped_throughout(self) -> bool:
        """Whether the display or the wanted rate limits the rate at every moment, so that heat takes nothing of it."""
        return self.display_capped and self.fps > self.fps_start * (1 - ROUNDED)


class OperatorRow(Record):
    """An operator of a predicted network.

    `name`, `op_type`: name and ONNX type. `ms`: time. `share`: part of the network's time, 0 to 1.
    `bound`: resource that takes the largest part of the time. `macs`: multiplications.
    `elements`: elements that it moves.
    """

    name: str
    op_type: str
    ms: float
    share: float
    bound: str
    macs: int
    elements: int


class UnruledRow(Record):
    """An operator type without a rule: number of operators, and their share of all moved elements."""

    op_type: str
    count: int
    share_of_elements: float


class NetworkPrediction(Record):
    """The prediction of one network on one unit.

    `file`: path of the network. `unit`: unit that runs it. `numbers`: number format of the file.
    `precision`, `engine_runtime`: precision and runtime of the unit; the runtime is null without a tensor engine.
    `parameters_m`, `gmac`: millions of parameters, and billions of multiplications.
    `network_ms`: time of one inference. `low_ms`, `high_ms`: its 80 % interval, null if unknown. `why`: reasons for it.
    `fps`: inferences a second. `job_ms`: time that belongs to no operator.
    `operators`, `without_rule`: operators in the order of the file, and operator types without a rule.
    `power`: power of the settled device. `rate`, `power_limit`: answers about the rate and the limit that were wanted.
    The fields from `fps_start` to `timeline` are absent unless minutes were asked for.
    """

    file: str
    unit: UnitName
    numbers: str
    precision: str
    engine_runtime: str | None
    parameters_m: float
    gmac: float
    network_ms: float
    low_ms: float | None
    high_ms: float | None
    why: tuple[str, ...]
    fps: float
    job_ms: float
    operators: tuple[OperatorRow, ...]
    without_rule: tuple[UnruledRow, ...]
    power: DevicePower
    rate: HeldRate | None = None
    power_limit: PowerLimit | None = None
    fps_start: float | None = None
    fps_settled: float | None = None
    temperature_c: Temperature | None = None
    caps: Throttling | None = None
    timeline: tuple[dict[str, Any], ...] = ()

    @property
    def frame(self) -> FrameInterval:
        """The time of one inference, with its interval."""
        return FrameInterval(self.network_ms, self.low_ms, self.high_ms)
