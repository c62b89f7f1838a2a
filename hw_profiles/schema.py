"""The schema of a hardware profile: units, speeds, powers and limits, each number with its source.

Every number is a `Quantity`, which states the number's source; the unit of measure ends the key's name. The schema
checks only types and ranges. `corners_of` returns the corner of each unit under a performance profile.
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Annotated, Final, Literal, Self, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from trilane.errors import BadInputError
from trilane.hw_profiles.operators import TERMS
from trilane.unexpected_value import UnexpectedValue
from trilane.units import PERFORMANCE_PROFILES, UNITS, PerformanceProfile, UnitName

Corner = Literal["max", "turbo", "nominal_plus", "nominal", "svs_plus", "svs", "svs2"]
CORNERS: tuple[Corner, ...] = get_args(Corner)
Kind = Literal["measured", "published", "fitted", "assumed", "unknown"]
#: Relative error (standard deviation of the logarithm) of a number by its kind, if the profile states none.
SPREAD_OF_KIND: dict[str, float] = {"measured": 0.05, "published": 0.1, "fitted": 0.15, "assumed": 0.5, "unknown": 1.0}
#: Probability with which an interval of a prediction contains the true value, as a number and in words.
SHARE: Final = 0.8
SHARE_TEXT: Final = f"{100 * SHARE:.0f} %"
#: Number of standard deviations from the mean within which this share of a normal distribution lies.
SIGMAS: Final = round(NormalDist().inv_cdf((1 + SHARE) / 2), 4)
#: Largest `error_scale`: an interval of 20 times the stated error says nothing any more.
MOST_ERROR_SCALE = 20.0
BYTES = {"int8": 1, "fp16": 2, "fp32": 4}

Corners = tuple[Corner, Corner, Corner]


def interval_around(middle: float, error: float) -> tuple[float, float]:
    """Return the ends of the interval around `middle` that contains the true value with probability SHARE.

    `error`: standard deviation of the value's logarithm.
    """
    factor = math.exp(SIGMAS * error)
    return middle / factor, middle * factor


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
        """Return the value, or `default` for an unknown value."""
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
    """The chip's main memory, which all units share."""

    bandwidth_gb_s: Rate = Field(description="Bandwidth of the memory of the whole chip.")
    application_use_fraction: Annotated[Quantity, AfterValidator(_Range(0, 0.95))] = Field(
        description="Share of the bandwidth that camera, display and composition take."
    )


class Efficiencies(ProfileTable):
    """Share of a peak that each kind of operator reaches.

    With Winograd and similar shortcuts, a share of arithmetic may exceed 1.
    """

    convolution: Efficiency = Field(description="Of convolutions: share of the peak of arithmetic.")
    depthwise: Efficiency = Field(description="Of depthwise convolutions: share of the peak of arithmetic.")
    pointwise: Efficiency = Field(description="Of 1x1 convolutions: share of the peak of arithmetic.")
    convolution_traffic: Efficiency = Field(
        description="Of convolutions that memory traffic bounds: share of the bandwidth."
    )
    depthwise_traffic: Efficiency = Field(
        description="Of depthwise convolutions that memory traffic bounds: share of the bandwidth."
    )
    pointwise_traffic: Efficiency = Field(
        description="Of 1x1 convolutions that memory traffic bounds: share of the bandwidth."
    )
    normalisation: Efficiency = Field(description="Of normalisation: share of the bandwidth.")
    resize: Efficiency = Field(description="Of resizing: share of the bandwidth.")
    elementwise: Efficiency = Field(description="Of elementwise operators: share of the bandwidth.")
    permute: Efficiency = Field(description="Of permutations: share of the bandwidth.")


#: A precision under a runtime: each has numbers of its own.
EngineName = Literal["int8_tflite", "int8_qnn_dlc", "fp16_tflite", "fp16_qnn_dlc"]
EngineRuntime = Literal["tflite", "qnn_dlc"]
ENGINE_RUNTIMES: tuple[EngineRuntime, ...] = get_args(EngineRuntime)
ENGINES: tuple[EngineName, ...] = get_args(EngineName)


