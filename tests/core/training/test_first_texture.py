"""The first texture: colours and fields by hand; what no frame shows beside solutions of Laplace's equation."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("scipy")

from trilane.training import first_texture as module
from trilane.training.dataset import U16, ShapeGroup
from trilane.training.first_texture import (
    eigenfunctions,
    fill_along_surface,
    fill_beside,
    fill_gaps,
    first_texture,
    grown,
    harmonic_fill,
    head_on,
    lay_out,
    mean_colours,
)
from trilane.training.surface import BodyArrays

ROUND, RINGS, SIDE = 24, 13, 96
#: Of the texture, what lies beside the cylinder's layout at each border.
BORDER = 0.05


@pytest.fixture(scope="module")
def cylinder() -> BodyArrays:
    """A cylinder of 24 x 12 squares; its layout begins and ends at the same line of vertices, the seam."""
    turn = 2 * np.pi * np.arange(ROUND) / ROUND
    chord = 2 * np.sin(np.pi / ROUND)
    points = [(np.cos(a), chord * j, np.sin(a)) for j in range(RINGS) for a in turn]
    places = [(k / ROUND, j / (RINGS - 1)) for j in range(RINGS) for k in range(ROUND + 1)]
    faces, uv_faces = [], []
    for j in range(RINGS - 1):
        for k in range(ROUND):
            a, b = ROUND * j + k, ROUND * j + (k + 1) % ROUND
            p = (ROUND + 1) * j + k
            faces += [(a, b, a + ROUND), (b, b + ROUND, a + ROUND)]
            uv_faces += [(p, p + 1, p + ROUND + 1), (p + 1, p + ROUND + 2, p + ROUND + 1)]
    uv = BORDER + (1 - 2 * BORDER) * np.array(places)
    count = len(points)
    skin = (np.zeros((count, 55)), np.zeros((55, 3)))
    return BodyArrays(np.array(points), np.array(faces), uv, np.array(uv_faces), *skin)


def texels() -> tuple[np.ndarray, np.ndarray]:
    """Share of the turn and of the height (SIDE,SIDE) of each texel's centre."""
    at = ((np.arange(SIDE) + 0.5) / SIDE - BORDER) / (1 - 2 * BORDER)
    return np.meshgrid(at, at)


def test_between_two_rings_a_fill_is_linear(cylinder: BodyArrays) -> None:
    ring = np.repeat(np.arange(RINGS), ROUND)
    line = np.column_stack([3.0 + 0.5 * ring, -1.0 * ring])
    known = (ring <= 2) | (ring == 10)
    filled = harmonic_fill(np.where(known[:, None], line, 99.0), known, cylinder.vertices, cylinder.faces)
    inside = ring <= 10
    np.testing.assert_allclose(filled[inside], line[inside], atol=1e-9)
    np.testing.assert_allclose(filled[~inside], np.broadcast_to(line[ring == 10][0], filled[~inside].shape), atol=1e-9)


def test_a_wave_round_the_cylinder_fades_as_the_hyperbolic_cosine(cylinder: BodyArrays) -> None:
    """On squares the equation is 4 u = the sum of four neighbours, so with u = c(j) cos(turn) the ratio of c's is
    cosh(m) = 2 - cos(2 pi / 24); right angles count as a hundredth instead of 0, hence the tolerance."""
    ring, turn = np.repeat(np.arange(RINGS), ROUND), np.tile(2 * np.pi * np.arange(ROUND) / ROUND, RINGS)
    known = (ring <= 1) | (ring >= 11)
    wave = np.cos(turn)
    filled = harmonic_fill((wave * known)[:, None], known, cylinder.vertices, cylinder.faces)[:, 0]
    m = np.arccosh(2 - np.cos(2 * np.pi / ROUND))
    wanted = np.where(known, 1.0, np.cosh(m * (ring - 6)) / np.cosh(m * 5)) * wave
    assert np.cosh(0) / np.cosh(m * 5) < 0.52
    np.testing.assert_allclose(filled, wanted, atol=0.01)


def test_texels_are_filled_over_the_seam(cylinder: BodyArrays) -> None:
    """Two strips are seen: 1 just before the seam, 0 in the middle. Behind the seam the fill falls from 1, although in
    the texture the strip of zeros is nearer."""
    across, up = texels()
    _, covered = lay_out(np.zeros((RINGS * ROUND, 1)), cylinder.faces, cylinder.uv, cylinder.uv_faces, SIDE)
    strip, middle = across > 19 / 24, (across > 10 / 24) & (across < 14 / 24)
    image = np.where(strip, 1.0, 0.0)[..., None]
    filled = fill_along_surface(image, ~(covered & (strip | middle)), cylinder)[..., 0]
    inside = covered & (across > 0) & (across < 1) & (up > 0) & (up < 1)
    wanted = np.where(across < 0.5, np.clip(1 - across * 24 / 10, 0, 1), np.clip((across * 24 - 14) / 5, 0, 1))
    assert np.abs(filled - wanted)[inside].max() < 0.06, (
        "the strips end between two vertices: a sixteenth of 10 at most"
    )
    assert np.abs(filled[:, ~inside.any(axis=0)][inside.any(axis=1)] - 1).max() < 0.1, "the margin of the seam too"
    flat = fill_gaps(image, covered & (strip | middle))[..., 0]
    assert np.abs(flat - wanted)[inside].max() > 0.5, "what a fill in the texture alone gives"


