"""The block `overlay`: draws on a picture what networks found in it.

- `mask`: classes or scores; of three axes the smallest outer one is that of the channels. Of several channels the
  largest counts, and channel 0 is the background. One channel of floats counts above 0.5; one of whole numbers holds
  classes.
- `depth`: one channel, from its least (blue) to its largest number (red).
- `boxes`: rows of x0, y0, x1, y1 and maybe a score, in pixels of the picture, or from 0 to 1; a score of 0 draws
  nothing.

A mask is stretched over the picture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilane.arrays import F32, U8
from trilane.errors import BadInputError
from trilane.pipeline.stage import Arrays, PortedStage, UnitContext

FRAME, MASK, DEPTH, BOXES = "frame", "mask", "depth", "boxes"
LINE_PIXELS: Final = 2
BOX_COLOUR: Final = np.array([255, 220, 0], np.uint8)
CLASSES: Final = 256


def class_colours() -> U8:
    """Return a colour for each class, (CLASSES, 3), distinct for neighbours; that of class 0 is never drawn."""
    hues = np.arange(CLASSES) * 0.618034 % 1  # the golden ratio spreads them
    waves = [np.clip(np.abs((hues * 6 + shift) % 6 - 3) - 1, 0, 1) for shift in (0, 4, 2)]
    return np.asarray(np.stack(waves, axis=1) * STEPS, np.uint8)


STEPS: Final = 255
OWN_CODE: Final = "a stage with python before it can bring them into this form"


class Overlay(PortedStage):
    """Writes a picture with what was found in it. Raises BadInputError for a port of another form."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(settings)
        self._alpha = float(self.settings.keys.get("alpha", 0.5))
        self._colours = class_colours()
        types = {each.name or FRAME: each.type for each in self.reads}
        self._height, self._width = types[FRAME].shape[:2]
        for name in (MASK, DEPTH):
            if name in types and len([size for size in types[name].shape if size > 1]) not in (2, 3):
                where, found = f"{self.settings.where}.in.{name}", f"{types[name]}"
                raise BadInputError(where, found, "a height and a width, and maybe channels", OWN_CODE)
        if BOXES in types and types[BOXES].shape[-1] < 4:
            where, found = f"{self.settings.where}.in.boxes", f"{types[BOXES]}"
            raise BadInputError(where, found, "rows of 4 numbers or more", OWN_CODE)

    def work(self, frame: int, arrays: Sequence[NDArray[Any] | None], outputs: Arrays) -> Mapping[str, float]:  # noqa: ARG002
        found = {each.name or FRAME: array for each, array in zip(self.reads, arrays, strict=True)}
        picture = np.array(found[FRAME])
        if (depth := found.get(DEPTH)) is not None:
            self._blend(picture, _depth_colours(self._stretched(_channels(depth)[0].astype(np.float32))))
        if (mask := found.get(MASK)) is not None:
            classes = self._stretched(_classes(mask).astype(np.float32)).astype(np.uint8)
            self._blend(picture, self._colours[classes], classes > 0)
        if (boxes := found.get(BOXES)) is not None:
            self._draw(picture, boxes.reshape(-1, boxes.shape[-1]).astype(np.float64))
        for target in outputs.values():
            target[...] = picture
        return {}

    def _stretched(self, plane: F32) -> F32:
        image = Image.fromarray(np.ascontiguousarray(plane)).resize(
            (self._width, self._height), Image.Resampling.NEAREST
        )
        return np.asarray(image, np.float32)

    def _blend(self, picture: U8, colours: U8, where: NDArray[np.bool_] | None = None) -> None:
        mixed = picture[..., :3] + (colours.astype(np.float32) - picture[..., :3]) * np.float32(self._alpha)
        chosen = mixed.astype(np.uint8)
        picture[..., :3] = chosen if where is None else np.where(where[..., None], chosen, picture[..., :3])

    def _draw(self, picture: U8, boxes: NDArray[np.float64]) -> None:
        """Draw the frame of each box."""
        boxes = boxes[np.isfinite(boxes[:, :4]).all(axis=1)]
        if boxes.shape[1] > 4:
            boxes = boxes[boxes[:, 4] > 0]
        scale = (self._width, self._height) * 2 if len(boxes) and boxes[:, :4].max() <= 1 else (1.0,) * 4
        limits = np.array((self._width, self._height) * 2)
        for x0, y0, x1, y1 in np.clip(boxes[:, :4] * scale, 0, limits).round().astype(int):
            if x1 <= x0 or y1 <= y0:
                continue
            for rows, columns in (
                (slice(y0, y0 + LINE_PIXELS), slice(x0, x1)),
                (slice(max(y1 - LINE_PIXELS, 0), y1), slice(x0, x1)),
                (slice(y0, y1), slice(x0, x0 + LINE_PIXELS)),
                (slice(y0, y1), slice(max(x1 - LINE_PIXELS, 0), x1)),
            ):
                picture[rows, columns, :3] = BOX_COLOUR


def _channels(array: NDArray[Any]) -> NDArray[Any]:
    """Return `array` as (channels, height, width): of three axes the smallest outer one is that of the channels."""
    planes = array.reshape([size for size in array.shape if size > 1])
    if planes.ndim == 2:
        return planes[None]
    return planes if planes.shape[0] <= planes.shape[2] else planes.transpose(2, 0, 1)


def _classes(mask: NDArray[Any]) -> U8:
    """Return the class of each pixel, (h,w)."""
    planes = _channels(mask)
    if len(planes) > 1:
        return np.asarray(planes.argmax(axis=0) % CLASSES, np.uint8)
    if planes.dtype.kind == "f":
        return np.asarray(planes[0] > 0.5, np.uint8)
    return np.asarray(planes[0].astype(np.int64) % CLASSES, np.uint8)


def _depth_colours(depth: F32) -> U8:
    low, high = float(depth.min()), float(depth.max())
    share = (depth - low) / (high - low) if high > low else np.zeros_like(depth)
    return np.asarray(np.stack([share, 1 - np.abs(2 * share - 1), 1 - share], axis=-1) * STEPS, np.uint8)


def build(settings: Mapping[str, Any], unit: UnitContext) -> Overlay:  # noqa: ARG001 - a factory's signature
    """Build the block. Raises BadInputError."""
    return Overlay(settings)
