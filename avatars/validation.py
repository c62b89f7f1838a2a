"""Decides which figures of an avatar's image error may be shown, and explains why other figures are not shown.

Rule: a figure is shown only if the avatar's files and numbers, and the way of drawing, are the same as when it was
measured. Otherwise a sentence names the difference, and the command that measures the figure.
"""

from __future__ import annotations

import datetime
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trilane.arrays import parse_shape
from trilane.avatars.bundle import Bundle, bundle_folder
from trilane.avatars.manifest import CAPTURED, UNTRAINED, Validation, digests_of, figures_digest
from trilane.units import ALL_WORK, AVATARS, NO_FIGURES, SIDES, work_of_side

#: Name of each part of an avatar in a sentence.
PARTS = {
    "body": "the body",
    "texture": "the neural texture",
    "network": "the network",
    "constants": "the manifest's constants (shape, expression, scales and zero points)",
}
VALIDATE = "trilane avatar validate"
NO_TRUTH = "only frames of its person are known"
HELD_OUT = "held_out_error"
ON_HELD_OUT = "its error on those held out is in the provenance of its manifest"


#: Remark on the command that validates at another size or on another runtime.
REPLACES = ", in place of what the manifest says now"
NEIGHBOURS = "`trilane bench several` measures what an avatar loses to its neighbours"
PLANNED, BY_FRAME = "auto", "`trilane bench planner` measures scenes whose tensor is planned"
#: Motion, seeds, samples of each band and seed, and tensor size of a validation. One seed is not enough: the worst of
#: its 96 samples differs by several dB from seed to seed.
BUILTIN_HELD_OUT = "builtin:walk-wave-turn"
SEEDS = (1, 2, 3, 4, 5, 6, 7, 8)
PER_BAND = 24
VALIDATION_SIZE = "256"
#: Runtimes to validate with if they are installed. The first one gives the avatar's figures.
VALIDATION_RUNTIMES = ("ort", "openvino")


@dataclass(frozen=True)
class DrawnAs:
    """How a run draws an avatar.

    `runtime`: runtime of the network.
    `size`: tensor size, as `trilane run --size` takes it.
    `texture_filter`: filter of the neural texture.
    `avatars`: number of avatars that share the tensor.
    """

    runtime: str
    size: str
    texture_filter: str = "linear"
    avatars: int = 1


def from_validation(date: datetime.date | None) -> str:
    """Return the text that names the source of a figure: an avatar's validation of `date`."""
    return f"from the avatar's validation of {date}"


def accuracy_of(bundle: Bundle, drawn: DrawnAs) -> dict[str, Any]:
    """Return the figures of the avatar's image error that hold for a run that draws the avatar as `drawn`.

    Keys: `source`, which names the validation and its date; `runtime`, `size`; the keys of `AccuracyFigures`. If no
    figure holds, the keys are `source`, `changed` and `why`, as in `refused`.
    Raises BadInputError for a file that cannot be read.
    """
    validation = bundle.manifest.validation
    refusal = refused(bundle)
    if validation is None or refusal:
        return refusal
    own, differs = validation.on(drawn.runtime), _drawn_otherwise(validation, drawn)
    if own is None or differs:
        if drawn.avatars > 1:
            return {"source": NO_FIGURES, "changed": [], "why": f"{differs}; {NEIGHBOURS}"}
        if drawn.size == PLANNED:
            return {"source": NO_FIGURES, "changed": [], "why": f"{differs}; {BY_FRAME}"}
        return _no_figures(bundle, [], differs, f" --size {drawn.size} --runtime {drawn.runtime}", REPLACES)
    return {
        "source": from_validation(validation.date),
        "runtime": drawn.runtime,
        "size": drawn.size,
        **own.model_dump(),
    }


def validation_facts(bundle: Bundle) -> dict[str, Any] | None:
    """Return the keys of the avatar's validation, and `source`; None for an avatar without a validation.

    If no figure may be shown, return the keys of `refused`. Raises BadInputError for a file that cannot be read.
    """
    validation = bundle.manifest.validation
    if validation is None:
        return None
    return refused(bundle) or {"source": from_validation(validation.date), **validation.model_dump(mode="json")}


