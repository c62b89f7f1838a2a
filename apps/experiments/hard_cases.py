"""Errors of integer networks against their float networks, for hard networks and inputs, on every runtime.

Rule: a bound follows from network, input and quantisation steps, never from a runtime's picture. The bound is the
smaller of two: one with the steps of the integer network (`noise_model`), one with the steps of an ideal quantiser
(`ideal_noise_model`). Therefore coarse steps do not widen the bound on their own error. A row also fails if a wrong
picture would stay within its bound. Networks have random weights of a fixed seed, chosen so that a wrong picture has a
large error. No input is constant, because a constant picture could then be right.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx

from trilane.arrays import F32, U8
from trilane.errors import MissingPartError
from trilane.stages.dsp.runtime import RuntimeOptions, load_runtime
from trilane.training.quantising.noise_model import (
    NoiseModel,
    float_picture,
    ideal_noise_model,
    noise_model,
    predicted_bound,
)
from trilane.training.quantising.quantise import Quantised, quantise

UNIT = "mean step of 1/255"
SOURCE = "computed: the float network with the rounding errors of every stored tensor and weight (docs/networks.md)"
OWN_STEPS, IDEAL_STEPS = "computed with the integer network's steps", "computed with ideal steps"
#: Shift of a wrong, shifted picture, pixels.
SHIFT = 8
HOLDS, EXCEEDED, UNTOLD = "holds", "FAILS: error above the bound", "FAILS: a wrong picture would keep the bound"
SIDE, CHANNELS, WIDTH = 64, 4, 8
OUTLIER = 100.0
#: Factor of the input "saturating" over usual frames. Bytes of an input represent values up to about 3.
EXCESS = 10.0
CALIBRATION_FRAMES = 8
CASE_SEED, NETWORK_SEED = 7, 0
#: Semi-axes of the figure and the largest distance of its centre from the middle, as shares of the side.
FIGURE_HEIGHT, FIGURE_WIDTH, OFF_CENTRE = 0.42, 0.25, 0.1
#: Size of the figure in "little but background", as a share of the usual size.
SMALL = 0.7
#: Sides of the cells of `_smooth` and `_flat` textures, in pixels.
SMOOTH_CELL, FLAT_CELL = 8, 16
#: Norm of a kernel's smooth part, and size of its random part.
GAIN, RANDOM_PART = 2**0.5, 0.5
#: Factor on the weights of features from deeper levels, largest bias of a norm, standard deviation of the logits.
DEEP, BIAS, CONTRAST = 0.25, 0.05, 1.5
#: Name of a network -> its norm, and whether the weights of one channel of the stem are `OUTLIER` times as large.
NETWORKS: dict[str, tuple[str, bool]] = {
    "batch": ("batch", False),
    "instance": ("instance", False),
    "group": ("group", False),
    "outlier channel": ("batch", True),
}
#: Name of an input -> function that draws it, (SIDE, SIDE, CHANNELS).
INPUTS: dict[str, Callable[[np.random.Generator], F32]] = {
    "constant patches": lambda rng: _in_figure(rng, _flat),
    "little but background": lambda rng: _in_figure(rng, _smooth, SMALL),
    "saturating": lambda rng: np.float32(EXCESS) * _in_figure(rng, _smooth),
    "usual": lambda rng: _in_figure(rng, _smooth),
}


@dataclass(frozen=True)
class NetworkPair:
    """A float network, its integer network, and the noise model of the integer network.

    `network`: float network. `quantised`: integer network, calibrated on usual frames. `noise`: model of the integer
    network's rounding errors.
    """

    network: onnx.ModelProto
    quantised: Quantised
    noise: NoiseModel


@dataclass(frozen=True)
class Case:
    """A pair of networks with an input, the expected picture, and the bound on a picture's error.

    `pair`: the networks. `tensor`: input (1,H,W,C) uint8. `wanted`: picture of the float network (1,H,W,4), in steps of
    1/255. `predicted`, `bound`: expected error and bound, from the noise model with the smaller bound.
    `source`: name of this noise model. `own_bound`: bound from the model with the integer network's steps.
    `wrong`: result of `wrong_answers`. All errors and bounds are means, in steps of 1/255.
    """

    pair: NetworkPair
    tensor: U8
    wanted: F32
    predicted: float
    bound: float
    source: str
    own_bound: float
    wrong: dict[str, float]

    @property
    def tells(self) -> bool:
        """Whether the error of every kind of wrong picture is above the bound."""
        return self.bound < min(self.wrong.values())

    def verdict(self, error: float) -> str:
        """Return the verdict on a picture's `error`: HOLDS, EXCEEDED or UNTOLD. NaN counts as above the bound.

        UNTOLD means that the error of a wrong picture could also be within the bound (`tells` is false).
        """
        if not self.tells:
            return UNTOLD
        return HOLDS if error <= self.bound else EXCEEDED


def make_pair(name: str) -> NetworkPair:
    """Return the network `name` of `NETWORKS`, in float and in integers. Raises MissingPartError without PyTorch."""
    network = float_network(name)
    quantised = quantise(network, calibration_frames())
    return NetworkPair(network, quantised, noise_model(quantised))


def make_case(pair: NetworkPair, case: str) -> Case:
    """Return the case of the networks `pair` with the input named `case`, a key of `INPUTS`."""
    encoding = pair.quantised.network.input
    steps = np.round(case_input(case) / encoding.scale) + encoding.zero_point
    tensor = np.ascontiguousarray(np.clip(steps, 0, 255).astype(np.uint8)[None])
    wanted = float_picture(pair.network, pair.quantised, tensor)
    models = {OWN_STEPS: pair.noise, IDEAL_STEPS: ideal_noise_model(pair.network, pair.quantised, tensor)}
    bounds = {source: predicted_bound(model, wanted, tensor) for source, model in models.items()}
    source, (predicted, bound) = min(bounds.items(), key=lambda row: row[1][1])
    return Case(pair, tensor, wanted, predicted, bound, source, bounds[OWN_STEPS][1], wrong_answers(wanted[0]))


def error_of(case: Case, runtime: str) -> float:
    """Return the mean absolute error of `runtime`'s picture, in steps of 1/255.

    The error is NaN if the float network's picture contains NaN. Raises MissingPartError without the runtime.
    """
    image = np.zeros(case.wanted.shape, np.uint8)
    session = load_runtime(runtime).load(case.pair.quantised.network, RuntimeOptions())
    session.bind([case.tensor], [image]).run()
    return float(np.abs(image - case.wanted).mean())


def wrong_answers(wanted: F32) -> dict[str, float]:
    """Return the least error of each kind of wrong picture against `wanted` (H,W,4), all in steps of 1/255.

    `constant_error`: error of the best picture of one colour, which is the median of each channel.
    `shifted_error`: least error of `wanted` moved by `SHIFT` pixels up, down, left or right, wrapped or with its edge
    repeated.
    `swapped_error`: error of `wanted` with red and blue exchanged.
    """
    shifted = (
        np.abs(moved - wanted).mean() for axis in (0, 1) for by in (SHIFT, -SHIFT) for moved in _moved(wanted, by, axis)
    )
    return {
        "constant_error": float(np.abs(wanted - np.median(wanted, axis=(0, 1))).mean()),
        "shifted_error": float(min(shifted)),
        "swapped_error": float(np.abs(wanted[..., [2, 1, 0, 3]] - wanted).mean()),
    }


def _moved(picture: F32, by: int, axis: int) -> Iterator[F32]:
    """Yield `picture` moved by `by` pixels along `axis`: first wrapped, then with its edge repeated."""
    places = np.arange(picture.shape[axis]) - by
    yield np.take(picture, places % len(places), axis)
    yield np.take(picture, np.clip(places, 0, len(places) - 1), axis)


def hard_cases(runtimes: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield a row for each network of `NETWORKS`, input of `INPUTS` and runtime of `runtimes`.

    Keys, besides the keys of `wrong_answers`:
    `name`: name of the row.
    `error`: mean error; None if it is not a finite number, which counts as above every bound.
    `bound`: bound on the error.
    `unit`: unit of the error and of the bound.
    `source`: source of the bound.
    `predicted_error`: expected error.
    `verdict`: verdict as text.
    `passed`: whether the verdict is HOLDS.

    Raises MissingPartError without PyTorch or a runtime.
    """
    for network in NETWORKS:
        pair = make_pair(network)
        for name in INPUTS:
            case = make_case(pair, name)
            for runtime in runtimes:
                error = error_of(case, runtime)
                verdict = case.verdict(error)
                yield {
                    "name": f"{network}, {name}, {runtime}",
                    "error": error if math.isfinite(error) else None,
                    "bound": case.bound,
                    "unit": UNIT,
                    "source": case.source,
                    "predicted_error": case.predicted,
                    **case.wrong,
                    "verdict": verdict,
                    "passed": verdict == HOLDS,
                }