class EngineRates(ProfileTable):
    """The six rates of a tensor engine of a chip."""

    arithmetic_tmac_s: Rate = Field(description="Rate of products.")
    activation_gb_s: Rate = Field(description="Rate of activations that fit on the chip.")
    spill_gb_s: Rate = Field(description="Rate of activations that do not fit on the chip.")
    weight_gb_s: Rate = Field(description="Rate of weights.")
    operator_us: Cost = Field(description="Fixed time of an operator.")
    job_us: Cost = Field(description="Fixed time of a job.")


#: By the name of a rate: (its key in `EngineRates`, factor from the key's unit of measure to base units).
KEY_OF_RATE = {
    "arithmetic": ("arithmetic_tmac_s", 1e12),
    "activation": ("activation_gb_s", 1e9),
    "spill": ("spill_gb_s", 1e9),
    "weight": ("weight_gb_s", 1e9),
    "operator": ("operator_us", 1e-6),
    "job": ("job_us", 1e-6),
}


class Engine(ProfileTable):
    """A tensor engine at one precision under one runtime."""

    element_bytes: Literal[1, 2] = Field(description="Bytes of one element.")
    on_chip_mb: Rate = Field(description="Memory for activations on the chip, MiB.")
    rates: EngineRates = Field(description="The numbers of the chip; the next table lists them.")
    factors: dict[str, Rate] = Field(
        default={},
        description=("How many times more each term of `operators.py` costs than a plain convolution; 1 if not given."),
    )
    seen: dict[str, dict[str, Annotated[float, Field(ge=0, le=1)]]] = Field(
        default={}, description="Each network of the fit, with the share of its time that each term takes."
    )
    error_fraction: Annotated[Quantity, AfterValidator(_Range(0, 5))] = Field(
        description=(
            "Relative error of the model itself, without that of its numbers, for a network that "
            "shares no term with the networks of the fit."
        )
    )

    @model_validator(mode="after")
    def _known_factors(self) -> Self:
        for name in self.factors:
            if name not in TERMS:
                raise UnexpectedValue(f"the unknown factor `{name}`", "one of " + ", ".join(TERMS))
        return self

    def factor(self, term: str) -> float:
        """Return the cost of `term` divided by the cost of the term that defines the unit of its rate."""
        return self.factors[term].or_else(1.0) if term in self.factors else 1.0

    def seconds_per_unit(self, rate: str) -> float:
        """Return the time in seconds of one unit of `rate`: a product, an element, an operator or a job."""
        key, unit = KEY_OF_RATE[rate]
        value: float = getattr(self.rates, key).or_else(1.0)
        if rate in ("operator", "job"):
            return value * unit
        return (1 if rate == "arithmetic" else self.element_bytes) / (value * unit)


class Measured(ProfileTable):
    """The measurement of a network on a unit of this machine."""

    slower: dict[int, float] = Field(
        min_length=1, description="By number of threads: measured time over the time that the unit's numbers give."
    )
    error: float = Field(ge=0, description="Relative error of a time that is computed with `slower`.")
    said: str = Field(description="A sentence about how it was measured.")


