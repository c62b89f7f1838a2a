"""Training by a number of steps, in one process: the same settings give the same weights.

Rule: what a step does depends on its number, the settings and the state alone, so a training that was ended anywhere
goes on as if it had not been.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Iterator
from itertools import islice

import torch
from torch import Tensor, nn

from trilane.training.activation_noise import add_activation_noise
from trilane.training.adversary import Adversary
from trilane.training.batch_choice import Batch, batch_stream, is_whole, load_batch
from trilane.training.byte_grid import ByteGrid
from trilane.training.device import chosen_device
from trilane.training.dropout import add_dropout
from trilane.training.objective import Objective
from trilane.training.optimisers import clip_gradients, optimiser_of
from trilane.training.perceptual import Vgg16
from trilane.training.rounding import round_to_bytes
from trilane.training.sample_files import ShapeGroup
from trilane.training.trainable_avatar import TrainableAvatar
from trilane.training.training_settings import TrainingSettings
from trilane.training.training_state import TrainingState

#: Share of the steps in which the learning rate rises.
WARM_UP = 0.02
#: Steps that are measured to say what all will take.
MEASURED = 4
#: Moves the number of a step into the bits above the seed.
SEED_BITS = 31


def first_state(avatar: TrainableAvatar, settings: TrainingSettings, vgg: Vgg16 | None = None) -> TrainingState:
    """The state of a training of `avatar` before its first step. `vgg`: for a perceptual loss by its features."""
    device = chosen_device(settings.device)
    average = copy.deepcopy(avatar.to(device)).eval()
    harder = settings.regularisation
    avatar.texture_noise, avatar.input_noise = harder.texture_noise, harder.input_noise
    avatar.precision = settings.precision
    add_dropout(avatar.network, harder.dropout)
    add_activation_noise(avatar.network, settings.noise_steps)
    if settings.bytes_from < 1:
        avatar.grid = ByteGrid(avatar.network)  # after the noise, so that what is rounded has it
    avatar.network.to(memory_format=torch.channels_last)
    loss, rate = settings.loss, settings.discriminator_rate
    adversary = Adversary(settings.width, rate, settings.seed, device) if loss.judged else None
    objective = Objective(loss.by_name(), None if vgg is None else vgg.to(device), adversary)
    optimiser = optimiser_of(avatar, settings, settings.optimiser, settings.masked_texture)
    return TrainingState(avatar, average, optimiser, objective)


def steps(
    state: TrainingState, groups: list[ShapeGroup], settings: TrainingSettings, count: int
) -> Iterator[dict[str, float]]:
    """Do the steps of `state` up to number `count`; yields after each what `add_gradients` tells.

    `state`: changes in place.
    `groups`: the samples.
    """
    stream = batch_stream(groups, settings, count, state.step)
    peaks = (settings.network_rate, settings.network_rate, settings.texture_rate)
    while state.step < count:
        share = state.step / count
        torch.manual_seed(state.step << SEED_BITS | settings.seed)
        for group, peak in zip(state.optimiser.param_groups, peaks, strict=True):
            group["lr"] = peak * rate_share(share)  # kernels, the network's other weights, texture
        _round(state.avatar, groups, settings, share)
        terms = _step(state, stream, settings, frozen=share > settings.freeze_norms_at)
        state.step += 1
        follow(state.average, state.avatar, 1 - 1 / max(1.0, settings.average_share * state.step))
        yield terms


def _round(avatar: TrainableAvatar, groups: list[ShapeGroup], settings: TrainingSettings, share: float) -> None:
    """Round `avatar` to bytes where the `share` of the steps that is done says so; the grid is measured at first."""
    if avatar.grid is None or share <= settings.bytes_from:
        return
    round_to_bytes(avatar, avatar.grid, groups, settings.seed)


def _step(state: TrainingState, stream: Iterator[Batch], settings: TrainingSettings, frozen: bool) -> dict[str, float]:
    """One step by the mean gradient of the next batches of `stream`; the mean terms of their losses.

    `frozen`: batch statistics no longer change.
    """
    options, avatar = settings.optimiser, state.avatar
    state.optimiser.zero_grad(set_to_none=True)
    sums: dict[str, float] = {}
    for batch in islice(stream, options.batches_per_step):
        set_mode(avatar, frozen or (settings.batches.full_body_statistics and not is_whole(batch)))
        terms = add_gradients(avatar, load_batch(*batch, state.device), state.objective, 1 / options.batches_per_step)
        sums = {name: sums.get(name, 0.0) + value / options.batches_per_step for name, value in terms.items()}
    clip_gradients(avatar, options)
    state.optimiser.step()
    return sums


def add_gradients(
    avatar: TrainableAvatar, batch: tuple[Tensor, Tensor, Tensor], objective: Objective, share: float = 1.0
) -> dict[str, float]:
    """Add `share` of the gradients of `batch`, as `load_batch` returns it, to those of `avatar`; the terms by name.

    `objective`: what is minimised; its discriminators learn from every batch.
    """
    uv, covered, target = batch
    output = avatar(uv, covered)
    terms = objective.terms(output, target)
    (share * objective.total(terms)).backward()
    return {name: float(term.detach()) for name, term in terms.items()} | objective.learn(output.detach(), target)


def rate_share(share: float) -> float:
    """What learning rates are multiplied by when `share` of the training is done: up at first, then half a cosine."""
    if share < WARM_UP:
        return max(share / WARM_UP, 0.02)
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * (share - WARM_UP) / (1 - WARM_UP)))


def set_mode(avatar: TrainableAvatar, frozen: bool) -> None:
    """Put `avatar` into training mode; `frozen`: its batch statistics no longer change."""
    avatar.train()
    if frozen:
        for module in avatar.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()


def follow(average: TrainableAvatar, avatar: TrainableAvatar, keep: float) -> None:
    """Move `average` towards `avatar`; it keeps the share `keep` of itself."""
    current = avatar.state_dict()
    for name, value in average.state_dict().items():
        if value.dtype.is_floating_point:
            value.lerp_(current[name], 1 - keep)


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
        settings.model_copy(update={"small_until": small_until, "bytes_from": 1.0}),
        1 + MEASURED,
    )
    next(going)
    start = time.monotonic()
    for _ in going:
        pass
    return (time.monotonic() - start) / MEASURED
