"""Paints samples with the float network, to compare the integer network with.

Rule: the texture is read at the UV image bilinearly, as in training.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from trilane.arrays import U8
from trilane.avatars.bundle import Bundle
from trilane.training.evaluate import Painter
from trilane.training.mip_levels import levels_of, read_levels
from trilane.training.network import UNet
from trilane.training.sample_renderer import Sample
from trilane.training.weights_file import load_network


def float_painter(network: UNet, *levels: torch.Tensor) -> Painter:
    """A painter that runs `network` on the texture of `levels` (1,C,S,S), (1,C,S/2,S/2), ..., where they are."""
    network.eval()

    def paint(_: Sample, uv: NDArray[np.float32]) -> U8:
        image = torch.from_numpy(np.ascontiguousarray(uv))[None].to(levels[0].device)
        with torch.no_grad():
            output = network(read_levels(levels, image[..., :2], image[..., 2] > 0))
        pixels: U8 = (output[0].permute(1, 2, 0) * 255).round().to(torch.uint8).cpu().numpy()
        return pixels

    return paint


def float_painter_of(bundle: Bundle, weights: Path) -> Painter:
    """A painter that runs the network of a file of `save_network` on the texture of `bundle`. Raises BadInputError."""
    entry = bundle.manifest.network
    network = load_network(UNet(norm=entry.norm, width=entry.width, channels=entry.channels, input_skip=True), weights)
    return float_painter(network, *levels_of(bundle))
