"""Training samples by value: which views are taken, and where each sample lies on disk."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest

from trilane.scene.crop import Rect
from trilane.training import dataset, sample_renderer
from trilane.training.clothing import HIKER
from trilane.training.dataset import DENSITY, TRAINING_SHARE, open_groups, random_kind
from trilane.training.random_views import OUTPUT_ROWS, Crop, Cropper, View
from trilane.training.sample_renderer import Sample, SampleRenderer

SHAPES = ((32, 64), (64, 32))


def sample(number: int) -> Any:
    return SimpleNamespace(
        number=number, picture=0, band=number % 5, crop=SimpleNamespace(shape=SHAPES[number % 3 == 0])
    )


class Renderer:
    """A sample's pictures: its number as colour, and u and v beyond 0..1 at two corners."""

    def __init__(self, shaped: Any, threads: int, look: Any) -> None:
        assert (shaped, threads, look) == (HIKER.betas, 1, HIKER)

    def render(self, asked: Any) -> tuple[Any, Any]:
        uv = np.zeros((*asked.crop.shape, 3), np.float32)
        uv[..., :2] = asked.number / 256
        uv[0, 0, :2], uv[-1, -1, :2] = -0.5, 1.5
        uv[1:3, 2:5, 2] = 0.5
        return uv, np.full((*asked.crop.shape, 4), asked.number, np.uint8)


