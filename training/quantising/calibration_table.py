"""Compares calibration methods and numbers of frames by the error of the picture.

Rule: the error is measured on frames that are never used for calibration, against the float network's pictures.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray

from trilane.arrays import F32, psnr_db
from trilane.errors import BadInputError
from trilane.hw_profiles.governor import figure_for
from trilane.training.quantising.quantise import quantise
from trilane.units import CALIBRATION_METHODS
from trilane.writing import write_atomically

#: PSNRs that differ by at most this many dB count as equal.
TIE_DB = 0.1
COUNTS = (5, 10, 50, 100)
#: Default number of frames, at the end of all frames, on which the error is measured.
EVALUATED = 5
PROVIDERS = ["CPUExecutionProvider"]
ERRORS_ONLY = 3


def calibration_table(
    model: onnx.ModelProto,
    frames: Sequence[F32],
    methods: Sequence[str] = CALIBRATION_METHODS,
    counts: Sequence[int] = COUNTS,
    held_out: int = EVALUATED,
) -> Iterator[dict[str, Any]]:
    """Yield a row for each method and count: `method`, `count`, `psnr_db`, `mean`, `largest`.

    `psnr_db` is the mean PSNR over the last `held_out` frames. `mean` and `largest` are the mean and the largest
    absolute error of a value, in steps of 1/255.

    `model`: float network with an input of (1, C, H, W).
    `frames`: inputs (H, W, C) float32.
    `methods`: names of `CALIBRATION_METHODS`.
    `counts`: numbers of calibration frames. A count that would reach into the last `held_out` frames is left out.
    `held_out`: number of frames, at the end of `frames`, on which the error is measured.

    Raises BadInputError for too few frames for the smallest count, and for an unknown method.
    """
    spare = len(frames) - held_out
    possible = [count for count in counts if count <= spare]
    if not possible:
        raise BadInputError("frames", f"{len(frames)} of them", f"at least {min(counts) + held_out}")
    for method in methods:
        if method not in CALIBRATION_METHODS:
            raise BadInputError("--method", repr(method), f"one of {', '.join(CALIBRATION_METHODS)}")
    evaluated = frames[spare:]
    run = _session(model)
    channels_first = [np.ascontiguousarray(frame.transpose(2, 0, 1)[None]) for frame in evaluated]
    float_pictures = [255 * run(frame).transpose(0, 2, 3, 1) for frame in channels_first]
    for method in methods:
        for count in possible:
            network = quantise(model, frames[:count], method).network
            integer, scale, zero = _session(network.model), network.input.scale, network.input.zero_point
            tensors = [np.clip(np.round(f / scale) + zero, 0, 255).astype(np.uint8)[None] for f in evaluated]
            yield {"method": method, "count": count, **_errors(float_pictures, [integer(t) for t in tensors])}


def recommended(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return the row with the fewest frames among the rows whose PSNR is within `TIE_DB` of the best PSNR.

    If several rows have equally few frames, return the row with the highest PSNR. Raises ValueError without rows.
    """
    best = max(float(row["psnr_db"]) for row in rows)
    ties = [row for row in rows if best - float(row["psnr_db"]) <= TIE_DB]
    return min(ties, key=lambda row: (row["count"], -row["psnr_db"]))


def recommendation(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return one line about the recommended row of the table and its distance to the best row."""
    row, best = recommended(rows), max(float(row["psnr_db"]) for row in rows)
    return (
        f"{row['method']} on {row['count']} frames: {row['psnr_db']:.2f} dB, {best - row['psnr_db']:.2f} dB below the "
        f"best; within {TIE_DB} dB the fewest frames win"
    )


def _session(model: onnx.ModelProto) -> Any:
    """Return a function that runs the network: it takes the only input array and returns the only output array."""
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = ERRORS_ONLY
    session = onnxruntime.InferenceSession(model.SerializeToString(), settings, providers=PROVIDERS)
    name = session.get_inputs()[0].name
    return lambda feed: session.run(None, {name: feed})[0]


def _errors(float_pictures: Sequence[F32], pictures: Sequence[NDArray[np.uint8]]) -> dict[str, float]:
    differences = [np.abs(true - picture) for true, picture in zip(float_pictures, pictures, strict=True)]
    squares = [float(np.square(difference, dtype=np.float64).mean()) for difference in differences]
    return {
        "psnr_db": float(np.mean([psnr_db(square / 255**2) for square in squares])),
        "mean": float(np.mean([difference.mean() for difference in differences])),
        "largest": float(max(difference.max() for difference in differences)),
    }


# Draws the calibration table: the PSNR of the picture over the number of frames, with a line for each method.
#
# Rule: nothing is computed here.


def plot_calibrations(rows: Sequence[Mapping[str, Any]], recommendation: str, path: Path) -> None:
    """Draw `rows` of the calibration table into a picture file, with `recommendation` as its title.

    Raises MissingPartError without Matplotlib, BadInputError for an unknown suffix or a file that cannot be written.
    """
    figure = figure_for(path, (9, 4.5))
    axes = figure.subplots()
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        axes.plot([row["count"] for row in own], [row["psnr_db"] for row in own], marker="o", label=method)
    counts = sorted({row["count"] for row in rows})
    axes.set_xscale("log")
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.minorticks_off()
    axes.set(xlabel="frames to calibrate on", ylabel="PSNR to the float network, dB")
    axes.set_title(f"recommended: {recommendation}", fontsize="medium")
    axes.grid(alpha=0.3)
    axes.legend(title="method", fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    with write_atomically(path) as draft:
        figure.savefig(draft, dpi=120)
