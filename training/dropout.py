"""Dropout of whole channels after each level of encoder and decoder.

Rule: it acts in training mode only and adds no weights, so that what is exported and resumed is as without it.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn
from torch.nn import functional

from trilane.training.network import UNet


def add_dropout(network: UNet, probability: float) -> None:
    """Make each level of `network` set a channel to 0 with `probability`; the others grow, so that the mean stays."""

    def hook(module: nn.Module, _inputs: Any, output: Tensor) -> Tensor | None:
        return functional.dropout2d(output, probability) if module.training else None

    if probability:
        for level in (*network.encoder.children(), *network.levels):
            for part in level if isinstance(level, nn.ModuleList) else (level,):
                if not isinstance(part, nn.MaxPool2d):
                    part.register_forward_hook(hook)
