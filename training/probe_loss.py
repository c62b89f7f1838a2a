"""How far a training's loss fell: the same samples, before the first step and after the last.

Rule: it is a loss of the avatar alone, without what discriminators find, which is another measure after each step; it
is of the weights that become the avatar, and computing it changes nothing of the training.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from trilane.training.objective import Objective
from trilane.training.sample_files import ShapeGroup
from trilane.training.trainable_avatar import TrainableAvatar
from trilane.training.training_loop import load_batch
from trilane.training.training_state import TrainingState

#: Samples of each shape, evenly among them.
SAMPLES = 3


def probe_loss(state: TrainingState, groups: list[ShapeGroup]) -> float:
    """The mean loss of the averaged avatar of `state` over the shapes of `groups`.

    Before the first step it is the lesser of two: with the statistics of each batch, and with those that are stored,
    which a new network has not learned yet.
    """
    judge = replace(state.objective, adversary=None)
    ways = (False,) if state.step else (False, True)
    return min(_loss(copy.deepcopy(state.average).train(way), judge, _batches(state, groups)) for way in ways)


def _batches(state: TrainingState, groups: list[ShapeGroup]) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    for group in groups:
        index = np.unique(np.linspace(0, len(group) - 1, SAMPLES).astype(np.int64))
        yield load_batch(group, index, state.device)


def _loss(avatar: TrainableAvatar, judge: Objective, batches: Iterator[tuple[Tensor, Tensor, Tensor]]) -> float:
    with torch.no_grad():
        losses = [float(judge.total(judge.terms(avatar(uv, covered), target))) for uv, covered, target in batches]
    return float(np.mean(losses))
