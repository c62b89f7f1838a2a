"""What was measured of this machine, laid over the profile `host`. Rule: pure functions of measured times.

A network's measured time over its modelled one says how much slower its unit is than the profile's assumed numbers, for
each number of threads. So the network has its measured time, and another tensor shape of it a time in proportion to its
work. The other stages have their measured times in place of the assumed ones. What is not measured has no interval.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import median, stdev
from typing import Any

from trilane.hw_profiles.network_work import Network, Work
from trilane.hw_profiles.placed_host import NETWORK, with_threads
from trilane.hw_profiles.placement_facts import NS_PER_MS
from trilane.hw_profiles.reference_networks import CHANNELS_PER_PASS
from trilane.hw_profiles.schema import Measured, Profile, Quantity
from trilane.hw_profiles.unit_times import time_on
from trilane.scheduler.placement_model import SCHEDULER_NS
from trilane.units import UnitName

#: Relative error of a prediction from measured times, besides their scatter: frame times that followed from CPU times
#: were 0.90 to 1.15 of 11 measured runs (docs/decisions/placement.md), a range that fits a deviation of 0.08.
MODEL_ERROR = 0.08
#: Keys of intervals, and of what stands for one.
OF_TIMES = frozenset(
    [
        "low",
        "high",
        "low_ms",
        "high_ms",
        "reserve_low",
        "reserve_high",
        "confidence",
        "expected_error",
        "expected_error_gpu",
        "expected_error_dsp",
    ]
)
OF_POWER = frozenset(["low_w", "high_w", "low_fps", "high_fps"])
UNMEASURED = "of this machine are cores, clock and instructions; its speeds are assumed, so there is no interval"


def error_of(took: Sequence[float]) -> float:
    """The relative error of what follows from times that were measured: their scatter, and `MODEL_ERROR`.

    `took`: each above 0; a single one has no scatter.
    """
    scatter = stdev(map(math.log, took)) if len(took) > 1 else 0.0
    return math.hypot(scatter, MODEL_ERROR)


def with_network(profile: Profile, work: Work, ms: Mapping[int, float], error: float, said: str) -> Profile:
    """`profile` with the times of a network of `work` on the unit for networks.

    `ms`: measured, by threads. `error`: of `error_of`. `said`: how it was measured, a sentence.
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
    """`profile` with the times of the stages beside the network; the medians over the frames count.

    `network`: whose tensor they had. `took_ns`: of each stage, frame by frame. `avatars`: that were posed. The
    scheduler works on the cores of the first and the last stage; half of what it takes for a frame is added to each.
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


def with_known_intervals(profile: Profile, unit: UnitName, answer: dict[str, Any]) -> dict[str, Any]:
    """`answer`, a prediction for `unit` of this machine, without the intervals of what was not measured.

    No power of it ever is. They are null, and the words of a rate say no more than whether it holds.
    """
    if profile.units[unit].measured is not None:
        return _without(answer, OF_POWER)
    known = _without(answer, OF_POWER | OF_TIMES)
    if rate := known.get("rate"):
        rate["words"] = rate["words"].partition(",")[0]
    return known


def _without(found: dict[str, Any], keys: frozenset[str]) -> dict[str, Any]:
    """`found` with nothing under `keys`, in the mappings in it too."""
    return {
        key: None if key in keys else _without(value, keys) if isinstance(value, dict) else value
        for key, value in found.items()
    }
