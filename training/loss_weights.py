"""Weights of the terms of the loss, by name.

Rule: it needs no PyTorch, so that settings are read, and refused, where none is installed.
"""

from __future__ import annotations

from pydantic import Field

from trilane.scene.schema import Table


class LossWeights(Table):
    """Of each term of `losses.loss_terms`; 0 leaves it out. The defaults are the default avatar's.

    The thesis has L1 25, Dice 25 and a perceptual loss 20, which here are `composite`, `overlap` and `structure`.
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

    def by_name(self) -> dict[str, float]:
        """The weights as `losses.total_loss` takes them."""
        return {str(name): float(value) for name, value in self.model_dump().items()}
