"""`bench augmentation`: its rows and gains on figures that are told, what both trainings share, and what it refuses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("skimage")

from trilane import machine
from trilane.avatars.bundle import load_bundle
from trilane.bench import augmentation
from trilane.errors import BadInputError, MissingPartError
from trilane.training import sample_renderer
from trilane.training.clothing.looks import HIKER

FIGURES = {
    "camera space": {"psnr_db_far": 25.0, "psnr_db_face": 24.5, "iou": 0.96},
    "image space": {"psnr_db_far": 25.5, "psnr_db_face": 22.0, "iou": 0.95},
}


@dataclass(frozen=True)
class Captured:
    """Stands for a capture."""

    shaped: Any


def test_rows_and_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both are trained by the same steps on as many samples of the same seed, and measured by the same renderer.

    The body wears what the package's avatar of that look wears, also where it is trained on.
    """
    asked: list[Any] = []

    def trained(work: Any, source: Any, folder: Path) -> Any:
        worn = work.capture.shaped.body.offsets is not None
        asked.append((type(work.capture) is Captured and worn, work.steps, work.count, work.seed, source, folder.name))
        return source, 0.5

    def errors(studio: Any, paint: str, views: int, seed: int) -> Any:
        asked.append((studio, views, seed))
        return FIGURES[paint]

    def capture(folder: Path, shaped: Any, *said: Any) -> Any:
        asked.append((folder.name, *said))
        worn = load_bundle("hiker").read_body()
        assert worn.offsets is not None and np.array_equal(shaped.body.offsets, worn.offsets)
        np.testing.assert_allclose(shaped.vertices, worn.shape(HIKER.betas).vertices, atol=2e-7)
        return Captured(shaped)

    monkeypatch.setattr(sample_renderer, "SampleRenderer", lambda _, threads, look: ("studio", threads, look))
    monkeypatch.setattr(augmentation, "_capture", capture)
    monkeypatch.setattr(augmentation, "_sources", lambda capture: {name: name for name in FIGURES if capture})
    monkeypatch.setattr(augmentation, "_trained", trained)
    monkeypatch.setattr(augmentation, "_errors", errors)
    found = augmentation.measure(steps=11, frames=5, samples=9, views=3, seed=7)
    studio = (("studio", 1, HIKER), 3, 7)
    assert asked == [
        ("capture", 5, "hiker", 7),
        *((True, 11, 9, 7, "camera space", "camera-space"), studio),
        *((True, 11, 9, 7, "image space", "image-space"), studio),
    ]
    assert found["rows"] == [{"augmentation": name, **figures, "loss": 0.5} for name, figures in FIGURES.items()]
    assert found["gain_db"] == {"far": -0.5, "face": 2.5}
    assert found["config"] == {"steps": 11, "frames": 5, "samples": 9, "views": 3, "look": "hiker", "seed": 7}


@pytest.mark.parametrize("asked", [{"steps": 9}, {"frames": 3}, {"samples": 7}, {"look": "nobody"}])
def test_settings_out_of_range_are_refused(asked: Any) -> None:
    with pytest.raises(BadInputError):
        augmentation.measure(**asked)


def test_without_pytorch_it_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine.here, "has_package", lambda part: part != "torch")
    with pytest.raises(MissingPartError, match=r"training needs torch; .*train"):
        augmentation.measure()
