"""Noise on activations while training, so that the picture hardly changes when another runtime rounds differently.

Rule: noise is added only to positive outputs of ReLUs, is about as large as one step of a byte, and only in training.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

BYTE_STEPS = 255


def add_activation_noise(network: nn.Module, steps: float) -> None:
    """Make every ReLU of `network` add noise of up to `steps` times 1/255 of its largest output, in training mode."""

    def hook(module: nn.Module, _inputs: Any, output: Tensor) -> Tensor | None:
        if not module.training:
            return None
        size = output.detach().amax() * (2 * steps / BYTE_STEPS)
        noise = torch.rand_like(output).sub_(0.5).mul_(size).mul_(output.detach() > 0)
        return output + noise

    for module in network.modules():
        if isinstance(module, nn.ReLU):
            module.register_forward_hook(hook)
