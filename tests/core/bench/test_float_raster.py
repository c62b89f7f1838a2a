"""The reference rasteriser against a second one that solves each pixel by itself, and its rules on samples at edges."""

from __future__ import annotations

import numpy as np
import pytest

from trilane.bench.lib import float_raster
from trilane.bench.lib.float_raster import ReferenceImage, quantise, rasterise, sample, tensor

SHAPE = (8, 16)
EDGE = 1e-9  # of a share, nearer to which a sample is at an edge


def alone(corners: np.ndarray, row: int, column: int) -> np.ndarray:
    """Shares (F,3) of the corners (F,3,4), clip x, y, z, w, at a pixel's centre, such that w is 1 there.

    They solve sum(share * (x, y, w)) = (x, y, 1) of the centre; rows run downward.
    """
    centre = np.array([2 * (column + 0.5) / SHAPE[1] - 1, 1 - 2 * (row + 0.5) / SHAPE[0], 1.0])
    equations = corners[:, :, [0, 1, 3]].transpose(0, 2, 1)
    return np.linalg.solve(equations, np.tile(centre, (len(corners), 1))[..., None])[..., 0]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("cull", [False, True])
def test_each_pixel_shows_what_it_shows_alone(seed: int, cull: bool) -> None:
    """Fifty triangles through the eye's plane, near and far planes and the frame, in front of each other."""
    random = np.random.default_rng(seed)
    world = random.uniform(-1.5, 1.5, (150, 3)) * [1, 1, 2]
    clip = random.normal(0, 0.3, (4, 4)) + np.diag([1, 1, 0.6, 0.0])
    clip[3] = [0.1, -0.2, -0.5, 0.7]
    uv = random.uniform(0, 1, (150, 2))
    triangles = random.permutation(150).reshape(50, 3)
    image = rasterise(world, triangles, uv, clip, SHAPE, cull)
    corners = (np.c_[world, np.ones(150)] @ clip.T)[triangles]
    turns = np.linalg.det(corners[:, :, [0, 1, 3]]) > 0
    seen = 0
    for row, column in np.ndindex(*SHAPE):
        nearest, expected = np.inf, (-1, np.zeros(2), 0.0)
        for number, share in enumerate(alone(corners, row, column)):
            assert np.abs(share).min() > EDGE
            depth = share @ corners[number, :, 2]
            if (share > 0).all() and abs(depth) <= 1 and depth < nearest and (turns[number] or not cull):
                nearest = depth
                expected = number, (share / share.sum()) @ uv[triangles[number]], depth
        assert image.triangle[row, column] == expected[0]
        assert image.coverage[row, column] == (expected[0] >= 0)
        np.testing.assert_allclose(image.uv[row, column], expected[1], atol=1e-9)
        assert image.depth[row, column] == pytest.approx(expected[2], abs=1e-9)
        seen += expected[0] >= 0
    assert seen > 5


def pixels(*places: tuple[float, float]) -> np.ndarray:
    """World positions whose x, y fall on these (column, row), in pixels from the upper left corner, at depth 0."""
    return np.array([[2 * x / SHAPE[1] - 1, 1 - 2 * y / SHAPE[0], 0.0] for x, y in places])


def drawn(world: np.ndarray, triangles: list[list[int]], cull: bool = False) -> ReferenceImage:
    return rasterise(world, np.array(triangles), np.zeros((len(world), 2)), np.eye(4), SHAPE, cull)


@pytest.mark.parametrize("diagonal", [[[0, 1, 2], [0, 2, 3]], [[1, 2, 3], [1, 3, 0]], [[2, 1, 0], [3, 2, 0]]])
def test_of_a_rectangle_through_centres_the_upper_and_left_ones_are_inside(diagonal: list[list[int]]) -> None:
    """Columns 1 to 5 of rows 1 to 3: samples on the lower and right edges belong to others, and none to two."""
    world = pixels((1.5, 1.5), (1.5, 4.5), (6.5, 4.5), (6.5, 1.5))
    rows, columns = np.indices(SHAPE)
    inside = (rows >= 1) & (rows < 4) & (columns >= 1) & (columns < 6)
    assert np.array_equal(drawn(world, diagonal).coverage, inside)
    counts = sum(drawn(world, [one]).coverage.astype(int) for one in diagonal)
    assert np.array_equal(counts, inside.astype(int))


