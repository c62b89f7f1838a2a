"""Training with the roundings of the bundle: weights and activations of a network on the grid of its bytes.

Rule: the grid is the quantiser's own, measured once, when the rounding begins; gradients go through a rounding as if it
were none, and end where a value is cut off (Bengio et al., Estimating or propagating gradients, 2013). What is exported
at last is measured anew.

Batch norms are folded into the convolutions before them when an avatar is written, so a weight is rounded as it will be
then, times the scale of its norm, whose statistics must stay. Biases are left as they are: their steps are far finer.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.func import functional_call

from trilane.training.network import INPUT, UNet
from trilane.training.quantising.power_of_two_scales import WEIGHT_TOP
from trilane.training.quantising.quantise import ByteRanges
from trilane.unet_tables import DECODER

#: Largest integer weight, and the greatest integer of an activation.
TOP, BYTE = WEIGHT_TOP[True], 255
#: Modules of the two heads, which are exported as one, by the tensor that stands for both.
HEADS = {"/Relu_output_0": ("colour.2", "mask.2"), "/second/Conv_output_0": ("colour.3", "mask.3")}
#: Levels of the decoder, by the tensor that each reads: what is joined is cut off once more.
JOINED = {f"/Concat{f'_{level}' if level else ''}_output_0": f"levels.{level}" for level in range(len(DECODER))}
NAMED = {INPUT: (INPUT,), **HEADS, **{tensor: (level,) for tensor, level in JOINED.items()}}


class ByteGrid:
    """The grid of `network`, and the roundings on it, which begin when `active` is set.

    `ends` (K,2): of each place where bytes are stored, the real values of bytes 0 and 255; all 0 until measured.
    `alike` (1,): whether weights are even multiples of powers of two.
    """

    def __init__(self, network: UNet) -> None:
        self.active = False
        self.places = tuple(_places(network))
        self.ends, self.alike = torch.zeros(len(self.places), 2), torch.zeros(1)
        modules = dict(network.named_modules())
        read = {INPUT: network, **{name: modules[name] for name in self.places if name in JOINED.values()}}
        for number, name in enumerate(self.places):
            if name in read:
                read[name].register_forward_pre_hook(lambda _module, inputs, k=number: (self._stored(inputs[0], k),))
            else:
                modules[name].register_forward_hook(lambda _module, _inputs, output, k=number: self._stored(output, k))

    @property
    def measured(self) -> bool:
        return bool(self.ends.any())

    def measure(self, ranges: ByteRanges) -> None:
        """Take the grid from the `ranges` that the network's export was given."""
        by_place = {place: ends for name, ends in ranges.ends.items() for place in _modules_of(name)}
        self.ends.copy_(torch.tensor([by_place[place] for place in self.places]))
        self.alike.fill_(ranges.alike)

    def painted(self, network: UNet, x: Tensor) -> Tensor:
        """`network` of `x`, with rounded weights; activations are rounded by the hooks."""
        output: Tensor = functional_call(network, self.weights(network), (x,))
        return output

    def weights(self, network: UNet) -> dict[str, Tensor]:
        """The rounded weights of all convolutions, by name."""
        return {
            f"{name}.weight": _rounded_weight(conv.weight, _folded_scale(conv, norm), bool(self.alike))
            for name, conv, norm in convolutions(network)
        }

    def _stored(self, x: Tensor, place: int) -> Tensor:
        if not self.active:
            return x
        low, high = map(float, self.ends[place])
        step = (high - low) / BYTE
        zero = round(-low / step)
        inside = x.clamp(-zero * step, (BYTE - zero) * step)
        return inside + (torch.round(inside.detach() / step) * step - inside.detach())


def rounded_weights(folded: Tensor, alike: bool) -> Tensor:
    """`folded` (O,I,h,w) as the bundle has it: whole multiples of a scale for each O, which is a power of two and the
    multiples even where runtimes round `alike`.
    """
    largest = folded.abs().amax(dim=(1, 2, 3), keepdim=True).clamp(min=1e-30)
    unit = 2 * torch.exp2(torch.ceil(torch.log2(largest / (TOP + 0.99)))) if alike else largest / TOP
    return torch.round(folded / unit) * unit


def _rounded_weight(weight: Tensor, scale: Tensor, alike: bool) -> Tensor:
    """`weight` (O,I,h,w), which is folded with `scale` (O,) of a norm, so that the folded one is on the grid."""
    with torch.no_grad():
        by_channel = scale[:, None, None, None]
        change = rounded_weights(weight * by_channel, alike) / by_channel - weight
    return weight + change.nan_to_num(posinf=0.0, neginf=0.0)


def _folded_scale(conv: nn.Conv2d, norm: nn.BatchNorm2d | None) -> Tensor:
    if norm is None:
        return torch.ones(1, device=conv.weight.device)
    assert norm.running_var is not None
    return norm.weight.detach() / torch.sqrt(norm.running_var + norm.eps)


def convolutions(network: UNet) -> Iterator[tuple[str, nn.Conv2d, nn.BatchNorm2d | None]]:
    """Each convolution with its name and the norm behind it, which always is the next module."""
    named = list(network.named_modules())
    for (name, module), (_, after) in zip(named, [*named[1:], ("", None)], strict=True):
        if isinstance(module, nn.Conv2d):
            yield name, module, after if isinstance(after, nn.BatchNorm2d) else None


def _places(network: UNet) -> Iterator[str]:
    """Where bytes are stored: the input, joined tensors, rectified outputs, other norms' outputs, the heads' ends."""
    yield INPUT
    yield from list(JOINED.values())[: len(DECODER) - (not network.input_skip)]
    ends = HEADS["/second/Conv_output_0"]
    for name, module in network.named_modules():
        children = list(module.named_children()) if isinstance(module, nn.Sequential) else []
        if isinstance(module, nn.ReLU) or name in ends:
            yield name
        elif children and isinstance(children[-1][1], nn.BatchNorm2d):
            yield f"{name}.{children[-1][0]}"


def _modules_of(tensor: str) -> tuple[str, ...]:
    """The places that the exported `tensor` is stored at, by the exporter's names: `/a/b.0/b.0.1/Conv_output_0`."""
    if tensor in NAMED:
        return NAMED[tensor]
    name, operator = module_of(tensor), tensor.rpartition("/")[2]
    if operator.startswith("Conv") and name:
        before, _, number = name.rpartition(".")
        return (f"{before}.{int(number) + 1}",) if number.isdecimal() else ()
    return (name,)


def module_of(exported: str) -> str:
    """The module of the `exported` operator or tensor: `a.b.0.1` of `/a/b.0/b.0.1/Conv`."""
    path: list[str] = []
    for scope in exported.strip("/").split("/")[:-1]:
        if path and scope.startswith(f"{path[-1]}."):
            path.pop()
        path.append(scope)
    return ".".join(path)
