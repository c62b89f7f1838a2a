"""The trained parts: a neural texture and a network, which turn a UV image into a picture, and their byte grid.

Rule: in training, the network's input is rounded to as many steps as its bytes have in the pipeline. Noise is added
only in training mode.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn import functional

from trilane.arrays import F32, U8
from trilane.avatars.bundle import Bundle, split_levels
from trilane.avatars.network_file import constants_of
from trilane.errors import BadInputError, reason
from trilane.files import DAMAGED
from trilane.training.dataset import U16, ShapeGroup, batches
from trilane.training.network import INPUT, UNet
from trilane.training.quantising.calibration import WEIGHT_TOP
from trilane.training.quantising.quantise import ByteRanges
from trilane.unet_tables import DECODER
from trilane.writing import write_atomically

if TYPE_CHECKING:
    from trilane.training.sample_renderer import Sample
    from trilane.training.validate import Painter

Precision = Literal["float32", "bfloat16"]
#: Number of steps of the network's input bytes on each side of zero.
INPUT_STEPS = 127


class TrainableAvatar(nn.Module):
    """One or several neural textures, one for each person, and the network that reads them.

    `textures`: texture of each person, by the person's number.
    `texture_noise`, `input_noise`: standard deviations of the Gaussian noise on texels and on the network's input.
    `grid`: byte grid that rounds weights and activations while it is active, or None.
    """

    #: With "bfloat16", PyTorch's autocast computes the network in that format; weights, texture and loss stay float32.
    precision: Precision = "float32"

    def __init__(self, network: UNet, *textures: NeuralTexture) -> None:
        super().__init__()
        self.textures, self.network = nn.ModuleList(textures), network
        self.texture_noise = self.input_noise = 0.0
        self.grid: ByteGrid | None = None

    def levels(self, person: int) -> list[Tensor]:
        """Return the texture of `person`, a number, and its smaller levels, as `read_levels` takes them."""
        texture = self.textures[person]
        assert isinstance(texture, NeuralTexture)
        return texture.levels()

    def forward(self, uv: Tensor, covered: Tensor, person: int = 0) -> Tensor:
        """Return pictures (N,4,H,W), RGBA in 0..1, of the person whose number is `person`.

        `uv`: (N,H,W,2) in 0..1. `covered`: (N,H,W) bool.
        """
        levels = [self._noisy(level, self.texture_noise) for level in self.levels(person)]
        x = read_levels(levels, uv, covered)
        x = self._noisy(x, self.input_noise)
        rounded = torch.round(x * INPUT_STEPS) / INPUT_STEPS
        x = x + (rounded - x).detach()
        rounds = self.grid is not None and self.grid.active
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.precision == "bfloat16"):
            output: Tensor = self.grid.painted(self.network, x) if self.grid and rounds else self.network(x)
        return output.float() if self.precision == "bfloat16" else output

    def _noisy(self, x: Tensor, deviation: float) -> Tensor:
        return x + deviation * torch.randn_like(x) if self.training and deviation else x


def load_batch(
    group: ShapeGroup, index: NDArray[np.int64], device: torch.device | str = "cpu"
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the samples `index` (N,) of `group`, on `device`, as uv, covered and target.

    They are (N,H,W,2) in 0..1, (N,H,W) bool, and (N,4,H,W) in 0..1.
    """
    uv = torch.from_numpy(group.uv[index].astype(np.float32) / U16)
    covered = torch.from_numpy(group.covered[index] > 0)
    target = torch.from_numpy(group.rgba[index].astype(np.float32) / 255).permute(0, 3, 1, 2)
    return uv.to(device), covered.to(device), target.to(device)


# The neural texture: one image of C channels, stored as the sum of several scales.
#
# Rule: a coarse scale holds the common part of neighbouring texels; finer scales hold only differences from it.

SIDES = (512, 256, 128, 64, 32)
LIMIT = 1.0


