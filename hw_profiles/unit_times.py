"""The time of one job of a network on a unit, and the relative error to expect of it.

A unit with a tensor engine is priced by layers (`engine_times.py`), any other one by operators and a roofline:

    time = job + operators * dispatch + input elements * conversion + weights / bandwidth
           + sum over operators of max(arithmetic, traffic) + operators that fall back to the CPU

Sources: Williams, Waterman and Patterson (2009), the roofline; Gables (Hill and Reddi, 2019), the shared memory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.hw_profiles.engine_times import EngineTime, engine_time, numbers_of
from trilane.hw_profiles.network_work import Work
from trilane.hw_profiles.operators import ARITHMETIC, CLASSES, NAMES, RATES, TERMS, TRAFFIC
from trilane.hw_profiles.schema import KEY_OF_RATE, Engine, Memory, Unit

TRAFFIC_KEYS = tuple(f"{kind}_traffic" for kind in ARITHMETIC) + TRAFFIC


@dataclass(frozen=True)
class JobTime:
    """Milliseconds of one job by part: `fixed`, `input`, `weights`, `fallback` and the operator classes.

    A tensor engine has `arithmetic`, `activation` and `spill` in place of the classes. `unsure`: relative error that
    the engine's numbers leave; None for a roofline. `unlike`: how unlike the network is to `like`, the nearest network
    that the numbers were fitted to, 0 to 1.
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
    `contended`: whether the rest of the application uses the memory meanwhile.
    `batch`: number of frames in the job.
    """
    if unit.engine is None:
        return job_time(work, machine_of(unit, memory, clock_fraction, contended), batch)
    time = layer_times(unit, memory, work, clock_fraction, contended=contended, batch=batch)
    by_bound = 1e3 * time.layers.sum(axis=0)
    parts = {
        "fixed": float(by_bound[4]) + _permutes_ms(unit, work),
        "input": 1e3 * time.job + batch * work.input_elements * unit.input_ns_per_element.or_else(0.0) / 1e6,
        "weights": float(by_bound[3]),
        "fallback": sum(ms for _, ms in fallback_ms(unit, work, batch)),
    }
    parts |= dict(zip(("arithmetic", "activation", "spill"), by_bound[:3].tolist(), strict=True))
    return JobTime(parts, unsure(unit.engine, time.shares), *nearest(unit.engine, time.shares))


def relative_error(job: JobTime, unit: Unit) -> float:
    """Return the relative error to expect of the time of `job` on `unit`; for a measured unit, the measured error.

    For other units it joins two errors: that of the numbers behind each part of the time, and that of the model itself.
    It multiplies both by the unit's `error_scale`, which rows of the user's own give.
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
    """Return the seconds of each layer on the engine of `unit`, 0 for a layer that falls back to the CPU.

    Parameters: as in `time_on`.
    """
    assert unit.engine is not None
    left = 1 - (memory.application_use_fraction.or_else(0.0) if contended else 0.0)
    time = engine_time(work.layers, numbers_of(unit.engine, clock_fraction, left), batch)
    on_engine = np.array([layer.op_type not in unit.fallback for layer in work.layers.layers], dtype=bool)
    return EngineTime(time.layers * on_engine[:, None], time.job, time.shares)


def fallback_ms(unit: Unit, work: Work, batch: int = 1) -> list[tuple[str, float]]:
    """Return the name and milliseconds of each operator that the unit hands to the CPU."""
    fixed, each = unit.fallback_fixed_ms.or_else(0.0), unit.fallback_ns_per_element.or_else(0.0) / 1e6
    return [(o.name, fixed + batch * o.out * each) for o in work.operators if o.op_type in unit.fallback]


def _permutes_ms(unit: Unit, work: Work) -> float:
    """Return the milliseconds that a picture in several tensors costs."""
    return unit.permute_fixed_ms.or_else(0.0) if work.input_tensors > 1 else 0.0


def nearest(engine: Engine, shares: F64) -> tuple[float, str]:
    """Return how unlike a network is to the nearest one of the fit of the engine's numbers, and the name of that one.

    The distance is the total variation of both networks' shares: the part of the time that goes into other terms, 0 to
    1. An engine that names no networks gives 1 and "".
    `shares`: share of each term in the network's time (terms,).
    """
    own = dict(zip(NAMES, shares.tolist(), strict=True))
    return min(((_apart(own, others), name) for name, others in engine.seen.items()), default=(1.0, ""))


def _apart(own: Mapping[str, float], others: Mapping[str, float]) -> float:
    """Return half the sum of absolute differences of two networks' shares.

    A term that `others` do not name counts as 0.
    """
    # The shares of `own` sum to 1, so the 1 contains the terms that `others` does not name.
    return (1 + sum([abs(own[name] - share) - own[name] for name, share in others.items()])) / 2


def unsure(engine: Engine, shares: F64) -> float:
    """Return the relative error that the engine's numbers leave in the time of a job.

    `shares`: share of each term in its time (terms,).
    """
    of_rates = [sum(s for n, s in zip(NAMES, shares, strict=True) if TERMS[n] == rate) for rate in RATES]
    spreads = [getattr(engine.rates, KEY_OF_RATE[rate][0]).relative_error for rate in RATES]
    known = [engine.factors[name].relative_error if name in engine.factors else 0.0 for name in NAMES]
    return float(np.hypot(np.linalg.norm(shares * known), np.linalg.norm(np.multiply(of_rates, spreads))))


@dataclass(frozen=True)
class UnitNumbers:
    """A unit as plain numbers. Rates are per second, times in seconds.

    `arithmetic`: multiply-accumulates per second of each of CLASSES, infinite for classes without products. `traffic`:
    bytes per second of each of CLASSES. `stream`: bytes of weights per second. `element_bytes`: bytes of one element.
    `block`: multiple to which channel counts are rounded up. `job`, `operator`: fixed time of a job, of an operator.
    `input`: time of an element of the network's input. `permute`: extra time where the input comes as several tensors.
    `fallback`: ONNX types of the operators that run on the CPU; `fallback_job`: fixed time of each; `fallback_element`:
    time of an element of its result.
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
    """Return the numbers of a unit, all of them slower by the factor that was measured for the unit.

    `unit`: unit of a profile.
    `memory`: memory of the same profile.
    `clock_fraction`: fraction of its highest clock, above 0 to 1.
    `contended`: whether the rest of the application uses the memory meanwhile.
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
    """Return the time of one job of `batch` frames. The fixed costs and the weights count once per job."""
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
    """Return the seconds of each operator (operators,): the larger of its arithmetic and its traffic."""
    macs, moved, c_in, c_out = counts[:, 0], counts[:, 1], counts[:, 2], counts[:, 3]
    padded = macs * _padding_factor(c_in, machine.block) * _padding_factor(c_out, machine.block)
    arithmetic = np.where(classes == CLASSES.index("depthwise"), macs, padded) / machine.arithmetic[classes]
    traffic = moved * machine.element_bytes / machine.traffic[classes]
    larger: NDArray[np.float64] = np.maximum(arithmetic, traffic)
    return larger


def _padding_factor(channels: NDArray[np.float64], block: float) -> NDArray[np.float64]:
    """Return `channels` rounded up to whole blocks, over `channels`; 1 for an operator without products."""
    known = np.maximum(channels, 1.0)
    return np.ceil(known / block) * block / known
