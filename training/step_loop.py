"""Training by a number of steps, in one process: the same settings give the same weights.

Rule: a step depends only on its number, the settings and the state. A resumed training therefore gives the same weights
as one that was never interrupted.
"""

from __future__ import annotations

import copy
import ctypes
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch
from torch import Tensor, nn

from trilane.errors import BadInputError, MissingPartError, package_line, reason
from trilane.files import DAMAGED
from trilane.training.dataset import Batch, ShapeGroup, batch_stream, is_whole
from trilane.training.make_bundle import round_to_bytes
from trilane.training.network import add_activation_noise, add_dropout
from trilane.training.objective import Adversary, Objective, Vgg16
from trilane.training.trainable_avatar import ByteGrid, TrainableAvatar, load_batch
from trilane.training.training_settings import OptimiserOptions, TrainingSettings
from trilane.writing import write_atomically

#: The learning rate rises during this share of the steps, at the beginning.
WARM_UP = 0.02
#: Number of steps that are measured to estimate the duration of a training.
MEASURED = 4
#: The random seed of a step has the training's seed in this many low bits, and the step's number above them.
SEED_BITS = 31


def first_state(avatar: TrainableAvatar, settings: TrainingSettings, vgg: Vgg16 | None = None) -> TrainingState:
    """Return the state of a training of `avatar` before the first step.

    `avatar` changes in place: it moves to the chosen device, and gets the noise, dropout and precision of `settings`.
    If `settings` round to bytes, it gets a byte grid too.
    `vgg`: network of the perceptual loss; None if MS-SSIM replaces it or the loss has no such term.
    Raises MissingPartError as `chosen_device` does.
    """
    device = chosen_device(settings.device)
    average = copy.deepcopy(avatar.to(device)).eval()
    harder = settings.regularisation
    avatar.texture_noise, avatar.input_noise = harder.texture_noise, harder.input_noise
    avatar.precision = settings.precision
    add_dropout(avatar.network, harder.dropout)
    add_activation_noise(avatar.network, settings.noise_steps)
    if settings.bytes_from < 1:
        avatar.grid = ByteGrid(avatar.network)  # the grid follows the noise, so that noisy activations are rounded
    avatar.network.to(memory_format=torch.channels_last)
    loss, rate = settings.loss, settings.discriminator_rate
    adversary = Adversary(settings.width, rate, settings.seed, device) if loss.judged else None
    objective = Objective(loss.by_name(), None if vgg is None else vgg.to(device), adversary)
    optimiser = optimiser_of(avatar, settings)
    return TrainingState(avatar, average, optimiser, objective)


def steps(
    state: TrainingState, groups: list[ShapeGroup], settings: TrainingSettings, count: int
) -> Iterator[dict[str, float]]:
    """Do the steps from `state.step` to `count`, and yield the terms of the loss, by name, after each step.

    `state`: state of the training, changed in place.
    `groups`: training samples.
    Raises BadInputError as `batch_stream` does.
    """
    stream = batch_stream(groups, settings, count, state.step)
    peaks = (settings.network_rate, settings.network_rate, settings.texture_rate)
    while state.step < count:
        share = state.step / count
        torch.manual_seed(state.step << SEED_BITS | settings.seed)
        for group, peak in zip(state.optimiser.param_groups, peaks, strict=True):
            group["lr"] = peak * rate_share(share)  # kernels, the network's other weights, texture
        if state.avatar.grid is not None and share > settings.bytes_from:
            round_to_bytes(state.avatar, state.avatar.grid, groups, settings.seed)
        frozen = settings.keep_network or share > settings.freeze_norms_at
        terms = _step(state, stream, settings, frozen)
        state.step += 1
        follow(state.average, state.avatar, 1 - 1 / max(1.0, settings.average_share * state.step))
        yield terms


def _step(state: TrainingState, stream: Iterator[Batch], settings: TrainingSettings, frozen: bool) -> dict[str, float]:
    """Do one step by the mean gradient of the next batches, and return the means of their loss terms, by name."""
    options, avatar = settings.optimiser, state.avatar
    state.optimiser.zero_grad(set_to_none=True)
    sums: dict[str, float] = {}
    for batch in islice(stream, options.batches_per_step):
        set_mode(
            avatar, frozen or settings.keep_network or (settings.batches.full_body_statistics and not is_whole(batch))
        )
        group, share = batch[0], 1 / options.batches_per_step
        terms = add_gradients(avatar, load_batch(*batch, state.device), state.objective, share, group.person)
        sums = {name: sums.get(name, 0.0) + value / options.batches_per_step for name, value in terms.items()}
    clip_gradients(avatar, options)
    state.optimiser.step()
    return sums


