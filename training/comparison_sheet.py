"""The sheet that compares pictures: ground truth, float network and integer network side by side.

Rule: one row per band with two samples, those of median and of upper-quartile PSNR, all pictures over mid-grey.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilane.training.evaluate import Evaluated
from trilane.training.image_error import over_grey
from trilane.training.sample_renderer import BAND_NAMES

SHEET_CELL = (256, 192)


def comparison_sheet(floats: list[Evaluated], integers: list[Evaluated]) -> NDArray[np.uint8]:
    """The sheet, (height, width, 3) uint8, of the same samples painted by both networks."""
    rows = []
    for band in BAND_NAMES:
        places = [place for place, sample in enumerate(integers) if sample.band == band]
        by_error = sorted(places, key=lambda place: integers[place].error.psnr_db)
        cells = []
        for place in (by_error[len(by_error) // 2], by_error[-len(by_error) // 4]):
            cells += [floats[place].truth, floats[place].picture, integers[place].picture]
        rows.append(np.hstack([_cell(picture) for picture in cells]))
    return np.vstack(rows)


def _cell(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    image = Image.fromarray((over_grey(picture) * 255).round().astype(np.uint8))
    image.thumbnail(SHEET_CELL[::-1], Image.Resampling.LANCZOS)
    cell = np.full((*SHEET_CELL, 3), 128, np.uint8)
    top, left = (SHEET_CELL[0] - image.height) // 2, (SHEET_CELL[1] - image.width) // 2
    cell[top : top + image.height, left : left + image.width] = np.asarray(image)
    return cell
