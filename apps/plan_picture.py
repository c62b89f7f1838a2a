"""The plan as a picture: the bodies' vertices, their rectangles and the tensor's, a frame of each phase.

Rule: it shows what was decided, not what the run paints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from trilane.apps.scene_plan import PlannedFrame, ScenePlan
from trilane.scene.crop import Rect
from trilane.shapes import Shape
from trilane.writing import write_atomically

MOST_FRAMES = 9
GROUND, BODY, MESH, TENSOR, TEXT = (24, 26, 30), (150, 156, 166), (92, 176, 255), (255, 172, 64), (235, 235, 235)


def draw_plan(plan: ScenePlan, frames: Sequence[PlannedFrame], file: Path) -> None:
    """Write a sheet of at most `MOST_FRAMES` of `frames`, evenly spread, as PNG to `file`, which is replaced whole."""
    step = max(1, math.ceil(len(frames) / MOST_FRAMES))
    tiles = [_tile(plan, planned) for planned in frames[::step]]
    columns = math.ceil(math.sqrt(len(tiles)))
    height, width = plan.output
    sheet = Image.new("RGB", (columns * width, math.ceil(len(tiles) / columns) * height))
    for number, tile in enumerate(tiles):
        sheet.paste(tile, (number % columns * width, number // columns * height))
    with write_atomically(file) as draft:
        sheet.save(draft, format="PNG")


def _tile(plan: ScenePlan, planned: PlannedFrame) -> Image.Image:
    height, width = plan.output
    pixels = np.full((height, width, 3), GROUND, np.uint8)
    for avatar in planned.plan.seen:
        places = plan.places(planned.frame, avatar)
        columns, rows = places[np.isfinite(places).all(axis=1)].astype(int).T
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        pixels[rows[inside], columns[inside]] = BODY
    image = Image.fromarray(pixels)
    draw = ImageDraw.Draw(image)
    for avatar, one in planned.plan.seen.items():
        draw.rectangle(_box(planned.crops[avatar], plan.output), outline=TENSOR)
        draw.rectangle(_box(one.rect, plan.output), outline=MESH)
    draw.text((6, 4), _label(planned), fill=TEXT)
    return image


def _box(rect: Rect, output: Shape) -> tuple[float, float, float, float]:
    height, width = output
    left, right = (rect.x0 + 1) / 2 * width, (rect.x1 + 1) / 2 * width - 1
    top, bottom = (1 - rect.y1) / 2 * height, (1 - rect.y0) / 2 * height - 1
    return left, top, max(right, left), max(bottom, top)


def _label(planned: PlannedFrame) -> str:
    shape = planned.plan.shape
    if shape is None:
        return f"frame {planned.frame}: nobody in view"
    density = "" if planned.plan.density is None else f", density {planned.plan.density:.2f}"
    return f"frame {planned.frame}: tensor {shape[0]}x{shape[1]}{density}"