def test_what_is_seen_stays_as_it_is(cylinder: BodyArrays) -> None:
    image = np.random.default_rng(1).uniform(-1, 1, (SIDE, SIDE, 3))
    unseen = np.zeros((SIDE, SIDE), bool)
    unseen[30:60, 20:70] = True
    filled = fill_along_surface(image, unseen, cylinder)
    assert np.array_equal(filled[~unseen], image[~unseen]) and not np.array_equal(filled[unseen], image[unseen])
    assert filled.min() >= -1 and filled.max() <= 1


def test_a_part_of_its_own_takes_the_nearest_known_vertex(cylinder: BodyArrays) -> None:
    """A second cylinder beside the first, nothing of it known; and a mesh of which nothing is known at all."""
    points = np.concatenate([cylinder.vertices, cylinder.vertices + np.array([5.0, 0, 0])])
    faces = np.concatenate([cylinder.faces, cylinder.faces + len(cylinder.vertices)])
    values = np.concatenate([np.where(cylinder.vertices[:, 0] > 0, 2.0, 1.0), np.zeros(RINGS * ROUND)])[:, None]
    known = np.arange(len(points)) < RINGS * ROUND
    filled = harmonic_fill(values, known, points, faces)
    assert np.array_equal(filled[known], values[known]) and (filled[~known] == 2.0).all()
    assert np.array_equal(harmonic_fill(values, np.zeros(len(points), bool), points, faces), values)


def test_texels_beside_known_ones_take_their_mean() -> None:
    known = np.zeros((5, 6), bool)[:5, :5]
    known[0, 0] = known[2, 1] = True
    image = np.full((5, 5, 1), 7.0)
    image[0, 0], image[2, 1] = 2.0, 4.0
    filled, near = fill_beside(image, known)
    assert filled[..., 0].tolist() == [[2, 2, 7, 7, 7], [3, 3, 4, 7, 7], [4, 4, 4, 7, 7], [4, 4, 4, 7, 7], [7] * 5]
    assert near.tolist() == (filled[..., 0] < 7).tolist() == grown(known).tolist()


def test_pixels_are_weighted_by_how_the_surface_is_seen():
    """u = 0.01 x, v = t 0.01 y: singular values 0.01 and 0.01 t. At t = 1/2 the weight is (1/2)^3, and (1 / (s side))^2
    of that above a texel a pixel; nothing at the outline, and nothing where a pixel spans more than 0.03.
    """
    y, x = np.mgrid[:6, :7].astype(float)
    covered = np.ones((6, 7), bool)
    covered[3, 5] = False

    def weight(step, t, side):
        return head_on(np.stack([step * x, t * step * y], axis=2), covered, side)

    inner = weight(0.01, 0.5, 50)
    assert inner[2, 2] == pytest.approx(0.5**3)
    assert weight(0.01, 0.5, 400)[2, 2] == pytest.approx(0.5**3 / 16)
    assert (inner > 0).sum() == 4 * 5 - 4, "the frame has none, nor the gap in its last column and three beside it"
    assert not weight(0.04, 1.0, 50).any()
    assert weight(0.029, 1.0, 10)[2, 2] == pytest.approx(1.0)


