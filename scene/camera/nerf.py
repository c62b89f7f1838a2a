"""NeRF `transforms.json`: `frames[].transform_matrix`, 4x4 camera to world, OpenGL axes, Z up.

Rule: the lens is that of the file (`fl_x`, `fl_y`, `cx`, `cy` in pixels of `w` x `h`, or `camera_angle_x`). The format
has no times: views less than FILM_STEP_DEG apart are a film at 30 a second, others are stills, one a second.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.files import read_text, whole_number
from trilane.scene.camera.recorded import RawCamera
from trilane.scene.detected import Detected
from trilane.scene.lens import Known, Lens, centred, of_fov_x

EXPECTED = "a NeRF transforms.json: `frames`, each with a 4x4 `transform_matrix`"
FILM_RATE_HZ = 30.0
FILM_STEP_DEG = 6.0
DEFAULT_ANGLE_X = math.radians(50.0)
DEFAULT_ASPECT = 4 / 3
MAX_FRAMES = 100_000
#: Of a matrix whose columns have unit length; that of a rotation is 1. A place far off makes it less: 1e-5 at 100 km.
LEAST_DETERMINANT = 1e-9


def load_nerf(path: Path) -> RawCamera:
    """Read `path`. Raises BadInputError naming the key."""
    try:
        content = json.loads(read_text(path, EXPECTED), parse_int=whole_number)
    except (ValueError, RecursionError) as error:
        raise BadInputError(path, f"no valid JSON ({error})", EXPECTED) from None
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise BadInputError(path, "no list `frames`", EXPECTED)
    frames = content["frames"]
    if not 1 <= len(frames) <= MAX_FRAMES:
        raise BadInputError(f"{path}: frames", f"{len(frames)} frames", f"1 to {MAX_FRAMES}")
    matrices = np.stack([_matrix(path, k, frame) for k, frame in enumerate(frames)])
    rate, how = _rate(matrices[:, :3, :3])
    lens, source = _lens(path, content)
    notes = (f"NeRF transforms, {len(frames)} views, no times: {how}, camera to world",)
    detected = Detected("NeRF transforms.json", "JSON with `frames`", rate=f"no times in the format: {how}")
    times, turns, places = np.arange(len(frames)) / rate, matrices[:, :3, :3], matrices[:, :3, 3]
    return RawCamera(times, turns, places, "z", (lens,), source, notes, _place_of, detected, pictures=_pictures(frames))


def _pictures(frames: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """The photo of each view as the file names it; nothing when a view has none."""
    names = tuple(frame.get("file_path") for frame in frames)
    return tuple(str(name) for name in names) if all(isinstance(name, str) and name for name in names) else ()


def _place_of(index: int) -> str:
    return f"frames[{index}].transform_matrix"


def _matrix(path: Path, index: int, frame: Any) -> NDArray[np.float64]:
    where = f"{path}: {_place_of(index)}"
    value = frame.get("transform_matrix") if isinstance(frame, dict) else None
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise BadInputError(where, "something else than numbers", "a 4x4 matrix") from None
    if matrix.shape not in ((4, 4), (3, 4)):
        raise BadInputError(where, f"shape {matrix.shape}", "a 4x4 matrix")
    if _is_singular(matrix):
        raise BadInputError(
            where, "a matrix without an inverse", "a 4x4 matrix, camera to world", "leave this view out"
        )
    return matrix[:3]


def _is_singular(matrix: NDArray[np.float64]) -> bool:
    """Whether the columns of `matrix` (3 or 4, 4), however long they are, span less than all directions."""
    square = matrix[:, : len(matrix)]
    if not np.isfinite(square).all():
        return False  # a hole in a recording, which is interpolated across
    lengths = np.linalg.norm(square, axis=0)
    return bool(not lengths.all() or abs(np.linalg.det(square / lengths)) < LEAST_DETERMINANT)


def _rate(turns: NDArray[np.float64]) -> tuple[float, str]:
    ahead = turns[:, :, 2]
    cosine = np.clip((ahead[1:] * ahead[:-1]).sum(axis=1), -1, 1)
    finite = cosine[np.isfinite(cosine)]
    step = float(np.degrees(np.median(np.arccos(finite)))) if len(finite) else 0.0
    if step > FILM_STEP_DEG:
        return 1.0, f"stills {step:.0f} degrees apart, 1 a second"
    return FILM_RATE_HZ, f"{FILM_RATE_HZ:g} a second assumed"


def _lens(path: Path, content: Mapping[str, Any]) -> tuple[Lens, str]:
    """The lens, and where it comes from."""
    lens, source = _measured(path, content)
    for side, angle in (("height", lens.fov_y_deg), ("width", lens.fov_x_deg)):
        if not 1 < angle < 170:
            raise BadInputError(path, f"a field of view of {angle:.4g} degrees over the {side}", "1 to 170")
    return lens, source


def _measured(path: Path, content: Mapping[str, Any]) -> tuple[Lens, str]:
    keys = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x")
    width, height, focal_x, focal_y, cx, cy, angle_x = (_number(path, content, key) for key in keys)
    usable = {"fl_x": focal_x if width else None, "fl_y": focal_y if height else None}
    known = [key for key, value in usable.items() if value]
    if not known:
        angle = angle_x or DEFAULT_ANGLE_X
        source = "by `camera_angle_x`" if angle_x else "usual, as the file has none"
        if not (width and height):
            return of_fov_x(math.degrees(angle)), source
        return centred(width, height, width / 2 / math.tan(angle / 2)), source
    wide, high = width or (height or 0.0) * DEFAULT_ASPECT, height or (width or 0.0) / DEFAULT_ASPECT
    fx, fy = usable["fl_x"] or usable["fl_y"] or 0.0, usable["fl_y"] or usable["fl_x"] or 0.0
    shape = Known.ALL if width and height else Known.WIDTH if width else Known.HEIGHT
    source = f"by {' and '.join(f'`{key}`' for key in known)}"
    return Lens(wide, high, fx, fy, cx or wide / 2, cy or high / 2, shape), source


def _number(path: Path, content: Mapping[str, Any], key: str) -> float | None:
    """A positive number of the file, or None when the key is not there. Raises BadInputError."""
    value = content.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value > 0):
        raise BadInputError(f"{path}: {key}", repr(value)[:40], "a positive number")
    if key == "camera_angle_x" and value >= math.pi:
        raise BadInputError(f"{path}: {key}", f"{value:g}", "an angle in radians below pi")
    return float(value)
