"""Loads the camera of a scene: a built-in one by name, or a file whose format is found from its content.

The scene may state the format. Otherwise a folder is recognised by the names of its files. A text is recognised by its
column names, or else by the number of columns and their content. A file that fits a second format, or another order of
columns, is refused. The message names both possibilities, and the scene's key that decides between them. A note gives
the reason of each guess.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trilane.arrays import F64
from trilane.errors import BadInputError, did_you_mean
from trilane.files import read_text, require_file
from trilane.scene.camera.colmap import ENDINGS, load_colmap, model_in
from trilane.scene.camera.json_files import NERF_FILE, RECORD3D_FILE, load_nerf, load_record3d
from trilane.scene.camera.path import BUILTIN, CameraPath, load_builtin
from trilane.scene.camera.pose_table import (
    LEAST_GROWING,
    MATRIX,
    POSE,
    ROW_ORDER,
    SAY_ORDER,
    SECONDS,
    TableClock,
    TableLayout,
    head_of,
    is_index,
    is_off,
    layout_of,
    read_table,
    units_of,
)
from trilane.scene.camera.recorded import (
    AUTO,
    LEAST_SKYWARDS,
    LEAST_UP_COSINE,
    OPENGL_FROM_OPTICAL,
    UP,
    RawCamera,
    are_rotations,
    find_upright,
    is_of_body,
    meeting_point,
    path_from_recording,
    price_of,
    price_of_horizons,
)
from trilane.scene.camera.trajectories import (
    EUROC_NAMES,
    KITTI_TIMES,
    STRAY_FILE,
    TUM_COLUMNS,
    TUM_NAMES,
    load_arkit,
    load_euroc,
    load_kitti,
    load_stray,
    load_tum,
)
from trilane.scene.rotations import matrix_from_quat, normalised
from trilane.scene.schema import BUILT_IN_PREFIX, CameraSpec, axes_of

EXPECTED = (
    "a camera: an ARKit log, a TUM, KITTI or EuRoC trajectory, a transforms.json, odometry.csv of Stray Scanner, "
    "metadata.json of Record3D or a folder of COLMAP"
)
COLMAP_FILES = tuple(f"{name}{ending}" for name in ("cameras", "images") for ending in ENDINGS)


class Guess(NamedTuple):
    """A guess at a file's format. `kind`: format, as in the scene's `format`. `reason`: reason in words, for notes."""

    kind: str
    reason: str


#: Least number of rows from which a camera's movement is judged.
LEAST_ROWS = 5
#: Least number of rows from which another order of columns is found by where the camera goes and looks.
LEAST_LED = 20
#: A column is a clock if its `_unevenness` is below EVEN, and no clock if it is UNEVEN or more.
EVEN, UNEVEN = 0.1, 0.5
#: Largest coordinate of a map, in any unit; times since 1970 are larger.
FARTHEST = 1e8
#: Tolerance of quaternions and rotation matrices whose numbers have more than three digits; largest share of rows that
#: may exceed it.
PRECISE, MOST_IMPRECISE = 1e-3, 0.25
#: Tolerance within which a pose is the identity.
EXACT = 1e-6
#: Directions count as equal above these mean cosines: the camera's movement and an axis of the camera; an axis of the
#: camera and one of the world.
ALONG, UPRIGHT = 0.9, 0.7
#: Least distance of a point that a camera goes round, and by how much lines of sight may miss the point, as a share of
#: its distance. A person who pans holds the camera nearer than this to the axis of the turn; such lines of sight meet
#: behind the camera.
LEAST_AWAY, MOST_MISSED = 1.0, 0.2
#: Range of depths below 0, metres, of a camera held by a person, if Y is down and the floor is at 0. With Y up, no
#: camera is that low. In a phone's world, the origin is where the phone was, so no camera is that low either.
BELOW_M = 0.7, 2.5
#: Range of times of a device's clock, in seconds since it was switched on: more than times since the start of a
#: recording, less than times since 1970.
OF_A_DEVICE_S = 60.0, 1e9
#: Another order of numbers is possible if its price (`price_of`, `price_of_horizons`) is higher by less than this.
MUCH_DEARER = 0.1
#: Another order looks clearly more astray if `_astray` is higher by this: for one of the 24 orders of a quaternion, and
#: for an order of a matrix. Matrices whose entries differ by at most SAME, as by a rotation of 5 degrees, are the same.
MUCH_ASTRAY, AS_ASTRAY, SAME = 0.3, 0.1, 2 * math.sin(math.radians(2.5))
#: A camera looks ahead if the sine of its mean elevation is below this: one degree.
LEVEL = 0.02
WHICH_MATRIX = (
    'set camera.format to "kitti" if the camera looks along +Z of its axes (x right, y down), to "arkit" if along -Z '
    "(x right, y up); camera.axes states other axes"
)

#: How to convert a table, by the number of columns that other programs save.
OTHERS = {
    1: "part the numbers by blanks, commas or semicolons",
    7: "if these are rotation vectors, as in ARKitScenes, or a place and a quaternion: write time, place and "
    "quaternion of each pose, camera to world, as TUM has them",
    16: "if these are 4x4 matrices, as of Replica: leave the last four columns out, which are 0 0 0 1, for KITTI's 12",
    17: "if these are a time and a 4x4 matrix: leave the last four columns out, which are 0 0 0 1",
}

#: How to make a table from an array of matrices, and from a folder of files with one matrix each.
OF_ARRAY = (
    "if it has shape (N, 4, 4) or (N, 3, 4): python -c \"import numpy as np; np.savetxt('poses.txt', "
    "np.load('{name}')[:, :3].reshape(-1, 12))\""
)
OF_FILES = (
    "make one table of them: for f in $(ls -v {folder}/*.txt); do head -n 3 $f | tr '\\n' ' '; echo; done > poses.txt"
)


def detect(path: Path, up_axis: str = AUTO, axes: str = AUTO) -> Guess:
    """Return the format of `path`, and the reason. Raises BadInputError if the format is unknown, or if two fit.

    `up_axis`, `axes`: keys of the scene's camera: the axis that is up, and the directions of x, y and z of a pose.
    """
    if path.is_dir():
        return _of_folder(path)
    require_file(path, EXPECTED)
    if path.suffix.lower() == ".npy":
        raise BadInputError(path, "an array of NumPy", "a text or a folder", OF_ARRAY.format(name=path))
    if path.name in COLMAP_FILES and model_in(path.parent) is not None:
        return Guess("colmap", "a file of a COLMAP model")
    text = read_text(path, EXPECTED)
    if path.suffix.lower() != ".json" and text.lstrip()[:1] != "{":
        return _of_table(path, layout_of(path, EXPECTED), up_axis, axes)
    if '"frames"' not in text and '"poses"' in text:
        return Guess("record3d", "JSON with `poses` and no `frames`")
    return Guess("nerf", "it is JSON")


def _of_folder(path: Path) -> Guess:
    found = model_in(path)
    if found is not None:
        return Guess("colmap", f"cameras{found[1]} and images{found[1]} in the folder")
    for kind, name in (("nerf", NERF_FILE), ("stray", STRAY_FILE), ("record3d", RECORD3D_FILE)):
        if (path / name).is_file():
            return Guess(kind, f"{name} in the folder")
    for folder in (path, path / "pose"):  # of 7-Scenes and ScanNet
        if _has_matrices(folder):
            text = "a folder of text files with a 4x4 matrix each"
            raise BadInputError(folder, text, "one file with all poses", OF_FILES.format(folder=folder))
    remedy = "name the file of poses in it"
    raise BadInputError(
        path, f"a folder without {NERF_FILE}, {STRAY_FILE}, {RECORD3D_FILE} and COLMAP's files", EXPECTED, remedy
    )


def _has_matrices(folder: Path) -> bool:
    """Return whether `folder` has at least two text files and the first of them holds a 4x4 matrix."""
    files = sorted(folder.glob("*.txt"))
    try:
        return len(files) > 1 and read_table(files[0], 4, EXPECTED).numbers.shape == (4, 4)
    except BadInputError:
        return False


def _of_table(path: Path, layout: TableLayout, up_axis: str, axes: str) -> Guess:
    columns = layout.columns
    if layout.has_pose and "frame" in layout.names:
        return Guess("stray", "column names with a frame, a place and a quaternion")
    if layout.has_pose:
        scalar_first = layout.names.index("qw") < layout.names.index("qx")
        reason = f"column names with the quaternion's scalar {'first' if scalar_first else 'last'}"
        return Guess("euroc" if scalar_first and layout.is_ns else "tum", reason)
    if any(name in layout.names for name in ("qw", "qx", "qy", "qz")):
        missing = ", ".join(name for name in POSE if name not in layout.names)
        raise BadInputError(path, f"column names without {missing}", f"names of {', '.join(POSE)} in any order")
    if columns in (MATRIX, MATRIX + 1):
        return _of_matrices(path, head_of(path, columns, EXPECTED), up_axis, axes)
    if columns >= TUM_COLUMNS and layout.has_commas and layout.is_ns:
        _require_one_order(path, head_of(path, columns, EXPECTED), EUROC_NAMES, _axes("euroc", axes))
        reason = f"{columns} columns with commas and times in ns: the quaternion's scalar is taken to be first"
        return Guess("euroc", reason)
    if columns == TUM_COLUMNS:
        _require_one_order(path, head_of(path, columns, EXPECTED), TUM_NAMES, _axes("tum", axes))
        return Guess("tum", f"{columns} columns: the quaternion's scalar is taken to be last")
    counts = f"{TUM_COLUMNS} (TUM, EuRoC), {MATRIX} (KITTI) or {MATRIX + 1} (ARKit), or column names"
    raise BadInputError(path, f"{columns} columns", counts, OTHERS.get(columns, ""))


def _require_clock(path: Path, numbers: F64, others: Iterable[int]) -> None:
    """Raise BadInputError if a column of `numbers` (N, columns) other than the first looks like times.

    `others`: indices of columns to check. A column looks like times if its numbers are as large as times since 1970. It
    also looks like times if it grows evenly and the first column does not.
    """
    if len(numbers) < LEAST_ROWS:
        return
    # Equal times are refused by the reader.
    is_even = np.ptp(numbers[:, 0]) == 0 or _unevenness(numbers[:, 0]) < UNEVEN
    for k in others:
        middle = float(np.median(numbers[:, k]))
        if abs(middle) > FARTHEST:
            raise BadInputError(path, f"{middle:.6g} in column {k + 1}", "a place, not a time", SAY_ORDER)
        if not is_even and _unevenness(numbers[:, k]) < EVEN:
            found = f"column {k + 1} growing evenly, as times do, and column 1 not"
            raise BadInputError(path, found, "a time in the first column", SAY_ORDER)


def _unevenness(column: F64) -> float:
    """Return the median deviation of the steps of `column` (N,) from their median, as a share of the median.

    The result is infinite if the column does not grow.
    """
    steps = np.diff(column)
    middle = float(np.median(steps))
    if not middle > 0 or (steps > 0).mean() < LEAST_GROWING:
        return np.inf
    return float(np.median(np.abs(steps - middle))) / middle


def _of_matrices(path: Path, numbers: F64, up_axis: str, axes: str) -> Guess:
    """Return the format of a table of 3x4 matrices, KITTI or ARKit.

    `numbers`: (N, 12); (N, 13) if a time or a frame's number comes first.

    Cameras of KITTI and ARKit look along opposite axes. Therefore, unless the scene states `axes`, poses that may
    belong to the other format raise BadInputError. Transposed or inexact matrices, and misplaced times, raise it too.
    """
    matrices = numbers[:, -MATRIX:].reshape(-1, 3, 4)
    rows = numbers[sound := are_rotations(matrices[:, :, :3])]
    has_time = numbers.shape[1] > MATRIX and not is_index(rows[:, 0])
    usual, first = ("arkit", "a time and ") if has_time else ("kitti", "a frame's number and ")
    columns = f"{numbers.shape[1]} columns: {first if numbers.shape[1] > MATRIX else ''}"
    if len(rows) >= LEAST_ROWS and _has_digits(rows[:, -MATRIX:]):
        precise = are_rotations(matrices[sound, :, :3], PRECISE)
        if (~precise).mean() > MOST_IMPRECISE:
            found = f"{columns}matrices that are nearly rotations, but not as exactly as their digits"
            raise BadInputError(path, found, "numbers row by row", WHICH_MATRIX)
    is_readable = 0 < len(rows) >= len(numbers) / 2  # otherwise the reader refuses the file and names a row
    has_times = has_time or path.with_name(KITTI_TIMES).is_file()
    if is_readable and has_time:
        _require_clock(path, rows, (4, 8, 12))
    if is_readable and has_times and axes == AUTO:
        _require_row_order(path, matrices[sound], columns, usual, -AS_ASTRAY)
    if is_readable and (has_time or not has_times):
        signs = _signs(matrices[sound], up_axis, rows[:, 0] if has_time else None)
        if axes == AUTO and (signs["kitti" if has_time else "arkit"] or not signs[usual]):
            why = " and ".join((*signs["kitti"], *signs["arkit"])) or "which do not tell where the camera looks"
            raise BadInputError(path, f"{columns}3x4 matrices, {why}", "what fits one format", WHICH_MATRIX)
    if is_readable and not has_times and axes == AUTO:
        _require_row_order(path, matrices[sound], columns, usual, AS_ASTRAY)
    return Guess(usual, f"{columns}a 3x4 matrix{'' if numbers.shape[1] > MATRIX else ' without a time'}")


def _require_row_order(path: Path, matrices: F64, columns: str, kind: str, slack: float) -> None:
    """Raise BadInputError if `matrices` (N, 3, 4) of the format `kind` fit better with their numbers in another order.

    `columns`: the table's columns, in words.
    `slack`: another order is possible if its `_astray` is less than the `_astray` of the present order plus `slack`.

    People hold a camera level while it pans. With transposed matrices or exchanged axes, the picture swings, the camera
    looks up, or the camera looks away from where it goes. KITTI's first pose is the identity, so KITTI's poses are as
    level when transposed.
    """
    turns, places = matrices[:, :, :3], matrices[:, :, 3]
    if len(turns) < LEAST_ROWS:
        return
    back, is_kitti, axes = turns.swapaxes(1, 2), kind == "kitti", _axes(kind, AUTO)
    others = {
        "each is transposed, as of world to camera": (back, places),
        "each is that of world to camera": (back, -(back @ places[:, :, None])[:, :, 0]),
    }
    if not is_kitti:
        others["their columns are y, z, x"] = turns[:, :, [1, 2, 0]], places
        others["their columns are z, x, y"] = turns[:, :, [2, 0, 1]], places

    def astray(turns: F64, places: F64) -> float:
        is_steep = not is_kitti and _skywards(turns @ axes) > LEAST_SKYWARDS
        return min(_astray(turns @ axes, places), 1.0) + is_steep

    price, own = price_of_horizons(turns), astray(turns, places)
    for how, other in others.items():
        dearer = price_of_horizons(other[0]) - price
        is_nearer = dearer < MUCH_DEARER and astray(*other) < own + slack
        is_cheaper = dearer < -MUCH_DEARER and not is_kitti
        if (is_nearer or is_cheaper) and np.abs(other[0] - turns).max() > SAME:
            found = f"{columns}3x4 matrices that fit {'as well' if slack > 0 else 'better'} if {how}"
            remedy = f"write rotations from camera to world in this order; {WHICH_MATRIX}"
            raise BadInputError(path, found, ROW_ORDER, remedy)


def _signs(matrices: F64, up_axis: str, times: F64 | None) -> dict[str, tuple[str, ...]]:
    """Return the features of the poses `matrices` (N, 3, 4) that speak for KITTI and for ARKit, in words, by format.

    `up_axis`: axis that is up, by the scene. If it is AUTO, Y or Z may be up.
    `times` (N,): times of the table; None if it has no times.

    A camera of KITTI looks along +Z, and its Y is down. A camera of ARKit looks along -Z, and its Y is up. A device is
    upright if its X is nearly vertical, and more so than its Y.

    With and without times, these features count for both formats: the camera moves along its view, or it looks at one
    point. If the device is not upright, the direction of Y also counts. Here AUTO allows KITTI both axes, and ARKit
    only Z. For KITTI, a first pose that is the identity counts too.

    These features count only with times. For both formats, a device with its lower end down looks down. For KITTI, Y
    tends up and the camera is below 0 by a depth in BELOW_M. For ARKit, the times are of a device's clock, or Y tends
    up. Here AUTO means Y.

    One feature counts only without times: an upright device speaks for ARKit, whatever the direction of Z.
    """
    turns, places = matrices[:, :, :3], matrices[:, :, 3]
    ups = ("z", "y") if up_axis == AUTO else (up_axis,)
    mean, gravity = turns.mean(axis=0), np.array(UP[ups[-1]])
    own_up = {axis: float(mean[:, 1] @ UP[axis]) for axis in ups}
    along = _along(turns, places)
    is_upright = bool(abs(mean[:, 0] @ gravity) > max(UPRIGHT, *map(abs, own_up.values())))
    starts = np.abs(turns[0] - np.eye(3)).max() < EXACT and np.abs(places[0]).max() < EXACT
    has_time = times is not None
    least, most = OF_A_DEVICE_S
    is_up = has_time and own_up[ups[-1]] > LEAST_UP_COSINE
    # For a phone whose lower end points down, which is its X: how steeply the view along -Z goes down. The view along
    # +Z then goes up as steeply.
    downwards = float(mean[:, 2] @ gravity) if has_time and is_upright and mean[:, 0] @ gravity < 0 else 0.0
    said = {
        "kitti": {
            "which begin at the origin without a turn, as KITTI's": starts,
            "which move along +Z, as KITTI's": along > ALONG,
            "which look at one point along +Z, as KITTI's": _missed(turns @ OPENGL_FROM_OPTICAL, places) < MOST_MISSED,
            "which look down along +Z, as KITTI's": downwards < -LEAST_SKYWARDS,
            f"whose Y is down where {' or '.join(ups).upper()} is up, as KITTI's": (
                min(own_up.values()) < -UPRIGHT and not is_upright
            ),
            f"which lie below 0 if {ups[-1].upper()} is up, unlike a camera over the floor": (
                is_up and BELOW_M[0] < -float(np.median(places @ gravity)) < BELOW_M[1]
            ),
        },
        "arkit": {
            "which move along -Z, as ARKit's": along < -ALONG,
            "which look at one point along -Z, as ARKit's": _missed(turns, places) < MOST_MISSED,
            "which look down along -Z, as ARKit's": downwards > LEAST_SKYWARDS,
            "of a device held upright, as ARKit's": is_upright and not has_time,
            "with times of a device's clock, as ARKit's": times is not None
            and any(least < times[0] * SECONDS[unit] < most for unit in units_of(times) if unit in SECONDS),
            f"whose Y is up where {ups[0].upper()} is up, as ARKit's": own_up[ups[0]] > UPRIGHT and not is_upright,
            f"with times and {ups[-1].upper()} up, as ARKit's": is_up,
        },
    }
    return {kind: tuple(why for why, holds in of.items() if holds) for kind, of in said.items()}


def _along(turns: F64, places: F64) -> float:
    """Return the mean cosine between steps of `places` (N, 3) and Z of `turns` (N, 3, 3), weighted by step length.

    The result is 0 without movement, and for fewer than LEAST_ROWS poses.
    """
    steps = np.diff(places, axis=0)
    length = float(np.linalg.norm(steps, axis=1).sum())
    return float((steps * turns[:-1, :, 2]).sum()) / length if length > 0 and len(turns) >= LEAST_ROWS else 0.0


def _missed(turns: F64, places: F64) -> float:
    """Return by how much lines of sight miss the point that the cameras go round, as a share of its distance.

    The result is infinite if there is no such point, or if it is nearer than LEAST_AWAY. Axes are OpenGL's.
    """
    point = meeting_point(turns, places) if len(turns) >= LEAST_ROWS else None
    if point is None:
        return math.inf
    towards, ahead = point - places, -turns[:, :, 2]
    along = (towards * ahead).sum(axis=1)
    missed = np.linalg.norm(towards - along[:, None] * ahead, axis=1)
    return float(np.median(missed) / np.median(along)) if np.median(along) > LEAST_AWAY else math.inf


def _require_one_order(path: Path, numbers: F64, names: tuple[str, ...], axes: F64) -> None:
    """Raise BadInputError if the quaternion's parts may be in another order than `names`, the order of the columns.

    `numbers` (N, columns): numbers of the table.
    `axes` (3, 3): columns are the directions of the camera's OpenGL axes, in the coordinates of a pose.

    Each of the 24 orders gives a camera. Four orders are equally level, as they only mirror the camera's heading.
    Movement tells these apart: a camera looks where it goes, or at one point that it goes round, and not up. In a SLAM
    map that begins with the identity, the 1 shows the place of the scalar. Of the six orders with the scalar there,
    only the most level order counts.
    """
    at = names.index("qw"), names.index("qx"), names.index("qy"), names.index("qz")
    first_of = min(at)
    numbers = numbers[np.any(numbers[:, first_of : first_of + 4] != 0, axis=1)]
    quats = numbers[:, first_of : first_of + 4]
    if not len(numbers) or 2 * np.count_nonzero(is_off(quats)) > len(quats):
        return  # the reader refuses such quaternions
    where = f"columns {first_of + 1} to {first_of + 4}"
    if len(quats) >= LEAST_ROWS and _has_digits(quats) and is_off(quats, PRECISE).mean() > MOST_IMPRECISE:
        found = f"quaternions in {where} that have length 1, but not as exactly as their digits"
        raise BadInputError(path, found, "a quaternion in these columns", SAY_ORDER)
    _require_clock(path, numbers, (1, 2, 3))
    own = tuple(k - first_of for k in at)
    one = np.abs(np.abs(quats[0]) - 1) < EXACT
    every = len(quats) // 100 + 1
    places = numbers[::every, [names.index(axis) for axis in "xyz"]]
    cameras = {
        order: matrix_from_quat(normalised(quats[::every, order])) @ axes
        for order in permutations(range(4))
        if not one.any() or one[order[0]]
    }
    prices = {order: price_of(turns, "z") for order, turns in cameras.items()}
    if one.any():
        fitting = {min(prices, key=lambda order: prices[order])}
    else:
        most = min(prices.values()) + MUCH_DEARER
        level = [order for order, price in prices.items() if price < most and _skywards(cameras[order]) < LEVEL]
        astray = {order: _astray(cameras[order], places) for order in level}
        off = min(1.0, min(astray.values(), default=1.0) + MUCH_ASTRAY)
        fitting = {order for order in level if astray[order] < off}
    if fitting != {own}:
        raise BadInputError(
            path,
            f"{where} with quaternions whose order does not follow from how the camera is held and moves",
            "an order that makes a level camera that looks where it goes, and no other",
            'set camera.format to "tum" (qx qy qz qw) or "euroc" (qw qx qy qz), or ' + SAY_ORDER,
        )


def _has_digits(numbers: F64) -> bool:
    """Return whether any of `numbers` has more than three digits after the point."""
    return bool((np.abs(numbers - np.round(numbers, 3)) > EXACT).any())


def _astray(turns: F64, places: F64) -> float:
    """Return how far cameras look away from where they go, or from a point that they go round, whichever is less.

    A result below 1 means that they look there; with too few cameras it is infinite. Axes are OpenGL's.
    """
    if len(places) < LEAST_LED:
        return math.inf
    return min((1 + _along(turns, places)) / (1 - ALONG), _missed(turns, places) / MOST_MISSED)


def _skywards(turns: F64) -> float:
    """Return the sine of the mean elevation of the views of cameras with OpenGL axes `turns` (N, 3, 3)."""
    return -float(turns[:, :, 2].mean(axis=0) @ find_upright(turns, "z", False).up)


#: Reader of each table format, called with a path and what the scene says about times.
_TABLES: dict[str, Callable[[Path, TableClock], RawCamera]] = {
    "arkit": load_arkit,
    "euroc": load_euroc,
    "kitti": load_kitti,
    "stray": load_stray,
    "tum": load_tum,
}
#: Reader of each other format, called with a path and the rate in Hz that the scene states, if any.
_OTHERS: dict[str, Callable[[Path, float | None], RawCamera]] = {
    "colmap": load_colmap,
    "nerf": load_nerf,
    "record3d": load_record3d,
}
#: Formats that may be folders.
FOLDERS = ("colmap", "nerf", "record3d", "stray")


#: Formats whose poses have OpenGL axes; the poses of other formats have optical axes.
OPENGL_KINDS = ("arkit", "nerf", "record3d")


def _read(kind: str, path: Path, spec: CameraSpec) -> RawCamera:
    """Return the content of `path`, a file of the format `kind`, in the axes of its poses.

    Raises BadInputError, also when the scene states a unit of times for a file without times.
    """
    if kind in _TABLES:
        return _TABLES[kind](path, TableClock(spec.rate_hz, spec.time_unit))
    if spec.time_unit != AUTO:
        found = f'camera.time_unit = "{spec.time_unit}" with a file that is no table of times'
        raise BadInputError(path, found, "a table, such as TUM's", "remove it, or set camera.rate_hz")
    return _OTHERS[kind](path, spec.rate_hz)


def _axes(kind: str, stated: str) -> F64:
    """Return the directions of the camera's OpenGL axes, as columns (3, 3), in the coordinates of a pose.

    `kind`: format of the file. `stated`: `axes` of the scene's camera, or AUTO for the usual axes of the format.
    """
    axes = axes_of(stated)
    if axes is None:
        return np.eye(3) if kind in OPENGL_KINDS else OPENGL_FROM_OPTICAL
    return np.array(axes, dtype=np.float64)  # row k is the direction of the pose's axis k, in the camera's axes


#: Axes of the poses of robots and drones.
BODY_AXES = "forward-left-up"


def _require_camera(path: Path, raw: RawCamera, kind: str, spec: CameraSpec) -> None:
    """Raise BadInputError if the poses of `raw` more likely belong to a vehicle's body than to a camera."""
    if spec.axes != AUTO or spec.up_axis != AUTO or kind in OPENGL_KINDS:
        return
    turns = raw.turns[np.isfinite(raw.turns).all(axis=(1, 2))]
    turns = turns[are_rotations(turns)]
    if len(turns) and is_of_body(turns @ _axes(kind, AUTO), turns @ _axes(kind, BODY_AXES), raw.usual_up):
        found = "poses which, as a camera's, are turned by 90 degrees and look up steeply"
        remedy = f"set camera.axes to \"{BODY_AXES}\" if the poses are those of a drone's or robot's body (x forward), "
        remedy += 'or to "right-down-forward" if they are the camera\'s'
        raise BadInputError(path, found, "poses of a camera that is held level", remedy)


