"""Temperatures of a device over minutes, from the power that its units take.

Rule: there are two time scales and no more: each unit's junction (seconds) on top of the device's body (minutes). Each
is an RC: T' = (T_below + R P - T) / tau, solved exactly over a step in which the power does not change.

Source: lumped RC models of phones (for one, Bhat, Gumussoy and Ogras, 2019).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp

from trilane.hw_profiles.schema import Profile
from trilane.units import UNITS, UnitName


@dataclass
class ThermalState:
    """Temperatures in degrees Celsius: `device_c` of the device's body, `junction_c` of each unit's junction.

    `rising`: whether the headroom shrank over the last step.
    """

    device_c: float
    junction_c: dict[UnitName, float]
    rising: bool = False

    @classmethod
    def at_rest(cls, profile: Profile) -> ThermalState:
        """A device that has been off for long: everything is at ambient temperature."""
        ambient = profile.thermal.ambient_c.or_else(25.0)
        return cls(ambient, dict.fromkeys(UNITS, ambient))

    def advance(self, profile: Profile, power_w: Mapping[UnitName, float], seconds: float) -> None:
        """Let `seconds` pass while each unit takes `power_w`, and the rest of the device the profile's base power."""
        thermal, before = profile.thermal, headroom_k(profile, self)
        device_w = sum(power_w.values()) + thermal.base_power_w.or_else(0.0)
        goal = thermal.ambient_c.or_else(25.0) + thermal.device_k_per_w.or_else(5.0) * device_w
        self.device_c = _approach(self.device_c, goal, seconds, thermal.device_time_s.or_else(600.0))
        for name, unit in profile.units.items():
            goal = self.device_c + unit.junction_k_per_w.or_else(1.0) * power_w[name]
            self.junction_c[name] = _approach(self.junction_c[name], goal, seconds, unit.junction_time_s.or_else(10.0))
        self.rising = headroom_k(profile, self) < before


def _approach(value: float, goal: float, seconds: float, time_constant: float) -> float:
    return goal + (value - goal) * exp(-seconds / time_constant)


def headroom_k(profile: Profile, thermal_state: ThermalState) -> float:
    """Degrees that are left to the nearer of the two limits (skin, junction); negative beyond it."""
    thermal = profile.thermal
    skin = thermal.skin_limit_c.or_else(45.0) - thermal_state.device_c
    return min(skin, thermal.junction_limit_c.or_else(95.0) - max(thermal_state.junction_c.values()))