def _smooth(rng: np.random.Generator) -> F32:
    """Return a texture (SIDE,SIDE,CHANNELS) with random values at the corners of cells, and linear values between them.

    The random values are normally distributed. `rng`: random numbers.
    """
    cells = SIDE // SMOOTH_CELL
    corners = rng.normal(size=(cells + 1, cells + 1, CHANNELS))
    place = np.linspace(0, cells, SIDE)
    first = np.minimum(place.astype(int), cells - 1)
    share = place - first
    rows = corners[first] * (1 - share)[:, None, None] + corners[first + 1] * share[:, None, None]
    texture: F32 = (rows[:, first] * (1 - share)[:, None] + rows[:, first + 1] * share[:, None]).astype(np.float32)
    return texture


def _flat(rng: np.random.Generator) -> F32:
    """Return a texture (SIDE,SIDE,CHANNELS) with one normally distributed value in each cell and channel.

    `rng`: random numbers.
    """
    cells = SIDE // FLAT_CELL
    values = rng.normal(size=(cells, cells, CHANNELS)).astype(np.float32)
    return values.repeat(FLAT_CELL, axis=0).repeat(FLAT_CELL, axis=1)


def _in_figure(rng: np.random.Generator, texture: Callable[[np.random.Generator], F32], size: float = 1.0) -> F32:
    """Return a frame (SIDE,SIDE,CHANNELS) with a texture inside a randomly placed ellipse, and 0 outside the ellipse.

    `rng`: random numbers. `texture`: function that draws the texture from `rng`. `size`: size of the ellipse, as a
    share of the usual size.
    """
    row, column = np.mgrid[:SIDE, :SIDE] / SIDE - 0.5
    down, right = rng.uniform(-OFF_CENTRE, OFF_CENTRE, 2)
    inside = ((row - down) / FIGURE_HEIGHT) ** 2 + ((column - right) / FIGURE_WIDTH) ** 2 < size**2
    frame: F32 = np.where(inside[..., None], texture(rng), np.float32(0))
    return frame


