"""A sheet that shows how the fits of a capture lie over its frames.

Rule: the drawn body is red and what the mask has beyond it is blue, over the frame; each cell says its frame and IoU.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from trilane.arrays import F32, U8
from trilane.training.capture.capture import HALF
from trilane.training.capture.check import CheckedFrame

COLUMNS, MOST_CELLS = 4, 16
CELL_WIDTH = 320
BODY_COLOUR, MASK_COLOUR = (255.0, 0.0, 0.0), (0.0, 64.0, 255.0)


def chosen(frames: Sequence[CheckedFrame], bad: Sequence[CheckedFrame]) -> list[CheckedFrame]:
    """Frames for the sheet: the worst of those that are `bad`, in half of it at most, then others at even steps."""
    worst = list(bad[: MOST_CELLS // 2])
    others = [frame for frame in frames if frame not in bad]
    room = min(MOST_CELLS - len(worst), len(others))
    return worst + [others[round(place)] for place in np.linspace(0, len(others) - 1, room)]


def overlaid(picture: U8, uv: F32) -> U8:
    """A frame with its mask as alpha (h,w,4), and the body of the UV image (h,w,3) over it: (h,w,3)."""
    result = picture[..., :3].astype(np.float64)
    drawn, mask = uv[..., 2] > 0, picture[..., 3] >= HALF
    for where, colour in ((drawn, BODY_COLOUR), (mask & ~drawn, MASK_COLOUR)):
        result[where] = (result[where] + colour) / 2
    return np.round(result).astype(np.uint8)


def sheet(cells: Sequence[tuple[str, U8]]) -> Image.Image:
    """Pictures (h,w,3) of one size in rows, each under its line of text."""
    height, width = cells[0][1].shape[:2]
    size = (CELL_WIDTH, max(1, round(CELL_WIDTH * height / width)))
    columns = min(COLUMNS, len(cells))
    result = Image.new("RGB", (columns * size[0], -(-len(cells) // columns) * size[1]))
    draw = ImageDraw.Draw(result)
    for number, (text, picture) in enumerate(cells):
        row, column = divmod(number, columns)
        corner = (column * size[0], row * size[1])
        result.paste(Image.fromarray(picture).resize(size, Image.Resampling.BOX), corner)
        draw.text((corner[0] + 4, corner[1] + 2), text, fill="white", stroke_width=1, stroke_fill="black")
    return result
