"""Tables with a time, a place and a quaternion in each line, whatever the order of their columns.

Rule: column names decide the order where a file has them, else its format does. Columns that most often hold no
quaternion are refused: taken for one, another order of columns would give a camera that looks anywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.scene.camera.text_table import POSE, Table, Times, layout_of, read_table, times_of
from trilane.scene.rotations import matrix_from_quat, normalised

USUAL = "as usual"
SAY_ORDER = "say the order in a first line, such as `timestamp qx qy qz qw tx ty tz`"
#: Columns of a 3x4 matrix.
MATRIX = 12
#: Times from 2001 to 2100 are those of a clock, others those of a device.
EARLIEST_S, LATEST_S = 1e9, 4.1e9
#: A quaternion has length 1; two digits after the point change it by 0.01 at most.
MOST_OFF = 0.02


@dataclass(frozen=True)
class PoseTable:
    """`times_s` (N,): from 0. `turns` (N, 3, 3) and `places` (N, 3): as the file has them.

    `time`: unit of the file's times. `rate`: for notes, such as `, 30/s`. `order`: where the order of columns comes
    from. `names`: what the columns of `table` hold. `began_s`: at a time of 0, seconds since 1970; None where the file
    has other times.
    """

    times_s: F64
    turns: F64
    places: F64
    time: str
    rate: str
    order: str
    names: Sequence[str]
    table: Table
    began_s: float | None

    def column(self, name: str) -> F64:
        """The numbers (N,) of the column that holds `name`."""
        return self.table.numbers[:, self.names.index(name)]


def read_pose_table(
    path: Path, rate_hz: float | None, usual: Sequence[str], expected: str, may_have_more: bool = False
) -> PoseTable:
    """The poses of `path`.

    `rate_hz`: of the scene. `usual`: what columns hold in the format. `may_have_more`: whether others may follow.
    Raises BadInputError with the line.
    """
    layout = layout_of(path, expected)
    names = layout.names if layout.has_pose else tuple(usual)
    order = USUAL if names[: len(usual)] == tuple(usual) else "by the file's column names"
    if may_have_more or layout.has_pose:
        fitting = (*names, *[""] * (layout.columns - len(names)))[: layout.columns]
        names = fitting if set(POSE) <= set(fitting) else names
    table = read_table(path, len(names), expected)
    time, x, y, z, qw, qx, qy, qz = (table.numbers[:, names.index(name)] for name in POSE)
    times = times_of(time, rate_hz)
    quats = np.column_stack([qw, qx, qy, qz])
    _require_quats(path, quats, table)
    turns = matrix_from_quat(normalised(quats))
    places = np.column_stack([x, y, z])
    return PoseTable(
        times.since_s, turns, places, times.unit, times.rate, order, names, table, _began(time, times.unit)
    )


class MatrixTable(NamedTuple):
    """`turns` (N, 3, 3) and `places` (N, 3): as the file has them. `times`: None where it has none."""

    times: Times | None
    turns: F64
    places: F64
    table: Table


def read_matrix_table(path: Path, rate_hz: float | None, usual_hz: float, expected: str) -> MatrixTable:
    """The poses of `path`, 3x4 matrices row by row, with a time or the number of the frame before each, or without.

    `rate_hz`: of the scene. `usual_hz`: of frames that are numbered. Raises BadInputError with the line.
    """
    columns = MATRIX if layout_of(path, expected).columns == MATRIX else MATRIX + 1
    table = read_table(path, columns, expected)
    first = times_of(table.numbers[:, 0], rate_hz, usual_hz) if columns > MATRIX else None
    matrices = table.numbers[:, -MATRIX:].reshape(-1, 3, 4)
    return MatrixTable(first, matrices[:, :, :3], matrices[:, :, 3], table)


def _began(times: F64, unit: str) -> float | None:
    """The first of `times`, seconds since 1970; None when it is no such time."""
    finite = times[np.isfinite(times)]
    first = float(finite[0]) * (1e-9 if unit == "ns" else 1.0) if len(finite) else 0.0
    return first if EARLIEST_S < first < LATEST_S else None


def _require_quats(path: Path, quats: F64, table: Table) -> None:
    """Raises BadInputError when most of `quats` (N, 4), which are of `table`, have not length 1."""
    off = is_off(quats)
    if 2 * np.count_nonzero(off) <= len(off):
        return
    first = int(np.flatnonzero(off)[0])
    others = [k for k in range(table.numbers.shape[1] - 3) if not is_off(table.numbers[:, k : k + 4]).any()]
    remedy = SAY_ORDER
    if others:
        remedy = f"columns {others[0] + 1} to {others[0] + 4} have length 1: {SAY_ORDER}"
    found = f"a quaternion of length {np.linalg.norm(quats[first]):.3g}"
    raise BadInputError(f"{path}, {table.place_of(first)}", found, "length 1", remedy)


def is_off(quats: F64, most: float = MOST_OFF) -> NDArray[np.bool_]:
    """Of which rows (N, 4) the length is off 1 by more than `most`; not of those that are no rotation at all."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quats, axis=1)
        return np.asarray(np.isfinite(length) & (length > 0) & (np.abs(length - 1) > most))
