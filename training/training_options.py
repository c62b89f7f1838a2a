"""Options of a training, in tables of `training.toml`: the optimiser, how batches are made, what makes it harder.

Rule: it needs no PyTorch, so that settings are read, and refused, where none is installed. The defaults change nothing.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from trilane.scene.schema import Table

Repeats = Annotated[int, Field(ge=1, le=100)]


class OptimiserOptions(Table):
    """`[optimiser]`.

    `kind`: Adam (a decay of weights goes through its moments) or AdamW (it does not). `momentum`, `texture_momentum`:
    Adam's first, of network and texture; 0 is off. `second_momentum`: Adam's second, of both. `clip_norm`: the norm of
    all gradients is at most this; 0 is off. `clip_value`: each number of a gradient is at most this; 0 is off.
    `batches_per_step`: whose mean gradient makes a step.
    """

    kind: Literal["adamw", "adam"] = "adamw"
    momentum: float = Field(default=0.9, ge=0, lt=1)
    texture_momentum: float = Field(default=0.9, ge=0, lt=1)
    second_momentum: float = Field(default=0.99, ge=0, lt=1)
    clip_norm: float = Field(default=1.0, ge=0, le=1e6)
    clip_value: float = Field(default=0.0, ge=0, le=1e6)
    batches_per_step: int = Field(default=1, ge=1, le=1000)


class BatchOptions(Table):
    """`[batches]`.

    `sample_share`: of the samples, drawn once, that are used. `same_zoom`: the samples of a batch have about one zoom.
    `full_body_statistics`: batch statistics come from batches of whole bodies alone, other batches use them.
    `full_body_from`: share of the steps after which all samples show whole bodies. `repeats`: how often an epoch has a
    sample of each band: far, full body, upper body, face, anywhere.
    """

    sample_share: float = Field(default=1.0, gt=0, le=1)
    same_zoom: bool = False
    full_body_statistics: bool = False
    full_body_from: float = Field(default=1.0, ge=0, le=1)
    repeats: tuple[Repeats, Repeats, Repeats, Repeats, Repeats] = (1, 1, 1, 1, 1)


class RegularisationOptions(Table):
    """`[regularisation]`: what is done to the avatar in each step.

    `texture_noise`, `input_noise`: standard deviation of Gaussian noise on every texel, and on every number of the
    network's input. `dropout`: probability of each channel to be 0 after each level of encoder and decoder.
    """

    texture_noise: float = Field(default=0.0, ge=0, le=1)
    input_noise: float = Field(default=0.0, ge=0, le=1)
    dropout: float = Field(default=0.0, ge=0, lt=1)
