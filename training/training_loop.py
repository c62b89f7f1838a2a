"""The training loop: worker processes that each train a copy of the avatar and exchange weights with a shared one.

Rule: the budget is time, so the learning rate depends on the share of it that is spent. No worker waits for another,
because one that shares its core with other programs must not delay the rest.

The exchange: after every few steps a worker adds a share of its change since the last exchange to the shared weights
and continues from the sum (after Dean et al., Large scale distributed deep networks, 2012).
"""

from __future__ import annotations

import copy
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch import multiprocessing as tmp

from trilane.training.activation_noise import add_activation_noise
from trilane.training.byte_grid import ByteGrid
from trilane.training.losses import WEIGHTS
from trilane.training.objective import Objective
from trilane.training.optimisers import clip_gradients, optimiser_of
from trilane.training.rounding import round_to_bytes
from trilane.training.sample_files import U16, ShapeGroup, batches, open_groups
from trilane.training.trainable_avatar import Precision, TrainableAvatar

#: Share of the budget in which the learning rate rises.
WARM_UP = 0.02
#: Tensors with fewer pixels are half-size ones, which alone are used at first because they are cheap.
SMALL_PIXELS = 160 * 160
EXCHANGE_STEPS = 4
#: The shared weights take this share of a worker's change, divided by the number of workers.
TOTAL_SHARE = 1.5
#: Seconds between two looks of the main process at its workers.
WATCH_S = 4.0


@dataclass(frozen=True)
class FitConfig:
    """Settings of one training.

    `minutes`: the budget.
    `threads`: of each worker.
    `small_until`: share of the budget that is spent on half-size tensors.
    `freeze_norms_at`: share of the budget after which batch statistics no longer change.
    `average_s`: time constant of the average of the weights.
    `repeats`: how often an epoch has a sample, by its band: far, full body, upper body, face, anywhere.
    `noise_steps`: size of the noise on activations, in steps of a byte.
    `precision`: of the network while it is trained.
    `bytes_from`: share of the budget after which weights and activations are rounded as the bundle's are.
    """

    minutes: float
    workers: int = 3
    threads: int = 1
    batch: int = 4
    seed: int = 0
    network_rate: float = 1.5e-3
    texture_rate: float = 4e-4
    weight_decay: float = 1e-3
    small_until: float = 0.12
    freeze_norms_at: float = 0.6
    average_s: float = 60.0
    repeats: tuple[int, ...] = (1, 1, 1, 1, 1)
    noise_steps: float = 1.0
    report_s: float = 30.0
    checkpoint_s: float = 180.0
    max_steps: int = 10_000_000
    precision: Precision = "float32"
    bytes_from: float = 1.0


def load_batch(
    group: ShapeGroup, index: NDArray[np.int64], device: torch.device | str = "cpu"
) -> tuple[Tensor, Tensor, Tensor]:
    """`uv` (N,H,W,2) in 0..1, `covered` (N,H,W) bool and the target (N,4,H,W) in 0..1 of the samples `index` (N,)."""
    uv = torch.from_numpy(group.uv[index].astype(np.float32) / U16)
    covered = torch.from_numpy(group.covered[index] > 0)
    target = torch.from_numpy(group.rgba[index].astype(np.float32) / 255).permute(0, 3, 1, 2)
    return uv.to(device), covered.to(device), target.to(device)


def fit(
    avatar: TrainableAvatar,
    data: Path,
    config: FitConfig,
    report: Callable[[str], None],
    checkpoint: Callable[[TrainableAvatar, int], None],
) -> tuple[TrainableAvatar, int]:
    """Train an avatar; the average of its weights over the last minutes, and the number of steps.

    `avatar`: what to start from; its weights become the shared ones.
    `data`: the folder of the samples.
    `config`: the settings.
    `report`: takes a line of progress.
    `checkpoint`: takes the average so far and the number of steps, every `checkpoint_s`.
    """
    shared = avatar.share_memory()
    average = copy.deepcopy(avatar)
    start, steps, terms = time.time(), tmp.get_context("spawn").Value("q", 0), torch.zeros(16).share_memory_()
    lock = tmp.get_context("spawn").Lock()
    work = (shared, data, config, start, steps, terms, lock)
    pool = tmp.spawn(_worker, work, nprocs=config.workers, join=False)
    last_report = last_checkpoint = start
    while not pool.join(timeout=WATCH_S):
        now = time.time()
        if steps.value:
            age = min(config.average_s, 0.2 * (now - start))
            follow(average, shared, math.exp(-WATCH_S / max(age, WATCH_S)))
        if now - last_report >= config.report_s:
            report(f"{spent(config, start):6.1%} step {steps.value} " + _terms_text(terms))
            last_report = now
        if now - last_checkpoint >= config.checkpoint_s:
            checkpoint(average, steps.value)
            last_checkpoint = now
    return average.eval(), int(steps.value)


