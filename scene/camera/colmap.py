"""COLMAP sparse models: a folder with `cameras` and `images`, as `.txt` or as `.bin`.

Rule: poses are world to camera, axes optical (x right, y down, looks along +Z); views are taken in the order of their
photos' names. The map has no unit, no levelled axis and no times. Distortion is left out and said.
Format: https://colmap.github.io/format.html, https://colmap.github.io/cameras.html.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from trilane.errors import BadInputError
from trilane.scene.camera.colmap_binary import read_cameras_binary, read_images_binary
from trilane.scene.camera.colmap_model import ColmapCamera, ColmapImage
from trilane.scene.camera.colmap_text import read_cameras_text, read_images_text
from trilane.scene.camera.distortion import distortion_note
from trilane.scene.camera.map_frame import Unit
from trilane.scene.camera.recorded import OPENGL_FROM_OPTICAL, RawCamera
from trilane.scene.camera.untimed import times_without
from trilane.scene.detected import Detected
from trilane.scene.lens import Lens
from trilane.scene.rotations import matrix_from_quat, normalised

EXPECTED = "a COLMAP model: cameras.txt and images.txt, or cameras.bin and images.bin"
MAX_VIEWS = 100_000
#: Where the model is below the folder of a project.
BELOW = (Path(), Path("sparse/0"), Path("sparse"), Path("0"), Path("colmap/sparse/0"))
ENDINGS = (".bin", ".txt")


def model_in(folder: Path) -> tuple[Path, str] | None:
    """The folder at or below `folder` that has a model, and the ending of its files."""
    for below in BELOW:
        for ending in ENDINGS:
            if all((folder / below / f"{name}{ending}").is_file() for name in ("cameras", "images")):
                return folder / below, ending
    return None


def load_colmap(path: Path, rate_hz: float | None = None) -> RawCamera:
    """Read `path`, a folder or a file of the model. `rate_hz`: of the scene. Raises BadInputError naming the file."""
    found = model_in(path if path.is_dir() else path.parent)
    if found is None:
        raise BadInputError(path, "no COLMAP model", EXPECTED)
    folder, ending = found
    cameras, images = _read(folder, ending)
    if not 1 <= len(images) <= MAX_VIEWS:
        raise BadInputError(folder / f"images{ending}", f"{len(images)} images", f"1 to {MAX_VIEWS}")
    views = sorted(images, key=lambda image: _natural(image.name))
    lenses, distorted = _lenses(folder / f"images{ending}", views, cameras)
    world_to_camera = matrix_from_quat(normalised(np.array([image.quat for image in views])))
    turns = np.swapaxes(world_to_camera, 1, 2)
    places = -(turns @ np.array([image.shift for image in views])[:, :, None])[:, :, 0]
    turns = turns @ OPENGL_FROM_OPTICAL
    times, rate = times_without(turns, rate_hz)
    models = " and ".join(sorted({cameras[image.camera].model for image in views}))
    notes = (f"COLMAP model, {len(views)} views by {len(cameras)} cameras ({models}), no times: {rate}", *distorted)
    names = tuple(image.name for image in views)
    detected = Detected("COLMAP model", f"cameras{ending} and images{ending}", rate=f"no times in the format: {rate}")
    source = "by the model" if len(lenses) == 1 else "by the model, view by view"
    return RawCamera(
        times, turns, places, "-y", lenses, source, notes, lambda k: names[k], detected, names, unit=Unit.NONE
    )


def _read(folder: Path, ending: str) -> tuple[dict[int, ColmapCamera], list[ColmapImage]]:
    cameras, images = folder / f"cameras{ending}", folder / f"images{ending}"
    if ending == ".bin":
        return read_cameras_binary(cameras), read_images_binary(images)
    return read_cameras_text(cameras), read_images_text(images)


def _natural(name: str) -> list[tuple[int, str]]:
    """A key by which `img10` comes after `img9`."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d{1,18})", name)]


def _lenses(
    where: Path, views: Sequence[ColmapImage], cameras: Mapping[int, ColmapCamera]
) -> tuple[tuple[Lens, ...], tuple[str, ...]]:
    """One lens for all views or one for each, and notes on what is left out of them."""
    for image in views:
        if image.camera not in cameras:
            raise BadInputError(f"{where}: {image.name}", f"camera {image.camera}", "a camera of the model")
    used = dict.fromkeys(image.camera for image in views)
    notes = distortion_note(cameras[number].bent() for number in used)
    lenses = {number: cameras[number].lens() for number in used}
    if len(set(lenses.values())) == 1:
        return (next(iter(lenses.values())),), notes
    return tuple(lenses[image.camera] for image in views), notes