def case_input(case: str) -> F32:
    """Return the input named `case`, a key of `INPUTS`, (SIDE,SIDE,CHANNELS). It is no calibration frame."""
    return INPUTS[case](np.random.default_rng(CASE_SEED))


def calibration_frames() -> list[F32]:
    """Return `CALIBRATION_FRAMES` inputs of the kind "usual", each (SIDE, SIDE, CHANNELS)."""
    rng = np.random.default_rng(NETWORK_SEED)
    return [INPUTS["usual"](rng) for _ in range(CALIBRATION_FRAMES)]


def float_network(name: str) -> onnx.ModelProto:
    """Return the float network `name` of `NETWORKS`. Raises MissingPartError without PyTorch.

    As in trained networks, kernels are partly smooth, and each level weakens the features from deeper levels. Therefore
    rounding errors do not hide the picture. The output layers give every colour its own mean and contrast.
    """
    try:
        import torch
    except ImportError:
        raise MissingPartError("hard cases need PyTorch", extra="train") from None
    from trilane.training.network import UNet, export_onnx

    norm, outlier = NETWORKS[name]
    generator = torch.Generator().manual_seed(NETWORK_SEED)
    network = UNet(norm=norm, width=WIDTH, channels=CHANNELS).eval()
    with torch.no_grad():
        for module in network.modules():
            _draw(module, generator)
        *skips, _ = network.encoder.channels
        for level, skip in zip(network.levels, (*reversed(skips), 0), strict=True):
            level[0].weight[:, : level[0].weight.shape[1] - skip] *= DEEP
        if outlier:
            network.encoder.stem[0].weight[0] *= OUTLIER
        features = network.features(torch.from_numpy(np.stack(calibration_frames())).permute(0, 3, 1, 2))
        for head in (network.colour, network.mask):
            _give_contrast(head, features)
    return export_onnx(network, SIDE, SIDE)


def _draw(module: Any, generator: Any) -> None:
    """Draw random weights for `module` if it is a convolution, or random biases if it is a norm.

    For each output channel of a convolution, the sum of the smooth parts over the input channels is 0. `generator`:
    PyTorch's random numbers.
    """
    import torch

    if isinstance(module, torch.nn.Conv2d):
        count, side = module.weight.shape[1], module.weight.shape[2]
        across = torch.randn(*module.weight.shape[:2], generator=generator)
        across -= across.mean(1, keepdim=True)
        across *= GAIN / across.norm(dim=1, keepdim=True)
        row = torch.tensor([math.comb(side - 1, place) / 2 ** (side - 1) for place in range(side)])
        noise = torch.randn(module.weight.shape, generator=generator) * (RANDOM_PART / side / count**0.5)
        module.weight.copy_(across[:, :, None, None] * row[:, None] * row + noise)
        if module.bias is not None:
            module.bias.zero_()
    elif getattr(module, "bias", None) is not None:
        module.bias.uniform_(-BIAS, BIAS, generator=generator)


def _give_contrast(head: Any, features: Any) -> None:
    """Scale the last layer of `head` so that its logits for `features` have a given spread and given means.

    The standard deviation of each channel becomes `CONTRAST`, and the means of the channels run evenly from -1 to 1.
    `head`: output layers for colour or mask. `features`: features (N,C,H,W) of the calibration frames.
    """
    import torch

    logits = head(features)
    scale = CONTRAST / logits.std(dim=(0, 2, 3))
    head[3].weight *= scale[:, None, None, None]
    head[3].bias.copy_(torch.linspace(-1, 1, len(scale)) - scale * logits.mean(dim=(0, 2, 3)))
