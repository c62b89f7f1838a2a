"""Readers of camera trajectories, text tables with one pose per line, in five formats.

A format states the order of its columns, its axes, and the lens that its devices usually have. `pose_table.py` reads
the lines; a file's own column names override the order of the format. Optical axes are x right, y down, looking along
+Z.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.files import read_text
from trilane.scene.camera.pose_table import (
    FRAMES,
    MATRIX,
    USUAL,
    MatrixTable,
    PoseTable,
    TableClock,
    read_matrix_table,
    read_pose_table,
    read_table,
    times_of,
)
from trilane.scene.camera.recorded import AUTO, LENGTH_UNITS, LengthUnit, RawCamera
from trilane.scene.lens import Bent, Known, Lens, centred, checked_lens, distortion_note, measured_lens, of_opencv
from trilane.scene.recordings import Detected

ANY_CLOCK = TableClock()
ARKIT_COLUMNS = 13
ARKIT = "an ARKit log: time and the 12 numbers of a 3x4 matrix a line"
#: Lens of an iPhone's main camera, 26 mm equivalent, on a 16:9 picture: 36 degrees high, 60 wide.
PHONE = centred(1920, 1080, 540 / math.tan(math.radians(18.0)), Known.LONG)


def load_arkit(path: Path, clock: TableClock = ANY_CLOCK) -> RawCamera:
    """Read an ARKit log: `time r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz` per line, camera to world, metres, Y up.

    The camera's axes belong to the sensor in landscape (x right, y up, looks along -Z). The time may be missing.
    `clock`: what the scene says about the times. Raises BadInputError with the line.
    """
    read = read_matrix_table(path, clock, ARKIT)
    count = len(read.turns)
    times = read.times or times_of(path, np.arange(float(count)), _counted(path, clock))
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
            "ARKit log",
            f"{ARKIT_COLUMNS} columns of numbers",
            unit="m",
            rate=f"by the times of the file, in {times.unit}",
        ),
        is_levelled=True,
        lengths=read.lengths,
    )


KITTI = "KITTI poses: the 12 numbers of a 3x4 matrix a line"
KITTI_HZ = 10.0
KITTI_TIMES = "times.txt"
#: Lens of KITTI's left grey camera in the first sequences, rectified.
GREY = of_opencv(1241.0, 376.0, 718.856, 718.856, 607.1928, 185.2157)


def load_kitti(path: Path, clock: TableClock = ANY_CLOCK) -> RawCamera:
    """Read KITTI odometry poses: a 3x4 matrix per line, row by row, from the camera to the first camera's axes, metres.

    Axes are optical, so -Y is usually up. Some programs write a frame number or a time before each matrix. `clock`:
    what the scene says about the times. Raises BadInputError with the line.
    Format: https://www.cvlibs.net/datasets/kitti/eval_odometry.php, readme.txt of the development kit.
    """
    clock = clock._replace(usual_hz=KITTI_HZ)
    read = read_matrix_table(path, clock, KITTI)
    times, rate = _kitti_times(path, read, clock)
    notes = (f"KITTI poses, {len(times)}, {rate}, optical axes, camera to the first one",)
    detected = Detected("KITTI poses", f"{MATRIX} columns of numbers", unit="m", rate=rate)
    lens = ((GREY,), "usual for KITTI's cameras")
    place_of = read.table.place_of
    return RawCamera(times, read.turns, read.places, "-y", *lens, notes, place_of, detected, lengths=read.lengths)


def _kitti_times(path: Path, read: MatrixTable, clock: TableClock) -> tuple[F64, str]:
    """Return (times of the poses (N,), seconds; their source in words).

    Raises BadInputError when `times.txt` has another number of times than there are poses.
    """
    if read.times is not None and read.times.unit != FRAMES:
        return read.times.since_s, f"by the times of the file, in {read.times.unit}"
    beside = path.with_name(KITTI_TIMES)
    if clock.rate_hz is None and beside.is_file() and beside != path:
        times = read_table(beside, 1, "the time of a pose a line").numbers[:, 0]
        if len(times) != len(read.turns):
            expected = f"{len(read.turns)}, one for each pose of {path.name}"
            raise BadInputError(beside, f"{len(times)} times", expected, "correct it, or set camera.rate_hz")
        return times_of(beside, times, clock).since_s, f"times by {KITTI_TIMES}"
    counted = read.times or times_of(path, np.arange(float(len(read.turns))), _counted(path, clock))
    return counted.since_s, f"{counted.rate.removeprefix(', ')}, as the file has no times"


def _counted(path: Path, clock: TableClock) -> TableClock:
    """Return the clock of poses without times, which counts frames. Raises BadInputError if `clock` has a time unit."""
    if clock.unit not in (AUTO, FRAMES):
        found = f'camera.time_unit = "{clock.unit}" with poses without times'
        raise BadInputError(path, found, "times in the file", "remove it, or set camera.rate_hz")
    return clock._replace(unit=FRAMES)


TUM_NAMES = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")
TUM_COLUMNS = len(TUM_NAMES)
TUM = "a TUM trajectory: time, tx ty tz, qx qy qz qw a line"
#: Lens of the Kinect's colour camera, as calibrated for the first TUM recordings: 49.8 degrees high, 63.5 wide.
KINECT = centred(640, 480, 517.0)


def load_tum(path: Path, clock: TableClock = ANY_CLOCK) -> RawCamera:
    """Read a TUM RGB-D trajectory: `time tx ty tz qx qy qz qw` per line, camera to world, metres, seconds.

    Axes are optical. SLAM programs also write their maps in this format, some with times in nanoseconds. `clock`: what
    the scene says about the times. Raises BadInputError with the line.
    Format: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats.
    """
    poses = read_pose_table(path, clock, TUM_NAMES, TUM)
    times, order = poses.times, "" if poses.order == USUAL else f", columns {poses.order}"
    time = "" if times.unit == "s" else f", time in {times.unit}"
    notes = (f"TUM trajectory, {len(poses.turns)} poses{times.rate}{time}{order}, optical axes, camera to world",)
    lens = ((KINECT,), "usual for a Kinect")
    reason = f"{TUM_COLUMNS} columns of numbers"
    detected = Detected("TUM trajectory", reason, unit="m", rate="by the times of the file")
    return RawCamera(
        times.since_s,
        poses.turns,
        poses.places,
        "z",
        *lens,
        notes,
        poses.table.place_of,
        detected,
        unit=LengthUnit.USUALLY_M,
        began_s=poses.began_s,
        lengths=poses.lengths,
    )


EUROC_NAMES = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")
EUROC = "EuRoC poses: time in ns, x, y, z, qw, qx, qy, qz a line"
EUROC_SENSOR = Path("cam0") / "sensor.yaml"
#: Lens of the left camera of the EuRoC data sets.
CAM0 = of_opencv(752.0, 480.0, 458.654, 457.296, 367.215, 248.375)
#: Keys of `sensor.yaml`, with the number of values of each.
SENSOR_KEYS = {"data": 16, "resolution": 2, "intrinsics": 4, "distortion_coefficients": 4}


def load_euroc(path: Path, clock: TableClock = ANY_CLOCK) -> RawCamera:
    """Read EuRoC MAV poses, `data.csv`: time in nanoseconds, position, quaternion `w, x, y, z`, then any other columns.

    The poses belong to the device's body. `cam0/sensor.yaml` next to the file's folder states the camera's pose on the
    body; without this file, the body's poses are taken for the camera's. Camera axes are optical; the world's Z is up.
    `clock`: what the scene says about the times. Raises BadInputError with the line.
    Format: M. Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016.
    """
    poses = read_pose_table(path, clock, EUROC_NAMES, EUROC, may_have_more=True)
    turns, places, lens, source = poses.turns, poses.places, CAM0, "usual for EuRoC's cameras"
    how: tuple[str, ...] = (f"the axes of the poses are taken for the camera's, as there is no {EUROC_SENSOR}",)
    sensor = path.parent.parent / EUROC_SENSOR
    if sensor.is_file():
        numbers = _sensor(sensor)
        to_body = numbers["data"].reshape(4, 4)
        turns, places = turns @ to_body[:3, :3], places + turns @ to_body[:3, 3] / LENGTH_UNITS[poses.lengths or "m"]
        own = of_opencv(*(float(value) for key in ("resolution", "intrinsics") for value in numbers[key]))
        lens, source = checked_lens(sensor, own), f"by {EUROC_SENSOR}"
        bent = dict(zip(("k1", "k2", "p1", "p2"), map(float, numbers["distortion_coefficients"]), strict=True))
        how = (f"poses of the body, brought to the camera by {EUROC_SENSOR}", *distortion_note([Bent(lens, bent)]))
    times = poses.times
    notes = (f"EuRoC poses, {len(turns)}{times.rate}, time in {times.unit}, columns {poses.order}", *how)
    detected = Detected("EuRoC poses", "times in ns and commas", unit="m", rate="by the times of the file")
    return RawCamera(
        times.since_s,
        turns,
        places,
        "z",
        (lens,),
        source,
        notes,
        poses.table.place_of,
        detected,
        began_s=poses.began_s,
        lengths=poses.lengths,
    )


def _sensor(path: Path) -> dict[str, F64]:
    """Return the numbers of a `sensor.yaml` by key of SENSOR_KEYS. Raises BadInputError."""
    text = "\n".join(line.split("#", 1)[0] for line in read_text(path, "a EuRoC sensor.yaml").splitlines())
    numbers = {}
    for key, count in SENSOR_KEYS.items():
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


STRAY_FILE, STRAY_MATRIX = "odometry.csv", "camera_matrix.csv"
STRAY_NAMES = ("time", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
STRAY = "a Stray Scanner odometry.csv: timestamp, frame, x, y, z, qx, qy, qz, qw"
#: Width and height of Stray Scanner's video. A principal point within NEAR_PX of its middle belongs to it.
VIDEO_PX, NEAR_PX = (1920.0, 1440.0), 100.0


def load_stray(path: Path, clock: TableClock = ANY_CLOCK) -> RawCamera:
    """Read Stray Scanner's `odometry.csv`, or its folder: time, frame, position and quaternion of each frame.

    Axes are optical in ARKit's world, which is levelled, Y up, metres. Newer files have a lens for each frame, in
    pixels of the sensor in landscape. Next to older files, `camera_matrix.csv` has one lens for all frames. `clock`:
    what the scene says about the times. Raises BadInputError with the line.
    Format: https://docs.strayrobots.io/apps/scanner/format.html.
    """
    file = path / STRAY_FILE if path.is_dir() else path
    poses = read_pose_table(file, clock, STRAY_NAMES, STRAY, may_have_more=True)
    lenses, source = _stray_lenses(file, poses)
    times = poses.times
    time = "" if times.unit == "s" else f", time in {times.unit}"
    notes = (f"Stray Scanner, {len(poses.turns)} poses{times.rate}{time}, optical axes, camera to world",)
    detected = Detected("Stray Scanner odometry", "its column names", unit="m", rate="by the times of the file")
    return RawCamera(
        times.since_s,
        poses.turns,
        poses.places,
        "y",
        lenses,
        source,
        notes,
        poses.table.place_of,
        detected,
        is_levelled=True,
        lengths=poses.lengths,
    )


def _stray_lenses(file: Path, poses: PoseTable) -> tuple[tuple[Lens, ...], str]:
    """Return (lenses, source of the lenses in words). There is one lens for all poses, or one lens for each pose.

    Raises BadInputError for a lens or a camera matrix that is wrong.
    """
    parts = ("fx", "fy", "cx", "cy")
    if all(name in poses.names for name in parts):
        table = np.column_stack([poses.column(name) for name in parts])
        if np.isfinite(table).any():
            places = (f"{file}, {poses.table.place_of(k)}" for k in range(len(table)))
            lenses = tuple(_stray_lens(where, row) for where, row in zip(places, table, strict=True))
            return lenses, "by the file, frame by frame"
    matrix = file.with_name(STRAY_MATRIX)
    if not matrix.is_file():
        return (PHONE,), f"usual for a phone, as there is no {STRAY_MATRIX}"
    numbers = read_table(matrix, 3, "the 3 x 3 camera matrix").numbers
    if numbers.shape != (3, 3):
        raise BadInputError(matrix, f"{len(numbers)} rows", "a 3 x 3 camera matrix")
    return (_stray_lens(matrix, numbers[[0, 1, 0, 1], [0, 1, 2, 2]]),), f"by {STRAY_MATRIX}"


def _stray_lens(where: str | Path, numbers: F64) -> Lens:
    """Return the lens with fx, fy, cx and cy in `numbers` (4,).

    A principal point near the middle of the usual video means a picture of that size; otherwise it is taken as the
    middle of the picture. Raises BadInputError about `where`.
    """
    _, _, cx, cy = (float(value) for value in numbers)
    is_usual = abs(cx - VIDEO_PX[0] / 2) < NEAR_PX and abs(cy - VIDEO_PX[1] / 2) < NEAR_PX
    width, height = VIDEO_PX if is_usual else (2 * cx, 2 * cy)
    return measured_lens(where, width, height, numbers)
