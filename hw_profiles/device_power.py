"""The power that a device takes while its units are busy for shares of the time, unit by unit, with intervals.

Rule: a mean is that of `Unit.power_w`; an interval follows from the spreads of the profile's numbers, taken as
independent, and of the busy shares. Powers are positive, so that sums are taken as log-normal.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from trilane.hw_profiles.network_time import NORMAL_80
from trilane.hw_profiles.performance_profiles import Corners
from trilane.hw_profiles.schema import Profile
from trilane.units import UNITS, UnitName


class Watts(NamedTuple):
    """A mean in watts and where it is with a probability of 80 %."""

    w: float
    low_w: float
    high_w: float


def device_power(
    profile: Profile, busy: Mapping[str, float], corners: Corners, busy_error: Mapping[UnitName, float]
) -> dict[str, Any]:
    """Of the whole device, of each unit, and of what is no unit (memory, screen, radio): the base.

    `profile`: of the chip.
    `busy`: share of the time in which each unit works.
    `corners`: at which the units are.
    `busy_error`: relative error of these shares; 0 for a unit without one.
    """
    base = profile.thermal.base_power_w
    spreads = {
        unit: _unit(profile, unit, corners, busy[unit], busy_error.get(unit, 0.0) * (busy[unit] < 1)) for unit in UNITS
    }
    spreads_of_all = [*spreads.values(), (base.or_else(0.0), base.or_else(0.0) * base.relative_error)]
    whole = _watts(sum(mean for mean, _ in spreads_of_all), math.hypot(*(deviation for _, deviation in spreads_of_all)))
    return {
        **whole._asdict(),
        "units": {unit: _watts(*spread)._asdict() for unit, spread in spreads.items()},
        "base": {**_watts(*spreads_of_all[-1])._asdict(), "kind": base.kind},
    }


def _unit(profile: Profile, name: UnitName, corners: Corners, busy: float, busy_error: float) -> tuple[float, float]:
    """Mean and standard deviation of the power of a unit, in watts."""
    unit, corner = profile.units[name], corners[UNITS.index(name)]
    active, idle = unit.power_w(corner, 1.0), unit.power_w(corner, 0.0)
    exponent = unit.power_exponent.or_else(3.0) * unit.power_exponent.relative_error
    active_error = math.hypot(unit.power_max_w.relative_error, exponent * math.log(unit.clock(corner)))
    parts = (
        busy * active * active_error,
        (1 - busy) * idle * unit.idle_w.relative_error,
        busy * busy_error * (active - idle),
    )
    return unit.power_w(corner, busy), math.hypot(*parts)


def _watts(mean: float, deviation: float) -> Watts:
    """The interval of a log-normal distribution of this mean and standard deviation."""
    if not mean:
        return Watts(0.0, 0.0, 0.0)
    variance = math.log1p((deviation / mean) ** 2)
    middle, factor = mean * math.exp(-variance / 2), math.exp(NORMAL_80 * math.sqrt(variance))
    return Watts(mean, middle / factor, middle * factor)
