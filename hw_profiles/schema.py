"""The schema of a hardware profile: units, speeds, powers and limits, each number with its source.

Every number is a `Quantity`, which states where the number is from; the unit of measure ends the key's name. The
schema checks shapes and ranges only. `corners_of` tells the corner of each unit under a performance profile.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from trilane.errors import BadInputError
from trilane.hw_profiles.engine_layers import TERMS
from trilane.unexpected_value import UnexpectedValue
from trilane.units import PERFORMANCE_PROFILES, UNITS, PerformanceProfile, UnitName

Corner = Literal["max", "turbo", "nominal_plus", "nominal", "svs_plus", "svs", "svs2"]
CORNERS: tuple[Corner, ...] = ("max", "turbo", "nominal_plus", "nominal", "svs_plus", "svs", "svs2")
Kind = Literal["measured", "published", "fitted", "assumed", "unknown"]
#: Relative error (standard deviation of the logarithm) of a kind of number, where its profile states none.
SPREAD_OF_KIND: dict[str, float] = {"measured": 0.05, "published": 0.1, "fitted": 0.15, "assumed": 0.5, "unknown": 1.0}
#: Standard deviations from the mean within which 80 % of a normal distribution lie.
NORMAL_80 = 1.2816
#: Intervals of more than 20 times the stated error say nothing.
MOST_ERROR_SCALE = 20.0
BYTES = {"int8": 1, "fp16": 2, "fp32": 4}

Corners = tuple[Corner, Corner, Corner]


class ProfileTable(BaseModel):
    """Base of all tables: unknown keys are errors, and values never change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Quantity(ProfileTable):
    """A number, its kind and its source. A quantity of kind `unknown` has no value.

    `spread`: relative error, as the standard deviation of the value's logarithm; None for the usual error of its kind.
    """

    value: float | None = Field(default=None, allow_inf_nan=False, strict=True)
    kind: Kind
    source: str = Field(min_length=1)
    spread: float | None = Field(default=None, ge=0, le=5)

    @model_validator(mode="after")
    def _value_or_unknown(self) -> Self:
        if (self.value is None) != (self.kind == "unknown"):
            amount = "no value" if self.value is None else "a value"
            raise UnexpectedValue(f'{amount} under kind = "{self.kind}"', 'one unless kind = "unknown"')
        return self

    @property
    def relative_error(self) -> float:
        """`spread`, or the usual error of this kind of number."""
        return SPREAD_OF_KIND[self.kind] if self.spread is None else self.spread

    def or_else(self, default: float) -> float:
        """Return the value, or `default` when it is unknown."""
        return default if self.value is None else self.value


class _Range:
    """Validator of a quantity's value, from `low` to `high`. Raises UnexpectedValue for a value outside."""

    def __init__(self, low: float, high: float) -> None:
        self.low, self.high = low, high

    def __call__(self, quantity: Quantity) -> Quantity:
        if quantity.value is not None and not self.low <= quantity.value <= self.high:
            raise UnexpectedValue(f"{quantity.value:g}", f"{self.low:g} to {self.high:g}")
        return quantity


Rate = Annotated[Quantity, AfterValidator(_Range(1e-6, 1e5))]
Fraction = Annotated[Quantity, AfterValidator(_Range(1e-6, 1))]
Efficiency = Annotated[Quantity, AfterValidator(_Range(1e-6, 4))]
Cost = Annotated[Quantity, AfterValidator(_Range(0, 1e6))]
Power = Annotated[Quantity, AfterValidator(_Range(0, 1000))]
Celsius = Annotated[Quantity, AfterValidator(_Range(-50, 200))]
Resistance = Annotated[Quantity, AfterValidator(_Range(1e-3, 1000))]
Seconds = Annotated[Quantity, AfterValidator(_Range(1e-3, 1e6))]
Count = Annotated[Quantity, AfterValidator(_Range(1, 1e6))]


