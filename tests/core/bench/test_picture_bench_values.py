"""`bench filters` and `bench several`: their rows of pictures that are told, and what they draw and ask for."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.avatars.bundle import load_bundle
from trilane.bench import filters, several
from trilane.bench.lib import fixture
from trilane.errors import BadInputError, MissingPartError
from trilane.scene.crop import Rect, crop_projection
from trilane.stages.dsp.runtime import RuntimeOptions
from trilane.stages.gpu.opengl import Driver

Held = Callable[[str, Any], None]
DRIVER = Driver("v", "r", "3.3", False)


class Session:
    """Stands for a runtime and its session: paints the first four channels, doubled."""

    def __init__(self) -> None:
        self.asked: list[Any] = []

    def __call__(self, name: str) -> Session:
        self.asked.append(name)
        return self

    def load(self, network: Any, options: Any) -> Session:
        self.asked.append((network, options))
        return self

    def bind(self, inputs: list[np.ndarray], outputs: list[np.ndarray]) -> Any:
        ((source,), (target,)) = inputs, outputs
        assert source.dtype == target.dtype == np.uint8 and target.shape == (*source.shape[:3], 4)
        return SimpleNamespace(run=lambda: np.copyto(target, 2 * source[..., :4]))


class Packed:
    """Stands for a packed pass of eight channels: all rows but the first are what `fill` says of those drawn."""

    channels = 8

    def __init__(self, fill: Callable[[list[Any]], int]) -> None:
        self._fill = fill
        self.drawn: list[Any] = []

    def begin(self, shape: tuple[int, int]) -> Any:
        self.drawn = []
        return "target", shape

    def draw(self, *asked: Any) -> None:
        self.drawn.append(asked)

    def read_into(self, shape: tuple[int, int], tensor: np.ndarray) -> None:
        assert tensor.shape == (shape[0] * shape[1] * 8,)
        tensor[: shape[1] * 8] = 0
        tensor[shape[1] * 8 :] = self._fill(self.drawn)


def error(picture: np.ndarray, truth: int) -> Any:
    """A PSNR that tells the picture by its second row, beside the truth."""
    return SimpleNamespace(psnr_db=np.float32(picture[1, 0, 0] + truth))


def test_every_filter_is_painted_and_set_against_linear(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bytes of 10, 12 and 7 on the body, which is all but the first row; the zero point is 0."""
    fill = {"linear": 10, "mipmap": 12, "anisotropic": 7}
    monkeypatch.setattr(filters, "describe", lambda _ctx: DRIVER)
    session, passes, rendered = Session(), {}, []

    def make(ctx: Any, channels: int, quantisation: Any, *, deferred: bool, filtering: str) -> Packed:
        assert (ctx, channels, quantisation, deferred) == ("context", 8, "quantisation", False)
        passes[filtering] = Packed(lambda _: fill[filtering])
        return passes[filtering]

    bundle = SimpleNamespace(read_network=lambda: SimpleNamespace(input=SimpleNamespace(zero_point=0)))
    body = SimpleNamespace(render=lambda *asked: rendered.append(asked) or 100)
    studio = SimpleNamespace(ctx="context", clothed_body=body)
    posed = SimpleNamespace(joints="joints", view="view", projection="projection")
    texture = np.zeros((2, 2, 8))
    assets = SimpleNamespace(texture=texture, arrays="arrays", quantisation="quantisation")
    named: list[Any] = []
    monkeypatch.setattr(filters, "load_bundle", lambda name: named.append(name) or bundle)
    monkeypatch.setattr(filters, "load_drawable", lambda name: named.append(name) or assets)
    monkeypatch.setattr(filters, "ground_truth", lambda of: named.append(of) or (studio, error))
    monkeypatch.setattr(filters, "standing", lambda channels: named.append(channels) or posed)
    monkeypatch.setattr(filters, "PackedPass", make)
    monkeypatch.setattr(filters, "SkinnedMesh", lambda *asked: ("mesh", *asked))
    monkeypatch.setattr(filters, "PackedAvatar", lambda packed, *asked: named.append(asked) or packed)
    monkeypatch.setattr(filters, "reshaped", lambda _network, *shape: shape)
    monkeypatch.setattr(filters, "load_runtime", session)
    repeated: list[int] = []

    def interleaved(variants: dict[str, Any], repeats: int) -> dict[str, list[float]]:
        repeated.append(repeats)
        for run in variants.values():
            run()
        return {name: [5.0 * place, 1.0, 6.0 * place] for place, name in enumerate(variants, start=1)}

    monkeypatch.setattr(filters, "interleaved_ms", interleaved)
    result = filters.measure(sizes=(64, 32), repeats=3)
    assert result == {
        "rows": [
            {"side": side, "filter": name, "raster_ms": 5.0 * place, "steps_mean": steps, "psnr_db": psnr}
            for side in (64, 32)
            for place, name, steps, psnr in (
                (1, "linear", 0.0, 120.0),
                (2, "mipmap", 2.0, 124.0),
                (3, "anisotropic", 3.0, 114.0),
            )
        ],
        "sources": {"rows": filters.MEASURED},
        "driver": {"vendor": "v", "renderer": "r", "version": "3.3", "hardware": False},
        "config": {"sizes": [64, 32], "repeats": 3},
    }
    assert named == ["default", "default", bundle, 8, *[(("mesh", "context", "arrays"), texture)] * 3]
    assert rendered == [("joints", "view", "projection", (side, side)) for side in (64, 32)]
    assert session.asked == [each for s in (64, 32) for each in ("ort", ((s, s), RuntimeOptions(threads=1)))]
    assert repeated == [3, 3]
    placement = filters.Placement("joints", "projection", (0, 0, 32, 32))  # type: ignore[arg-type]
    assert [packed.drawn for packed in passes.values()] == [[(("target", (32, 32)), "view", placement)]] * 3


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"sizes": (64, 33, 1)}, "--sizes: found 33, expected a multiple of 32 up to 2048"),
        ({"sizes": (2080,)}, "--sizes: found 2080, expected a multiple of 32 up to 2048"),
        ({"sizes": (0,)}, "--sizes: found 0, expected a multiple of 32 up to 2048"),
        ({"repeats": 0}, "--repeats: found 0, expected at least 1"),
    ],
)
def test_filters_that_cannot_be_measured_are_refused(asked: dict[str, Any], words: str) -> None:
    with pytest.raises(BadInputError, match=f"^{words}$"):
        filters.measure(**asked)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"avatars": 0}, "--avatars: found 0, expected 1 to 8"),
        ({"avatars": 9}, "--avatars: found 9, expected 1 to 8"),
        ({"views": 0}, "--views: found 0, expected 1 to 10000"),
        ({"views": 10_001}, "--views: found 10001, expected 1 to 10000"),
        ({"margins": (4, 129, -1)}, "--margins: found 129, expected 0 to 128"),
        ({"margins": (-1,)}, "--margins: found -1, expected 0 to 128"),
    ],
)
def test_crowds_that_cannot_be_measured_are_refused(asked: dict[str, Any], words: str) -> None:
    with pytest.raises(BadInputError, match=f"^{words}$"):
        several.measure(**asked)
    with pytest.raises(BadInputError, match="--size"):
        several.measure(size="63")
    several._check(8, 10_000, "64", (0, 128))


