"""TUM RGB-D trajectory: `time tx ty tz qx qy qz qw` a line, camera to world, metres, seconds.

Rule: axes are optical (x right, y down, looks along +Z); the quaternion's scalar comes last.
Format: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats.
"""

from __future__ import annotations

from pathlib import Path

from trilane.scene.camera.recorded import OPENGL_FROM_OPTICAL, RawCamera
from trilane.scene.camera.text_table import elapsed, read_table
from trilane.scene.detected import Detected
from trilane.scene.lens import centred
from trilane.scene.rotations import matrix_from_quat, normalised

COLUMNS = 8
EXPECTED = "a TUM trajectory: time, tx ty tz, qx qy qz qw a line"
#: The Kinect's colour camera, as calibrated for the first of these recordings: 49.8 degrees high, 63.5 wide.
KINECT = centred(640, 480, 517.0)


def load_tum(path: Path) -> RawCamera:
    """Read `path`. Raises BadInputError with the line."""
    read = read_table(path, COLUMNS, EXPECTED)
    table = read.numbers
    times, step = elapsed(table[:, 0])
    turns = matrix_from_quat(normalised(table[:, [7, 4, 5, 6]])) @ OPENGL_FROM_OPTICAL
    rate = f", {1 / step:.4g}/s" if step > 0 else ""
    notes = (f"TUM trajectory, {len(table)} poses{rate}, optical axes, camera to world",)
    lens = ((KINECT,), "usual for a Kinect")
    detected = Detected("TUM trajectory", f"{COLUMNS} columns of numbers", unit="m", rate="by the times of the file")
    return RawCamera(times, turns, table[:, 1:4], "z", *lens, notes, read.place_of, detected)
