"""What a training by steps minimises as a whole: the terms of `losses.py`, and those that need networks of their own.

Rule: a term is computed only where it has a weight, and the same step on the same pictures gives the same numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor

from trilane.training.adversary import Adversary
from trilane.training.losses import WEIGHTS, composite, drawn_behind, loss_terms, total_loss
from trilane.training.perceptual import Vgg16
from trilane.training.structural_similarity import ms_ssim

PERCEPTUAL = "perceptual"
#: What discriminators err by, bits; told with the terms, but not one of them.
JUDGES = "discriminators"


@dataclass(frozen=True)
class Objective:
    """`weights` of the terms, by name. `vgg`: for the perceptual loss, in place of MS-SSIM. `adversary`: if any."""

    weights: Mapping[str, float] = field(default_factory=lambda: WEIGHTS)
    vgg: Vgg16 | None = None
    adversary: Adversary | None = None

    def terms(self, output: Tensor, target: Tensor) -> dict[str, Tensor]:
        """The terms by name, before weighting, over backgrounds that are drawn here.

        `output`, `target` (N, 4, H, W): straight colour and mask, 0..1.
        """
        behind = drawn_behind(target)
        terms = loss_terms(output, target, behind, self.weights)
        if self.weights.get(PERCEPTUAL):
            shown, wanted = composite(output, behind), composite(target, behind)
            distance = 1 - ms_ssim(shown, wanted) if self.vgg is None else self.vgg.distance(shown, wanted)
            terms[PERCEPTUAL] = distance.mean()
        return terms if self.adversary is None else terms | self.adversary.terms(output, target, behind)

    def total(self, terms: Mapping[str, Tensor]) -> Tensor:
        """The weighted sum of `terms`, which is minimised."""
        return total_loss(terms, self.weights)

    def learn(self, output: Tensor, target: Tensor) -> dict[str, float]:
        """What of this objective is trained itself takes a step on these pictures; what that tells, by name."""
        return {} if self.adversary is None else {JUDGES: self.adversary.learn(output, target, drawn_behind(target))}