class Unit(ProfileTable):
    """A unit of the chip: its speeds, errors, clocks, power and thermal resistance.

    While a job runs, the unit takes `power_max_w` times the clock's fraction to the power of `power_exponent`.
    """

    title: str = Field(description="Name of the unit for people.")
    core: str = Field(
        default="",
        description=(
            "Units with the same text share a core and take turns, as on a host with few cores; empty "
            "for a unit of its own."
        ),
    )
    threads: int = Field(
        default=1, ge=1, description="Threads that share the peak rates; only for this machine's units."
    )
    measured: Measured | None = Field(
        default=None, description="A measurement on this machine; only for this machine's units."
    )
    precision: Literal["int8", "fp16", "fp32"] = Field(description="Number format in which the unit computes.")
    peak_int8_tmac_s: Rate = Field(description="Peak of arithmetic in INT8.")
    peak_fp16_tmac_s: Rate = Field(description="Peak of arithmetic in FP16.")
    peak_fp32_tmac_s: Rate = Field(description="Peak of arithmetic in FP32.")
    channel_block: Count = Field(description="Numbers of channels are rounded up to multiples of this.")
    job_fixed_ms: Cost = Field(description="Fixed time of a job.")
    operator_fixed_us: Cost = Field(description="Fixed time of an operator.")
    input_ns_per_element: Cost = Field(description="Time for each element of the network's input.")
    permute_fixed_ms: Cost = Field(description="Fixed time if the picture comes in several tensors.")
    fallback: tuple[str, ...] = Field(
        default=(), description="ONNX operators that the unit cannot run and hands to the CPU."
    )
    fallback_fixed_ms: Cost = Field(description="Fixed time of each operator that the CPU runs.")
    fallback_ns_per_element: Cost = Field(description="Time for each element that is handed to the CPU.")
    model_error_fraction: Annotated[Quantity, AfterValidator(_Range(0, 5))] = Field(
        description="Relative error of the roofline model itself, without that of its numbers."
    )
    error_scale: Annotated[Quantity, AfterValidator(_Range(0, MOST_ERROR_SCALE))] | None = Field(
        default=None, description="Factor on the stated errors, from measured rows of your own; none if not given."
    )
    efficiency: Efficiencies = Field(description="Reached shares of the peaks, for a unit without `engines`.")
    runtimes: dict[str, Rate] = Field(
        default={},
        description=(
            "How many times faster than ONNX Runtime in FP32 each runtime runs an INT8 network; only "
            "for the host's DSP unit."
        ),
    )
    engines: dict[EngineName, Engine] = Field(
        default={}, description="Numbers of a tensor engine, by precision and runtime."
    )
    engine_runtime: EngineRuntime = Field(default="tflite", description="Runtime whose engine is used.")
    corners: dict[Corner, Fraction] = Field(
        description="Clock at each voltage corner, as a fraction of the highest clock."
    )
    power_max_w: Power = Field(description="Power of a job at the highest clock.")
    power_exponent: Annotated[Quantity, AfterValidator(_Range(0, 6))] = Field(
        description="The power of a job grows with the clock to this exponent."
    )
    idle_w: Power = Field(description="Power without a job.")
    junction_k_per_w: Resistance = Field(description="Thermal resistance from the junction to the device.")
    junction_time_s: Seconds = Field(description="Thermal time constant of the junction.")

    @model_validator(mode="after")
    def _all_corners(self) -> Self:
        missing = [corner for corner in CORNERS if corner not in self.corners]
        if missing:
            raise UnexpectedValue(f"no corner {', '.join(missing)}", f"all of {', '.join(CORNERS)}")
        return self

    def clock(self, corner: Corner) -> float:
        """Return the clock at `corner` as a fraction of the highest clock."""
        return self.corners[corner].or_else(1.0)

    def power_w(self, corner: Corner, busy: float) -> float:
        """Return the mean power in watts at `corner` if the unit works for the share `busy` of the time."""
        active: float = self.power_max_w.or_else(1.0) * self.clock(corner) ** self.power_exponent.or_else(3.0)
        return busy * active + (1 - busy) * self.idle_w.or_else(0.0)

    @property
    def slower(self) -> float:
        """The measured time of the unit divided by the time that its numbers give; 1 without a measurement."""
        return 1.0 if self.measured is None else self.measured.slower[self.threads]

    @property
    def peak(self) -> Quantity:
        """The peak of multiply-accumulates at the unit's precision, in 1e12 per second."""
        peak: Quantity = getattr(self, f"peak_{self.precision}_tmac_s")
        return peak

    @property
    def peak_mac_s(self) -> float:
        """The peak of multiply-accumulates per second at the unit's precision; 1e11 if unknown."""
        return self.peak.or_else(0.1) * 1e12

    @property
    def engine(self) -> Engine | None:
        """The tensor engine for the unit's precision and runtime; None if the unit has none."""
        return next((e for name, e in self.engines.items() if name == f"{self.precision}_{self.engine_runtime}"), None)

    @property
    def element_bytes(self) -> int:
        """The bytes of one element at the unit's precision."""
        return BYTES[self.precision]


