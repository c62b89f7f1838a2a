"""Whether a rate holds, which rate a limit of power leaves, and the power of a device with its intervals.

All are pure functions of times and of a profile's powers, for the whole device, its base included. Means come from
`Unit.power_w`. An interval follows from the spreads of the profile's numbers and of the busy shares, which are taken as
independent. Powers are positive, so their sums are taken as log-normal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import product
from typing import Any, NamedTuple

from trilane.hw_profiles.schema import CORNERS, NORMAL_80, Corner, Corners, Profile
from trilane.scheduler.events import DropCause
from trilane.units import UNITS, UnitName


class Wanted(NamedTuple):
    """The rate and the limit of power that a user wants to know about."""

    fps: float | None = None
    power_limit_w: float | None = None


NOTHING = Wanted()


class FrameInterval(NamedTuple):
    """Least milliseconds between two frames: expected, and at both ends of the 80 % interval."""

    ms: float
    low_ms: float
    high_ms: float


def holding(fps: float, times: FrameInterval, dropped: int = 0, late: int = 0, frames: int = 0) -> dict[str, Any]:
    """Say whether a rate of `fps` frames a second holds, also in words.

    The reserve is the part of a frame's time that is left.

    `times`: time of a frame that never waits for its turn. `dropped`, `late`: numbers of the run's `frames` that it
    drops, or shows too late, at this rate. Jitter may cause both although a mean frame fits.
    """
    reserve, high, low = (1 - ms * fps / 1e3 for ms in times)
    if low >= 0:
        words = "holds, and would at the slow end of the interval"
    elif reserve >= 0:
        words = "holds, but not at the slow end of the interval"
    elif high >= 0:
        words = "does not hold, but would at the fast end of the interval"
    else:
        words = "does not hold, nor would it at the fast end of the interval"
    return {
        "fps": fps,
        "holds": reserve >= 0,
        "words": words,
        "sentence": _sentence(fps, times, {"dropped": dropped, "late": late}, frames),
        "reserve": reserve,
        "reserve_low": low,
        "reserve_high": high,
    }


def wanted_drops(dropped: Mapping[str, int]) -> int:
    """Return how many frames were dropped although the pipeline wanted them: all but those that `every` leaves out.

    `dropped`: frames by place and cause, as in report.json.
    """
    return sum(count for cause, count in dropped.items() if not cause.endswith(f":{DropCause.EVERY.value}"))


def without_interval(rate: Mapping[str, Any]) -> dict[str, Any]:
    """Return the answer of `holding` where nobody knows the error of the frame's time."""
    ms = (1 - rate["reserve"]) * 1e3 / rate["fps"]
    holds = f"{'yes' if rate['holds'] else 'no'}; {_short(ms)} ms of {_short(1e3 / rate['fps'])} ms (no interval)"
    said = {"words": rate["words"].partition(",")[0], "sentence": f"holds {rate['fps']:g} fps: {holds}"}
    return {**rate, **said, "reserve_low": None, "reserve_high": None}


def _sentence(fps: float, times: FrameInterval, missed: Mapping[str, int], frames: int) -> str:
    """Say whether the rate holds: `holds 30 fps: yes; 12-19 ms of 33 ms (80 %)`."""
    frame_ms = 1e3 / fps
    holds = "yes" if times.high_ms <= frame_ms else "no" if times.low_ms > frame_ms else "perhaps"
    said = " and ".join(f"{count} {what}" for what, count in missed.items() if count)
    left_out = f"; of {frames} frames {said}" if said and holds == "yes" else ""
    if left_out:
        holds = "not for every frame"
    low, high = _short(times.low_ms), _short(times.high_ms)
    span = f"{low} ms" if low == high else f"{low}-{high} ms"
    share = "" if times.low_ms == times.high_ms else " (80 %)"
    return f"holds {fps:g} fps: {holds}; {span} of {_short(frame_ms)} ms{share}{left_out}"


def _short(ms: float) -> str:
    """Return a time with three digits, without an exponent."""
    return f"{ms:.3g}" if ms < 100 else f"{ms:.0f}"


class FrameLoad(NamedTuple):
    """What runs, as functions of the corners of the units.

    `work_ms`: milliseconds that each working unit works for a frame. `frame_ms`: least time between frames; it may take
    a simulation, so it is called only where it decides.
    """

    work_ms: Callable[[Corners], Mapping[UnitName, float]]
    frame_ms: Callable[[Corners], float]


