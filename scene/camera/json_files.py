"""Readers of camera files in JSON: NeRF's `transforms.json` and Record3D's `metadata.json`.

A pose is camera to world with OpenGL axes (x right, y up, looks along -Z). Errors name the key.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.files import read_text, whole_number
from trilane.scene.camera.recorded import FILM_RATE_HZ, LengthUnit, RawCamera, times_without
from trilane.scene.lens import (
    Bent,
    Known,
    Lens,
    centred,
    checked_lens,
    distortion_note,
    measured_lens,
    of_fov_x,
    of_fov_y,
)
from trilane.scene.recordings import Detected
from trilane.scene.rotations import matrix_from_quat, normalised


def read_object(path: Path, expected: str) -> dict[str, Any]:
    """Return the JSON object in `path`, or {} for another JSON value. Raises BadInputError if it is no JSON.

    `expected`: expected content in words.
    """
    try:
        content = json.loads(read_text(path, expected), parse_int=whole_number)
    except (ValueError, RecursionError) as error:
        raise BadInputError(path, f"no valid JSON ({error})", expected) from None
    return content if isinstance(content, dict) else {}


NERF_FILE = "transforms.json"
NERF = "a NeRF transforms.json: `frames`, each with a 4x4 `transform_matrix`"
DEFAULT_ANGLE_X = math.radians(50.0)
DEFAULT_ASPECT = 4 / 3
MAX_FRAMES = 100_000
#: A matrix with columns of unit length is singular if its determinant is below this. A rotation has 1; a position far
#: away makes the determinant smaller, 1e-5 at 100 km.
LEAST_DETERMINANT = 1e-9
LENS_KEYS = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y")
DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "p1", "p2")
FISHEYE = "FISHEYE"  # part of a camera model's name
#: Parts of the names of nerfstudio's camera models that are no perspective cameras.
NO_LENS = ("EQUIRECTANGULAR", "OMNIDIRECTIONAL", "VR180", "ORTHOPHOTO")
NO_LENS_REMEDY = "cut the pictures into perspective ones first (ns-process-data --camera-type equirectangular)"


def load_nerf(path: Path, rate_hz: float | None = None) -> RawCamera:
    """Read a NeRF `transforms.json`; `path` is the file or its folder. Each frame has a 4x4 `transform_matrix`.

    Usually Z is up. There are no times. A frame may have its own lens; otherwise the lens of the file holds. A lens is
    an angle, or `fl_x`, `fl_y`, `cx`, `cy` in pixels of `w` x `h`. Distortion is left out and noted. nerfstudio makes
    such files from the exports of Polycam and Record3D.
    `rate_hz`: frames a second by the scene; None if the scene does not say. Raises BadInputError that names the key.
    Format: https://docs.nerf.studio/quickstart/data_conventions.html.
    """
    path = path / NERF_FILE if path.is_dir() else path
    content = read_object(path, NERF)
    if not isinstance(content.get("frames"), list):
        raise BadInputError(path, "no list `frames`", NERF)
    frames = content["frames"]
    if not 1 <= len(frames) <= MAX_FRAMES:
        raise BadInputError(f"{path}: frames", f"{len(frames)} frames", f"1 to {MAX_FRAMES}")
    matrices = np.stack([_matrix(path, k, frame) for k, frame in enumerate(frames)])
    turns, places = matrices[:, :3, :3], matrices[:, :3, 3]
    times, how = times_without(turns, rate_hz)
    lenses, source = _nerf_lenses(path, content, frames)
    notes = (
        f"NeRF transforms, {len(frames)} views, no times: {how}, camera to world",
        *_distortion(path, content, frames, lenses),
    )
    detected = Detected("NeRF transforms.json", "JSON with `frames`", rate=f"no times in the format: {how}")
    return RawCamera(
        times,
        turns,
        places,
        "z",
        lenses,
        source,
        notes,
        _place_of,
        detected,
        _pictures(frames),
        unit=LengthUnit.OFTEN_M,
    )


def _nerf_lenses(path: Path, content: Mapping[str, Any], frames: Sequence[Any]) -> tuple[tuple[Lens, ...], str]:
    """Return (one lens for all views, or one for each if any view has its own keys; source of the lenses in words).

    `content`: object of the file. `frames`: views in it. Raises BadInputError if a camera is no perspective camera.
    """
    for keys in (content, *frames):
        model = str(keys.get("camera_model", ""))
        if any(word in model.upper() for word in NO_LENS):
            raise BadInputError(f"{path}: camera_model", model[:40], "a pinhole or fisheye camera", NO_LENS_REMEDY)
    if not any(key in frame for frame in frames if isinstance(frame, dict) for key in LENS_KEYS):
        lens, source = _nerf_lens(path, content, "")
        return (lens,), source
    own = [_nerf_lens(path, {**content, **frame}, f"frames[{k}].") for k, frame in enumerate(frames)]
    sources = dict.fromkeys(source for _, source in own)
    return tuple(lens for lens, _ in own), f"{' or '.join(sources)}, frame by frame"


def _distortion(
    path: Path, content: Mapping[str, Any], frames: Sequence[Any], lenses: Sequence[Lens]
) -> tuple[str, ...]:
    """Return a note on the largest distortion of `lenses`, which is not drawn; () below LEAST_BEND_PX pixels.

    `content`: object of the file, with the distortion of all views. `frames`: views; a view's keys replace
    the file's.
    `lenses`: one lens for all views, which has the first view's distortion, or one for each. Raises BadInputError if a
    parameter of the distortion is no finite number.
    """
    bent = []
    for lens, frame in zip(lenses, frames, strict=False):  # a single lens stands for all frames
        keys = {**content, **frame}
        parameters = {key: _real(path, keys, key) for key in DISTORTION_KEYS}
        bent.append(Bent(lens, parameters, FISHEYE in str(keys.get("camera_model", ""))))
    return distortion_note(bent)


def _real(path: Path, content: Mapping[str, Any], key: str) -> float:
    """Return the number at `key` of `content`, 0 without the key. Raises BadInputError if it is not a finite number."""
    value = content.get(key, 0.0)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise BadInputError(f"{path}: {key}", repr(value)[:40], "a number")
    return float(value)


def _pictures(frames: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Return the name of the photo of each of `frames`, as the file states it; () if any view has no photo."""
    names = tuple(frame.get("file_path") for frame in frames)
    return tuple(str(name) for name in names) if all(isinstance(name, str) and name for name in names) else ()


