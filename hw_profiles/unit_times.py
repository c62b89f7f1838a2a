"""One job of a network on a unit: by the layers of its tensor engine where it has one, or by operators and a roofline.

Rule: both give a `JobTime`; who asks need not know which it was.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from trilane.arrays import F64
from trilane.hw_profiles.engine_layers import NAMES, RATES, TERMS
from trilane.hw_profiles.engine_times import EngineTime, engine_time, numbers_of
from trilane.hw_profiles.network_work import Work
from trilane.hw_profiles.operator_times import JobTime, job_time, machine_of
from trilane.hw_profiles.schema import KEY_OF_RATE, Engine, Memory, Unit


def time_on(
    unit: Unit, memory: Memory, work: Work, clock_fraction: float = 1.0, *, contended: bool = False, batch: int = 1
) -> JobTime:
    """Time of one job.

    `unit`, `memory`: of a profile.
    `work`: of one frame.
    `clock_fraction`: of the unit's highest clock.
    `contended`: whether the rest of the application uses the memory at the same time.
    `batch`: frames of the job.
    """
    if unit.engine is None:
        return job_time(work, machine_of(unit, memory, clock_fraction, contended), batch)
    time = layer_times(unit, memory, work, clock_fraction, contended=contended, batch=batch)
    by_bound = 1e3 * time.layers.sum(axis=0)
    parts = {
        "fixed": float(by_bound[4]) + permutes_ms(unit, work),
        "input": 1e3 * time.job + batch * work.input_elements * unit.input_ns_per_element.or_else(0.0) / 1e6,
        "weights": float(by_bound[3]),
        "fallback": sum(ms for _, ms in fallback_ms(unit, work, batch)),
    }
    parts |= dict(zip(("arithmetic", "activation", "spill"), by_bound[:3].tolist(), strict=True))
    return JobTime(parts, unsure(unit.engine, time.shares), *nearest(unit.engine, time.shares))


def layer_times(
    unit: Unit, memory: Memory, work: Work, clock_fraction: float = 1.0, *, contended: bool = False, batch: int = 1
) -> EngineTime:
    """Seconds of each layer on the engine of `unit`, 0 for one that falls back to the CPU. Words as of `time_on`."""
    assert unit.engine is not None
    left = 1 - (memory.application_use_fraction.or_else(0.0) if contended else 0.0)
    time = engine_time(work.layers, numbers_of(unit.engine, clock_fraction, left), batch)
    on_engine = np.array([layer.op_type not in unit.fallback for layer in work.layers.layers], dtype=bool)
    return EngineTime(time.layers * on_engine[:, None], time.job, time.shares)


def fallback_ms(unit: Unit, work: Work, batch: int = 1) -> list[tuple[str, float]]:
    """What each operator costs that the unit hands to the CPU, with its name."""
    fixed, each = unit.fallback_fixed_ms.or_else(0.0), unit.fallback_ns_per_element.or_else(0.0) / 1e6
    return [(o.name, fixed + batch * o.out * each) for o in work.operators if o.op_type in unit.fallback]


def permutes_ms(unit: Unit, work: Work) -> float:
    """What a picture in several tensors costs."""
    return unit.permute_fixed_ms.or_else(0.0) if work.input_tensors > 1 else 0.0


def nearest(engine: Engine, shares: F64) -> tuple[float, str]:
    """How unlike a network is to the nearest one that the engine's numbers were fitted to, and which one that is.

    The total variation distance of both networks' shares: the part of the time that goes into other terms, 0 to 1.
    `shares`: of the terms in the network's time. 1 and "" where the engine names no networks.
    """
    own = dict(zip(NAMES, shares.tolist(), strict=True))
    return min(((_apart(own, others), name) for name, others in engine.seen.items()), default=(1.0, ""))


def _apart(own: Mapping[str, float], others: Mapping[str, float]) -> float:
    """Half the sum of absolute differences of two networks' shares. What `others` do not name, they have none of."""
    return (1 + sum([abs(own[name] - share) - own[name] for name, share in others.items()])) / 2


def unsure(engine: Engine, shares: F64) -> float:
    """Relative error that the engine's numbers leave of a job. `shares`: of the terms in it."""
    of_rates = [sum(s for n, s in zip(NAMES, shares, strict=True) if TERMS[n] == rate) for rate in RATES]
    spreads = [getattr(engine.rates, KEY_OF_RATE[rate][0]).relative_error for rate in RATES]
    known = [engine.factors[name].relative_error if name in engine.factors else 0.0 for name in NAMES]
    return float(np.hypot(np.linalg.norm(shares * known), np.linalg.norm(np.multiply(of_rates, spreads))))
