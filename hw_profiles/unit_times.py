"""The time of one job of a network on a unit, and its expected relative error.

For a unit with a tensor engine, the time is the sum over layers. It follows from the factors of terms, which all chips
share, and from six rates of the chip:

    cost of a term    amount * factor / rate             factor: shared by all chips; rate: the chip's, one of six
    time of a layer   (a^4 + m^4 + s^4)^(1/4) + w + o    arithmetic, activations moved, spill; weights, fixed

Products, movement and spill happen at the same time, so the slowest decides (as in the roofline of Williams, Waterman
and Patterson, 2009). The transition is smooth if two are about equal. Spill is the elements that do not fit on the
chip. The tensor whose next reader comes last is moved out first (Belady, 1966: no rule moves less). No measured time is
looked up.

For any other unit, the time is the sum over operators by a roofline:

    time = job + operators * dispatch + input elements * conversion + weights / bandwidth
           + sum over operators of max(arithmetic, traffic) + operators that fall back to the CPU

The memory is shared as in Gables (Hill and Reddi, 2019).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.hw_profiles.network_work import Work
from trilane.hw_profiles.operators import ARITHMETIC, CLASSES, INDEX, NAMES, RATES, TERMS, TRAFFIC, Layers
from trilane.hw_profiles.schema import KEY_OF_RATE, Engine, Memory, Unit

#: Exponent that combines parts that happen at the same time: 1 would add them, infinity would take only the slowest.
JOINED = 4.0
#: The resource that decides an operator's time.
Bound = Literal["arithmetic", "activation traffic", "spill", "weight traffic", "fixed"]
BOUNDS: tuple[Bound, ...] = ("arithmetic", "activation traffic", "spill", "weight traffic", "fixed")
#: Terms of each rate, as a mask (rates, terms).
OF_RATE = np.array([[TERMS[name] == rate for name in NAMES] for rate in RATES])


@dataclass(frozen=True)
class EngineNumbers:
    """An engine as plain numbers.

    `seconds`: time of one unit of each term, in seconds (terms,).
    `room`: number of activation elements that fit on the chip.
    """

    seconds: F64
    room: int


@dataclass(frozen=True)
class EngineTime:
    """The time of a job in seconds.

    `layers`: time by layer and bound (layers, 5).
    `job`: time that belongs to no layer.
    `shares`: derivative of the time's logarithm by the logarithm of each term's cost (terms,); they sum to 1. A term
    that runs beside a slower term has a small share.
    """

    layers: F64
    job: float
    shares: F64

    @property
    def total(self) -> float:
        return float(self.layers.sum()) + self.job


def numbers_of(engine: Engine, clock_fraction: float = 1.0, memory_fraction: float = 1.0) -> EngineNumbers:
    """Return the numbers of an engine.

    `engine`: tensor engine of a profile.
    `clock_fraction`: fraction of the highest clock, above 0 to 1; it slows all work on the engine.
    `memory_fraction`: share of the memory's bandwidth that is left for the engine, above 0 to 1.
    """
    # Only spill and weights cross the main memory; all other work slows down with the engine's clock.
    slower = {"spill": memory_fraction, "weight": memory_fraction}
    per_unit = {rate: engine.seconds_per_unit(rate) / slower.get(rate, clock_fraction) for rate in RATES}
    seconds = [per_unit[TERMS[name]] * engine.factor(name) for name in NAMES]
    return EngineNumbers(np.array(seconds), int(engine.on_chip_mb.or_else(4.0) * 2**20 / engine.element_bytes))


def amounts(network: Layers, room: int) -> F64:
    """Return the amount of each term (layers + 1, terms): a row for each layer, with its spill, then a row for the job.

    `room`: number of activation elements that fit on the chip.
    """
    table = np.vstack([network.table, np.zeros(len(NAMES))])
    table[:-1, INDEX["spill"]] = spilled(network, room)
    for name, amount in (("input", network.input), ("output", network.output), ("job", 1)):
        table[-1, INDEX[name]] = amount
    return table


def engine_time(network: Layers, engine: EngineNumbers, batch: int = 1) -> EngineTime:
    """Return the time of one job of `batch` frames; weights and fixed costs count once per job.

    `network`: layers of the network.
    `engine`: numbers of the engine.
    """
    once = OF_RATE[3:].any(axis=0)  # weights, and the fixed costs of operators and job
    costs = amounts(network, engine.room) * engine.seconds * np.where(once, 1, batch)
    joined, slopes = join(costs[:-1])
    shares = np.vstack([costs[:-1] * slopes, costs[-1:]]).sum(axis=0)
    return EngineTime(joined, float(costs[-1].sum()), shares / max(shares.sum(), 1e-30))


def join(costs: F64) -> tuple[F64, F64]:
    """Return (seconds by layer and bound (layers, 5), derivative of a layer's time by each cost (layers, terms)).

    Parts that happen at the same time divide the layer's time in proportion to their powers.

    `costs`: seconds by layer and term (layers, terms).
    """
    by_rate = costs @ OF_RATE.T
    at_once = by_rate[:, :3]
    # Relative to the largest, so that the powers neither overflow nor underflow.
    largest = np.maximum(at_once.max(axis=1, keepdims=True), 1e-30)
    powers = (at_once / largest) ** JOINED
    whole = largest * powers.sum(axis=1, keepdims=True) ** (1 / JOINED)
    divided = whole * powers / np.maximum(powers.sum(axis=1, keepdims=True), 1e-30)
    slopes = (at_once / np.maximum(whole, 1e-30)) ** (JOINED - 1)
    by_bound = np.column_stack([divided, by_rate[:, 3], by_rate[:, 4] + by_rate[:, 5]])
    return by_bound, np.column_stack([slopes, np.ones((len(costs), 3))]) @ OF_RATE


@lru_cache(maxsize=512)
def spilled(network: Layers, room: int) -> tuple[int, ...]:
    """Return the elements that each layer moves from and to the main memory if `room` elements fit on the chip.

    The network's input comes from the main memory, and its results go there. A layer's result stays on the chip until
    its last reader. If room is short, the tensor whose next reader comes last is moved out, only in part if a part is
    enough. A concatenation moves nothing, because its readers read its parts.
    """
    chip = _Chip(network, room)
    return tuple(chip.run(index) for index in range(len(network.layers)))


class _Chip:
    """The content of the chip's memory: elements of each tensor, and the layers that will read it."""

    def __init__(self, network: Layers, room: int) -> None:
        self._layers, self._sizes, self._room = network.layers, network.sizes, room
        self._parts: dict[str, tuple[str, ...]] = {}
        self._readers: dict[str, list[int]] = defaultdict(list)
        self._held: dict[str, int] = {}
        for index, layer in enumerate(network.layers):
            if layer.kind == "Concat":
                self._parts[layer.writes] = self._read(layer.reads)
                continue
            for name in self._read(layer.reads):
                self._readers[name].append(index)

    def _read(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the tensors that hold the data of `names`, each once: the parts in place of a concatenation."""
        return tuple(dict.fromkeys(part for name in names for part in self._parts.get(name, (name,))))

    def _next(self, name: str, index: int) -> int:
        """Return the index of the next layer after `index` that reads the tensor; the number of layers without one."""
        return next((reader for reader in self._readers[name] if reader > index), len(self._layers))

    def run(self, index: int) -> int:
        """Run the layer `index` and return the elements that it moves."""
        layer = self._layers[index]
        if layer.kind == "Concat":
            return 0
        moved = 0
        for name in self._read(layer.reads):
            moved += self._sizes[name] - self._held.get(name, 0)
            if self._next(name, index) == len(self._layers):
                self._held.pop(name, None)
        return moved + sum(self._keep(name, index) for name in (layer.writes, *layer.more))

    def _keep(self, name: str, index: int) -> int:
        """Put the result `name` of the layer `index` on the chip. Return how many elements are moved out for it."""
        size, soon, gone = self._sizes[name], self._next(name, index), 0
        if soon == len(self._layers):
            return size
        free = self._room - sum(self._held.values())
        for other in sorted(self._held, key=lambda held: -self._next(held, index)):
            if free >= size or self._next(other, index) <= soon:
                break
            part = min(self._held[other], size - free)
            self._held[other] -= part
            free, gone = free + part, gone + part
        self._held[name] = max(0, min(size, free))
        return gone + size - self._held[name]


TRAFFIC_KEYS = tuple(f"{kind}_traffic" for kind in ARITHMETIC) + TRAFFIC


@dataclass(frozen=True)
class JobTime:
    """The time of one job.

    `parts`: time in ms by part: `fixed`, `input`, `weights`, `fallback` and the operator classes. A tensor engine has
    `arithmetic`, `activation` and `spill` in place of the classes.
    `unsure`: relative error from the spreads of the engine's numbers; None for a roofline.
    `unlike`: distance of the network from the network `like`, 0 to 1 (`nearest`).
    `like`: name of the nearest network of the engine's fit; empty without one.
    """

    parts: Mapping[str, float]
    unsure: float | None = None
    unlike: float = 1.0
    like: str = ""

    @property
    def total_ms(self) -> float:
        return sum(self.parts.values())


def time_on(
    unit: Unit, memory: Memory, work: Work, clock_fraction: float = 1.0, *, contended: bool = False, batch: int = 1
) -> JobTime:
    """Return the time of one job.

    `unit`, `memory`: unit and memory of one profile.
    `work`: work of one frame.
    `clock_fraction`: fraction of the unit's highest clock, above 0 to 1.
    `contended`: whether the rest of the application uses the memory at the same time.
    `batch`: number of frames in the job.
    """
    if unit.engine is None:
        return job_time(work, machine_of(unit, memory, clock_fraction, contended), batch)
    time = layer_times(unit, memory, work, clock_fraction, contended=contended, batch=batch)
    by_bound = 1e3 * time.layers.sum(axis=0)
    parts = {
        "fixed": float(by_bound[4]) + (unit.permute_fixed_ms.or_else(0.0) if work.input_tensors > 1 else 0.0),
        "input": 1e3 * time.job + batch * work.input_elements * unit.input_ns_per_element.or_else(0.0) / 1e6,
        "weights": float(by_bound[3]),
        "fallback": sum(ms for _, ms in fallback_ms(unit, work, batch)),
    }
    parts |= dict(zip(("arithmetic", "activation", "spill"), by_bound[:3].tolist(), strict=True))
    return JobTime(parts, unsure(unit.engine, time.shares), *nearest(unit.engine, time.shares))


def relative_error(job: JobTime, unit: Unit) -> float:
    """Return the expected relative error of the time of `job` on `unit`.

    It combines the stated error with the error of the peak, if the profile does not know the peak.
    """
    return math.hypot(stated_error(job, unit), unit.peak.relative_error if assumes_peak(unit) else 0.0)


def assumes_peak(unit: Unit) -> bool:
    """Return whether times on `unit` are computed from a peak that its profile does not know."""
    return unit.measured is None and unit.engine is None and unit.peak.value is None


def stated_error(job: JobTime, unit: Unit) -> float:
    """Return the relative error that a profile states for the time of `job`; for a measured unit, the measured error.

    For any other unit, the error combines the errors of the numbers behind each part of the time with the model's
    error. Both are multiplied by the unit's `error_scale`, which comes from the user's own rows.
    """
    if unit.measured is not None:
        return unit.measured.error
    scale = 1.0 if unit.error_scale is None else unit.error_scale.or_else(1.0)
    if job.unsure is not None and unit.engine is not None:
        return scale * math.hypot(job.unsure, unit.engine.error_fraction.or_else(0.5) * job.unlike)
    computed_from = {
        "fixed": unit.job_fixed_ms,
        "input": unit.input_ns_per_element,
        "weights": unit.efficiency.convolution_traffic,
        "fallback": unit.fallback_ns_per_element,
        "depthwise": unit.efficiency.depthwise_traffic,
        "pointwise": unit.efficiency.pointwise_traffic,
    }
    computed_from |= {kind: getattr(unit.efficiency, kind) for kind in CLASSES if kind not in computed_from}
    shares = {part: ms / job.total_ms for part, ms in job.parts.items()}
    variance = sum((shares[part] * quantity.relative_error) ** 2 for part, quantity in computed_from.items())
    return scale * float((variance + unit.model_error_fraction.or_else(0.5) ** 2) ** 0.5)


def layer_times(
    unit: Unit, memory: Memory, work: Work, clock_fraction: float = 1.0, *, contended: bool = False, batch: int = 1
) -> EngineTime:
    """Return the time of each layer on the engine of `unit`, which is 0 for a layer that runs on the CPU instead.

    The parameters are as in `time_on`.
    """
    assert unit.engine is not None
    left = 1 - (memory.application_use_fraction.or_else(0.0) if contended else 0.0)
    time = engine_time(work.layers, numbers_of(unit.engine, clock_fraction, left), batch)
    on_engine = np.array([layer.op_type not in unit.fallback for layer in work.layers.layers], dtype=bool)
    return EngineTime(time.layers * on_engine[:, None], time.job, time.shares)


def fallback_ms(unit: Unit, work: Work, batch: int = 1) -> list[tuple[str, float]]:
    """Return (name, time in ms) of each operator that runs on the CPU instead of the unit."""
    fixed, each = unit.fallback_fixed_ms.or_else(0.0), unit.fallback_ns_per_element.or_else(0.0) / 1e6
    return [(o.name, fixed + batch * o.out * each) for o in work.operators if o.op_type in unit.fallback]


def nearest(engine: Engine, shares: F64) -> tuple[float, str]:
    """Return (distance of a network from the nearest network of the engine's fit, name of that nearest network).

    The distance is the total variation distance of both networks' shares, 0 to 1. For an engine that names no networks
    the result is (1, "").

    `shares`: share of each term in the network's time (terms,).
    """
    own = dict(zip(NAMES, shares.tolist(), strict=True))
    return min(((_apart(own, others), name) for name, others in engine.seen.items()), default=(1.0, ""))


def _apart(own: Mapping[str, float], others: Mapping[str, float]) -> float:
    """Return half the sum of the absolute differences of two networks' shares; a term that `others` lacks is 0."""
    # The shares of `own` sum to 1, so the 1 contains the terms that `others` does not name.
    return (1 + sum([abs(own[name] - share) - own[name] for name, share in others.items()])) / 2


def unsure(engine: Engine, shares: F64) -> float:
    """Return the relative error of a job's time that comes from the spreads of the engine's numbers.

    `shares`: share of each term in the job's time (terms,).
    """
    of_rates = [sum(s for n, s in zip(NAMES, shares, strict=True) if TERMS[n] == rate) for rate in RATES]
    spreads = [getattr(engine.rates, KEY_OF_RATE[rate][0]).relative_error for rate in RATES]
    known = [engine.factors[name].relative_error if name in engine.factors else 0.0 for name in NAMES]
    return float(np.hypot(np.linalg.norm(shares * known), np.linalg.norm(np.multiply(of_rates, spreads))))


@dataclass(frozen=True)
class UnitNumbers:
    """A unit as plain numbers. Rates are per second, times in seconds.

    `arithmetic`: rate of multiply-accumulates of each of CLASSES (classes,); infinite for classes without products.
    `traffic`: rate of bytes of each of CLASSES (classes,).
    `stream`: rate of bytes of weights.
    `element_bytes`: bytes of one element.
    `block`: multiple to which channel counts are rounded up.
    `job`, `operator`: fixed times of a job and of an operator.
    `input`: time of an element of the network's input.
    `permute`: additional time if the input comes as several tensors.
    `fallback`: ONNX types of the operators that run on the CPU.
    `fallback_job`, `fallback_element`: fixed time of an operator on the CPU, and time of an element of its result.
    """

    arithmetic: NDArray[np.float64]
    traffic: NDArray[np.float64]
    stream: float
    element_bytes: int
    block: float
    job: float
    operator: float
    input: float
    permute: float
    fallback: frozenset[str]
    fallback_job: float
    fallback_element: float


def machine_of(unit: Unit, memory: Memory, clock_fraction: float = 1.0, contended: bool = False) -> UnitNumbers:
    """Return the numbers of a unit; for a measured unit, all times and rates are slower by the measured factor.

    `unit`: unit of a profile.
    `memory`: memory of the same profile.
    `clock_fraction`: fraction of the unit's highest clock, above 0 to 1.
    `contended`: whether the rest of the application uses the memory at the same time.
    """
    use = memory.application_use_fraction.or_else(0.0) if contended else 0.0
    bandwidth = memory.bandwidth_gb_s.or_else(10.0) * 1e9 * (1 - use)
    efficiency = unit.efficiency
    arithmetic = [getattr(efficiency, kind).or_else(0.1) * unit.peak_mac_s * clock_fraction for kind in ARITHMETIC]
    traffic = np.array([getattr(efficiency, key).or_else(0.1) for key in TRAFFIC_KEYS]) * bandwidth / unit.slower
    return UnitNumbers(
        arithmetic=np.array(arithmetic + [np.inf] * len(TRAFFIC)) / unit.slower,
        traffic=traffic,
        stream=float(traffic[CLASSES.index("convolution")]),
        element_bytes=unit.element_bytes,
        block=unit.channel_block.or_else(1.0),
        job=unit.slower * unit.job_fixed_ms.or_else(0.0) / 1e3,
        operator=unit.slower * unit.operator_fixed_us.or_else(0.0) / 1e6,
        input=unit.slower * unit.input_ns_per_element.or_else(0.0) / 1e9,
        permute=unit.slower * unit.permute_fixed_ms.or_else(0.0) / 1e3,
        fallback=frozenset(unit.fallback),
        fallback_job=unit.slower * unit.fallback_fixed_ms.or_else(0.0) / 1e3,
        fallback_element=unit.slower * unit.fallback_ns_per_element.or_else(0.0) / 1e9,
    )


def job_time(work: Work, machine: UnitNumbers, batch: int = 1) -> JobTime:
    """Return the time of one job of `batch` frames; fixed costs and weights count once per job.

    `work`: work of one frame.
    `machine`: numbers of the unit.
    """
    classes, counts = work.classes, work.table
    on_cpu = np.array([o.op_type in machine.fallback for o in work.operators], dtype=bool)
    seconds = np.where(on_cpu, 0.0, _operator_seconds(counts, classes, machine))
    parts = {
        "fixed": machine.job + machine.operator * len(classes) + machine.permute * (work.input_tensors > 1),
        "input": batch * work.input_elements * machine.input,
        "weights": work.weights * machine.element_bytes / machine.stream,
        "fallback": float(on_cpu.sum()) * machine.fallback_job
        + batch * float(counts[on_cpu, 4].sum()) * machine.fallback_element,
    }
    by_class = batch * np.bincount(classes, weights=seconds, minlength=len(CLASSES))
    parts |= dict(zip(CLASSES, by_class.tolist(), strict=True))
    return JobTime({name: 1e3 * value for name, value in parts.items()})


def _operator_seconds(
    counts: NDArray[np.float64], classes: NDArray[np.int64], machine: UnitNumbers
) -> NDArray[np.float64]:
    """Return the time of each operator in seconds (operators,): the larger of its arithmetic and its traffic.

    `counts`: `Work.table` (operators, 5). `classes`: index into CLASSES of each operator (operators,).
    """
    macs, moved, c_in, c_out = counts[:, 0], counts[:, 1], counts[:, 2], counts[:, 3]
    padded = macs * _padding_factor(c_in, machine.block) * _padding_factor(c_out, machine.block)
    arithmetic = np.where(classes == CLASSES.index("depthwise"), macs, padded) / machine.arithmetic[classes]
    traffic = moved * machine.element_bytes / machine.traffic[classes]
    larger: NDArray[np.float64] = np.maximum(arithmetic, traffic)
    return larger


def _padding_factor(channels: NDArray[np.float64], block: float) -> NDArray[np.float64]:
    """Return (`channels` rounded up to whole blocks) / `channels`; 1 for an operator without products."""
    known = np.maximum(channels, 1.0)
    return np.ceil(known / block) * block / known
