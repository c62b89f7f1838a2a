"""The time of one network on one unit, operator by operator, what bounds each, and how far to trust the sum.

Rule: pure functions of a network's counts and of a profile's numbers; `operator_times.py` has the cost of an operator,
this file says what people ask of it.

    time = price(profile, work, "dsp", corners_of(profile, "burst"))
    time.total_ms, time.operators[0].bound, interval(profile, work, time).why

The parts of the sum are `job_ms`, which belongs to no operator (waking the unit, conversion of the input), and the
operators, in the order of the file. An operator that the runtime folds into another one is not among them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from trilane.arrays import F64
from trilane.hw_profiles.application import relative_error
from trilane.hw_profiles.engine_layers import NAMES, Layer
from trilane.hw_profiles.engine_times import BOUNDS, Bound, engine_time, numbers_of
from trilane.hw_profiles.network_work import Operator, Work
from trilane.hw_profiles.operator_times import JobTime, Machine, job_time, machine_of
from trilane.hw_profiles.performance_profiles import Corners
from trilane.hw_profiles.schema import Profile, Unit
from trilane.hw_profiles.unit_times import fallback_ms, layer_times, time_on
from trilane.units import UNITS, UnitName

#: A term is named where it alone makes the time uncertain by so much.
NAMED_FROM = 0.05
#: Of a normal distribution: how many standard deviations have 80 % between them and their negative.
NORMAL_80 = 1.2816


class OperatorTime(NamedTuple):
    """Milliseconds of one operator. `op_type`: of ONNX. `bound`: the largest of its parts."""

    name: str
    op_type: str
    ms: float
    bound: Bound


@dataclass(frozen=True)
class NetworkTime:
    """Milliseconds of one job. `job_ms`: what belongs to no operator. `operators`: in the order of the file."""

    unit: UnitName
    job_ms: float
    operators: tuple[OperatorTime, ...]

    @property
    def total_ms(self) -> float:
        return self.job_ms + sum(o.ms for o in self.operators)


class Interval(NamedTuple):
    """Where the time is with a probability of 80 %, in milliseconds, and `why` in plain sentences."""

    low_ms: float
    high_ms: float
    why: tuple[str, ...]


def spread_of(around: Interval) -> float:
    """The standard deviation of the time's logarithm."""
    return math.log(around.high_ms / around.low_ms) / 2 / NORMAL_80


def price(profile: Profile, work: Work, unit: UnitName, corners: Corners) -> NetworkTime:
    """The time of one job of the network when nothing else runs.

    `profile`: of the chip.
    `work`: of the network; of several hundred operators, too.
    `unit`: that runs it.
    `corners`: of all units.
    """
    of_unit, clock = profile.units[unit], profile.units[unit].clock(corners[UNITS.index(unit)])
    whole = time_on(of_unit, profile.memory, work, clock)
    if of_unit.engine is None:
        machine = machine_of(of_unit, profile.memory, clock)
        operators = tuple(_by_roofline(o, machine) for o in work.operators)
    else:
        seconds = layer_times(of_unit, profile.memory, work, clock).layers
        on_cpu = dict(fallback_ms(of_unit, work))
        operators = tuple(
            _on_cpu(layer, on_cpu) if layer.op_type in of_unit.fallback else _by_engine(layer, row)
            for layer, row in zip(work.layers.layers, seconds, strict=True)
        )
    return NetworkTime(unit, whole.total_ms - sum(o.ms for o in operators), operators)


def _by_engine(layer: Layer, seconds: F64) -> OperatorTime:
    return OperatorTime(layer.name, layer.op_type, 1e3 * float(seconds.sum()), BOUNDS[int(seconds.argmax())])


def _on_cpu(layer: Layer, on_cpu: Mapping[str, float]) -> OperatorTime:
    return OperatorTime(layer.name, layer.op_type, on_cpu.get(layer.name, 0.0), "activation traffic")


def _by_roofline(operator: Operator, machine: Machine) -> OperatorTime:
    bare = job_time(Work((), 0, 1, 0), machine).total_ms
    parts = dict(job_time(Work((operator,), 0, 1, 0), machine).parts)
    parts["fixed"] -= bare
    ms = sum(parts.values())
    bounds: dict[Bound, float] = {"fixed": parts.pop("fixed"), "weight traffic": parts.pop("weights")}
    products = operator.macs / machine.arithmetic.max(initial=1, where=machine.arithmetic < math.inf) * 1e3
    main: Bound = "arithmetic" if products > 0.5 * sum(parts.values()) else "activation traffic"
    bounds[main] = sum(parts.values())
    return OperatorTime(operator.name, operator.op_type, ms, max(bounds, key=lambda key: bounds[key]))


def interval(profile: Profile, work: Work, time: NetworkTime) -> Interval:
    """The 80 % interval around `time`: the model's own error, and what its numbers leave open for this network.

    `profile`: of the chip.
    `work`: of the network.
    `time`: of `price`.
    """
    unit = profile.units[time.unit]
    job = time_on(unit, profile.memory, work)
    error = relative_error(job, unit)
    if unit.measured is not None:
        why = [unit.measured.said]
    elif unit.engine is None:
        why = [f"the profile states a relative error of {error:.0%} for networks on its {time.unit}"]
        peak = unit.peak
        if peak.value is None:
            error = math.hypot(error, peak.relative_error)
            assumed = f"{unit.peak_mac_s / 1e12:g} TMAC/s are assumed"
            why.append(f"it does not know how fast its {time.unit} is in {unit.precision}: {assumed}")
    else:
        own = unit.engine.error_fraction.or_else(0.5) * job.unlike
        why = [f"networks as unlike those of the fit were off by {own:.0%} besides what its numbers leave open"]
        why += [_likeness(job), f"the numbers leave {job.unsure or 0:.0%} open for this one"]
        why += [f"{share:.0%} of it is {term}, known to {spread:.0%}" for term, share, spread in _ill_known(work, unit)]
    odd = sorted({o.op_type for o in work.operators if not o.ruled})
    if odd:
        why.append(f"no rule for {', '.join(odd)}: counted as the movement of its elements")
    factor = math.exp(NORMAL_80 * error)
    return Interval(time.total_ms / factor, time.total_ms * factor, tuple(why))


def _likeness(job: JobTime) -> str:
    """How unlike the network is to the nearest of the fit, in words."""
    if not job.like:
        return "its profile names no network that its numbers were fitted to"
    return f"of those {job.like} is most like it; {job.unlike:.0%} of the time goes into other work"


def _ill_known(work: Work, unit: Unit) -> list[tuple[str, float, float]]:
    """The terms that make the time uncertain: name, share of the time, relative spread of what they cost."""
    assert unit.engine is not None
    factors = unit.engine.factors
    shares = engine_time(work.layers, numbers_of(unit.engine)).shares
    all_terms = [(n, float(s), factors[n].relative_error) for n, s in zip(NAMES, shares, strict=True) if n in factors]
    return [term for term in all_terms if term[1] * term[2] >= NAMED_FROM]
