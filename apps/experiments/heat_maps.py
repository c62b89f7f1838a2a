"""Heat maps of a picture's error: the picture, the reference, and their difference with a colour bar.

Rule: a difference is the mean over the colours of its size, times a power of two that is written on it; what is beyond
the bar has the bar's last colour.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from trilane.arrays import F64, U8
from trilane.writing import write_bytes

#: The bar's colours from no difference to the largest: black, violet, red, orange, pale yellow.
COLOURS = np.array([(0, 0, 4), (87, 16, 110), (188, 55, 84), (249, 142, 9), (252, 255, 164)], np.float64)
LARGEST_FACTOR = 1024
#: So much of the pixels has to be on the bar.
ON_THE_BAR = 0.999
#: A panel's longer side is enlarged by a whole number to at least so many pixels.
LEAST_SIDE_PX = 320
BORDER_PX, LINE_PX, BAR_PX, FONT_PX, SCALE_WIDTH_PX = 8, 18, 16, 13, 56


def write_heat_map(file: Path, title: str, picture: F64, reference: F64) -> None:
    """Write `heat_map` as the PNG `file`. Raises BadInputError."""
    content = io.BytesIO()
    Image.fromarray(heat_map(title, picture, reference)).save(content, "PNG")
    write_bytes(file, content.getvalue())


def heat_map(title: str, picture: F64, reference: F64) -> U8:
    """(h,w,3): `picture`, `reference`, both (h,w,3) sRGB in 0..1, their difference, and the colours' bar."""
    difference = np.abs(picture - reference).mean(axis=2)
    factor = shown_factor(difference)
    times = max(1, -(-LEAST_SIDE_PX // max(difference.shape)))
    panels = [np.rint(picture * 255), np.rint(reference * 255), coloured(difference * factor)]
    high, wide = (side * times for side in difference.shape)
    sheet = Image.new("RGB", (3 * wide + 5 * BORDER_PX + SCALE_WIDTH_PX + BAR_PX, high + 3 * LINE_PX + BORDER_PX))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(FONT_PX)
    top = 2 * LINE_PX
    for number, panel in enumerate(panels):
        left = BORDER_PX + number * (wide + BORDER_PX)
        enlarged = panel.astype(np.uint8).repeat(times, axis=0).repeat(times, axis=1)
        sheet.paste(Image.fromarray(enlarged), (left, top))
        name = ("picture", "reference", f"difference x {factor}")[number]
        draw.text((left, LINE_PX), name, font=font)
    mean, largest = difference.mean() * 255, difference.max() * 255
    draw.text((BORDER_PX, 0), f"{title}: mean {mean:.3g}, largest {largest:.3g} of 255", font=font)
    _draw_bar(sheet, draw, (BORDER_PX + 3 * (wide + BORDER_PX), top, high), 255 / factor, font)
    return np.asarray(sheet)


def shown_factor(difference: F64) -> int:
    """The largest power of two, times which nearly all of `difference`, in 0..1, is at most 1; 1 when nothing differs.

    It is at most `LARGEST_FACTOR`.
    """
    most = float(np.quantile(difference, ON_THE_BAR))
    if most == 0.0:
        return 1
    return int(2 ** np.floor(np.log2(np.clip(1 / most, 1, LARGEST_FACTOR))))


def coloured(values: F64) -> U8:
    """(..., 3): the bar's colours of `values`, 0 to 1; larger ones have the last."""
    place = np.clip(values, 0, 1) * (len(COLOURS) - 1)
    channels = [np.interp(place, np.arange(len(COLOURS)), COLOURS[:, channel]) for channel in range(3)]
    return np.rint(np.stack(channels, axis=-1)).astype(np.uint8)


def _draw_bar(sheet: Image.Image, draw: Any, place: tuple[int, int, int], most: float, font: Any) -> None:
    """The colour bar at `place` (left, top, height), with what its ends and its middle stand for, of 255."""
    left, top, height = place
    bar = coloured(np.linspace(1, 0, height))[:, None].repeat(BAR_PX, axis=1)
    sheet.paste(Image.fromarray(bar), (left, top))
    for share in (0.0, 0.5, 1.0):
        row = top + round((1 - share) * (height - FONT_PX))
        draw.text((left + BAR_PX + BORDER_PX // 2, row), f"{most * share:.3g}", font=font)
