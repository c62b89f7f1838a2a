"""How far a training's loss fell: the same samples, before the first step and after the last.

Rule: it is a loss of the avatar alone, without what discriminators find, which is another measure after each step; it
is of the weights that become the avatar, over the same backgrounds, and computing it changes nothing of the training.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from trilane.training.batch_choice import load_batch
from trilane.training.sample_files import ShapeGroup
from trilane.training.training_state import TrainingState


def probe_loss(state: TrainingState, groups: list[ShapeGroup]) -> float:
    """The mean loss of the averaged avatar of `state`, as it would be written now, over first samples of `groups`."""
    judge = replace(state.objective, adversary=None)
    losses = list[float]()
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for group in groups:
            uv, covered, target = load_batch(group, np.zeros(1, np.int64), state.device)
            losses.append(float(judge.total(judge.terms(state.average(uv, covered), target))))
    return float(np.mean(losses))
