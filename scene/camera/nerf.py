"""NeRF `transforms.json`: `frames[].transform_matrix`, 4x4 camera to world, OpenGL axes, usually Z up.

Rule: the lens is that of the frame, else that of the file (`fl_x`, `fl_y`, `cx`, `cy` in pixels of `w` x `h`, or
`camera_angle_x` or `camera_angle_y`); distortion is left out and said. The
format has no times (`untimed.py`). Polycam's and Record3D's exports are such files, as nerfstudio makes them.
Format: https://docs.nerf.studio/quickstart/data_conventions.html.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.scene.camera.distortion import Bent, distortion_note
from trilane.scene.camera.field_of_view import checked
from trilane.scene.camera.json_object import read_object
from trilane.scene.camera.map_frame import Unit
from trilane.scene.camera.recorded import RawCamera
from trilane.scene.camera.untimed import times_without
from trilane.scene.detected import Detected
from trilane.scene.lens import Known, Lens, centred, of_fov_x, of_fov_y

FILE = "transforms.json"
EXPECTED = "a NeRF transforms.json: `frames`, each with a 4x4 `transform_matrix`"
DEFAULT_ANGLE_X = math.radians(50.0)
DEFAULT_ASPECT = 4 / 3
MAX_FRAMES = 100_000
#: Of a matrix whose columns have unit length; that of a rotation is 1. A place far off makes it less: 1e-5 at 100 km.
LEAST_DETERMINANT = 1e-9
LENS_KEYS = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y")
DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "p1", "p2")
FISHEYE = "FISHEYE"  # in the name of a camera model
#: In the names of nerfstudio's models whose pictures no pinhole makes.
NO_LENS = ("EQUIRECTANGULAR", "OMNIDIRECTIONAL", "VR180", "ORTHOPHOTO")
NO_LENS_REMEDY = "cut the pictures into perspective ones first (ns-process-data --camera-type equirectangular)"


def load_nerf(path: Path, rate_hz: float | None = None) -> RawCamera:
    """Read `path`, the file or its folder. `rate_hz`: of the scene. Raises BadInputError naming the key."""
    path = path / FILE if path.is_dir() else path
    content = read_object(path, EXPECTED)
    if not isinstance(content.get("frames"), list):
        raise BadInputError(path, "no list `frames`", EXPECTED)
    frames = content["frames"]
    if not 1 <= len(frames) <= MAX_FRAMES:
        raise BadInputError(f"{path}: frames", f"{len(frames)} frames", f"1 to {MAX_FRAMES}")
    matrices = np.stack([_matrix(path, k, frame) for k, frame in enumerate(frames)])
    turns, places = matrices[:, :3, :3], matrices[:, :3, 3]
    times, how = times_without(turns, rate_hz)
    lenses, source = _lenses(path, content, frames)
    notes = (
        f"NeRF transforms, {len(frames)} views, no times: {how}, camera to world",
        *_distortion(path, content, frames, lenses),
    )
    detected = Detected("NeRF transforms.json", "JSON with `frames`", rate=f"no times in the format: {how}")
    return RawCamera(
        times, turns, places, "z", lenses, source, notes, _place_of, detected, _pictures(frames), unit=Unit.USUALLY_M
    )


def _lenses(path: Path, content: Mapping[str, Any], frames: Sequence[Any]) -> tuple[tuple[Lens, ...], str]:
    """One lens for all views, or one for each where a view has a key of its own; and where they come from."""
    _check_models(path, (content, *frames))
    if not any(key in frame for frame in frames if isinstance(frame, dict) for key in LENS_KEYS):
        lens, source = _lens(path, content, "")
        return (lens,), source
    own = [_lens(path, {**content, **frame}, f"frames[{k}].") for k, frame in enumerate(frames)]
    sources = dict.fromkeys(source for _, source in own)
    return tuple(lens for lens, _ in own), f"{' or '.join(sources)}, frame by frame"


def _check_models(path: Path, tables: Sequence[Mapping[str, Any]]) -> None:
    """Raises BadInputError where a camera of the file makes pictures that no pinhole makes."""
    for keys in tables:
        model = str(keys.get("camera_model", ""))
        if any(word in model.upper() for word in NO_LENS):
            raise BadInputError(f"{path}: camera_model", model[:40], "a pinhole or fisheye camera", NO_LENS_REMEDY)


def _distortion(
    path: Path, content: Mapping[str, Any], frames: Sequence[Any], lenses: Sequence[Lens]
) -> tuple[str, ...]:
    """What is left out of the lens that is distorted the most."""
    bent = []
    for lens, frame in zip(lenses, frames, strict=False):  # one lens may be that of all frames
        keys = {**content, **frame}
        parameters = {key: _real(path, keys, key) for key in DISTORTION_KEYS}
        bent.append(Bent(lens, parameters, FISHEYE in str(keys.get("camera_model", ""))))
    return distortion_note(bent)


def _real(path: Path, content: Mapping[str, Any], key: str) -> float:
    """A finite number of the file, 0 when the key is not there. Raises BadInputError."""
    value = content.get(key, 0.0)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise BadInputError(f"{path}: {key}", repr(value)[:40], "a number")
    return float(value)


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


def _lens(path: Path, content: Mapping[str, Any], of: str) -> tuple[Lens, str]:
    """The lens, and where it comes from. `of`: the beginning of its keys, for messages."""
    lens, source = _measured(path, content, of)
    return checked(f"{path}: {of.rstrip('.')}" if of else path, lens), source


def _measured(path: Path, content: Mapping[str, Any], of: str) -> tuple[Lens, str]:
    numbers = (_number(f"{path}: {of}{key}", content.get(key), key) for key in LENS_KEYS)
    width, height, focal_x, focal_y, cx, cy, angle_x, angle_y = numbers
    usable = {"fl_x": focal_x if width else None, "fl_y": focal_y if height else None}
    known = [key for key, value in usable.items() if value]
    if not known:
        lens, source = _by_angle(width, height, angle_x, angle_y)
        if (focal_x or focal_y) and not (angle_x or angle_y):
            source = "usual, as focal lengths in pixels need `w` and `h`"
        return replace(lens, cx=cx or lens.cx, cy=cy or lens.cy) if width and height else lens, source
    wide, high = width or (height or 0.0) * DEFAULT_ASPECT, height or (width or 0.0) / DEFAULT_ASPECT
    fx, fy = usable["fl_x"] or usable["fl_y"] or 0.0, usable["fl_y"] or usable["fl_x"] or 0.0
    shape = Known.ALL if width and height else Known.WIDTH if width else Known.HEIGHT
    source = f"by {' and '.join(f'`{key}`' for key in known)}"
    return Lens(wide, high, fx, fy, cx or wide / 2, cy or high / 2, shape), source


def _by_angle(
    width: float | None, height: float | None, angle_x: float | None, angle_y: float | None
) -> tuple[Lens, str]:
    """The lens of which at most the angles over a picture's sides are known, and where they come from."""
    angles = {"camera_angle_x": angle_x, "camera_angle_y": angle_y}
    source = f"by {' and '.join(f'`{key}`' for key, value in angles.items() if value)}"
    if not (angle_x or angle_y):
        angle_x, source = DEFAULT_ANGLE_X, "usual, as the file has none"
    if not (width and height):
        if angle_x:
            return of_fov_x(math.degrees(angle_x)), source.removesuffix(" and `camera_angle_y`")
        return of_fov_y(math.degrees(angle_y or 0.0)), source
    focal_x = width / 2 / math.tan(angle_x / 2) if angle_x else None
    focal_y = height / 2 / math.tan(angle_y / 2) if angle_y else None
    lens = centred(width, height, focal_x or focal_y or 0.0)
    return replace(lens, fy=focal_y or lens.fx), source


def _number(where: str, value: Any, key: str) -> float | None:
    """A positive number of the file, or None when the key is not there. Raises BadInputError."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value > 0):
        raise BadInputError(where, repr(value)[:40], "a positive number")
    if key.startswith("camera_angle") and value >= math.pi:
        raise BadInputError(where, f"{value:g}", "an angle in radians below pi")
    return float(value)
