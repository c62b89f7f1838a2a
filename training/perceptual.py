"""The perceptual loss by features of VGG-16, whose weights the user brings as a file.

Rule: the file is data: only tensors are read from it, and each must have the size that VGG-16 has there.
"""

from __future__ import annotations

import pickle
import zipfile
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from trilane.errors import BadInputError, MissingPartError, package_line, reason

#: Convolutions and channels of the five blocks, between which the picture is halved: Simonyan and Zisserman, Very deep
#: convolutional networks for large-scale image recognition, 2014, table 1, column D.
BLOCKS = ((2, 64), (2, 128), (3, 256), (3, 512), (3, 512))
#: Of ImageNet, which the weights were trained for.
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
EXPECTED = "weights of VGG-16 by torchvision's names (features.0.weight ...)"
SAFETENSORS = ".safetensors"
LEAST_LENGTH = 1e-10


class Vgg16(nn.Module):
    """The convolutions of VGG-16, without weights of its own; its parameters are never trained."""

    def __init__(self) -> None:
        super().__init__()
        layers, before = list[nn.Module](), 3
        for count, channels in BLOCKS:
            for _ in range(count):
                layers += [nn.Conv2d(before, channels, 3, 1, 1), nn.ReLU()]
                before = channels
            layers.append(nn.MaxPool2d(2))
        self.features = nn.Sequential(*layers[:-1])
        self.register_buffer("mean", torch.tensor(MEAN)[:, None, None], persistent=False)
        self.register_buffer("deviation", torch.tensor(DEVIATION)[:, None, None], persistent=False)
        self.requires_grad_(False)

    def forward(self, picture: Tensor) -> list[Tensor]:
        """The last features of each block, for `picture` (N, 3, H, W) in 0..1, sides at least 16."""
        x, found = (picture - self.mean) / self.deviation, list[Tensor]()
        for layer, after in pairwise([*self.features, nn.MaxPool2d(2)]):
            x = layer(x)
            if isinstance(after, nn.MaxPool2d):
                found.append(x)
        return found

    def distance(self, one: Tensor, other: Tensor) -> Tensor:
        """(N,): of pictures (N, 3, H, W) in 0..1, the squared differences of features of length 1, summed over blocks.

        Zhang et al., The unreasonable effectiveness of deep features as a perceptual metric, 2018, formula 1, where all
        its learned weights of channels are 1.
        """
        parts = [
            (functional.normalize(mine, eps=LEAST_LENGTH) - functional.normalize(theirs, eps=LEAST_LENGTH))
            .square()
            .sum(dim=1)
            .mean(dim=(1, 2))
            for mine, theirs in zip(self(one), self(other), strict=True)
        ]
        return torch.stack(parts).sum(dim=0)


def read_vgg16(path: Path) -> Vgg16:
    """The network of the state dict in the file `path` (.pth, .pt or .safetensors).

    Raises BadInputError; MissingPartError for a .safetensors file where that package is not installed.
    """
    found, network = _tensors(path), Vgg16()
    for name, wanted in network.state_dict().items():
        tensor = found.get(name)
        if not isinstance(tensor, Tensor):
            raise BadInputError(path, f"no tensor {name}", EXPECTED)
        if tensor.shape != wanted.shape:
            raise BadInputError(f"{path}: {name}", str(tuple(tensor.shape)), f"{tuple(wanted.shape)} of VGG-16")
        if not bool(tensor.isfinite().all()):
            raise BadInputError(f"{path}: {name}", "numbers that are not finite", EXPECTED)
        wanted.copy_(tensor)
    return network


def _tensors(path: Path) -> dict[str, object]:
    try:
        return _safe_tensors(path) if path.suffix == SAFETENSORS else _saved_tensors(path)
    except (OSError, EOFError, RuntimeError, ValueError, pickle.UnpicklingError, zipfile.BadZipFile) as error:
        raise BadInputError(path, reason(error).splitlines()[0], EXPECTED) from error


def _saved_tensors(path: Path) -> dict[str, object]:
    """What `torch.save` wrote; with `weights_only` it can hold tensors and plain values, and no code."""
    found = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(found, dict):
        raise ValueError(f"a {type(found).__name__}, not a state dict")
    return found


def _safe_tensors(path: Path) -> dict[str, object]:
    try:
        from safetensors import SafetensorError
        from safetensors.torch import load_file
    except ImportError:
        raise MissingPartError("reading .safetensors needs safetensors", package_line("safetensors")) from None
    try:
        return dict(load_file(path))
    except SafetensorError as error:
        raise ValueError(str(error)) from error
