"""Predicts the time of one network by itself on one unit: the time and bound of each operator, and the interval.

    time = price(profile, work, "dsp", corners_of(profile, "burst"))
    time.total_ms, time.operators[0].bound, interval(profile, work, time).why

`job_ms` is the part of the time that belongs to no operator: the unit wakes, and the input is converted. An operator
that the runtime folds into another one is not listed. `predict_network` adds power, rates and the course over minutes;
other units are idle.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Final, NamedTuple

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.hw_profiles.governor import ends_of, over_minutes, settled_corners, warm_up
from trilane.hw_profiles.graph_file import GraphFile, NumberFormat
from trilane.hw_profiles.host_model import UNMEASURED, is_known
from trilane.hw_profiles.network_work import Operator, Work
from trilane.hw_profiles.operators import COMPILED, NAMES, EngineLayer
from trilane.hw_profiles.prediction import NetworkPrediction, OperatorRow, UnruledRow
from trilane.hw_profiles.rates import NOTHING, FrameInterval, FrameLoad, Wanted, answers, device_power
from trilane.hw_profiles.schema import SIGMAS, Corners, EngineRuntime, Profile, Unit, corners_of, interval_around
from trilane.hw_profiles.unit_times import (
    BOUNDS,
    Bound,
    UnitNumbers,
    assumes_peak,
    engine_time,
    fallback_ms,
    job_time,
    layer_times,
    machine_of,
    numbers_of,
    relative_error,
    stated_error,
    time_on,
)
from trilane.units import BURST, UNITS, UnitName

#: A term is named if it causes at least this relative error of the time.
NAMED_FROM = 0.05

#: Reason for a time that is only a lower bound.
INSIDE = "it holds a compiled network, and only its ends can be seen: price the network that it was made from"


class OperatorTime(NamedTuple):
    """The time of one operator. `op_type`: its ONNX type. `bound`: resource that takes the largest part of its time."""

    name: str
    op_type: str
    ms: float
    bound: Bound


@dataclass(frozen=True)
class NetworkTime:
    """The time of one job. The whole time, `total_ms`, is the sum of the parts below.

    `job_ms`: part that belongs to no operator.
    `operators`: times of the operators, in the order of the file.
    """

    unit: UnitName
    job_ms: float
    operators: tuple[OperatorTime, ...]

    @property
    def total_ms(self) -> float:
        return self.job_ms + sum(o.ms for o in self.operators)


class Interval(NamedTuple):
    """An interval that contains the time with a probability of 80 %. `why`: reasons for its width, as sentences."""

    low_ms: float
    high_ms: float
    why: tuple[str, ...]


def spread_of(around: Interval) -> float:
    """Return the standard deviation of the time's logarithm that the 80 % interval `around` implies."""
    return math.log(around.high_ms / around.low_ms) / 2 / SIGMAS


