"""Stray Scanner's `odometry.csv`: time, frame, place and quaternion of each frame, in newer ones its lens too.

Rule: axes are optical (x right, y down, looks along +Z) in ARKit's world, which is levelled, Y up, metres. Focal
lengths and principal points are of the sensor's picture in landscape; without columns of their own they are those of
`camera_matrix.csv` beside the file.
Format: https://docs.strayrobots.io/apps/scanner/format.html.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.scene.camera.arkit import PHONE
from trilane.scene.camera.field_of_view import checked
from trilane.scene.camera.pose_table import PoseTable, read_pose_table
from trilane.scene.camera.recorded import OPENGL_FROM_OPTICAL, RawCamera
from trilane.scene.camera.text_table import read_table
from trilane.scene.detected import Detected
from trilane.scene.lens import Lens

FILE, MATRIX = "odometry.csv", "camera_matrix.csv"
NAMES = ("time", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
EXPECTED = "a Stray Scanner odometry.csv: timestamp, frame, x, y, z, qx, qy, qz, qw"
#: Width and height of the video; a principal point this near its middle belongs to it.
VIDEO_PX, NEAR_PX = (1920.0, 1440.0), 100.0


def load_stray(path: Path, rate_hz: float | None = None) -> RawCamera:
    """Read `path`, the file or its folder. `rate_hz`: of the scene. Raises BadInputError with the line."""
    file = path / FILE if path.is_dir() else path
    poses = read_pose_table(file, rate_hz, NAMES, EXPECTED, may_have_more=True)
    lenses, source = _lenses(file, poses)
    notes = (f"Stray Scanner, {len(poses.times_s)} poses{poses.rate}, optical axes, camera to world",)
    detected = Detected("Stray Scanner odometry", "its column names", unit="m", rate="by the times of the file")
    turns, place_of = poses.turns @ OPENGL_FROM_OPTICAL, poses.table.place_of
    return RawCamera(
        poses.times_s, turns, poses.places, "y", lenses, source, notes, place_of, detected, is_levelled=True
    )


def _lenses(file: Path, poses: PoseTable) -> tuple[tuple[Lens, ...], str]:
    """One lens for all poses or one for each, and where they come from."""
    parts = ("fx", "fy", "cx", "cy")
    if all(name in poses.names for name in parts):
        table = np.column_stack([poses.column(name) for name in parts])
        if np.isfinite(table).any():
            places = (f"{file}, {poses.table.place_of(k)}" for k in range(len(table)))
            lenses = tuple(_lens(where, row) for where, row in zip(places, table, strict=True))
            return lenses, "by the file, frame by frame"
    matrix = file.with_name(MATRIX)
    if not matrix.is_file():
        return (PHONE,), f"usual for a phone, as there is no {MATRIX}"
    numbers = read_table(matrix, 3, "the 3 x 3 camera matrix").numbers
    if numbers.shape != (3, 3):
        raise BadInputError(matrix, f"{len(numbers)} rows", "a 3 x 3 camera matrix")
    return (_lens(matrix, numbers[[0, 1, 0, 1], [0, 1, 2, 2]]),), f"by {MATRIX}"


def _lens(where: str | Path, numbers: F64) -> Lens:
    """Of fx, fy, cx and cy, of a video of the usual size where the principal point is in its middle.

    Raises BadInputError about `where`.
    """
    if not (np.isfinite(numbers).all() and (numbers > 0).all()):
        raise BadInputError(where, "a lens whose numbers are not all positive", "fx, fy, cx and cy in pixels")
    fx, fy, cx, cy = (float(value) for value in numbers)
    is_usual = abs(cx - VIDEO_PX[0] / 2) < NEAR_PX and abs(cy - VIDEO_PX[1] / 2) < NEAR_PX
    width, height = VIDEO_PX if is_usual else (2 * cx, 2 * cy)
    return checked(where, Lens(width, height, fx, fy, cx, cy))
