"""The crop: buckets, the cropped projection, and the mesh's rectangle for any pose, camera and lens."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from trilane.arrays import F64, shape_buckets
from trilane.body.body import ShapedBody
from trilane.body.joints import Skeleton, rodrigues
from trilane.body.skinning import CpuSkinner
from trilane.errors import BadInputError
from trilane.scene.crop import SCREEN, Rect, choose_bucket, crop_projection
from trilane.stages.cpu.mesh_bounds import MeshBounds

SLACK = 1e-9

sides = st.floats(-1, 1).flatmap(lambda a: st.tuples(st.just(a), st.floats(-1, 1))).map(sorted)
rects = st.tuples(sides, sides).map(lambda s: Rect(s[0][0], s[1][0], s[0][1], s[1][1]))
outputs = st.sampled_from([(480, 640), (1080, 1920), (1920, 1080), (64, 64)])
bucket_sets = st.sampled_from([shape_buckets("256"), shape_buckets("512"), [(256, 256)], [(128, 512)]])


# --- buckets -------------------------------------------------------------------------------------------------------


@given(rects, outputs, bucket_sets)
def test_grown_rectangle_holds_the_mesh(rect: Rect, output: tuple[int, int], buckets: list[tuple[int, int]]) -> None:
    """It contains the rectangle, has square pixels, and lies on the screen when it is no longer than the screen."""
    shape, grown = choose_bucket(rect, output, buckets)
    assert shape in buckets
    assert grown.x0 <= rect.x0
    assert grown.y0 <= rect.y0
    assert grown.x1 >= rect.x1
    assert grown.y1 >= rect.y1
    pixel_height = grown.height * output[0] / shape[0]
    assert grown.width * output[1] / shape[1] == pytest.approx(pixel_height, rel=1e-6)
    for low, high in ((grown.x0, grown.x1), (grown.y0, grown.y1)):
        if high - low < 2.0:
            assert low >= -1.0 - SLACK
            assert high <= 1.0 + SLACK
        else:
            assert low + high == pytest.approx(0.0, abs=SLACK)


@given(rects, outputs, bucket_sets)
def test_no_other_bucket_wastes_less(rect: Rect, output: tuple[int, int], buckets: list[tuple[int, int]]) -> None:
    _, grown = choose_bucket(rect, output, buckets)
    for bucket in buckets:
        _, other = choose_bucket(rect, output, [bucket])
        assert grown.width * grown.height <= other.width * other.height * (1 + 1e-6)


def test_standing_bodies_get_tall_tensors() -> None:
    """A narrow rectangle gets a tall bucket, a wide one a wide bucket, and equal fits go to the larger."""
    assert choose_bucket(Rect(-0.1, -0.9, 0.1, 0.9), (480, 640), shape_buckets("256"))[0] == (512, 128)
    assert choose_bucket(Rect(-0.9, -0.2, 0.9, 0.2), (480, 640), shape_buckets("256"))[0] == (128, 512)
    assert choose_bucket(Rect(-0.5, -0.5, 0.5, 0.5), (480, 480), [(64, 64), (256, 256), (128, 128)])[0] == (256, 256)


def test_one_pixel_and_ten_thousand_pixel_bodies() -> None:
    """A point gets a rectangle of at least one output pixel; a rectangle larger than the screen is enclosed too."""
    _, small = choose_bucket(Rect(0.3, 0.3, 0.3, 0.3), (480, 640), [(256, 256)])
    assert small.width * 640 / 2 == pytest.approx(1.0)
    _, large = choose_bucket(SCREEN, (10_000, 10_000), [(256, 512)])
    assert large == Rect(-2.0, -1.0, 2.0, 1.0)


def test_no_buckets_is_an_error() -> None:
    with pytest.raises(BadInputError, match="tensor shapes"):
        choose_bucket(SCREEN, (480, 640), [])


@given(rects.filter(lambda r: min(r.width, r.height) > 1e-3), st.integers(0, 1000))
def test_cropped_projection_is_an_exact_affine_map(rect: Rect, seed: int) -> None:
    """For any 4x4 projection: x' = (2 x - (x0 + x1)) / (x1 - x0) of what the projection gives; depth unchanged."""
    random = np.random.default_rng(seed)
    projection = random.normal(0, 1, (4, 4))
    point = np.append(random.normal(0, 1, 3), 1.0)
    whole, cropped = projection @ point, crop_projection(projection, rect) @ point
    x, y = whole[:2] / whole[3]
    expected = [(2 * x - rect.x0 - rect.x1) / rect.width, (2 * y - rect.y0 - rect.y1) / rect.height]
    np.testing.assert_allclose(cropped[:2] / cropped[3], expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(cropped[2:], whole[2:])


# --- the mesh's rectangle ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bounds(body: ShapedBody) -> MeshBounds:
    return MeshBounds(body)


def perspective(fov: float, aspect: float, near: float, far: float, shift: tuple[float, float] = (0.0, 0.0)) -> F64:
    """OpenGL perspective, `shift` of its centre in NDC; `far` may be infinite."""
    p = np.zeros((4, 4))
    p[1, 1] = 1.0 / np.tan(fov / 2.0)
    p[0, 0] = p[1, 1] / aspect
    p[0, 2], p[1, 2] = shift
    p[2, 2], p[2, 3] = (
        (-1.0, -2.0 * near) if np.isinf(far) else ((far + near) / (near - far), 2 * far * near / (near - far))
    )
    p[3, 2] = -1.0
    return p


def orthographic(half_width: float, half_height: float, near: float, far: float) -> F64:
    p = np.diag([1.0 / half_width, 1.0 / half_height, -2.0 / (far - near), 1.0])
    p[2, 3] = -(far + near) / (far - near)
    return p


def random_lens(random: np.random.Generator) -> F64:
    """Perspective, shifted, infinite and orthographic lenses, with near planes that may cut the body."""
    near = 10.0 ** random.uniform(-2, 0)
    kind = random.integers(4)
    if kind == 0:
        return orthographic(random.uniform(0.2, 3), random.uniform(0.2, 3), near, near + random.uniform(0.5, 20))
    shift = (random.uniform(-0.8, 0.8), random.uniform(-0.8, 0.8)) if kind == 1 else (0.0, 0.0)
    far = np.inf if kind == 2 else near + random.uniform(1, 100)
    return perspective(np.radians(random.uniform(10, 150)), random.uniform(0.4, 2.5), near, far, shift)


def random_clip(random: np.random.Generator) -> F64:
    """A lens somewhere around, inside or beside the body, looking its way or not."""
    view = np.eye(4)
    view[:3, :3] = rodrigues(random.normal(0, 0.6, 3)) @ rodrigues([0, random.uniform(-np.pi, np.pi), 0])
    view[:3, 3] = [*random.normal(0, 0.4, 2), -abs(random.normal(0, 2.5)) + random.choice([0.0, 0.0, 0.0, 1.5])]
    return np.asarray(random_lens(random) @ view)


def random_pose(random: np.random.Generator) -> F64:
    """From still to wild, with joints at rest and joints turned by exactly pi."""
    pose = random.normal(0, random.choice([0.0, 0.2, 0.6, 1.5]), (55, 3))
    half_turns = random.random(55) < 0.02
    lengths = np.linalg.norm(pose[half_turns], axis=1, keepdims=True)
    pose[half_turns] *= np.pi / np.maximum(lengths, 1e-9)
    return pose.ravel()


def visible_points(points: F64, clip: F64) -> F64:
    """(N,2) NDC of the points that lie inside the view volume."""
    h = points @ clip[:, :3].T + clip[:, 3]
    w = h[:, 3]
    inside = (w > 0) & (np.abs(h[:, :3]) <= w[:, None]).all(axis=1)
    return np.asarray(h[inside, :2] / w[inside, None])


def surface_points(vertices: F64, faces: NDArray[Any], random: np.random.Generator, count: int = 1000) -> F64:
    """The vertices, and points all over the triangles: also where the near plane cuts them open."""
    corners = vertices[faces[random.integers(0, len(faces), count)]]
    share = random.random((count, 3)) ** 3
    share /= share.sum(axis=1, keepdims=True)
    return np.concatenate([vertices, np.einsum("nk,nka->na", share, corners)])


def assert_holds(rect: Rect | None, seen: F64) -> None:
    if rect is None:
        assert not len(seen)
    elif len(seen):
        low, high = seen.min(axis=0), seen.max(axis=0)
        assert (low >= np.array([rect.x0, rect.y0]) - 1e-6).all()
        assert (high <= np.array([rect.x1, rect.y1]) + 1e-6).all()


def test_nothing_on_screen_falls_outside(body: ShapedBody, bounds: MeshBounds) -> None:
    """400 random poses, cameras and lenses: every visible point of the surface is in the rectangle."""
    random = np.random.default_rng(2)
    skeleton, skinner = Skeleton(body.joints, body.body.parents), CpuSkinner(body)
    visible = 0
    for _ in range(400):
        posed, clip = skeleton.pose(random_pose(random)), random_clip(random)
        vertices = skinner.vertices(posed)
        seen = visible_points(surface_points(vertices, body.body.faces, random), clip)
        assert_holds(bounds.rect(posed, clip), seen)
        assert_holds(bounds.rect(posed, clip, vertices.astype(np.float32)), seen)
        visible += bool(len(seen))
    assert visible > 200


def test_rectangle_is_tight_on_whole_bodies(body: ShapedBody, bounds: MeshBounds) -> None:
    random = np.random.default_rng(3)
    skeleton, skinner = Skeleton(body.joints, body.body.parents), CpuSkinner(body)
    view = np.eye(4)
    view[2, 3] = -5.0
    clip = perspective(np.radians(40), 4 / 3, 0.05, 100.0) @ view
    for _ in range(50):
        posed = skeleton.pose(random.normal(0, 0.4, 165))
        vertices = skinner.vertices(posed)
        h = np.c_[vertices, np.ones(len(vertices))] @ clip.T
        seen = h[:, :2] / h[:, 3:]
        expected = [*seen.min(axis=0), *seen.max(axis=0)]
        np.testing.assert_allclose(bounds.rect(posed, clip), expected, atol=3e-6)
        quick = bounds.rect(posed, clip, vertices.astype(np.float32))
        np.testing.assert_allclose(quick, expected, atol=1e-4)


def test_wasted_area_of_whole_bodies(body: ShapedBody, bounds: MeshBounds) -> None:
    """The tensor's area outside the mesh's own rectangle: at most 20 % in the median full-body view."""
    random = np.random.default_rng(4)
    skeleton = Skeleton(body.joints, body.body.parents)
    wasted = []
    while len(wasted) < 200:
        view = np.eye(4)
        view[:3, :3] = rodrigues([random.normal(0, 0.2), random.uniform(-3, 3), 0])
        view[2, 3] = -random.uniform(2.5, 6)
        rect = bounds.rect(skeleton.pose(random.normal(0, 0.3, 165)), perspective(0.8, 4 / 3, 0.05, 100.0) @ view)
        assert rect is not None
        if max(-rect.x0, -rect.y0, rect.x1, rect.y1) < 1.0:
            _, grown = choose_bucket(rect, (480, 640), shape_buckets("256"))
            wasted.append(1.0 - rect.width * rect.height / (grown.width * grown.height))
    assert np.median(wasted) <= 0.20


def test_nothing_visible_gives_nothing(body: ShapedBody, bounds: MeshBounds) -> None:
    """Behind the camera, beside the screen, beyond the far plane; and a camera inside the body sees it."""
    posed = Skeleton(body.joints, body.body.parents).pose(np.zeros(165))
    lens = perspective(0.8, 1.0, 0.05, 100.0)
    for place in ([0, 0, 3.0], [9.0, 0, -3.0], [0, -9.0, -3.0], [0, 0, -200.0]):
        view = np.eye(4)
        view[:3, 3] = place
        assert bounds.rect(posed, lens @ view) is None
    inside = bounds.rect(posed, lens)
    assert inside is not None
    assert inside.width > 1.5


def test_standoff_widens_the_rectangle(body: ShapedBody) -> None:
    """Points that stand off the mesh by the distance, in any direction, are inside; none is inside by chance."""
    random = np.random.default_rng(5)
    near, far = MeshBounds(body), MeshBounds(body, standoff_m=0.05)
    skeleton, skinner = Skeleton(body.joints, body.body.parents), CpuSkinner(body)
    for _ in range(50):
        posed, clip = skeleton.pose(random_pose(random)), random_clip(random)
        away = random.normal(0, 1, (len(body.vertices), 3))
        away *= 0.05 / np.linalg.norm(away, axis=1, keepdims=True)
        assert_holds(far.rect(posed, clip), visible_points(skinner.vertices(posed) + away, clip))
        tight, wide = near.rect(posed, clip), far.rect(posed, clip)
        if tight is not None:
            assert wide is not None
            assert wide.width >= tight.width
            assert wide.height >= tight.height


def test_pose_blend_shapes_and_fewer_weights(shaped: ShapedBody) -> None:
    """A body with pose blend shapes, drawn with 4 weights: the rectangle is that of what is drawn."""
    random = np.random.default_rng(6)
    bounds, skinner = MeshBounds(shaped, weight_count=4), CpuSkinner(shaped, 4)
    skeleton = Skeleton(shaped.joints, shaped.body.parents)
    used = np.unique(shaped.body.faces)
    for _ in range(300):
        posed, clip = skeleton.pose(random_pose(random)), random_clip(random)
        vertices = skinner.vertices(posed)
        points = surface_points(vertices, shaped.body.faces, random)[len(vertices) :]
        seen = visible_points(np.concatenate([vertices[used], points]), clip)
        assert_holds(bounds.rect(posed, clip), seen)
