"""Adam and AdamW that leave numbers without a gradient as they are, with their moments.

Rule: a texel that a batch does not show is no texel whose gradient is 0: plain Adam would go on moving it by its old
momentum, let that fade, and let its weight decay.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

#: Key of the groups of parameters that are masked.
MASKED = "masked"
MOMENTS = ("exp_avg", "exp_avg_sq")


class _Masked(torch.optim.Optimizer):
    """What is put before a class of Adam.

    In groups of parameters with `masked`, numbers whose gradient is exactly 0 do not take part in a step. The count of
    steps, which corrects the moments' bias, goes on for all, as in `torch.optim.SparseAdam`.
    """

    def step(self, closure: Callable[[], float] | None = None) -> Any:
        """As the class behind this one."""
        groups = [group for group in self.param_groups if group.get(MASKED)]
        kept = [
            self._kept(parameter) for group in groups for parameter in group["params"] if parameter.grad is not None
        ]
        loss = super().step(closure)
        for parameter, unseen, values in kept:
            for tensor, before in zip(self._tensors(parameter), values, strict=True):
                tensor.data[unseen] = before
        return loss

    def _kept(self, parameter: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """`parameter`, where it has no gradient, and what it and its moments have there; moments begin at 0."""
        unseen = parameter.grad == 0
        if self.state[parameter]:
            return parameter, unseen, [tensor.data[unseen].clone() for tensor in self._tensors(parameter)]
        value = parameter.data[unseen].clone()
        return parameter, unseen, [value, *(torch.zeros_like(value) for _ in MOMENTS)]

    def _tensors(self, parameter: Tensor) -> list[Tensor]:
        return [parameter, *(self.state[parameter][name] for name in MOMENTS)]


class MaskedAdam(_Masked, torch.optim.Adam):
    """Adam, whose weight decay is part of the gradient and so is left out where there is none."""


class MaskedAdamW(_Masked, torch.optim.AdamW):
    """AdamW."""
