"""The built-in cameras, for a person at the origin who faces +Z.

Rule: each is a formula of time, sampled over one cycle that ends where it began.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trilane.scene.camera.path import CameraPath, Lens, axes_towards
from trilane.scene.motion.motion import Wrap
from trilane.scene.rotations import quat_from_matrix
from trilane.scene.schema import CameraSpec

FOV_Y_DEG = 40.0
RATE_HZ = 30


@dataclass(frozen=True)
class Orbit:
    """A swing of `swing_deg` either way round `target` in `period_s`, from `far_m` in to `near_m` and back."""

    what: str
    target: tuple[float, float, float]
    height_m: float
    far_m: float
    near_m: float
    swing_deg: float
    period_s: float


ORBITS = {
    "orbit": Orbit("whole person, going round, coming nearer", (0.0, 0.93, 0.0), 1.35, 3.9, 3.4, 28.0, 20.0),
    "static": Orbit("whole person, standing still", (0.0, 0.93, 0.0), 1.30, 3.8, 3.8, 0.0, 20.0),
    "closeup": Orbit("head and shoulders", (0.0, 1.50, 0.0), 1.58, 1.15, 0.95, 16.0, 12.0),
    "far": Orbit("whole person, far off", (0.0, 1.00, 0.0), 1.60, 10.0, 8.0, 10.0, 20.0),
}


def load_builtin(name: str, spec: CameraSpec) -> CameraPath | None:
    """The camera `name`, or None when there is none of that name."""
    orbit = ORBITS.get(name)
    if orbit is None:
        return None
    count = int(orbit.period_s * RATE_HZ)
    times = np.arange(count + 1) / RATE_HZ
    phase = 2 * np.pi * times / orbit.period_s
    angle = np.radians(orbit.swing_deg) * np.sin(phase - 0.6)
    distance = orbit.far_m + (orbit.near_m - orbit.far_m) * (1 - np.cos(phase)) / 2
    places = np.column_stack([distance * np.sin(angle), np.full(len(times), orbit.height_m), distance * np.cos(angle)])
    fov = FOV_Y_DEG if spec.fov_y_deg is None else spec.fov_y_deg
    notes = (f"built in: {orbit.what}, {orbit.period_s:g} s a cycle, field of view {fov:g} degrees high",)
    quats = quat_from_matrix(axes_towards(places, np.array(orbit.target)))
    return CameraPath(times, quats, places, Lens(fov, spec.near_m, spec.far_m), notes, Wrap.LOOP, recorded=False)
