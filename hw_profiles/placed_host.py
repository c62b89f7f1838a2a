"""The units of the profile `host` on cores, in virtual time. Rule: they are placed as a run's are, by modelled times.

The scheduler in virtual time knows units that have cores of their own and units that work in turns on one core. So
these placements are the ones to choose from: no unit floats, and none with several cores shares one. Where cores are
asked for, which is not simulated, all are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from trilane.hw_profiles.application import Plan, stage_times_ms
from trilane.hw_profiles.host import rule_placement
from trilane.hw_profiles.performance_profiles import Corners
from trilane.hw_profiles.placement_facts import NS_PER_MS, predictions, unit_rows
from trilane.hw_profiles.schema import Profile, Quantity, Unit
from trilane.scheduler.placement import Ranked, chosen, ranked
from trilane.scheduler.placement_model import Rules, frame_ns
from trilane.scheduler.places import Core, Place, Placement, Times, Work, shared_cores
from trilane.units import BEFORE_INFER, UNITS, UnitName

NETWORK: UnitName = "dsp"
SEQUENTIAL = "sequential"
PEAKS = ("peak_int8_tmac_s", "peak_fp16_tmac_s", "peak_fp32_tmac_s")


class Placed(NamedTuple):
    """`best`: the placement that was taken. `rule`: that for any run. `found`: all, the least frame time first."""

    best: Ranked
    rule: Ranked
    found: Sequence[Ranked]

    @property
    def facts(self) -> dict[str, Any]:
        """`placement` of a prediction."""
        return {"units": unit_rows(self.best.placement), **predictions(self.best, self.rule, self.found)}


def place_units(
    profile: Profile,
    plan: Plan,
    corners: Corners,
    cores: Sequence[Core],
    asked: Mapping[str, tuple[int, ...]] | None = None,
) -> Placed:
    """Place the units of `profile` for `plan`, at these `corners`, on `cores`, by what the model says they need.

    `asked`: cores of units that are given, all of them among `cores`.
    """
    given = {unit: Place(own, len(own)) for unit, own in (asked or {}).items()}
    times = _times(profile, plan, corners, len(cores), given)
    rules = Rules(BEFORE_INFER[0][1], plan.variant.policy == SEQUENTIAL)
    where = rule_placement(tuple(core.number for core in cores), asked)
    found = [each for each in ranked(cores, times, rules, given) if given or _can_be_simulated(each.placement)]
    rule = Ranked(where, frame_ns(where, cores, times, rules))
    return Placed(chosen(found, rule), rule, found)


def on_cores(profile: Profile, placement: Placement) -> Profile:
    """`profile` with its units placed so; the network's has the rates of its threads."""
    units = {}
    for name, unit in profile.units.items():
        place = placement[name]
        core = f"core {place.cores[0]}" if len(place.cores) == 1 else ""
        placed = with_threads(unit, place.threads) if name == NETWORK else unit
        units[name] = placed.model_copy(update={"core": core})
    return profile.model_copy(update={"units": units})


def _can_be_simulated(placement: Placement) -> bool:
    shared = shared_cores(placement)
    return all(len(place.cores) == place.threads for place in placement.values()) and not any(
        shared.intersection(place.cores) for place in placement.values() if place.threads > 1
    )


def _times(profile: Profile, plan: Plan, corners: Corners, cores: int, given: Placement) -> Times:
    """The model's times of a frame. The network's unit may have as many threads as there are cores.

    `given`: places of units, whose threads are known too.
    """
    rule = rule_placement(tuple(range(cores)))
    counts = {unit: {1, rule[unit].threads} for unit in UNITS}
    measured = profile.units[NETWORK].measured
    counts[NETWORK] = counts[NETWORK] | set(range(1, cores + 1)) if measured is None else set(measured.slower)
    for unit in UNITS:
        counts[unit] |= {place.threads for name, place in given.items() if name == unit}
    times: dict[str, dict[int, Work]] = {unit: {} for unit in UNITS}
    for unit, threads in ((unit, each) for unit, of in counts.items() for each in sorted(of)):
        network = with_threads(profile.units[NETWORK], threads) if unit == NETWORK else profile.units[NETWORK]
        threaded = profile.model_copy(update={"units": {**profile.units, NETWORK: network}})
        stages = stage_times_ms(threaded, plan, corners)
        own = [ms / plan.variant.batch for (_, other), ms in stages.items() if other == unit]
        ns = round(sum(own) * NS_PER_MS)
        times[unit][threads] = Work(ns, ns, len(own))
    return times


def with_threads(unit: Unit, threads: int) -> Unit:
    """The network's unit with `threads` threads. Each thread has the peak rates of a core.

    A measured unit is slower by the factor that was measured with that number of threads.
    """
    scale = threads / unit.threads
    rates: dict[str, Quantity] = {name: getattr(unit, name) for name in PEAKS}
    scaled = {name: rate.model_copy(update={"value": rate.or_else(0.0) * scale}) for name, rate in rates.items()}
    return unit.model_copy(update={**scaled, "threads": threads})
