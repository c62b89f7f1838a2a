"""What it cost to be in time: for how many frames the tensor was stepped down, to what size, and the error of that.

Rule: frames are counted by the run; the error is the avatars' own, from their validation, or said to be unknown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from trilane.apps.report import Resolution, TensorSize
from trilane.avatars.validation import SizeLoss
from trilane.scene.planner import ALL_WORK
from trilane.stages.config import RunConfig


def resolution_of(
    rungs: Mapping[int, int], switches: int, config: RunConfig, losses: Sequence[SizeLoss]
) -> dict[str, Any]:
    """The report's `resolution`.

    `rungs`: how many presented frames had each. `switches`: how often one had another than the frame before.
    `losses`: of the scene's avatars.
    """
    sizes = [
        {
            "work": work / ALL_WORK,
            "most_pixels": budget.most_of(1),
            "frames": rungs.get(rung, 0),
            "psnr_loss_db": worst_loss(work, losses),
        }
        for rung, (work, budget) in enumerate(zip(config.works, config.tensor_budgets, strict=True))
    ]
    return {
        "sizes": sizes,
        "switches": switches,
        "loss_source": "; ".join(dict.fromkeys(loss.source for loss in losses)),
    }


def worst_loss(work: int, losses: Sequence[SizeLoss]) -> float | None:
    """The largest loss of an avatar; None when one's is not known."""
    found = [loss.at(work) for loss in losses]
    known = [db for db in found if db is not None]
    return max(known) if known and len(known) == len(found) else None


def resolution_note(resolution: Resolution) -> str:
    """A sentence for a person; empty when every frame had all its pixels."""
    less = [size for size in resolution.sizes[1:] if size.frames]
    if not less:
        return ""
    total = sum(size.frames for size in resolution.sizes)
    parts = ", ".join(_said(size) for size in less)
    return (
        f"resolution: to be in time {sum(size.frames for size in less)} of {total} presented frames had smaller "
        f"tensors: {parts}; {resolution.switches} switches (error: {resolution.loss_source})"
    )


def _said(size: TensorSize) -> str:
    loss = f", {size.psnr_loss_db:.1f} dB worse" if size.psnr_loss_db is not None else ""
    return f"{size.frames} of at most {size.most_pixels} pixels an avatar{loss}"
