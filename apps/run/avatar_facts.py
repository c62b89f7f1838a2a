"""What a report says of a run of avatars alone: its configuration, and the sizes of its tensors.

Rule: the run counts the frames of each tensor size; the error of a size comes from the avatars' validation, or is
unknown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from trilane.apps.run.report import Report, Resolution, TensorSize
from trilane.apps.run.report_facts import report_of
from trilane.avatars.validation import SizeLoss
from trilane.pipeline.result import RunResult
from trilane.scene.planner import ALL_WORK
from trilane.stages.config import RunConfig


def avatar_report(
    result: RunResult,
    config: RunConfig,
    *,
    machine: Mapping[str, Any],
    baseline: RunResult | None,
    facts: Mapping[str, Any],
) -> Report:
    """Build the report of a run of avatars. `config`: its configuration. The rest is as in `report_of`.

    `facts` may also have `placement`, `resolution`, `pace`, `accuracy` and `check`.
    """
    facts = {"plan": {"tensor_shapes": config.buckets}, **facts}
    shown = config_facts(config, result.report.policy, result.report.edge)
    return report_of(result, shown, machine=machine, baseline=baseline, facts=facts)


def config_facts(config: RunConfig, policy: str, edge: str) -> dict[str, Any]:
    """Return the block `config` of the report."""
    return {**config.model_dump(mode="json", exclude={"out_dir", "window", "kept"}), "policy": policy, "edge": edge}


def resolution_of(
    rungs: Mapping[int, int], switches: int, config: RunConfig, losses: Sequence[SizeLoss]
) -> dict[str, Any]:
    """Return the block `resolution` of the report.

    `rungs`: number of presented frames of each size. `switches`: number of frames of another size than the frame
    before. `losses`: losses of the scene's avatars by size.
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
    """Return the largest loss of an avatar, in dB; None when one of them is not known."""
    found = [loss.at(work) for loss in losses]
    known = [db for db in found if db is not None]
    return max(known) if known and len(known) == len(found) else None


def resolution_note(resolution: Resolution) -> str:
    """Say to a person how many frames had smaller tensors; empty when every frame had all its pixels."""
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