def test_every_sample_of_a_fan_belongs_to_one_triangle() -> None:
    """Eight triangles round a sample, their edges through others: level, upright and across."""
    ring = [(4.5, 0.5), (6.5, 0.5), (6.5, 2.5), (6.5, 4.5), (4.5, 4.5), (2.5, 4.5), (2.5, 2.5), (2.5, 0.5)]
    world = pixels((4.5, 2.5), *ring)
    fan = [[0, 1 + n, 1 + (n + 1) % 8] for n in range(8)]
    counts = sum(drawn(world, [one]).coverage.astype(int) for one in fan)
    rows, columns = np.indices(SHAPE)
    assert np.array_equal(counts, ((rows < 4) & (columns >= 2) & (columns < 6)).astype(int))
    turned = sum(drawn(world, [one[::-1]]).coverage.astype(int) for one in fan)
    assert np.array_equal(turned, counts)
    culled = [drawn(world, [each], cull=True).coverage.sum() for one in fan for each in (one, one[::-1])]
    assert not any(culled[::2]) and sum(culled[1::2]) == 16, "the fan's own wind clockwise in the picture"


def test_of_triangles_at_one_depth_the_first_is_seen_and_flat_ones_are_not() -> None:
    world = pixels((0, 0), (0, 6), (9, 0), (3, 3))
    image = drawn(world, [[0, 0, 1], [2, 1, 0], [0, 1, 2]])
    assert {*image.triangle[image.coverage].tolist()} == {1} and image.coverage.sum() > 20
    assert not drawn(world + np.array([5, 0, 0]), [[0, 1, 2]]).coverage.any()
    empty = drawn(world, [[0, 0, 1]])
    assert (empty.triangle == -1).all() and not empty.depth.any() and not empty.uv.any()


def test_few_samples_at_a_time_give_the_same_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(3)
    world = random.uniform(-1, 1, (60, 3))
    triangles = np.arange(60).reshape(20, 3)
    at_once = rasterise(world, triangles, world[:, :2], np.eye(4), SHAPE)
    monkeypatch.setattr(float_raster, "BATCH_SAMPLES", 100)
    by_parts = rasterise(world, triangles, world[:, :2], np.eye(4), SHAPE)
    assert np.array_equal(at_once.triangle, by_parts.triangle) and np.array_equal(at_once.uv, by_parts.uv)


def test_a_tensor_has_the_zero_point_where_there_is_no_mesh() -> None:
    """Two of four pixels: (0.25 - 0.5 of a texel) between texels, by hand; real / 0.5 + 100."""
    coverage = np.array([[True, False], [False, True]])
    uv = np.zeros((2, 2, 2))
    uv[0, 0], uv[1, 1] = (0.375, 0.5), (0.75, 0.25)
    texture = np.array([[[0.0, 8.0], [4.0, 2.0]], [[2.0, 8.0], [6.0, 2.0]]])
    image = ReferenceImage(coverage, np.zeros((2, 2), np.int64), uv, np.zeros((2, 2)))
    found = tensor(image, texture, 0.5, 100)
    assert found.tolist() == [[[104, 113], [100, 100]], [[100, 100], [108, 104]]] and found.dtype == np.uint8


def test_bytes_of_the_reference_round_halves_to_even_and_clamp() -> None:
    real = np.array([-99.0, -0.3, 0.25, 0.75, 1.25, 999.0])
    assert quantise(real, 0.5, 3).tolist() == [0, 2, 3, 5, 5, 255]


def test_the_reference_samples_between_texels_and_clamps_at_the_edge() -> None:
    texture = np.array([[[0.0], [1.0]], [[2.0], [3.0]]])
    uv = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.5, 0.5], [-1.0, 2.0], [0.625, 0.25]])
    assert sample(texture, uv)[:, 0].tolist() == [0.0, 1.0, 2.0, 1.5, 2.0, 0.75]
    tall = np.arange(12.0).reshape(3, 4, 1)
    assert sample(tall, np.array([[1.0, 1.0], [0.0, 0.0], [0.375, 0.5]]))[:, 0].tolist() == [11.0, 0.0, 5.0]
    assert sample(tall, np.array([[0.5, 0.5], [0.25, 2 / 3]]))[:, 0] == pytest.approx([5.5, 6.5])
