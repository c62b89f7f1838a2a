"""What is trained: a neural texture and a network, which turn a UV image into a picture.

Rule: while training, the network's input is rounded to as many steps as its bytes have in the pipeline. Noise, where
there is any, is in training mode alone.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from trilane.training.byte_grid import ByteGrid
from trilane.training.mip_levels import read_levels
from trilane.training.network import UNet
from trilane.training.neural_texture import NeuralTexture

Precision = Literal["float32", "bfloat16"]
#: Steps of the network's input bytes on each side of zero.
INPUT_STEPS = 127


class TrainableAvatar(nn.Module):
    """A neural texture and the network that reads it.

    `texture_noise`, `input_noise`: standard deviation of Gaussian noise on texels, and on the network's input. `grid`:
    rounds weights and activations, where it is active.
    """

    #: "bfloat16": the network is computed in it where that is safe; weights, texture and loss stay float32.
    precision: Precision = "float32"

    def __init__(self, texture: NeuralTexture, network: UNet) -> None:
        super().__init__()
        self.texture, self.network = texture, network
        self.texture_noise = self.input_noise = 0.0
        self.grid: ByteGrid | None = None

    def forward(self, uv: Tensor, covered: Tensor) -> Tensor:
        """`uv` (N,H,W,2) in 0..1 and `covered` (N,H,W) bool to pictures (N,4,H,W) in 0..1."""
        levels = [self._noisy(level, self.texture_noise) for level in self.texture.levels()]
        x = read_levels(levels, uv, covered)
        x = self._noisy(x, self.input_noise)
        rounded = torch.round(x * INPUT_STEPS) / INPUT_STEPS
        x = x + (rounded - x).detach()
        rounds = self.grid is not None and self.grid.active
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.precision == "bfloat16"):
            output: Tensor = self.grid.painted(self.network, x) if self.grid and rounds else self.network(x)
        return output.float()

    def _noisy(self, x: Tensor, deviation: float) -> Tensor:
        return x + deviation * torch.randn_like(x) if self.training and deviation else x
