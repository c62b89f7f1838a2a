"""The profile `host` in a prediction: its units placed on cores, and measured times in place of assumed times.

Units are placed as in a run, but by modelled times. Virtual time can only simulate units with cores of their own, and
units that take turns on one core. Therefore no unit floats, and no unit with several cores shares a core, apart from
cores that the user chose. A network's measured time, divided by its modelled time, says how much slower its unit is
than assumed, for each number of threads. If the network's tensor has another shape, the time changes in proportion to
the work. A prediction without measurements has no interval.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import median, stdev
from typing import Any, NamedTuple

from trilane.hw_profiles.application import Plan, stage_times_ms
from trilane.hw_profiles.host import predictions, rule_placement, unit_rows
from trilane.hw_profiles.network_work import Network, Work
from trilane.hw_profiles.reference_networks import CHANNELS_PER_PASS
from trilane.hw_profiles.schema import Corners, Measured, Profile, Quantity, Unit
from trilane.hw_profiles.unit_times import time_on
from trilane.scheduler.placement import (
    SCHEDULER_NS,
    CpuCore,
    Place,
    Placement,
    Ranked,
    Rules,
    Times,
    chosen,
    frame_ns,
    ranked,
    shared_cores,
)
from trilane.scheduler.placement import UnitWork as FrameWork
from trilane.units import BEFORE_INFER, HOST, NS_PER_MS, UNITS, UnitName

NETWORK: UnitName = "dsp"
SEQUENTIAL = "sequential"
PEAKS = ("peak_int8_tmac_s", "peak_fp16_tmac_s", "peak_fp32_tmac_s")

#: Relative error of a prediction from measured times, in addition to their scatter. It is the deviation of predicted
#: from measured frame times, with each network left out in turn, from `trilane bench predict`
#: (docs/decisions/this-machine.md).
MODEL_ERROR = 0.108
UNMEASURED = "of this machine are cores, clock and instructions; its speeds are assumed, so there is no interval"


class Placed(NamedTuple):
    """The placement of the units.

    `best`: placement that was chosen.
    `rule`: placement that suits any run.
    `found`: all placements, the shortest frame time first.
    """

    best: Ranked
    rule: Ranked
    found: Sequence[Ranked]

    @property
    def facts(self) -> dict[str, Any]:
        """The value of a prediction's key `placement`: `units`, and the keys of `predictions`."""
        return {"units": unit_rows(self.best.placement), **predictions(self.best, self.rule, self.found)}


def place_units(
    profile: Profile,
    plan: Plan,
    corners: Corners,
    cores: Sequence[CpuCore],
    asked: Mapping[str, tuple[int, ...]] | None = None,
) -> Placed:
    """Return the placement of the units of `profile` on `cores`, by the times that the model predicts for `plan`.

    `corners`: corner of each unit.
    `asked`: cores that the user chose for units, all of them among `cores`.
    """
    given = {unit: Place(own, len(own)) for unit, own in (asked or {}).items()}
    times = _times(profile, plan, corners, len(cores), given)
    rules = Rules(BEFORE_INFER[0][1], plan.variant.policy == SEQUENTIAL)
    where = rule_placement(tuple(core.number for core in cores), asked)
    found = [each for each in ranked(cores, times, rules, given) if given or _can_be_simulated(each.placement)]
    rule = Ranked(where, frame_ns(where, cores, times, rules))
    return Placed(chosen(found, rule), rule, found)


def on_cores(profile: Profile, placement: Placement) -> Profile:
    """Return `profile` with the cores that `placement` gives its units, and the threads for the network's unit."""
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
    """Return the modelled work of a frame, by unit and number of threads.

    The network's unit may have any number of threads up to the number of cores, or the measured numbers. Numbers of
    threads of the places `given` by the user are added.
    """
    rule = rule_placement(tuple(range(cores)))
    counts = {unit: {1, rule[unit].threads} for unit in UNITS}
    measured = profile.units[NETWORK].measured
    counts[NETWORK] = counts[NETWORK] | set(range(1, cores + 1)) if measured is None else set(measured.slower)
    for unit in UNITS:
        counts[unit] |= {place.threads for name, place in given.items() if name == unit}
    times: dict[str, dict[int, FrameWork]] = {unit: {} for unit in UNITS}
    for unit, threads in ((unit, each) for unit, of in counts.items() for each in sorted(of)):
        network = with_threads(profile.units[NETWORK], threads) if unit == NETWORK else profile.units[NETWORK]
        threaded = profile.model_copy(update={"units": {**profile.units, NETWORK: network}})
        stages = stage_times_ms(threaded, plan, corners)
        own = [ms / plan.variant.batch for (_, other), ms in stages.items() if other == unit]
        ns = round(sum(own) * NS_PER_MS)
        times[unit][threads] = FrameWork(ns, ns, len(own))
    return times


