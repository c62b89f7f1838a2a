"""The blocks of pictures: `prepare` turns a picture into a network's input, and `overlay` draws outputs on a picture.

The block `prepare` writes a picture in a network's size, layout and numbers. The number for a byte b of channel c is
((b / 255 - mean[c]) / sd[c]) / step + zero_point; for an integer type it is rounded and clipped. Without keys, mean is
0 and sd is 1. The step is 1 for floats and 1/255 for bytes, so that bytes do not change. The zero point is 0, but -128
for signed bytes without a given step.

The block `overlay` draws these outputs on a picture:

- `mask`: classes or scores. If it has three axes, the smaller of the first and the last has the channels. The largest
of several channels is the class, and channel 0 is the background. A pixel of a single float channel belongs to the mask
if it is above 0.5. A single integer channel contains classes.
- `depth`: one channel, drawn from its least number (blue) to its largest (red).
- `boxes`: rows of x0, y0, x1, y1 and maybe a score. Coordinates are in pixels of the picture; if none is above 1, they
are shares of the picture's sides. A box whose score is not above 0 is not drawn.

Mask and depth are stretched over the picture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilane.arrays import F32, U8
from trilane.errors import BadInputError
from trilane.pipeline.file_keys import TYPES, PortType
from trilane.pipeline.stage import Arrays, PortedStage, UnitContext

STEPS: Final = 255
PAD: Final = 114  # grey around a letterboxed picture, with which detectors are trained
CHANNELS: Final = (1, 3)
NCHW, NHWC = "nchw", "nhwc"
OWN_CODE: Final = "a stage with python can prepare it"


class Preparation:
    """Turns pictures into inputs of a network.

    `wanted`: type of the network's input.
    `keys`: fit, layout, mean, sd, step and zero_point of the block, as far as they are given.
    `where`: place of the stage in its file, for errors.

    Raises BadInputError if keys and types do not fit each other, or if integers of several bytes have no `step`.
    """

    def __init__(self, wanted: PortType, keys: Mapping[str, Any], where: str) -> None:
        self._fit = keys.get("fit") or "stretch"
        self._layout, (self._height, self._width, self._channels) = _layout(wanted, keys.get("layout"), where)
        self._dtype = np.dtype(TYPES[wanted.dtype])
        self._shape = wanted.shape
        if wanted.shape[0] != 1 and len(wanted.shape) == 4:
            found, remedy = f"a network for {wanted.shape[0]} pictures at once", "export it with a batch of 1"
            raise BadInputError(where, found, "one for 1 picture", remedy)
        mean, sd = (_each(keys.get(key), self._channels, other, f"{where}.{key}") for key, other in _DEFAULTS.items())
        step, zero = self._quantised(keys, where)
        numbers = (np.arange(STEPS + 1)[:, None] / STEPS - mean) / sd / step + zero
        if self._dtype.kind in "iu":
            limits = np.iinfo(self._dtype)
            numbers = np.clip(np.rint(numbers), limits.min, limits.max)
        #: The network's number for each byte and channel (256, channels), so that each byte needs one look-up.
        self._table = numbers.astype(self._dtype)
        self._is_same = self._dtype == np.uint8 and (self._table == np.arange(STEPS + 1)[:, None]).all()

    def _quantised(self, keys: Mapping[str, Any], where: str) -> tuple[float, float]:
        """Return (step, zero point) of the network's numbers. `keys`, `where`: as in `Preparation`."""
        if self._dtype.kind == "f":
            return keys.get("step") or 1.0, float(keys.get("zero_point") or 0)
        if self._dtype.itemsize > 1 and keys.get("step") is None:
            expected = f"the step of the network's numbers, {self._dtype.name}"
            raise BadInputError(f"{where}.step", "nothing", expected, "add the scale of its quantisation")
        zero = keys.get("zero_point")
        usual = -128 if self._dtype == np.int8 and keys.get("step") is None else 0
        return keys.get("step") or 1 / STEPS, float(usual if zero is None else zero)

    def into(self, picture: U8, target: NDArray[Any]) -> None:
        """Write the input for `picture` (h,w,c) into `target`, which has the network's shape."""
        fitted = self._channelled(self._fitted(picture))
        size = self._height, self._width
        grid = target.reshape((*size, self._channels) if self._layout == NHWC else (self._channels, *size))
        if self._is_same:
            grid[...] = fitted if self._layout == NHWC else fitted.transpose(2, 0, 1)
            return
        for channel in range(self._channels):
            plane = grid[..., channel] if self._layout == NHWC else grid[channel]
            plane[...] = self._table[:, channel].take(fitted[..., channel])

    def _channelled(self, picture: U8) -> U8:
        """Return `picture` (h,w,c) with the number of channels that the network reads."""
        count = picture.shape[2]
        if count == self._channels:
            return picture
        if self._channels == 1:
            return np.asarray(Image.fromarray(picture[..., :3]).convert("L"), np.uint8)[..., None]
        return np.repeat(picture, 3, axis=2) if count == 1 else picture[..., :3]

    def _fitted(self, picture: U8) -> U8:
        height, width = picture.shape[:2]
        if (height, width) == (self._height, self._width):
            return picture
        if self._fit == "stretch":
            return _resized(picture, self._width, self._height)
        ratios = self._width / width, self._height / height
        if self._fit == "crop":
            ratio = max(ratios)
            wide, high = max(round(width * ratio), self._width), max(round(height * ratio), self._height)
            left, top = (wide - self._width) // 2, (high - self._height) // 2
            return _resized(picture, wide, high)[top : top + self._height, left : left + self._width]
        ratio = min(ratios)
        wide, high = max(round(width * ratio), 1), max(round(height * ratio), 1)
        left, top = (self._width - wide) // 2, (self._height - high) // 2
        framed: U8 = np.full((self._height, self._width, picture.shape[2]), PAD, np.uint8)
        framed[top : top + high, left : left + wide] = _resized(picture, wide, high)
        return framed


