"""The schema of a hardware profile: units, speeds, powers and limits, each number with its source.

Rule: every number is a `Quantity`, which states where the number is from; the unit of measure ends the key's name.
Only shapes and ranges are checked here.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from trilane.hw_profiles.engine_layers import TERMS
from trilane.unexpected_value import UnexpectedValue
from trilane.units import PERFORMANCE_PROFILES, UNITS, PerformanceProfile, UnitName

Corner = Literal["max", "turbo", "nominal_plus", "nominal", "svs_plus", "svs", "svs2"]
CORNERS: tuple[Corner, ...] = ("max", "turbo", "nominal_plus", "nominal", "svs_plus", "svs", "svs2")
Kind = Literal["measured", "published", "fitted", "assumed", "unknown"]
#: Relative error (standard deviation of the logarithm) of a kind of number, where its profile states none.
SPREAD_OF_KIND: dict[str, float] = {"measured": 0.05, "published": 0.1, "fitted": 0.15, "assumed": 0.5, "unknown": 1.0}
BYTES = {"int8": 1, "fp16": 2, "fp32": 4}


class Model(BaseModel):
    """Base of all tables: unknown keys are errors, and values never change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Quantity(Model):
    """A number, its kind and where it is from. One of kind `unknown` has no value.

    `spread`: its relative error, as the standard deviation of its logarithm; None for the usual one of its kind.
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
        """`spread`, or the usual one of the kind of number."""
        return SPREAD_OF_KIND[self.kind] if self.spread is None else self.spread

    def or_else(self, default: float) -> float:
        """The value, or `default` when it is unknown."""
        return default if self.value is None else self.value


class _Range:
    """Validator of a quantity's value, from `low` to `high`. Raises UnexpectedValue for any other."""

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


class Memory(Model):
    """The memory that the units share. `bandwidth_gb_s`: of the whole chip.

    `application_use_fraction`: share of it that camera, display and composition take.
    """

    bandwidth_gb_s: Rate
    application_use_fraction: Annotated[Quantity, AfterValidator(_Range(0, 0.95))]


class Efficiencies(Model):
    """Reached share of a peak: of arithmetic for the first three, of memory bandwidth for the others.

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


#: An engine's numbers are those of a precision under a runtime.
EngineName = Literal["int8_tflite", "int8_qnn_dlc", "fp16_tflite", "fp16_qnn_dlc"]
EngineRuntime = Literal["tflite", "qnn_dlc"]
ENGINE_RUNTIMES: tuple[EngineRuntime, ...] = ("tflite", "qnn_dlc")
ENGINES: tuple[EngineName, ...] = ("int8_tflite", "int8_qnn_dlc", "fp16_tflite", "fp16_qnn_dlc")


class EngineRates(Model):
    """The six numbers of a chip: products, activations on the chip, activations that do not fit there, weights; what an
    operator and a job cost besides.
    """

    arithmetic_tmac_s: Rate
    activation_gb_s: Rate
    spill_gb_s: Rate
    weight_gb_s: Rate
    operator_us: Cost
    job_us: Cost


#: Rate of a term -> key of `EngineRates`, and how many of what it counts are one of the key's unit of measure.
KEY_OF_RATE = {
    "arithmetic": ("arithmetic_tmac_s", 1e12),
    "activation": ("activation_gb_s", 1e9),
    "spill": ("spill_gb_s", 1e9),
    "weight": ("weight_gb_s", 1e9),
    "operator": ("operator_us", 1e-6),
    "job": ("job_us", 1e-6),
}


class Engine(Model):
    """A tensor engine at one precision under one runtime.

    `on_chip_mb`: activations that it holds. `factors`: how much dearer each term of `engine_layers.py` is than a plain
    convolution's; 1 where none is given. `error_fraction`: relative error of the model itself, apart from that of its
    numbers, for a network that shares no term with those that the numbers were fitted to; `seen`: each of these, with
    the terms' shares in its time.
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
        """How much dearer `term` is."""
        return self.factors[term].or_else(1.0) if term in self.factors else 1.0

    def seconds_per_unit(self, rate: str) -> float:
        """Seconds of one product, one element of one activation or weight, one operator, or one job."""
        key, unit = KEY_OF_RATE[rate]
        value: float = getattr(self.rates, key).or_else(1.0)
        if rate in ("operator", "job"):
            return value * unit
        return (1 if rate == "arithmetic" else self.element_bytes) / (value * unit)


class Measured(Model):
    """What was measured of a network on a unit of this machine.

    `slower`: by threads, how many times longer it took than by the unit's numbers. `error`: relative, of a time that
    follows. `said`: how it was measured.
    """

    slower: dict[int, float] = Field(min_length=1)
    error: float = Field(ge=0)
    said: str


class Unit(Model):
    """One unit. `fallback`: ONNX operators that it cannot run and hands to the CPU.

    `channel_block`: channel counts are rounded up to it. `job_fixed_ms` is paid once a job, `operator_fixed_us` once
    an operator, `input_ns_per_element` for each element of the network's input, `permute_fixed_ms` where the picture
    comes in several tensors. `corners`: clock at each voltage corner as a fraction of the highest. While a job runs
    the unit takes `power_max_w` times the clock fraction to the power of `power_exponent`, and `idle_w` otherwise.
    `model_error_fraction`: relative error of the roofline itself, apart from that of its numbers. `runtimes`: how many
    times faster than ONNX Runtime in FP32 each runtime runs an INT8 network; only the host's DSP unit has them. `core`:
    units with the same one, unless it is empty, work in turns: on a host with too few cores. `engines`: a tensor
    engine's numbers by precision and runtime, of which `engine_runtime` is taken; a unit without is priced by
    `efficiency`. Of this machine alone: `threads` have the peak rates together; `measured`: where it was.
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
        """The clock at `corner` as a fraction of the highest."""
        return self.corners[corner].or_else(1.0)

    def power_w(self, corner: Corner, busy: float) -> float:
        """Mean power in watts at `corner` when the unit works for a share `busy` of the time."""
        active: float = self.power_max_w.or_else(1.0) * self.clock(corner) ** self.power_exponent.or_else(3.0)
        return busy * active + (1 - busy) * self.idle_w.or_else(0.0)

    @property
    def slower(self) -> float:
        """How many times longer it takes than by its numbers."""
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


class Application(Model):
    """The stages beside the network. Times at the `max` corner.

    `raster_ns_per_pixel` and `raster_ns_per_vertex` on the GPU; `readback_ns_per_byte` from GPU memory to the network's
    input, done with the GPU held; `handover_ms` from the end of the read-back to the network's start, with its unit
    held; `composite_ms` on the GPU; `pose_ms` on the CPU; `display_ms` the shortest interval between shown frames.
    `vertices` and `pose_ms` are those of one avatar.
    `ema20_half_range_fraction`: how far the exponential average over 20 frames strays from the mean.
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


class PerformanceSettings(Model):
    """A performance profile: the corner of each unit, and how soon an idle unit may sleep."""

    cpu: Corner
    gpu: Corner
    dsp: Corner
    sleep_latency_us: Cost

    def corner(self, unit: UnitName) -> Corner:
        """The corner of `unit`."""
        corner: Corner = getattr(self, unit)
        return corner


class Thermal(Model):
    """The device as a slow thermal mass under the junction of each unit, its limits, and the governor that keeps them.

    `governor`: of the Linux thermal framework. `poll_s`: how often it looks.
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


class Profile(Model):
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
