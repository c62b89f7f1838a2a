"""The packed pass against the float64 reference, and the cases that drivers find hard."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.avatars.mesh_levels import MeshLevel
from trilane.bench.lib import float_raster
from trilane.body.skinning import FrameSkinner
from trilane.stages.config import Quantisation
from trilane.stages.gpu.raster import PackedAvatar, PackedPass, Placement
from trilane.stages.gpu.skinned_mesh import PosedMesh, SkinnedMesh, avatar_mesh, mesh_arrays
from trilane.training.sample_renderer import UvBytes, UvRaster

ENCODING = Quantisation(6 / 255, 117)
REST = np.zeros(165)
Camera = Callable[..., Any]


def draw(gl: Any, mesh: Any, texture: Any, joints: Any, camera: Any, shape: Any, deferred: bool = True) -> Any:
    """The tensor (h,w,C) of one avatar that fills it."""
    packed = PackedPass(gl, texture.shape[2], ENCODING, deferred)
    avatar = PackedAvatar(packed, mesh, texture)
    avatar.draw(packed.begin(shape), camera[0], Placement(joints, camera[1], (0, 0, *shape)))
    tensor = np.zeros(shape[0] * shape[1] * texture.shape[2], np.uint8)
    packed.read_into(shape, tensor)
    return tensor.reshape(*shape, texture.shape[2])


def compare(gl: Any, arrays: Any, texture: Any, joints: Any, camera: Any, shape: Any) -> dict[str, float]:
    """How much a drawn tensor differs from the reference's: counts of pixels, and the share within one step."""
    mesh = SkinnedMesh(gl, arrays)
    tensor = draw(gl, mesh, texture, joints, camera, shape)
    covered = UvRaster(gl, mesh).render(joints, *camera, shape)[..., 2] > 0
    clip = camera[1] @ camera[0]
    image = float_raster.rasterise(
        float_raster.skin(arrays, joints), arrays.triangles, arrays.uv, clip, shape, arrays.closed
    )
    expected = float_raster.tensor(image, texture, ENCODING.scale, ENCODING.zero_point)
    steps = np.abs(tensor.astype(int) - expected)[covered & image.coverage]
    return {
        "pixels": float(image.coverage.sum()),
        "coverage": float((covered != image.coverage).sum()),
        "within_one": float((steps <= 1).mean()) if steps.size else 1.0,
        "background": float((tensor[~covered] != ENCODING.zero_point).sum()),
    }


def random_numbers(seed: int) -> NDArray[np.float64]:
    """Axis-angle numbers of a bent body, (165,)."""
    return np.random.default_rng(seed).normal(0, 0.2, 165)


def test_row_zero_is_on_top(gl: Any, person: Any, camera: Camera) -> None:
    """The head is in the upper rows, the body's left hand on the picture's right."""
    image = UvRaster(gl, person.mesh).render(person.pose(REST), *camera((0, 0.9, 3), (0, 0.9, 0)), (64, 64))
    rows, columns = np.nonzero(image[..., 2])
    assert np.ptp(columns[rows < rows.min() + 4]) < 12 < np.ptp(columns)
    arms = person.pose(np.eye(165)[3 * 16 + 2] * 1.3)  # the left shoulder turns about z: the left arm goes up
    raised = UvRaster(gl, person.mesh).render(arms, *camera((0, 0.9, 3), (0, 0.9, 0)), (64, 64))
    assert np.nonzero(raised[:12, :, 2])[1].mean() > 34


HARD_VIEWS = {
    "near plane through the body": ((0.0, 0.95, 0.35), (0.0, 0.95, 0.0), {"near": 0.3}),
    "camera inside the body": ((0.0, 1.0, 0.03), (0.0, 1.1, 1.0), {"near": 0.01}),
    "body behind the camera": ((0.0, 1.0, 1.0), (0.0, 1.0, 3.0), {}),
    "a body of a few pixels": ((0.0, 1.0, 90.0), (0.0, 1.0, 0.0), {}),
    "an eyelash away": ((0.03, 1.66, 0.24), (0.03, 1.64, 0.0), {"near": 0.001}),
}
#: Looking straight down the body, which then is 10,000 pixels tall in a window of 192.
HARD_VIEWS["a body of 10,000 pixels"] = ((0.0, 1.62, 3.0), (0.0, 1.62, 0.0), {"fov_y_deg": 0.645})
NOTHING_SEEN = ("body behind the camera", "camera inside the body")


