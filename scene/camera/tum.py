"""TUM RGB-D trajectory: `time tx ty tz qx qy qz qw` a line, camera to world, metres, seconds.

Rule: axes are optical (x right, y down, looks along +Z); the quaternion's scalar comes last, unless the file's own
column names say otherwise. Programs of SLAM write their maps so too, some with times in nanoseconds.
Format: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats.
"""

from __future__ import annotations

from pathlib import Path

from trilane.scene.camera.map_frame import Unit
from trilane.scene.camera.pose_table import USUAL, read_pose_table
from trilane.scene.camera.recorded import OPENGL_FROM_OPTICAL, RawCamera
from trilane.scene.detected import Detected
from trilane.scene.lens import centred

NAMES = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")
COLUMNS = len(NAMES)
EXPECTED = "a TUM trajectory: time, tx ty tz, qx qy qz qw a line"
#: The Kinect's colour camera, as calibrated for the first of these recordings: 49.8 degrees high, 63.5 wide.
KINECT = centred(640, 480, 517.0)


def load_tum(path: Path, rate_hz: float | None = None) -> RawCamera:
    """Read `path`. `rate_hz`: of the scene. Raises BadInputError with the line."""
    poses = read_pose_table(path, rate_hz, NAMES, EXPECTED)
    order = "" if poses.order == USUAL else f", columns {poses.order}"
    time = "" if poses.time == "s" else f", time in {poses.time}"
    notes = (f"TUM trajectory, {len(poses.times_s)} poses{poses.rate}{time}{order}, optical axes, camera to world",)
    lens = ((KINECT,), "usual for a Kinect")
    detected = Detected("TUM trajectory", f"{COLUMNS} columns of numbers", unit="m", rate="by the times of the file")
    turns = poses.turns @ OPENGL_FROM_OPTICAL
    place_of = poses.table.place_of
    return RawCamera(
        poses.times_s,
        turns,
        poses.places,
        "z",
        *lens,
        notes,
        place_of,
        detected,
        unit=Unit.USUALLY_M,
        began_s=poses.began_s,
    )
