"""The block `prepare`: makes of a picture what a network expects: its size, layout and numbers.

A network's number for a byte b of channel c is ((b / 255 - mean[c]) / sd[c]) / step + zero_point, rounded and clipped
to the type where that is a whole number. Without keys, mean is 0, sd is 1, and step is 1 for floats. For bytes, step is
1/255, so that bytes stay as they are; the zero point is 0, or -128 for signed bytes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilane.arrays import U8
from trilane.errors import BadInputError
from trilane.pipeline.file_keys import TYPES, PortType
from trilane.pipeline.stage import Arrays, PortedStage, UnitContext

STEPS: Final = 255
PAD: Final = 114  # the grey around a letterboxed picture, as detectors are trained with
CHANNELS: Final = (1, 3)
NCHW, NHWC = "nchw", "nhwc"
OWN_CODE: Final = "a stage with python can prepare it"


class Preparation:
    """Turns pictures of one type into inputs of a network.

    `keys`: fit, layout, mean, sd, step and zero_point of the block, as far as they are given.
    `where`: place of the stage in its file. Raises BadInputError for what does not fit.
    """

    def __init__(self, picture: PortType, wanted: PortType, keys: Mapping[str, Any], where: str) -> None:
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
        #: The number for each byte and channel, so that a frame needs one look-up for each of its bytes.
        self._table = numbers.astype(self._dtype)
        self._is_same = self._dtype == np.uint8 and (self._table == np.arange(STEPS + 1)[:, None]).all()
        self._height_in, self._width_in, self._channels_in = picture.shape

    def _quantised(self, keys: Mapping[str, Any], where: str) -> tuple[float, float]:
        """Return step and zero point of the network's numbers."""
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
        grid = target.reshape(self._grid_shape())
        if self._is_same:
            grid[...] = fitted if self._layout == NHWC else fitted.transpose(2, 0, 1)
            return
        for channel in range(self._channels):
            plane = grid[..., channel] if self._layout == NHWC else grid[channel]
            plane[...] = self._table[:, channel].take(fitted[..., channel])

    def _grid_shape(self) -> tuple[int, int, int]:
        if self._layout == NHWC:
            return self._height, self._width, self._channels
        return self._channels, self._height, self._width

    def _channelled(self, picture: U8) -> U8:
        """Return `picture` with as many channels as the network reads."""
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
    """Return a value for each channel."""
    given = [other] if values is None else list(values)
    if len(given) not in (1, channels):
        expected = f"1 or {channels}, one for each channel"
        raise BadInputError(where, f"{len(given)} values", expected, "one value counts for all channels")
    return np.broadcast_to(np.array(given, np.float64), (channels,))


def _layout(wanted: PortType, asked: str | None, where: str) -> tuple[str, tuple[int, int, int]]:
    """Return the layout of a network's input, and height, width and channels in it."""
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
    """Writes what a network expects of a picture."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(settings)
        (wanted,) = self.writes.values()
        self._preparation = Preparation(self.reads[0].type, wanted, self.settings.keys, self.settings.where)

    def work(self, frame: int, arrays: Sequence[NDArray[Any] | None], outputs: Arrays) -> Mapping[str, float]:  # noqa: ARG002
        if arrays[0] is not None:
            for target in outputs.values():
                self._preparation.into(arrays[0], target)
        return {}


def build(settings: Mapping[str, Any], unit: UnitContext) -> Prepare:  # noqa: ARG001 - a factory's signature
    """Build the block. Raises BadInputError."""
    return Prepare(settings)
