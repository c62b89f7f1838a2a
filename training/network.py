"""The avatar's network: an encoder, a decoder of five levels with skip connections, a colour head and a mask head.

Rule: only this module defines the network's layers. Every runtime runs a file that was exported from it.
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, Self

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from trilane.errors import BadInputError
from trilane.unet_tables import (
    DECODER,
    HEADS,
    MOBILE_ENCODERS,
    NORM_GROUPS,
    RESNET18_STAGES,
    RESNET18_STEM,
    MobileBlock,
    MobileEncoder,
    squeeze_channels,
)

# The encoders in PyTorch. An encoder turns a tensor (N, C, H, W) into features at strides 2, 4, 8, 16 and 32, finest
# first. H and W are multiples of 32. Its attribute `channels` has the numbers of channels of these features.
#
# Rule: channel counts, kernels and strides come from `trilane.unet_tables`; this file builds layers from the tables.

#: `Norm`: function that makes a normalisation for a number of channels. `Scale`: function that scales a channel count
#: of the tables by the width of the network.
Norm = Callable[[int], nn.Module]
Scale = Callable[[int], int]

#: Least number of input channels with which PyTorch's strided 1x1 convolution is safe in training (`Shortcut`).
SAFE_CHANNELS = 16
ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {"relu": nn.ReLU, "relu6": nn.ReLU6, "hardswish": nn.Hardswish}


class Shortcut(nn.Conv2d):
    """A strided 1x1 convolution without bias.

    In training with few channels, every `stride`-th pixel is picked first, and then convolved without stride. The
    reason is a defect of oneDNN: the float32 backward pass of a strided 1x1 convolution with few channels, channels
    last, writes beyond its memory. This was seen with PyTorch 2.13: with 4 and 8 channels under AVX-512, with 3 and 4
    channels under AVX2.
    """

    def __init__(self, c_in: int, c_out: int, stride: int) -> None:
        """Build a shortcut from `c_in` to `c_out` channels that reads every `stride`-th pixel along both axes."""
        super().__init__(c_in, c_out, 1, stride, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        if not torch.is_grad_enabled() or self.in_channels >= SAFE_CHANNELS:
            return super().forward(x)
        down, along = self.stride
        return functional.conv2d(x[:, :, ::down, ::along], self.weight)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions whose output is added to a shortcut of the input.

    If the shape changes, the shortcut is a strided 1x1 convolution, else the input itself.
    """

    def __init__(self, c_in: int, c_out: int, stride: int, norm: Norm) -> None:
        """Build a block from `c_in` to `c_out` channels. `stride`: the first convolution's. `norm`: see `Norm`."""
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(c_in, c_out, 3, stride, 1, bias=False),
            norm(c_out),
            nn.ReLU(inplace=True),
            nn.Conv2d(c_out, c_out, 3, 1, 1, bias=False),
            norm(c_out),
        )
        same = stride == 1 and c_in == c_out
        self.shortcut = nn.Identity() if same else nn.Sequential(Shortcut(c_in, c_out, stride), norm(c_out))
        self.relu = nn.ReLU(inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.relu(self.body(x) + self.shortcut(x))
        return out


class ResNet18(nn.Module):
    """An encoder: a 7x7 stride-2 stem, a 3x3 stride-2 max pool, and four stages of two residual blocks."""

    def __init__(self, c_in: int, scale: Scale, norm: Norm) -> None:
        super().__init__()
        stem = scale(RESNET18_STEM)
        self.stem = nn.Sequential(nn.Conv2d(c_in, stem, 7, 2, 3, bias=False), norm(stem), nn.ReLU(inplace=True))
        self.pool = nn.MaxPool2d(3, 2, 1)
        self.stages = nn.ModuleList()
        before = stem
        for count, stride in RESNET18_STAGES:
            c = scale(count)
            self.stages.append(nn.Sequential(ResidualBlock(before, c, stride, norm), ResidualBlock(c, c, 1, norm)))
            before = c
        self.channels = (stem, *(scale(count) for count, _ in RESNET18_STAGES))

    def forward(self, x: Tensor) -> list[Tensor]:
        features = [self.stem(x)]
        x = self.pool(features[0])
        for stage in self.stages:
            x = stage(x)
            features.append(x)
        return features


class SqueezeExcite(nn.Module):
    """Squeeze-and-excitation: scales each channel by a factor that is computed from the means of all channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = squeeze_channels(channels)
        self.body = nn.Sequential(
            nn.AdaptiveAvgPool2d(1),
            nn.Conv2d(channels, inner, 1),
            nn.ReLU(inplace=True),
            nn.Conv2d(inner, channels, 1),
            nn.Hardsigmoid(),
        )

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = x * self.body(x)
        return out


class InvertedResidual(nn.Module):
    """A 1x1 expansion, a depthwise convolution, an optional squeeze-and-excitation, and a linear 1x1 projection.

    If input and output have the same shape, the input is added to the output.
    """

    def __init__(self, c_in: int, row: MobileBlock, scale: Scale, norm: Norm) -> None:
        """Build the block of `row`, a row of an encoder's table.

        `c_in`: number of channels of the input. `scale`, `norm`: see `Scale` and `Norm`.
        """
        super().__init__()
        inner, c_out = scale(row.expanded), scale(row.channels)
        activation = ACTIVATIONS[row.activation]
        layers: list[nn.Module] = []
        if inner != c_in:
            layers += [nn.Conv2d(c_in, inner, 1, bias=False), norm(inner), activation()]
        layers += [
            nn.Conv2d(inner, inner, row.kernel, row.stride, row.kernel // 2, groups=inner, bias=False),
            norm(inner),
            activation(),
            *([SqueezeExcite(inner)] if row.squeeze else []),
            nn.Conv2d(inner, c_out, 1, bias=False),
            norm(c_out),
        ]
        self.body = nn.Sequential(*layers)
        self.add = row.stride == 1 and c_in == c_out

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.body(x)
        return x + out if self.add else out


class MobileFeatures(nn.Module):
    """An encoder: a 3x3 stride-2 stem, inverted residual blocks, and a last 1x1 layer.

    Its features are the inputs of the strided blocks, and the output of the last layer.
    """

    def __init__(self, spec: MobileEncoder, c_in: int, scale: Scale, norm: Norm) -> None:
        """Build the encoder of the table `spec`.

        `c_in`: number of channels of the input. `scale`, `norm`: see `Scale` and `Norm`.
        """
        super().__init__()
        before = scale(spec.stem)
        activation = ACTIVATIONS[spec.activation]
        stages = [[nn.Conv2d(c_in, before, 3, 2, 1, bias=False), norm(before), activation()]]
        channels = []
        for row in spec.rows:
            if row.stride == 2:
                channels.append(before)
                stages.append([])
            stages[-1].append(InvertedResidual(before, row, scale, norm))
            before = scale(row.channels)
        last = scale(spec.last)
        stages[-1] += [nn.Conv2d(before, last, 1, bias=False), norm(last), activation()]
        self.stages = nn.ModuleList(nn.Sequential(*stage) for stage in stages)
        self.channels = (*channels, last)

    def forward(self, x: Tensor) -> list[Tensor]:
        features = []
        for stage in self.stages:
            x = stage(x)
            features.append(x)
        return features


ENCODERS: dict[str, Callable[[int, Scale, Norm], nn.Module]] = {
    "resnet18": ResNet18,
    **{name: partial(MobileFeatures, spec) for name, spec in MOBILE_ENCODERS.items()},
}


FULL_WIDTH = 64
CHANNEL_STEP = 4


class GroupNorm(nn.GroupNorm):
    """`nn.GroupNorm`, built from operators that can be quantised: an instance norm and a depthwise 1x1 convolution."""

    def forward(self, x: Tensor) -> Tensor:
        n, c, h, w = x.shape
        grouped = x.reshape(n, self.num_groups, c // self.num_groups * h, w)
        x = functional.instance_norm(grouped, eps=self.eps).reshape(n, c, h, w)
        return functional.conv2d(x, self.weight.view(c, 1, 1, 1), self.bias, groups=c)


class NoNorm(nn.BatchNorm2d):
    """A learnt scale and shift of each channel: a batch norm whose statistics stay mean 0 and variance 1.

    Like a batch norm, it is folded into the convolution before it when the network is exported.
    """

    def train(self, mode: bool = True) -> Self:
        """Stay in evaluation mode, so that mean and variance never change. `mode` has no effect."""
        del mode
        super().train(False)
        return self


NORMS: dict[str, Callable[[int], nn.Module]] = {
    "batch": nn.BatchNorm2d,
    "instance": lambda channels: nn.InstanceNorm2d(channels, affine=True),
    "group": lambda channels: GroupNorm(math.gcd(channels, NORM_GROUPS), channels),
    "none": lambda channels: NoNorm(channels).eval(),
}


class UNet(nn.Module):
    """The whole network.

    The input is (N, channels, H, W) float32, with H and W multiples of 32. The output is (N, 4, H, W) in 0..1: three
    channels of colour and the mask, straight alpha.
    """

    def __init__(
        self,
        encoder: str = "resnet18",
        norm: str = "batch",
        width: int = FULL_WIDTH,
        channels: int = 16,
        input_skip: bool = False,
    ) -> None:
        """Build the network, untrained.

        `encoder`: a name of `ENCODERS`.
        `norm`: a name of `NORMS`.
        `width`: 1 to 256; every channel count is scaled by `width` / 64 and rounded to a multiple of 4, at least 4.
        `channels`: number of channels of the input, 1 to 64.
        `input_skip`: whether the last decoder level also reads the network's input, the only tensor of full resolution.
        The paper's network does not.

        Raises BadInputError for an unknown encoder or norm, or a width or channel count out of range.
        """
        super().__init__()
        _check(encoder, norm, width, channels)

        def scale(count: int) -> int:
            return max(CHANNEL_STEP, round(count * width / FULL_WIDTH / CHANNEL_STEP) * CHANNEL_STEP)

        make_norm = NORMS[norm]
        self.norm, self.input_skip = norm, input_skip
        self.encoder = ENCODERS[encoder](channels, scale, make_norm)
        *skips, deepest = self.encoder.channels
        self.levels = nn.ModuleList()
        c_in = deepest
        for count, skip in zip(DECODER, (*reversed(skips), channels if input_skip else 0), strict=True):
            c_out = scale(count)
            self.levels.append(
                nn.Sequential(*_convolution(c_in + skip, c_out, make_norm), *_convolution(c_out, c_out, make_norm))
            )
            c_in = c_out
        self.colour = nn.Sequential(*_convolution(c_in, c_in, make_norm), nn.Conv2d(c_in, HEADS[0], 3, 1, 1))
        self.mask = nn.Sequential(*_convolution(c_in, c_in, make_norm), nn.Conv2d(c_in, HEADS[1], 3, 1, 1))

    def forward(self, x: Tensor) -> Tensor:
        x = self.features(x)
        return torch.sigmoid(torch.cat((self.colour(x), self.mask(x)), dim=1))

    def features(self, x: Tensor) -> Tensor:
        """Return the features (N, C, H, W) that both heads read. `x`: input (N, channels, H, W) of the network."""
        whole = x if self.input_skip else None
        *skips, x = self.encoder(x)
        for level, skip in zip(self.levels, (*reversed(skips), whole), strict=True):
            x = functional.interpolate(x, scale_factor=2.0, mode="nearest")
            x = level(x if skip is None else torch.cat((x, skip), dim=1))
        return x


def _convolution(c_in: int, c_out: int, norm: Callable[[int], nn.Module]) -> tuple[nn.Module, ...]:
    return nn.Conv2d(c_in, c_out, 3, 1, 1, bias=False), norm(c_out), nn.ReLU(inplace=True)


def _check(encoder: str, norm: str, width: int, channels: int) -> None:
    for name, value, known in (("encoder", encoder, ENCODERS), ("norm", norm, NORMS)):
        if value not in known:
            raise BadInputError("network", f"{name} {value!r}", f"one of {', '.join(known)}")
    for name, number, top in (("width", width, 256), ("channels", channels, 64)):
        if not 1 <= number <= top:
            raise BadInputError("network", f"{name} {number}", f"a number from 1 to {top}")


# Noise on activations in training, so that pictures hardly change on a runtime that rounds differently.
#
# Rule: noise is added only in training mode, to positive outputs of ReLUs. It is about as large as one step of the
# bytes that store these outputs after quantisation.

BYTE_STEPS = 255
#: Noise is a slice of a fixed array of random values. The slice begins at a random index below this number. A slice
#: takes a fifth of the time of drawing new values.
STARTS = 1 << 16


def add_activation_noise(network: nn.Module, steps: float) -> None:
    """Make every ReLU of `network` add noise to its positive outputs in training mode.

    The noise is uniform, up to ±`steps` / 255 times the ReLU's largest output.
    """
    bank = torch.empty(0)

    def noise_for(output: Tensor) -> Tensor:
        nonlocal bank
        if len(bank) < output.numel() + STARTS or bank.dtype != output.dtype or bank.device != output.device:
            drawn = torch.rand(output.numel() + STARTS, generator=torch.Generator().manual_seed(0))
            bank = (2 * drawn - 1).to(output.device, output.dtype)
        start = int(torch.randint(STARTS, ()))
        return torch.as_strided(bank, output.shape, output.stride(), start)

    def hook(module: nn.Module, _inputs: Any, output: Tensor) -> Tensor | None:
        if not module.training:
            return None
        shown = output.detach()
        size = shown.amax() * (steps / BYTE_STEPS)
        return torch.addcmul(output, torch.where(shown > 0, noise_for(shown), 0), size)

    for module in network.modules():
        if isinstance(module, nn.ReLU) and steps:
            module.register_forward_hook(hook)


# Dropout of whole channels after each level of encoder and decoder.
#
# Rule: dropout acts only in training mode and adds no weights, so it changes neither the export nor a stored state.


def add_dropout(network: UNet, probability: float) -> None:
    """Make each level of the encoder and decoder set a channel to 0 with `probability` in training mode.

    The other channels are scaled up, so that the mean stays the same.
    """

    def hook(module: nn.Module, _inputs: Any, output: Tensor) -> Tensor | None:
        return functional.dropout2d(output, probability) if module.training else None

    if probability:
        for level in (*network.encoder.children(), *network.levels):
            for part in level if isinstance(level, nn.ModuleList) else (level,):
                if not isinstance(part, nn.MaxPool2d):
                    part.register_forward_hook(hook)


# Exports the network as a float ONNX model of a fixed shape, with batch norms folded into the convolutions.
#
# Rule: the model computes the same function as the network. Only its two heads are arranged differently.

OPSET = 17
INPUT, OUTPUT = "tensor", "rgba"


class _OneHead(nn.Module):
    """The network with both heads joined, so that the features are read only once.

    The first convolutions of both heads become one convolution with twice the channels. Their second convolutions
    become one convolution whose weights are block-diagonal.
    """

    def __init__(self, network: UNet) -> None:
        super().__init__()
        self.network = network
        heads = [(fuse_conv_bn_eval(head[0], head[1]), head[3]) for head in (network.colour, network.mask)]
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


def export_onnx(network: UNet, height: int, width: int) -> onnx.ModelProto:
    """Return the network as a float ONNX model.

    Its input is `tensor` (1, C, height, width), its output `rgba` (1, 4, height, width) in 0..1, straight alpha.

    `network`: network to export; it is put into evaluation mode.
    `height`, `width`: size of the input in pixels, multiples of 32.
    """
    network.eval()
    batch_norm = isinstance(network.colour[1], nn.BatchNorm2d)
    channels = next(network.parameters()).shape[1]
    example = torch.zeros(1, channels, height, width)
    file = io.BytesIO()
    with warnings.catch_warnings(), torch.no_grad():
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
    """Make every Reshape of `model` work for any input shape: batch and width are copied, the height is inferred."""
    makers = {out: node for node in model.graph.node for out in node.output}
    for node in model.graph.node:
        if node.op_type == "Reshape":
            shape = makers[node.input[1]].attribute[0].t
            channels = int(numpy_helper.to_array(shape)[1])
            shape.CopyFrom(numpy_helper.from_array(np.array([0, channels, -1, 0], np.int64)))
