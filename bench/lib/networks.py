"""The networks that the inference benches run: untrained, with the shapes and operators of trained networks.

Rule: weights and inputs are random, and the same every time. The time that a network takes does not depend on their
values.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from trilane.avatars.bundle import MANIFEST, bundle_folder, load_bundle, write_bundle
from trilane.avatars.manifest import UNTRAINED, Manifest, network_entry
from trilane.avatars.network_file import NetworkFile, reshaped
from trilane.cache import cache_dir
from trilane.errors import MissingPartError, TrilaneError
from trilane.hw_profiles.network_work import graph_facts
from trilane.training.quantising.quantise import quantise

CALIBRATION_SIDE = 64
CALIBRATION_FRAMES = 5
#: Name of the avatar with the paper's network: the default avatar's body and texture, with untrained weights.
FULL_WIDTH = "resnet18"
ENCODER, NORM, WIDTH = "resnet18", "batch", 64
SIDE = 64  # any side works, because a run reshapes the network


@dataclass(frozen=True)
class NetworkFixture:
    """A network to be timed.

    `label`: settings of the network by name, as in the rows of a bench.
    `integer`: quantised network, with bytes as input and output.
    `parameters`: number of parameters. `gmac`: multiply-accumulates of a frame, in 1e9.
    """

    label: dict[str, Any]
    integer: NetworkFile
    parameters: int
    gmac: float


def untrained(
    encoder: str, norm: str, width: int, size: tuple[int, int], channels: int = 16, batch: int = 1
) -> NetworkFixture:
    """Return an untrained, quantised network. Its `gmac` only counts convolutions that the network defines.

    `encoder`, `norm`: kind of the encoder and of its normalisation, as in `trilane.training.network.UNet`.
    `width`: width of the network, with which every number of channels grows; 64 for the paper's network.
    `size`: (height, width) of the tensor in pixels.
    `channels`: number of channels of the tensor.
    `batch`: number of frames that are inferred at once.
    Raises MissingPartError without PyTorch, BadInputError for wrong settings.
    """
    network, torch = _unet(encoder, norm, width, channels)
    from trilane.training.network import export_onnx

    small = export_onnx(network, CALIBRATION_SIDE, CALIBRATION_SIDE)
    rng = np.random.default_rng(0)
    shape = (CALIBRATION_SIDE, CALIBRATION_SIDE, channels)
    frames = [rng.normal(size=shape).astype(np.float32) for _ in range(CALIBRATION_FRAMES)]
    label = {"encoder": encoder, "norm": norm, "width": width, "size": list(size), "channels": channels}
    macs = _defined_macs(network, torch, channels) * size[0] * size[1]
    parameters = sum(p.numel() for p in network.parameters())
    return NetworkFixture(label, reshaped(quantise(small, frames).network, *size, batch), parameters, macs / 1e9)


def untrained_float(encoder: str, norm: str, width: int, size: tuple[int, int], channels: int = 16) -> onnx.ModelProto:
    """Return the float network that `untrained` quantises. Its input is (1, C, H, W) float32.

    Parameters and errors: see `untrained`.
    """
    from trilane.training.network import export_onnx

    return export_onnx(_unet(encoder, norm, width, channels)[0], *size)


def fixture_of_file(network: NetworkFile, batch: int = 1) -> NetworkFixture:
    """Return a fixture with the network of a file. Its `gmac` counts all layers of the file.

    `network`: network of the file. `batch`: number of frames that are inferred at once.
    """
    facts = graph_facts(network.model)
    size = network.shape[1:3]
    label = {"network": network.where, "size": list(size)}
    return NetworkFixture(label, reshaped(network, *size, batch), facts["parameters"], facts["gmac"])


def random_tensors(network: NetworkFile, count: int) -> NDArray[np.uint8]:
    """Return `count` random inputs of `network`, (count, N, H, W, C) uint8, the same every time."""
    return np.random.default_rng(1).integers(0, 256, (count, *network.shape), dtype=np.uint8)


def _unet(encoder: str, norm: str, width: int, channels: int) -> tuple[Any, Any]:
    try:
        import torch
    except ModuleNotFoundError as error:
        raise MissingPartError("untrained networks need PyTorch", extra="train") from error
    from trilane.training.network import UNet

    torch.manual_seed(0)
    return UNet(encoder, norm, width, channels).eval(), torch


def _defined_macs(network: Any, torch: Any, channels: int) -> float:
    """Return the multiply-accumulates of all convolutions of `network`, divided by the tensor's pixels."""
    total = 0

    def add(module: Any, _inputs: Any, output: Any) -> None:
        nonlocal total
        total += output.shape[2] * output.shape[3] * module.weight.numel()

    hooks = [m.register_forward_hook(add) for m in network.modules() if isinstance(m, torch.nn.Conv2d)]
    with torch.no_grad():
        network(torch.zeros(1, channels, CALIBRATION_SIDE, CALIBRATION_SIDE))
    for hook in hooks:
        hook.remove()
    return total / CALIBRATION_SIDE**2


def full_width_bundle() -> Path:
    """Return the folder of the avatar `FULL_WIDTH`. The avatar is made once and cached. Its pictures mean nothing.

    Raises MissingPartError without PyTorch, TrilaneError if the cache folder cannot be written.
    """
    home = cache_dir("bench")
    if home is None:
        raise TrilaneError("the cache folder cannot be written: set XDG_CACHE_HOME to one that can")
    default = load_bundle(bundle_folder("default"))
    texture = default.read_texture().astype(np.float16)
    offsets = default.read_body().offsets
    worn = b"" if offsets is None else offsets.tobytes()
    content = hashlib.sha256(texture.tobytes() + default.body_path.read_bytes() + worn).hexdigest()[:12]
    folder = home / f"{ENCODER}-{NORM}-{WIDTH}-{content}"
    if not (folder / MANIFEST).exists():
        network = untrained(ENCODER, NORM, WIDTH, (SIDE, SIDE), texture.shape[2]).integer
        entry = network_entry(network, ENCODER, NORM, WIDTH)
        manifest = Manifest(name=FULL_WIDTH, network=entry, provenance={"weights": UNTRAINED})
        write_bundle(folder, manifest, default.body_path, texture, network, offsets=offsets)
    return folder
