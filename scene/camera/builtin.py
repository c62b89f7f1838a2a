"""The built-in cameras, for a person at the origin who faces +Z.

Rule: each is a formula of time, sampled over one cycle that ends where it began.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trilane.arrays import F64
from trilane.scene.camera.path import CameraPath, axes_towards, one_lens
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

    def places(self, phase: F64) -> F64:
        """Places (N, 3), metres, at `phase` (N,) of the cycle, radians."""
        angle = np.radians(self.swing_deg) * np.sin(phase - 0.6)
        distance = self.far_m + (self.near_m - self.far_m) * (1 - np.cos(phase)) / 2
        return np.column_stack([distance * np.sin(angle), np.full(len(phase), self.height_m), distance * np.cos(angle)])


@dataclass(frozen=True)
class Descent:
    """From `top_deg` above `target`, on an arc of radius `distance_m` in the plane x = 0, to `low_m` and back."""

    what: str
    target: tuple[float, float, float]
    distance_m: float
    top_deg: float
    low_m: float
    period_s: float

    def places(self, phase: F64) -> F64:
        """As `Orbit.places`: at the top at 0, at `low_m` after half a cycle."""
        top, low = np.radians(self.top_deg), np.arcsin((self.low_m - self.target[1]) / self.distance_m)
        angle = low + (top - low) * (1 + np.cos(phase)) / 2
        arc = np.column_stack([np.zeros(len(phase)), np.sin(angle), np.cos(angle)])
        return np.asarray(np.array(self.target) + self.distance_m * arc)


@dataclass(frozen=True)
class Stand:
    """Stands at `place` and looks at `target`."""

    what: str
    target: tuple[float, float, float]
    place: tuple[float, float, float]
    period_s: float = 1.0

    def places(self, phase: F64) -> F64:
        """As `Orbit.places`."""
        return np.tile(self.place, (len(phase), 1))


ORBITS = {
    "orbit": Orbit("whole person, going round, coming nearer", (0.0, 0.93, 0.0), 1.35, 3.9, 3.4, 28.0, 20.0),
    "static": Orbit("whole person, standing still", (0.0, 0.93, 0.0), 1.30, 3.8, 3.8, 0.0, 20.0),
    "closeup": Orbit("head and shoulders", (0.0, 1.50, 0.0), 1.58, 1.15, 0.95, 16.0, 12.0),
    "far": Orbit("whole person, far off", (0.0, 1.00, 0.0), 1.60, 10.0, 8.0, 10.0, 20.0),
}


#: Name: the camera.
BUILTIN: dict[str, Orbit | Descent | Stand] = {
    **ORBITS,
    "top-to-floor": Descent("whole person, from above down to the floor", (0.0, 0.90, 0.0), 3.9, 80.0, 0.12, 12.0),
    "wayside": Stand("beside the way of one who walks along z", (-0.1, 1.05, -2.5), (0.9, 1.45, 1.9)),
}


def _pace(camera: Orbit | Descent | Stand) -> str:
    return "fixed" if isinstance(camera, Stand) else f"{camera.period_s:g} s a cycle"


def load_builtin(name: str, spec: CameraSpec) -> CameraPath | None:
    """The camera `name`, or None when there is none of that name."""
    camera = BUILTIN.get(name)
    if camera is None:
        return None
    count = int(camera.period_s * RATE_HZ)
    times = np.arange(count + 1) / RATE_HZ
    places = camera.places(2 * np.pi * times / camera.period_s)
    fov = FOV_Y_DEG if spec.fov_y_deg is None else spec.fov_y_deg
    notes = (f"built in: {camera.what}, {_pace(camera)}, field of view {fov:g} degrees high",)
    quats = quat_from_matrix(axes_towards(places, np.array(camera.target)))
    return CameraPath(times, quats, places, one_lens(fov, spec.near_m, spec.far_m), notes, Wrap.LOOP, recorded=False)
