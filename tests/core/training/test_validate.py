"""A validation worked out by hand: what is planned, drawn, measured and written, on pictures of one grey each."""

from __future__ import annotations

import hashlib
import math
import shutil
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("skimage")

from trilane import machine
from trilane.arrays import U8
from trilane.avatars.bundle import Bundle, load_bundle
from trilane.avatars.manifest import digests_of
from trilane.body.body import load_body
from trilane.scene.crop import SCREEN, Rect, crop_projection
from trilane.training import random_views, validate
from trilane.training.clothing import LOOKS
from trilane.training.image_error import (
    ImageError,
    image_error,
    scenes,
)
from trilane.training.sample_renderer import SampleRenderer
from trilane.training.validate import Evaluated, FloatNetwork, ValidationPlan, worst_sheet

BANDS = ("far", "full_body", "upper_body", "face")
GREY = 100


class Renderer:
    """Its samples are the numbers that they were asked for; each shows a square of one grey."""

    ctx = SimpleNamespace(info={"GL_RENDERER": "a renderer", "GL_VENDOR": "another word"})

    def __init__(self):
        self.planned = []

    def plan(self, seed, source, band, size):
        self.planned.append((seed, band, size))
        return SimpleNamespace(seed=seed, source=source, band=BANDS.index(band) if band in BANDS else 4)

    def training_sample(self, seed, band, size):
        return SampleRenderer.training_sample(self, seed, band, size)  # as the real one, of a random pose

    def render(self, sample):
        """A square of 8 x 8 pixels; the first sample of seed 2 shows nobody."""
        truth = np.zeros((32, 32, 4), np.uint8)
        if sample.seed != (2, 2, 0, 0):
            truth[8:16, 12:20] = (GREY, GREY, GREY, 255)
        return np.full((32, 32, 3), sample.band, np.float32), truth


def painter(times):
    """Off by 10, 20, 30 and 40 by band, `times` over; the second sample of seed 2's upper bodies by 60.

    Where nobody is, it paints a corner.
    """

    def paint(sample, uv):
        assert (uv == sample.band).all()
        _, picture = Renderer().render(sample)
        off = 60 if sample.seed == (2, 2, 1, 2) else 10 * (sample.band + 1)
        picture[8:16, 12:20, :3] += np.uint8(off * times)
        if sample.seed == (2, 2, 0, 0):
            picture[0, 0] = 255
        return picture

    return paint


def db(off):
    return -20 * math.log10(off / 255)


def likeness(off):
    """SSIM of two constant pictures: the means' part alone, with the constant 0.01 squared."""
    a, b = GREY / 255, (GREY + off) / 255
    return (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)


def figures(times):
    """By band and seed the offsets that `painter` makes, and what they come to."""
    offs = {1: [10, 10, 20, 20, 30, 30, 40, 40], 2: [10, 20, 20, 30, 60, 40, 40]}
    offs = {seed: [off * times for off in row] for seed, row in offs.items()}
    every = offs[1] + offs[2]
    by_band = {"far": [10] * 3, "full_body": [20] * 4, "upper_body": [30] * 3 + [60], "face": [40] * 4}
    means = {band: round(np.mean([db(off * times) for off in row]), 2) for band, row in by_band.items()}
    mean = round(np.mean([db(off) for off in every]), 2)
    least = round(db(60 * times), 2)
    seeds = {
        str(seed): {
            "psnr_db": round(np.mean([db(off) for off in row]), 2),
            "body_psnr_db": round(np.mean([db(off) for off in row]), 2),
            "least_psnr_db": round(db(max(row)), 2),
        }
        for seed, row in offs.items()
    }
    return {
        "psnr_db_by_band": means,
        "body_psnr_db_by_band": means,
        "psnr_db_by_background": dict.fromkeys(("black", "white", "noise", "scenery"), mean),
        "see_through_by_band": dict.fromkeys(means, 0.0),
        **dict.fromkeys(("see_through", "alpha_inside", "alpha_edge", "alpha_outside"), 0.0),
        "iou_by_band": dict.fromkeys(means, 1.0),
        "psnr_db": mean,
        "body_psnr_db": mean,
        "background": 0.0,
        "iou": 1.0,
        "ssim": round(np.mean([likeness(off) for off in every]), 4),
        "least_psnr_db": least,
        "least_body_psnr_db": least,
        "worst": {"seed": 2, "number": 5, "band": "upper_body", "psnr_db": least, "body_psnr_db": least},
        "by_seed": seeds,
        "samples": 15,
    }