def add_gradients(
    avatar: TrainableAvatar,
    batch: tuple[Tensor, Tensor, Tensor],
    objective: Objective,
    share: float = 1.0,
    person: int = 0,
) -> dict[str, float]:
    """Add `share` times the gradient of `batch` to the gradients of `avatar`, and return the loss terms by name.

    `batch`: UV image, coverage and target, as `load_batch` returns them.
    `objective`: loss to minimise. Its discriminators learn from `batch` too.
    `person`: number of the person whom `batch` shows.
    """
    uv, covered, target = batch
    output = avatar(uv, covered, person)
    terms = objective.terms(output, target)
    (share * objective.total(terms)).backward()
    return {name: float(term.detach()) for name, term in terms.items()} | objective.learn(output.detach(), target)


def rate_share(share: float) -> float:
    """Return the factor of the learning rates after `share` of the steps: a linear rise, then half a cosine."""
    if share < WARM_UP:
        return max(share / WARM_UP, 0.02)
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * (share - WARM_UP) / (1 - WARM_UP)))


def set_mode(avatar: TrainableAvatar, frozen: bool) -> None:
    """Put `avatar` into training mode. `frozen`: whether the running statistics of batch norms stay fixed."""
    avatar.train()
    if frozen:
        for module in avatar.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()


def follow(average: TrainableAvatar, avatar: TrainableAvatar, keep: float) -> None:
    """Set each weight of `average` to `keep` times itself plus 1 - `keep` times the weight of `avatar`."""
    current = avatar.state_dict()
    for name, value in average.state_dict().items():
        if value.dtype.is_floating_point:
            value.lerp_(current[name], 1 - keep)


def step_seconds(
    avatar: TrainableAvatar, groups: list[ShapeGroup], settings: TrainingSettings, vgg: Vgg16 | None = None
) -> float:
    """Return the mean duration of a step in seconds, measured on a copy of `avatar`.

    Steps with half-size samples cost less, and steps that round to bytes cost more. The parts of the training with each
    kind of step are weighted by their shares.
    """
    bounds = sorted({0.0, settings.small_until, settings.bytes_from, 1.0})
    return sum((end - begin) * _measured(avatar, groups, settings, vgg, begin) for begin, end in pairwise(bounds))


def _measured(
    avatar: TrainableAvatar,
    groups: list[ShapeGroup],
    settings: TrainingSettings,
    vgg: Vgg16 | None,
    begin: float,
) -> float:
    """Return the mean duration in seconds of a step as after the share `begin` of a training, after a warm-up step."""
    kind = {
        "small_until": float(begin < settings.small_until),
        "bytes_from": 1.0 if begin < settings.bytes_from else -1.0,  # below 0: the warm-up step rounds too
    }
    state = first_state(copy.deepcopy(avatar), settings, vgg)
    going = steps(state, groups, settings.model_copy(update=kind), 1 + MEASURED)
    next(going)
    start = time.monotonic()
    for _ in going:
        pass
    return (time.monotonic() - start) / MEASURED


# Where a training computes: the CPU, or a GPU that PyTorch can use.
#
# Rule: a device that is named is used, or an error says that the device is absent. Only `auto` leaves a choice.

MB = 1e6
#: Numbers and values of options of glibc (malloc.h), bytes. M_MMAP_THRESHOLD: from this size on, memory lies apart from
#: the heap; 32 MiB is the most. M_TRIM_THRESHOLD: free memory at the heap's end that is returned to the kernel.
MALLOC_OPTIONS = ((-3, 2**25), (-1, 2**31 - 1))


def chosen_device(asked: str) -> torch.device:
    """Return the device for `asked`: "auto", "cpu" or "cuda". Raises MissingPartError for "cuda" without a GPU."""
    found = torch.cuda.is_available()
    if asked == "cuda" and not found:
        what = "device cuda: this PyTorch finds no NVIDIA GPU (device auto or cpu trains on the CPU)"
        raise MissingPartError(what, f"{package_line('torch')}, with NVIDIA's driver")
    return torch.device("cuda" if found and asked != "cpu" else "cpu")


def device_words(device: torch.device, threads: int) -> str:
    """Return a name of `device` for people. `threads`: number of PyTorch's threads on the CPU."""
    if device.type == "cuda":
        return f"the GPU {torch.cuda.get_device_name(device)}"
    return f"{threads} {'thread' if threads == 1 else 'threads'} of the CPU"