def with_threads(unit: Unit, threads: int) -> Unit:
    """Return the network's unit with `threads` threads, and peak rates in proportion to this number."""
    scale = threads / unit.threads
    rates: dict[str, Quantity] = {name: getattr(unit, name) for name in PEAKS}
    scaled = {name: rate.model_copy(update={"value": rate.or_else(0.0) * scale}) for name, rate in rates.items()}
    return unit.model_copy(update={**scaled, "threads": threads})


def error_of(took: Sequence[float]) -> float:
    """Return the relative error of a prediction from measured times: their scatter, combined with MODEL_ERROR.

    `took`: measured times, each above 0; a single time has no scatter.
    """
    scatter = stdev(map(math.log, took)) if len(took) > 1 else 0.0
    return math.hypot(scatter, MODEL_ERROR)


def with_network(profile: Profile, work: Work, ms: Mapping[int, float], error: float, said: str) -> Profile:
    """Return `profile` with the measured times of a network on the unit for networks.

    The unit keeps its number of threads, or takes the least measured one if its own was not measured. The
    application's share of the memory's bandwidth becomes 0, because the stages were measured beside each other.

    `work`: work of the network.
    `ms`: measured time of a job in ms, by number of threads.
    `error`: relative error of these times, from `error_of`.
    `said`: sentence that says how the times were measured.
    """
    fraction = _measured(0.0, "the stages were measured beside each other")
    memory = profile.memory.model_copy(update={"application_use_fraction": fraction})
    unit = profile.units[NETWORK]
    slower = {
        threads: took / time_on(with_threads(unit, threads), memory, work).total_ms for threads, took in ms.items()
    }
    measured = unit.model_copy(update={"measured": Measured(slower=slower, error=error, said=said)})
    threads = unit.threads if unit.threads in slower else min(slower)
    units = {**profile.units, NETWORK: with_threads(measured, threads)}
    return profile.model_copy(update={"units": units, "memory": memory})


def with_stages(
    profile: Profile, network: Network, took_ns: Mapping[str, Sequence[int]], said: str, avatars: int = 1
) -> Profile:
    """Return `profile` with measured times of the stages other than the network: the medians over the frames.

    The scheduler works on the cores of the first and the last stage, so half of its time for a frame is added to each.

    `network`: network whose tensor the frames had.
    `took_ns`: for each stage, its time for each frame in ns.
    `said`: sentence that says how the times were measured.
    `avatars`: number of avatars that were posed.
    """
    ms = {name: median(each) / NS_PER_MS for name, each in took_ns.items()}
    scheduler_ms = len(ms) * SCHEDULER_NS / NS_PER_MS / 2
    drawn = network.pixels * -(-network.channels // CHANNELS_PER_PASS)
    costs = {
        "pose_ms": (ms["pose"] + scheduler_ms) / avatars,
        "raster_ns_per_vertex": 0.0,
        "raster_ns_per_pixel": ms["raster"] * NS_PER_MS / drawn,
        "readback_ns_per_byte": 0.0,
        "handover_ms": 0.0,
        "composite_ms": ms["composite"],
        "present_ms": ms["present"] + scheduler_ms,
    }
    update = {key: _measured(value, said) for key, value in costs.items()}
    return profile.model_copy(update={"application": profile.application.model_copy(update=update)})


def _measured(value: float, source: str) -> Quantity:
    return Quantity(value=value, kind="measured", source=source)


def is_known(profile: Profile, unit: UnitName) -> bool:
    """Return whether times on `unit` have a known error: a chip's times always do, this machine's only if measured."""
    return profile.name != HOST or profile.units[unit].measured is not None
