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
from dataclasses import dataclass
from typing import Literal, NamedTuple

from trilane.hw_profiles.network_work import Operator, Work
from trilane.hw_profiles.operator_times import Machine, job_time, machine_of
from trilane.hw_profiles.performance_profiles import Corners
from trilane.hw_profiles.schema import Profile
from trilane.units import UNITS, UnitName

#: What decides an operator's time: products, activations to and from memory, its weights, activations that do not fit
#: into the on-chip memory, or the fixed cost of an operator.
Bound = Literal["arithmetic", "activation traffic", "weight traffic", "spill", "fixed"]
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
    machine = machine_of(profile.units[unit], profile.memory, profile.units[unit].clock(corners[UNITS.index(unit)]))
    operators = tuple(_operator_time(o, machine) for o in work.operators)
    return NetworkTime(unit, job_time(work, machine).total_ms - sum(o.ms for o in operators), operators)


def _operator_time(operator: Operator, machine: Machine) -> OperatorTime:
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
    """The 80 % interval around `time`.

    `profile`: of the chip.
    `work`: of the network.
    `time`: of `price`.
    """
    error = profile.units[time.unit].model_error_fraction.or_else(1.0)
    factor = math.exp(NORMAL_80 * error)
    why = [f"the profile states a relative error of {error:.0%} for networks on its {time.unit}"]
    odd = sorted({o.op_type for o in work.operators if not o.ruled})
    if odd:
        why.append(f"no rule for {', '.join(odd)}: counted as the movement of its elements")
    return Interval(time.total_ms / factor, time.total_ms * factor, tuple(why))
