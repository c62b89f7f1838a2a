"""Temperatures of a device, the rules that throttle its units, and the governor that applies them to a run.

Each unit's junction (seconds) stands on the device's body (minutes). Each is an RC, T' = (T_below + R P - T) / tau,
solved exactly over a step of constant power (lumped models of phones: Bhat, Gumussoy and Ogras, 2019). The rules are
`step_wise` and `power_allocator` of the Linux thermal framework (Documentation/driver-api/thermal): pure functions of
temperatures and power that move one unit by one corner per call. In a run on this machine a corner is a duty cycle: its
clock divided by the highest clock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import exp
from typing import Any

from trilane.errors import BadInputError
from trilane.hw_profiles.schema import CORNERS, Profile, corners_of
from trilane.scheduler.events import SetDuty
from trilane.scheduler.state import FULL_DUTY
from trilane.units import PERFORMANCE_PROFILES, UNITS, UnitName

#: Performance profiles that ask for a short wake-up of a sleeping unit: idle cores are kept awake.
PROMPT = PERFORMANCE_PROFILES[:3]
HOW = "duty cycles; cores and threads of each unit stand with it"  # `caps.how` of report.json
NS = 1_000_000_000


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
        """Return a device that has been off for long: everything is at ambient temperature."""
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
    # The exact solution while the power, and with it `goal`, stays the same.
    return goal + (value - goal) * exp(-seconds / time_constant)


def headroom_k(profile: Profile, thermal_state: ThermalState) -> float:
    """Return the degrees that are left to the nearer of the two limits (skin, junction); negative beyond it."""
    thermal = profile.thermal
    skin = thermal.skin_limit_c.or_else(45.0) - thermal_state.device_c
    return min(skin, thermal.junction_limit_c.or_else(95.0) - max(thermal_state.junction_c.values()))


@dataclass
class Throttle:
    """How many corners each unit is held below the one that its performance profile requests."""

    steps: dict[UnitName, int] = field(default_factory=lambda: dict.fromkeys(UNITS, 0))

    def corner_index(self, unit: UnitName, requested: int) -> int:
        """Return the index into CORNERS at which `unit` runs when its performance profile requests `requested`."""
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
    """Lower the unit that takes most power while the device is over a limit and still getting warmer.

    Raise the most lowered unit again once the device is below the limits by the hysteresis.

    `profile`: hardware profile of the chip.
    `thermal_state`: temperatures now.
    `throttle`: steps of each unit; it is changed in place.
    `requested`: index into CORNERS that the performance profile requests, by unit.
    `power_w`: watts that each unit takes now.
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
    """Grant the units the power that the device can shed, plus a share of the headroom.

    Lower the unit that takes most power while all units together take more than the grant. Raise the most lowered one
    again once its additional power fits into the grant.

    `profile`: hardware profile of the chip.
    `thermal_state`: temperatures now.
    `throttle`: steps of each unit; it is changed in place.
    `requested`: index into CORNERS that the performance profile requests, by unit.
    `power_w`: watts that each unit takes now.
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
    """Return additional watts that the unit `name` would take one corner higher, at the same share of busy time.

    `profile`: hardware profile of the chip.
    `throttle`: how far its units are lowered now.
    `requested`: index into CORNERS that the performance profile requests of the unit.
    `power_w`: watts that it takes now.
    """
    unit, index = profile.units[name], throttle.corner_index(name, requested)
    now, then = (unit.power_w(CORNERS[i], 1.0) for i in (index, index - 1))
    return power_w * (then / now - 1) if now else 0.0


Govern = Callable[[Profile, ThermalState, Throttle, Mapping[UnitName, int], Mapping[UnitName, float]], None]
#: Name of a governor, as in the Linux thermal framework -> its function.
GOVERNORS: dict[str, Govern] = {"step_wise": step_wise, "power_allocator": power_allocator}


class Governor:
    """The governor of one run. It learns time and work only from `tick`, so the same ticks give the same events.

    `name`: name in GOVERNORS. `due_ns`: time at which `tick` is to be called next.
    """

    def __init__(self, profile: Profile, performance_profile: str, governor: str | None = None) -> None:
        """Prepare the governor of a chip's `profile`.

        `performance_profile`: name of one of its performance profiles. `governor`: name in GOVERNORS; None for the
        profile's own. Raises BadInputError for an unknown performance profile or governor.
        """
        self.name = governor or profile.thermal.governor
        if self.name not in GOVERNORS:
            raise BadInputError("governor", repr(self.name), " or ".join(GOVERNORS))
        self._profile, self._performance_profile = profile, performance_profile
        corners = corners_of(profile, performance_profile)
        self._requested: dict[UnitName, int] = dict(zip(UNITS, map(CORNERS.index, corners), strict=True))
        self._thermal_state, self._throttle = ThermalState.at_rest(profile), Throttle()
        self._poll_ns = round(profile.thermal.poll_s.or_else(1.0) * NS)
        self._start_ns = self._last_ns = 0
        self._busy_ns: dict[UnitName, int] = dict.fromkeys(UNITS, 0)
        self._duty_sum: dict[UnitName, float] = dict.fromkeys(UNITS, 0.0)
        self._ticks = self._throttled_ticks = 0
        self._first_throttled_s: float | None = None
        self._joules = 0.0
        self._hottest = {
            "device": self._thermal_state.device_c,
            "junction": max(self._thermal_state.junction_c.values()),
        }
        self._duty: dict[UnitName, int] = {}
        self.due_ns = 0

    def begin(self, now_ns: int) -> list[SetDuty]:
        """Return the duties that the performance profile requests. `now_ns`: when the run begins."""
        self._start_ns = self._last_ns = now_ns
        self.due_ns = now_ns + self._poll_ns
        return self._changed()

    def tick(self, now_ns: int, busy_ns: Mapping[str, int]) -> list[SetDuty]:
        """Return the duties that change at `now_ns`. `busy_ns`: time that each unit has worked since the run began."""
        seconds = (now_ns - self._last_ns) / NS
        power = {unit: self._power_w(unit, busy_ns[unit] - self._busy_ns[unit], now_ns) for unit in UNITS}
        self._joules += seconds * (sum(power.values()) + self._profile.thermal.base_power_w.or_else(0.0))
        self._thermal_state.advance(self._profile, power, seconds)
        self._note((now_ns - self._start_ns) / NS)
        GOVERNORS[self.name](self._profile, self._thermal_state, self._throttle, self._requested, power)
        self._busy_ns = {unit: busy_ns[unit] for unit in UNITS}
        self._last_ns, self.due_ns = now_ns, now_ns + self._poll_ns
        return self._changed()

    @property
    def is_prompt(self) -> bool:
        """Whether the performance profile prefers a short wake-up to the power that awake cores take."""
        return self._performance_profile in PROMPT

    @property
    def power_w(self) -> float | None:
        """Mean power of the whole device in watts, modelled from busy time; None before the first tick."""
        seconds = (self._last_ns - self._start_ns) / NS
        return self._joules / seconds if seconds > 0 else None

    @property
    def temperatures_c(self) -> dict[str, float]:
        """Modelled temperatures now: of the device's body (`device`) and of each unit's junction."""
        junctions = {str(unit): celsius for unit, celsius in self._thermal_state.junction_c.items()}
        return {"device": self._thermal_state.device_c, **junctions}

    def report(self) -> dict[str, Any]:
        """Return the keys `caps` and `temperature_c` of report.json."""
        ticks = max(self._ticks, 1)
        caps = {
            "how": HOW,
            "profile": self._profile.name,
            "performance_profile": self._performance_profile,
            "governor": self.name,
            "units": {
                unit: {"corner": self._corner(unit), "duty": self._duty[unit] / FULL_DUTY, "duty_mean": total / ticks}
                for unit, total in self._duty_sum.items()
                if unit in self._duty
            },
            "power_w": self.power_w,
            "throttled_share": self._throttled_ticks / ticks,
            "first_throttled_s": self._first_throttled_s,
        }
        temperature = {
            "kind": "modelled from busy time",
            "device_end": self._thermal_state.device_c,
            "device_max": self._hottest["device"],
            "junction_max": self._hottest["junction"],
        }
        return {"caps": caps, "temperature_c": temperature}

    def _corner(self, unit: UnitName) -> Any:
        return CORNERS[self._throttle.corner_index(unit, self._requested[unit])]

    def _power_w(self, unit: UnitName, busy_ns: int, now_ns: int) -> float:
        """Return the mean power of `unit` since the last tick, in watts. `busy_ns`: time that it worked since then.

        A duty stands for a clock, so the busy share counts only the time in which the duty let the unit work.
        """
        share = busy_ns / max(now_ns - self._last_ns, 1) * FULL_DUTY / self._duty[unit]
        return self._profile.units[unit].power_w(self._corner(unit), min(1.0, share))

    def _note(self, at_s: float) -> None:
        throttled = any(self._throttle.steps.values())
        self._ticks += 1
        self._throttled_ticks += throttled
        if throttled and self._first_throttled_s is None:
            self._first_throttled_s = at_s
        for unit, duty in self._duty.items():
            self._duty_sum[unit] += duty / FULL_DUTY
        self._hottest["device"] = max(self._hottest["device"], self._thermal_state.device_c)
        self._hottest["junction"] = max(self._hottest["junction"], *self._thermal_state.junction_c.values())

    def _changed(self) -> list[SetDuty]:
        """Return events for the units whose duty has changed since it was last set."""
        events = []
        for unit in UNITS:
            clock = self._profile.units[unit].clock(self._corner(unit))
            duty = max(1, min(FULL_DUTY, round(clock * FULL_DUTY)))
            if duty != self._duty.get(unit, FULL_DUTY):
                events.append(SetDuty(unit, duty))
            self._duty[unit] = duty
        return events
