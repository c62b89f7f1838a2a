"""Training with the bundle's rounding: weights and activations of a network lie on the grid of its bytes.

Rule: the grid is the quantiser's own, measured once, when the rounding begins. Gradients pass a rounding unchanged and
stop where a value is clipped (Bengio et al., Estimating or propagating gradients, 2013). The final export measures the
ranges again.

The export folds each batch norm into the convolution before it. A weight is therefore rounded in its folded form, times
the scale of its norm, whose statistics must not change. Biases are not rounded: their steps are far finer.
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

#: Largest integer weight, and the largest integer of an activation.
TOP, BYTE = WEIGHT_TOP[True], 255
#: Modules of the two heads, by the tensor that stands for both: the export joins the heads.
HEADS = {"/Relu_output_0": ("colour.2", "mask.2"), "/second/Conv_output_0": ("colour.3", "mask.3")}
#: Levels of the decoder, by the joined tensor that each reads, which is clipped once more.
JOINED = {f"/Concat{f'_{level}' if level else ''}_output_0": f"levels.{level}" for level in range(len(DECODER))}
NAMED = {INPUT: (INPUT,), **HEADS, **{tensor: (level,) for tensor, level in JOINED.items()}}


class ByteGrid:
    """The byte grid of `network`; rounding begins when `active` is set.

    `ends` (K,2): the real values of bytes 0 and 255 at each place that stores bytes; all 0 until measured.
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
        """Take the grid from `ranges`, which the network's export used."""
        by_place = {place: ends for name, ends in ranges.ends.items() for place in _modules_of(name)}
        self.ends.copy_(torch.tensor([by_place[place] for place in self.places]))
        self.alike.fill_(ranges.alike)

    def painted(self, network: UNet, x: Tensor) -> Tensor:
        """Return the output of `network` for `x`, with rounded weights; hooks round the activations."""
        output: Tensor = functional_call(network, self.weights(network), (x,))
        return output

    def weights(self, network: UNet) -> dict[str, Tensor]:
        """Return the rounded weights of all convolutions, by name."""
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
    """Round `folded` (O,I,h,w) as the bundle does: to whole multiples of one scale for each output channel.

    Where runtimes round `alike`, the scale is a power of two and the multiples are even.
    """
    largest = folded.abs().amax(dim=(1, 2, 3), keepdim=True).clamp(min=1e-30)
    unit = 2 * torch.exp2(torch.ceil(torch.log2(largest / (TOP + 0.99)))) if alike else largest / TOP
    return torch.round(folded / unit) * unit


def _rounded_weight(weight: Tensor, scale: Tensor, alike: bool) -> Tensor:
    """Round `weight` (O,I,h,w) so that its product with the norm's `scale` (O,), its folded form, is on the grid."""
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
    """Yield each convolution with its name and the norm behind it, which always is the next module."""
    named = list(network.named_modules())
    for (name, module), (_, after) in zip(named, [*named[1:], ("", None)], strict=True):
        if isinstance(module, nn.Conv2d):
            yield name, module, after if isinstance(after, nn.BatchNorm2d) else None


def _places(network: UNet) -> Iterator[str]:
    """Yield the places that store bytes.

    These are the input, joined tensors, rectified outputs, other norms' outputs and the heads' ends.
    """
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
    """Return the places that store the exported `tensor`, by the exporter's names: `/a/b.0/b.0.1/Conv_output_0`."""
    if tensor in NAMED:
        return NAMED[tensor]
    name, operator = module_of(tensor), tensor.rpartition("/")[2]
    if operator.startswith("Conv") and name:
        before, _, number = name.rpartition(".")
        return (f"{before}.{int(number) + 1}",) if number.isdecimal() else ()
    return (name,)


def module_of(exported: str) -> str:
    """Return the module of an `exported` operator or tensor: `a.b.0.1` for `/a/b.0/b.0.1/Conv`."""
    path: list[str] = []
    for scope in exported.strip("/").split("/")[:-1]:
        if path and scope.startswith(f"{path[-1]}."):
            path.pop()
        path.append(scope)
    return ".".join(path)
