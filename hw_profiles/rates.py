"""Computes whether a rate holds, which rate a limit of power allows, and the power of a device with its interval.

All functions are pure; they depend on times and on a profile's powers. Power is the power of the whole device,
including its base power. Means come from `Unit.power_w`. An interval follows from the spreads of the profile's numbers
and of the busy shares, which are assumed to be independent. Powers are positive, so their sum is assumed to be
log-normal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import product
from typing import Any, Literal, NamedTuple

from trilane.hw_profiles.schema import CORNERS, SHARE_TEXT, Corner, Corners, Profile, interval_around
from trilane.pipeline.run_metrics import Record
from trilane.scheduler.events import DropCause
from trilane.units import HOST, UNITS, UnitName


class Wanted(NamedTuple):
    """The rate and the limit of power that a user asks about; None for a question that is not asked.

    `fps`: rate in frames a second.
    `power_limit_w`: limit of the device's power in watts.
    """

    fps: float | None = None
    power_limit_w: float | None = None


NOTHING = Wanted()


class FrameInterval(NamedTuple):
    """The time between two frames in ms: expected, and at both ends of the 80 % interval, which are None if unknown."""

    ms: float
    low_ms: float | None = None
    high_ms: float | None = None


class HeldRate(Record):
    """Whether a rate holds.

    `fps`: rate in frames a second. `holds`: whether the expected time of a frame is short enough.
    `words`, `sentence`: answer in words, and in a sentence with numbers.
    `reserve`: share of the time between two frames that is left over.
    `reserve_low`, `reserve_high`: 80 % interval of `reserve`; null if unknown.
    """

    fps: float
    holds: bool
    words: str
    sentence: str
    reserve: float
    reserve_low: float | None
    reserve_high: float | None

    @property
    def needs(self) -> FrameInterval:
        """The least time between two frames."""
        shares = (self.reserve_high, self.reserve_low)
        low, high = (None if share is None else (1 - share) * 1e3 / self.fps for share in shares)
        return FrameInterval((1 - self.reserve) * 1e3 / self.fps, low, high)


def holding(fps: float, times: FrameInterval, dropped: int = 0, late: int = 0, frames: int = 0) -> HeldRate:
    """Return whether a rate of `fps` frames a second holds.

    Jitter may drop or delay frames although the mean frame time is short enough.

    `times`: least time between two frames.
    `dropped`, `late`: numbers of frames that a run at this rate drops, or presents too late.
    `frames`: number of frames of this run.
    """
    reserve, high, low = (None if ms is None else 1 - ms * fps / 1e3 for ms in times)
    assert reserve is not None
    if low is None or high is None:
        words = "holds" if reserve >= 0 else "does not hold"
    elif low >= 0:
        words = "holds, and would at the slow end of the interval"
    elif reserve >= 0:
        words = "holds, but not at the slow end of the interval"
    elif high >= 0:
        words = "does not hold, but would at the fast end of the interval"
    else:
        words = "does not hold, nor would it at the fast end of the interval"
    sentence = _sentence(fps, times, {"dropped": dropped, "late": late}, frames)
    return HeldRate(
        fps=fps, holds=reserve >= 0, words=words, sentence=sentence, reserve=reserve, reserve_low=low, reserve_high=high
    )


def wanted_drops(dropped: Mapping[str, int]) -> int:
    """Return the number of dropped frames, apart from those that the key `every` of a pipeline file leaves out.

    `dropped`: numbers of dropped frames by edge and cause, as in report.json.
    """
    return sum(count for cause, count in dropped.items() if not cause.endswith(f":{DropCause.EVERY.value}"))


def _sentence(fps: float, times: FrameInterval, missed: Mapping[str, int], frames: int) -> str:
    """Return a sentence that says whether the rate holds, such as `holds 30 fps: yes; 12-19 ms of 33 ms (80 %)`."""
    frame_ms = 1e3 / fps
    if times.low_ms is None or times.high_ms is None:
        holds = "yes" if 1 - times.ms * fps / 1e3 >= 0 else "no"
        return f"holds {fps:g} fps: {holds}; {_short(times.ms)} ms of {_short(frame_ms)} ms (no interval)"
    holds = "yes" if times.high_ms <= frame_ms else "no" if times.low_ms > frame_ms else "perhaps"
    said = " and ".join(f"{count} {what}" for what, count in missed.items() if count)
    left_out = f"; of {frames} frames {said}" if said and holds == "yes" else ""
    if left_out:
        holds = "not for every frame"
    low, high = _short(times.low_ms), _short(times.high_ms)
    span = f"{low} ms" if low == high else f"{low}-{high} ms"
    share = "" if times.low_ms == times.high_ms else f" ({SHARE_TEXT})"
    return f"holds {fps:g} fps: {holds}; {span} of {_short(frame_ms)} ms{share}{left_out}"


def _short(ms: float) -> str:
    """Return `ms` as text: three digits below 100, a whole number from 100 on."""
    return f"{ms:.3g}" if ms < 100 else f"{ms:.0f}"


class FrameLoad(NamedTuple):
    """A load, as functions of the corners of the units.

    `work_ms`: function that returns the busy time of each working unit for a frame, ms.
    `frame_ms`: function that returns the least time between frames, ms. This function may run a simulation, so it is
    called only where its result matters.
    """

    work_ms: Callable[[Corners], Mapping[UnitName, float]]
    frame_ms: Callable[[Corners], float]


class PowerLimit(Record):
    """The highest rate within a limit of the device's power.

    `limit_w`: limit in watts. `fps`: highest rate at which the device takes at most `limit_w`.
    `low_fps`, `high_fps`: rates at the two ends of the 80 % interval of the device's power; null if unknown.
    `power_w`, `idle_w`: power of the device in watts, at this rate, and if no unit works.
    `corners`: corner of each working unit at this rate.
    `limited_by`: `speed` if the requested corners cannot reach a higher rate.
    """

    limit_w: float
    fps: float
    low_fps: float | None
    high_fps: float | None
    power_w: float
    idle_w: float
    corners: dict[UnitName, Corner]
    limited_by: Literal["speed", "power"]


def within_power(profile: Profile, requested: Corners, load: FrameLoad, limit_w: float) -> PowerLimit:
    """Return the highest rate at which the device takes at most `limit_w`.

    Each unit may run at any corner up to the requested one. For given corners the power is linear in the rate: the
    power of idle units, plus the energy of each frame's work.

    `profile`: hardware profile of the chip.
    `requested`: corner of each unit under the performance profile.
    `load`: load that runs.
    `limit_w`: limit of the power of the whole device in watts.
    """
    best, fps = _best(profile, requested, load, limit_w)
    work = load.work_ms(best.corners)
    power = device_power(profile, {u: work.get(u, 0.0) * fps / 1e3 for u in UNITS}, best.corners, {})
    # A device that takes more power than expected reaches the limit as if the limit were lower.
    low_fps, high_fps = (
        None if watts is None else _best(profile, requested, load, limit_w * power.w / watts)[1]
        for watts in (power.high_w, power.low_w)
    )
    working = load.work_ms(requested)
    return PowerLimit(
        limit_w=limit_w,
        fps=fps,
        low_fps=low_fps,
        high_fps=high_fps,
        power_w=best.idle_w + best.joules * fps,
        idle_w=best.idle_w,
        corners={unit: corner for unit, corner in zip(UNITS, best.corners, strict=True) if working.get(unit)},
        limited_by="speed" if fps >= (1 - 1e-9) * 1e3 / load.frame_ms(requested) else "power",
    )


def _best(profile: Profile, requested: Corners, load: FrameLoad, limit_w: float) -> tuple[_Choice, float]:
    """Return (choice of corners with the highest rate, this rate in frames a second)."""
    choices = sorted(
        (_by_power(profile, corners, load, limit_w) for corners in _allowed(requested, load)),
        key=lambda choice: -choice.most_fps,
    )
    best, fps = choices[0], 0.0
    for choice in choices:
        # The choices are sorted, so no later one can be faster.
        if choice.most_fps <= fps:
            break
        reached = min(choice.most_fps, 1e3 / load.frame_ms(choice.corners))
        if reached > fps:
            best, fps = choice, reached
    return best, fps


class _Choice(NamedTuple):
    """One choice of corners.

    `most_fps`: highest rate that the power and the busiest unit allow.
    `idle_w`: power of the device in watts if no unit works.
    `joules`: energy that the work of a frame adds.
    """

    most_fps: float
    corners: Corners
    idle_w: float
    joules: float


def _by_power(profile: Profile, corners: Corners, load: FrameLoad, limit_w: float) -> _Choice:
    units = {unit: (profile.units[unit], corner) for unit, corner in zip(UNITS, corners, strict=True)}
    idle = {unit: one.power_w(corner, 0.0) for unit, (one, corner) in units.items()}
    idle_w = sum(idle.values()) + profile.thermal.base_power_w.or_else(0.0)
    work = load.work_ms(corners)
    joules = sum((units[unit][0].power_w(units[unit][1], 1.0) - idle[unit]) * ms / 1e3 for unit, ms in work.items())
    by_power = max(0.0, limit_w - idle_w) / max(joules, 1e-12)
    return _Choice(min(by_power, 1e3 / max(work.values())), corners, idle_w, joules)


def _allowed(requested: Corners, load: FrameLoad) -> list[Corners]:
    """Return all combinations of corners in which no unit is above its requested corner.

    A unit that has no work in `load` keeps its requested corner.
    """
    working = load.work_ms(requested)

    def up_to(unit: UnitName, corner: Corner) -> tuple[Corner, ...]:
        return CORNERS[CORNERS.index(corner) :] if working.get(unit) else (corner,)

    cpu, gpu, dsp = (up_to(unit, corner) for unit, corner in zip(UNITS, requested, strict=True))
    return list(product(cpu, gpu, dsp))


def answers(
    profile: Profile, load: FrameLoad, corners: Corners, wanted: Wanted, times: FrameInterval
) -> dict[str, Any]:
    """Return the keys `rate` and `power_limit` of a prediction, each only if `wanted` asks for it.

    `profile`: hardware profile of the chip.
    `load`: load that runs.
    `corners`: corner of each unit under the performance profile.
    `wanted`: rate and limit of power.
    `times`: times of a frame of `load` at `corners`.
    """
    found: dict[str, Any] = {}
    if wanted.fps is not None:
        found["rate"] = holding(wanted.fps, times)
    if wanted.power_limit_w is not None:
        found["power_limit"] = within_power(profile, corners, load, wanted.power_limit_w)
    return found


class Watts(Record):
    """A mean power in watts. `low_w`, `high_w`: its 80 % interval; null for this machine, which measures no power."""

    w: float
    low_w: float | None
    high_w: float | None


class BasePower(Watts):
    """The power of memory, screen and radio. `kind`: kind of the profile's number."""

    kind: str


