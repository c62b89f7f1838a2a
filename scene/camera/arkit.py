"""ARKit log: `time r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz` a line, camera to world, metres, Y up.

Rule: axes are those of the sensor in landscape (x right, y up, looks along -Z); whether times are in nanoseconds or
seconds is recognised by the size of their steps. Where a program numbered the frames, or left the time out, the scene
gives the rate; the default is 30 per second.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from trilane.scene.camera.pose_table import read_matrix_table
from trilane.scene.camera.recorded import RawCamera
from trilane.scene.camera.text_table import times_of
from trilane.scene.camera.untimed import FILM_RATE_HZ
from trilane.scene.detected import Detected
from trilane.scene.lens import Known, centred

COLUMNS = 13
EXPECTED = "an ARKit log: time and the 12 numbers of a 3x4 matrix a line"
#: An iPhone's main camera, 26 mm equivalent, on a 16:9 picture: 36 degrees high, 60 wide.
PHONE = centred(1920, 1080, 540 / math.tan(math.radians(18.0)), Known.LONG)


def load_arkit(path: Path, rate_hz: float | None = None) -> RawCamera:
    """Read `path`. `rate_hz`: of the scene. Raises BadInputError with the line."""
    read = read_matrix_table(path, rate_hz, FILM_RATE_HZ, EXPECTED)
    count = len(read.turns)
    times = read.times or times_of(np.arange(float(count)), rate_hz)
    notes = (f"ARKit log, {count} poses{times.rate}, time in {times.unit}, camera to world",)
    return RawCamera(
        times.since_s,
        read.turns,
        read.places,
        "y",
        (PHONE,),
        "usual for a phone",
        notes,
        read.table.place_of,
        Detected(
            "ARKit log", f"{COLUMNS} columns of numbers", unit="m", rate=f"by the times of the file, in {times.unit}"
        ),
        is_levelled=True,
    )
