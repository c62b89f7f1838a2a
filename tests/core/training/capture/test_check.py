"""The check of a capture: overlap of body and mask, bad frames, sides, texels and regions never seen, by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from trilane.arrays import Mask
from trilane.body.body import ShapedBody
from trilane.body.skinning import blend_matrices
from trilane.errors import BadInputError
from trilane.scene.lens import Lens
from trilane.training.capture import check
from trilane.training.capture.capture import Fit
from trilane.training.capture.capture_samples import BodyRaster, projected
from trilane.training.capture.check import (
    REGIONS,
    CheckedFrame,
    TexelCoverage,
    bad_frames,
    checked,
    overlaid,
    require_fits,
    sheet,
    vertex_regions,
)
from trilane.training.surface import BodyArrays, body_arrays


def rows(*spans: tuple[int, int]) -> Mask:
    mask = np.zeros((10, 10), bool)
    for start, stop in spans:
        mask[start:stop] = True
    return mask


def test_overlap_by_hand() -> None:
    """A body of 4 rows, 3 of them on a mask of 6: 3 of 7 rows together, a quarter of the body outside."""
    assert checked(5, rows((0, 4)), rows((1, 7))) == CheckedFrame(5, pytest.approx(3 / 7), pytest.approx(0.25))
    assert checked(0, rows(), rows((1, 7))) == CheckedFrame(0, 0.0, 1.0)


def frames_of(*ious: float) -> list[CheckedFrame]:
    return [CheckedFrame(number, iou, 0.0) for number, iou in enumerate(ious)]


def test_bad_frames_are_far_below_the_others_or_below_a_half() -> None:
    """Of 16 frames the median is 0.795, that of their deviations 0.01: the limit is 4 x 1.4826 x 0.01 below, 0.7357."""
    usual = (0.79, 0.81, 0.80) * 4
    assert [each.number for each in bad_frames(frames_of(*usual, 0.60, 0.735, 0.745, 0.2))] == [15, 12, 13]
    assert bad_frames(frames_of(*usual)) == []
    assert bad_frames(frames_of(0.8, 0.8, 0.8, 0.755)) == []  # no spread at all: less than 0.05 is none
    assert [each.number for each in bad_frames(frames_of(0.3, 0.9, 0.49, 0.51))] == [0, 2]


def test_fits_that_lie_elsewhere_are_refused(tmp_path: Any) -> None:
    capture: Any = SimpleNamespace(folder=tmp_path, file=SimpleNamespace(fits="fits"))
    require_fits(capture, frames_of(0.1, 0.51, 0.9), tmp_path / "a.png")
    with pytest.raises(BadInputError) as caught:
        require_fits(capture, frames_of(0.1, 0.2, 0.9), tmp_path / "a.png")
    (line,) = caught.value.details
    assert "a median IoU of 0.20" in line and f"look at {tmp_path / 'a.png'}" in line


@pytest.fixture
def square(monkeypatch: pytest.MonkeyPatch) -> TexelCoverage:
    """Coverage of a square that fills the texture: two triangles to the left of its middle, two to the right of it."""
    monkeypatch.setattr(check, "vertex_regions", lambda _: np.repeat([0, 1], 4))
    left = np.array([[0.0, 0], [0.5, 0], [0.5, 1], [0, 1]])
    corners = np.concatenate([left, left + np.array([0.5, 0.0])])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    points = np.column_stack([corners, np.zeros(8)])
    return TexelCoverage(BodyArrays(points, faces, corners, faces, np.ones((8, 55)), np.zeros((55, 3))), side=32)


def test_texels_on_the_mask_are_seen(square: TexelCoverage) -> None:
    """Each texel has 2 x 2 pixels; the mask has a quarter of the columns, so 8 of 32 texels and those beside them."""
    y, x = np.mgrid[:64, :64] + 0.5
    uv = np.dstack([x / 64, y / 64, np.ones((64, 64))]).astype(np.float32)
    mask = np.zeros((64, 64), bool)
    assert square.share() == 0 and square.never_seen() == ["face and head", "left hand"]
    mask[:, :16] = True
    square.add(square.drawn(uv, mask))
    seen = square.seen
    assert seen[1:-1, 1:9].all() and not seen[:, 10:].any()
    assert square.share() == pytest.approx(9 / 32, abs=0.01)
    by_region = square.share_by_region()
    assert by_region["face and head"] > 0.5 and by_region["left hand"] == 0 and square.never_seen() == ["left hand"]
    square.add(square.drawn(uv[:, ::-1], np.ones((64, 64), bool)))
    assert square.share() > 0.95 and np.array_equal(square.unseen, square.used & ~square.seen)


def test_a_surface_seen_at_its_outline_is_not_seen(square: TexelCoverage) -> None:
    """u hardly changes over the picture: the surface is nearly parallel to the rays."""
    y, x = np.mgrid[:64, :64] + 0.5
    uv = np.dstack([0.5 + 1e-4 * x / 64, y / 64, np.ones((64, 64))]).astype(np.float32)
    square.add(square.drawn(uv, np.ones((64, 64), bool)))
    assert square.share() == 0


def test_regions_lie_where_their_names_say(body: ShapedBody) -> None:
    arrays = body_arrays(body)
    regions = vertex_regions(arrays)
    places = {name: arrays.vertices[regions == number] for number, name in enumerate(REGIONS)}
    height = np.ptp(arrays.vertices[:, 1])
    low, high = arrays.vertices[:, 1].min(), arrays.vertices[:, 1].max()
    assert all(len(points) > 20 for points in places.values()) and sum(map(len, places.values())) == len(regions)
    assert (
        places["soles"][:, 1].max() < low + 0.05 * height and places["top of head"][:, 1].min() > high - 0.08 * height
    )
    assert places["left hand"][:, 0].min() > 0.25 * height and places["right hand"][:, 0].max() < -0.25 * height
    assert (np.abs(places["armpits"][:, 0]) < 0.2 * height).all()
    armpits = places["armpits"][:, 1]
    assert low + 0.65 * height < armpits.min() and armpits.max() < low + 0.85 * height
    assert places["legs"][:, 1].max() < low + 0.6 * height < places["face and head"][:, 1].min()


def test_the_body_is_drawn_where_its_fit_and_its_lens_put_it(body: ShapedBody) -> None:
    """The box of the drawn body, against its vertices skinned in float64 and projected, to a pixel."""
    rng = np.random.default_rng(1)
    pose = rng.normal(0, 0.15, (55, 3))
    fit, shape = Fit(pose, np.array([0.3, 0.1, -4.0]), np.zeros(0), np.zeros(0)), (360, 480)
    projection = Lens(480, 360, 420.0, 380.0, 260.0, 170.0).projection(0.05, 100.0)
    raster = BodyRaster(body, 1)
    drawn = raster.uv(fit, np.eye(4), projection, shape)[..., 2] > 0
    matrices = raster.posed(fit).matrices.reshape(55, 12).astype(np.float64)
    moved = blend_matrices(body.body.weights.astype(np.float64), matrices).reshape(-1, 3, 4)
    points = np.einsum("vab,vb->va", moved[:, :, :3], body.vertices) + moved[:, :, 3]
    pixels = projected(points, projection, shape)
    for axis, others in ((0, 0), (1, 1)):
        seen = np.flatnonzero(drawn.any(axis=others))
        assert abs(seen[0] - pixels[:, axis].min()) < 1.5 and abs(seen[-1] + 1 - pixels[:, axis].max()) < 1.5


def test_body_and_mask_are_laid_over_the_frame() -> None:
    picture = np.full((2, 2, 4), 100, np.uint8)
    picture[..., 3] = [[255, 255], [0, 0]]
    uv = np.zeros((2, 2, 3), np.float32)
    uv[:, 0, 2] = 1
    over = overlaid(picture, uv)
    assert over[:, 0].tolist() == [[178, 50, 50]] * 2 and over[:, 1].tolist() == [[50, 82, 178], [100, 100, 100]]
    image = sheet([("a", np.full((90, 160, 3), 7, np.uint8))] * 5)
    assert image.size == (1280, 360) and isinstance(image, Image.Image)
    assert np.array(image)[100, 100].tolist() == [7, 7, 7] and not np.array(image)[200, 400].any()
