"""Tells the format of a camera file or folder by its content.

Rule: names of files decide only what is a folder of several; in a text the column names decide, then the number of
columns, then commas and the size of the times. Every guess comes with its reason.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from trilane.errors import BadInputError
from trilane.files import read_text, require_file
from trilane.scene.camera import arkit, colmap, kitti, nerf, record3d, stray, tum
from trilane.scene.camera.text_table import Layout, layout_of

EXPECTED = (
    "a camera: an ARKit log, a TUM, KITTI or EuRoC trajectory, a transforms.json, odometry.csv of Stray Scanner, "
    "metadata.json of Record3D or a folder of COLMAP"
)
COLMAP_FILES = tuple(f"{name}{ending}" for name in ("cameras", "images") for ending in colmap.ENDINGS)


class Guess(NamedTuple):
    """`kind`: as the scene's `format` has it. `reason`: part of a sentence."""

    kind: str
    reason: str


#: Columns of what others save -> how it becomes usable.
OTHERS = {
    1: "part the numbers by blanks or commas",
    7: "if these are rotation vectors, as in ARKitScenes, or a place and a quaternion: write time, place and "
    "quaternion of each pose, camera to world, as TUM has them",
    16: "if these are 4x4 matrices, as of Replica: leave the last four columns out, which are 0 0 0 1, for KITTI's 12",
}


def detect(path: Path) -> Guess:
    """The format of `path`. Raises BadInputError when it is none."""
    if path.is_dir():
        return _of_folder(path)
    require_file(path, EXPECTED)
    if path.name in COLMAP_FILES and colmap.model_in(path.parent) is not None:
        return Guess("colmap", "a file of a COLMAP model")
    if path.suffix.lower() == ".json" or read_text(path, EXPECTED).lstrip()[:1] == "{":
        return _of_json(path)
    return _of_table(path, layout_of(path, EXPECTED))


def _of_json(path: Path) -> Guess:
    text = read_text(path, EXPECTED)
    if '"frames"' not in text and '"poses"' in text:
        return Guess("record3d", "JSON with `poses` and no `frames`")
    return Guess("nerf", "it is JSON")


def _of_folder(path: Path) -> Guess:
    found = colmap.model_in(path)
    if found is not None:
        return Guess("colmap", f"cameras{found[1]} and images{found[1]} in the folder")
    for kind, name in (("nerf", nerf.FILE), ("stray", stray.FILE), ("record3d", record3d.FILE)):
        if (path / name).is_file():
            return Guess(kind, f"{name} in the folder")
    remedy = "name the file of poses in it"
    raise BadInputError(
        path, f"a folder without {nerf.FILE}, {stray.FILE}, {record3d.FILE} and COLMAP's files", EXPECTED, remedy
    )


def _of_table(path: Path, layout: Layout) -> Guess:
    columns = layout.columns
    if layout.has_pose and "frame" in layout.names:
        return Guess("stray", "column names with a frame, a place and a quaternion")
    if layout.has_pose:
        scalar_first = layout.names.index("qw") < layout.names.index("qx")
        reason = f"column names with the quaternion's scalar {'first' if scalar_first else 'last'}"
        return Guess("euroc" if scalar_first and layout.is_ns else "tum", reason)
    if columns == arkit.COLUMNS:
        return Guess("arkit", f"{columns} columns: a time and a 3x4 matrix")
    if columns == kitti.COLUMNS:
        return Guess("kitti", f"{columns} columns: a 3x4 matrix without a time")
    if columns >= tum.COLUMNS and layout.has_commas and layout.is_ns:
        return Guess(
            "euroc", f"{columns} columns with commas and times in ns: the quaternion's scalar is taken to be first"
        )
    if columns == tum.COLUMNS:
        return Guess("tum", f"{columns} columns: the quaternion's scalar is taken to be last")
    counts = f"{tum.COLUMNS} (TUM, EuRoC), {kitti.COLUMNS} (KITTI) or {arkit.COLUMNS} (ARKit), or column names"
    raise BadInputError(path, f"{columns} columns", counts, OTHERS.get(columns, ""))