def within_power(profile: Profile, requested: Corners, load: FrameLoad, limit_w: float) -> dict[str, Any]:
    """Return the highest rate at which the device takes at most `limit_w`, and the corners of its units there.

    `limited_by` is `speed` where the requested corners reach that rate, `power` otherwise. `low_fps` and `high_fps` are
    the rates at the two ends of the 80 % interval of the device's power.

    Each unit may be at any corner up to the `requested` one. For given corners the power is linear in the rate: the
    power of idle units, plus the energy of the work for each frame.

    `profile`: hardware profile of the chip.
    `requested`: corner of each unit under the performance profile.
    `load`: what runs, as work and least frame time.
    `limit_w`: limit of the whole device, watts.
    """
    best, fps = _best(profile, requested, load, limit_w)
    work = load.work_ms(best.corners)
    power = device_power(profile, {u: work.get(u, 0.0) * fps / 1e3 for u in UNITS}, best.corners, {})
    # A device that takes more power than expected reaches the limit as if the limit were lower.
    slow, fast = (limit_w * power["w"] / power[end] for end in ("high_w", "low_w"))
    working = load.work_ms(requested)
    return {
        "limit_w": limit_w,
        "fps": fps,
        "low_fps": _best(profile, requested, load, slow)[1],
        "high_fps": _best(profile, requested, load, fast)[1],
        "power_w": best.idle_w + best.joules * fps,
        "idle_w": best.idle_w,
        "corners": {unit: corner for unit, corner in zip(UNITS, best.corners, strict=True) if working.get(unit)},
        "limited_by": "speed" if fps >= (1 - 1e-9) * 1e3 / load.frame_ms(requested) else "power",
    }


def _best(profile: Profile, requested: Corners, load: FrameLoad, limit_w: float) -> tuple[_Choice, float]:
    """Return the choice of corners with the highest rate, and the rate."""
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

    `most_fps`: rate that power and the busiest unit allow. `idle_w`: watts of the device when no unit works. `joules`:
    energy of a frame on top of that.
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
    """Return all corners up to the requested ones; only the requested one for a unit that does nothing."""
    working = load.work_ms(requested)

    def up_to(unit: UnitName, corner: Corner) -> tuple[Corner, ...]:
        return CORNERS[CORNERS.index(corner) :] if working.get(unit) else (corner,)

    cpu, gpu, dsp = (up_to(unit, corner) for unit, corner in zip(UNITS, requested, strict=True))
    return list(product(cpu, gpu, dsp))


def answers(
    profile: Profile, load: FrameLoad, corners: Corners, wanted: Wanted, times: FrameInterval
) -> dict[str, Any]:
    """Return `rate` and `power_limit`, each only where it is wanted.

    `profile`: hardware profile of the chip.
    `load`: what runs, as work and least frame time.
    `corners`: corner of each unit under the performance profile.
    `wanted`: the rate and the limit.
    `times`: times of a frame of `load` at `corners`.
    """
    found: dict[str, Any] = {}
    if wanted.fps is not None:
        found["rate"] = holding(wanted.fps, times)
    if wanted.power_limit_w is not None:
        found["power_limit"] = within_power(profile, corners, load, wanted.power_limit_w)
    return found


class _Watts(NamedTuple):
    """A mean in watts, and the interval that holds it with a probability of 80 %."""

    w: float
    low_w: float
    high_w: float


def device_power(
    profile: Profile, busy: Mapping[str, float], corners: Corners, busy_error: Mapping[UnitName, float]
) -> dict[str, Any]:
    """Return the power of the whole device, of each unit, and of the base, which is no unit (memory, screen, radio).

    `profile`: hardware profile of the chip.
    `busy`: share of the time in which each unit works.
    `corners`: corner of each unit.
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
    """Return the mean and standard deviation of the power of a unit, in watts."""
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


def _watts(mean: float, deviation: float) -> _Watts:
    """Return the interval of a log-normal distribution of this mean and standard deviation."""
    if not mean:
        return _Watts(0.0, 0.0, 0.0)
    variance = math.log1p((deviation / mean) ** 2)
    middle, factor = mean * math.exp(-variance / 2), math.exp(NORMAL_80 * math.sqrt(variance))
    return _Watts(mean, middle / factor, middle * factor)