def test_a_row_for_each_margin(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two views of two avatars each. Losses: 30 - 28, 20 - 19.5, 25 - 21 and 22 - 22."""
    figures = {"v1": [(28.0, 30.0, 1.0, 9.0, 100.0), (19.5, 20.0, 2.0, 5.0, 80.0)]}
    figures["v2"] = [(21.0, 25.0, 4.0, 7.0, 90.0), (22.0, 22.0, 0.0, 8.0, 60.0)]
    asked: list[Any] = []
    fixture = SimpleNamespace(compare=lambda view: figures[view])
    monkeypatch.setattr(several, "_CrowdFixture", lambda: fixture)
    monkeypatch.setattr(several, "_views", lambda *what: asked.append(what) or iter(figures))
    result = several.measure(avatars=2, views=5, size="64", margins=(4, 0))
    row = {
        "loss_db_median": 1.25,
        "loss_db_worst": 4.0,
        "psnr_db_alone": 23.5,
        "bytes_mean": 1.75,
        "bytes_max": 9,
        "cell_height": 85.0,
    }
    assert result == {
        "rows": [{"margin": 4, **row}, {"margin": 0, **row}],
        "sources": {"rows": several.MEASURED},
        "bound_db": 0.5,
        "margin_px": several.MARGIN_PX,
        "config": {"avatars": 2, "views": 5, "size": "64", "output": [480, 640]},
    }
    assert asked == [(fixture, 2, 5, "64", margin) for margin in (4, 0)]


def crowd(monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Session, list[Any]]:
    """A fixture whose tensor has 10 bytes for each avatar that is drawn, and a truth of 50 in all cells."""
    session, named, rendered = Session(), [], []
    packed = Packed(lambda drawn: 10 * len(drawn))

    def make(ctx: Any, channels: int, quantisation: Any, *, deferred: bool) -> Packed:
        named.append((ctx, channels, quantisation, deferred))
        return packed

    bundle = SimpleNamespace(read_network=lambda: "network", shaped_body=lambda: "shaped")
    body = SimpleNamespace(render=lambda *asked: rendered.append(asked) or 50)
    assets = SimpleNamespace(texture=np.zeros((2, 2, 8)), arrays="arrays", quantisation="quantisation")
    monkeypatch.setattr(several, "load_bundle", lambda name: named.append(name) or bundle)
    studio = SimpleNamespace(ctx="context", clothed_body=body)
    monkeypatch.setattr(several, "ground_truth", lambda of: named.append(of) or (studio, error))
    monkeypatch.setattr(several, "load_drawable", lambda name: named.append(name) or assets)
    monkeypatch.setattr(several, "PackedPass", make)
    monkeypatch.setattr(several, "SkinnedMesh", lambda *asked: ("mesh", *asked))
    monkeypatch.setattr(several, "PackedAvatar", lambda own, *asked: named.append(asked) or own)
    monkeypatch.setattr(several, "reshaped", lambda *what: what)
    monkeypatch.setattr(several, "load_runtime", session)
    fixture = several._CrowdFixture()
    mesh = ("mesh", "context", "arrays")
    assert named[:4] == ["default", bundle, "default", ("context", 8, "quantisation", True)]
    assert named[4][0] == mesh and named[4][1] is assets.texture and fixture.shaped == "shaped"
    return fixture, session, rendered


def test_an_avatar_is_compared_with_itself_on_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Together bytes are 20, doubled 40; on its own 20: PSNRs of 90 and 70. Cells of 3 and 2 rows begin in row 1 and 0:
    the first avatar's are all painted, half of the second's. A cell whose truth has no figure is left out."""
    fixture, session, rendered = crowd(monkeypatch)
    rects = Rect(-0.5, -0.5, 0.5, 0.5), Rect(0.0, -0.25, 0.75, 0.75)
    cells = (0, 0, 2, 3), (1, 2, 3, 4)
    layout = SimpleNamespace(shape=(4, 6), crops=tuple(zip(rects, cells, strict=True)))
    projection, view = np.diag([1.0, 2.0, 3.0, 4.0]), np.eye(4)
    seen: Any = SimpleNamespace(joints=("first", "second"), view=view, projection=projection, layout=layout)
    figures = fixture.compare(seen)
    assert figures == [(90.0, 70.0, 10.0, 20.0, 2.0), (90.0, 70.0, 20.0, 20.0, 3.0)]
    crops = [crop_projection(projection, rect) for rect in rects]
    for (joints, at, crop, shape), name, expected, cell in zip(rendered, seen.joints, crops, cells, strict=True):
        assert (joints, shape) == (name, cell[2:]) and at is view and np.array_equal(crop, expected)
    assert session.asked == ["ort", (("network", 4, 6), RuntimeOptions(threads=1))], "one session for a shape"
    target, at, placement = fixture.packed.drawn[0]
    assert len(fixture.packed.drawn) == 1 and target == ("target", (4, 6)) and at is view
    assert (placement.joints, placement.rect) == ("second", cells[1])
    assert np.array_equal(placement.clip_projection, crops[1])
    fixture._image_error = lambda picture, _truth: None if picture.shape[0] == 2 else error(picture, 1)
    assert fixture.compare(seen) == [(41.0, 21.0, 20.0, 20.0, 3.0)]


def test_the_moments_of_a_crowd_are_held(held: Held) -> None:
    fixture: Any = SimpleNamespace(shaped=load_bundle("default").shaped_body())
    seen = [*several._views(fixture, 2, 3, "256", 8)]
    assert len(seen) == 3 and all(len(view.joints) == 2 for view in seen)
    held("joints", [view.joints for view in seen])
    held("cameras", [[view.view, view.projection] for view in seen])
    held("crops", [[(*rect, *cell) for rect, cell in view.layout.crops] for view in seen])
    held("shapes", [view.layout.shape for view in seen])


def test_a_drawable_is_the_bundles_avatar() -> None:
    found, bundle = fixture.load_drawable("default"), load_bundle("default")
    packed = bundle.manifest.network.input
    assert (found.quantisation.scale, found.quantisation.zero_point) == (packed.scale, packed.zero_point)
    assert found.texture.dtype == np.float32 and found.texture.shape == bundle.read_texture().shape
    np.testing.assert_array_equal(found.texture, bundle.read_texture().astype(np.float32))
    assert found.arrays.position.shape[1] == 3
    with pytest.raises(BadInputError):
        fixture.load_drawable("nobody")


def test_ground_truth_is_drawn_as_training_draws_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the body in the shape that the manifest says; needs what the error of a picture needs."""
    pytest.importorskip("skimage")
    from trilane.training import sample_renderer
    from trilane.training.clothing.looks import LOOKS
    from trilane.training.image_error import image_error

    monkeypatch.setattr(sample_renderer, "SampleRenderer", lambda shaped, look: ("studio", shaped, look))
    manifest = SimpleNamespace(provenance={"look": "hiker"})
    bundle: Any = SimpleNamespace(shaped_body=lambda: "shaped", manifest=manifest)
    assert fixture.ground_truth(bundle) == (("studio", "shaped", LOOKS["hiker"]), image_error)


def test_ground_truth_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trilane.training.image_error", None)
    with pytest.raises(MissingPartError, match=r"ground truth needs trilane\.training\.image_error; .*train"):
        fixture.ground_truth(load_bundle("default"))
