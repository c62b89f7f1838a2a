"""The governor of a run on this machine: how large a share of the time each unit may work.

Rule: it learns the time and the work only from `tick`, and answers with events for the scheduler's core; the same ticks
give the same events.

A performance profile requests a corner of each unit. On a chip that is a clock; here it is a duty cycle, the corner's
clock over the highest one. Temperatures are modelled from the busy time and the profile's thermal resistances, and one
of the GOVERNORS of `throttling.py` takes units to lower corners at the limits and back.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from trilane.errors import BadInputError
from trilane.hw_profiles.performance_profiles import corners_of
from trilane.hw_profiles.schema import CORNERS, Profile
from trilane.hw_profiles.thermal_state import ThermalState
from trilane.hw_profiles.throttling import GOVERNORS, Throttle
from trilane.scheduler.events import SetDuty
from trilane.scheduler.state import FULL_DUTY
from trilane.units import PERFORMANCE_PROFILES, UNITS, UnitName

#: Performance profiles that ask for a short wake-up of a sleeping unit: idle cores are kept awake.
PROMPT = PERFORMANCE_PROFILES[:3]
HOW = "duty cycles; cores and threads of each unit stand with it"  # `caps.how` of report.json
NS = 1_000_000_000


class Governor:
    """The governor of one run. `name`: of GOVERNORS. `due_ns`: when `tick` is to be called next."""

    def __init__(self, profile: Profile, performance_profile: str, governor: str | None = None) -> None:
        """For a chip's `profile` and the name of one of its performance profiles; `governor` None: the profile's own.

        Raises BadInputError for an unknown performance profile or governor.
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
        """The duties that the performance profile requests. `now_ns`: when the run begins."""
        self._start_ns = self._last_ns = now_ns
        self.due_ns = now_ns + self._poll_ns
        return self._changed()

    def tick(self, now_ns: int, busy_ns: Mapping[str, int]) -> list[SetDuty]:
        """The duties that change at `now_ns`; `busy_ns`: how long each unit has worked since the run began."""
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
        """Modelled, now: of the device's body (`device`) and of each unit's junction."""
        junctions = {str(unit): celsius for unit, celsius in self._thermal_state.junction_c.items()}
        return {"device": self._thermal_state.device_c, **junctions}

    def report(self) -> dict[str, Any]:
        """The keys `caps` and `temperature_c` of report.json."""
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
        """Mean power of `unit` since the last tick, in watts, from the `busy_ns` that it worked in that time.

        A duty stands for a clock, so the busy share is that of the time in which the duty let the unit work.
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
        """Events for the units whose duty is no longer the one that was set last."""
        events = []
        for unit in UNITS:
            clock = self._profile.units[unit].clock(self._corner(unit))
            duty = max(1, min(FULL_DUTY, round(clock * FULL_DUTY)))
            if duty != self._duty.get(unit, FULL_DUTY):
                events.append(SetDuty(unit, duty))
            self._duty[unit] = duty
        return events
