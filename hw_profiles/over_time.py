"""A chip over minutes: it warms up, the governor throttles it, and reports sum up the moments.

Between two polls of the governor the application stays in the settled state of its corners; nothing else changes the
power. A report only sums up moments; it models nothing more.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from trilane.errors import BadInputError
from trilane.hw_profiles.application import Plan, steady
from trilane.hw_profiles.governor import GOVERNORS, ThermalState, Throttle
from trilane.hw_profiles.schema import CORNERS, Corners, Profile, corners_of
from trilane.units import MAX_MINUTES, UNITS, UnitName

MOST_SHOWN = 360  # moments in a report


@dataclass(frozen=True)
class Moment:
    """The state at one poll of the governor.

    `device_c`, `junction_c`: temperatures of the device and of the hottest junction, degrees Celsius. `throttled`:
    whether a unit is below the corner that the performance profile requests. `corners`: corner of each unit.
    """

    t_s: float
    frame_ms: float
    device_c: float
    junction_c: float
    power_w: float
    throttled: bool
    corners: Corners


class Settled(Protocol):
    """A settled state at constant corners. `frame_ms`: its frame time. `busy`: share of the time, by unit."""

    @property
    def frame_ms(self) -> float: ...

    @property
    def busy(self) -> Mapping[str, float]: ...


def over_time(
    profile: Profile, plan: Plan, performance_profile: str, minutes: float, governor: str | None = None
) -> list[Moment]:
    """Run the application from a cold start and return one moment per poll of the governor.

    `profile`: hardware profile of the chip.
    `plan`: application that runs on it.
    `performance_profile`: its name, one of PERFORMANCE_PROFILES.
    `minutes`: virtual time, above 0 to MAX_MINUTES.
    `governor`: name in GOVERNORS; None for the profile's own.
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
    """Do the same as `over_time` for any load whose settled state `at` gives.

    `at`: returns the settled state at given corners; it is called once for each combination.
    """
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
    """Return the mean power of each unit in watts in the settled state `now`, with the units at `corners`."""
    return {
        name: profile.units[name].power_w(corner, now.busy[name]) for name, corner in zip(UNITS, corners, strict=True)
    }


def last_fifth(moments: Sequence[Moment]) -> Sequence[Moment]:
    """Return the moments to which a run settles: the last fifth of them, at least one; empty without moments."""
    return moments[-max(1, len(moments) // 5) :]


def ends_of(moments: Sequence[Moment]) -> dict[str, float]:
    """Return frames a second at the start, and those to which it settles: the mean of the last fifth of the time."""
    last = last_fifth(moments)
    return {"fps_start": 1e3 / moments[0].frame_ms, "fps_settled": 1e3 / (sum(m.frame_ms for m in last) / len(last))}


def settled_corners(moments: Sequence[Moment]) -> Corners:
    """Return the corners at which the units mostly are in the last fifth of the time."""
    return Counter(moment.corners for moment in last_fifth(moments)).most_common(1)[0][0]


def temperatures_of(moments: Sequence[Moment]) -> dict[str, float]:
    """Return the degrees Celsius of the device and of its hottest junction; empty without moments."""
    if not moments:
        return {}
    return {
        "device_end": moments[-1].device_c,
        "device_max": max(m.device_c for m in moments),
        "junction_max": max(m.junction_c for m in moments),
    }


def caps_of(moments: Sequence[Moment]) -> dict[str, Any]:
    """Return the share of the time in which a unit was lowered for heat, and the first second of it."""
    throttled_s = [m.t_s for m in moments if m.throttled]
    return {
        "throttled_share": len(throttled_s) / len(moments) if moments else 0.0,
        "first_throttled_s": throttled_s[0] if throttled_s else None,
    }


def timeline_of(moments: Sequence[Moment]) -> list[dict[str, Any]]:
    """Return the moments as plain data, thinned."""
    return [_shown(m) for m in moments[:: max(1, len(moments) // MOST_SHOWN)]]


def _shown(moment: Moment) -> dict[str, Any]:
    return {
        "t_s": moment.t_s,
        "fps": 1e3 / moment.frame_ms,
        "device_c": moment.device_c,
        "junction_c": moment.junction_c,
        "power_w": moment.power_w,
        "corners": dict(zip(UNITS, moment.corners, strict=True)),
    }