def test_a_texels_colour_is_the_weighted_mean_of_its_pixels():
    """One sample whose left half is red, right half green; u and v run over the texture once."""
    h = w = 200
    y, x = np.mgrid[:h, :w]
    uv = np.stack([(x + 0.5) / w, (y + 0.5) / h], axis=2)
    rgba = np.zeros((1, h, w, 4), np.uint8)
    rgba[0, :, : w // 2, 0] = 200
    rgba[0, :, w // 2 :, 1] = 100
    rgba[..., 3] = 255
    group = ShapeGroup(
        (h, w), np.round(uv * U16).astype(np.uint16)[None], np.ones((1, h, w), np.uint8), rgba, np.zeros(1)
    )
    colours = mean_colours([group], 8, sheet())
    np.testing.assert_allclose(colours[:, :4], np.broadcast_to([200 / 255, 0, 0], (8, 4, 3)), atol=1e-6)
    np.testing.assert_allclose(colours[:, 4:], np.broadcast_to([0, 100 / 255, 0], (8, 4, 3)), atol=1e-6)
    small = ShapeGroup((64, 64), group.uv[:, :64, :64], group.covered[:, :64, :64], rgba[:, :64, :64], np.zeros(1))
    assert not mean_colours([small], 8, sheet()).any()


def sheet() -> BodyArrays:
    """A flat sheet of 6 x 6 vertices, whose texture coordinates cover 0.1 to 0.6."""
    grid = np.array([[x, y, 0.0] for x in range(6) for y in range(6)], np.float64)
    corner = [(6 * x + y, 6 * x + y + 6, 6 * x + y + 1) for x in range(5) for y in range(5)]
    faces = np.array(corner + [(b, b + 1, c) for _, b, c in corner])
    return BodyArrays(grid, faces, grid[:, :2] / 10 + 0.1, faces, np.zeros((36, 55)), np.zeros((55, 3)))


def test_fields_of_a_square_are_cosines():
    """The smoothest functions of a square sheet with free edges are cos(pi x / L) and cos(pi y / L); a lone vertex has
    the value of its neighbour."""
    body = sheet()
    far = np.vstack([body.vertices, [[0.0, 0.0, 9.0]]])
    fields = eigenfunctions(far, body.faces, 2)
    cosines = np.cos(np.pi * body.vertices[:, :2] / 5)
    fit, *_ = np.linalg.lstsq(cosines, fields[:36], rcond=None)
    assert np.abs(cosines @ fit - fields[:36]).max() < 0.12
    assert np.abs(fields).max(axis=0) == pytest.approx([1.0, 1.0])
    assert np.array_equal(fields[36], fields[0])


def test_values_are_laid_out_at_texel_centres():
    """A field that is u itself is u at the centre of every texel inside; only texels of the sheet are known."""
    body = sheet()
    image, known = lay_out(body.uv[:, :1] * [[1.0]], body.faces, body.uv, body.uv_faces, 20)
    rows, columns = np.nonzero(known)
    np.testing.assert_allclose(image[rows, columns, 0], (columns + 0.5) / 20, atol=1e-9)
    assert known[2:12, 2:12].all() and not known[:1].any() and not known[13:].any()
    assert not image[~known].any()


@pytest.mark.parametrize("at_once", [1, 300, 1 << 18])
def test_a_texel_takes_the_last_of_the_faces_over_it(at_once, monkeypatch):
    """A loop over faces and texels says the same; some faces overlap, leave the image or have no area."""
    monkeypatch.setattr(module, "TEXELS_AT_ONCE", at_once)
    rng, side = np.random.default_rng(1), 24
    middles, values = rng.uniform(-0.1, 1.1, (40, 1, 2)), rng.normal(size=(20, 2))
    uv = np.vstack([(middles + rng.uniform(-0.1, 0.1, (40, 3, 2))).reshape(-1, 2), np.full((3, 2), 0.5)])
    uv_faces, faces = np.arange(123).reshape(-1, 3), rng.integers(0, 20, (41, 3))
    expected, over = np.zeros((side, side, 2)), np.zeros((side, side), bool)
    for corners, face in zip(uv[uv_faces] * side - 0.5, faces, strict=True):
        system = np.vstack([corners.T, np.ones(3)])
        if abs(np.linalg.det(system)) < 1e-9:
            continue
        inverse = np.linalg.inv(system)
        reach = np.stack([corners.min(axis=0), corners.max(axis=0)])
        for y, x in np.ndindex(side, side):
            weights = inverse @ [x, y, 1]
            near = (np.floor(reach[0]) <= [x, y]).all() and ([x, y] <= np.ceil(reach[1])).all()
            if near and (weights >= -0.25).all():
                expected[y, x], over[y, x] = weights @ values[face], True
    image, known = lay_out(values, faces, uv, uv_faces, side)
    assert over.any() and not over.all()
    np.testing.assert_array_equal(known, over)
    np.testing.assert_allclose(image, expected, atol=1e-9)


def test_gaps_take_the_mean_of_the_known_texels_of_the_block_round_them():
    known = np.zeros((4, 4), bool)
    known[0, 0] = known[3, 3] = True
    image = np.zeros((4, 4, 1))
    image[0, 0], image[3, 3] = 2.0, 6.0
    filled = fill_gaps(image, known)[..., 0]
    assert filled[:2, :2].tolist() == [[2, 2], [2, 2]]
    assert filled[2:, 2:].tolist() == [[6, 6], [6, 6]]
    assert filled[:2, 2:].tolist() == filled[2:, :2].tolist() == [[4, 4], [4, 4]]


def test_a_first_texture_is_colours_then_fields():
    body = sheet()
    texture = first_texture(body, [], 16, 5)
    assert texture.shape == (16, 16, 5) and texture.dtype == np.float32
    assert (texture[..., :3] == -1).all(), "no sample has a colour: 2 * 0 - 1"
    fields = eigenfunctions(body.vertices, body.faces, 2)
    image, known = lay_out(fields, body.faces, body.uv, body.uv_faces, 16)
    np.testing.assert_allclose(texture[..., 3:][known], np.clip(image[known], -1, 1), atol=1e-6)
