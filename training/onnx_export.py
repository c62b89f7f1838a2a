"""Exports the network as a float ONNX model of one static shape, with batch norms folded into the convolutions.

Rule: the model computes the same as the network; only the layout of the two heads differs.
"""

from __future__ import annotations

import io
import warnings

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from trilane.training.network import UNet

OPSET = 17
INPUT, OUTPUT = "tensor", "rgba"


class _OneHead(nn.Module):
    """Both heads as one, so that the features are read once: first layers side by side, second ones block-diagonal."""

    def __init__(self, network: UNet) -> None:
        super().__init__()
        self.network = network
        heads = [_fused(head) for head in (network.colour, network.mask)]
        c = heads[0][0].in_channels
        self.first = nn.Conv2d(c, 2 * c, 3, 1, 1)
        self.second = nn.Conv2d(2 * c, 4, 3, 1, 1)
        with torch.no_grad():
            self.second.weight.zero_()
            self.second.weight[:3, :c] = heads[0][1].weight
            self.second.weight[3:, c:] = heads[1][1].weight
            for target, layers in ((self.first, 0), (self.second, 1)):
                target.bias.copy_(torch.cat([head[layers].bias for head in heads]))
            self.first.weight.copy_(torch.cat([head[0].weight for head in heads]))

    def forward(self, x: Tensor) -> Tensor:
        features = self.network.features(x)
        return torch.sigmoid(self.second(torch.relu(self.first(features))))


def _fused(head: nn.Sequential) -> tuple[nn.Conv2d, nn.Conv2d]:
    return fuse_conv_bn_eval(head[0], head[1]), head[3]


def export_onnx(network: UNet, height: int, width: int) -> onnx.ModelProto:
    """A float model for (1, C, height, width): input `tensor`, output `rgba` (1, 4, height, width) in 0..1.

    `network` is put into evaluation mode. `height` and `width`: multiples of 32.
    """
    network.eval()
    batch_norm = isinstance(network.colour[1], nn.BatchNorm2d)
    channels = next(network.parameters()).shape[1]
    example = torch.zeros(1, channels, height, width)
    file = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            (_OneHead(network) if batch_norm else network).eval(),
            (example,),
            file,
            dynamo=False,
            opset_version=OPSET,
            input_names=[INPUT],
            output_names=[OUTPUT],
        )
    model = onnx.load_model_from_string(file.getvalue())
    _free_reshapes(model)
    return model


def _free_reshapes(model: onnx.ModelProto) -> None:
    """Make every Reshape take batch and width from its input and compute the height, so that no shape is fixed."""
    makers = {out: node for node in model.graph.node for out in node.output}
    for node in model.graph.node:
        if node.op_type == "Reshape":
            shape = makers[node.input[1]].attribute[0].t
            channels = int(numpy_helper.to_array(shape)[1])
            shape.CopyFrom(numpy_helper.from_array(np.array([0, channels, -1, 0], np.int64)))
