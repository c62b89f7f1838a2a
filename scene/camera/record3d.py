"""Record3D's `metadata.json` (`metadata` in an .r3d archive): a pose, a time and a lens of each frame.

Rule: a pose is `qx qy qz qw tx ty tz`, camera to world, OpenGL axes of the picture of `w` x `h`, in ARKit's world,
which is levelled, Y up, metres. The lens is `perFrameIntrinsicCoeffs` (fx, fy, cx, cy), else `K`, column by column.
Times are `frameTimestamps`, else by `fps`.
Format: keys of the exports of https://record3d.app, as nerfstudio's `process_data/record3d_utils.py` takes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.scene.camera.field_of_view import checked
from trilane.scene.camera.json_object import read_object
from trilane.scene.camera.recorded import RawCamera
from trilane.scene.camera.untimed import FILM_RATE_HZ
from trilane.scene.detected import Detected
from trilane.scene.lens import Lens
from trilane.scene.rotations import matrix_from_quat, normalised

FILE = "metadata.json"
EXPECTED = "Record3D's metadata: `poses`, `K`, `w` and `h`"
MAX_FRAMES = 100_000


def load_record3d(path: Path, rate_hz: float | None = None) -> RawCamera:
    """Read `path`, the file or its folder. `rate_hz`: of the scene. Raises BadInputError naming the key."""
    path = path / FILE if path.is_dir() else path
    content = read_object(path, EXPECTED)
    if "poses" not in content:
        raise BadInputError(path, "no `poses`", EXPECTED)
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
    """The table (N, columns) at `key`. Raises BadInputError."""
    try:
        array = np.array(content.get(key), dtype=np.float64)
    except (TypeError, ValueError):
        raise BadInputError(f"{path}: {key}", "something else than numbers", f"rows of {columns} numbers") from None
    if array.ndim != 2 or array.shape[1] != columns:
        raise BadInputError(f"{path}: {key}", f"shape {array.shape}", f"rows of {columns} numbers")
    return array


def _times(path: Path, content: Mapping[str, Any], count: int, rate_hz: float | None) -> tuple[F64, str]:
    """Seconds (N,) of the poses, and where they come from."""
    if rate_hz is None and content.get("frameTimestamps"):
        values = content["frameTimestamps"]
        rows = {"frameTimestamps": [[value] for value in values] if isinstance(values, list) else None}
        times = _array(path, rows, "frameTimestamps", 1)[:, 0]
        if len(times) == count:
            return times - times[np.isfinite(times).argmax()], "by `frameTimestamps`"
    fps = content.get("fps")
    own = float(fps) if isinstance(fps, int | float) and not isinstance(fps, bool) and 0 < fps <= 1000 else None
    rate = rate_hz or own or FILM_RATE_HZ
    how = "as given" if rate_hz else "by `fps`" if own else "assumed"
    return np.arange(count) / rate, f"{rate:g} a second {how}"


def _lenses(path: Path, content: Mapping[str, Any], count: int) -> tuple[tuple[Lens, ...], str]:
    """One lens for all poses or one for each, and where they come from."""
    width, height = (_side(path, content, key) for key in ("w", "h"))
    if content.get("perFrameIntrinsicCoeffs"):
        rows = _array(path, content, "perFrameIntrinsicCoeffs", 4)
        if len(rows) != count:
            where = f"{path}: perFrameIntrinsicCoeffs"
            raise BadInputError(where, f"{len(rows)} rows", f"{count}, one for each of `poses`")
        named = ((f"{path}: perFrameIntrinsicCoeffs[{k}]", row) for k, row in enumerate(rows))
        return tuple(_lens(where, width, height, row) for where, row in named), "by the file, frame by frame"
    matrix = _array(path, {"K": [content.get("K")]}, "K", 9)[0]
    return (_lens(f"{path}: K", width, height, matrix[[0, 4, 6, 7]]),), "by `K`"


def _side(path: Path, content: Mapping[str, Any], key: str) -> float:
    value = content.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 1 <= value <= 1e6:
        raise BadInputError(f"{path}: {key}", repr(value)[:40], "a side of the picture in pixels")
    return float(value)


def _lens(where: str, width: float, height: float, numbers: F64) -> Lens:
    if not (np.isfinite(numbers).all() and (numbers > 0).all()):
        raise BadInputError(where, "a lens whose numbers are not all positive", "fx, fy, cx and cy in pixels")
    fx, fy, cx, cy = (float(value) for value in numbers)
    return checked(where, Lens(width, height, fx, fy, cx, cy))
