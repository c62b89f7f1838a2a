"""Everything that a training by steps goes on from, as one .npz file: weights, their average and Adam's moments, and
the same of discriminators.

Rule: what was read computes the same bits as what was written, so tensors keep their layout in memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from trilane.errors import BadInputError, reason
from trilane.files import DAMAGED
from trilane.training.objective import Objective
from trilane.training.trainable_avatar import TrainableAvatar
from trilane.writing import write_atomically

EXPECTED = "the state of this training"
REMEDY = "remove it, and the training begins anew"


@dataclass
class TrainingState:
    """`avatar`, trained by `optimiser` for the `objective`; the `average` of its weights; `step`s were done."""

    avatar: TrainableAvatar
    average: TrainableAvatar
    optimiser: torch.optim.Optimizer
    objective: Objective
    step: int = 0

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name; they are the state's own."""
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
        """Where it is trained."""
        return next(self.avatar.parameters()).device

    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """All optimisers by name, each of Adam's kind."""
        adversary = self.objective.adversary
        return {"optimiser": self.optimiser} | ({} if adversary is None else {"judges": adversary.optimiser})


def save_state(state: TrainingState, path: Path) -> None:
    """Write `state` as the file `path`, whole or not at all. Raises BadInputError."""
    arrays = {name: value.detach().cpu().numpy() for name, value in state.tensors().items()}
    with write_atomically(path) as draft, draft.open("wb") as file:
        np.savez(file, step=np.int64(state.step), **arrays)


def load_state(state: TrainingState, path: Path) -> None:
    """Set `state` to what `save_state` wrote. Raises BadInputError for the state of another training."""
    try:
        with path.open("rb") as source, np.load(source, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (*DAMAGED, TypeError) as error:  # TypeError: of a lone array
        raise BadInputError(path, reason(error).splitlines()[0], EXPECTED, REMEDY) from error
    for optimiser in state.optimisers().values():
        _add_moments(optimiser)
    wanted = {name: tuple(value.shape) for name, value in state.tensors().items()} | {"step": ()}
    found = {name: array.shape for name, array in arrays.items()}
    if wanted != found:
        other = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
        raise BadInputError(path, f"{other[0]} {found.get(other[0], 'missing')}", EXPECTED, REMEDY)
    state.step = int(arrays.pop("step"))
    _fill(state.tensors(), arrays)


def _fill(tensors: dict[str, Tensor], arrays: dict[str, NDArray[np.generic]]) -> None:
    for name, value in tensors.items():
        value.data.copy_(torch.from_numpy(arrays[name]))


def _add_moments(optimiser: torch.optim.Optimizer) -> None:
    """Adam's moments, as its first step makes them: laid out in memory as their parameters."""
    for group in optimiser.param_groups:
        for parameter in group["params"]:
            optimiser.state[parameter] = {
                "step": torch.tensor(0.0),
                "exp_avg": torch.zeros_like(parameter, memory_format=torch.preserve_format),
                "exp_avg_sq": torch.zeros_like(parameter, memory_format=torch.preserve_format),
            }
