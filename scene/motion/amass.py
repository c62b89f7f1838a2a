"""Reads AMASS `.npz` files: `poses` of 156 columns (SMPL-H) or 165 (SMPL-X), `trans`, `betas` and a frame rate.

Rule: joints that SMPL-H does not have (jaw, eyes) are at rest; all other keys are ignored. Layout:
https://amass.is.tue.mpg.de.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.errors import BadInputError
from trilane.files import as_numbers, read_npz
from trilane.scene.detected import Detected
from trilane.scene.motion.motion import JOINTS, REST_PELVIS
from trilane.scene.motion.recorded import RawMotion
from trilane.scene.motion.smplx_npy import hands_note

EXPECTED = "AMASS motion: `poses` (T, 156) or (T, 165), `trans` (T, 3), a frame rate"
RATE_KEYS = ("mocap_framerate", "mocap_frame_rate")
#: Number of columns of `poses` -> the SMPL-X joints that they are, in order.
COLUMNS = {
    156: (*range(22), *range(25, JOINTS)),
    165: tuple(range(JOINTS)),
}
NAMES = {156: "SMPL-H", 165: "SMPL-X"}
MAX_BETAS = 400


def load_amass(path: Path) -> RawMotion:
    """Read `path`. Raises BadInputError naming the key that is missing or has the wrong shape."""
    arrays = read_npz(path, ("poses", "trans", "betas", *RATE_KEYS), EXPECTED)
    if "poses" not in arrays:
        raise BadInputError(path, "no key `poses`", EXPECTED)
    poses, width = _poses(path, arrays["poses"])
    rate, key = _rate(path, arrays)
    translation = _translation(path, arrays.get("trans"), len(poses))
    betas = _betas(path, arrays.get("betas"))
    notes = (
        f"AMASS .npz ({NAMES[width]}, {width} columns), {len(poses)} frames at {rate:g}/s ({key})",
        f"hands: {hands_note(poses)}",
        f"betas: {'none' if betas is None else len(betas)}",
        *(("no `trans`: stays in place",) if translation is None else ()),
    )
    detected = Detected(f"AMASS .npz ({NAMES[width]})", f"`poses` of {width} columns", unit="m", rate=f"by `{key}`")
    return RawMotion(np.arange(len(poses)) / rate, poses, translation, betas, "z", notes, detected=detected)


def _poses(path: Path, array: NDArray[Any]) -> tuple[NDArray[np.float64], int]:
    if array.ndim != 2 or array.shape[1] not in COLUMNS or not len(array):
        raise BadInputError(f"{path}[poses]", f"shape {array.shape}", "(T, 156) or (T, 165), T at least 1")
    numbers = as_numbers(f"{path}[poses]", array, "numbers").reshape(len(array), -1, 3)
    poses = np.zeros((len(array), JOINTS, 3))
    poses[:, COLUMNS[array.shape[1]]] = numbers
    return poses, array.shape[1]


def _rate(path: Path, arrays: dict[str, NDArray[Any]]) -> tuple[float, str]:
    for key in RATE_KEYS:
        if key in arrays:
            value = as_numbers(f"{path}[{key}]", arrays[key], "one number")
            if value.size != 1 or not 1 <= value.item() <= 1000:
                raise BadInputError(f"{path}[{key}]", str(value.tolist()), "one rate from 1 to 1000 frames/s")
            return float(value.item()), key
    raise BadInputError(path, "no frame rate", f"a key `{RATE_KEYS[0]}` or `{RATE_KEYS[1]}`")


def _translation(path: Path, array: NDArray[Any] | None, frames: int) -> NDArray[np.float64] | None:
    if array is None:
        return None
    if array.shape != (frames, 3):
        raise BadInputError(f"{path}[trans]", f"shape {array.shape}", f"({frames}, 3), a row for each of `poses`")
    return REST_PELVIS + as_numbers(f"{path}[trans]", array, "numbers")


def _betas(path: Path, array: NDArray[Any] | None) -> NDArray[np.float64] | None:
    if array is None:
        return None
    betas = as_numbers(f"{path}[betas]", array, "numbers").reshape(-1)
    if betas.size > MAX_BETAS or not np.isfinite(betas).all():
        raise BadInputError(f"{path}[betas]", f"{betas.size} values, some not finite or too many", "finite numbers")
    return betas