@pytest.mark.parametrize("name", HARD_VIEWS)
def test_hard_views(gl: Any, person: Any, neural_texture: Any, camera: Camera, name: str) -> None:
    """Bounds: 0.2 % of the pixels plus 2 differ in coverage, 99.5 % of the values are within one step.

    From inside, a closed body shows nothing: all its triangles face away.
    """
    eye, target, planes = HARD_VIEWS[name]
    views = camera(eye, target, **planes)
    difference = compare(gl, person.arrays, neural_texture, person.pose(REST), views, (192, 192))
    assert difference["coverage"] <= 0.002 * difference["pixels"] + 2
    assert difference["within_one"] >= 0.995
    assert difference["background"] == 0
    assert (difference["pixels"] == 0) == (name in NOTHING_SEEN)


@pytest.mark.parametrize("shape", [(97, 61), (1, 1), (33, 200)])
def test_sizes_that_are_no_multiple_of_32(gl: Any, person: Any, camera: Camera, shape: Any) -> None:
    """Odd tensors and an odd texture agree with the reference as others do."""
    texture = np.random.default_rng(0).normal(0, 0.5, (37, 21, 16)).astype(np.float16).astype(np.float64)
    views = camera((0.2, 1.0, 2.0), (0, 1.0, 0), 40, shape[1] / shape[0])
    difference = compare(gl, person.arrays, texture, person.pose(REST), views, shape)
    assert difference["pixels"] > 0
    assert difference["coverage"] <= 0.002 * difference["pixels"] + 1
    assert difference["within_one"] >= 0.995
    assert difference["background"] == 0


def test_a_vertex_on_the_near_plane(gl: Any, neural_texture: Any, camera: Camera) -> None:
    """A triangle that touches the near plane at a corner, and one that lies in it, agree to two pixels a row."""
    joints = np.tile(np.eye(4)[:3], (55, 1, 1)).astype(np.float32)
    views = camera((0.0, 0.0, 1.0), (0, 0, 0), 90, near=0.5)
    touching = quad([(-0.4, -0.4, -1.0), (0.4, -0.4, -1.0), (0.0, 0.3, 0.5)], [(0, 1, 2)])
    difference = compare(gl, touching, neural_texture, joints, views, (64, 64))
    assert difference["pixels"] > 100
    assert difference["coverage"] <= 2
    within = quad([(-0.4, -0.4, 0.5), (0.4, -0.4, 0.5), (0.0, 0.3, 0.5)], [(0, 1, 2)])
    assert compare(gl, within, neural_texture, joints, views, (64, 64))["background"] == 0


def quad(corners: list[tuple[float, float, float]], faces: list[tuple[int, int, int]]) -> Any:
    """A mesh of joint 0 alone, u and v from x and y."""
    vertices = np.array(corners, float)
    indices = np.array(faces)
    joint, weight = np.zeros((len(vertices), 4), int), np.eye(4)[np.zeros(len(vertices), int)]
    return mesh_arrays(vertices, indices, vertices[:, :2] * 0.5 + 0.5, indices, joint, weight)


def test_degenerate_and_inverted_triangles(gl: Any, neural_texture: Any, camera: Camera) -> None:
    """Triangles without area draw nothing; those of open meshes are drawn whichever way they wind."""
    corners = [(-1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, 1.0, 0.0)]
    joints = np.tile(np.eye(4)[:3], (55, 1, 1)).astype(np.float32)
    views = camera((0.1, 0.2, 3.0), (0, 0, 0))
    nothing = quad(corners, [(0, 1, 1), (2, 2, 2)])
    assert compare(gl, nothing, neural_texture, joints, views, (64, 64))["pixels"] == 0
    mixed = quad(corners, [(0, 1, 2), (0, 3, 2)])
    difference = compare(gl, mixed, neural_texture, joints, views, (64, 64))
    assert difference["pixels"] > 1000
    assert difference["coverage"] <= 2
    assert difference["background"] == 0