def keep_freed_memory() -> None:
    """Make the C library keep blocks below 32 MiB that this process frees, if the C library is glibc.

    By default, glibc returns the memory of large tensors to the kernel, and the kernel clears it for the next tensor.
    After this call, only blocks below 32 MiB stay in the heap. Larger blocks still go back to the kernel; otherwise
    each new tensor size would make the heap grow.
    """
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        for option, value in MALLOC_OPTIONS:
            set_option(option, value)


def memory_words(device: torch.device) -> str:
    """Return words for the memory that this process has now, and the most GPU memory that it had."""
    of_cpu = f"{psutil.Process().memory_info().rss / MB:.0f} MB of memory"
    if device.type != "cuda":
        return of_cpu
    return f"{of_cpu}, {torch.cuda.max_memory_allocated(device) / MB:.0f} MB of the GPU's"


# Adam and AdamW that do not change elements without a gradient, nor their moments.
#
# Rule: a texel that no sample of a batch shows does not change. Plain Adam would treat its gradient as 0: it would move
# the texel by the old momentum, let this momentum fade, and apply weight decay.

#: Key of a parameter group; its value says whether the group is masked.
MASKED = "masked"
MOMENTS = ("exp_avg", "exp_avg_sq")


class _Masked(torch.optim.Optimizer):
    """Mix-in that adds masking to Adam or AdamW.

    In masked groups of parameters, an element whose gradient is exactly 0 does not change in a step. The step count,
    which corrects the moments' bias, grows for all elements, as in `torch.optim.SparseAdam`.
    """

    def step(self, closure: Callable[[], float] | None = None) -> Any:
        groups = [group for group in self.param_groups if group.get(MASKED)]
        kept = [
            self._kept(parameter) for group in groups for parameter in group["params"] if parameter.grad is not None
        ]
        loss = super().step(closure)
        for parameter, unseen, values in kept:
            for tensor, before in zip(self._tensors(parameter), values, strict=True):
                tensor.data[unseen] = before
        return loss

    def _kept(self, parameter: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Return `parameter`, a mask of its elements without a gradient, and the values to restore at these elements.

        The list has the parameter's values first, and then its moments' values. Missing moments count as 0.
        """
        unseen = parameter.grad == 0
        if self.state[parameter]:
            return parameter, unseen, [tensor.data[unseen].clone() for tensor in self._tensors(parameter)]
        value = parameter.data[unseen].clone()
        return parameter, unseen, [value, *(torch.zeros_like(value) for _ in MOMENTS)]

    def _tensors(self, parameter: Tensor) -> list[Tensor]:
        return [parameter, *(self.state[parameter][name] for name in MOMENTS)]


class MaskedAdam(_Masked, torch.optim.Adam):
    """Adam with masking. Its weight decay skips masked elements too."""


class MaskedAdamW(_Masked, torch.optim.AdamW):
    """AdamW with masking. Its weight decay skips masked elements too."""


# The optimiser of an avatar: Adam or AdamW, with three groups of parameters.
#
# Rule: the parameters of a group have the same learning rate, weight decay and momenta.

#: Class by kind of optimiser, and by whether texels without a gradient stay fixed.
CLASSES: dict[tuple[str, bool], type[torch.optim.Optimizer]] = {
    ("adamw", False): torch.optim.AdamW,
    ("adamw", True): MaskedAdamW,
    ("adam", False): torch.optim.Adam,
    ("adam", True): MaskedAdam,
}


def optimiser_of(avatar: TrainableAvatar, settings: TrainingSettings) -> torch.optim.Optimizer:
    """Return an optimiser with three groups: kernels, the network's other weights, and the texture.

    The network's other weights have no weight decay. If the network is kept, the first two groups are empty.
    """
    options = settings.optimiser
    kernels = [p for p in avatar.network.parameters() if p.ndim > 1 and p.requires_grad]
    others = [p for p in avatar.network.parameters() if p.ndim <= 1 and p.requires_grad]
    texture = list(avatar.textures.parameters())
    rows = (
        (kernels, settings.network_rate, settings.weight_decay, options.momentum),
        (others, settings.network_rate, 0.0, options.momentum),
        (texture, settings.texture_rate, settings.weight_decay, options.texture_momentum),
    )
    groups: list[dict[str, Any]] = [
        {"params": params, "lr": rate, "weight_decay": decay, "betas": (momentum, options.second_momentum)}
        for params, rate, decay, momentum in rows
    ]
    if settings.masked_texture:
        groups[-1][MASKED] = True
    return CLASSES[options.kind, settings.masked_texture](groups, lr=settings.network_rate)


def clip_gradients(module: nn.Module, options: OptimiserOptions) -> None:
    """Limit the gradients of `module` in place: each element by `clip_value`, then the total norm by `clip_norm`."""
    if options.clip_value:
        nn.utils.clip_grad_value_(module.parameters(), options.clip_value)
    if options.clip_norm:
        nn.utils.clip_grad_norm_(module.parameters(), options.clip_norm)


# The whole state that a training resumes from, as one .npz file: weights, their average and Adam's moments. It includes
# weights and moments of the discriminators.
#
# Rule: training from a state that was read gives the same bits as training from the state that was written. Tensors
# therefore keep their memory layout.

EXPECTED = "the state of this training"
REMEDY = "remove it to begin again"


@dataclass
class TrainingState:
    """The state of a training.

    `average`: avatar with the moving average of the weights; it becomes the bundle. `step`: number of finished steps.
    """

    avatar: TrainableAvatar
    average: TrainableAvatar
    optimiser: torch.optim.Optimizer
    objective: Objective
    step: int = 0

    def tensors(self) -> dict[str, Tensor]:
        """Return all tensors of the state by name, without copying them."""
        modules: dict[str, nn.Module] = {"avatar": self.avatar, "average": self.average}
        if self.objective.adversary is not None:
            modules["discriminators"] = self.objective.adversary.discriminators
        named = {
            f"{kind}.{name}": value for kind, module in modules.items() for name, value in module.state_dict().items()
        }
        if self.avatar.grid is not None:
            named |= {"grid.ends": self.avatar.grid.ends, "grid.alike": self.avatar.grid.alike}
        for kind, optimiser in self.optimisers().items():
            for number, moments in optimiser.state_dict()["state"].items():
                named |= {f"{kind}.{number}.{name}": value for name, value in moments.items()}
        return named

    @property
    def device(self) -> torch.device:
        return next(self.avatar.parameters()).device

    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Return the optimisers of the avatar and, if any, of the discriminators, by name."""
        adversary = self.objective.adversary
        return {"optimiser": self.optimiser} | ({} if adversary is None else {"judges": adversary.optimiser})


def save_state(state: TrainingState, path: Path) -> None:
    """Write `state` as the file `path`, whole or not at all. Raises BadInputError if the file cannot be written."""
    arrays = {name: value.detach().cpu().numpy() for name, value in state.tensors().items()}
    with write_atomically(path) as draft, draft.open("wb") as file:
        np.savez(file, step=np.int64(state.step), **arrays)


def load_state(state: TrainingState, path: Path) -> None:
    """Fill `state` from a file of `save_state`. Raises BadInputError if the file lacks the state of this training."""
    try:
        with path.open("rb") as source, np.load(source, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (*DAMAGED, TypeError) as error:  # NumPy raises TypeError for a lone array
        raise BadInputError(path, reason(error).splitlines()[0], EXPECTED, REMEDY) from error
    for optimiser in state.optimisers().values():
        _add_moments(optimiser)
    wanted = {name: tuple(value.shape) for name, value in state.tensors().items()} | {"step": ()}
    found = {name: array.shape for name, array in arrays.items()}
    if wanted != found:
        other = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
        raise BadInputError(path, f"{other[0]} {found.get(other[0], 'missing')}", EXPECTED, REMEDY)
    state.step = int(arrays.pop("step"))
    for name, value in state.tensors().items():
        value.data.copy_(torch.from_numpy(arrays[name]))


def _add_moments(optimiser: torch.optim.Optimizer) -> None:
    """Create Adam's moments as its first step would, with the memory layout of their parameters."""
    for group in optimiser.param_groups:
        for parameter in group["params"]:
            optimiser.state[parameter] = {
                "step": torch.tensor(0.0),
                "exp_avg": torch.zeros_like(parameter, memory_format=torch.preserve_format),
                "exp_avg_sq": torch.zeros_like(parameter, memory_format=torch.preserve_format),
            }


# How far a training's loss fell: the loss of the same samples, before the first step and after the last.
#
# Rule: both losses are measured alike. The terms of the discriminators are left out, because discriminators change with
# each step. The loss is measured on the averaged weights, which become the bundle, with the same backgrounds. The
# measurement changes nothing in the training.


def probe_loss(state: TrainingState, groups: list[ShapeGroup]) -> float:
    """Return the mean loss, over the first sample of each of `groups`, of the averaged avatar of `state`."""
    judge = replace(state.objective, adversary=None)
    losses = list[float]()
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for group in groups:
            uv, covered, target = load_batch(group, np.zeros(1, np.int64), state.device)
            losses.append(float(judge.total(judge.terms(state.average(uv, covered, group.person), target))))
    return float(np.mean(losses))