def load_camera(spec: CameraSpec, base: Path) -> CameraPath:
    """Load the camera that `spec.source` names. `base`: folder from which a relative path is resolved.

    Raises BadInputError when there is no such camera, or when the file is unusable.
    """
    if spec.source.startswith(BUILT_IN_PREFIX):
        name, names = spec.source.removeprefix(BUILT_IN_PREFIX), ", ".join(BUILTIN)
        built_in = load_builtin(name, spec)
        if built_in is None:
            near = did_you_mean(name, BUILTIN, BUILT_IN_PREFIX)
            raise BadInputError("camera", repr(spec.source), f"{BUILT_IN_PREFIX}{{{names}}} or a file", near)
        return built_in
    path = base / spec.source
    guess = detect(path, spec.up_axis, spec.axes) if spec.format == "auto" else Guess(spec.format, "")
    if not (path.is_dir() and guess.kind in FOLDERS):
        require_file(path, EXPECTED)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # non-finite values are left out later
        raw = _read(guess.kind, path, spec)
        _require_camera(path, raw, guess.kind, spec)
        said = () if spec.axes == AUTO else (f"axes of a pose: {spec.axes}, as given",)
        turns = raw.turns @ _axes(guess.kind, spec.axes)
        camera = path_from_recording(replace(raw, turns=turns, notes=(*raw.notes, *said)), str(path), spec)
    reason = guess.reason or "as given"
    taken = f"taken for {camera.detected.format}: {reason}"
    return replace(camera, notes=(*camera.notes, taken), detected=replace(camera.detected, reason=reason))