def test_a_shared_edge_is_drawn_once() -> None:
    """The reference's top-left rule: two triangles through pixel centres leave no gap, and each pixel has one owner."""
    world = np.array([(-1.0, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    whole = float_raster.rasterise(world, np.array([(0, 1, 2), (0, 2, 3)]), world[:, :2], np.eye(4), (8, 8))
    parts = [
        float_raster.rasterise(world, np.array([t]), world[:, :2], np.eye(4), (8, 8)) for t in ((0, 1, 2), (0, 2, 3))
    ]
    assert whole.coverage.all()
    assert parts[0].coverage.sum() + parts[1].coverage.sum() == 64


def test_pose_blend_shapes_move_vertices(gl: Any, person: Any, camera: Camera) -> None:
    """An offset of 0.2 m along x for feature 7 shifts the whole picture."""
    posedirs = np.zeros((len(person.body.v_template), 3, 486), np.float32)
    posedirs[:, 0, 7] = 0.1
    mesh = SkinnedMesh(gl, person.arrays, posedirs)
    feature = np.zeros(486, np.float32)
    feature[7] = 2.0
    joints, views = person.pose(REST), camera((0, 0.9, 3), (0, 0.9, 0))
    blended = UvRaster(gl, mesh).render(joints, *views, (64, 64), feature)
    moved = joints.copy()
    moved[:, 0, 3] += 0.2 * joints[:, 0, 0]
    plain = UvRaster(gl, person.mesh).render(moved, *views, (64, 64))
    assert (blended[..., 2] != plain[..., 2]).sum() <= 8


@pytest.mark.parametrize("filtering", ["mipmap", "anisotropic"])
def test_mip_maps_smooth_a_texture_that_is_shrunk(gl: Any, person: Any, camera: Camera, filtering: str) -> None:
    """Noise read far away: linear keeps its contrast, MIP maps average it; enlarged, all filters read the same."""
    noise = np.random.default_rng(0).choice([-2.0, 2.0], (512, 512, 4))
    view, joints = camera((0, 0.9, 3), (0, 0.9, 0)), person.pose(REST)
    contrast = {}
    for name in ("linear", filtering):
        packed = PackedPass(gl, 4, ENCODING, deferred=False, filtering=name)
        avatar = PackedAvatar(packed, person.mesh, noise)
        avatar.draw(packed.begin((64, 64)), view[0], Placement(joints, view[1], (0, 0, 64, 64)))
        tensor = np.zeros(64 * 64 * 4, np.uint8)
        packed.read_into((64, 64), tensor)
        covered = (tensor.reshape(-1, 4) != ENCODING.zero_point).any(axis=1)
        contrast[name] = tensor.reshape(-1, 4)[covered].std()
    assert contrast[filtering] < 0.5 * contrast["linear"]


def test_uv_bytes_are_the_uv_image_rounded(gl: Any, person: Any, camera: Camera) -> None:
    """At sides that are no multiple of four too; half a step, and what FP32 leaves of a tie."""
    view, joints, shape = camera((0.4, 1.2, 3), (0, 0.9, 0)), person.pose(random_numbers(1)), (97, 65)
    image = UvRaster(gl, person.mesh).render(joints, *view, shape)
    tensor = np.full(97 * 65 * 2, 77, np.uint8)
    UvBytes(gl, person.mesh).render_into(tensor, joints, *view, shape)
    assert np.abs(tensor.reshape(*shape, 2) - image[..., :2] * 255.0).max() <= 0.5 + 1e-3
    assert not tensor.reshape(*shape, 2)[image[..., 2] == 0].any()


def test_uv_seams_are_never_bridged(gl: Any, camera: Camera) -> None:
    """Two triangles with one edge in space and islands far apart in UV: no pixel reads from between the islands."""
    corners = np.array([[-1, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]], float)
    uv = np.array([[0.05, 0.05], [0.2, 0.05], [0.2, 0.2], [0.8, 0.8], [0.95, 0.95], [0.8, 0.95]])
    joint, weight = np.zeros((4, 4), int), np.eye(1, 4).repeat(4, axis=0)
    arrays = mesh_arrays(corners, np.array([[0, 1, 2], [0, 2, 3]]), uv, np.array([[0, 1, 2], [3, 4, 5]]), joint, weight)
    joints = np.tile(np.eye(3, 4, dtype=np.float32), (55, 1, 1))
    image = UvRaster(gl, SkinnedMesh(gl, arrays)).render(joints, *camera((0, 1, 3), (0, 1, 0)), (128, 128))
    seen = image[image[..., 2] > 0]
    assert len(seen) > 1000
    first = (seen[:, :2] <= 0.2 + 1e-6).all(axis=1)
    assert (first | (seen[:, :2] >= 0.8 - 1e-6).all(axis=1)).all()
    assert 0.4 < first.mean() < 0.6


@pytest.mark.parametrize("deferred", [False, True])
def test_vertices_from_the_cpu_unit_give_the_same_tensor(
    gl: Any, person: Any, neural_texture: Any, camera: Camera, deferred: bool
) -> None:
    """99.9 % of the bytes within one step: positions differ in float32's last bits and by weights left out."""
    view, posed = camera((0.4, 1.2, 3), (0, 0.9, 0)), person.skeleton.pose(random_numbers(2), (0.0, 0.94, 0.0))
    joints, shape = posed.matrices.copy(), (192, 128)
    vertices = np.zeros((len(person.body.v_template), 3), np.float32)
    FrameSkinner(person.body.shape()).skin_into(posed, vertices)
    expected = draw(gl, person.mesh, neural_texture, joints, view, shape, deferred).astype(int)
    packed = PackedPass(gl, 16, ENCODING, deferred)
    avatar = PackedAvatar(packed, PosedMesh(gl, person.arrays), neural_texture)
    avatar.draw(packed.begin(shape), view[0], Placement(joints, view[1], (0, 0, *shape), vertices=vertices))
    tensor = np.zeros(expected.size, np.uint8)
    packed.read_into(shape, tensor)
    assert (expected != ENCODING.zero_point).mean() > 0.1
    assert (np.abs(tensor.reshape(expected.shape) - expected) <= 1).mean() >= 0.999
    with pytest.raises(ValueError, match="vertices"):
        avatar.draw(packed.begin(shape), view[0], Placement(joints, view[1], (0, 0, *shape)))


@pytest.mark.parametrize("deferred", [False, True])
def test_a_level_of_the_mesh_is_drawn_as_a_mesh_of_its_own(
    gl: Any, person: Any, neural_texture: Any, camera: Camera, deferred: bool
) -> None:
    """Every third triangle, with its vertices at the beginning of the whole body's: bit for bit the same."""
    shaped, none = person.body.shape(), np.zeros((1, 54), np.float32)
    faces, uv_faces = (rows[::3].copy() for rows in (person.body.faces, person.body.uv_faces))
    reduced = MeshLevel(faces, uv_faces, none[:, 0], none, none, 0.0).reduced(shaped)
    view, posed = camera((0.4, 1.2, 3), (0, 0.9, 0)), person.skeleton.pose(random_numbers(2), (0.0, 0.94, 0.0))
    vertices, shape = np.zeros((len(shaped.vertices), 3), np.float32), (192, 128)
    FrameSkinner(reduced).skin_into(posed, vertices[: len(reduced.vertices)])
    packed = PackedPass(gl, 16, ENCODING, deferred)
    whole, level = (PosedMesh(gl, arrays) for arrays in (person.arrays, avatar_mesh(reduced)))
    tensors = []
    for avatar, mesh in (
        (PackedAvatar(packed, level, neural_texture), 0),
        (PackedAvatar(packed, whole, neural_texture, coarser=[level]), 1),
    ):
        placement = Placement(posed.matrices, view[1], (0, 0, *shape), vertices=vertices, mesh=mesh)
        avatar.draw(packed.begin(shape), view[0], placement)
        tensors.append(np.zeros(shape[0] * shape[1] * 16, np.uint8))
        packed.read_into(shape, tensors[-1])
    np.testing.assert_array_equal(tensors[0], tensors[1])
    assert (tensors[0] != ENCODING.zero_point).mean() > 0.03