class NeuralTexture(nn.Module):
    """A texture that is the sum of the scales of a Laplacian pyramid.

    Each scale starts as `start` shrunk to the scale's side, minus the next coarser scale's image enlarged. The sum is
    clipped to -1..1, because the network's input has one byte range for all channels.

    `start`: texture (S,S,C) before training; S is the largest of `sides`.
    `sides`: sides of the scales, in texels.
    `mip_levels`: number of smaller levels. Each has half the side of the level before, starts as `start` shrunk, and is
    learnt separately.
    """

    def __init__(self, start: F32, sides: tuple[int, ...] = SIDES, mip_levels: int = 0) -> None:
        super().__init__()
        target = torch.from_numpy(np.ascontiguousarray(start.transpose(2, 0, 1)))[None]
        scales: list[Tensor] = []
        coarser = torch.zeros(1, 1, 1, 1)
        for side in sorted(sides):
            shrunk = functional.interpolate(target, size=(side, side), mode="area")
            scales.append(shrunk - _enlarged(coarser, side))
            coarser = shrunk
        self.scales = nn.ParameterList([nn.Parameter(scale) for scale in reversed(scales)])
        smaller = [max(sides) >> (number + 1) for number in range(mip_levels)]
        self.mips = nn.ParameterList(
            [nn.Parameter(functional.interpolate(target, size=(side, side), mode="area")) for side in smaller]
        )

    def image(self) -> Tensor:
        """Return the texture (1, C, S, S)."""
        *finer, total = list(self.scales)
        for scale in reversed(finer):
            total = scale + _enlarged(total, scale.shape[-1])
        return total.clamp(-LIMIT, LIMIT)

    def levels(self) -> list[Tensor]:
        """Return the texture and its smaller levels, (1, C, S, S), (1, C, S/2, S/2), ..."""
        return [self.image(), *(level.clamp(-LIMIT, LIMIT) for level in self.mips)]


def _enlarged(scale: Tensor, side: int) -> Tensor:
    return functional.interpolate(scale, size=(side, side), mode="bilinear", align_corners=False)


def read_texture(image: Tensor, uv: Tensor, covered: Tensor) -> Tensor:
    """Return the network's input (N, C, H, W): the texture `image` sampled bilinearly at `uv`.

    It is channels-last in memory. Pixels that are not covered are 0.

    `image`: (1, C, S, S). `uv`: (N, H, W, 2) in 0..1. `covered`: (N, H, W) bool.
    """
    n, h, w = covered.shape
    points = uv[covered] * 2 - 1
    values = functional.grid_sample(
        image, points[None, None], mode="bilinear", align_corners=False, padding_mode="border"
    )
    filled = image.new_zeros((n, h, w, image.shape[1]))
    filled[covered] = values[0, :, 0].T
    return filled.permute(0, 3, 1, 2)


# Samples a texture with smaller levels as a GPU does: the more texels a pixel spans, the smaller the level.
#
# Rule: this is OpenGL's trilinear filter (specification 4.6, section 8.14). The level is the binary logarithm of the
# larger distance, in texels, to the next pixel along x or y. The two nearest levels are blended.
#
# A GPU has the derivatives within a triangle. Here, the smaller of the differences to the two neighbours along an axis
# replaces the derivative, because u and v jump across a seam.

#: Lower bound of the distance in texels, so that the logarithm is finite. The level is 0 there anyway.
LEAST = 1e-3


def read_levels(levels: Sequence[Tensor], uv: Tensor, covered: Tensor) -> Tensor:
    """Return the network's input (N, C, H, W): the texture with smaller levels, sampled at `uv`.

    `levels`: (1, C, S, S), (1, C, S/2, S/2), ...; at least one. `uv`: (N, H, W, 2) in 0..1. `covered`: (N, H, W) bool.
    """
    if len(levels) == 1:
        return read_texture(levels[0], uv, covered)
    detail = level_of_detail(uv, covered, levels[0].shape[-1]).clamp(max=len(levels) - 1)[:, None]
    parts = [
        (1 - (detail - number).abs()).clamp(min=0) * read_texture(level, uv, covered)
        for number, level in enumerate(levels)
    ]
    return torch.stack(parts).sum(dim=0)


