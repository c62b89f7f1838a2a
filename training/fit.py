"""The training loop: workers that each train a copy and exchange what they learnt with one shared avatar.

Rule: time is the budget, so the learning rate follows the share of it that is spent; nobody waits for anybody, because
a worker that shares its core with other programs must not hold up the rest; a checkpoint is always whole.

The exchange: after every few steps a worker adds a share of its own change since the last exchange to the shared
weights, and goes on from there (after Dean et al., Large scale distributed deep networks, 2012).
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

from trilane.errors import BadInputError, reason
from trilane.training.data import U16, ShapeGroup, batches, open_groups
from trilane.training.jitter import add_jitter
from trilane.training.losses import loss_terms, total_loss
from trilane.training.network import UNet
from trilane.training.texture import NeuralTexture, sample
from trilane.writing import write_atomically

#: Steps of the network's input bytes on either side of zero.
INPUT_STEPS = 127
WARM_UP = 0.02
#: Tensors with fewer pixels than this are half-size ones; only they are used at first, because they are cheap.
SMALL_PIXELS = 160 * 160
EXCHANGE_STEPS = 4
#: Share of a worker's change that the shared weights take, times the number of workers.
TOTAL_SHARE = 1.5
WATCH_S = 4.0
SAVED_WEIGHTS = "weights that this network's training saved"


@dataclass(frozen=True)
class FitConfig:
    """`minutes`: budget. `threads`: of each worker. `small_until`: share of the budget on half-size tensors.

    `freeze_norms_at`: share after which batch statistics stay as they are. `average_s`: time constant of the averaged
    weights. `repeats`: of a sample in an epoch, by its band: far, full body, upper body, face, anywhere.
    `jitter_steps`: of bytes, noise on activations.
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
    jitter_steps: float = 1.0
    report_s: float = 30.0
    checkpoint_s: float = 180.0
    max_steps: int = 10_000_000


class Avatar(nn.Module):
    """Texture and network: a UV image to a picture."""

    def __init__(self, texture: NeuralTexture, network: UNet) -> None:
        super().__init__()
        self.texture, self.network = texture, network

    def forward(self, uv: Tensor, covered: Tensor) -> Tensor:
        """`uv` (N,H,W,2) 0..1 and `covered` (N,H,W) bool -> (N,4,H,W), 0..1. The input is rounded as bytes are."""
        x = sample(self.texture.image(), uv, covered)
        rounded = torch.round(x * INPUT_STEPS) / INPUT_STEPS
        output: Tensor = self.network(x + (rounded - x).detach())
        return output


def load_batch(group: ShapeGroup, index: NDArray[np.int64]) -> tuple[Tensor, Tensor, Tensor]:
    """`uv`, `covered` and the target (N,4,H,W) in 0..1 of samples `index`."""
    uv = torch.from_numpy(group.uv[index].astype(np.float32) / U16)
    covered = torch.from_numpy(group.covered[index] > 0)
    target = torch.from_numpy(group.rgba[index].astype(np.float32) / 255).permute(0, 3, 1, 2)
    return uv, covered, target


