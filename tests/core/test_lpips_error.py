"""LPIPS with weights from a file, against the published formula, written a second time in NumPy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane.apps.experiments.picture_errors import LEAST_LPIPS_PX, LPIPS_LAYERS, Lpips, _shapes
from trilane.arrays import F64
from trilane.errors import BadInputError

torch = pytest.importorskip("torch")


@pytest.fixture(scope="module")
def state() -> dict[str, Any]:
    """Untrained: the formula is the same."""
    generator = torch.Generator().manual_seed(0)
    return {name: torch.randn(shape, generator=generator) / np.prod(shape[1:]) ** 0.5 for name, shape in _shapes()}


@pytest.fixture(scope="module")
def weights(state: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("lpips") / "alex.pth"
    torch.save({**state, "scaling_layer.shift": torch.zeros(3)}, file)  # the library's file has more than is read
    return file


def _convolved(x: F64, kernel: F64, bias: F64, stride: int, padding: int) -> F64:
    """(C,h,w) to (D,h',w'): sums over windows."""
    x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    windows = np.lib.stride_tricks.sliding_window_view(x, kernel.shape[2:], axis=(1, 2))[:, ::stride, ::stride]
    return np.einsum("chwab,dcab->dhw", windows, kernel, optimize=True) + bias[:, None, None]


def _second(state: dict[str, Any], picture: F64, reference: F64) -> float:
    """Unit feature vectors of five layers; squared differences, weighted by channel, mean over the places."""
    total, both = (
        0.0,
        [((2 * one - 1 - [-0.03, -0.088, -0.188]) / [0.458, 0.448, 0.45]) for one in (picture, reference)],
    )
    both = [one.transpose(2, 0, 1) for one in both]
    for number, (name, *_, stride, padding, pooled) in enumerate(LPIPS_LAYERS):
        kernel, bias = (state[f"net.{name}.{part}"].numpy().astype(float) for part in ("weight", "bias"))
        unit = []
        for index, x in enumerate(both):
            if pooled:
                x = np.lib.stride_tricks.sliding_window_view(x, (3, 3), axis=(1, 2))[:, ::2, ::2].max(axis=(3, 4))
            both[index] = np.maximum(_convolved(x, kernel, bias, stride, padding), 0)
            unit.append(both[index] / np.linalg.norm(both[index], axis=0))
        share = state[f"lin{number}.model.1.weight"].numpy()[0]
        total += float((share * (unit[0] - unit[1]) ** 2).sum(axis=0).mean())
    return total


def test_it_is_the_published_formula(state: dict[str, Any], weights: Path) -> None:
    rng = np.random.default_rng(0)
    picture, reference = (rng.uniform(0, 1, (LEAST_LPIPS_PX, 80, 3)) for _ in range(2))
    found, wanted = Lpips(weights), _second(state, picture, reference)
    assert abs(wanted) > 1e-3
    assert found(picture, reference) == pytest.approx(wanted, rel=1e-4)
    assert found(picture, picture) == 0
    assert found(picture[1:], reference[1:]) is None


def test_what_is_no_file_of_weights_is_refused(state: dict[str, Any], tmp_path: Path) -> None:
    text, part, odd = (tmp_path / name for name in ("text.pth", "part.pth", "odd.pth"))
    text.write_text("no weights", encoding="utf-8")
    torch.save({name: state[name] for name in list(state)[:3]}, part)
    torch.save({**state, "lin4.model.1.weight": torch.zeros(1, 7, 1, 1)}, odd)
    no_tensors = "text.pth: found a file that is not of tensors alone"
    for file, said in ((text, no_tensors), (part, "slice2.3.weight: found no tensor"), (odd, "(1, 7, 1, 1)")):
        with pytest.raises(BadInputError, match=r"weights of lpips") as caught:
            Lpips(file)
        assert said in str(caught.value)
    with pytest.raises(BadInputError, match="absent"):
        Lpips(tmp_path / "absent.pth")
