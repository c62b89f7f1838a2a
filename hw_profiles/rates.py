"""Whether a rate holds, and which rate a limit of power leaves.

Rule: pure functions of times and of a profile's powers. All powers are of the whole device, its base included.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import product
from typing import Any, NamedTuple

from trilane.hw_profiles.device_power import device_power
from trilane.hw_profiles.performance_profiles import Corners
from trilane.hw_profiles.schema import CORNERS, Corner, Profile
from trilane.units import UNITS, UnitName


class Wanted(NamedTuple):
    """What people want of a chip. `fps`: frames a second. `power_limit_w`: watts of the whole device."""

    fps: float | None = None
    power_limit_w: float | None = None


NOTHING = Wanted()


class FrameTimes(NamedTuple):
    """Least milliseconds between two frames: expected, and at both ends of the 80 % interval."""

    ms: float
    low_ms: float
    high_ms: float


def holding(fps: float, times: FrameTimes) -> dict[str, Any]:
    """Whether `fps` frames a second hold, in words too, with the reserve: the part of a frame's time that is left.

    `times`: of a frame when none waits for its turn.
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
        "reserve": reserve,
        "reserve_low": low,
        "reserve_high": high,
    }


class Load(NamedTuple):
    """What runs: per frame and at given corners, for how many milliseconds each unit works, and the least frame time.

    `work_ms`: of the units that work. `frame_ms`: may take a simulation, and is asked only where it decides.
    """

    work_ms: Callable[[Corners], Mapping[UnitName, float]]
    frame_ms: Callable[[Corners], float]


def within_power(profile: Profile, requested: Corners, load: Load, limit_w: float) -> dict[str, Any]:
    """The highest rate at which the device takes at most `limit_w`, and the corners of its units there.

    It is limited by `speed` where it is that of the requested corners, by `power` otherwise. `low_fps`, `high_fps`: the
    rates if the device takes as much more or less than expected as the 80 % interval of its power says.

    The units may be at any corner up to the `requested` ones. At one choice of corners the power is linear in the
    rate: what idle units take, and for each frame the energy of the work.

    `profile`: of the chip.
    `requested`: corners of the performance profile.
    `load`: what runs.
    `limit_w`: watts of the whole device.
    """
    best, fps = _best(profile, requested, load, limit_w)
    work = load.work_ms(best.corners)
    power = device_power(profile, {u: work.get(u, 0.0) * fps / 1e3 for u in UNITS}, best.corners, {})
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


def _best(profile: Profile, requested: Corners, load: Load, limit_w: float) -> tuple[_Choice, float]:
    """The choice of corners with the highest rate, and the rate."""
    choices = sorted(
        (_by_power(profile, corners, load, limit_w) for corners in _allowed(requested, load)),
        key=lambda choice: -choice.most_fps,
    )
    best, fps = choices[0], 0.0
    for choice in choices:
        if choice.most_fps <= fps:
            break
        reached = min(choice.most_fps, 1e3 / load.frame_ms(choice.corners))
        if reached > fps:
            best, fps = choice, reached
    return best, fps


class _Choice(NamedTuple):
    """One choice of corners.

    `most_fps`: that power and the busiest unit allow. `idle_w`: of the device when no unit works. `joules`: of a frame,
    beside that.
    """

    most_fps: float
    corners: Corners
    idle_w: float
    joules: float


def _by_power(profile: Profile, corners: Corners, load: Load, limit_w: float) -> _Choice:
    units = {unit: (profile.units[unit], corner) for unit, corner in zip(UNITS, corners, strict=True)}
    idle = {unit: one.power_w(corner, 0.0) for unit, (one, corner) in units.items()}
    idle_w = sum(idle.values()) + profile.thermal.base_power_w.or_else(0.0)
    work = load.work_ms(corners)
    joules = sum((units[unit][0].power_w(units[unit][1], 1.0) - idle[unit]) * ms / 1e3 for unit, ms in work.items())
    by_power = max(0.0, limit_w - idle_w) / max(joules, 1e-12)
    return _Choice(min(by_power, 1e3 / max(work.values())), corners, idle_w, joules)


def _allowed(requested: Corners, load: Load) -> list[Corners]:
    """All corners up to the requested ones; of a unit that does nothing, the requested one."""
    working = load.work_ms(requested)

    def up_to(unit: UnitName, corner: Corner) -> tuple[Corner, ...]:
        return CORNERS[CORNERS.index(corner) :] if working.get(unit) else (corner,)

    cpu, gpu, dsp = (up_to(unit, corner) for unit, corner in zip(UNITS, requested, strict=True))
    return list(product(cpu, gpu, dsp))


def answers(profile: Profile, load: Load, corners: Corners, wanted: Wanted, times: FrameTimes) -> dict[str, Any]:
    """`rate` and `power_limit`, each where it is wanted.

    `profile`: of the chip.
    `load`: what runs.
    `corners`: of the performance profile.
    `wanted`: the rate and the limit.
    `times`: of a frame of `load` at `corners`.
    """
    found: dict[str, Any] = {}
    if wanted.fps is not None:
        found["rate"] = holding(wanted.fps, times)
    if wanted.power_limit_w is not None:
        found["power_limit"] = within_power(profile, corners, load, wanted.power_limit_w)
    return found
