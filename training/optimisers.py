"""The optimiser of an avatar: Adam or AdamW, of three groups of parameters.

Rule: a group is what shares a learning rate, a decay and moments; the table says which class steps it.
"""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import nn

from trilane.training.masked_adam import MASKED, MaskedAdam, MaskedAdamW
from trilane.training.trainable_avatar import TrainableAvatar
from trilane.training.training_options import OptimiserOptions

#: By kind, and whether texels without a gradient stay.
CLASSES: dict[tuple[str, bool], type[torch.optim.Optimizer]] = {
    ("adamw", False): torch.optim.AdamW,
    ("adamw", True): MaskedAdamW,
    ("adam", False): torch.optim.Adam,
    ("adam", True): MaskedAdam,
}
USUAL = OptimiserOptions()


class Rates(Protocol):
    """Learning rates of network and texture, and the decay of weights."""

    @property
    def network_rate(self) -> float: ...

    @property
    def texture_rate(self) -> float: ...

    @property
    def weight_decay(self) -> float: ...


def optimiser_of(
    avatar: TrainableAvatar, rates: Rates, options: OptimiserOptions = USUAL, masked: bool = False
) -> torch.optim.Optimizer:
    """What steps `avatar`: its kernels, the network's other weights, which do not decay, and its texture.

    `rates`: learning rates and decay.
    `options`: kind and momenta.
    `masked`: texels without a gradient stay as they are, with their moments.
    """
    kernels = [p for p in avatar.network.parameters() if p.ndim > 1]
    others = [p for p in avatar.network.parameters() if p.ndim <= 1]
    texture = list(avatar.texture.parameters())
    rows = (
        (kernels, rates.network_rate, rates.weight_decay, options.momentum),
        (others, rates.network_rate, 0.0, options.momentum),
        (texture, rates.texture_rate, rates.weight_decay, options.texture_momentum),
    )
    groups: list[dict[str, Any]] = [
        {"params": params, "lr": rate, "weight_decay": decay, "betas": (momentum, options.second_momentum)}
        for params, rate, decay, momentum in rows
    ]
    if masked:
        groups[-1][MASKED] = True
    return CLASSES[options.kind, masked](groups, lr=rates.network_rate)


def clip_gradients(module: nn.Module, options: OptimiserOptions = USUAL) -> None:
    """Limit the gradients of `module`: each number by `clip_value`, then the norm of all by `clip_norm`. In place."""
    if options.clip_value:
        nn.utils.clip_grad_value_(module.parameters(), options.clip_value)
    if options.clip_norm:
        nn.utils.clip_grad_norm_(module.parameters(), options.clip_norm)
