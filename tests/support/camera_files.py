"""Camera files as text, and where a point falls in a picture of 640x480. Rule: expectations are worked out by hand."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from trilane.arrays import F64
from trilane.scene.camera.files import load_camera
from trilane.scene.camera.path import CameraPath
from trilane.scene.lens import Lens
from trilane.scene.rotations import quat_from_matrix
from trilane.scene.schema import CameraSpec

WIDTH, HEIGHT = 640, 480


def load(source: Path | str, **spec: Any) -> CameraPath:
    return load_camera(CameraSpec(source=str(source), **spec), Path("/"))


def pixel(camera: CameraPath, point: list[float], t_s: float = 0.0) -> tuple[float, float]:
    """Column and row of a world point in a picture of 640x480, origin top left."""
    x, y, _, w = camera.projection(t_s, (HEIGHT, WIDTH)) @ camera.sample(t_s) @ [*point, 1.0]
    return (x / w + 1) / 2 * WIDTH, (1 - y / w) / 2 * HEIGHT


def rows_of(matrix: F64) -> str:
    return "0 " + " ".join(f"{value:.12g}" for value in np.column_stack([matrix, np.zeros(3)]).ravel())


def nerf_text(*matrices: F64, **extra: Any) -> str:
    return json.dumps({"frames": [{"transform_matrix": matrix.tolist()} for matrix in matrices], **extra})


def pose_z_up(degrees: float, place: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> F64:
    """4x4 of a level camera in a Z-up world that looks along +Y, turned left about +Z."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    matrix[:3, 3] = place
    return matrix


def angle(tangent: float) -> float:
    return math.degrees(2 * math.atan(tangent))


OPTICAL = np.diag([1.0, -1.0, -1.0])
RATE_HZ = 30
#: Of the pictures that the writers below say the camera took.
LENS = Lens(640.0, 480.0, 510.0, 500.0, 330.0, 228.0)
VIDEO_LENS = LENS.scaled(1920.0, 1440.0)


def lines_of(rows: F64, separator: str = " ") -> str:
    return "".join(separator.join(f"{value:.17g}" for value in row) + "\n" for row in rows)


def seconds(count: int) -> F64:
    return np.arange(count) / RATE_HZ


def write_arkit(folder: Path, turns: F64, places: F64) -> Path:
    """As https://github.com/PyojinKim/ARKit-Data-Logger has it; axes (N, 3, 3) OpenGL, camera to world."""
    rows = np.column_stack([105230574092166 + seconds(len(turns)) * 1e9, np.dstack([turns, places]).reshape(-1, 12)])
    (folder / "ARposes.txt").write_text(lines_of(rows))
    return folder / "ARposes.txt"


def write_tum(folder: Path, turns: F64, places: F64) -> Path:
    """As https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats has it, with a line of column names."""
    quats = quat_from_matrix(turns @ OPTICAL)[:, [1, 2, 3, 0]]
    text = lines_of(np.column_stack([1305031098.5 + seconds(len(turns)), places, quats]))
    (folder / "CameraTrajectory.txt").write_text("timestamp tx ty tz qx qy qz qw\n" + text)
    return folder / "CameraTrajectory.txt"


EUROC_NAMES = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]\n"
)


def write_euroc(folder: Path, turns: F64, places: F64) -> Path:
    """As the data sets' `state_groundtruth_estimate0/data.csv`, of the camera itself; with three more columns."""
    quats = quat_from_matrix(turns @ OPTICAL)
    times = [1403636580838555648 + round(t_s * 1e9) for t_s in seconds(len(turns))]
    rows = lines_of(np.column_stack([places, quats, np.zeros((len(turns), 3))]), ",").splitlines()
    text = "".join(f"{time},{row}\n" for time, row in zip(times, rows, strict=True))
    (folder / "data.csv").write_text(EUROC_NAMES + text)
    return folder / "data.csv"


def kitti_text(turns: F64, places: F64) -> str:
    return lines_of(np.dstack([turns @ OPTICAL, places]).reshape(-1, 12))


def write_kitti(folder: Path, turns: F64, places: F64) -> Path:
    """As the readme of KITTI's odometry development kit has it, with its times."""
    (folder / "00.txt").write_text(kitti_text(turns, places))
    (folder / "times.txt").write_text(lines_of(seconds(len(turns))[:, None]))
    return folder / "00.txt"