_DEFAULTS: Final = {"mean": 0.0, "sd": 1.0}


def _each(values: Sequence[float] | None, channels: int, other: float, where: str) -> NDArray[np.float64]:
    """Return a value for each channel (channels,). `other`: value of all channels if `values` is None."""
    given = [other] if values is None else list(values)
    if len(given) not in (1, channels):
        expected = f"1 or {channels}, one for each channel"
        raise BadInputError(where, f"{len(given)} values", expected, "one value counts for all channels")
    return np.broadcast_to(np.array(given, np.float64), (channels,))


def _layout(wanted: PortType, asked: str | None, where: str) -> tuple[str, tuple[int, int, int]]:
    """Return (layout of a network's input, (height, width, channels) of the picture in it). Raises BadInputError."""
    shape = wanted.shape[-3:]
    if len(wanted.shape) not in (3, 4):
        expected = "one that reads pictures, 1xCxHxW or 1xHxWxC"
        raise BadInputError(where, f"a network that reads {wanted}", expected, OWN_CODE)
    fits = {NCHW: shape[0] in CHANNELS, NHWC: shape[2] in CHANNELS}
    layout = asked or next((name for name, is_so in fits.items() if is_so), "")
    if not layout or not fits[layout]:
        expected, remedy = "1 or 3 channels, first or last", "change `layout`" if asked else OWN_CODE
        raise BadInputError(where, f"a network that reads {wanted}", expected, remedy)
    channels, height, width = shape if layout == NCHW else (shape[2], shape[0], shape[1])
    return layout, (height, width, channels)


def _resized(picture: U8, width: int, height: int) -> U8:
    image = Image.fromarray(picture[..., 0] if picture.shape[2] == 1 else picture)
    found = np.asarray(image.resize((width, height), Image.Resampling.BILINEAR), np.uint8)
    return found.reshape(height, width, picture.shape[2])


