"""The accuracy of a run itself: some of the pictures that it presented, against the truth and against the float path.

Rule: what is compared is what was presented, kept without loss by the present stage; nothing is made a second time but
what it is compared with. The truth comes first where it is known, for it is what a person would see without Trilane;
the float path tells what integers, rasters and plans cost, and nothing of what the network cannot paint. Frames with
nobody in view are left out. Figures are of the region that holds the avatars; the IoU is of where the picture differs
from its background.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np

from trilane.arrays import F64, U8, Mask
from trilane.bench.lib.picture_error import psnr_of_frames, require_metrics
from trilane.errors import TrilaneError

if TYPE_CHECKING:
    from trilane.apps.experiments.picture_errors import ErrorFigures
    from trilane.avatars.bundle import Bundle
    from trilane.stages.configure import Checked

TRUTH = "the truth: the clothed body that the avatar was trained on"
FLOAT_PATH = "the float path: float64 body and raster, FP32 network"
STEPS = 255


def asked_frames(total: int, count: int) -> tuple[int, ...]:
    """The numbers of at most `count` of `total` frames, evenly spread, each in the middle of its share."""
    number = min(count, total)
    return tuple((2 * index + 1) * total // (2 * number) for index in range(number))


def require_parts(bundles: Iterable[Bundle]) -> None:
    """Raises MissingPartError for a library that a check of runs with avatars `bundles` needs, and is not here."""
    from trilane.bench.lib.full_network import require_float_network

    require_metrics()
    for bundle in bundles:
        require_float_network(bundle)


def check_run(checked: Checked, folder: Path, told: Callable[[int, int], None] = lambda *_: None) -> dict[str, Any]:
    """The frames that were kept in `folder`, against the truth, where it is known, and the float path of the scene.

    `told`: how many of how many are done. The result is `check` of report.json.
    Raises TrilaneError when no frame with somebody in view was kept, MissingPartError, BadInputError.
    """
    from trilane.apps.experiments.picture_errors import figures
    from trilane.apps.experiments.reference_path import ReferencePath
    from trilane.apps.experiments.scene_pictures import around
    from trilane.bench.lib.full_picture import true_pictures
    from trilane.stages.cpu.present import kept_frames

    files = kept_frames(folder)
    numbers: list[int] = []
    found: dict[str, list[ErrorFigures]] = {}
    path = ReferencePath(checked) if files else None
    true = true_pictures(path.cast, path.gl) if path is not None else None
    for done, (number, file) in enumerate(files.items()):
        assert path is not None
        moment = path.moment(number)
        if moment.boxes:
            numbers.append(number)
            picture, part = np.load(file, allow_pickle=False), around(moment.boxes, path.output)
            wanted = {} if true is None else {TRUTH: true.frame(number, moment.background) / STEPS}
            for against, other in {**wanted, FLOAT_PATH: moment.frame(frozenset()).picture}.items():
                masks = [differs(image, moment.background) for image in (picture, _bytes(other))]
                error = figures(picture[part] / STEPS, other[part], mask=masks[0], reference_mask=masks[1])
                found.setdefault(against, []).append(error)
        told(done + 1, len(files))
    if not found:
        raise TrilaneError("none of the frames that were kept shows an avatar")
    first, *rest = (summed_up(against, errors) for against, errors in found.items())
    return {**first, "frames": len(numbers), "numbers": tuple(numbers), "float_path": rest[0] if rest else None}


def summed_up(against: str, errors: Sequence[ErrorFigures]) -> dict[str, Any]:
    """What report.json says of frames `against` something."""
    ssim = [error.ssim for error in errors if error.ssim is not None]
    return {
        "against": against,
        **psnr_of_frames([error.psnr_db for error in errors]),
        "mae": fmean(error.mae for error in errors),
        "ssim": fmean(ssim) if ssim else None,
        "flip": fmean(error.flip for error in errors),
        "iou": fmean(error.iou for error in errors if error.iou is not None),
    }


def differs(picture: U8, background: U8) -> Mask:
    """(h,w): where `picture` (h,w,3) is not its `background`."""
    return np.asarray((picture != background).any(axis=2))


def _bytes(picture: F64) -> U8:
    return np.asarray(np.rint(picture * STEPS), np.uint8)