class Memory(ProfileTable):
    """The memory that the units share.

    `bandwidth_gb_s`: bandwidth of the whole chip. `application_use_fraction`: share of it that camera, display and
    composition take.
    """

    bandwidth_gb_s: Rate
    application_use_fraction: Annotated[Quantity, AfterValidator(_Range(0, 0.95))]


class Efficiencies(ProfileTable):
    """Reached share of a peak: a peak of arithmetic for the first three, of memory bandwidth for the others.

    `*_traffic` are the shares of bandwidth that the products reach when traffic bounds them. Winograd and similar
    shortcuts may take an arithmetic share above 1.
    """

    convolution: Efficiency
    depthwise: Efficiency
    pointwise: Efficiency
    convolution_traffic: Efficiency
    depthwise_traffic: Efficiency
    pointwise_traffic: Efficiency
    normalisation: Efficiency
    resize: Efficiency
    elementwise: Efficiency
    permute: Efficiency


#: A precision under a runtime: each has numbers of its own.
EngineName = Literal["int8_tflite", "int8_qnn_dlc", "fp16_tflite", "fp16_qnn_dlc"]
EngineRuntime = Literal["tflite", "qnn_dlc"]
ENGINE_RUNTIMES: tuple[EngineRuntime, ...] = ("tflite", "qnn_dlc")
ENGINES: tuple[EngineName, ...] = ("int8_tflite", "int8_qnn_dlc", "fp16_tflite", "fp16_qnn_dlc")


class EngineRates(ProfileTable):
    """The six numbers of a chip.

    They are the rates of products, of activations on the chip, of activations that do not fit there and of weights, and
    the fixed cost of an operator and of a job.
    """

    arithmetic_tmac_s: Rate
    activation_gb_s: Rate
    spill_gb_s: Rate
    weight_gb_s: Rate
    operator_us: Cost
    job_us: Cost


#: Rate of a term -> key of `EngineRates`, and the factor from the key's unit of measure to base units.
KEY_OF_RATE = {
    "arithmetic": ("arithmetic_tmac_s", 1e12),
    "activation": ("activation_gb_s", 1e9),
    "spill": ("spill_gb_s", 1e9),
    "weight": ("weight_gb_s", 1e9),
    "operator": ("operator_us", 1e-6),
    "job": ("job_us", 1e-6),
}


class Engine(ProfileTable):
    """A tensor engine at one precision under one runtime.

    `on_chip_mb`: megabytes of activations that it holds. `factors`: how many times dearer each term of
    `engine_layers.py` is than a plain convolution's; 1 where none is given. `error_fraction`: relative error of the
    model itself, apart from that of its numbers, for a network that shares no term with the networks of the fit.
    `seen`: each network of the fit, with the terms' shares in its time.
    """

    element_bytes: Literal[1, 2]
    on_chip_mb: Rate
    rates: EngineRates
    factors: dict[str, Rate] = {}
    seen: dict[str, dict[str, Annotated[float, Field(ge=0, le=1)]]] = {}
    error_fraction: Annotated[Quantity, AfterValidator(_Range(0, 5))]

    @model_validator(mode="after")
    def _known_factors(self) -> Self:
        for name in self.factors:
            if name not in TERMS:
                raise UnexpectedValue(f"the unknown factor `{name}`", "one of " + ", ".join(TERMS))
        return self

    def factor(self, term: str) -> float:
        """Return how many times dearer `term` is than a plain convolution's."""
        return self.factors[term].or_else(1.0) if term in self.factors else 1.0

    def seconds_per_unit(self, rate: str) -> float:
        """Return the seconds of a product, of an element of an activation or weight, of an operator, or of a job."""
        key, unit = KEY_OF_RATE[rate]
        value: float = getattr(self.rates, key).or_else(1.0)
        if rate in ("operator", "job"):
            return value * unit
        return (1 if rate == "arithmetic" else self.element_bytes) / (value * unit)


