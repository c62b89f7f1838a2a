"""Loads the camera of a scene: a built-in one by name, or a file.

Rule: the scene says the format, else the file's content does (`detect.py`), and a note says which and why.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from trilane.errors import BadInputError
from trilane.files import require_file
from trilane.near_miss import did_you_mean
from trilane.scene.camera.arkit import load_arkit
from trilane.scene.camera.builtin import BUILTIN, load_builtin
from trilane.scene.camera.colmap import load_colmap
from trilane.scene.camera.detect import EXPECTED, Guess, detect
from trilane.scene.camera.euroc import load_euroc
from trilane.scene.camera.kitti import load_kitti
from trilane.scene.camera.nerf import load_nerf
from trilane.scene.camera.path import CameraPath
from trilane.scene.camera.record3d import load_record3d
from trilane.scene.camera.recorded import RawCamera, path_from_recording
from trilane.scene.camera.stray import load_stray
from trilane.scene.camera.tum import load_tum
from trilane.scene.schema import CameraSpec

PREFIX = "builtin:"

#: Readers of a path and the scene's rate.
_READERS: dict[str, Callable[[Path, float | None], RawCamera]] = {
    "arkit": load_arkit,
    "colmap": load_colmap,
    "euroc": load_euroc,
    "kitti": load_kitti,
    "nerf": load_nerf,
    "record3d": load_record3d,
    "stray": load_stray,
    "tum": load_tum,
}
#: Formats that may be folders.
FOLDERS = ("colmap", "nerf", "record3d", "stray")


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
    guess = detect(path, spec.up_axis) if spec.format == "auto" else Guess(spec.format, "")
    if not (path.is_dir() and guess.kind in FOLDERS):
        require_file(path, EXPECTED)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # what is not finite is left out afterwards
        raw = _READERS[guess.kind](path, spec.rate_hz)
        camera = path_from_recording(raw, str(path), spec)
    reason = guess.reason or "as given"
    taken = f"taken for {camera.detected.format}: {reason}"
    return replace(camera, notes=(*camera.notes, taken), detected=replace(camera.detected, reason=reason))