def _place_of(index: int) -> str:
    return f"frames[{index}].transform_matrix"


def _matrix(path: Path, index: int, frame: Any) -> NDArray[np.float64]:
    where = f"{path}: {_place_of(index)}"
    matrix = _numbers(where, frame.get("transform_matrix") if isinstance(frame, dict) else None, "a 4x4 matrix")
    if matrix.shape not in ((4, 4), (3, 4)):
        raise BadInputError(where, f"shape {matrix.shape}", "a 4x4 matrix")
    if _is_singular(matrix):
        raise BadInputError(
            where, "a matrix without an inverse", "a 4x4 matrix, camera to world", "leave this view out"
        )
    return matrix[:3]


def _numbers(where: str, value: Any, expected: str) -> F64:
    """Return the numbers in `value`, a list of a JSON file; null is NaN. Raises BadInputError for any other content."""
    array = np.array(value, dtype=object)
    if not {type(each) for each in array.flat} <= {int, float, type(None)}:
        raise BadInputError(where, "something else than numbers", expected)
    try:
        return array.astype(np.float64)
    except OverflowError:
        raise BadInputError(where, "a whole number that is too large", expected) from None


def _is_singular(matrix: NDArray[np.float64]) -> bool:
    """Return whether `matrix` (3 or 4, 4) has no inverse, whatever the length of its columns.

    A matrix with NaN or infinity does not count as singular.
    """
    square = matrix[:, : len(matrix)]
    if not np.isfinite(square).all():
        return False  # the pose is a hole in the recording, and sampling interpolates across it
    lengths = np.linalg.norm(square, axis=0)
    return bool(not lengths.all() or abs(np.linalg.det(square / lengths)) < LEAST_DETERMINANT)