class Prepare(PortedStage):
    """Writes the input of a network for each picture."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(settings)
        (wanted,) = self.writes.values()
        self._preparation = Preparation(wanted, self.settings.keys, self.settings.where)

    def work(self, frame: int, arrays: Sequence[NDArray[Any] | None], outputs: Arrays) -> Mapping[str, float]:  # noqa: ARG002
        if arrays[0] is not None:
            for target in outputs.values():
                self._preparation.into(arrays[0], target)
        return {}


def build_prepare(settings: Mapping[str, Any], unit: UnitContext) -> Prepare:  # noqa: ARG001 - a factory's signature
    """Build the block `prepare`. Raises BadInputError."""
    return Prepare(settings)


FRAME, MASK, DEPTH, BOXES = "frame", "mask", "depth", "boxes"
LINE_PIXELS: Final = 2
BOX_COLOUR: Final = np.array([255, 220, 0], np.uint8)
CLASSES: Final = 256


def class_colours() -> U8:
    """Return RGB bytes for each class (CLASSES, 3), distinct for neighbouring classes; class 0 is never drawn."""
    hues = np.arange(CLASSES) * 0.618034 % 1  # the golden ratio spreads them
    waves = [np.clip(np.abs((hues * 6 + shift) % 6 - 3) - 1, 0, 1) for shift in (0, 4, 2)]
    return np.asarray(np.stack(waves, axis=1) * STEPS, np.uint8)


DRAW_YOURSELF: Final = "a stage with python before it can bring them into this form"


class Overlay(PortedStage):
    """Draws mask, depth and boxes on a picture. Raises BadInputError if one of them has a shape that does not fit."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(settings)
        self._alpha = float(self.settings.keys.get("alpha", 0.5))
        self._colours = class_colours()
        types = {each.name or FRAME: each.type for each in self.reads}
        self._height, self._width = types[FRAME].shape[:2]
        for name in (MASK, DEPTH):
            if name in types and len([size for size in types[name].shape if size > 1]) not in (2, 3):
                where, found = f"{self.settings.where}.in.{name}", f"{types[name]}"
                raise BadInputError(where, found, "a height and a width, and maybe channels", DRAW_YOURSELF)
        if BOXES in types and types[BOXES].shape[-1] < 4:
            where, found = f"{self.settings.where}.in.boxes", f"{types[BOXES]}"
            raise BadInputError(where, found, "rows of 4 numbers or more", DRAW_YOURSELF)

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
        """Draw the outlines of `boxes` (boxes, 4 or more) into `picture`: x0, y0, x1, y1, maybe score."""
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
    """Return `array` as (channels, height, width). Of three axes, the smaller of first and last has the channels."""
    planes = array.reshape([size for size in array.shape if size > 1])
    if planes.ndim == 2:
        return planes[None]
    return planes if planes.shape[0] <= planes.shape[2] else planes.transpose(2, 0, 1)


def _classes(mask: NDArray[Any]) -> U8:
    """Return the class of each pixel (h,w) of `mask`, an output of a network."""
    planes = _channels(mask)
    if len(planes) > 1:
        return np.asarray(planes.argmax(axis=0) % CLASSES, np.uint8)
    if planes.dtype.kind == "f":
        return np.asarray(planes[0] > 0.5, np.uint8)
    return np.asarray(planes[0].astype(np.int64) % CLASSES, np.uint8)


def _depth_colours(depth: F32) -> U8:
    """Return the colours (h,w,3) uint8 of `depth` (h,w), from blue for the least finite depth to red for the largest.

    Plus infinity counts as the largest finite depth. Minus infinity and NaN count as the least. If all finite depths
    are equal, or there are none, the picture is blue.
    """
    finite = depth[np.isfinite(depth)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    depth = np.nan_to_num(np.clip(depth, low, high), nan=low)
    share = (depth - low) / (high - low) if high > low else np.zeros_like(depth)
    return np.asarray(np.stack([share, 1 - np.abs(2 * share - 1), 1 - share], axis=-1) * STEPS, np.uint8)


def build_overlay(settings: Mapping[str, Any], unit: UnitContext) -> Overlay:  # noqa: ARG001 - a factory's signature
    """Build the block `overlay`. Raises BadInputError."""
    return Overlay(settings)
