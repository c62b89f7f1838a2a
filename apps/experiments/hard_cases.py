"""How near an integer network's picture stays to the float network's on hard networks and inputs, on every runtime.

Rule: a bound is the smaller of two, which follow from the network, the input and the steps: the integer network's own
(`noise_model`), and an ideal quantiser's (`ideal_noise`), so that coarse steps do not raise the bound of their error.
Neither follows from a runtime's picture. A row whose bound a wrong picture would keep fails, whatever its error is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx

from trilane.apps.experiments.hard_networks import INPUTS, NETWORKS, calibration_frames, case_input, float_network
from trilane.arrays import F32, U8
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
#: Pixels by which a shifted picture is shifted.
SHIFT = 8
HOLDS, EXCEEDED, UNTOLD = "holds", "FAILS: error above the bound", "FAILS: a wrong picture would keep the bound"


@dataclass(frozen=True)
class Pair:
    """A network in float and in integers, calibrated on usual frames, and the model of the integers' noise."""

    network: onnx.ModelProto
    quantised: Quantised
    noise: NoiseModel


@dataclass(frozen=True)
class Case:
    """A network with an input: what is expected, and what a picture's error may be.

    `tensor`: bytes (1, H, W, C). `wanted`: the float network's picture (1, H, W, 4), of 255.
    `predicted`, `bound`: expected error and bound, with the steps of `source`, whose bound is smaller.
    `own_bound`: the bound with the integer network's steps. `wrong`: least error of each kind of wrong picture.
    """

    pair: Pair
    tensor: U8
    wanted: F32
    predicted: float
    bound: float
    source: str
    own_bound: float
    wrong: dict[str, float]

    @property
    def tells(self) -> bool:
        """Whether every wrong picture is above the bound."""
        return self.bound < min(self.wrong.values())

    def verdict(self, error: float) -> str:
        """What a picture's `error` means; an error that is not a number is above the bound."""
        if not self.tells:
            return UNTOLD
        return HOLDS if error <= self.bound else EXCEEDED


def make_pair(name: str) -> Pair:
    """The pair of row `name` of `NETWORKS`. Raises MissingPartError without PyTorch."""
    network = float_network(name)
    quantised = quantise(network, calibration_frames())
    return Pair(network, quantised, noise_model(quantised))


def make_case(pair: Pair, case: str) -> Case:
    """Row `case` of `INPUTS` on the networks of `pair`."""
    encoding = pair.quantised.network.input
    steps = np.round(case_input(case) / encoding.scale) + encoding.zero_point
    tensor = np.ascontiguousarray(np.clip(steps, 0, 255).astype(np.uint8)[None])
    wanted = float_picture(pair.network, pair.quantised, tensor)
    models = {OWN_STEPS: pair.noise, IDEAL_STEPS: ideal_noise_model(pair.network, pair.quantised, tensor)}
    bounds = {source: predicted_bound(model, wanted, tensor) for source, model in models.items()}
    source, (predicted, bound) = min(bounds.items(), key=lambda row: row[1][1])
    return Case(pair, tensor, wanted, predicted, bound, source, bounds[OWN_STEPS][1], wrong_answers(wanted[0]))


def error_of(case: Case, runtime: str) -> float:
    """Mean difference of `runtime`'s picture in steps of 1/255; NaN when the float network gives no number."""
    image = np.zeros(case.wanted.shape, np.uint8)
    session = load_runtime(runtime).load(case.pair.quantised.network, RuntimeOptions())
    session.bind([case.tensor], [image]).run()
    return float(np.abs(image - case.wanted).mean())


def wrong_answers(wanted: F32) -> dict[str, float]:
    """The errors of pictures that are wrong, against `wanted` (H, W, 4), of 255: of each kind, the least.

    `constant_error`: the best picture of one colour, which is the median of each channel.
    `shifted_error`: `wanted` moved by `SHIFT` pixels, up, down, left or right, wrapped or with its edge repeated.
    `swapped_error`: red and blue exchanged.
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
    """`picture` moved along `axis`, wrapped and with its edge repeated."""
    places = np.arange(picture.shape[axis]) - by
    yield np.take(picture, places % len(places), axis)
    yield np.take(picture, np.clip(places, 0, len(places) - 1), axis)


def hard_cases(runtimes: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Rows of every network, input and runtime. Raises MissingPartError.

    Keys: `name`, `error`, `bound`, `unit`, `source` (of the bound), `predicted_error`, those of `wrong_answers`,
    `verdict`, `passed`. `error` is None where it is no number, which is above every bound.
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
