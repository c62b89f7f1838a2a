"""What is trained: a neural texture and a network, which turn a UV image into a picture.

Rule: while training, the network's input is rounded to as many steps as its bytes have in the pipeline.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from trilane.training.network import UNet
from trilane.training.neural_texture import NeuralTexture, read_texture

#: Steps of the network's input bytes on each side of zero.
INPUT_STEPS = 127


class TrainableAvatar(nn.Module):
    """A neural texture and the network that reads it."""

    def __init__(self, texture: NeuralTexture, network: UNet) -> None:
        super().__init__()
        self.texture, self.network = texture, network

    def forward(self, uv: Tensor, covered: Tensor) -> Tensor:
        """`uv` (N,H,W,2) in 0..1 and `covered` (N,H,W) bool to pictures (N,4,H,W) in 0..1."""
        x = read_texture(self.texture.image(), uv, covered)
        rounded = torch.round(x * INPUT_STEPS) / INPUT_STEPS
        output: Tensor = self.network(x + (rounded - x).detach())
        return output