def refused(bundle: Bundle) -> dict[str, Any]:
    """Return the reason why no figure of the manifest may be shown; empty if they may be shown.

    Keys: `source`, which is `NO_FIGURES`; `why`, the reason as a sentence; `changed`, the keys of `PARTS` that were
    changed since the validation. Raises BadInputError for a file that cannot be read.
    """
    validation = bundle.manifest.validation
    if bundle.manifest.provenance.get("weights") == UNTRAINED:
        why = "its network is untrained: its times count, its pictures do not"
        return {"source": NO_FIGURES, "changed": [], "why": why}
    if bundle.manifest.provenance.get("body") == CAPTURED:
        return {"source": NO_FIGURES, "changed": [], "why": no_truth(bundle)}
    if validation is None:
        return _no_figures(bundle, [], "it was never validated")
    if validation.digests is None:
        return _no_figures(bundle, [], "the validation in its manifest does not say what it is of: it has no digests")
    if validation.date is None or validation.figures_digest is None:
        why = "it has no date or no digest of its figures"
        return _no_figures(bundle, [], f"the validation in its manifest is not whole: {why}")
    if validation.figures_digest != figures_digest(validation):
        return _no_figures(bundle, [], f"the figures were changed since the validation of {validation.date}")
    if validation.psnr_db_by_background is None:
        return _no_figures(
            bundle, [], "its figures are before one grey, before which a transparent person has no error"
        )
    now = digests_of(bundle.folder, bundle.manifest)
    changed = [part for part in PARTS if getattr(now, part) != getattr(validation.digests, part)]
    if not changed:
        return {}
    names = " and ".join(PARTS[part] for part in changed)
    return _no_figures(bundle, changed, f"changed since the validation of {validation.date}: {names}")


def no_truth(bundle: Bundle) -> str:
    """Return part of a sentence: why an avatar of a capture cannot be validated.

    If the manifest has the error on frames that were held out of training, the text says so.
    """
    return f"{NO_TRUTH}; {ON_HELD_OUT}" if HELD_OUT in bundle.manifest.provenance else NO_TRUTH


def _drawn_otherwise(validation: Validation, drawn: DrawnAs) -> str:
    """Return part of a sentence: how `drawn` differs from the drawing in the validation; "" if nothing differs."""
    runtimes = [validation.runtime, *validation.other_runtimes]
    if drawn.avatars > 1:
        return f"it was validated alone in its tensor, and here {drawn.avatars} avatars share one"
    if drawn.size != validation.size:
        return f"it was validated at tensor size {validation.size}, and this is {drawn.size}"
    if drawn.texture_filter != validation.texture_filter:
        found = f"and this is {drawn.texture_filter}"
        return f"it was validated with the {validation.texture_filter} texture filter, {found}"
    if drawn.runtime not in runtimes:
        return f"it was validated on {' and '.join(runtimes)}, and this is {drawn.runtime}"
    return ""


def _no_figures(bundle: Bundle, changed: Sequence[str], why: str, how: str = "", remark: str = "") -> dict[str, Any]:
    """Return the keys of `refused`. Their `why` ends with the command that measures the figures."""
    command = f"{VALIDATE} {name_of(bundle.folder)}{how}"
    return {"source": NO_FIGURES, "changed": list(changed), "why": f"{why}; `{command}` measures it{remark}"}


def name_of(folder: Path) -> str:
    """Return the word by which a command names the avatar in `folder`: a name of AVATARS, or the quoted path."""
    known = (name for name in AVATARS if folder.absolute() == bundle_folder(name).absolute())
    return next(known, shlex.quote(str(folder)))


# The tensor sizes that an avatar needs, and its loss in smaller ones. Rule: they come from the avatar's validation, or
# there are none.

DIGITS = 2
#: A tensor is large enough for a body if it loses at most this much of the PSNR at the best measured size, in dB: for
#: an avatar with a network of its own, and for avatars that share a network. These share a tensor too. Background
#: between them also takes pixels, so that a tenth of a dB costs more.
TOLERANCE_DB, SHARED_TOLERANCE_DB = 0.04, 0.3


@dataclass(frozen=True)
class SizeLoss:
    """The tensor sizes that an avatar needs, and its loss in smaller tensors.

    `source`: source of the figures; without figures, why there are none and which command measures them.
    `by_work`: loss of PSNR in dB, by the tensor's pixels in thousandths of the full size; empty without figures.
    `curve`: pairs (pixels of the picture that the body covers, pixels of the full-size tensor for such a body), from
    `curve_of`. If it is empty, the full size is the network's own.
    """

    source: str
    by_work: Mapping[int, float]
    curve: tuple[tuple[int, int], ...] = ()

    def at(self, work: int) -> float | None:
        """Return the loss in dB of a tensor with `work` thousandths of the full size's pixels.

        The loss is 0 at the full size. For a smaller tensor, it is the loss at the largest measured size up to `work`.
        The result is None if no such size was measured, and without figures.
        """
        if work >= ALL_WORK and self.by_work:
            return 0.0
        measured = [size for size in self.by_work if size <= work]
        return self.by_work[max(measured)] if measured else None


