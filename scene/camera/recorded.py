"""A recorded camera to a CameraPath: bad poses left out, world Y up, picture the right way up.

Rule: the movement from pose to pose never changes. Two constant turns are applied: one of the world, so that +Y is up,
and one of the picture by a multiple of 90 degrees, as a phone turns its display.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.scene.camera.map_frame import Unit, metres_per_unit, near_origin
from trilane.scene.camera.path import CameraPath, Optics, one_lens
from trilane.scene.camera.upright import UP
from trilane.scene.camera.upright import upright as find_upright
from trilane.scene.detected import NOTHING, Detected
from trilane.scene.lens import Lens
from trilane.scene.motion.usable_samples import PlaceOf, by_number, usable_samples
from trilane.scene.rotations import about, quat_from_matrix, shortest_turn
from trilane.scene.schema import CameraSpec

#: A matrix is taken for a rotation when |R^T R - 1| is below this.
SKEW = 0.05
#: Places are left out that are farther than this from the others.
FARTHEST_M = 1e5
NOT_FINITE, FAR_OFF = "not finite", f"farther than {FARTHEST_M / 1000:.0f} km from the others"
#: Optical axes (x right, y down, z ahead) to OpenGL axes.
OPENGL_FROM_OPTICAL: F64 = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class RawCamera:
    """The content of a camera file, before anything is left out or turned.

    `times_s` (N,): seconds. `turns` (N, 3, 3) and `places` (N, 3), metres: camera to world, OpenGL axes. `usual_up`:
    the axis of the world that is usually up in the format. `lenses`: of the picture as the axes of a pose have it,
    one for all poses or one for each; `lens`: where they come from. `notes`: on the file, for people. `place_of`: where
    a sample stands in the file. `detected`: what the file is, but for its axes and lens. `pictures`: names of the
    photos that the poses are of, one for each, or none. `is_levelled`: whether the world of the format is aligned with
    gravity, by its definition. `unit`: of the lengths. `began_s`: at a time of 0, seconds since 1970; None where the
    file does not say it.
    """

    times_s: F64
    turns: F64
    places: F64
    usual_up: str
    lenses: tuple[Lens, ...]
    lens: str
    notes: tuple[str, ...]
    place_of: PlaceOf = by_number
    detected: Detected = NOTHING
    pictures: tuple[str, ...] = ()
    is_levelled: bool = False
    unit: Unit = Unit.METRES
    began_s: float | None = None


def path_from_recording(raw: RawCamera, where: str, spec: CameraSpec) -> CameraPath:
    """The camera path of a file.

    `raw`: its content. `where`: its path, for messages. `spec`: of the scene, with the lens. Raises BadInputError when
    more than half of the poses are unusable.
    """
    near, offset_notes = near_origin(raw.places)
    faults = _faults(raw.times_s, raw.turns, near)
    readable = ~np.logical_or.reduce(list(faults.values()))
    broken = " or ".join(fault for fault, of in faults.items() if of.any())
    usable, repairs = usable_samples(where, raw.times_s, readable, raw.place_of, broken or NOT_FINITE)
    times, turns, places = raw.times_s[usable], raw.turns[usable], near[usable]
    upright = find_upright(turns, raw.usual_up, raw.is_levelled, spec.up_axis)
    world = shortest_turn(upright.up, np.array(UP["y"]))
    quats = quat_from_matrix(world @ turns @ about(2, np.array(upright.quarter * np.pi / 2)))
    optics, seen = _optics(raw, usable, upright.quarter, spec)
    fov_y_deg = float(np.median([lens.fov_y_deg for lens in optics.lenses]))
    scale, scale_notes = metres_per_unit(turns, places, times, fov_y_deg, raw.unit, spec)
    notes = (
        *raw.notes,
        *offset_notes,
        upright.note,
        *scale_notes,
        seen,
        *repairs,
    )
    unit = " ".join(scale_notes) or raw.detected.unit
    detected = replace(raw.detected, axes=upright.note, unit=unit, lens=seen)
    pictures = tuple(raw.pictures[k] for k in usable) if raw.pictures else ()
    return CameraPath(
        times - times[0],
        quats,
        scale * places @ world.T,
        optics,
        notes,
        detected=detected,
        pictures=pictures,
        quarter=upright.quarter,
        began_s=None if raw.began_s is None else raw.began_s + float(times[0]),
    )


def _optics(raw: RawCamera, usable: NDArray[np.intp], quarter: int, spec: CameraSpec) -> tuple[Optics, str]:
    """The lenses of the `usable` poses, of a picture turned by `quarter`, and a note."""
    if spec.fov_y_deg is not None:
        optics = one_lens(spec.fov_y_deg, spec.near_m, spec.far_m)
        return optics, f"field of view {spec.fov_y_deg:.4g} degrees high, as given"
    own = raw.lenses if len(raw.lenses) == 1 else tuple(raw.lenses[k] for k in usable)
    lenses = tuple(lens.turned(quarter) for lens in (own[:1] if len(set(own)) == 1 else own))
    angles = sorted({f"{lens.fov_y_deg:.4g}" for lens in lenses}, key=float)
    return Optics(lenses, spec.near_m, spec.far_m), (
        f"field of view {' to '.join(dict.fromkeys((angles[0], angles[-1])))} degrees high, {raw.lens}"
    )


def _faults(times_s: F64, turns: F64, places: F64) -> dict[str, NDArray[np.bool_]]:
    """What can be wrong with a pose, in words, and which poses (N,) have it; a pose has one fault at most."""
    finite = np.isfinite(times_s) & np.isfinite(turns).all(axis=(1, 2)) & np.isfinite(places).all(axis=1)
    safe, near = np.where(finite[:, None, None], turns, 0.0), np.where(finite[:, None], places, 0.0)
    rotation = are_rotations(safe)
    is_far = (np.abs(near) >= FARTHEST_M).any(axis=1)
    return {NOT_FINITE: ~finite, "no rotation": finite & ~rotation, FAR_OFF: finite & rotation & is_far}


def are_rotations(matrices: F64, skew: float = SKEW) -> NDArray[np.bool_]:
    """Which of `matrices` (N, 3, 3) turn and do nothing else, where |R^T R - 1| below `skew` is a rotation."""
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(np.swapaxes(matrices, -1, -2) @ matrices - np.eye(3)).max(axis=(1, 2))
        return np.asarray((off < skew) & (np.linalg.det(matrices) > 0))