def _nerf_lens(path: Path, content: Mapping[str, Any], of: str) -> tuple[Lens, str]:
    """Return (lens of a view or of the file, its source in words).

    `content`: keys of the file, with the view's own keys in place of the file's. `of`: prefix of keys in messages, such
    as `frames[3].`; "" for the file's lens. Raises BadInputError if a number or the lens is not plausible.
    """
    lens, source = _measured(path, content, of)
    return checked_lens(f"{path}: {of.rstrip('.')}" if of else path, lens), source


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
    """Return (lens of a file without focal lengths, source of its angles in words).

    `width`, `height`: pixels. `angle_x`, `angle_y`: radians. Each is None if the file does not state it.
    """
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
    """Return `value`, a positive number or None. Raises BadInputError about `where` for any other value."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value > 0):
        raise BadInputError(where, repr(value)[:40], "a positive number")
    if key.startswith("camera_angle") and value >= math.pi:
        raise BadInputError(where, f"{value:g}", "an angle in radians below pi")
    return float(value)


RECORD3D_FILE = "metadata.json"
#: Range of the rate that a file may state, as of camera.rate_hz.
LEAST_HZ, MOST_HZ = 1e-3, 1000.0
CORRECT_RATE = "correct it, or set camera.rate_hz"
RECORD3D = "Record3D's metadata: `poses`, `K`, `w` and `h`"


def load_record3d(path: Path, rate_hz: float | None = None) -> RawCamera:
    """Read Record3D's `metadata.json`; `path` is the file or its folder. A pose is `qx qy qz qw tx ty tz`.

    The world is ARKit's: levelled, Y up, metres. The lens is `perFrameIntrinsicCoeffs` (fx, fy, cx, cy), or else `K`,
    column by column, in pixels of `w` x `h`. Times are `frameTimestamps`, or else follow from `fps`.
    `rate_hz`: frames a second by the scene; None if the scene does not say. Raises BadInputError that names the key.
    Format: keys of the exports of https://record3d.app, as nerfstudio's `process_data/record3d_utils.py` reads them.
    """
    path = path / RECORD3D_FILE if path.is_dir() else path
    content = read_object(path, RECORD3D)
    if "poses" not in content:
        raise BadInputError(path, "no `poses`", RECORD3D)
    poses = _array(path, content, "poses", 7)
    if not 1 <= len(poses) <= MAX_FRAMES:
        raise BadInputError(f"{path}: poses", f"{len(poses)} poses", f"1 to {MAX_FRAMES}")
    turns = matrix_from_quat(normalised(poses[:, [3, 0, 1, 2]]))
    times, rate = _times(path, content, len(poses), rate_hz)
    lenses, source = _lenses(path, content, len(poses))
    notes = (f"Record3D, {len(poses)} poses, {rate}, camera to world",)
    detected = Detected("Record3D metadata", "JSON with `poses`", unit="m", rate=rate)
    return RawCamera(
        times, turns, poses[:, 4:], "y", lenses, source, notes, lambda k: f"poses[{k}]", detected, is_levelled=True
    )


def _array(path: Path, content: Mapping[str, Any], key: str, columns: int) -> F64:
    """Return the table (N, `columns`) at `key` of `content`. Raises BadInputError when it has another shape."""
    array = _numbers(f"{path}: {key}", content.get(key), f"rows of {columns} numbers")
    if array.ndim != 2 or array.shape[1] != columns:
        raise BadInputError(f"{path}: {key}", f"shape {array.shape}", f"rows of {columns} numbers")
    return array


def _times(path: Path, content: Mapping[str, Any], count: int, rate_hz: float | None) -> tuple[F64, str]:
    """Return (times of the poses (N,), seconds; their source in words). `count`: number N of poses.

    Raises BadInputError if there are not N times, or if `fps` is not a number from LEAST_HZ to MOST_HZ.
    """
    if rate_hz is None and content.get("frameTimestamps"):
        values = content["frameTimestamps"]
        rows = {"frameTimestamps": [[value] for value in values] if isinstance(values, list) else None}
        times = _array(path, rows, "frameTimestamps", 1)[:, 0]
        if len(times) != count:
            expected = f"{count}, one for each of `poses`"
            raise BadInputError(f"{path}: frameTimestamps", f"{len(times)} times", expected, CORRECT_RATE)
        return times - times[np.isfinite(times).argmax()], "by `frameTimestamps`"
    fps = content.get("fps")
    if not (rate_hz or fps is None or (type(fps) in (int, float) and LEAST_HZ <= fps <= MOST_HZ)):
        raise BadInputError(f"{path}: fps", repr(fps)[:40], f"a number from {LEAST_HZ:g} to {MOST_HZ:g}", CORRECT_RATE)
    rate = rate_hz or fps or FILM_RATE_HZ
    how = "as given" if rate_hz else "by `fps`" if fps else "assumed"
    return np.arange(count) / rate, f"{rate:g} a second {how}"


def _lenses(path: Path, content: Mapping[str, Any], count: int) -> tuple[tuple[Lens, ...], str]:
    """Return (one lens for all poses or one for each; their source in words). `count`: number of poses."""
    width, height = (_side(path, content, key) for key in ("w", "h"))
    if content.get("perFrameIntrinsicCoeffs"):
        rows = _array(path, content, "perFrameIntrinsicCoeffs", 4)
        if len(rows) != count:
            where = f"{path}: perFrameIntrinsicCoeffs"
            raise BadInputError(where, f"{len(rows)} rows", f"{count}, one for each of `poses`")
        named = ((f"{path}: perFrameIntrinsicCoeffs[{k}]", row) for k, row in enumerate(rows))
        return tuple(measured_lens(where, width, height, row) for where, row in named), "by the file, frame by frame"
    matrix = _array(path, {"K": [content.get("K")]}, "K", 9)[0]
    return (measured_lens(f"{path}: K", width, height, matrix[[0, 4, 6, 7]]),), "by `K`"


def _side(path: Path, content: Mapping[str, Any], key: str) -> float:
    value = content.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 1 <= value <= 1e6:
        raise BadInputError(f"{path}: {key}", repr(value)[:40], "a side of the picture in pixels")
    return float(value)