class Measured(ProfileTable):
    """The measurement of a network on a unit of this machine.

    `slower`: by number of threads, the measured time over the time by the unit's numbers. `error`: relative error of a
    time that follows from it. `said`: sentence that tells how it was measured.
    """

    slower: dict[int, float] = Field(min_length=1)
    error: float = Field(ge=0)
    said: str


class Unit(ProfileTable):
    """One unit.

    `fallback`: ONNX operators that it cannot run and hands to the CPU. `channel_block`: block to which channel counts
    are rounded up. `job_fixed_ms` is paid once a job, `operator_fixed_us` once an operator, `input_ns_per_element` for
    each element of the network's input, `permute_fixed_ms` where the picture comes in several tensors. `corners`: clock
    at each voltage corner as a fraction of the highest. While a job runs the unit takes `power_max_w` times the clock
    fraction to the power of `power_exponent`, and `idle_w` otherwise. `model_error_fraction`: relative error of the
    roofline itself, apart from that of its numbers. `error_scale`: how many times the error that all these numbers
    state is to be expected, as own rows showed; None without any. `runtimes`: how many times faster than ONNX Runtime
    in FP32 each runtime runs an INT8 network; only the host's DSP unit has them. `core`: units with the same text share
    a core and work in turns, as on a host with too few cores; empty for a unit of its own. `engines`: numbers of a
    tensor engine by precision and runtime, from which `engine_runtime` chooses; a unit without any is priced by
    `efficiency`. Only this machine's units have `threads`, which share the peak rates, and `measured`.
    """

    title: str
    core: str = ""
    threads: int = Field(default=1, ge=1)
    measured: Measured | None = None
    precision: Literal["int8", "fp16", "fp32"]
    peak_int8_tmac_s: Rate
    peak_fp16_tmac_s: Rate
    peak_fp32_tmac_s: Rate
    channel_block: Count
    job_fixed_ms: Cost
    operator_fixed_us: Cost
    input_ns_per_element: Cost
    permute_fixed_ms: Cost
    fallback: tuple[str, ...] = ()
    fallback_fixed_ms: Cost
    fallback_ns_per_element: Cost
    model_error_fraction: Annotated[Quantity, AfterValidator(_Range(0, 5))]
    error_scale: Annotated[Quantity, AfterValidator(_Range(0, MOST_ERROR_SCALE))] | None = None
    efficiency: Efficiencies
    runtimes: dict[str, Rate] = {}
    engines: dict[EngineName, Engine] = {}
    engine_runtime: EngineRuntime = "tflite"
    corners: dict[Corner, Fraction]
    power_max_w: Power
    power_exponent: Annotated[Quantity, AfterValidator(_Range(0, 6))]
    idle_w: Power
    junction_k_per_w: Resistance
    junction_time_s: Seconds

    @model_validator(mode="after")
    def _all_corners(self) -> Self:
        missing = [corner for corner in CORNERS if corner not in self.corners]
        if missing:
            raise UnexpectedValue(f"no corner {', '.join(missing)}", f"all of {', '.join(CORNERS)}")
        return self

    def clock(self, corner: Corner) -> float:
        """Return the clock at `corner` as a fraction of the highest."""
        return self.corners[corner].or_else(1.0)

    def power_w(self, corner: Corner, busy: float) -> float:
        """Return the mean power in watts at `corner` when the unit works for a share `busy` of the time."""
        active: float = self.power_max_w.or_else(1.0) * self.clock(corner) ** self.power_exponent.or_else(3.0)
        return busy * active + (1 - busy) * self.idle_w.or_else(0.0)

    @property
    def slower(self) -> float:
        """How many times longer the unit takes than its numbers say; 1 where nothing was measured."""
        return 1.0 if self.measured is None else self.measured.slower[self.threads]

    @property
    def peak(self) -> Quantity:
        """Highest multiply-accumulates per second at the unit's precision, in tera."""
        peak: Quantity = getattr(self, f"peak_{self.precision}_tmac_s")
        return peak

    @property
    def peak_mac_s(self) -> float:
        """Highest multiply-accumulates per second at the unit's precision."""
        return self.peak.or_else(0.1) * 1e12

    @property
    def engine(self) -> Engine | None:
        """The tensor engine at the unit's precision, if it has one."""
        return next((e for name, e in self.engines.items() if name == f"{self.precision}_{self.engine_runtime}"), None)

    @property
    def element_bytes(self) -> int:
        """Bytes of one element at the unit's precision."""
        return BYTES[self.precision]


