"""LPIPS of two pictures, with AlexNet, and weights that somebody gives by path.

Rule: nothing is downloaded, and nothing but tensors is read from the file: the weights of `lpips.LPIPS(net="alex")` by
the names that its authors' library has, as `torch.save(lpips.LPIPS().state_dict(), FILE)` writes them.

Source: Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018, version 0.1.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from trilane.arrays import F64
from trilane.errors import BadInputError, MissingPartError

EXPECTED = "a file of all weights of lpips.LPIPS(net='alex')"
REMEDY = "torch.save(lpips.LPIPS().state_dict(), FILE) writes one"
#: Of AlexNet's convolutions: name in the file, outputs, inputs, side, stride, padding, whether pooling comes before.
LAYERS = (
    ("slice1.0", 64, 3, 11, 4, 2, False),
    ("slice2.3", 192, 64, 5, 1, 2, True),
    ("slice3.6", 384, 192, 3, 1, 1, True),
    ("slice4.8", 256, 384, 3, 1, 1, False),
    ("slice5.10", 256, 256, 3, 1, 1, False),
)
#: What a picture in -1..1 is shifted and divided by.
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
#: Keeps a feature vector of nothing from 0 / 0.
TINY = 1e-10
#: The least side of a picture that all layers see something of.
LEAST_PX = 64


class Lpips:
    """LPIPS with the weights of a file."""

    def __init__(self, weights: Path) -> None:
        """Raises BadInputError, MissingPartError without PyTorch."""
        try:
            import torch
        except ImportError as error:
            raise MissingPartError(f"LPIPS needs {error.name}", extra="train") from None
        try:
            state = torch.load(weights, map_location="cpu", weights_only=True)
        except OSError as error:
            raise BadInputError.of_os_error(weights, error, EXPECTED) from None
        except Exception:  # of whatever kind: PyTorch raises many, some with the advice to read the file less carefully
            raise BadInputError(str(weights), "a file that is not of tensors alone", EXPECTED, REMEDY) from None
        self._state = {name: _tensor(state, name, shape, weights) for name, shape in _shapes()}

    def __call__(self, picture: F64, reference: F64) -> float | None:
        """LPIPS of two pictures (h,w,3), sRGB in 0..1; 0 without an error, None when a side is below `LEAST_PX`."""
        import torch

        if min(picture.shape[:2]) < LEAST_PX:
            return None
        with torch.no_grad():
            pairs = zip(self._features(picture), self._features(reference), strict=True)
            return sum(
                float(((first - second).square() * self._state[f"lin{number}.model.1.weight"]).sum(1).mean())
                for number, (first, second) in enumerate(pairs)
            )

    def _features(self, picture: F64) -> Iterator[Any]:
        """(1,C,h,w) of each layer: unit vectors of the features of each place."""
        import torch
        from torch.nn import functional

        scaled = np.ascontiguousarray(((2 * picture - 1 - SHIFT) / SCALE).transpose(2, 0, 1), np.float32)
        values = torch.from_numpy(scaled)[None]
        for name, _, _, _, stride, padding, pooled in LAYERS:
            values = functional.max_pool2d(values, 3, 2) if pooled else values
            kernel, bias = self._state[f"net.{name}.weight"], self._state[f"net.{name}.bias"]
            values = functional.relu(functional.conv2d(values, kernel, bias, stride, padding))
            yield values / (values.square().sum(1, keepdim=True).sqrt() + TINY)


def _shapes() -> Iterator[tuple[str, tuple[int, ...]]]:
    """What the file has to have."""
    for number, (name, outputs, inputs, side, *_) in enumerate(LAYERS):
        yield f"net.{name}.weight", (outputs, inputs, side, side)
        yield f"net.{name}.bias", (outputs,)
        yield f"lin{number}.model.1.weight", (1, outputs, 1, 1)


def _tensor(state: Any, name: str, shape: tuple[int, ...], weights: Path) -> Any:
    found = state.get(name) if isinstance(state, dict) else None
    if found is None or tuple(found.shape) != shape:
        what = "no tensor" if found is None else f"shape {tuple(found.shape)}"
        raise BadInputError(f"{weights}: {name}", what, f"shape {shape}: {EXPECTED}", REMEDY)
    return found.float()