@pytest.fixture
def parts(monkeypatch):
    """Painters by runtime's name, and the outside world of a validation; what the painters were asked for."""
    asked = []

    def integer_painter(renderer, bundle, name, threads):
        asked.append((renderer, bundle, name, threads))
        return painter({"ort": 1, "openvino": 2}[name])

    monkeypatch.setattr(validate, "integer_painter", integer_painter)
    monkeypatch.setattr(validate, "load_motion", lambda spec, folder: (spec.motion, folder))
    monkeypatch.setattr(validate, "load_runtime", lambda name: SimpleNamespace(version=lambda: f"{name} 3.2"))
    monkeypatch.setattr(validate, "package_version", {"trilane": "9.8"}.__getitem__)
    monkeypatch.setattr(machine.here, "now", lambda: datetime(2026, 1, 2, 23, 30, tzinfo=UTC))
    return asked


@pytest.mark.parametrize("with_float", [False, True])
def test_a_validation_by_hand(parts, tiny_bundle, tmp_path, with_float):
    (tmp_path / "jump.bvh").write_bytes(b"a motion")
    held_out = ("builtin:walk-wave-turn", str(tmp_path / "jump.bvh"))
    plan = ValidationPlan(held_out, (1, 2), 2, ("ort", "openvino"), "128", 3, "a1b2", True)
    bundle, renderer, looked = load_bundle(tiny_bundle), Renderer(), []
    network = FloatNetwork("floats of somewhere", painter(0.5)) if with_float else None
    said = validate.validate(bundle, plan, renderer, network, lambda seed, sample: looked.append((seed, sample.number)))
    assert parts == [(renderer, bundle, name, 3) for name in ("ort", "openvino")]
    assert renderer.planned == [
        ((seed, 2, number, index), band, "128")
        for seed in (1, 2) for index, band in enumerate(BANDS) for number in (0, 1)
    ]  # fmt: skip
    assert looked == [(1, number) for number in range(8)] + [(2, number) for number in range(1, 8)]
    integer, other = figures(1), figures(2)
    wanted = {
        "date": date(2026, 1, 2),
        "digests": digests_of(tiny_bundle, bundle.manifest).model_dump(),
        "made_with": {
            "trilane": "9.8", "revision": "a1b2", "modified": True, "renderer": "a renderer",
            "runtimes": {"ort": "ort 3.2", "openvino": "openvino 3.2"},
        },
        "size": "128",
        "per_band": 2,
        "held_out": {
            "builtin:walk-wave-turn": "built in",
            "jump.bvh": f"sha256 {hashlib.sha256(b'a motion').hexdigest()}",
        },
        "psnr_db_by_band": integer["psnr_db_by_band"],
        "psnr_db_by_background": integer["psnr_db_by_background"],
        "iou": 1.0,
        "ssim": integer["ssim"],
        "runtime": "ort",
        "integer": integer,
        "other_runtimes": {"openvino": other},
    }  # fmt: skip
    if with_float:
        floats = figures(0.5)
        loss = {band: round(floats["psnr_db_by_band"][band] - integer["psnr_db_by_band"][band], 2) for band in BANDS}
        wanted |= {"float": {"network": "floats of somewhere", **floats}, "psnr_loss_db": loss}
    found = said.model_dump(exclude_none=True)
    assert len(found.pop("figures_digest")) == 64
    assert found.pop("texture_filter") == "linear"
    assert {key: value for key, value in found.items() if value} == wanted


def test_a_validation_is_written_into_its_manifest(parts, tiny_bundle, tmp_path):
    own = shutil.copytree(tiny_bundle, tmp_path / "own")
    bundle = load_bundle(own)
    said = validate.validate(bundle, ValidationPlan(seeds=(1, 2), per_band=2), Renderer())
    written = validate.revalidate(bundle, said)
    assert written == Bundle(bundle.folder, bundle.manifest.model_copy(update={"validation": said}))
    assert load_bundle(own) == written
    assert len(parts) == 1


def test_samples_are_of_the_avatars_own_shape(monkeypatch, tiny_bundle):
    bundle = load_bundle(tiny_bundle)
    bundle = Bundle(bundle.folder, bundle.manifest.model_copy(update={"betas": (1.0,), "expression": (2.0,)}))
    monkeypatch.setattr(validate, "SampleRenderer", lambda shaped, *words, look: (shaped.vertices, *words, look))
    shaped = load_body(tiny_bundle / "body.npz").shape((1.0,), (2.0,)).vertices
    vertices, *others = validate.open_renderer(bundle, 4)
    assert (vertices == shaped).all() and others == [4, LOOKS["default"]]
    manifest = bundle.manifest.model_copy(update={"provenance": {"look": "hiker"}})
    assert validate.open_renderer(Bundle(bundle.folder, manifest), 4)[1:] == (4, LOOKS["hiker"])


