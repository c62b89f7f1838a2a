"""Temperatures of a device, the rules that throttle its units, and the application over minutes under these rules.

The device's body warms in minutes, and each unit's junction warms above the body in seconds. Each is an RC element,
T' = (T_below + R P - T) / tau, and is solved exactly over a step of constant power. Source: lumped models of phones by
Bhat, Gumussoy and Ogras, 2019. The rules are `step_wise` and `power_allocator` of the Linux thermal framework
(Documentation/driver-api/thermal). Each rule is a function of temperatures and power that moves at most one unit by one
corner per call. In a run on this machine a corner becomes a duty: its clock divided by the highest clock.

Between two polls of the governor the application stays in the settled state of its corners; nothing else changes the
power. Reports and pictures only summarise the moments. Matplotlib is an optional dependency; an error names it if it is
missing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from math import exp
from pathlib import Path
from typing import Any, Protocol

from trilane.errors import BadInputError, MissingPartError
from trilane.hw_profiles.application import Plan, steady
from trilane.hw_profiles.prediction import Throttling
from trilane.hw_profiles.schema import CORNERS, Corners, Profile, corners_of
from trilane.pipeline.run_metrics import Temperature
from trilane.scheduler.events import SetDuty
from trilane.scheduler.state import FULL_DUTY
from trilane.units import MAX_MINUTES, PERFORMANCE_PROFILES, UNITS, UnitName
from trilane.writing import write_atomically

#: Performance profiles that request a short wake-up of a sleeping unit, so that idle cores are kept awake.
PROMPT = PERFORMANCE_PROFILES[:3]
HOW = "duty cycles; cores and threads of each unit stand with it"  # `caps.how` of report.json
NS = 1_000_000_000


@dataclass
class ThermalState:
    """The modelled temperatures of a device, in degrees Celsius.

    `device_c`: temperature of the device's body.
    `junction_c`: temperature of each unit's junction.
    `rising`: whether the headroom (`headroom_k`) shrank over the last step.
    """

    device_c: float
    junction_c: dict[UnitName, float]
    rising: bool = False

    @classmethod
    def at_rest(cls, profile: Profile) -> ThermalState:
        """Return the state of a device that was off for a long time: all temperatures are ambient."""
        ambient = profile.thermal.ambient
        return cls(ambient, dict.fromkeys(UNITS, ambient))

    def advance(self, profile: Profile, power_w: Mapping[UnitName, float], seconds: float) -> None:
        """Let `seconds` pass at constant power.

        `power_w`: power of each unit in watts; the profile's base power is added for the rest of the device.
        """
        thermal, before = profile.thermal, headroom_k(profile, self)
        device_w = sum(power_w.values()) + thermal.base_power_w.or_else(0.0)
        goal = thermal.ambient + thermal.resistance * device_w
        self.device_c = _approach(self.device_c, goal, seconds, thermal.device_time_s.or_else(600.0))
        for name, unit in profile.units.items():
            goal = self.device_c + unit.junction_k_per_w.or_else(1.0) * power_w[name]
            self.junction_c[name] = _approach(self.junction_c[name], goal, seconds, unit.junction_time_s.or_else(10.0))
        self.rising = headroom_k(profile, self) < before


def _approach(value: float, goal: float, seconds: float, time_constant: float) -> float:
    # The exact solution while the power, and with it `goal`, stays the same.
    return goal + (value - goal) * exp(-seconds / time_constant)


def headroom_k(profile: Profile, thermal_state: ThermalState) -> float:
    """Return how many kelvins are left to the nearer of two limits, skin and junction; negative above the limit."""
    thermal = profile.thermal
    skin = thermal.skin_limit - thermal_state.device_c
    return min(skin, thermal.junction_limit_c.or_else(95.0) - max(thermal_state.junction_c.values()))


@dataclass
class Throttle:
    """The throttling of the units. `steps`: by how many corners each unit is below its requested corner."""

    steps: dict[UnitName, int] = field(default_factory=lambda: dict.fromkeys(UNITS, 0))

    def corner_index(self, unit: UnitName, requested: int) -> int:
        """Return the index into CORNERS at which `unit` runs. `requested`: index of its requested corner."""
        return min(requested + self.steps[unit], len(CORNERS) - 1)

    def lower(self, requested: Mapping[UnitName, int], power_w: Mapping[UnitName, float]) -> None:
        """Of the units that are above the last corner, move the one with the most power one corner down.

        `requested`: index into CORNERS of the requested corner, by unit. `power_w`: present power by unit, watts.
        """
        lowerable = [unit for unit in UNITS if self.corner_index(unit, requested[unit]) < len(CORNERS) - 1]
        if lowerable:
            self.steps[max(lowerable, key=lambda unit: power_w[unit])] += 1

    def raise_(self, unit: UnitName) -> None:
        """Move `unit` one corner up, but not above the requested corner."""
        self.steps[unit] = max(self.steps[unit] - 1, 0)


def step_wise(
    profile: Profile,
    thermal_state: ThermalState,
    throttle: Throttle,
    requested: Mapping[UnitName, int],
    power_w: Mapping[UnitName, float],
) -> None:
    """Move one unit a corner down if the device is too warm, or a corner up if the device is cool enough.

    If a temperature is above its limit and the device gets warmer, the unit with the most power moves down. Units at
    the last corner do not count. If all temperatures are below their limits by more than `hysteresis_k` of the profile,
    the most lowered unit moves up. Otherwise nothing changes.

    `profile`: hardware profile of the chip.
    `thermal_state`: present temperatures.
    `throttle`: steps of each unit; it is changed in place.
    `requested`: index into CORNERS of the requested corner, by unit.
    `power_w`: present power of each unit in watts.
    """
    headroom = headroom_k(profile, thermal_state)
    if headroom < 0 and thermal_state.rising:
        throttle.lower(requested, power_w)
    elif headroom > profile.thermal.hysteresis_k.or_else(2.0):
        throttle.raise_(max(UNITS, key=lambda u: throttle.steps[u]))


def power_allocator(
    profile: Profile,
    thermal_state: ThermalState,
    throttle: Throttle,
    requested: Mapping[UnitName, int],
    power_w: Mapping[UnitName, float],
) -> None:
    """Lower a unit if all units together take more power than is granted, or raise a unit if they take less.

    The granted power is the power that the device can shed, plus a share of the headroom. The unit with the most power
    is lowered. The most lowered unit is raised if its additional power fits into the grant.

    Parameters: as for `step_wise`.
    """
    thermal = profile.thermal
    shed = (thermal.skin_limit - thermal.ambient) / thermal.resistance
    granted = shed - thermal.base_power_w.or_else(0.0) + headroom_k(profile, thermal_state) / thermal.resistance
    wanted = sum(power_w.values())
    if wanted > granted:
        throttle.lower(requested, power_w)
        return
    lowest = max(UNITS, key=lambda u: throttle.steps[u])
    if throttle.steps[lowest]:
        unit, index = profile.units[lowest], throttle.corner_index(lowest, requested[lowest])
        now, then = (unit.power_w(CORNERS[i], 1.0) for i in (index, index - 1))
        more = power_w[lowest] * (then / now - 1) if now else 0.0  # at the same share of busy time
        if wanted + more <= granted:
            throttle.raise_(lowest)


Govern = Callable[[Profile, ThermalState, Throttle, Mapping[UnitName, int], Mapping[UnitName, float]], None]
#: The function of each governor, by its name in the Linux thermal framework.
GOVERNORS: dict[str, Govern] = {"step_wise": step_wise, "power_allocator": power_allocator}


class Governor:
    """The governor of one run. It gets time and work only from `tick`, so equal ticks give equal events.

    `name`: name in GOVERNORS.
    `due_ns`: time at which the caller calls `tick` next.
    """

    def __init__(self, profile: Profile, performance_profile: str, governor: str | None = None) -> None:
        """Prepare the governor of a run with the hardware profile `profile`.

        `performance_profile`: name of one of its performance profiles.
        `governor`: name in GOVERNORS; None for the profile's governor.

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
        # (device, junction)
        self._hottest_c = self._thermal_state.device_c, max(self._thermal_state.junction_c.values())
        self._duty: dict[UnitName, int] = {}
        self.due_ns = 0

    def begin(self, now_ns: int) -> list[SetDuty]:
        """Return the duties that the performance profile requests, except full ones. `now_ns`: time of the start."""
        self._start_ns = self._last_ns = now_ns
        self.due_ns = now_ns + self._poll_ns
        return self._changed()

    def tick(self, now_ns: int, busy_ns: Mapping[str, int]) -> list[SetDuty]:
        """Return the duties that change at `now_ns`. `busy_ns`: busy time of each unit since the run began."""
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
        """Whether the performance profile requests a short wake-up, at the price of the power of awake cores."""
        return self._performance_profile in PROMPT

    @property
    def power_w(self) -> float | None:
        """The mean power of the whole device in watts, modelled from busy time; None before the first tick."""
        seconds = (self._last_ns - self._start_ns) / NS
        return self._joules / seconds if seconds > 0 else None

    @property
    def temperatures_c(self) -> dict[str, float]:
        """The present modelled temperatures of the device's body (`device`) and of each unit's junction."""
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
            "device_max": self._hottest_c[0],
            "junction_max": self._hottest_c[1],
        }
        return {"caps": caps, "temperature_c": temperature}

    def _corner(self, unit: UnitName) -> Any:
        return CORNERS[self._throttle.corner_index(unit, self._requested[unit])]

    def _power_w(self, unit: UnitName, busy_ns: int, now_ns: int) -> float:
        """Return the mean power of `unit` since the last tick, in watts. `busy_ns`: its busy time since then.

        A duty stands for a lower clock. Therefore the busy share is a share of the time in which the duty let the unit
        work.
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
        device_c, junction_c = self._hottest_c
        now = self._thermal_state
        self._hottest_c = max(device_c, now.device_c), max(junction_c, *now.junction_c.values())

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


MOST_SHOWN = 360  # moments in a report


@dataclass(frozen=True)
class Moment:
    """The state at one poll of the governor.

    `t_s`: time since the start in seconds.
    `frame_ms`: mean frame time at these corners.
    `device_c`, `junction_c`: temperatures of the device's body and of the hottest junction, in degrees Celsius.
    `power_w`: power of the whole device in watts.
    `throttled`: whether a unit is below its requested corner.
    `corners`: corner of each unit.
    """

    t_s: float
    frame_ms: float
    device_c: float
    junction_c: float
    power_w: float
    throttled: bool
    corners: Corners


class Settled(Protocol):
    """The settled state of a load at constant corners.

    `frame_ms`: mean frame time.
    `busy`: share of the time in which each unit works.
    """

    @property
    def frame_ms(self) -> float: ...

    @property
    def busy(self) -> Mapping[str, float]: ...


def over_time(
    profile: Profile, plan: Plan, performance_profile: str, minutes: float, governor: str | None = None
) -> list[Moment]:
    """Return a `Moment` for each poll of the governor, while an application runs on a chip that is cold at the start.

    `profile`: hardware profile of the chip.
    `plan`: application that runs on it.
    `performance_profile`: one of PERFORMANCE_PROFILES.
    `minutes`: virtual time, above 0 to MAX_MINUTES.
    `governor`: name in GOVERNORS; None for the profile's governor.

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
    """Return a `Moment` for each poll of the governor, while a load runs on a chip that is cold at the start.

    The load may be anything; `over_time` does the same for an application.

    `at`: function that returns the load's settled state at given corners. It is called once for each combination of
    corners that occurs.

    The other parameters and the errors are the same as in `over_time`.
    """
    name = governor or profile.thermal.governor
    if name not in GOVERNORS:
        raise BadInputError("governor", repr(name), " or ".join(GOVERNORS))
    if not 0 < minutes <= MAX_MINUTES:
        raise BadInputError("minutes", f"{minutes:g}", f"above 0, at most {MAX_MINUTES}")
    requested = dict(zip(UNITS, map(CORNERS.index, corners_of(profile, performance_profile)), strict=True))
    thermal_state, throttle, moments = ThermalState.at_rest(profile), Throttle(), []
    poll_s, steady_at = profile.thermal.poll_s.or_else(1.0), cache(at)
    for tick in range(max(1, round(60 * minutes / poll_s))):
        cpu, gpu, dsp = (CORNERS[throttle.corner_index(unit, requested[unit])] for unit in UNITS)
        corners = (cpu, gpu, dsp)
        now = steady_at(corners)
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
    """Return the mean power of each unit in watts, in the settled state `now` at `corners`."""
    return {
        name: profile.units[name].power_w(corner, now.busy[name]) for name, corner in zip(UNITS, corners, strict=True)
    }


