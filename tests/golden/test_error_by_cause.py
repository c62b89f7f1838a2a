"""A run's picture split by cause, on a small scene: each cause against a hand case, and the sequence's end the run's.

The network is exchanged for one that paints the tensor's first channel, where what comes out can be said beforehand.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion

from trilane.apps.experiments.error_by_cause import error_by_cause
from trilane.apps.experiments.reference_path import BODY, NOTHING, Cause, ReferenceMoment, ReferencePath, needs, up_to
from trilane.arrays import F32, F64
from trilane.bench.lib.cast import Cast
from trilane.bench.lib.full_picture import FullPictures
from trilane.stages.config import posed_vertices
from trilane.stages.configure import Checked

FRAME = 5
#: Of the texture everywhere; float16 and bytes cannot hold it.
GREY = 0.3


def alone(cause: Cause) -> frozenset[Cause]:
    return needs(cause) | {cause}


@pytest.fixture(scope="module")
def path(checked: Checked) -> ReferencePath:
    """One for all tests of the file: it takes seconds to make."""
    return ReferencePath(checked)


@pytest.fixture(autouse=True)
def own_context(current: None, path: ReferencePath) -> None:  # noqa: ARG001
    """Make the path's context the current one."""
    path.gl.__enter__()


@pytest.fixture(scope="module")
def moment(path: ReferencePath) -> ReferenceMoment:
    return path.moment(FRAME)


@pytest.fixture(scope="module")
def grey(path: ReferencePath) -> ReferenceMoment:
    """The frame of a body whose texture is GREY, painted opaque in the tensor's own colours."""

    def paint(tensor: F64) -> F32:
        inside = (tensor[..., :1] != 0).astype(np.float32)
        return np.concatenate([tensor[..., :1].repeat(3, axis=2), inside], axis=-1).astype(np.float32)

    plain = copy(path)
    plain.avatars = {
        folder: replace(avatar, paint=paint, texture=np.full_like(avatar.texture, GREY))
        for folder, avatar in path.avatars.items()
    }
    return plain.moment(FRAME)


def test_without_a_cause_it_is_the_plan_full(checked: Checked, moment: ReferenceMoment) -> None:
    """Which is rounded to bytes: half a step."""
    cast = Cast(checked)
    full = FullPictures(cast).frame(FRAME, moment.background)
    frame = moment.frame(NOTHING)
    assert np.abs(frame.picture * 255 - full).max() <= 0.5 + 1e-9
    assert list(frame.boxes) == cast.boxes(FRAME)


def test_with_all_causes_it_is_the_run_to_the_bit(checked: Checked, path: ReferencePath) -> None:
    """In the end the pictures' bytes, and after the body's causes the vertices that the CPU unit skinned."""
    moment = path.moment(FRAME)
    assert np.array_equal(moment.frame(frozenset(Cause)).picture, moment.own)
    packet = path.frames._chain.packets[0]
    (vertices,) = posed_vertices(packet.payload, checked.config.posed_vertices)
    assert np.array_equal(moment.vertices(0, BODY), vertices)
    of_float32 = np.abs(moment.vertices(0, frozenset({Cause.FLOAT32})) - moment.vertices(0, NOTHING))
    assert 0 < of_float32.max() < 5e-6  # at a few metres
    of_weights = np.abs(moment.vertices(0, frozenset({Cause.WEIGHTS})) - moment.vertices(0, NOTHING)).max(axis=1)
    assert 1e-3 < of_weights.max() < 0.05  # so far away hands and face are at rest
    assert (of_weights == 0).mean() > 0.3  # and the rest of the body has the weights that it has


def test_float64_makes_the_run_s_tensor_but_for_single_steps(moment: ReferenceMoment) -> None:
    """The driver rounds, and snaps vertices to parts of a pixel: of the values on the mesh few are a step off."""
    avatar = next(iter(moment._path.avatars.values()))
    own, driver = (
        moment._tensor(0, avatar, up_to(cause)) / avatar.encoding.scale for cause in (Cause.PACKING, Cause.RASTER)
    )
    both = (own != 0).any(axis=-1) & (driver != 0).any(axis=-1)
    assert both.sum() > 100
    assert ((own != 0).any(axis=-1) != (driver != 0).any(axis=-1)).sum() <= 0.02 * both.sum()
    assert (np.abs(own - driver)[both] <= 1.001).mean() > 0.98