def levels_of(bundle: Bundle) -> list[Tensor]:
    """Return the texture of `bundle` and its smaller levels for `read_levels`. Raises BadInputError for wrong files."""
    texture = bundle.read_texture()
    levels = [texture, *split_levels(bundle.read_levels(), texture.shape[1])]
    return [torch.from_numpy(level.transpose(2, 0, 1).copy())[None] for level in levels]


def level_of_detail(uv: Tensor, covered: Tensor, side: int) -> Tensor:
    """Return the level (N, H, W): 0 if the next pixel is at most one texel away, 1 if it is two texels away, and so on.

    `side`: side of the texture in texels.
    """
    texels = torch.maximum(_least_step(uv, covered, 1), _least_step(uv, covered, 2)) * side
    return torch.log2(texels.clamp(min=LEAST)).clamp(min=0)


def _least_step(uv: Tensor, covered: Tensor, axis: int) -> Tensor:
    """Return the UV distance (N, H, W) to the nearer of the two neighbours along `axis`; 0 without a neighbour.

    Only neighbours on the body count.
    """
    size = covered.shape[axis] - 1
    ends = (uv.narrow(axis, 0, size), uv.narrow(axis, 1, size))
    both = covered.narrow(axis, 0, size) & covered.narrow(axis, 1, size)
    step = torch.where(both, (ends[1] - ends[0]).norm(dim=-1), torch.inf)
    before = (1, 0) if axis == 2 else (0, 0, 1, 0)
    after = (0, 1) if axis == 2 else (0, 0, 0, 1)
    least = torch.minimum(functional.pad(step, before, value=torch.inf), functional.pad(step, after, value=torch.inf))
    return torch.where(least.isinf(), 0.0, least)


# Weights of a network as an .npz file.
#
# Rule: a file is complete or absent. A network loads weights only from a file that has all of its weights.

SAVED_WEIGHTS = "weights that this network's training saved"


def load_network(network: UNet, path: Path) -> UNet:
    """Load the weights that `save_network` wrote to `path` into `network`, and return `network`.

    Raises BadInputError for any other file, and for the weights of another network.
    """
    try:
        with path.open("rb") as source, np.load(source, allow_pickle=False) as arrays:
            saved = {name: torch.from_numpy(arrays[name]) for name in arrays.files}
    except (*DAMAGED, TypeError) as error:  # NumPy raises TypeError for a lone array
        raise BadInputError(path, reason(error).splitlines()[0], SAVED_WEIGHTS) from error
    prefix = "network."
    weights = {k.removeprefix(prefix): v.float() for k, v in saved.items() if k.startswith(prefix)}
    try:
        missing, unexpected = network.load_state_dict(weights, strict=False)
    except RuntimeError as error:
        raise BadInputError(path, str(error).splitlines()[-1].strip(), SAVED_WEIGHTS) from error
    missing = [name for name in missing if not name.endswith("num_batches_tracked")]
    if missing or unexpected:
        raise BadInputError(path, f"no {missing[0]}" if missing else f"also {unexpected[0]}", SAVED_WEIGHTS)
    return network


def float_network_of(bundle: Bundle, weights: Path) -> UNet:
    """Return the network of `bundle` with the weights in the file `weights`. Raises BadInputError for another file."""
    entry = bundle.manifest.network
    return load_network(UNet(entry.encoder, entry.norm, entry.width, entry.channels, input_skip=True), weights)


def save_network(avatar: TrainableAvatar, path: Path) -> None:
    """Write the network's weights to `path` in half precision, which suffices to continue training.

    Raises BadInputError when `path` cannot be written.
    """
    weights = {f"network.{name}": value.detach().numpy() for name, value in avatar.network.state_dict().items()}
    halves = {name: value.astype(np.float16) for name, value in weights.items() if value.dtype.kind == "f"}
    with write_atomically(path) as draft, draft.open("wb") as file:
        np.savez_compressed(file, **halves)


# Recovers a float network from an avatar's integer network, to continue training if only the avatar was kept.
#
# Rule: the float network computes what the integer network computes, except that activations are not rounded. Batch
# norms, which were folded into the convolutions before them, are restored with the statistics of training samples.

#: Names of the two exported convolutions that each join a convolution of both heads: colour channels first, then mask.
FIRST, SECOND, COLOURS = "first", "second", 3
#: Size and number of the batches on which the norms' statistics are measured.
BATCH, BATCHES = 8, 8


