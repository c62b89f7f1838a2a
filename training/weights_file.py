"""Weights of a network as an .npz file.

Rule: a file is complete or not there; weights are loaded only into a network that has every one of them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from trilane.errors import BadInputError, reason
from trilane.training.network import UNet
from trilane.training.trainable_avatar import TrainableAvatar
from trilane.writing import write_atomically

SAVED_WEIGHTS = "weights that this network's training saved"


def load_network(network: UNet, path: Path) -> UNet:
    """Load the network of a file of `save_network` into `network`. Raises BadInputError."""
    weights = _read_weights(path)
    prefix = "network."
    _fill(network, {k.removeprefix(prefix): v.float() for k, v in weights.items() if k.startswith(prefix)}, path)
    return network


def save_network(avatar: TrainableAvatar, path: Path) -> None:
    """Write the network alone in half precision: a small file, precise enough to continue training from.

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
    """Load `weights` into `module`. Every weight must be there; only the counters of batches may be missing."""
    try:
        missing, unexpected = module.load_state_dict(weights, strict=False)
    except RuntimeError as error:
        raise BadInputError(path, str(error).splitlines()[-1].strip(), SAVED_WEIGHTS) from error
    missing = [name for name in missing if not name.endswith("num_batches_tracked")]
    if missing or unexpected:
        raise BadInputError(path, f"no {missing[0]}" if missing else f"also {unexpected[0]}", SAVED_WEIGHTS)
