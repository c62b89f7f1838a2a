"""Camera files as text, and where a point falls in a picture of 640x480. Rule: expectations are worked out by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from trilane.arrays import F64
from trilane.scene.camera.load import load_camera
from trilane.scene.camera.path import CameraPath
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
