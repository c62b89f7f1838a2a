"""Training by a number of steps, in one process: the same settings give the same weights.

Rule: what a step does depends on its number, the settings and the state alone, so a training that was ended anywhere
goes on as if it had not been. `training_loop.py` is the other loop, of processes that share a budget of time.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Iterator
from itertools import islice

import numpy as np
import torch
from numpy.typing import NDArray

from trilane.training.activation_noise import add_activation_noise
from trilane.training.adversary import Adversary
from trilane.training.objective import Objective
from trilane.training.perceptual import Vgg16
from trilane.training.sample_files import ShapeGroup, batches
from trilane.training.trainable_avatar import TrainableAvatar
from trilane.training.training_loop import (
    SMALL_PIXELS,
    follow,
    load_batch,
    optimiser_of,
    rate_share,
    set_mode,
    train_step,
)
from trilane.training.training_settings import TrainingSettings
from trilane.training.training_state import TrainingState

#: Steps that are measured to say what all will take.
MEASURED = 4
#: Moves the number of a step into the bits above the seed.
SEED_BITS = 31


def first_state(avatar: TrainableAvatar, settings: TrainingSettings, vgg: Vgg16 | None = None) -> TrainingState:
    """The state of a training of `avatar` before its first step. `vgg`: for a perceptual loss by its features."""
    average = copy.deepcopy(avatar).eval()
    add_activation_noise(avatar.network, settings.noise_steps)
    avatar.network.to(memory_format=torch.channels_last)
    loss, rate = settings.loss, settings.discriminator_rate
    adversary = Adversary(settings.width, rate, settings.seed) if loss.judged else None
    objective = Objective(loss.by_name(), vgg, adversary)
    return TrainingState(avatar, average, optimiser_of(avatar, settings, settings.masked_texture), objective)


def steps(
    state: TrainingState, groups: list[ShapeGroup], settings: TrainingSettings, count: int
) -> Iterator[dict[str, float]]:
    """Do the steps of `state` up to number `count`; yields after each what `train_step` tells.

    `state`: changes in place.
    `groups`: the samples.
    """
    small = [group for group in groups if math.prod(group.shape) < SMALL_PIXELS] or groups
    switch = math.ceil(settings.small_until * count)
    streams = (_stream(small, settings, 0), _stream(groups, settings, 1))
    done = (min(state.step, switch), max(state.step - switch, 0))
    first, then = (islice(stream, skipped, None) for stream, skipped in zip(streams, done, strict=True))
    peaks = (settings.network_rate, settings.network_rate, settings.texture_rate)
    while state.step < count:
        share = state.step / count
        torch.manual_seed(state.step << SEED_BITS | settings.seed)
        set_mode(state.avatar, frozen=share > settings.freeze_norms_at)
        for group, peak in zip(state.optimiser.param_groups, peaks, strict=True):
            group["lr"] = peak * rate_share(share)  # kernels, the network's other weights, texture
        batch = load_batch(*next(first if state.step < switch else then))
        terms = train_step(state.avatar, state.optimiser, *batch, state.objective)
        state.step += 1
        follow(state.average, state.avatar, 1 - 1 / max(1.0, settings.average_share * state.step))
        yield terms


def step_seconds(
    avatar: TrainableAvatar, groups: list[ShapeGroup], settings: TrainingSettings, vgg: Vgg16 | None = None
) -> float:
    """Mean seconds of a step of a copy of `avatar`, measured; small samples count by their share of the steps."""
    share = settings.small_until
    of_small = _measured(avatar, groups, settings, vgg, 1.0) if share > 0 else 0.0
    of_all = _measured(avatar, groups, settings, vgg, 0.0) if share < 1 else 0.0
    return share * of_small + (1 - share) * of_all


def _measured(
    avatar: TrainableAvatar,
    groups: list[ShapeGroup],
    settings: TrainingSettings,
    vgg: Vgg16 | None,
    small_until: float,
) -> float:
    """Mean seconds of a step, after one that warms up."""
    going = steps(
        first_state(copy.deepcopy(avatar), settings, vgg),
        groups,
        settings.model_copy(update={"small_until": small_until}),
        1 + MEASURED,
    )
    next(going)
    start = time.monotonic()
    for _ in going:
        pass
    return (time.monotonic() - start) / MEASURED


def _stream(
    groups: list[ShapeGroup], settings: TrainingSettings, phase: int
) -> Iterator[tuple[ShapeGroup, NDArray[np.int64]]]:
    return batches(groups, settings.batch, np.random.default_rng((settings.seed, 2, phase)))
