"""Weights of the terms of the loss, by name.

Rule: it needs no PyTorch, so that settings are read, and refused, where none is installed.
"""

from __future__ import annotations

from pydantic import Field

from trilane.scene.schema import Table


class LossWeights(Table):
    """Of each term of `losses.loss_terms`; 0 leaves it out. The defaults are the default avatar's.

    `perceptual` is by features of VGG-16 where their weights are given, else one minus MS-SSIM, as `structure` always
    is. `adversarial` and `features` (feature matching) bring discriminators.
    """

    composite: float = Field(default=0.4, ge=0, le=1000)
    decibels: float = Field(default=0.03, ge=0, le=1000)
    colour: float = Field(default=0.1, ge=0, le=1000)
    edges: float = Field(default=0.2, ge=0, le=1000)
    coarse: float = Field(default=0.2, ge=0, le=1000)
    mask: float = Field(default=0.1, ge=0, le=1000)
    background: float = Field(default=0.05, ge=0, le=1000)
    overlap: float = Field(default=0.1, ge=0, le=1000)
    structure: float = Field(default=0.0, ge=0, le=1000)
    perceptual: float = Field(default=0.0, ge=0, le=1000)
    adversarial: float = Field(default=0.0, ge=0, le=1000)
    features: float = Field(default=0.0, ge=0, le=1000)

    @property
    def judged(self) -> bool:
        """Whether a term is about what discriminators find."""
        return self.adversarial > 0 or self.features > 0

    def by_name(self) -> dict[str, float]:
        """The weights as `losses.total_loss` takes them."""
        return {str(name): float(value) for name, value in self.model_dump().items()}