class DevicePower(Watts):
    """The power of the whole device, of its `units`, and of its `base`."""

    units: dict[UnitName, Watts]
    base: BasePower


def device_power(
    profile: Profile, busy: Mapping[str, float], corners: Corners, busy_error: Mapping[UnitName, float]
) -> DevicePower:
    """Return the power of the whole device and of its parts.

    `profile`: hardware profile of the chip.
    `busy`: share of the time in which each unit works.
    `corners`: corner of each unit.
    `busy_error`: relative error of these shares; it counts as 0 for a missing unit, and for a unit that always works.
    """
    base = profile.thermal.base_power_w
    spreads = {
        unit: _unit(profile, unit, corners, busy[unit], busy_error.get(unit, 0.0) * (busy[unit] < 1)) for unit in UNITS
    }
    spreads_of_all = [*spreads.values(), (base.or_else(0.0), base.or_else(0.0) * base.relative_error)]
    whole = sum(mean for mean, _ in spreads_of_all), math.hypot(*(deviation for _, deviation in spreads_of_all))
    known = profile.name != HOST
    return DevicePower(
        **_watts(*whole, known),
        units={unit: Watts(**_watts(*spread, known)) for unit, spread in spreads.items()},
        base=BasePower(**_watts(*spreads_of_all[-1], known), kind=base.kind),
    )


def _unit(profile: Profile, name: UnitName, corners: Corners, busy: float, busy_error: float) -> tuple[float, float]:
    """Return (mean, standard deviation) of the power of the unit `name` in watts.

    `busy`, `busy_error`: share of the time in which the unit works, and relative error of this share.
    """
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


def _watts(mean: float, deviation: float, known: bool) -> dict[str, Any]:
    """Return the fields of `Watts` for a log-normal distribution with this mean and standard deviation.

    `known`: whether the power has an interval.
    """
    variance = math.log1p((deviation / mean) ** 2) if mean else 0.0
    low, high = interval_around(mean * math.exp(-variance / 2), math.sqrt(variance))
    return {"w": mean, "low_w": low if known else None, "high_w": high if known else None}
