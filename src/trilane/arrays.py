"""Names for array types in annotations, sizes of tensors as text and as shape buckets, the PSNR and light of pictures.

Rules: the name of an array type states the elements, docstrings state the shape. A tensor's shape is (height, width),
and both sides are multiples of `BUCKET_STEP`.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.unexpected_value import UnexpectedValue

U8 = NDArray[np.uint8]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
Ints = NDArray[np.integer[Any]]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]


MAX_SIDE = 4096
BUCKET_STEP = 32
MOST_ASPECT = 4  # largest ratio of a bucket's longer side to its shorter one

Shape = tuple[int, int]


def parse_shape(text: str) -> Shape:
    """Return (height, width) from a text such as `256x128`. Raises UnexpectedValue for another text."""
    match = re.fullmatch(r"(\d{1,9})x(\d{1,9})", text)
    if match is None:
        raise UnexpectedValue(repr(text), "HEIGHTxWIDTH such as 256x256")
    return int(match[1]), int(match[2])


def shape_buckets(size: str) -> list[Shape]:
    """Return the tensor shapes (height, width) that `size` allows.

    If `size` is `HxW`, this one shape is allowed. If it is one number S, the result is `shapes_within(S²)`: tall shapes
    suit a standing body, wide shapes a lying body. Raises UnexpectedValue for another text, and for a side that is not
    a multiple of BUCKET_STEP or is out of range.
    """
    if re.fullmatch(r"\d{1,9}", size):
        return shapes_within(check_side(int(size)) ** 2)
    height, width = parse_shape(size)
    return [(check_side(height), check_side(width))]


def shapes_within(pixels: int) -> list[Shape]:
    """Return the largest tensor shapes (height, width) of at most `pixels` pixels: none fits inside another.

    Sides are multiples of `BUCKET_STEP`, at most `MAX_SIDE`. A side is at most `MOST_ASPECT` times the other side.

    `pixels`: number of pixels, at least `BUCKET_STEP`².
    """
    longest = math.isqrt(MOST_ASPECT * pixels)
    widest = [(h, pixels // h // BUCKET_STEP * BUCKET_STEP) for h in range(BUCKET_STEP, longest + 1, BUCKET_STEP)]
    shapes = [(h, w) for h, w in widest if w and max(h, w) <= min(MOST_ASPECT * min(h, w), MAX_SIDE)]
    return [(h, w) for h, w in shapes if not any(b > h and v >= w for b, v in shapes)]


#: Lower bound of the mean square difference of values in 0..1. Therefore the highest PSNR is 100 dB.
LEAST_SQUARE = 1e-10


def psnr_db(square: float) -> float:
    """Return the PSNR in dB, at most 100. `square`: mean square difference of values in 0..1."""
    return float(-10 * np.log10(max(square, LEAST_SQUARE)))


def to_light(code: F64) -> F64:
    """Return the linear light in 0..1 of sRGB values in 0..1, by IEC 61966-2-1."""
    return np.asarray(np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4))


def to_code(light: F64) -> F64:
    """Return the sRGB values in 0..1 of linear light, by IEC 61966-2-1. Light outside of 0..1 is clipped first."""
    light = np.clip(light, 0.0, 1.0)
    return np.asarray(np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055))


def check_side(side: int, name: str = "side") -> int:
    """Return `side` unchanged. Raises UnexpectedValue, which calls it `name`, if no tensor can have such a side."""
    if side % BUCKET_STEP or not BUCKET_STEP <= side <= MAX_SIDE:
        raise UnexpectedValue(f"{name} {side}", f"a multiple of {BUCKET_STEP} from {BUCKET_STEP} to {MAX_SIDE}")
    return side


def checked_size(size: str) -> str:
    """Return `size` unchanged. Raises UnexpectedValue if `shape_buckets` refuses it."""
    shape_buckets(size)
    return size
