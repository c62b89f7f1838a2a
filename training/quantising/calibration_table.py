"""What the number of calibration frames and the method cost the picture.

Rule: pictures are judged on frames that no row was calibrated on, against the float network on the unrounded input.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray

from trilane.arrays import F32
from trilane.errors import BadInputError
from trilane.training.quantising.calibration import METHODS
from trilane.training.quantising.quantise import quantise

COUNTS = (5, 10, 20, 50, 100)
JUDGED = 5
PROVIDERS = ["CPUExecutionProvider"]
ERRORS_ONLY = 3


def calibration_table(
    model: onnx.ModelProto,
    frames: Sequence[F32],
    methods: Sequence[str] = tuple(METHODS),
    counts: Sequence[int] = COUNTS,
) -> Iterator[dict[str, Any]]:
    """Rows `method`, `count`, `psnr_db` (mean over the last `JUDGED` frames), `mean` and `largest` (of 255).

    `model`: the float network (1, C, H, W). `frames`: (H, W, C) each; counts that would reach into the judged ones are
    left out. Raises BadInputError when there are too few frames for the smallest count, or for an unknown method.
    """
    spare = len(frames) - JUDGED
    possible = [count for count in counts if count <= spare]
    if not possible:
        raise BadInputError("frames", f"{len(frames)} of them", f"at least {min(counts) + JUDGED}")
    for method in methods:
        if method not in METHODS:
            raise BadInputError("--method", repr(method), f"one of {', '.join(METHODS)}")
    judged = frames[spare:]
    run = _session(model)
    wanted = [255 * run(np.ascontiguousarray(frame.transpose(2, 0, 1)[None])).transpose(0, 2, 3, 1) for frame in judged]
    for method in methods:
        for count in possible:
            network = quantise(model, frames[:count], method).network
            integer, scale, zero = _session(network.model), network.input.scale, network.input.zero_point
            found = [integer(np.clip(np.round(f / scale) + zero, 0, 255).astype(np.uint8)[None]) for f in judged]
            yield {"method": method, "count": count, **_errors(wanted, found)}


def _session(model: onnx.ModelProto) -> Any:
    """A function of the network's one input."""
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = ERRORS_ONLY
    session = onnxruntime.InferenceSession(model.SerializeToString(), settings, providers=PROVIDERS)
    name = session.get_inputs()[0].name
    return lambda feed: session.run(None, {name: feed})[0]


def _errors(wanted: Sequence[F32], found: Sequence[NDArray[np.uint8]]) -> dict[str, float]:
    differences = [np.abs(true - picture) for true, picture in zip(wanted, found, strict=True)]
    squares = [float(np.square(difference, dtype=np.float64).mean()) for difference in differences]
    return {
        "psnr_db": float(np.mean([20 * math.log10(255) - 10 * math.log10(max(square, 1e-12)) for square in squares])),
        "mean": float(np.mean([difference.mean() for difference in differences])),
        "largest": float(max(difference.max() for difference in differences)),
    }
