"""What a check of a capture found, as plain data for people and for JSON.

Rule: every figure was measured by the check.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from trilane.training.capture.capture import Capture
from trilane.training.capture.check import LEAST_IOU, CheckedFrame
from trilane.training.capture.faults import Fault, FaultyCaptureError
from trilane.training.capture.texel_coverage import TexelCoverage
from trilane.training.capture.view_coverage import STEP_DEG, frames_by_side, widest_gap_deg


def require_fits(capture: Capture, frames: Sequence[CheckedFrame], sheet: object) -> None:
    """Raises FaultyCaptureError, which points to `sheet`, when most bodies are not where the masks are."""
    median = float(np.median([frame.iou for frame in frames]))
    if median < LEAST_IOU:
        found = f"bodies that overlap the masks by a median IoU of {median:.2f}"
        expected = f"at least {LEAST_IOU}; clothed people have 0.7 to 0.9"
        remedy = f"look at {sheet}: are `axes`, the lens, `flat_hand_mean` and the order of frames right?"
        raise FaultyCaptureError(str(capture.folder), [Fault(capture.file.fits, found, expected, remedy)])


def capture_facts(
    capture: Capture, frames: Sequence[CheckedFrame], bad: Sequence[CheckedFrame], coverage: TexelCoverage
) -> dict[str, Any]:
    """Keys: `capture`, `frames`, `size`, `betas`, `fit`, `bad`, `views`, `texels`; see docs/captures.md."""
    ious, outside = ([getattr(frame, name) for frame in frames] for name in ("iou", "outside"))
    return {
        "capture": str(capture.folder),
        "frames": len(capture),
        "size": [*capture.shape[::-1]],
        "betas": [round(float(value), 4) for value in capture.betas],
        "fit": {
            "iou_median": float(np.median(ious)),
            "iou_least": float(np.min(ious)),
            "outside_median": float(np.median(outside)),
        },
        "bad": [{"name": capture.names[each.number], "iou": each.iou, "outside": each.outside} for each in bad],
        "views": view_facts(capture.directions()),
        "texels": texel_facts(coverage),
    }


def texel_facts(coverage: TexelCoverage) -> dict[str, Any]:
    """`seen`: share of the body's texels. `regions`: of each region's. `never_seen`: regions hardly seen."""
    names = coverage.never_seen()
    return {"seen": coverage.share(), "regions": coverage.share_by_region(), "never_seen": names}


def view_facts(directions: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """Frames by side and by direction, of the (yaw, height) of cameras in degrees.

    `by_yaw`: number of frames in steps of `STEP_DEG` from behind over the right, the front and the left.
    """
    yaws = [yaw for yaw, _ in directions]
    heights = [height for _, height in directions]
    counts, _ = np.histogram(yaws, bins=np.arange(-180, 181, STEP_DEG))
    return {
        "by_side": frames_by_side(yaws),
        "by_yaw": [int(count) for count in counts],
        "widest_gap_deg": widest_gap_deg(yaws),
        "height_deg": [min(heights), max(heights)],
    }