def write_stray(folder: Path, turns: F64, places: F64) -> Path:
    """As https://docs.strayrobots.io/apps/scanner/format.html has it, with the lens of each frame."""
    count = len(turns)
    quats = quat_from_matrix(turns @ OPTICAL)[:, [1, 2, 3, 0]]
    lens = np.tile([VIDEO_LENS.fx, VIDEO_LENS.fy, VIDEO_LENS.cx, VIDEO_LENS.cy], (count, 1))
    rows = lines_of(np.column_stack([5000 + seconds(count), np.arange(count), places, quats, lens]), ", ").splitlines()
    names = "timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy, distortion_center_x, distortion_center_y\n"
    (folder / "odometry.csv").write_text(names + "".join(f"{row}, , \n" for row in rows))
    return folder / "odometry.csv"


def write_nerf(folder: Path, turns: F64, places: F64) -> Path:
    """As https://docs.nerf.studio/quickstart/data_conventions.html has it, with the lens of each frame."""
    matrices = np.tile(np.eye(4), (len(turns), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = turns, places
    lens = {"fl_x": LENS.fx, "fl_y": LENS.fy, "cx": LENS.cx, "cy": LENS.cy, "w": 640, "h": 480}
    frames = [
        {"file_path": f"images/frame_{k:05d}.jpg", **lens, "transform_matrix": matrix.tolist()}
        for k, matrix in enumerate(matrices)
    ]
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}))
    return folder / "transforms.json"


def colmap_rows(turns: F64, places: F64) -> list[tuple[str, F64]]:
    """Name and w, x, y, z, tx, ty, tz, world to camera, of each photo."""
    world_to_camera = np.swapaxes(turns @ OPTICAL, 1, 2)
    shifts = -(world_to_camera @ places[:, :, None])[:, :, 0]
    rows = np.column_stack([quat_from_matrix(world_to_camera), shifts])
    return [(f"view {k}.jpg", row) for k, row in enumerate(rows)]


def write_colmap_text(folder: Path, turns: F64, places: F64) -> Path:
    """As https://colmap.github.io/format.html has it: points, no points, and photos in no order."""
    camera = f"7 PINHOLE 640 480 {LENS.fx} {LENS.fy} {LENS.cx} {LENS.cy}\n"
    (folder / "cameras.txt").write_text("# Camera list\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n" + camera)
    images = [
        f"{k + 1} {' '.join(f'{value:.17g}' for value in row)} 7 {name}\n{'1.5 2.5 -1 3 4 5 6 7 8 9 8 7' * (k % 2)}\n"
        for k, (name, row) in enumerate(colmap_rows(turns, places))
    ]
    (folder / "images.txt").write_text("# Image list with two lines of data per image:\n" + "".join(images[::-1]))
    return folder


def write_colmap_binary(folder: Path, turns: F64, places: F64) -> Path:
    """As https://colmap.github.io/format.html#binary-file-format has it."""
    camera = struct.pack("<iiQQ4d", 7, 1, 640, 480, LENS.fx, LENS.fy, LENS.cx, LENS.cy)
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", 1) + camera)
    images = b"".join(
        struct.pack("<i7di", k + 1, *row, 7) + name.encode() + b"\0" + struct.pack("<Q", k % 3) + bytes(24 * (k % 3))
        for k, (name, row) in enumerate(colmap_rows(turns, places))
    )
    (folder / "images.bin").write_bytes(struct.pack("<Q", len(turns)) + images)
    return folder


def write_record3d(folder: Path, turns: F64, places: F64) -> Path:
    """As the app exports it: keys of https://docs.nerf.studio's converter, with the lens of each frame."""
    poses = np.column_stack([quat_from_matrix(turns)[:, [1, 2, 3, 0]], places]).tolist()
    content = {"w": 640, "h": 480, "fps": 30, "K": [LENS.fx, 0, 0, 0, LENS.fy, 0, LENS.cx, LENS.cy, 1], "poses": poses}
    lens = [[LENS.fx, LENS.fy, LENS.cx, LENS.cy]] * len(poses)
    times = (7.5 + seconds(len(poses))).tolist()
    text = json.dumps({**content, "perFrameIntrinsicCoeffs": lens, "frameTimestamps": times})
    (folder / "metadata.json").write_text(text)
    return folder / "metadata.json"


Writer = Callable[[Path, F64, F64], Path]
#: Kind -> writes the poses (N, 3, 3) and (N, 3) of a camera, OpenGL axes, camera to world, and says where.
WRITERS: dict[str, Writer] = {
    "arkit": write_arkit,
    "tum": write_tum,
    "euroc": write_euroc,
    "kitti": write_kitti,
    "stray": write_stray,
    "nerf": write_nerf,
    "record3d": write_record3d,
    "colmap text": write_colmap_text,
    "colmap binary": write_colmap_binary,
}
