"""Sheets of pictures side by side: which samples, in which order, how large, before what."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("skimage")

from trilane.training.backgrounds import scenes
from trilane.training.image_error import ImageError
from trilane.training.validate import Evaluated, worst_sheet

BANDS = ("far", "full_body", "upper_body", "face")
#: Height and width of a cell.
CELL = (256, 192)
PAINTERS = ("float", "ort")
ALPHA = ("alpha_inside", "alpha_edge", "alpha_outside", "see_through")


def evaluated(band: str, number: int, psnr_db: float, shape: tuple[int, int] = (64, 32)) -> Evaluated:
    """Its pictures have one grey each: ten times its number, one more for `float` and two more for `ort`."""

    def flat(grey: int) -> np.ndarray:
        return np.full((*shape, 4), (grey, grey, grey, 255), np.uint8)

    def error(value: float) -> ImageError:
        return ImageError(value, 0.0, {}, 0.0, ssim=1.0, iou=1.0, **dict.fromkeys(ALPHA, 0.0))

    pictures = {name: flat(10 * number + k) for k, name in enumerate(PAINTERS, start=1)}
    return Evaluated(number, band, flat(10 * number), pictures, {"float": error(-psnr_db), "ort": error(psnr_db)})


def cells(sheet: np.ndarray) -> list[list[int]]:
    """The grey in the middle of each cell."""
    rows, columns = sheet.shape[0] // CELL[0], sheet.shape[1] // CELL[1]
    return [[int(sheet[256 * r + 128, 192 * c + 96, 0]) for c in range(columns)] for r in range(rows)]


def test_a_small_picture_stands_in_the_middle_of_grey() -> None:
    sheet = worst_sheet([evaluated("far", 2, 1.0), evaluated("face", 7, 1.0)], ("ort",))
    assert cells(sheet) == [[20, 22], [70, 72]]
    cell = sheet[:256, :192]
    assert (cell[96:160, 80:112] == 20).all()
    assert (cell != 128).all(axis=2).sum() == 64 * 32, "all else is grey"


def test_a_large_picture_is_shrunk_into_its_cell() -> None:
    """512 x 96 to 256 x 48, and 64 x 768 to 16 x 192."""
    for shape, rows, columns in (
        ((512, 96), slice(0, 256), slice(72, 120)),
        ((64, 768), slice(120, 136), slice(0, 192)),
    ):
        cell = worst_sheet([evaluated("far", 2, 1.0, shape)], ())
        assert (cell[rows, columns] == 20).all()
        assert (cell != 128).any(axis=2).sum() == (256 * 48 if shape[0] == 512 else 16 * 192)


def test_what_is_transparent_shows_the_scenery() -> None:
    """The middle of a cell is pixel (32, 16) of a picture; black of alpha 127 lets 128 of 255 parts through."""
    sample = evaluated("far", 0, 1.0)
    sample.truth[..., 3] = 0
    sample.pictures["ort"][...] = (0, 0, 0, 127)
    behind = scenes()[0][32, 16, 0]
    assert cells(worst_sheet([sample], ("ort",))) == [[round(255 * behind), round(128 * behind)]]
