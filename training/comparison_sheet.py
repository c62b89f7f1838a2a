"""Sheets that compare pictures: the ground truth and what each painter made of it, side by side.

Rule: all pictures are before the same scenery, in which a transparent person shows, and none is enlarged.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilane.training.backgrounds import SIDE, scenes
from trilane.training.evaluate import Evaluated
from trilane.training.image_error import over

SHEET_CELL = (256, 192)


def worst_sheet(samples: Sequence[Evaluated], painters: Sequence[str]) -> NDArray[np.uint8]:
    """A row for each of `samples`: (height, width, 3) uint8."""
    return np.vstack([_cells(sample, painters) for sample in samples])


def _cells(sample: Evaluated, painters: Sequence[str]) -> NDArray[np.uint8]:
    """The ground truth and the pictures of `painters` side by side."""
    return side_by_side((sample.truth, *(sample.pictures[name] for name in painters)))


def side_by_side(pictures: Iterable[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """`pictures` (h,w,4), each in a cell: (height, width, 3) uint8."""
    return np.hstack([_cell(picture) for picture in pictures])


def _cell(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    behind = scenes()[0][np.arange(picture.shape[0])[:, None] % SIDE, np.arange(picture.shape[1]) % SIDE]
    image = Image.fromarray((over(picture, behind) * 255).round().astype(np.uint8))
    image.thumbnail(SHEET_CELL[::-1], Image.Resampling.LANCZOS)
    cell = np.full((*SHEET_CELL, 3), 128, np.uint8)
    top, left = (SHEET_CELL[0] - image.height) // 2, (SHEET_CELL[1] - image.width) // 2
    cell[top : top + image.height, left : left + image.width] = np.asarray(image)
    return cell
