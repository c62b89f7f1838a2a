"""EuRoC MAV poses, `data.csv`: time in nanoseconds, place, quaternion `w, x, y, z`; more columns are left alone.

Rule: the poses of a ground truth are those of the device's body; with `cam0/sensor.yaml` beside it they are brought to
the camera, else the body's axes are taken for the camera's, which is said. Camera axes are optical, the world's Z is
up.
Format: M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.files import read_text
from trilane.scene.camera.distortion import Bent, distortion_note
from trilane.scene.camera.field_of_view import checked
from trilane.scene.camera.pose_table import read_pose_table
from trilane.scene.camera.recorded import OPENGL_FROM_OPTICAL, RawCamera
from trilane.scene.detected import Detected
from trilane.scene.lens import Lens, of_opencv

NAMES = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")
EXPECTED = "EuRoC poses: time in ns, x, y, z, qw, qx, qy, qz a line"
SENSOR = Path("cam0") / "sensor.yaml"
#: The left camera of the data sets.
CAM0 = of_opencv(752.0, 480.0, 458.654, 457.296, 367.215, 248.375)
#: Key of the sensor's file -> how many numbers follow it.
KEYS = {"data": 16, "resolution": 2, "intrinsics": 4, "distortion_coefficients": 4}


def load_euroc(path: Path, rate_hz: float | None = None) -> RawCamera:
    """Read `path`. `rate_hz`: of the scene. Raises BadInputError with the line."""
    poses = read_pose_table(path, rate_hz, NAMES, EXPECTED, may_have_more=True)
    turns, places, lens, source = poses.turns, poses.places, CAM0, "usual for EuRoC's cameras"
    how: tuple[str, ...] = (f"the axes of the poses are taken for the camera's, as there is no {SENSOR}",)
    sensor = path.parent.parent / SENSOR
    if sensor.is_file():
        numbers = _sensor(sensor)
        to_body = numbers["data"].reshape(4, 4)
        turns, places = turns @ to_body[:3, :3], places + turns @ to_body[:3, 3]
        lens, source = checked(sensor, _lens(numbers)), f"by {SENSOR}"
        how = (f"poses of the body, brought to the camera by {SENSOR}", *_distortion(lens, numbers))
    notes = (f"EuRoC poses, {len(poses.times_s)}{poses.rate}, time in {poses.time}, columns {poses.order}", *how)
    detected = Detected("EuRoC poses", "times in ns and commas", unit="m", rate="by the times of the file")
    turns = turns @ OPENGL_FROM_OPTICAL
    return RawCamera(
        poses.times_s, turns, places, "z", (lens,), source, notes, poses.table.place_of, detected, began_s=poses.began_s
    )


def _lens(numbers: Mapping[str, F64]) -> Lens:
    width, height = (float(value) for value in numbers["resolution"])
    fx, fy, cx, cy = (float(value) for value in numbers["intrinsics"])
    return of_opencv(width, height, fx, fy, cx, cy)


def _distortion(lens: Lens, numbers: Mapping[str, F64]) -> tuple[str, ...]:
    keys = ("k1", "k2", "p1", "p2")
    return distortion_note([Bent(lens, dict(zip(keys, map(float, numbers["distortion_coefficients"]), strict=True)))])


def _sensor(path: Path) -> dict[str, F64]:
    """The numbers of a `sensor.yaml` by KEYS; each is a list in brackets. Raises BadInputError."""
    text = "\n".join(line.split("#", 1)[0] for line in read_text(path, "a EuRoC sensor.yaml").splitlines())
    numbers = {}
    for key, count in KEYS.items():
        found = re.search(rf"\b{key}:\s*\[([^\[\]]*)\]", text)
        try:
            values = np.array([float(word) for word in found.group(1).split(",")]) if found else np.zeros(0)
        except ValueError as error:
            raise BadInputError(f"{path}: {key}", str(error), f"{count} numbers") from None
        if len(values) != count or not np.isfinite(values).all():
            raise BadInputError(f"{path}: {key}", f"{len(values)} numbers", f"{count} finite numbers in brackets")
        numbers[key] = values
    if (numbers["resolution"] <= 0).any() or (numbers["intrinsics"] <= 0).any():
        raise BadInputError(path, "a resolution or focal length that is not positive", "positive numbers")
    return numbers