def test_a_body_without_blend_shapes_loses_nothing_by_leaving_them_out(moment: ReferenceMoment) -> None:
    assert np.array_equal(moment.frame(alone(Cause.BLEND)).picture, moment.frame(NOTHING).picture)


def painted_grey(grey: ReferenceMoment, causes: frozenset[Cause]) -> float:
    """The picture's grey in the middle of the chest, where the body covers all."""
    frame = grey.frame(causes)
    (box,) = grey.boxes
    row, column = box.top + (box.bottom - box.top) * 3 // 8, (box.left + box.right) // 2
    around = frame.picture[row - 1 : row + 2, column - 2 : column]
    assert np.ptp(around) < 1e-6
    return float(around.mean())


def test_the_texture_s_grey_in_float16_and_in_bytes(grey: ReferenceMoment) -> None:
    """The error is that of the number itself: 0.3 in float16 is 0.300048828125; in bytes at most half a step off."""
    encoding = next(iter(grey._path.avatars.values())).encoding
    assert painted_grey(grey, NOTHING) == pytest.approx(GREY, abs=1e-6)
    assert painted_grey(grey, alone(Cause.FLOAT16)) == pytest.approx(0.300048828125, abs=1e-7)
    packed = painted_grey(grey, alone(Cause.PACKING))
    assert packed == pytest.approx(round(GREY / encoding.scale) * encoding.scale, abs=1e-6)
    assert abs(packed - GREY) <= encoding.scale / 2 + 1e-6


def test_the_composite_alone_is_off_by_two_roundings(grey: ReferenceMoment) -> None:
    """The network's picture in bytes, then the screen's: a step at most, in the middle of the body."""
    exact, rounded = (painted_grey(grey, one) for one in (alone(Cause.CROP), alone(Cause.COMPOSITE)))
    assert abs(rounded - exact) * 255 <= 1.0 + 1e-6
    assert rounded * 255 == pytest.approx(round(rounded * 255), abs=1e-9)


def test_one_read_a_pixel_changes_the_outline_alone(grey: ReferenceMoment) -> None:
    before, after = grey.frame(NOTHING), grey.frame(alone(Cause.READS))
    changed = np.abs(before.picture - after.picture).max(axis=2) > 1e-6
    opaque = (np.abs(before.picture - GREY) < 1e-6).all(axis=2)
    (box,) = grey.boxes
    assert opaque[box.top : box.bottom, box.left : box.right].sum() > 50
    assert changed.any() and not (changed & binary_erosion(opaque)).any()
    assert not (changed & ~binary_dilation(before.mask, iterations=2)).any()


@pytest.mark.slow
def test_the_document_adds_up_and_its_maps_are_written(checked: Checked, tmp_path: Path) -> None:
    for module in ("skimage", "flip_evaluator"):
        pytest.importorskip(module)
    out = tmp_path / "maps"
    out.mkdir()
    found = error_by_cause(checked, 2, out)
    assert found["frames"] == [0, 6] and found["truth"] is None
    assert [row["cause"] for row in found["causes"]] == [str(cause) for cause in Cause]
    assert found["whole"]["mae"] > 0.05
    assert found["remainder"]["mae"] == 0 and found["remainder"]["psnr_db"] == 100
    for left in found["sums"]["left_in_order"].values():
        assert abs(left) < 1e-9 * found["whole"]["square"]
    assert len(list(out.glob("*.png"))) == 2 * (len(Cause) + 1)
    rows = {row["cause"]: row for row in found["causes"]}
    assert rows["blend shapes"]["alone"]["mae"] == rows["blend shapes"]["adds"]["product"] == 0
    assert rows["FP32 transforms"]["moved"]["largest_mm"] < 0.005
    assert rows["INT8 packing"]["moved"] is None