def test_samples_are_written_by_shape_in_their_order(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    """120 samples in parts of 50, by two renderers; every third one has the other shape."""
    made = []

    def pool(processes: int, context: Any, start: Any, words: Any) -> ThreadPoolExecutor:
        made.append((processes, context.get_start_method()))
        start(*words)
        return ThreadPoolExecutor(1)

    monkeypatch.setattr(dataset, "ProcessPoolExecutor", pool)
    monkeypatch.setattr(dataset, "SampleRenderer", Renderer)
    monkeypatch.setattr(dataset, "_source", [])
    bodies = {tmp_path / "body.npz": SimpleNamespace(shape=lambda betas: betas)}
    monkeypatch.setattr(dataset, "load_body", bodies.__getitem__)
    source = partial(dataset.clothed_source, tmp_path / "body.npz", "hiker", None)
    parts = []
    samples = [sample(number) for number in range(120)]
    dataset.write_dataset(source, samples, tmp_path / "set", 2, lambda rows: parts.append(len(rows)) or rows)
    assert made == [(2, "spawn")] and parts == [3]
    groups = {group.shape: group for group in open_groups(tmp_path / "set")}
    assert list(groups) == list(SHAPES)
    for shape, numbers in ((SHAPES[0], [n for n in range(120) if n % 3]), (SHAPES[1], list(range(0, 120, 3)))):
        group = groups[shape]
        assert group.band.tolist() == [number % 5 for number in numbers]
        assert group.rgba[:, 3, 3, 1].tolist() == numbers and (group.rgba == group.rgba[:, :1, :1, :1]).all()
        assert group.uv[:, 5, 5, 0].tolist() == [round(65535 * n / 256) for n in numbers]
        assert not group.uv[:, 0, 0].any() and (group.uv[:, -1, -1] == 65535).all()
        assert group.covered.sum() == 6 * len(numbers) and (group.covered[:, 1:3, 2:5] == 1).all()


def test_samples_of_a_frame_follow_each_other(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    """So that a video is decoded once: samples of one shape, planned of frames 3, 1, 3, 2, 1."""
    rendered: list[int] = []

    class Source:
        def render(self, asked: Any) -> tuple[Any, Any]:
            rendered.append(asked.picture)
            return Renderer(HIKER.betas, 1, HIKER).render(asked)

    def pool(*words: Any) -> ThreadPoolExecutor:
        words[2](*words[3])
        return ThreadPoolExecutor(1)

    monkeypatch.setattr(dataset, "ProcessPoolExecutor", pool)
    monkeypatch.setattr(dataset, "_source", [])
    samples = [SimpleNamespace(**{**vars(sample(3 * n)), "picture": frame}) for n, frame in enumerate((3, 1, 3, 2, 1))]
    dataset.write_dataset(Source, samples, tmp_path, 1)
    assert rendered == [1, 1, 2, 3, 3]
    (group,) = open_groups(tmp_path)
    assert group.rgba[:, 3, 3, 1].tolist() == [3, 12, 9, 0, 6] and group.band.tolist() == [3, 2, 4, 0, 1]


@pytest.mark.parametrize(
    ("rows", "density", "side"),
    [
        (64, 1.0, 64),
        (64, 2.0, 128),
        (64, 2.25, 128),
        (100, 0.5, 64),
        (100, 1.75, 192),
        (480, 0.5, 256),
        (480, 2.0, 256),
    ],
)
def test_a_tensor_has_the_size_that_its_density_asks_for(rows: int, density: float, side: int) -> None:
    """A square body that is `rows` pixels high on the picture: the tensor's side is the nearest, as a factor."""
    cropper, side_ndc = object.__new__(Cropper), 2 * rows / OUTPUT_ROWS
    rect = Rect(-side_ndc / 2, -side_ndc / 2, side_ndc / 2, side_ndc / 2)
    cropper._bounds = SimpleNamespace(rect=lambda *_: rect)  # type: ignore[assignment]
    crop = cropper.crop_of(None, View(np.eye(4), np.eye(4), 1.0), density)  # type: ignore[arg-type]
    assert crop is not None and crop.shape == (side, side) and crop.pixels == pytest.approx(rows**2)


def test_every_size_of_tensor_is_trained_and_small_ones_show_far_bodies() -> None:
    """Random kinds have the shares of the table, and densities whose logarithm is uniform between the two ends."""
    rng = np.random.default_rng(4)
    kinds = [random_kind(rng) for _ in range(4000)]
    shares = Counter(band for band, _ in kinds)
    assert {band: round(count / 4000, 1) for band, count in shares.items()} == pytest.approx(TRAINING_SHARE, abs=0.05)
    low, high = np.log(DENSITY)
    assert kstest(np.log([density for _, density in kinds]), "uniform", (low, high - low)).pvalue > 1e-3


@pytest.mark.parametrize(("band", "index"), [("far", 0), ("face", 3), ("anywhere", 4)])
def test_a_view_is_taken_when_it_is_clear_and_shows_enough(
    monkeypatch: pytest.MonkeyPatch, band: str, index: int
) -> None:
    """The first is cut, the second does not show the body, the third shows 199 pixels of it, the fourth 200."""
    asked = []

    def random_view(rng: np.random.Generator, *words: Any) -> int:
        asked.append((words, rng.random()))
        return len(asked)

    def crop_of(posed: Any, view: int, size: Any) -> Crop | None:
        assert (posed, size) == (body, "192")
        return None if view == 2 else Crop((32, 32), np.eye(4), {3: 199.0, 4: 200.0}[view])

    body = SimpleNamespace(joints="joints")
    monkeypatch.setattr(sample_renderer, "random_view", random_view)
    renderer = object.__new__(SampleRenderer)
    pose = np.ones((55, 3))
    vars(renderer).update(
        skeleton=SimpleNamespace(pose=lambda found: body if found is pose else None),
        cropper=SimpleNamespace(crop_of=crop_of),
        surface=SimpleNamespace(
            posed=lambda posed: "points" if posed is body else None,
            is_clear_of=lambda view, points: points == "points" and view != 1,
        ),
    )
    found = renderer.plan((3, 4), lambda rng: pose if rng.random() else None, band, "192")
    rng = np.random.default_rng((3, 4))
    rng.random()
    assert asked == [((band, "joints"), rng.random()) for _ in range(4)]
    assert isinstance(found, Sample)
    assert (found.pose is pose, found.view, found.crop.pixels, found.band) == (True, 4, 200.0, index)
