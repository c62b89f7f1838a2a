"""Inputs of a network to calibrate it on, drawn as the training draws its views, and others to look at the result.

Rule: every kind of view that the training has, in its shares; what the result is looked at on comes from motions that
no training has. All are of the one tensor shape that networks are calibrated at.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import count
from typing import Any

import numpy as np
import onnx
import torch

from trilane.arrays import F32
from trilane.avatars.bundle import Bundle
from trilane.training.dataset import SIZES, TRAINING_SHARE, VALIDATION_SIZE, motion_poses
from trilane.training.make_bundle import CALIBRATION_SHAPE
from trilane.training.mip_levels import levels_of, read_levels
from trilane.training.network import UNet
from trilane.training.onnx_export import export_onnx
from trilane.training.random_poses import random_pose
from trilane.training.sample_renderer import BAND_NAMES, Sample, SampleRenderer
from trilane.training.validate import BUILTIN_HELD_OUT, held_out_motions
from trilane.training.weights_file import load_network

#: Seed of the views; the training of the default avatar had another one.
SEED = 17


def float_model(bundle: Bundle, weights: Any) -> onnx.ModelProto:
    """The float network of file `weights`, of `bundle`, at the calibration's shape. Raises BadInputError."""
    entry = bundle.manifest.network
    untrained = UNet(entry.encoder, entry.norm, entry.width, entry.channels, input_skip=True)
    return export_onnx(load_network(untrained, weights), *CALIBRATION_SHAPE)


def training_views(renderer: SampleRenderer, bundle: Bundle, views: int) -> list[F32]:
    """`views` inputs (H,W,C), of random poses and views in the training's shares."""
    rng = np.random.default_rng((SEED, 0))
    bands, sizes = list(TRAINING_SHARE), list(SIZES)

    def sample(number: int) -> Sample:
        band = str(rng.choice(bands, p=list(TRAINING_SHARE.values())))
        size = str(rng.choice(sizes, p=list(SIZES.values())))
        return renderer.plan((SEED, 1, number), random_pose, band, size)

    return list(_inputs(renderer, bundle, sample, views))


def held_out_views(renderer: SampleRenderer, bundle: Bundle, views: int) -> list[F32]:
    """`views` inputs (H,W,C) of all bands in turn, in poses of a motion that no training has."""
    poses = motion_poses(held_out_motions([BUILTIN_HELD_OUT]))

    def sample(number: int) -> Sample:
        band = number % len(BAND_NAMES)
        return renderer.plan((SEED, 2, number, band), poses, BAND_NAMES[band], VALIDATION_SIZE)

    return list(_inputs(renderer, bundle, sample, views))


def _inputs(renderer: SampleRenderer, bundle: Bundle, sample: Callable[[int], Sample], wanted: int) -> Iterator[F32]:
    """Of samples 0, 1, 2, ... the first `wanted` that have the calibration's shape, as the network is given them."""
    levels = levels_of(bundle)
    found = (one for one in map(sample, count()) if one.crop.shape == CALIBRATION_SHAPE)
    for _, one in zip(range(wanted), found, strict=False):
        uv = torch.from_numpy(np.ascontiguousarray(renderer.render(one)[0]))[None]
        yield read_levels(levels, uv[..., :2], uv[..., 2] > 0)[0].permute(1, 2, 0).contiguous().numpy()
