"""KITTI odometry poses: the 12 numbers of a 3x4 matrix a line, row by row, camera to the first camera's axes, metres.

Rule: axes are optical (x right, y down, looks along +Z), so up is usually -Y. The format has no times: they come from a
`times.txt` beside it with a line for each pose, else from the scene's `rate_hz`, else KITTI's 10 a second are assumed.
Some programs write the number of the frame, or a time, before each matrix.
Format: https://www.cvlibs.net/datasets/kitti/eval_odometry.php, readme.txt of the development kit.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trilane.arrays import F64
from trilane.scene.camera.pose_table import MATRIX, MatrixTable, read_matrix_table
from trilane.scene.camera.recorded import OPENGL_FROM_OPTICAL, RawCamera
from trilane.scene.camera.text_table import FRAMES, elapsed, read_table
from trilane.scene.detected import Detected
from trilane.scene.lens import of_opencv

EXPECTED = "KITTI poses: the 12 numbers of a 3x4 matrix a line"
RATE_HZ = 10.0
TIMES = "times.txt"
#: The left grey camera of the first sequences, rectified.
GREY = of_opencv(1241.0, 376.0, 718.856, 718.856, 607.1928, 185.2157)


def load_kitti(path: Path, rate_hz: float | None = None) -> RawCamera:
    """Read `path`. `rate_hz`: of the scene. Raises BadInputError with the line."""
    read = read_matrix_table(path, rate_hz, RATE_HZ, EXPECTED)
    times, rate = _times(path, read, rate_hz)
    notes = (f"KITTI poses, {len(times)}, {rate}, optical axes, camera to the first one",)
    detected = Detected("KITTI poses", f"{MATRIX} columns of numbers", unit="m", rate=rate)
    lens = ((GREY,), "usual for KITTI's cameras")
    turns = read.turns @ OPENGL_FROM_OPTICAL
    return RawCamera(times, turns, read.places, "-y", *lens, notes, read.table.place_of, detected)


def _times(path: Path, read: MatrixTable, rate_hz: float | None) -> tuple[F64, str]:
    """Seconds (N,) of the poses, and where they come from."""
    if read.times is not None and read.times.unit != FRAMES:
        return read.times.since_s, f"by the times of the file, in {read.times.unit}"
    frames = np.arange(float(len(read.turns))) if read.times is None else read.table.numbers[:, 0]
    beside = path.with_name(TIMES)
    if rate_hz is None and beside.is_file() and beside != path:
        times = read_table(beside, 1, "the time of a pose a line").numbers[:, 0]
        if len(times) == len(frames):
            return elapsed(times)[0], f"times by {TIMES}"
    rate = rate_hz or RATE_HZ
    how = "as given" if rate_hz else "assumed"
    return elapsed(frames)[0] / rate, f"{rate:g} a second {how}, as the file has no times"
