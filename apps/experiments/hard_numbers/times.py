"""A day of media time: frame 5,000,000 shows what the same moment of the motion's period shows.

Rule: the reference reduces the frame's time by the period in fractions, which are exact.

The bound. frame / fps rounds by U of itself, the remainder is exact, so the moment is off by at most U t, and what is
shown by that times the fastest that it moves between two samples, and by a few roundings of what is shown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from fractions import Fraction

import numpy as np

from trilane.apps.experiments.hard_numbers.hard_number import HardNumber, U
from trilane.arrays import F64
from trilane.body.kinematics import rodrigues
from trilane.scene.camera.path import load_builtin
from trilane.scene.motion.builtin import walk_wave_turn
from trilane.scene.motion.motion import Wrap
from trilane.scene.schema import CameraSpec

FRAME = 5_000_000
RATES = (24.0, 30.0, 59.94)
SOURCE = "rounding of the frame's time, times the fastest that is shown"
Shown = Callable[[float], F64]


def time_cases() -> Iterator[HardNumber]:
    """Rows of the built-in walk and camera at each rate."""
    motion, camera = walk_wave_turn(), load_builtin("orbit", CameraSpec())
    assert camera is not None
    shown: dict[str, tuple[Shown, F64, Wrap, str]] = {
        "turns of the walk": (lambda t: rodrigues(motion.sample(t)[0]), motion.times_s, motion.wrap, "entry of R"),
        "place of the walk": (lambda t: motion.sample(t)[1], motion.times_s, motion.wrap, "m"),
        "the orbiting camera": (camera.sample, camera.times_s, camera.wrap, "entry of the view"),
    }
    for name, (at, times_s, wrap, unit) in shown.items():
        speed = _fastest(at, times_s)
        for fps in RATES:
            reached = FRAME / fps
            error = float(np.abs(at(reached) - at(_moment(fps, times_s, wrap))).max())
            bound = 2 * U * reached * speed + 64 * U * (1 + np.pi)
            yield HardNumber(f"{name}, frame {FRAME:,} at {fps:g} a second", error, bound, unit, SOURCE)


def _moment(fps: float, times_s: F64, wrap: Wrap) -> float:
    """The time within one period of frame `FRAME`."""
    length = Fraction(float(times_s[-1])) * (1 if wrap is Wrap.LOOP else 2)
    phase = (Fraction(FRAME) / Fraction(fps)) % length
    return float(phase if wrap is Wrap.LOOP or phase <= length / 2 else length - phase)


def _fastest(at: Shown, times_s: F64) -> float:
    """The greatest change in a second of any number, between neighbouring samples."""
    values = np.array([at(float(t)).ravel() for t in times_s])
    return float(np.abs(np.diff(values, axis=0) / np.diff(times_s)[:, None]).max())
