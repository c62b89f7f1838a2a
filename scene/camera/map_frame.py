"""Origin and unit of the map in which a camera was recorded.

Rule: a far origin is moved to the middle of the places. A length of the map is the metres that the scene states
(`metres_per_unit`), else one metre; but where the format has no unit, or its cameras would be faster than anything that
carries one, the map is scaled so that a person would fill the pictures where the cameras look.
"""

from __future__ import annotations

from enum import Enum

import numpy as np

from trilane.arrays import F64
from trilane.scene.schema import CameraSpec

#: An origin from which the middle of all places is farther than this is moved there; beyond it, float32 no longer
#: resolves tenths of a millimetre.
MAP_M = 1e3
#: Above this median speed the unit of a map is no metre.
FASTEST_M_S = 40.0
#: How high a person is, and which part of the picture's height one fills where the cameras look.
PERSON_M, SHARE = 1.7, 0.75
#: Lines of sight that are less apart than this (least eigenvalue of their mean projection) meet nowhere.
LEAST_SPREAD = 0.02
#: How far a camera goes from end to end that looks at nothing in particular.
PATH_M = 2.0


class Unit(Enum):
    """Of a format's lengths: metres by its definition, usually metres, or none."""

    METRES = "metres"
    USUALLY_M = "usually metres"
    NONE = "none"


def near_origin(places: F64) -> tuple[F64, tuple[str, ...]]:
    """`places` (N, 3) without the offset of a map, such as that of UTM coordinates, and a note on it."""
    finite = np.isfinite(places).all(axis=1)
    middle = np.median(places[finite], axis=0) if finite.any() else np.zeros(3)
    if np.abs(middle).max() <= MAP_M:
        return places, ()
    offset = np.round(middle)
    text = ", ".join(f"{value:.0f}" for value in offset)
    return places - offset, (f"origin of the map moved: ({text}) subtracted from all places",)


def metres_per_unit(
    turns: F64, places: F64, times_s: F64, fov_y_deg: float, unit: Unit, spec: CameraSpec
) -> tuple[float, tuple[str, ...]]:
    """What a length of 1 of the map is in metres, and notes on it.

    `turns` (N, 3, 3) and `places` (N, 3): camera to world, OpenGL axes. `times_s` (N,). `fov_y_deg`: of the picture's
    height. `unit`: of the format. `spec`: of the scene.
    """
    if spec.metres_per_unit is not None:
        return spec.metres_per_unit, (f"1 unit of the file is {spec.metres_per_unit:g} m, as given",)
    speed = _speed(places, times_s)
    if unit is Unit.METRES or (unit is Unit.USUALLY_M and speed <= FASTEST_M_S):
        return 1.0, ()
    reason = "the file has no unit" if unit is Unit.NONE else f"at {speed:.0f} m/s its unit can be no metre"
    if spec.place == "none":
        return 1.0, (f"{reason}: 1 unit is taken for 1 m, as camera.place is none; camera.metres_per_unit decides",)
    scale, how = _fitting(turns, places, fov_y_deg)
    return scale, (f"{reason}: 1 unit is taken for {scale:.4g} m, so that {how}; camera.metres_per_unit decides",)


def _speed(places: F64, times_s: F64) -> float:
    """The median speed, units a second; 0 of one place."""
    if len(places) < 2:
        return 0.0
    return float(np.median(np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(times_s)))


def _fitting(turns: F64, places: F64, fov_y_deg: float) -> tuple[float, str]:
    """A scale that depends on nothing but the shape of the path and where it looks, and what it does."""
    distance = looked_at_from(turns, places)
    if distance is not None:
        wanted = PERSON_M / SHARE / (2 * np.tan(np.radians(fov_y_deg) / 2))
        return float(wanted / distance), f"a person fills {SHARE:.0%} of the picture's height where the cameras look"
    length = float(np.linalg.norm(places.max(axis=0) - places.min(axis=0)))
    if length == 0.0:
        return 1.0, "nothing changes, as the camera stays where it is"
    return PATH_M / length, f"the path is {PATH_M:g} m from end to end"


def looked_at_from(turns: F64, places: F64) -> float | None:
    """The median distance of the cameras from the point that is nearest to all their lines of sight.

    None where the lines are nearly parallel, or meet behind the cameras. The point solves the normal equations of the
    distances: sum (1 - d d') (x - p) = 0 for places p and unit directions d.
    """
    ahead = -turns[:, :, 2]
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    if np.linalg.eigvalsh(across.mean(axis=0))[0] < LEAST_SPREAD:
        return None
    point = np.linalg.solve(across.sum(axis=0), (across @ places[:, :, None]).sum(axis=0)[:, 0])
    towards = point - places
    distance = float(np.median(np.linalg.norm(towards, axis=1)))
    in_front = float(np.median((towards * ahead).sum(axis=1)))
    return distance if in_front > 0.5 * distance > 0 else None
