"""A network by itself on a unit: its time, its most expensive operators, and how it fares over minutes.

Rule: nothing else runs, neither raster nor composite; the other units are idle. Times are of `network_time.py`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

from trilane.errors import BadInputError
from trilane.hw_profiles.device_power import device_power
from trilane.hw_profiles.graph_file import GraphFile, Numbers
from trilane.hw_profiles.load import HOST
from trilane.hw_profiles.measured_host import UNMEASURED, with_known_intervals
from trilane.hw_profiles.network_time import Interval, NetworkTime, interval, price, spread_of
from trilane.hw_profiles.network_work import Work
from trilane.hw_profiles.operator_kinds import COMPILED
from trilane.hw_profiles.over_time import Moment, warm_up
from trilane.hw_profiles.performance_profiles import Corners, corners_of
from trilane.hw_profiles.rates import NOTHING, FrameTimes, Load, Wanted, answers
from trilane.hw_profiles.schema import EngineRuntime, Profile
from trilane.hw_profiles.timeline import caps_of, ends_of, settled_corners, temperatures_of, timeline_of
from trilane.units import BURST, UNITS, UnitName

#: Said of a time that is only a lower bound.
INSIDE = "it holds a compiled network, of which only the ends are seen: price the network that it was made from"


class Running(NamedTuple):
    """A network that runs on and on. `frame_ms`: between two results. `busy`: share of the time of each unit."""

    frame_ms: float
    busy: Mapping[str, float]


def in_precision(profile: Profile, unit: UnitName, numbers: Numbers, asked: str | None = None) -> Profile:
    """`profile` with the unit computing as the network does.

    `unit`: that runs it.
    `numbers`: what the file says of its numbers. A network of floats has FP16 on a unit for integers; any other one has
    the unit's own precision, as a file without weights says nothing.
    `asked`: int8, fp16 or fp32 instead.
    """
    own = profile.units[unit].precision
    precision = asked or ("fp16" if numbers == "float" and own == "int8" else own)
    changed = profile.units[unit].model_copy(update={"precision": precision})
    return profile.model_copy(update={"units": {**profile.units, unit: changed}})


def under_runtime(profile: Profile, unit: UnitName, runtime: EngineRuntime | None) -> Profile:
    """`profile` with the tensor engine of the unit under `runtime`, None for the unit's own.

    `unit`: that runs the network, in the network's precision.
    Raises BadInputError where the profile has no numbers for it.
    """
    if runtime is None:
        return profile
    changed = profile.units[unit].model_copy(update={"engine_runtime": runtime})
    if changed.engine is None:
        found = f"{runtime} for the {unit} of {profile.name} in {changed.precision}"
        known = [f"{', '.join(each.engines)} of the {name}" for name, each in profile.units.items() if each.engines]
        expected = " or ".join(known) or "a chip with a tensor engine"
        raise BadInputError("engine runtime", found, expected, "without it a unit is priced as its profile says")
    return profile.model_copy(update={"units": {**profile.units, unit: changed}})


def predict_network(
    profile: Profile,
    graph: GraphFile,
    unit: UnitName,
    performance_profile: str = BURST,
    minutes: float = 0.0,
    governor: str | None = None,
    wanted: Wanted = NOTHING,
) -> dict[str, Any]:
    """Everything about one network on one unit, as plain data.

    `profile`: of the chip, with the unit in the precision of the network.
    `graph`: of the network.
    `unit`: that runs it.
    `performance_profile`: by name; published latencies are taken to be of `burst`.
    `minutes`: of virtual time from a cold start, at the wanted rate or as fast as it can; 0 for none.
    `governor`: of GOVERNORS; None for the profile's own.
    `wanted`: a rate that may hold or not, and a limit of power.
    Raises BadInputError for an unknown name, a time out of range, and operators that cannot be counted.
    """
    work, corners = graph.work, corners_of(profile, performance_profile)
    time = price(profile, work, unit, corners)
    around = interval(profile, work, time)

    known = {corners: time.total_ms}

    def ms_at(at: Corners) -> float:
        if at not in known:
            known[at] = price(profile, work, unit, at).total_ms
        return known[at]

    def running(at: Corners) -> Running:
        frame_ms = max(ms_at(at), 1e3 / wanted.fps if wanted.fps else 0.0)
        return Running(frame_ms, {u: ms_at(at) / frame_ms if u == unit else 0.0 for u in UNITS})

    moments = warm_up(profile, running, performance_profile, minutes, governor) if minutes else []
    at_last = settled_corners(moments) if moments else corners
    answer = {
        "file": str(graph.path),
        "unit": unit,
        "numbers": graph.numbers,
        "precision": profile.units[unit].precision,
        "engine_runtime": profile.units[unit].engine_runtime if profile.units[unit].engine else None,
        "parameters_m": work.weights / 1e6,
        "gmac": work.macs / 1e9,
        **_times(time, around),
        "operators": operator_rows(work, time),
        "without_rule": without_rule(work),
        "power": device_power(profile, running(at_last).busy, at_last, {unit: spread_of(around)}),
        **answers(
            profile, Load(lambda at: {unit: ms_at(at)}, ms_at), corners, wanted, FrameTimes(time.total_ms, *around[:2])
        ),
        **(_over_minutes(moments) if moments else {}),
    }
    if profile.name != HOST:
        return answer
    why = answer["why"] if profile.units[unit].measured is not None else [UNMEASURED, *answer["why"][1:]]
    return with_known_intervals(profile, unit, {**answer, "why": why})


def _times(time: NetworkTime, around: Interval) -> dict[str, Any]:
    return {
        "network_ms": time.total_ms,
        "low_ms": around.low_ms,
        "high_ms": around.high_ms,
        "why": [*around.why, *([INSIDE] if any(o.op_type in COMPILED for o in time.operators) else [])],
        "fps": 1e3 / time.total_ms,
        "job_ms": time.job_ms,
    }


def operator_rows(work: Work, time: NetworkTime) -> list[dict[str, Any]]:
    """The operators in the order of the file, with what bounds each, and its share of the network's time.

    An operator that the unit's runtime folds into another one is not among those of `time`.
    """
    counts = {operator.name: (operator.macs, operator.moved) for operator in work.operators}
    total_ms = time.total_ms
    return [
        {
            "name": one.name,
            "op_type": one.op_type,
            "ms": one.ms,
            "share": one.ms / total_ms,
            "bound": one.bound,
            "macs": counts.get(one.name, (0, 0))[0],
            "elements": counts.get(one.name, (0, 0))[1],
        }
        for one in time.operators
    ]


def without_rule(work: Work) -> list[dict[str, Any]]:
    """Types of operators that no rule is for: how many there are and which share of all moved elements is theirs."""
    moved = Counter[str]()
    for operator in work.operators:
        if not operator.ruled:
            moved[operator.op_type] += operator.moved
    counts = Counter(operator.op_type for operator in work.operators if not operator.ruled)
    total = sum(operator.moved for operator in work.operators)
    return [
        {"op_type": op_type, "count": counts[op_type], "share_of_elements": elements / total}
        for op_type, elements in moved.most_common()
    ]


def _over_minutes(moments: list[Moment]) -> dict[str, Any]:
    return {
        **ends_of(moments),
        "temperature_c": temperatures_of(moments),
        "caps": caps_of(moments),
        "timeline": timeline_of(moments),
    }
