"""NeRF `transforms.json`: `frames[].transform_matrix`, 4x4 camera to world, OpenGL axes, Z up.

Rule: the lens is that of the file (`fl_y` and `h`, `fl_x` and `w`, or `camera_angle_x`). The format has no times: views
less than FILM_STEP_DEG apart are a film at 30 a second, others are stills, one a second.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.files import read_text
from trilane.scene.camera.recorded import RawCamera
from trilane.scene.detected import Detected

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
        content = json.loads(read_text(path, EXPECTED))
    except (ValueError, RecursionError) as error:
        raise BadInputError(path, f"no valid JSON ({error})", EXPECTED) from None
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise BadInputError(path, "no list `frames`", EXPECTED)
    frames = content["frames"]
    if not 1 <= len(frames) <= MAX_FRAMES:
        raise BadInputError(f"{path}: frames", f"{len(frames)} frames", f"1 to {MAX_FRAMES}")
    matrices = np.stack([_matrix(path, k, frame) for k, frame in enumerate(frames)])
    rate, how = _rate(matrices[:, :3, :3])
    tall, wide, lens = _lens(path, content)
    notes = (f"NeRF transforms, {len(frames)} views, no times: {how}, camera to world",)
    detected = Detected("NeRF transforms.json", "JSON with `frames`", rate=f"no times in the format: {how}")
    times, turns, places = np.arange(len(frames)) / rate, matrices[:, :3, :3], matrices[:, :3, 3]
    return RawCamera(times, turns, places, "z", tall, wide, lens, notes, _place_of, detected)


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
    step = float(np.degrees(np.nanmedian(np.arccos(cosine)))) if len(cosine) else 0.0
    if step > FILM_STEP_DEG:
        return 1.0, f"stills {step:.0f} degrees apart, 1 a second"
    return FILM_RATE_HZ, f"{FILM_RATE_HZ:g} a second assumed"


def _lens(path: Path, content: Mapping[str, Any]) -> tuple[float, float, str]:
    """Field of view in degrees of the picture's height and of its width, and where it comes from."""
    width, height = (_number(path, content, key) for key in ("w", "h"))
    aspect = width / height if width and height else DEFAULT_ASPECT
    focal_y, focal_x = (_number(path, content, key) for key in ("fl_y", "fl_x"))
    angle_x, lens = _number(path, content, "camera_angle_x"), "by `camera_angle_x`"
    if focal_y and height:
        tan_y, lens = height / focal_y / 2, "by `fl_y`"
    elif focal_x and width:
        tan_y, lens = width / focal_x / 2 / aspect, "by `fl_x`"
    else:
        lens = lens if angle_x else "usual, as the file has none"
        tan_y = math.tan((angle_x or DEFAULT_ANGLE_X) / 2) / aspect
    angles = [math.degrees(2 * math.atan(tangent)) for tangent in (tan_y, tan_y * aspect)]
    for side, angle in zip(("height", "width"), angles, strict=True):
        if not 1 < angle < 170:
            raise BadInputError(path, f"a field of view of {angle:.4g} degrees over the {side}", "1 to 170")
    return angles[0], angles[1], lens


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