def network_of(bundle: Bundle, groups: list[ShapeGroup], seed: int) -> UNet:
    """Return the float network of `bundle`. Raises BadInputError if its network is wrong or lacks a convolution.

    `groups`: samples for the norms' statistics. `seed`: seed of the choice of batches.
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
    """Yield `BATCHES` inputs (N,C,H,W) of the network of `bundle`, for random samples of `groups`."""
    texture = torch.from_numpy(bundle.read_texture()).permute(2, 0, 1)[None]
    for group, index in islice(batches(groups, BATCH, np.random.default_rng(seed)), BATCHES):
        uv, covered, _ = load_batch(group, index)
        yield read_texture(texture, uv, covered)


def _constants(model: onnx.ModelProto) -> Iterator[tuple[str, tuple[F32, F32]]]:
    """Yield (name, (kernel, bias)) of each convolution of the integer `model`, with the module names of a `UNet`."""
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
    """Give the norms of `network`, in place, the statistics of `inputs`, without changing the network's output.

    On entry, the norms only add their biases.
    """
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


# Paints samples with the float network, for comparison with the integer network.
#
# Rule: the texture is sampled as in training.


def float_painter(network: UNet, *levels: torch.Tensor) -> Painter:
    """Return a painter that runs `network` on the texture `levels`: (1,C,S,S), (1,C,S/2,S/2), ...

    The painter computes on the device of `levels`.
    """
    network.eval()

    def paint(_: Sample, uv: NDArray[np.float32]) -> U8:
        image = torch.from_numpy(np.ascontiguousarray(uv))[None].to(levels[0].device)
        with torch.no_grad():
            output = network(read_levels(levels, image[..., :2], image[..., 2] > 0))
        pixels: U8 = (output[0].permute(1, 2, 0) * 255).round().to(torch.uint8).cpu().numpy()
        return pixels

    return paint


def float_painter_of(bundle: Bundle, weights: Path) -> Painter:
    """Return a painter that runs the float network of `bundle` on the texture of `bundle`.

    `weights`: file that `save_network` wrote. Raises BadInputError for another file or a wrong texture.
    """
    return float_painter(float_network_of(bundle, weights), *levels_of(bundle))


# Quantisation-aware training: weights and activations of a network are rounded to the steps of its bytes.
#
# Rule: the byte ranges are the quantiser's, measured once, when the rounding begins. Gradients pass a rounding
# unchanged and stop where a value is clipped (Bengio et al., Estimating or propagating gradients, 2013). The final
# export measures the ranges again.
#
# The export folds each batch norm into the convolution before it. A weight is therefore rounded after multiplication by
# the scale of its norm, whose statistics must not change. Biases are not rounded: their steps are far finer.

#: Largest integer of a weight, and of an activation.
TOP, BYTE = WEIGHT_TOP[True], 255
#: Modules of the two heads, by the exported tensor that has the outputs of both: the export joins the heads.
HEADS = {"/Relu_output_0": ("colour.2", "mask.2"), "/second/Conv_output_0": ("colour.3", "mask.3")}
#: Levels of the decoder, by the concatenated tensor that each reads. This tensor has a byte range of its own.
JOINED = {f"/Concat{f'_{level}' if level else ''}_output_0": f"levels.{level}" for level in range(len(DECODER))}
NAMED = {INPUT: (INPUT,), **HEADS, **{tensor: (level,) for tensor, level in JOINED.items()}}


class ByteGrid:
    """Rounds the activations of `network` to bytes while `active` is set, and computes rounded weights.

    `places`: names of the K places that store bytes, see `_places`.
    `ends`: (K,2), the real values of bytes 0 and 255 at each place; all 0 until measured.
    `alike`: (1,), 1 if all runtimes must round alike: weights are then even multiples of powers of two.
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
        """Set the grid from `ranges`, the byte ranges of the network's export."""
        by_place = {place: ends for name, ends in ranges.ends.items() for place in _modules_of(name)}
        self.ends.copy_(torch.tensor([by_place[place] for place in self.places]))
        self.alike.fill_(ranges.alike)

    def painted(self, network: UNet, x: Tensor) -> Tensor:
        """Return the output of `network` for the input `x` (N,C,H,W), with rounded weights and activations."""
        output: Tensor = functional_call(network, self.weights(network), (x,))
        return output

    def weights(self, network: UNet) -> dict[str, Tensor]:
        """Return the weights of all convolutions, by name.

        They are changed so that their product with the norm's scale is rounded.
        """
        rounded = {}
        for name, conv, norm in convolutions(network):
            scale = torch.ones(1, device=conv.weight.device)
            if norm is not None:
                assert norm.running_var is not None
                scale = norm.weight.detach() / torch.sqrt(norm.running_var + norm.eps)
            with torch.no_grad():
                by_channel = scale[:, None, None, None]
                change = rounded_weights(conv.weight * by_channel, bool(self.alike)) / by_channel - conv.weight
            rounded[f"{name}.weight"] = conv.weight + change.nan_to_num(posinf=0.0, neginf=0.0)
        return rounded

    def _stored(self, x: Tensor, place: int) -> Tensor:
        if not self.active:
            return x
        low, high = map(float, self.ends[place])
        step = (high - low) / BYTE
        zero = round(-low / step)
        rounded: Tensor = _Rounded.apply(x, -zero * step, (BYTE - zero) * step, step)
        return rounded


