"""Learnt levels of a texture on the GPU: read where training reads them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trilane.avatars.bundle import pack_levels
from trilane.errors import BadInputError
from trilane.stages.config import Quantisation
from trilane.stages.gpu.raster import PackedAvatar, PackedPass

torch = pytest.importorskip("torch")

from trilane.training.random_views import random_pose  # noqa: E402
from trilane.training.trainable_avatar import read_levels  # noqa: E402

QUANTISATION = Quantisation(1 / 127, 128)


def drawn(renderer: Any, sample: Any, levels: list[Any]) -> Any:
    """The tensor (h,w,4) of real numbers."""
    packed = PackedPass(renderer.ctx, 4, QUANTISATION, deferred=False)
    smaller = pack_levels(levels[1:]) if levels[1:] else None
    avatar = PackedAvatar(packed, renderer.mesh, levels[0], smaller)
    shape = sample.crop.shape
    tensor = np.empty((*shape, 4), np.uint8)
    avatar.draw(packed.begin(shape), *renderer.placed(sample))
    packed.read_into(shape, tensor.reshape(-1))
    return (tensor.astype(float) - QUANTISATION.zero_point) * QUANTISATION.scale


def test_the_gpu_reads_the_levels_that_training_reads(renderer: Any) -> None:
    """Plain levels of 0, 0.3 and 0.6, so that a number says which level was read. A driver takes one level for four
    pixels and an approximate logarithm, so half of the pixels must agree to a tenth of a level.
    """
    levels = [np.full((512 >> k, 512 >> k, 4), 0.3 * k, np.float32) for k in range(3)]
    sample = renderer.plan((1, 2, 3), random_pose, "full_body", "128")
    uv, _ = renderer.render(sample)
    shown = uv[..., 2] > 0
    image = torch.from_numpy(np.ascontiguousarray(uv))[None]
    tensors = [torch.from_numpy(level.transpose(2, 0, 1).copy())[None] for level in levels]
    wanted = read_levels(tensors, image[..., :2], image[..., 2] > 0)[0].permute(1, 2, 0).numpy()
    tensor = drawn(renderer, sample, levels)
    assert np.median(np.abs(tensor - wanted)[shown]) <= 0.03 and np.median(wanted[shown]) > 0.4
    assert not drawn(renderer, sample, levels[:1])[shown].any() and not tensor[~shown].any()
    deferred = PackedPass(renderer.ctx, 4, QUANTISATION, deferred=True)
    with pytest.raises(BadInputError, match="found learnt levels, expected one level; draw mesh and texture in one"):
        PackedAvatar(deferred, renderer.mesh, levels[0], pack_levels(levels[1:]))
