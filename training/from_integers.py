"""The float network that an avatar's integers stand for, so that training goes on where only the avatar was kept.

Rule: it computes what the integer network computes, but for the rounding of activations. Batch norms, which were folded
into the convolutions before them, are there again with the statistics of training samples.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from trilane.arrays import F32
from trilane.avatars.bundle import Bundle
from trilane.avatars.network_file import constants_of
from trilane.errors import BadInputError
from trilane.training.batch_choice import load_batch
from trilane.training.byte_grid import convolutions, module_of
from trilane.training.network import UNet
from trilane.training.neural_texture import read_texture
from trilane.training.sample_files import ShapeGroup, batches

#: The two convolutions of the heads, which are exported side by side: colour first, then the mask.
FIRST, SECOND, COLOURS = "first", "second", 3
#: Samples that norms are measured on.
BATCH, BATCHES = 8, 8


def network_of(bundle: Bundle, groups: list[ShapeGroup], seed: int) -> UNet:
    """The float network of `bundle`. `groups`: samples that norms are measured on, chosen by `seed`.

    Raises BadInputError.
    """
    entry = bundle.manifest.network
    network = UNet(entry.encoder, "batch", entry.width, entry.channels, input_skip=True)
    network.eval()
    constants = dict(_constants(bundle.read_network().model))
    for name, conv, norm in convolutions(network):
        if name not in constants:
            raise BadInputError(bundle.network_path, f"no convolution {name}", f"those of {entry.encoder}")
        kernel, bias = (torch.from_numpy(values.copy()) for values in constants[name])
        with torch.no_grad():
            conv.weight.copy_(kernel)
            if norm is None:
                assert conv.bias is not None
                conv.bias.copy_(bias)
            else:
                assert norm.running_var is not None
                norm.bias.copy_(bias)
                norm.running_var.fill_(1 - norm.eps)
    _measure_norms(network, _inputs(bundle, groups, seed))
    return network


def _inputs(bundle: Bundle, groups: list[ShapeGroup], seed: int) -> Iterator[Tensor]:
    """(N,C,H,W): what the network of `bundle` reads of some samples."""
    texture = torch.from_numpy(bundle.read_texture()).permute(2, 0, 1)[None]
    for group, index in islice(batches(groups, BATCH, np.random.default_rng(seed)), BATCHES):
        uv, covered, _ = load_batch(group, index)
        yield read_texture(texture, uv, covered)


def _constants(model: onnx.ModelProto) -> Iterator[tuple[str, tuple[F32, F32]]]:
    """Name, kernel and bias of each convolution of `model` as the modules of a `UNet` have them."""
    stored = {name: numpy_helper.to_array(tensor) for name, tensor in constants_of(model).items()}
    made_by = {node.output[0]: node for node in model.graph.node if node.op_type == "DequantizeLinear"}

    def real(name: str) -> F32:
        integers, scale = (stored[part] for part in made_by[name].input[:2])
        return np.asarray(integers * scale.reshape(-1, *[1] * (integers.ndim - 1)), np.float32)

    for node in model.graph.node:
        if node.op_type != "Conv":
            continue
        name, (kernel, bias) = module_of(node.name), (real(part) for part in node.input[1:3])
        if name == FIRST:
            half = len(kernel) // 2
            yield "colour.0", (kernel[:half], bias[:half])
            yield "mask.0", (kernel[half:], bias[half:])
        elif name == SECOND:
            half = kernel.shape[1] // 2
            yield "colour.3", (kernel[:COLOURS, :half], bias[:COLOURS])
            yield "mask.3", (kernel[COLOURS:, half:], bias[COLOURS:])
        else:
            yield name, (kernel, bias)


def _measure_norms(network: UNet, inputs: Iterable[Tensor]) -> None:
    """Give the norms of `network`, which change nothing but add their biases, the statistics of `inputs`; in place."""
    norms = [norm for _, _, norm in convolutions(network) if norm is not None]
    sums: dict[nn.Module, list[Tensor]] = {norm: [] for norm in norms}

    def look(norm: nn.Module, given: Any) -> None:
        x = given[0]
        sums[norm].append(torch.stack((x.mean(dim=(0, 2, 3)), x.square().mean(dim=(0, 2, 3)))))

    hooks = [norm.register_forward_pre_hook(look) for norm in norms]
    with torch.no_grad():
        for x in inputs:
            network(x)
        for hook in hooks:
            hook.remove()
        for norm in norms:
            mean, square = torch.stack(sums[norm]).mean(dim=0)
            assert norm.running_mean is not None and norm.running_var is not None
            norm.running_mean.copy_(mean)
            norm.running_var.copy_((square - mean.square()).clamp(min=0))
            norm.weight.copy_(torch.sqrt(norm.running_var + norm.eps))
            norm.bias.add_(mean)
