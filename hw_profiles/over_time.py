"""The application on a chip over minutes: it warms up, and the governor throttles it.

Rule: between two polls of the governor the application is in its settled state at the corners of that time; nothing
else changes the power.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from trilane.errors import BadInputError
from trilane.hw_profiles.application import Plan, steady
from trilane.hw_profiles.performance_profiles import Corners, corners_of
from trilane.hw_profiles.schema import CORNERS, Profile
from trilane.hw_profiles.thermal_state import ThermalState
from trilane.hw_profiles.throttling import GOVERNORS, Throttle
from trilane.units import UNITS, UnitName

MAX_MINUTES = 24 * 60


@dataclass(frozen=True)
class Moment:
    """The application at one poll of the governor.

    `device_c`, `junction_c`: temperatures of the device and of the hottest junction, degrees Celsius. `throttled`:
    whether a unit is below the corner that the performance profile requests; `corners`: where the units are.
    """

    t_s: float
    frame_ms: float
    device_c: float
    junction_c: float
    power_w: float
    throttled: bool
    corners: Corners


class Settled(Protocol):
    """What runs at constant corners, once it has settled. `frame_ms`: its frame time. `busy`: share of each unit."""

    @property
    def frame_ms(self) -> float: ...

    @property
    def busy(self) -> Mapping[str, float]: ...


def over_time(
    profile: Profile, plan: Plan, performance_profile: str, minutes: float, governor: str | None = None
) -> list[Moment]:
    """The application from a cold start, one moment per poll of the governor.

    `profile`: of the chip.
    `plan`: what runs on it.
    `performance_profile`: by name.
    `minutes`: of virtual time.
    `governor`: of GOVERNORS; None for the profile's own.
    Raises BadInputError for an unknown name or a time out of range.
    """
    return warm_up(profile, lambda corners: steady(profile, plan, corners), performance_profile, minutes, governor)


def warm_up(
    profile: Profile,
    at: Callable[[Corners], Settled],
    performance_profile: str,
    minutes: float,
    governor: str | None = None,
) -> list[Moment]:
    """`over_time` of whatever settles `at` given corners as it says; it is asked once for each."""
    name = governor or profile.thermal.governor
    if name not in GOVERNORS:
        raise BadInputError("governor", repr(name), " or ".join(GOVERNORS))
    if not 0 < minutes <= MAX_MINUTES:
        raise BadInputError("minutes", f"{minutes:g}", f"above 0, at most {MAX_MINUTES}")
    requested = dict(zip(UNITS, map(CORNERS.index, corners_of(profile, performance_profile)), strict=True))
    thermal_state, throttle, moments = ThermalState.at_rest(profile), Throttle(), []
    poll_s, steady_at = profile.thermal.poll_s.or_else(1.0), dict[Corners, Settled]()
    for tick in range(max(1, round(60 * minutes / poll_s))):
        cpu, gpu, dsp = (CORNERS[throttle.corner_index(unit, requested[unit])] for unit in UNITS)
        corners = (cpu, gpu, dsp)
        if corners not in steady_at:
            steady_at[corners] = at(corners)
        now = steady_at[corners]
        power = unit_power_w(profile, now, corners)
        thermal_state.advance(profile, power, poll_s)
        total = sum(power.values()) + profile.thermal.base_power_w.or_else(0)
        throttled = any(throttle.steps.values())
        hottest = max(thermal_state.junction_c.values())
        t_s = (tick + 1) * poll_s
        moments.append(Moment(t_s, now.frame_ms, thermal_state.device_c, hottest, total, throttled, corners))
        GOVERNORS[name](profile, thermal_state, throttle, requested, power)
    return moments


def unit_power_w(profile: Profile, now: Settled, corners: Corners) -> dict[UnitName, float]:
    """Mean power in watts of each unit while the application runs as in `now` with the units at `corners`."""
    return {
        name: profile.units[name].power_w(corner, now.busy[name]) for name, corner in zip(UNITS, corners, strict=True)
    }
