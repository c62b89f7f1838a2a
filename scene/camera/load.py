"""A scene's `camera` entry to a CameraPath: a built-in name or a file, by its format.

Rule: JSON is NeRF's; of the text tables, the count of columns tells which.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from trilane.errors import BadInputError
from trilane.files import require_file
from trilane.scene.camera import arkit, tum
from trilane.scene.camera.arkit import load_arkit
from trilane.scene.camera.builtin import ORBITS, load_builtin
from trilane.scene.camera.nerf import load_nerf
from trilane.scene.camera.path import CameraPath
from trilane.scene.camera.recorded import RawCamera, finish
from trilane.scene.camera.text_table import column_count
from trilane.scene.camera.tum import load_tum
from trilane.scene.schema import CameraSpec

PREFIX = "builtin:"
EXPECTED = "a camera file: an ARKit log, a TUM trajectory or a NeRF transforms.json"

_READERS: dict[str, Callable[[Path], RawCamera]] = {"arkit": load_arkit, "tum": load_tum, "nerf": load_nerf}
_COLUMNS = {arkit.COLUMNS: "arkit", tum.COLUMNS: "tum"}


def load_camera(spec: CameraSpec, base: Path) -> CameraPath:
    """The camera that `spec.source` names; a relative path starts at `base`.

    Raises BadInputError when there is no such camera or the file is unusable.
    """
    if spec.source.startswith(PREFIX):
        path_of = load_builtin(spec.source.removeprefix(PREFIX), spec)
        if path_of is None:
            raise BadInputError("camera", repr(spec.source), f"{PREFIX}{{{', '.join(ORBITS)}}} or a file")
        return path_of
    path = base / spec.source
    require_file(path, EXPECTED)
    kind = _kind(path) if spec.format == "auto" else spec.format
    with np.errstate(over="ignore", invalid="ignore"):  # numbers that are not finite are `repair`'s concern
        return finish(_READERS[kind](path), str(path), spec)


def _kind(path: Path) -> str:
    if path.suffix.lower() == ".json":
        return "nerf"
    columns = column_count(path, EXPECTED)
    if columns not in _COLUMNS:
        raise BadInputError(path, f"{columns} columns", f"{arkit.COLUMNS} (ARKit) or {tum.COLUMNS} (TUM)")
    return _COLUMNS[columns]
