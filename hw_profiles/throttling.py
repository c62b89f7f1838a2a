"""Temperature of a device over minutes, and the governors that hold it: pure functions of power and time.

Rule: two time scales and no more: each unit's junction (seconds) over the device's body (minutes). Each is an RC:
T' = (T_below + R P - T) / tau, solved exactly over a step in which the power does not change.

Sources: lumped RC models of phones (for one, Bhat, Gumussoy and Ogras, 2019); governors after `step_wise` and
`power_allocator` of the Linux thermal framework (Documentation/driver-api/thermal).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import exp

from trilane.hw_profiles.schema import CORNERS, Profile
from trilane.units import UNITS, UnitName


@dataclass
class Heat:
    """Temperatures in degrees Celsius of the device's body and of each unit's junction.

    `rising`: the headroom shrank over the last step.
    """

    device_c: float
    junction_c: dict[UnitName, float]
    rising: bool = False

    @classmethod
    def at_rest(cls, profile: Profile) -> Heat:
        ambient = profile.thermal.ambient_c.or_else(25.0)
        return cls(ambient, dict.fromkeys(UNITS, ambient))

    def advance(self, profile: Profile, power_w: Mapping[UnitName, float], seconds: float) -> None:
        """Let `seconds` pass with each unit at `power_w`; the profile's base power comes on top."""
        thermal, before = profile.thermal, headroom_k(profile, self)
        everything = sum(power_w.values()) + thermal.base_power_w.or_else(0.0)
        goal = thermal.ambient_c.or_else(25.0) + thermal.device_k_per_w.or_else(5.0) * everything
        self.device_c = _approach(self.device_c, goal, seconds, thermal.device_time_s.or_else(600.0))
        for name, unit in profile.units.items():
            goal = self.device_c + unit.junction_k_per_w.or_else(1.0) * power_w[name]
            self.junction_c[name] = _approach(self.junction_c[name], goal, seconds, unit.junction_time_s.or_else(10.0))
        self.rising = headroom_k(profile, self) < before


def _approach(value: float, goal: float, seconds: float, time_constant: float) -> float:
    return goal + (value - goal) * exp(-seconds / time_constant)


def headroom_k(profile: Profile, heat: Heat) -> float:
    """Degrees to the nearer of the two limits; negative beyond it."""
    thermal = profile.thermal
    skin = thermal.skin_limit_c.or_else(45.0) - heat.device_c
    return min(skin, thermal.junction_limit_c.or_else(95.0) - max(heat.junction_c.values()))


@dataclass
class Throttle:
    """Steps of the corner ladder that each unit is held below what its performance profile asks."""

    steps: dict[UnitName, int] = field(default_factory=lambda: dict.fromkeys(UNITS, 0))

    def corner_index(self, unit: UnitName, asked: int) -> int:
        return min(asked + self.steps[unit], len(CORNERS) - 1)

    def lower(self, unit: UnitName, asked: int) -> None:
        self.steps[unit] = min(self.steps[unit] + 1, len(CORNERS) - 1 - asked)

    def raise_(self, unit: UnitName) -> None:
        self.steps[unit] = max(self.steps[unit] - 1, 0)


def step_wise(
    profile: Profile, heat: Heat, throttle: Throttle, asked: Mapping[UnitName, int], power_w: Mapping[UnitName, float]
) -> None:
    """Over a limit and rising, the unit that takes most power goes a step down; well under it the lowest one up."""
    headroom = headroom_k(profile, heat)
    if headroom < 0 and heat.rising:
        able = [u for u in UNITS if throttle.corner_index(u, asked[u]) < len(CORNERS) - 1]
        if able:
            hungriest = max(able, key=lambda u: power_w[u])
            throttle.lower(hungriest, asked[hungriest])
    elif headroom > profile.thermal.hysteresis_k.or_else(2.0):
        throttle.raise_(max(UNITS, key=lambda u: throttle.steps[u]))


def power_allocator(
    profile: Profile, heat: Heat, throttle: Throttle, asked: Mapping[UnitName, int], power_w: Mapping[UnitName, float]
) -> None:
    """Grants the power that the device can shed plus a share of the headroom; units give way to fit into it."""
    thermal = profile.thermal
    resistance = thermal.device_k_per_w.or_else(5.0)
    shed = (thermal.skin_limit_c.or_else(45.0) - thermal.ambient_c.or_else(25.0)) / resistance
    granted = shed - thermal.base_power_w.or_else(0.0) + headroom_k(profile, heat) / resistance
    wanted = sum(power_w.values())
    if wanted > granted:
        able = [u for u in UNITS if throttle.corner_index(u, asked[u]) < len(CORNERS) - 1]
        if able:
            hungriest = max(able, key=lambda u: power_w[u])
            throttle.lower(hungriest, asked[hungriest])
        return
    held = max(UNITS, key=lambda u: throttle.steps[u])
    if throttle.steps[held] and wanted + _next_step_w(profile, throttle, held, asked[held], power_w[held]) <= granted:
        throttle.raise_(held)


def _next_step_w(profile: Profile, throttle: Throttle, name: UnitName, asked: int, power_w: float) -> float:
    """How much more power `name` would take one corner higher, at the same share of busy time."""
    unit, index = profile.units[name], throttle.corner_index(name, asked)
    now, then = (unit.power_w(CORNERS[i], 1.0) for i in (index, index - 1))
    return power_w * (then / now - 1) if now else 0.0


Govern = Callable[[Profile, Heat, Throttle, Mapping[UnitName, int], Mapping[UnitName, float]], None]
GOVERNORS: dict[str, Govern] = {"step_wise": step_wise, "power_allocator": power_allocator}
