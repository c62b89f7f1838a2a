"""Noise on activations while training, so that the picture hardly changes when another runtime rounds differently.

Rule: noise is added only to positive outputs of ReLUs, is about as large as one step of a byte, and only in training.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

BYTE_STEPS = 255
#: Values that are drawn once, beyond those of the largest output: noise begins at any of them, which costs a fifth of
#: drawing all of it anew.
STARTS = 1 << 16


def add_activation_noise(network: nn.Module, steps: float) -> None:
    """Make every ReLU of `network` add noise of up to `steps` times 1/255 of its largest output, in training mode."""
    bank = torch.empty(0)

    def noise_for(output: Tensor) -> Tensor:
        """Like `output`, uniform in -1..1."""
        nonlocal bank
        if len(bank) < output.numel() + STARTS or bank.dtype != output.dtype or bank.device != output.device:
            drawn = torch.rand(output.numel() + STARTS, generator=torch.Generator().manual_seed(0))
            bank = (2 * drawn - 1).to(output.device, output.dtype)
        start = int(torch.randint(STARTS, ()))
        return torch.as_strided(bank, output.shape, output.stride(), start)

    def hook(module: nn.Module, _inputs: Any, output: Tensor) -> Tensor | None:
        if not module.training:
            return None
        shown = output.detach()
        size = shown.amax() * (steps / BYTE_STEPS)
        return torch.addcmul(output, torch.where(shown > 0, noise_for(shown), 0), size)

    for module in network.modules():
        if isinstance(module, nn.ReLU):
            module.register_forward_hook(hook)