def fit(
    avatar: Avatar,
    data: Path,
    config: FitConfig,
    report: Callable[[str], None],
    checkpoint: Callable[[Avatar, int], None],
) -> tuple[Avatar, int]:
    """Train `avatar` on the samples in folder `data`; its average over the last minutes, and the number of steps.

    `checkpoint` gets the average so far and the step.
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
            _follow(average, shared, math.exp(-WATCH_S / max(age, WATCH_S)))
        if now - last_report >= config.report_s:
            report(f"{spent(config, start):6.1%} step {steps.value} " + _terms_text(terms))
            last_report = now
        if now - last_checkpoint >= config.checkpoint_s:
            checkpoint(average, steps.value)
            last_checkpoint = now
    return average.eval(), int(steps.value)


def spent(config: FitConfig, start: float) -> float:
    """Share of the budget that is gone."""
    return (time.time() - start) / (60 * config.minutes)


def _worker(
    number: int, shared: Avatar, data: Path, config: FitConfig, start: float, steps: Any, terms: Tensor, lock: Any
) -> None:
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed + number)
    avatar = copy.deepcopy(shared)
    add_jitter(avatar.network, config.jitter_steps)
    avatar.network.to(memory_format=torch.channels_last)
    optimiser = _optimiser(avatar, config)
    peaks = [group["lr"] for group in optimiser.param_groups]
    groups = open_groups(data)
    small = [group for group in groups if math.prod(group.shape) < SMALL_PIXELS]
    streams = [
        batches(some or groups, config.batch, np.random.default_rng((config.seed, number, k)), config.repeats)
        for k, some in enumerate((small, groups))
    ]
    before, parent = _copy(avatar), os.getppid()
    for step in range(config.max_steps):
        share = spent(config, start)
        if share >= 1 or os.getppid() != parent:
            break
        _set_mode(avatar, frozen=share > config.freeze_norms_at)
        for parameters, peak in zip(optimiser.param_groups, peaks, strict=True):
            parameters["lr"] = peak * _schedule(share)
        values = train_step(avatar, optimiser, *load_batch(*next(streams[share >= config.small_until])))
        with lock:
            steps.value += 1
            terms[: len(values)].lerp_(torch.tensor(list(values.values())), 0.02 if steps.value > 50 else 0.3)
        if step % EXCHANGE_STEPS == EXCHANGE_STEPS - 1:
            with lock:
                _exchange(avatar, before, shared, TOTAL_SHARE / config.workers if config.workers > 1 else 1.0)


def train_step(
    avatar: Avatar, optimiser: torch.optim.Optimizer, uv: Tensor, covered: Tensor, target: Tensor
) -> dict[str, float]:
    """One step on one batch; the loss terms by name."""
    terms = loss_terms(avatar(uv, covered), target)
    optimiser.zero_grad(set_to_none=True)
    total_loss(terms).backward()
    nn.utils.clip_grad_norm_(avatar.parameters(), 1.0)
    optimiser.step()
    return {name: float(term.detach()) for name, term in terms.items()}


def save_avatar(avatar: Avatar, steps: int, path: Path) -> None:
    """Write all weights and the number of steps as the .npz file `path`, whole or not at all. Raises BadInputError."""
    with write_atomically(path) as draft, draft.open("wb") as file:
        np.savez(file, steps=steps, **{name: value.detach().numpy() for name, value in avatar.state_dict().items()})


def load_avatar(avatar: Avatar, path: Path) -> tuple[Avatar, int]:
    """Read what `save_avatar` wrote into `avatar`; the number of steps. Raises BadInputError."""
    weights = _read_weights(path)
    steps = int(weights.pop("steps", torch.tensor(0)))
    _fill(avatar, weights, path)
    return avatar.eval(), steps


def load_network(network: UNet, path: Path) -> UNet:
    """Read the network of what `save_avatar` or `save_network` wrote into `network`. Raises BadInputError."""
    weights = _read_weights(path)
    prefix = "network."
    _fill(network, {k.removeprefix(prefix): v.float() for k, v in weights.items() if k.startswith(prefix)}, path)
    return network


def save_network(avatar: Avatar, path: Path) -> None:
    """Write the network alone in half precision: small enough to be kept, and enough to go on training from.

    Raises BadInputError when `path` cannot be written.
    """
    weights = {f"network.{name}": value.detach().numpy() for name, value in avatar.network.state_dict().items()}
    halves = {name: value.astype(np.float16) for name, value in weights.items() if value.dtype.kind == "f"}
    with write_atomically(path) as draft, draft.open("wb") as file:
        np.savez_compressed(file, **halves)


def _read_weights(path: Path) -> dict[str, Tensor]:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {name: torch.from_numpy(arrays[name]) for name in arrays.files}
    except (OSError, ValueError, KeyError) as error:
        raise BadInputError(path, reason(error).splitlines()[0], SAVED_WEIGHTS) from error


def _fill(module: nn.Module, weights: dict[str, Tensor], path: Path) -> None:
    """Every floating-point weight of `module` has to be there; counters of batches may be left out."""
    try:
        missing, unexpected = module.load_state_dict(weights, strict=False)
    except RuntimeError as error:
        raise BadInputError(path, str(error).splitlines()[-1].strip(), SAVED_WEIGHTS) from error
    missing = [name for name in missing if not name.endswith("num_batches_tracked")]
    if missing or unexpected:
        raise BadInputError(path, f"no {missing[0]}" if missing else f"also {unexpected[0]}", SAVED_WEIGHTS)


def _optimiser(avatar: Avatar, config: FitConfig) -> torch.optim.Optimizer:
    kernels = [p for p in avatar.network.parameters() if p.ndim > 1]
    others = [p for p in avatar.network.parameters() if p.ndim <= 1]
    groups = [
        {"params": kernels, "lr": config.network_rate, "weight_decay": config.weight_decay},
        {"params": others, "lr": config.network_rate, "weight_decay": 0.0},
        {"params": list(avatar.texture.parameters()), "lr": config.texture_rate, "weight_decay": config.weight_decay},
    ]
    return torch.optim.AdamW(groups, betas=(0.9, 0.99))


def _schedule(share: float) -> float:
    if share < WARM_UP:
        return max(share / WARM_UP, 0.02)
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * (share - WARM_UP) / (1 - WARM_UP)))


def _set_mode(avatar: Avatar, frozen: bool) -> None:
    avatar.train()
    if frozen:
        for module in avatar.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()


def _copy(avatar: Avatar) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in avatar.state_dict().items()}


def _exchange(avatar: Avatar, before: dict[str, Tensor], shared: Avatar, share: float) -> None:
    """Weights: add the change and take the sum. Batch statistics: meet half way, so variances stay positive."""
    common, learnt = shared.state_dict(), {name for name, _ in avatar.named_parameters()}
    for name, value in avatar.state_dict().items():
        if name in learnt:
            common[name].add_(value - before[name], alpha=share)
            value.copy_(common[name])
            before[name].copy_(value)
        elif value.dtype.is_floating_point:
            common[name].lerp_(value, 0.5)
            value.copy_(common[name])


def _follow(average: Avatar, avatar: Avatar, keep: float) -> None:
    current = avatar.state_dict()
    for name, value in average.state_dict().items():
        if value.dtype.is_floating_point:
            value.lerp_(current[name], 1 - keep)


def _terms_text(terms: Tensor) -> str:
    names = list(loss_terms(torch.full((1, 4, 32, 32), 0.5), torch.full((1, 4, 32, 32), 0.5)))
    return " ".join(f"{name} {float(value):.4f}" for name, value in zip(names, terms, strict=False))