# --- what samples are made of -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("side", "window"), [(12, 7), (8, 7), (6, 5), (3, 3)])
def test_ssim_by_loops(side, window):
    """Wang et al. (2004) with a flat window, as large as fits up to 7, and variances of samples."""
    rng = np.random.default_rng(side)
    truth, picture = (rng.integers(0, 256, (side, side, 4), dtype=np.uint8) for _ in range(2))
    truth[..., 3] = picture[..., 3] = 255
    a, b = truth / 255, picture / 255
    values = []
    for row in range(side - window + 1):
        for column in range(side - window + 1):
            for channel in range(3):
                x, y = (each[row : row + window, column : column + window, channel].ravel() for each in (a, b))
                (xx, xy), (_, yy) = np.cov(x, y)
                means, c1, c2 = x.mean() * y.mean(), 0.01**2, 0.03**2
                top = (2 * means + c1) * (2 * xy + c2)
                values.append(top / ((x.mean() ** 2 + y.mean() ** 2 + c1) * (xx + yy + c2)))
    found = image_error(picture, truth)
    assert found.ssim == pytest.approx(np.mean(values), rel=1e-9)
    assert found.psnr_db == found.body_psnr_db == pytest.approx(-10 * np.log10(((a - b)[..., :3] ** 2).mean()))
    assert (found.background, found.iou) == (0.0, 1.0)


# The figures of smaller tensors: which views, sizes and means, with painter and renderer that are told.


@dataclass(frozen=True)
class Sample:
    name: str
    view: random_views.View
    crop: random_views.Crop
    band: int


def square(side: int, grey: int) -> U8:
    """A grey square without anything transparent."""
    picture = np.full((side, side, 4), grey, np.uint8)
    picture[..., 3] = 255
    return picture


