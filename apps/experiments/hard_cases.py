"""Numerically hard inputs and networks: how near the picture stays to the float network's, on every runtime.

Rule: networks are untrained and seeded, errors are mean steps of 1/255, and every case has a stated bound. The bounds
are wide where instance and group norm amplify nearly constant maps, and where inputs leave the calibrated range.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trilane.arrays import F32
from trilane.avatars.integer_network import NetworkFile
from trilane.errors import MissingPartError
from trilane.stages.dsp.runtime import RuntimeOptions, load_runtime
from trilane.training.quantising.quantise import quantise

SHAPE = (64, 64, 4)
WIDTH = 8
OUTLIER = 100.0
UNIT = "mean step of 1/255"
SOURCE = "the float network in PyTorch on the same bytes"

INPUTS: dict[str, Callable[[np.random.Generator], F32]] = {
    "constant map": lambda _: np.full(SHAPE, 0.7, np.float32),
    "all background": lambda _: np.zeros(SHAPE, np.float32),
    "saturating": lambda rng: (10 * rng.normal(size=SHAPE)).astype(np.float32),
    "usual": lambda rng: rng.normal(size=SHAPE).astype(np.float32),
}
FOLDED = {"constant map": 1.0, "all background": 1.0, "saturating": 5.0, "usual": 1.0}
STATISTICS = {"constant map": 12.0, "all background": 1.0, "saturating": 22.0, "usual": 9.0}
#: Network: its norm, whether one channel of the stem is a hundredfold, and the bound of each input.
NETWORKS: dict[str, tuple[str, bool, dict[str, float]]] = {
    "batch": ("batch", False, FOLDED),
    "instance": ("instance", False, STATISTICS),
    "group": ("group", False, STATISTICS),
    "outlier channel": ("batch", True, FOLDED),
}


@dataclass(frozen=True)
class Pair:
    """A network in float and in integers, calibrated on usual frames."""

    network: Any
    integer: NetworkFile
    bounds: dict[str, float]


def make_pair(name: str) -> Pair:
    """The pair of row `name` of `NETWORKS`. Raises MissingPartError without PyTorch."""
    try:
        import torch
    except ImportError:
        raise MissingPartError("hard cases need PyTorch", extra="train") from None
    from trilane.training.network import UNet
    from trilane.training.onnx_export import export_onnx

    norm, outlier, bounds = NETWORKS[name]
    torch.manual_seed(0)
    network = UNet(norm=norm, width=WIDTH, channels=SHAPE[2])
    if outlier:
        with torch.no_grad():
            network.encoder.stem[0].weight[0] *= OUTLIER
    rng = np.random.default_rng(0)
    frames = [INPUTS["usual"](rng) for _ in range(4)]
    return Pair(network.eval(), quantise(export_onnx(network, *SHAPE[:2]), frames).network, bounds)


def error_of(pair: Pair, case: str, runtime: str) -> float:
    """Mean difference in steps of 1/255; NaN when the float network gives no number.

    `pair`: the two networks.
    `case`: key of `INPUTS`.
    `runtime`: that runs the integer network.
    """
    import torch

    encoding = pair.integer.input
    frame = INPUTS[case](np.random.default_rng(7))
    tensor = np.clip(np.round(frame / encoding.scale) + encoding.zero_point, 0, 255).astype(np.uint8)
    image = np.zeros((1, *SHAPE[:2], 4), np.uint8)
    load_runtime(runtime).load(pair.integer, RuntimeOptions()).bind([np.ascontiguousarray(tensor[None])], [image]).run()
    real = (tensor.astype(np.float32) - encoding.zero_point) * np.float32(encoding.scale)
    with torch.no_grad():
        wanted = pair.network(torch.from_numpy(real).permute(2, 0, 1)[None]).permute(0, 2, 3, 1).numpy()
    return float(np.abs(image - 255 * wanted).mean())


def hard_cases(runtimes: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Rows with `name`, `error`, `bound`, `unit`, `source`, `passed`. Raises MissingPartError."""
    for network in NETWORKS:
        pair = make_pair(network)
        for case in INPUTS:
            for runtime in runtimes:
                error, bound = error_of(pair, case, runtime), pair.bounds[case]
                name = f"{network}, {case}, {runtime}"
                yield {
                    "name": name,
                    "error": error,
                    "bound": bound,
                    "unit": UNIT,
                    "source": SOURCE,
                    "passed": bool(error <= bound),
                }