class Application(ProfileTable):
    """The stages beside the network. Times are those at the `max` corner.

    `raster_ns_per_pixel` and `raster_ns_per_vertex`: drawing on the GPU. `readback_ns_per_byte`: from GPU memory to the
    network's input, with the GPU held. `handover_ms`: from the end of the read-back to the network's start, with the
    network's unit held. `composite_ms`: on the GPU. `pose_ms`: on the CPU. `display_ms`: shortest interval between
    shown frames. `vertices` and `pose_ms` are those of one avatar. `ema20_half_range_fraction`: how far the exponential
    average over 20 frames strays from the mean, as a fraction of it.
    """

    vertices: Annotated[Quantity, AfterValidator(_Range(0, 1e7))]
    pose_ms: Cost
    raster_ns_per_vertex: Cost
    raster_ns_per_pixel: Cost
    readback_ns_per_byte: Cost
    handover_ms: Cost
    composite_ms: Cost
    present_ms: Cost
    display_ms: Cost
    ema20_half_range_fraction: Annotated[Quantity, AfterValidator(_Range(0, 1))]


class PerformanceSettings(ProfileTable):
    """A performance profile: the corner of each unit, and how soon an idle unit may sleep."""

    cpu: Corner
    gpu: Corner
    dsp: Corner
    sleep_latency_us: Cost

    def corner(self, unit: UnitName) -> Corner:
        """Return the corner of `unit`."""
        corner: Corner = getattr(self, unit)
        return corner


class Thermal(ProfileTable):
    """The device as a slow thermal mass under the junction of each unit, its limits, and the governor that keeps them.

    `governor`: name of a governor of the Linux thermal framework. `poll_s`: seconds between two of its looks.
    """

    ambient_c: Celsius
    base_power_w: Power
    device_k_per_w: Resistance
    device_time_s: Seconds
    skin_limit_c: Celsius
    junction_limit_c: Celsius
    hysteresis_k: Cost
    governor: Literal["step_wise", "power_allocator"]
    poll_s: Seconds


class Profile(ProfileTable):
    """A chip in a device. `template`: whether it describes no chip and is only there to be extended."""

    name: str = Field(min_length=1)
    title: str
    template: bool = False
    memory: Memory
    units: dict[UnitName, Unit]
    application: Application
    performance_profiles: dict[PerformanceProfile, PerformanceSettings]
    thermal: Thermal

    @model_validator(mode="after")
    def _complete(self) -> Self:
        for what, names, stated in (
            ("unit", UNITS, self.units),
            ("performance profile", PERFORMANCE_PROFILES, self.performance_profiles),
        ):
            missing = [name for name in names if name not in stated]
            if missing:
                raise UnexpectedValue(f"no {what} {', '.join(missing)}", f"all of {', '.join(names)}")
        if (self.thermal.skin_limit_c.value or 0) <= (self.thermal.ambient_c.value or 0):
            raise UnexpectedValue("thermal.skin_limit_c at or below thermal.ambient_c", "it above")
        return self


def corners_of(profile: Profile, performance_profile: str) -> Corners:
    """Return corners of cpu, gpu and dsp. Raises BadInputError for a name that is no performance profile."""
    for name, settings in profile.performance_profiles.items():
        if name == performance_profile:
            return settings.cpu, settings.gpu, settings.dsp
    known = ", ".join(profile.performance_profiles)
    raise BadInputError("performance profile", repr(performance_profile), f"one of {known}")