def last_fifth(moments: Sequence[Moment]) -> Sequence[Moment]:
    """Return the last fifth of the moments, in which the run has settled; at least one if there is any."""
    return moments[-max(1, len(moments) // 5) :]


def ends_of(moments: Sequence[Moment]) -> dict[str, Any]:
    """Return frames a second: `fps_start` at the first moment, `fps_settled` over the last fifth of the moments."""
    last = last_fifth(moments)
    return {"fps_start": 1e3 / moments[0].frame_ms, "fps_settled": 1e3 / (sum(m.frame_ms for m in last) / len(last))}


def settled_corners(moments: Sequence[Moment]) -> Corners:
    """Return the most frequent combination of corners in the last fifth of the moments."""
    return Counter(moment.corners for moment in last_fifth(moments)).most_common(1)[0][0]


def temperatures_of(moments: Sequence[Moment]) -> Temperature:
    """Return the temperatures of the device's body and of the hottest junction; without moments, no field is set."""
    if not moments:
        return Temperature()
    device_max, junction_max = max(m.device_c for m in moments), max(m.junction_c for m in moments)
    return Temperature(device_end=moments[-1].device_c, device_max=device_max, junction_max=junction_max)


def caps_of(moments: Sequence[Moment]) -> Throttling:
    """Return how long units were throttled."""
    throttled_s = [m.t_s for m in moments if m.throttled]
    share = len(throttled_s) / len(moments) if moments else 0.0
    return Throttling(throttled_share=share, first_throttled_s=throttled_s[0] if throttled_s else None)


def timeline_of(moments: Sequence[Moment]) -> list[dict[str, Any]]:
    """Return every n-th moment as JSON values, with the least n such that at most MOST_SHOWN remain."""
    return [
        {
            "t_s": m.t_s,
            "fps": 1e3 / m.frame_ms,
            "device_c": m.device_c,
            "junction_c": m.junction_c,
            "power_w": m.power_w,
            "corners": dict(zip(UNITS, m.corners, strict=True)),
        }
        for m in moments[:: max(1, -(-len(moments) // MOST_SHOWN))]
    ]


def over_minutes(moments: Sequence[Moment]) -> dict[str, Any]:
    """Return the fields of a prediction that describe its course over minutes."""
    return {"temperature_c": temperatures_of(moments), "caps": caps_of(moments), "timeline": timeline_of(moments)}


SUFFIXES = (".png", ".svg", ".pdf")


def figure_for(path: Path, inches: tuple[float, float]) -> Any:
    """Return an empty `matplotlib.figure.Figure` for a file.

    `path`: path of the file; its ending is one of SUFFIXES.
    `inches`: (width, height) of the figure.

    Raises MissingPartError without Matplotlib, BadInputError for another ending.
    """
    if path.suffix not in SUFFIXES:
        raise BadInputError(path, f"the ending {path.suffix!r}", "one of " + ", ".join(SUFFIXES))
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingPartError("drawing needs Matplotlib", extra="plot") from None
    return Figure(figsize=inches, layout="constrained")


def plot_over_time(runs: Mapping[str, Sequence[Moment]], limit_c: float, title: str, path: Path) -> None:
    """Draw frame rates and temperatures into a file.

    `runs`: moments of each curve, by its label.
    `limit_c`: temperature that is marked, in degrees Celsius.
    `title`: title of the picture.
    `path`: path of the file; its ending is one of SUFFIXES.

    Raises MissingPartError without Matplotlib, BadInputError for another ending or a file that cannot be written.
    """
    figure = figure_for(path, (8, 6))
    rate, temperature = figure.subplots(2, 1, sharex=True)
    for label, moments in runs.items():
        minutes = [m.t_s / 60 for m in moments]
        (line,) = rate.plot(minutes, [1e3 / m.frame_ms for m in moments], label=label)
        colour = line.get_color()
        temperature.plot(minutes, [m.device_c for m in moments], color=colour, label=f"{label}: device")
        junction_c = [m.junction_c for m in moments]
        temperature.plot(minutes, junction_c, color=colour, linestyle=":", label=f"{label}: junction")
    temperature.axhline(limit_c, color="black", linewidth=0.8, linestyle="--", label=f"device limit {limit_c:g} °C")
    rate.set(ylabel="frames per second", title=title)
    rate.set_ylim(0, 1.15 * rate.get_ylim()[1])
    temperature.set(xlabel="minutes (virtual clock)", ylabel="temperature, °C")
    for axes in (rate, temperature):
        axes.grid(alpha=0.3)
        axes.legend(loc="lower right", fontsize="small")
    with write_atomically(path) as draft:
        figure.savefig(draft, dpi=120)
