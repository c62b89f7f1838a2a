"""KITTI odometry poses: the 12 numbers of a 3x4 matrix a line, row by row, camera to the first camera's axes, metres.

Rule: axes are optical (x right, y down, looks along +Z), so up is usually -Y. The file has no times: they come from a
`times.txt` beside it with a line for each pose, else from the scene's `rate_hz`, else KITTI's 10 a second are assumed.
Format: https://www.cvlibs.net/datasets/kitti/eval_odometry.php, readme.txt of the development kit.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trilane.arrays import F64
from trilane.scene.camera.recorded import OPENGL_FROM_OPTICAL, RawCamera
from trilane.scene.camera.text_table import elapsed, read_table
from trilane.scene.detected import Detected
from trilane.scene.lens import of_opencv

COLUMNS = 12
EXPECTED = "KITTI poses: the 12 numbers of a 3x4 matrix a line"
RATE_HZ = 10.0
TIMES = "times.txt"
#: The left grey camera of the first sequences, rectified.
GREY = of_opencv(1241.0, 376.0, 718.856, 718.856, 607.1928, 185.2157)


def load_kitti(path: Path, rate_hz: float | None = None) -> RawCamera:
    """Read `path`. `rate_hz`: of the scene. Raises BadInputError with the line."""
    read = read_table(path, COLUMNS, EXPECTED)
    matrices = read.numbers.reshape(-1, 3, 4)
    times, rate = _times(path, len(matrices), rate_hz)
    turns = matrices[:, :, :3] @ OPENGL_FROM_OPTICAL
    notes = (f"KITTI poses, {len(matrices)}, {rate}, optical axes, camera to the first one",)
    detected = Detected("KITTI poses", f"{COLUMNS} columns of numbers", unit="m", rate=rate)
    lens = ((GREY,), "usual for KITTI's cameras")
    return RawCamera(times, turns, matrices[:, :, 3], "-y", *lens, notes, read.place_of, detected)


def _times(path: Path, count: int, rate_hz: float | None) -> tuple[F64, str]:
    """Seconds (N,) of the poses, and where they come from."""
    beside = path.with_name(TIMES)
    if rate_hz is None and beside.is_file() and beside != path:
        times = read_table(beside, 1, "the time of a pose a line").numbers[:, 0]
        if len(times) == count:
            return elapsed(times)[0], f"times by {TIMES}"
    rate = rate_hz or RATE_HZ
    return np.arange(
        count
    ) / rate, f"{rate:g} a second {'as given' if rate_hz else 'assumed'}, as the file has no times"