class _Rounded(torch.autograd.Function):
    """Rounds values to multiples of a step, between two ends. Gradients pass inside the ends and are 0 outside.

    This operator keeps one tensor, and takes about half the time of separate operators with autograd.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, low: float, high: float, step: float) -> Tensor:
        ctx.save_for_backward(x)
        ctx.ends = low, high
        return x.clamp(low, high).div_(step).round_().mul_(step)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        (x,) = ctx.saved_tensors
        return torch.ops.aten.hardtanh_backward(gradient, x, *ctx.ends), None, None, None


def rounded_weights(folded: Tensor, alike: bool) -> Tensor:
    """Return the weights `folded`, rounded as in the bundle: to whole multiples of the scale of their output channel.

    `folded` (O,I,h,w): weights times the scale of their batch norm.
    `alike`: whether all runtimes must round alike. If so, scales are powers of two, and only even multiples are used.
    """
    largest = folded.abs().amax(dim=(1, 2, 3), keepdim=True).clamp(min=1e-30)
    unit = 2 * torch.exp2(torch.ceil(torch.log2(largest / (TOP + 0.99)))) if alike else largest / TOP
    return torch.round(folded / unit) * unit


def convolutions(network: UNet) -> Iterator[tuple[str, nn.Conv2d, nn.BatchNorm2d | None]]:
    """Yield (name, convolution, batch norm behind it or None) of each convolution of `network`."""
    named = list(network.named_modules())
    for (name, module), (_, after) in zip(named, [*named[1:], ("", None)], strict=True):
        if isinstance(module, nn.Conv2d):
            yield name, module, after if isinstance(after, nn.BatchNorm2d) else None


def _places(network: UNet) -> Iterator[str]:
    """Yield the names of the places of `network`: activation tensors that the exported network stores as bytes.

    A place has the name of the module that reads or makes the tensor; the network's input is `INPUT`. Places are the
    input, concatenated inputs of decoder levels, outputs of ReLUs, outputs of norms without ReLU, and outputs of the
    heads.
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
    """Return the names of the places of a `ByteGrid` that store the exported `tensor`."""
    if tensor in NAMED:
        return NAMED[tensor]
    name, operator = module_of(tensor), tensor.rpartition("/")[2]
    if operator.startswith("Conv") and name:
        before, _, number = name.rpartition(".")
        return (f"{before}.{int(number) + 1}",) if number.isdecimal() else ()
    return (name,)


def module_of(exported: str) -> str:
    """Return the name of the module of an `exported` operator or tensor: `a.b.0.1` for `/a/b.0/b.0.1/Conv`."""
    path: list[str] = []
    for scope in exported.strip("/").split("/")[:-1]:
        if path and scope.startswith(f"{path[-1]}."):
            path.pop()
        path.append(scope)
    return ".".join(path)