class Application(ProfileTable):
    """The stages other than the network. Times are those at the `max` corner."""

    vertices: Annotated[Quantity, AfterValidator(_Range(0, 1e7))] = Field(description="Vertices of one avatar.")
    pose_ms: Cost = Field(description="Time to pose one avatar on the CPU.")
    raster_ns_per_vertex: Cost = Field(description="Time on the GPU to draw, for each vertex.")
    raster_ns_per_pixel: Cost = Field(description="Time on the GPU to draw, for each pixel.")
    readback_ns_per_byte: Cost = Field(
        description="Time from GPU memory to the network's input, during which the GPU is held."
    )
    handover_ms: Cost = Field(
        description=(
            "Time from the end of the read-back to the network's start, during which the network's unit is held."
        )
    )
    composite_ms: Cost = Field(description="Time to composite on the GPU.")
    present_ms: Cost = Field(description="Time to present on the CPU.")
    display_ms: Cost = Field(description="Shortest interval between shown frames.")
    ema20_half_range_fraction: Annotated[Quantity, AfterValidator(_Range(0, 1))] = Field(
        description=("How far the exponential average over 20 frames strays from the mean, as a fraction of the mean.")
    )


class PerformanceSettings(ProfileTable):
    """A performance profile: the corner of each unit, and how soon an idle unit may sleep."""

    cpu: Corner = Field(description="Corner of the CPU.")
    gpu: Corner = Field(description="Corner of the GPU.")
    dsp: Corner = Field(description="Corner of the DSP.")
    sleep_latency_us: Cost = Field(description="Idle time after which a unit may sleep.")


class Thermal(ProfileTable):
    """The device as a slow thermal mass under each unit's junction, its limits, and the governor that keeps them."""

    ambient_c: Celsius = Field(description="Temperature of the surroundings.")
    base_power_w: Power = Field(description="Power of the device without its units.")
    device_k_per_w: Resistance = Field(description="Thermal resistance from the device to the surroundings.")
    device_time_s: Seconds = Field(description="Thermal time constant of the device.")
    skin_limit_c: Celsius = Field(description="Limit of the device's surface.")
    junction_limit_c: Celsius = Field(description="Limit of each junction.")
    hysteresis_k: Cost = Field(description="Cooling below a limit that is needed before clocks rise again.")
    governor: Literal["step_wise", "power_allocator"] = Field(description="Governor of the Linux thermal framework.")
    poll_s: Seconds = Field(description="Time between two polls of the governor.")

    @property
    def ambient(self) -> float:
        """The temperature of the surroundings, °C; 25 if unknown."""
        return self.ambient_c.or_else(25.0)

    @property
    def skin_limit(self) -> float:
        """The limit of the device's surface, °C; 45 if unknown."""
        return self.skin_limit_c.or_else(45.0)

    @property
    def resistance(self) -> float:
        """The thermal resistance from the device to the surroundings, K/W; 5 if unknown."""
        return self.device_k_per_w.or_else(5.0)


class Profile(ProfileTable):
    """A chip in a device."""

    name: str = Field(min_length=1, description="Name of the profile, as `--profile` takes it.")
    title: str = Field(description="Name of the chip for people.")
    template: bool = Field(
        default=False, description="Whether the profile describes no chip and exists only to be extended."
    )
    memory: Memory = Field(description="The shared memory.")
    units: dict[UnitName, Unit] = Field(description="The units, by name: `cpu`, `gpu`, `dsp`.")
    application: Application = Field(description="The stages other than the network.")
    performance_profiles: dict[PerformanceProfile, PerformanceSettings] = Field(
        description="The performance profiles, by SNPE's names."
    )
    thermal: Thermal = Field(description="Heat, its limits and the governor.")

    @model_validator(mode="after")
    def _complete(self) -> Self:
        for what, names, stated in (
            ("unit", UNITS, self.units),
            ("performance profile", PERFORMANCE_PROFILES, self.performance_profiles),
        ):
            missing = [name for name in names if name not in stated]
            if missing:
                raise UnexpectedValue(f"no {what} {', '.join(missing)}", f"all of {', '.join(names)}")
        if self.thermal.skin_limit <= self.thermal.ambient:
            raise UnexpectedValue("thermal.skin_limit_c at or below thermal.ambient_c", "it above")
        return self


def corners_of(profile: Profile, performance_profile: str) -> Corners:
    """Return the corners of cpu, gpu and dsp under a performance profile. Raises BadInputError for an unknown name."""
    for name, settings in profile.performance_profiles.items():
        if name == performance_profile:
            return settings.cpu, settings.gpu, settings.dsp
    known = ", ".join(profile.performance_profiles)
    raise BadInputError("performance profile", repr(performance_profile), f"one of {known}")