def spent(config: FitConfig, start: float) -> float:
    """Share of the budget that is spent; `start`: `time.time()` at the beginning."""
    return (time.time() - start) / (60 * config.minutes)


def _worker(
    number: int,
    shared: TrainableAvatar,
    data: Path,
    config: FitConfig,
    start: float,
    steps: Any,
    terms: Tensor,
    lock: Any,
) -> None:
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed + number)
    avatar = copy.deepcopy(shared)
    avatar.precision = config.precision
    add_activation_noise(avatar.network, config.noise_steps)
    grid = avatar.grid = ByteGrid(avatar.network) if config.bytes_from < 1 else None
    avatar.network.to(memory_format=torch.channels_last)
    optimiser = optimiser_of(avatar, config)
    peaks = [group["lr"] for group in optimiser.param_groups]
    groups = open_groups(data)
    small = [group for group in groups if math.prod(group.shape) < SMALL_PIXELS]
    streams = [
        batches(subset or groups, config.batch, np.random.default_rng((config.seed, number, k)), config.repeats)
        for k, subset in enumerate((small, groups))
    ]
    before, parent = _copy(avatar), os.getppid()
    for step in range(config.max_steps):
        share = spent(config, start)
        if share >= 1 or os.getppid() != parent:
            break
        set_mode(avatar, frozen=share > config.freeze_norms_at)
        if grid is not None and share > config.bytes_from:
            round_to_bytes(avatar, grid, groups, config.seed)
        for parameters, peak in zip(optimiser.param_groups, peaks, strict=True):
            parameters["lr"] = peak * rate_share(share)
        values = train_step(avatar, optimiser, *load_batch(*next(streams[share >= config.small_until])))
        with lock:
            steps.value += 1
            terms[: len(values)].lerp_(torch.tensor(list(values.values())), 0.02 if steps.value > 50 else 0.3)
        if step % EXCHANGE_STEPS == EXCHANGE_STEPS - 1:
            with lock:
                _exchange(avatar, before, shared, TOTAL_SHARE / config.workers if config.workers > 1 else 1.0)


def train_step(
    avatar: TrainableAvatar,
    optimiser: torch.optim.Optimizer,
    uv: Tensor,
    covered: Tensor,
    target: Tensor,
    objective: Objective | None = None,
) -> dict[str, float]:
    """One step on one batch; the loss terms by name, and what the objective tells of itself.

    `avatar`, `optimiser`: what is trained.
    `uv`, `covered`, `target`: the batch, as `load_batch` returns it.
    `objective`: what is minimised; the default avatar's where there is none.
    """
    optimiser.zero_grad(set_to_none=True)
    terms = add_gradients(avatar, (uv, covered, target), objective or Objective())
    clip_gradients(avatar)
    optimiser.step()
    return terms


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


def _copy(avatar: TrainableAvatar) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in avatar.state_dict().items()}


def _exchange(avatar: TrainableAvatar, before: dict[str, Tensor], shared: TrainableAvatar, share: float) -> None:
    """Add `share` of the change since `before` to the shared weights and continue from the sum.

    Batch statistics of both are set to their mean instead, so that variances stay positive.
    """
    common, weights = shared.state_dict(), {name for name, _ in avatar.named_parameters()}
    for name, value in avatar.state_dict().items():
        if name in weights:
            common[name].add_(value - before[name], alpha=share)
            value.copy_(common[name])
            before[name].copy_(value)
        elif value.dtype.is_floating_point:
            common[name].lerp_(value, 0.5)
            value.copy_(common[name])


def follow(average: TrainableAvatar, avatar: TrainableAvatar, keep: float) -> None:
    """Move `average` towards `avatar`; it keeps the share `keep` of itself."""
    current = avatar.state_dict()
    for name, value in average.state_dict().items():
        if value.dtype.is_floating_point:
            value.lerp_(current[name], 1 - keep)


def _terms_text(terms: Tensor) -> str:
    return " ".join(f"{name} {float(value):.4f}" for name, value in zip(WEIGHTS, terms, strict=False))
