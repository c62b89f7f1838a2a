"""The accuracy of a run itself: some of the pictures that it presented, against the reference path.

Rule: what is compared is what was presented, kept without loss by the present stage; nothing is made a second time but
the reference. Frames with nobody in view are left out. Figures are of the region that holds the avatars; the IoU is of
where the picture differs from its background.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np

from trilane.arrays import F64, U8, Mask
from trilane.errors import TrilaneError
from trilane.stages.cpu.kept_frames import kept_frames

if TYPE_CHECKING:
    from trilane.apps.experiments.picture_errors import ErrorFigures
    from trilane.stages.configure import Checked

AGAINST = "the reference path: float64 body and raster, FP32 network"
STEPS = 255


def asked_frames(total: int, count: int) -> tuple[int, ...]:
    """The numbers of at most `count` of `total` frames, evenly spread, each in the middle of its share."""
    number = min(count, total)
    return tuple((2 * index + 1) * total // (2 * number) for index in range(number))


def check_run(checked: Checked, folder: Path, told: Callable[[int, int], None] = lambda *_: None) -> dict[str, Any]:
    """The frames that were kept in `folder`, against the reference path of the scene in `checked`.

    `told`: how many of how many are done. The result is `check` of report.json.
    Raises TrilaneError when no frame with somebody in view was kept, MissingPartError, BadInputError.
    """
    from trilane.apps.experiments.picture_errors import figures
    from trilane.apps.experiments.reference_path import ReferencePath
    from trilane.apps.experiments.scene_pictures import around

    files = kept_frames(folder)
    found: dict[int, ErrorFigures] = {}
    path = ReferencePath(checked) if files else None
    for done, (number, file) in enumerate(files.items()):
        assert path is not None
        moment = path.moment(number)
        if moment.boxes:
            picture, reference = np.load(file, allow_pickle=False), moment.frame(frozenset())
            masks = [differs(image, moment.background) for image in (picture, _bytes(reference.picture))]
            part = around(moment.boxes, path.output)
            found[number] = figures(
                picture[part] / STEPS, reference.picture[part], mask=masks[0], reference_mask=masks[1]
            )
        told(done + 1, len(files))
    if not found:
        raise TrilaneError("none of the frames that were kept shows an avatar")
    return summed_up(found)


def summed_up(found: Mapping[int, ErrorFigures]) -> dict[str, Any]:
    """`check` of report.json of the figures of frames, by number."""
    errors = list(found.values())
    ssim = [error.ssim for error in errors if error.ssim is not None]
    return {
        "frames": len(errors),
        "psnr_db": fmean(error.psnr_db for error in errors),
        "worst_psnr_db": min(error.psnr_db for error in errors),
        "mae": fmean(error.mae for error in errors),
        "ssim": fmean(ssim) if ssim else None,
        "flip": fmean(error.flip for error in errors),
        "iou": fmean(error.iou for error in errors if error.iou is not None),
        "against": AGAINST,
        "numbers": tuple(found),
    }


def differs(picture: U8, background: U8) -> Mask:
    """(h,w): where `picture` (h,w,3) is not its `background`."""
    return np.asarray((picture != background).any(axis=2))


def _bytes(picture: F64) -> U8:
    return np.asarray(np.rint(picture * STEPS), np.uint8)
