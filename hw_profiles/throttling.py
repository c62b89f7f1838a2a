"""Decides throttling: which unit goes to a lower corner near a thermal limit, and which one back up.

Rule: a governor is a pure rule over temperatures and power; it changes one unit by one corner per call.

Source: `step_wise` and `power_allocator` of the Linux thermal framework (Documentation/driver-api/thermal).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from trilane.hw_profiles.schema import CORNERS, Profile
from trilane.hw_profiles.thermal_state import ThermalState, headroom_k
from trilane.units import UNITS, UnitName


@dataclass
class Throttle:
    """How many corners each unit is held below the one that its performance profile requests."""

    steps: dict[UnitName, int] = field(default_factory=lambda: dict.fromkeys(UNITS, 0))

    def corner_index(self, unit: UnitName, requested: int) -> int:
        """Index into CORNERS at which `unit` runs when its performance profile requests `requested`."""
        return min(requested + self.steps[unit], len(CORNERS) - 1)

    def lower(self, unit: UnitName, requested: int) -> None:
        """Take `unit` one corner down, but not below the last one."""
        self.steps[unit] = min(self.steps[unit] + 1, len(CORNERS) - 1 - requested)

    def raise_(self, unit: UnitName) -> None:
        """Take `unit` one corner up, but not above the requested one."""
        self.steps[unit] = max(self.steps[unit] - 1, 0)


def step_wise(
    profile: Profile,
    thermal_state: ThermalState,
    throttle: Throttle,
    requested: Mapping[UnitName, int],
    power_w: Mapping[UnitName, float],
) -> None:
    """Lowers the unit that takes most power when the device is over a limit and still getting warmer.

    Raises the most lowered unit again when the device is below the limits by the hysteresis.

    `profile`: of the chip.
    `thermal_state`: its temperatures now.
    `throttle`: is changed.
    `requested`: index into CORNERS that the performance profile requests of each unit.
    `power_w`: that each unit takes now.
    """
    headroom = headroom_k(profile, thermal_state)
    if headroom < 0 and thermal_state.rising:
        lowerable = [u for u in UNITS if throttle.corner_index(u, requested[u]) < len(CORNERS) - 1]
        if lowerable:
            highest_power = max(lowerable, key=lambda u: power_w[u])
            throttle.lower(highest_power, requested[highest_power])
    elif headroom > profile.thermal.hysteresis_k.or_else(2.0):
        throttle.raise_(max(UNITS, key=lambda u: throttle.steps[u]))


def power_allocator(
    profile: Profile,
    thermal_state: ThermalState,
    throttle: Throttle,
    requested: Mapping[UnitName, int],
    power_w: Mapping[UnitName, float],
) -> None:
    """Grants the units the power that the device can shed plus a share of the headroom.

    Lowers the unit that takes most power while they take more than that, and raises the most lowered one again when its
    additional power fits into the grant.

    `profile`: of the chip.
    `thermal_state`: its temperatures now.
    `throttle`: is changed.
    `requested`: index into CORNERS that the performance profile requests of each unit.
    `power_w`: that each unit takes now.
    """
    thermal = profile.thermal
    resistance = thermal.device_k_per_w.or_else(5.0)
    shed = (thermal.skin_limit_c.or_else(45.0) - thermal.ambient_c.or_else(25.0)) / resistance
    granted = shed - thermal.base_power_w.or_else(0.0) + headroom_k(profile, thermal_state) / resistance
    wanted = sum(power_w.values())
    if wanted > granted:
        lowerable = [u for u in UNITS if throttle.corner_index(u, requested[u]) < len(CORNERS) - 1]
        if lowerable:
            highest_power = max(lowerable, key=lambda u: power_w[u])
            throttle.lower(highest_power, requested[highest_power])
        return
    lowest = max(UNITS, key=lambda u: throttle.steps[u])
    if throttle.steps[lowest]:
        more = _next_step_w(profile, throttle, lowest, requested[lowest], power_w[lowest])
        if wanted + more <= granted:
            throttle.raise_(lowest)


def _next_step_w(profile: Profile, throttle: Throttle, name: UnitName, requested: int, power_w: float) -> float:
    """How much more power `name` would take one corner higher, at the same share of busy time.

    `profile`: of the chip.
    `throttle`: how far its units are lowered now.
    `name`: of the unit.
    `requested`: index into CORNERS that the performance profile requests of it.
    `power_w`: that it takes now.
    """
    unit, index = profile.units[name], throttle.corner_index(name, requested)
    now, then = (unit.power_w(CORNERS[i], 1.0) for i in (index, index - 1))
    return power_w * (then / now - 1) if now else 0.0


Govern = Callable[[Profile, ThermalState, Throttle, Mapping[UnitName, int], Mapping[UnitName, float]], None]
#: Name of a governor, as in the Linux thermal framework -> its function.
GOVERNORS: dict[str, Govern] = {"step_wise": step_wise, "power_allocator": power_allocator}