def test_every_view_is_painted_at_every_size_and_seen_at_every_density(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two far views of which one shows nobody, and one of a face, which no row has.

    Greys are off by 64 in tensors of less than 128² pixels, else by 32: 20 log10(255 / 64) = 12.01 dB, and so on.
    """
    asked: list[Any] = []
    camera = random_views.View(np.eye(4), random_views.perspective(1.0, 4 / 3), 4 / 3)
    whole = random_views.Crop((256, 256), camera.projection, 480 * 640)
    monkeypatch.setattr(validate, "PICTURE_SIDES", {64: "far", 96: "far"})

    def painter(renderer: Any, bundle: Any, runtime: str, threads: int) -> Any:
        asked.append((renderer, bundle, runtime, threads))
        return lambda sample, _: square(64, 64 if math.prod(sample.crop.shape) < 128 * 128 else 32)

    def planned(renderer: Any, per_band: int, seed: int, motions: Any) -> list[Any]:
        asked.append((renderer, per_band, seed, motions))
        return [Sample(name, camera, whole, band) for name, band in (("first", 0), ("nobody", 0), ("face", 3))]

    def rendered(sample: Any) -> tuple[None, U8]:
        seen.append((sample.name, sample.crop.shape))
        truth = np.zeros((*sample.crop.shape, 4), np.uint8)
        truth[...] = square(1, 0) if sample.name == "first" else 0
        return None, truth

    monkeypatch.setattr(validate, "integer_painter", painter)
    monkeypatch.setattr(validate, "plan_validation", planned)
    monkeypatch.setattr(validate, "held_out_motions", lambda names: ("motions", names))
    seen: list[Any] = []
    renderer: Any = SimpleNamespace(
        render=rendered, crop=lambda _, buckets: replace(whole, shape=max(buckets, key=math.prod))
    )
    bundle: Any = SimpleNamespace()
    plan = ValidationPlan(
        held_out=("/far/a.bvh", "builtin:b"), seeds=(5, 6), per_band=3, runtimes=("x", "y"), threads=2
    )
    before, looks = machine.here.now().date(), list[int]()
    found = validate.measure_sizes(bundle, plan, renderer, lambda: looks.append(1))
    assert before <= found.date <= machine.here.now().date()
    assert asked == [(renderer, bundle, "x", 2), (renderer, 3, 5, ("motions", plan.held_out))]
    assert (found.runtime, found.seed, found.per_band, found.held_out) == ("x", 5, 3, ("a.bvh", "builtin:b"))
    assert seen == [(name, (side, side)) for name in ("first", "nobody") for side in (64, 96)]
    assert len(looks) == 3
    row = {side: round(20 * np.log10(255 / (64 if side < 128 else 32)), 2) for side in validate.TENSOR_SIDES}
    assert found.psnr_db_by_picture == {64: row, 96: row} and found.psnr_db is None


def crop_of(shape: tuple[int, int], rect: Rect = SCREEN) -> random_views.Crop:
    return random_views.Crop(shape, crop_projection(random_views.perspective(1.0, 1.0), rect), 1.0)


def test_a_crop_has_the_density_at_which_the_body_covers_the_side() -> None:
    """The right half of the screen, 480 x 320 pixels, of which the body has a quarter: 0.64 of it are 96 x 128."""
    view = random_views.View(np.eye(4), random_views.perspective(1.0, 4 / 3), 4 / 3)
    half = crop_projection(view.projection, Rect(0.0, -1.0, 1.0, 1.0))
    crop = random_views.Crop((96, 64), half, 480 * 320 / 4)
    assert validate.on_picture(crop, view, 100).shape == (round(200 * 1.5**0.5), round(200 / 1.5**0.5)) == (245, 163)


def test_a_tensor_is_shown_in_linear_light_with_its_colours_times_alpha() -> None:
    """Two pixels, white and a black that is transparent, to four: white stays white, and alpha falls by quarters."""
    picture = np.array([[[255, 255, 255, 255], [0, 0, 0, 0]]] * 2, np.uint8)
    larger = validate.shown(picture, crop_of((2, 2)), crop_of((2, 4)))
    assert larger[0, :, 3].tolist() == [255, 191, 64, 0]
    assert (larger[0, :3, :3] == 255).all()
    grey = np.array([[[0, 0, 0, 255], [255, 255, 255, 255]]] * 2, np.uint8)
    assert validate.shown(grey, crop_of((2, 2)), crop_of((2, 4)))[0, 1].tolist() == [137, 137, 137, 255]


def test_a_denser_tensor_is_averaged_over_the_pixel() -> None:
    """Four white columns of eight to two pixels: two of three columns are white under the left one."""
    picture = np.full((8, 8, 4), 255, np.uint8)
    picture[:, 3:, :] = 0
    less = validate.shown(picture, crop_of((8, 8)), crop_of((2, 2)))
    assert less[..., 3].tolist() == [[191, 0]] * 2
    assert (less[:, 0, :3] == 255).all()


def test_a_part_of_the_tensor_is_read_where_it_lies() -> None:
    """Of eight columns and rows the right three quarters, and the upper half: columns 2 to 7 and rows 0 to 3."""
    picture = np.full((8, 8, 4), 255, np.uint8)
    picture[..., 0] = 20 * np.arange(8)
    picture[..., 1] = 20 * np.arange(8)[:, None]
    part = validate.shown(picture, crop_of((8, 8)), crop_of((4, 6), Rect(-0.5, 0.0, 1.0, 1.0)))
    assert (part == picture[:4, 2:]).all()


# Sheets of pictures side by side: which samples, in which order, how large, before what.

#: Height and width of a cell.
CELL = (256, 192)
PAINTERS = ("float", "ort")
ALPHA = ("alpha_inside", "alpha_edge", "alpha_outside", "see_through")


def evaluated(band: str, number: int, psnr_db: float, shape: tuple[int, int] = (64, 32)) -> Evaluated:
    """Its pictures have one grey each: ten times its number, one more for `float` and two more for `ort`."""

    def flat(grey: int) -> np.ndarray:
        return np.full((*shape, 4), (grey, grey, grey, 255), np.uint8)

    def error(value: float) -> ImageError:
        return ImageError(value, 0.0, {}, 0.0, ssim=1.0, iou=1.0, **dict.fromkeys(ALPHA, 0.0))

    pictures = {name: flat(10 * number + k) for k, name in enumerate(PAINTERS, start=1)}
    return Evaluated(number, band, flat(10 * number), pictures, {"float": error(-psnr_db), "ort": error(psnr_db)})


def cells(sheet: np.ndarray) -> list[list[int]]:
    """The grey in the middle of each cell."""
    rows, columns = sheet.shape[0] // CELL[0], sheet.shape[1] // CELL[1]
    return [[int(sheet[256 * r + 128, 192 * c + 96, 0]) for c in range(columns)] for r in range(rows)]


def test_a_large_picture_is_shrunk_into_its_cell() -> None:
    """512 x 96 to 256 x 48, and 64 x 768 to 16 x 192."""
    for shape, rows, columns in (
        ((512, 96), slice(0, 256), slice(72, 120)),
        ((64, 768), slice(120, 136), slice(0, 192)),
    ):
        cell = worst_sheet([evaluated("far", 2, 1.0, shape)], ())
        assert (cell[rows, columns] == 20).all()
        assert (cell != 128).any(axis=2).sum() == (256 * 48 if shape[0] == 512 else 16 * 192)


def test_what_is_transparent_shows_the_scenery() -> None:
    """The middle of a cell is pixel (32, 16) of a picture; black of alpha 127 lets 128 of 255 parts through."""
    sample = evaluated("far", 0, 1.0)
    sample.truth[..., 3] = 0
    sample.pictures["ort"][...] = (0, 0, 0, 127)
    behind = scenes()[0][32, 16, 0]
    assert cells(worst_sheet([sample], ("ort",))) == [[round(255 * behind), round(128 * behind)]]
