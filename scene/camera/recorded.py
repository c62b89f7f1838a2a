"""A recorded camera to a CameraPath: bad poses left out, world Y up, picture the right way up.

Rule: the movement from pose to pose never changes. Two constant turns are applied: one of the world, so that +Y is up,
and one of the picture by a multiple of 90 degrees, as a phone turns its display.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.scene.camera.path import CameraPath, Optics, one_lens
from trilane.scene.detected import NOTHING, Detected
from trilane.scene.lens import Lens
from trilane.scene.motion.usable_samples import PlaceOf, by_number, usable_samples
from trilane.scene.rotations import about, quat_from_matrix, shortest_turn
from trilane.scene.schema import CameraSpec

UP = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
#: The usual up of the format holds when its cosine with the picture's mean up is above this.
LEAST_UP_COSINE = 0.3
#: A matrix is taken for a rotation when |R^T R - 1| is below this.
SKEW = 0.05
#: Optical axes (x right, y down, z ahead) to OpenGL axes.
OPENGL_FROM_OPTICAL: F64 = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class RawCamera:
    """The content of a camera file, before anything is left out or turned.

    `times_s` (N,): seconds. `turns` (N, 3, 3) and `places` (N, 3), metres: camera to world, OpenGL axes. `usual_up`:
    the axis of the world that is usually up in the format. `lenses`: of the picture as the axes of a pose have it,
    one for all poses or one for each; `lens`: where they come from. `notes`: on the file, for people. `place_of`: where
    a sample stands in the file. `detected`: what the file is, but for its axes and lens. `pictures`: names of the
    photos that the poses are of, one for each, or none.
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


def path_from_recording(raw: RawCamera, where: str, spec: CameraSpec) -> CameraPath:
    """The camera path of a file.

    `raw`: its content. `where`: its path, for messages. `spec`: of the scene, with the lens. Raises BadInputError when
    more than half of the poses are unusable.
    """
    usable, repairs = usable_samples(where, raw.times_s, _readable(raw.turns, raw.places), raw.place_of)
    times, turns, places = raw.times_s[usable], raw.turns[usable], raw.places[usable]
    up, quarter, note = _upright(turns, raw.usual_up)
    world = shortest_turn(np.array(up), np.array(UP["y"]))
    quats = quat_from_matrix(world @ turns @ about(2, np.array(quarter * np.pi / 2)))
    optics, seen = _optics(raw, usable, quarter, spec)
    notes = (
        *raw.notes,
        note,
        seen,
        *repairs,
        f"{times[-1] - times[0]:.2f} s, then plays back and forth" if len(times) > 1 else "one pose: held",
    )
    detected = replace(raw.detected, axes=note, lens=seen)
    pictures = tuple(raw.pictures[k] for k in usable) if raw.pictures else ()
    return CameraPath(times - times[0], quats, places @ world.T, optics, notes, detected=detected, pictures=pictures)


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


def _readable(turns: F64, places: F64) -> NDArray[np.bool_]:
    """Whether each pose (N,) is finite, its matrix a rotation and its place not absurdly far off."""
    finite = np.asarray(np.isfinite(turns).all(axis=(1, 2)) & np.isfinite(places).all(axis=1))
    safe = np.where(finite[:, None, None], turns, 0.0)
    with np.errstate(over="ignore", invalid="ignore"):
        skew = np.abs(np.swapaxes(safe, -1, -2) @ safe - np.eye(3)).max(axis=(1, 2))
        rotation = (skew < SKEW) & (np.linalg.det(safe) > 0)
        return np.asarray(finite & rotation & (np.abs(np.where(finite[:, None], places, 0.0)) < 1e5).all(axis=1))


def _upright(turns: F64, usual: str) -> tuple[tuple[float, float, float], int, str]:
    """Up axis of the world, quarter turns of the picture, and a note.

    The picture is turned so that its up is nearest to the usual one. Where the two disagree even then, the picture is
    not turned, and up is the axis nearest to the picture's own up.
    """
    x, y = turns[:, :, 0].mean(axis=0), turns[:, :, 1].mean(axis=0)
    ups = np.array([y, -x, -y, x])
    cosines = ups @ np.array(UP[usual])
    quarter = int(np.argmax(cosines))
    if cosines[quarter] > LEAST_UP_COSINE:
        turned = f", device held so that the picture is turned by {quarter * 90} degrees" if quarter else ""
        return UP[usual], quarter, f"{usual.upper()} up{turned}"
    axis = int(np.argmax(np.abs(y)))
    sign = 1.0 if y[axis] >= 0 else -1.0
    vector = (sign * (axis == 0), sign * (axis == 1), sign * (axis == 2))
    name = f"{'-' if sign < 0 else ''}{'XYZ'[axis]}"
    return vector, 0, f"{name} up, as the camera is held (not {usual.upper()}, usual for the format)"
