"""The crop of a sample: the pipeline's rectangle, bucket and projection for one body in one view.

Rule: crops are computed by the functions that the pose stage calls, so training sees what the pipeline draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trilane.avatars.bundle import CLOTHES_STANDOFF_M
from trilane.body.body import ShapedBody
from trilane.body.kinematics import Posed
from trilane.scene.crop import choose_bucket, crop_projection
from trilane.shapes import Shape
from trilane.stages.cpu.mesh_bounds import MeshBounds
from trilane.training.random_views import View

#: Height in pixels of the picture that samples are cropped from.
OUTPUT_ROWS = 480


@dataclass(frozen=True)
class Crop:
    """`shape`: of the tensor. `projection` (4,4): of the crop. `pixels`: of the screen, in the body's rectangle."""

    shape: Shape
    projection: NDArray[np.float64]
    pixels: float


class Cropper:
    """Crops of one shaped body."""

    def __init__(self, shaped: ShapedBody, pose_blend: bool = False) -> None:
        """Of `shaped`; `pose_blend`: whether its pose blend shapes, if any, are drawn."""
        self._bounds = MeshBounds(shaped, standoff_m=CLOTHES_STANDOFF_M, pose_blend=pose_blend)

    def crop(self, posed: Posed, view: View, buckets: Sequence[Shape]) -> Crop | None:
        """The crop of the body as seen from `view`, in one of the tensor shapes `buckets`; None when it is not seen."""
        rect = self._bounds.rect(posed, view.projection @ view.view)
        if rect is None:
            return None
        output = (OUTPUT_ROWS, round(OUTPUT_ROWS * view.aspect))
        shape, grown = choose_bucket(rect, output, buckets)
        pixels = rect.width * rect.height * output[0] * output[1] / 4
        return Crop(shape, crop_projection(view.projection, grown), pixels)