def price(profile: Profile, work: Work, unit: UnitName, corners: Corners) -> NetworkTime:
    """Return the time of one job of the network when nothing else runs.

    `profile`: hardware profile of the chip.
    `work`: work of the network.
    `unit`: unit that runs it.
    `corners`: corner of each unit.
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


def _by_engine(layer: EngineLayer, seconds: F64) -> OperatorTime:
    return OperatorTime(layer.name, layer.op_type, 1e3 * float(seconds.sum()), BOUNDS[int(seconds.argmax())])


def _on_cpu(layer: EngineLayer, on_cpu: Mapping[str, float]) -> OperatorTime:
    return OperatorTime(layer.name, layer.op_type, on_cpu.get(layer.name, 0.0), "activation traffic")


def _by_roofline(operator: Operator, machine: UnitNumbers) -> OperatorTime:
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
    """Return the 80 % interval around `time`, from the error of the model itself and the error of its numbers.

    `profile`: hardware profile of the chip.
    `work`: work of the network.
    `time`: result of `price`.
    """
    unit = profile.units[time.unit]
    job = time_on(unit, profile.memory, work)
    if unit.measured is not None:
        why = [unit.measured.said]
    elif unit.engine is None:
        stated = stated_error(job, unit)
        why = [f"the profile states a relative error of {stated:.0%} for networks on its {time.unit}"]
        if assumes_peak(unit):
            assumed = f"{unit.peak_mac_s / 1e12:g} TMAC/s are assumed"
            why.append(f"it does not know how fast its {time.unit} is in {unit.precision}: {assumed}")
    else:
        own = unit.engine.error_fraction.or_else(0.5) * job.unlike
        why = [f"networks as unlike those of the fit were off by {own:.0%} besides what its numbers leave open"]
        likeness = f"of those {job.like} is most like it; {job.unlike:.0%} of the time goes into other work"
        why.append(likeness if job.like else "its profile names no network that its numbers were fitted to")
        why += [f"the numbers leave {job.unsure or 0:.0%} open for this one"]
        why += [f"{share:.0%} of it is {term}, known to {spread:.0%}" for term, share, spread in _ill_known(work, unit)]
    if unit.measured is None and unit.error_scale is not None:
        why.append(f"own rows scale the error of its {time.unit} by {unit.error_scale.or_else(1):.2g}")
    odd = sorted({o.op_type for o in work.operators if not o.ruled})
    if odd:
        why.append(f"no rule for {', '.join(odd)}: counted as the movement of its elements")
    return Interval(*interval_around(time.total_ms, relative_error(job, unit)), tuple(why))


def _ill_known(work: Work, unit: Unit) -> list[tuple[str, float, float]]:
    """Return (term, share of the time, relative spread of its cost) of each term that makes the time uncertain."""
    assert unit.engine is not None
    factors = unit.engine.factors
    shares = engine_time(work.layers, numbers_of(unit.engine)).shares
    all_terms = [(n, float(s), factors[n].relative_error) for n, s in zip(NAMES, shares, strict=True) if n in factors]
    return [term for term in all_terms if term[1] * term[2] >= NAMED_FROM]


class _Running(NamedTuple):
    """A network that runs all the time: time between two results, and share of the time in which each unit works."""

    frame_ms: float
    busy: Mapping[str, float]


def in_precision(profile: Profile, unit: UnitName, numbers: NumberFormat, asked: str | None = None) -> Profile:
    """Return `profile` with the unit computing in the network's precision.

    `unit`: unit that runs the network.
    `numbers`: number format of the file. An INT8 unit runs a float network in FP16.
    In all other cases, the unit keeps its own precision.
    `asked`: int8, fp16 or fp32, which replaces this choice; None keeps it.
    """
    own = profile.units[unit].precision
    precision = asked or ("fp16" if numbers == "float" and own == "int8" else own)
    changed = profile.units[unit].model_copy(update={"precision": precision})
    return profile.model_copy(update={"units": {**profile.units, unit: changed}})


def under_runtime(profile: Profile, unit: UnitName, runtime: EngineRuntime | None) -> Profile:
    """Return `profile` with the unit's tensor engine under `runtime`; None keeps the runtime of the profile.

    `unit`: unit that runs the network, in the network's precision.

    Raises BadInputError if the profile has no tensor engine for this unit, precision and runtime.
    """
    if runtime is None:
        return profile
    changed = profile.units[unit].model_copy(update={"engine_runtime": runtime})
    if changed.engine is None:
        found = f"{runtime} for the {unit} of {profile.name} in {changed.precision}"
        engines = {name: [key.split("_", 1) for key in each.engines] for name, each in profile.units.items()}
        known = [
            f"{' or '.join(dict.fromkeys(words))} for the {name} in {' or '.join(dict.fromkeys(numbers))}"
            for name, keys in engines.items()
            if keys
            for numbers, words in [zip(*keys, strict=True)]
        ]
        expected = ", or ".join(known) or "a chip with a tensor engine"
        remedy = f"without it the {unit} is priced as its profile says"
        raise BadInputError("--runtime", found, expected, remedy)
    return profile.model_copy(update={"units": {**profile.units, unit: changed}})


class Computes(NamedTuple):
    """How a network computes: number format of its file, and requested precision and runtime; None: not requested."""

    numbers: NumberFormat = "not said"
    precision: str | None = None
    runtime: EngineRuntime | None = None

    def on(self, profile: Profile, unit: UnitName) -> Profile:
        """Return `profile` with `unit` in the precision and under the runtime of this network, as predictions need it.

        Raises BadInputError as `under_runtime`.
        """
        return under_runtime(in_precision(profile, unit, self.numbers, self.precision), unit, self.runtime)


#: The default: the number format is not known, and no precision or runtime is requested.
AS_IT_SAYS: Final = Computes()


def predict_network(
    profile: Profile,
    graph: GraphFile,
    unit: UnitName,
    performance_profile: str = BURST,
    minutes: float = 0.0,
    governor: str | None = None,
    wanted: Wanted = NOTHING,
) -> NetworkPrediction:
    """Return the prediction of one network on one unit.

    `profile`: hardware profile of the chip, with the unit in the network's precision.
    `graph`: graph of the network, from a file.
    `unit`: unit that runs the network.
    `performance_profile`: one of PERFORMANCE_PROFILES; published latencies are assumed to be under `burst`.
    `minutes`: virtual time from a cold start, at the wanted rate or else without pause; 0: no course over minutes.
    `governor`: name in GOVERNORS; None for the profile's governor.
    `wanted`: rate to judge, and limit of power.

    Raises BadInputError for an unknown performance profile, and, unless `minutes` is 0, as `warm_up` does.
    """
    work, corners = graph.work, corners_of(profile, performance_profile)
    time = price(profile, work, unit, corners)
    around = interval(profile, work, time)

    ms_at = cache(lambda at: price(profile, work, unit, at).total_ms)

    def running(at: Corners) -> _Running:
        frame_ms = max(ms_at(at), 1e3 / wanted.fps if wanted.fps else 0.0)
        return _Running(frame_ms, {u: ms_at(at) / frame_ms if u == unit else 0.0 for u in UNITS})

    moments = warm_up(profile, running, performance_profile, minutes, governor) if minutes else []
    at_last = settled_corners(moments) if moments else corners
    is_sure = is_known(profile, unit)
    times = FrameInterval(time.total_ms, *(around[:2] if is_sure else ()))
    why = [*around.why, *([INSIDE] if any(o.op_type in COMPILED for o in time.operators) else [])]
    return NetworkPrediction(
        file=str(graph.path),
        unit=unit,
        numbers=graph.numbers,
        precision=profile.units[unit].precision,
        engine_runtime=profile.units[unit].engine_runtime if profile.units[unit].engine else None,
        parameters_m=work.weights / 1e6,
        gmac=work.macs / 1e9,
        network_ms=time.total_ms,
        low_ms=times.low_ms,
        high_ms=times.high_ms,
        why=tuple(why if is_sure else [UNMEASURED, *why[1:]]),
        fps=1e3 / time.total_ms,
        job_ms=time.job_ms,
        operators=operator_rows(work, time),
        without_rule=without_rule(work),
        power=device_power(profile, running(at_last).busy, at_last, {unit: spread_of(around)}),
        **answers(profile, FrameLoad(lambda at: {unit: ms_at(at)}, ms_at), corners, wanted, times),
        **({**ends_of(moments), **over_minutes(moments)} if moments else {}),
    )


def operator_rows(work: Work, time: NetworkTime) -> tuple[OperatorRow, ...]:
    """Return a row for each operator, in the order of the file.

    An operator that the unit's runtime folds into another one has no row.
    """
    counts = {operator.name: (operator.macs, operator.moved) for operator in work.operators}
    total_ms, rows = time.total_ms, []
    for one in time.operators:
        macs, elements = counts.get(one.name, (0, 0))
        rows.append(OperatorRow(**one._asdict(), share=one.ms / total_ms, macs=macs, elements=elements))
    return tuple(rows)


def without_rule(work: Work) -> tuple[UnruledRow, ...]:
    """Return a row for each operator type without a rule, the type that moves most elements first."""
    moved = Counter[str]()
    for operator in work.operators:
        if not operator.ruled:
            moved[operator.op_type] += operator.moved
    counts = Counter(operator.op_type for operator in work.operators if not operator.ruled)
    total = sum(operator.moved for operator in work.operators)
    return tuple(
        UnruledRow(op_type=op_type, count=counts[op_type], share_of_elements=elements / total)
        for op_type, elements in moved.most_common()
    )