def tolerance_db(avatars: int) -> float:
    """Return the tolerance for `curve_of`, in dB. `avatars`: number of avatars that share a network."""
    return TOLERANCE_DB if avatars == 1 else SHARED_TOLERANCE_DB


def size_loss(bundle: Bundle, avatars: int) -> SizeLoss:
    """Return the loss of PSNR of `bundle` in smaller tensors. Raises BadInputError for a file that cannot be read.

    `avatars`: number of avatars in the scene that have the network of `bundle`.
    """
    validation, name = bundle.manifest.validation, bundle.manifest.name
    measures = f"`{VALIDATE} {name_of(bundle.folder)} --sizes` measures them"
    if validation is None or refused(bundle):
        how = f"`{VALIDATE} {name_of(bundle.folder)}` first, then {measures}"
        return SizeLoss(f"avatar {name}: {NO_FIGURES} by tensor size, for it has no valid validation: {how}", {})
    by_size = validation.by_size
    if by_size is None:
        return SizeLoss(f"avatar {name}: {NO_FIGURES} by tensor size; {measures}", {})
    source = f"{from_validation(by_size.date)}, by tensor size"
    if by_size.psnr_db_by_picture is not None:
        table = by_size.psnr_db_by_picture
        curve = curve_of(table, tolerance_db(avatars))
        return SizeLoss(source, {ALL_WORK: 0.0, **_losses(table, curve)}, curve)
    pixels = {math.prod(parse_shape(size)): psnr for size, psnr in (by_size.psnr_db or {}).items()}
    own = max(pixels)
    losses = {ALL_WORK * count // own: round(pixels[own] - psnr, DIGITS) for count, psnr in pixels.items()}
    return SizeLoss(source, losses)


def curve_of(table: Mapping[int, Mapping[int, float]], tolerance: float) -> tuple[tuple[int, int], ...]:
    """Return, for each body in `table`, (pixels of the picture that it covers, pixels of the smallest tensor for it).

    Between measured tensors, PSNR is linear in the logarithm of the side.
    `table`: PSNR in dB, as `BySize.psnr_db_by_picture`. `tolerance`: most that a tensor loses against the best, dB.
    """
    curve: list[tuple[int, int]] = []
    for side in sorted(table):
        row = sorted(table[side].items())
        enough = max(psnr for _, psnr in row) - tolerance
        at = next(number for number, (_, psnr) in enumerate(row) if psnr >= enough)
        (low, below), (high, above) = row[max(at - 1, 0)], row[at]
        part = (enough - below) / (above - below) if at else 1.0
        curve.append((side * side, math.ceil((low * (high / low) ** part) ** 2)))
    return tuple(curve)


def psnr_at(row: Mapping[int, float], pixels: float) -> float | None:
    """Return the PSNR in dB of a tensor of `pixels`, interpolated in their logarithm; None outside the measured sizes.

    `row`: measured PSNR in dB, by side of a square tensor in pixels.
    """
    sides = sorted(row)
    if not sides[0] ** 2 <= pixels <= sides[-1] ** 2:
        return None
    return float(np.interp(math.log(pixels) / 2, [math.log(side) for side in sides], [row[side] for side in sides]))


def _losses(table: Mapping[int, Mapping[int, float]], curve: Sequence[tuple[int, int]]) -> dict[int, float]:
    """Return the mean loss of PSNR in dB over the bodies of `table`, by size of the tensor, one of WORKS.

    A size that was measured for no body is left out. A smaller tensor never counts as better. `curve`: from `curve_of`.
    """
    losses = {}
    for work in map(work_of_side, SIDES[1:]):
        found = [
            max(whole - less, 0.0)
            for (_, pixels), side in zip(curve, sorted(table), strict=True)
            if (whole := psnr_at(table[side], pixels)) is not None
            and (less := psnr_at(table[side], pixels * work / ALL_WORK)) is not None
        ]
        if found:
            losses[work] = round(sum(found) / len(found), DIGITS)
    return losses
