"""What an avatar loses in smaller tensors than its network was trained for. Rule: its validation's figures or none."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from trilane.avatars.bundle import Bundle
from trilane.avatars.validation import VALIDATE, name_of, refused
from trilane.figure_sources import NO_FIGURES, from_validation
from trilane.shapes import parse_shape

WHOLE = 1000  # thousandths
DIGITS = 2


@dataclass(frozen=True)
class SizeLoss:
    """`by_work`: PSNR in dB that is lost, by thousandths of the pixels; empty without figures.

    `source`: where they come from, or why there are none and what measures them.
    """

    source: str
    by_work: Mapping[int, float]

    def at(self, work: int) -> float | None:
        """The loss with so many thousandths of the pixels: of the next smaller size that was measured, if any was."""
        if work >= WHOLE and self.by_work:
            return 0.0
        measured = [size for size in self.by_work if size <= work]
        return self.by_work[max(measured)] if measured else None


def size_loss(bundle: Bundle) -> SizeLoss:
    """Of `bundle`. Raises BadInputError for a file that cannot be read."""
    validation, name = bundle.manifest.validation, bundle.manifest.name
    measures = f"`{VALIDATE} {name_of(bundle.folder)} --sizes` measures them"
    if validation is None or refused(bundle):
        how = f"`{VALIDATE} {name_of(bundle.folder)}` first, then {measures}"
        return SizeLoss(f"avatar {name}: {NO_FIGURES} by tensor size, for it has no valid validation: {how}", {})
    if validation.by_size is None:
        return SizeLoss(f"avatar {name}: {NO_FIGURES} by tensor size; {measures}", {})
    pixels = {math.prod(parse_shape(size)): psnr for size, psnr in validation.by_size.psnr_db.items()}
    own = max(pixels)
    losses = {WHOLE * count // own: round(pixels[own] - psnr, DIGITS) for count, psnr in pixels.items()}
    return SizeLoss(f"{from_validation(validation.by_size.date)}, by tensor size", losses)
