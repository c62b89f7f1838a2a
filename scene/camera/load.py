"""Loads the camera of a scene: a built-in one by name, or a file.

Rule: a JSON file is NeRF's; the format of a text table is recognised by its number of columns.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from trilane.errors import BadInputError
from trilane.files import require_file
from trilane.near_miss import did_you_mean
from trilane.scene.camera import arkit, tum
from trilane.scene.camera.arkit import load_arkit
from trilane.scene.camera.builtin import BUILTIN, load_builtin
from trilane.scene.camera.nerf import load_nerf
from trilane.scene.camera.path import CameraPath
from trilane.scene.camera.recorded import RawCamera, path_from_recording
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
        built_in = load_builtin(spec.source.removeprefix(PREFIX), spec)
        if built_in is None:
            near = did_you_mean(spec.source.removeprefix(PREFIX), BUILTIN, PREFIX)
            raise BadInputError("camera", repr(spec.source), f"{PREFIX}{{{', '.join(BUILTIN)}}} or a file", near)
        return built_in
    path = base / spec.source
    require_file(path, EXPECTED)
    kind = _kind(path) if spec.format == "auto" else spec.format
    with np.errstate(over="ignore", invalid="ignore"):  # `usable_samples` leaves out what is not finite
        return path_from_recording(_READERS[kind](path), str(path), spec)


def _kind(path: Path) -> str:
    if path.suffix.lower() == ".json":
        return "nerf"
    columns = column_count(path, EXPECTED)
    if columns not in _COLUMNS:
        raise BadInputError(path, f"{columns} columns", f"{arkit.COLUMNS} (ARKit) or {tum.COLUMNS} (TUM)")
    return _COLUMNS[columns]
