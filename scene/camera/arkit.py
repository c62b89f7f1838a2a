"""ARKit log: `time r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz` a line, camera to world, metres, Y up.

Rule: axes are those of the sensor in landscape (x right, y up, looks along -Z); whether times are in nanoseconds or
seconds is recognised by the size of their steps.
"""

from __future__ import annotations

import math
from pathlib import Path

from trilane.scene.camera.recorded import RawCamera
from trilane.scene.camera.text_table import in_seconds, read_table
from trilane.scene.detected import Detected
from trilane.scene.lens import Known, centred

COLUMNS = 13
EXPECTED = "an ARKit log: time and the 12 numbers of a 3x4 matrix a line"
#: An iPhone's main camera, 26 mm equivalent, on a 16:9 picture: 36 degrees high, 60 wide.
PHONE = centred(1920, 1080, 540 / math.tan(math.radians(18.0)), Known.LONG)


def load_arkit(path: Path) -> RawCamera:
    """Read `path`. Raises BadInputError with the line."""
    read = read_table(path, COLUMNS, EXPECTED)
    table = read.numbers
    times, step, unit = in_seconds(table[:, 0])
    matrices = table[:, 1:].reshape(-1, 3, 4)
    rate = f", {1 / step:.4g}/s" if step > 0 else ""
    notes = (f"ARKit log, {len(table)} poses{rate}, time in {unit}, camera to world",)
    return RawCamera(
        times,
        matrices[:, :, :3],
        matrices[:, :, 3],
        "y",
        (PHONE,),
        "usual for a phone",
        notes,
        read.place_of,
        Detected("ARKit log", f"{COLUMNS} columns of numbers", unit="m", rate=f"by the times of the file, in {unit}"),
        is_levelled=True,
    )
