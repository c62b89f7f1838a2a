"""What smaller tensors cost an avatar: the same views, painted at several sizes of tensor.

Rule: a smaller picture is enlarged as the composite does it, bilinearly in linear light with its colours multiplied by
alpha, to the size of the largest; there all are compared with the same ground truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilane import machine
from trilane.arrays import U8
from trilane.avatars.bundle import Bundle
from trilane.avatars.manifest import BySize, Validation, with_figures_digest
from trilane.scene.planner import SIDES
from trilane.shapes import BUCKET_STEP, Shape
from trilane.training.dataset import plan_validation
from trilane.training.evaluate import integer_painter
from trilane.training.image_error import image_error
from trilane.training.sample_renderer import SampleRenderer
from trilane.training.validate import ValidationPlan, held_out_motions

DIGITS = 2


def sizes_of(own: Shape) -> list[Shape]:
    """Of a network's own tensor and the planner's smaller ones, in whole steps; each once, the largest first."""
    return list(dict.fromkeys((_stepped(own[0] * side), _stepped(own[1] * side)) for side in SIDES))


def _stepped(side: float) -> int:
    return max(int(side) // BUCKET_STEP, 1) * BUCKET_STEP


def measure_sizes(
    bundle: Bundle, plan: ValidationPlan, renderer: SampleRenderer, look: Callable[[], None] = lambda: None
) -> BySize:
    """The figures of `bundle` by size of tensor.

    `plan`: of the validation; views of its first seed are painted on its first runtime.
    `renderer`: of `trilane.training.validate.open_renderer`.
    `look`: called for every view.
    Raises BadInputError, MissingPartError.
    """
    own, *smaller = sizes_of(bundle.read_network().shape[1:3])
    runtime, seed = plan.runtimes[0], plan.seeds[0]
    paint = integer_painter(renderer, bundle, runtime, plan.threads)
    size = f"{own[0]}x{own[1]}"
    found: dict[Shape, list[float]] = {shape: [] for shape in (own, *smaller)}
    for sample in plan_validation(renderer, plan.per_band, seed, held_out_motions(plan.held_out), size):
        uv, truth = renderer.render(sample)
        for shape, errors in found.items():
            picture = paint(replace(sample, crop=replace(sample.crop, shape=shape)), uv)
            error = image_error(picture if shape == own else enlarged(picture, own), truth)
            if error is not None:
                errors.append(error.psnr_db)
        look()
    psnr_db = {f"{h}x{w}": round(float(np.mean(errors)), DIGITS) for (h, w), errors in found.items()}
    return BySize(
        date=machine.here.now().date(),
        runtime=runtime,
        seed=seed,
        per_band=plan.per_band,
        held_out=tuple(Path(name).name for name in plan.held_out),
        psnr_db=psnr_db,
    )


def with_sizes(validation: Validation, by_size: BySize) -> Validation:
    """`validation` with what was just measured beside it."""
    return with_figures_digest(validation.model_copy(update={"by_size": by_size}))


def enlarged(picture: U8, shape: Shape) -> U8:
    """`picture` (h,w,4) sRGB with straight alpha, enlarged to `shape` (height, width)."""
    alpha = picture[..., 3:] / 255.0
    planes = np.dstack([_linear(picture[..., :3] / 255.0) * alpha, alpha]).astype(np.float32)
    larger = np.dstack([_resized(planes[..., plane], shape) for plane in range(4)])
    colour = _encoded(larger[..., :3] / np.maximum(larger[..., 3:], 1e-6))
    return np.asarray(np.round(np.clip(np.dstack([colour, larger[..., 3:]]), 0, 1) * 255), np.uint8)


def _resized(plane: NDArray[np.float32], shape: Shape) -> NDArray[np.float32]:
    return np.asarray(Image.fromarray(plane).resize(shape[::-1], Image.Resampling.BILINEAR))


def _linear(encoded: NDArray[np.float64]) -> NDArray[np.float64]:
    """IEC 61966-2-1."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _encoded(linear: NDArray[np.floating]) -> NDArray[np.floating]:
    """IEC 61966-2-1."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
