"""Tables with a time, a place and a quaternion in each line, whatever the order of their columns.

Rule: column names decide the order where a file has them, else its format does. Columns that most often hold no
quaternion are refused: taken for one, another order of columns would give a camera that looks anywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.scene.camera.text_table import POSE, Table, in_seconds, layout_of, read_table
from trilane.scene.rotations import matrix_from_quat, normalised

USUAL = "as usual"
#: Times from 2001 to 2100 are those of a clock, others those of a device.
EARLIEST_S, LATEST_S = 1e9, 4.1e9
#: A quaternion has length 1; two digits after the point change it by 0.01 at most.
MOST_OFF = 0.02


@dataclass(frozen=True)
class PoseTable:
    """`times_s` (N,): from 0. `turns` (N, 3, 3) and `places` (N, 3): as the file has them.

    `time`: unit of the file's times. `step_s`: their median step. `order`: where the order of columns comes from.
    `names`: what the columns of `table` hold. `began_s`: at a time of 0, seconds since 1970; None where the file has
    other times.
    """

    times_s: F64
    turns: F64
    places: F64
    time: str
    step_s: float
    order: str
    names: Sequence[str]
    table: Table
    began_s: float | None

    @property
    def rate(self) -> str:
        """For notes: `, 30/s`; empty where it is unknown."""
        return f", {1 / self.step_s:.4g}/s" if self.step_s > 0 else ""

    def column(self, name: str) -> F64:
        """The numbers (N,) of the column that holds `name`."""
        return self.table.numbers[:, self.names.index(name)]


def read_pose_table(path: Path, usual: Sequence[str], expected: str, may_have_more: bool = False) -> PoseTable:
    """The poses of `path`.

    `usual`: what columns hold in the format. `may_have_more`: whether others may follow. Raises BadInputError with the
    line.
    """
    layout = layout_of(path, expected)
    names = layout.names if layout.has_pose else tuple(usual)
    order = USUAL if names[: len(usual)] == tuple(usual) else "by the file's column names"
    if may_have_more or layout.has_pose:
        fitting = (*names, *[""] * (layout.columns - len(names)))[: layout.columns]
        names = fitting if set(POSE) <= set(fitting) else names
    table = read_table(path, len(names), expected)
    time, x, y, z, qw, qx, qy, qz = (table.numbers[:, names.index(name)] for name in POSE)
    times, step, unit = in_seconds(time)
    quats = np.column_stack([qw, qx, qy, qz])
    _require_quats(path, quats, table)
    turns = matrix_from_quat(normalised(quats))
    places = np.column_stack([x, y, z])
    return PoseTable(times, turns, places, unit, step, order, names, table, _began(time, unit))


def _began(times: F64, unit: str) -> float | None:
    """The first of `times`, seconds since 1970; None when it is no such time."""
    finite = times[np.isfinite(times)]
    first = float(finite[0]) * (1e-9 if unit == "ns" else 1.0) if len(finite) else 0.0
    return first if EARLIEST_S < first < LATEST_S else None


def _require_quats(path: Path, quats: F64, table: Table) -> None:
    """Raises BadInputError when most of `quats` (N, 4), which are of `table`, have not length 1."""
    off = _is_off(quats)
    if 2 * np.count_nonzero(off) <= len(off):
        return
    first = int(np.flatnonzero(off)[0])
    others = [k for k in range(table.numbers.shape[1] - 3) if not _is_off(table.numbers[:, k : k + 4]).any()]
    remedy = "say the order in a first line, such as `timestamp qx qy qz qw tx ty tz`"
    if others:
        remedy = f"columns {others[0] + 1} to {others[0] + 4} have length 1: {remedy}"
    found = f"a quaternion of length {np.linalg.norm(quats[first]):.3g}"
    raise BadInputError(f"{path}, {table.place_of(first)}", found, "length 1", remedy)


def _is_off(quats: F64) -> NDArray[np.bool_]:
    """Of which rows (N, 4) the length is another than 1; not of those that are no rotation at all."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quats, axis=1)
        return np.asarray(np.isfinite(length) & (length > 0) & (np.abs(length - 1) > MOST_OFF))
