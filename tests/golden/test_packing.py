"""The packing, byte for byte: every path, channel and clamp against the float64 oracle `float_raster.quantise`.

Rule: a byte may be one off only where real / scale lies within `TIE` of a rounding tie; elsewhere it is equal.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from support import raster_oracle
from trilane.arrays import F64, U8
from trilane.bench.lib import float_raster
from trilane.bench.raster import SplitPass
from trilane.stages.config import Quantisation
from trilane.stages.gpu.raster import PackedAvatar, PackedPass, Placement
from trilane.stages.gpu.skinned_mesh import MeshArrays, PosedMesh, SkinnedMesh, mesh_arrays
from trilane.training.sample_renderer import UvRaster

TIE = 1e-3
EYE = np.eye(4)
STILL = np.tile(np.eye(3, 4, dtype=np.float32), (55, 1, 1))
ENCODINGS = {
    "of the default avatar's kind": Quantisation(6 / 255, 117),
    "lowest zero point": Quantisation(0.05, 0),
    "highest zero point": Quantisation(0.013, 255),
    "power of two": Quantisation(0.125, 128),
}
PATHS = ("one pass", "deferred", "one pass, posed", "deferred, posed", "split")


def rectangle(x0: float, y0: float, x1: float, y1: float, z: float = 0.0) -> tuple[MeshArrays, F64]:
    """A rectangle in normalised device coordinates, y up, and its vertices; u runs right and v down, 0 to 1."""
    vertices = np.array([(x0, y1, z), (x0, y0, z), (x1, y0, z), (x1, y1, z)])
    uv, faces = np.array([(0.0, 0.0), (0, 1), (1, 1), (1, 0)]), np.array([(0, 1, 2), (0, 2, 3)])
    joint, weight = np.zeros((4, 4), int), np.eye(4)[np.zeros(4, int)]
    return mesh_arrays(vertices, faces, uv, faces, joint, weight), vertices


def packed(gl: Any, path: str, scene: Any, texture: F64, encoding: Quantisation, shape: tuple[int, int]) -> U8:
    """The tensor (h,w,C) that one of `PATHS` gives."""
    arrays, vertices = scene
    mesh = PosedMesh(gl, arrays) if "posed" in path else SkinnedMesh(gl, arrays)
    placement = Placement(STILL, EYE, (0, 0, *shape), vertices=vertices.astype(np.float32))
    tensor = np.full((*shape, texture.shape[2]), 99, np.uint8)
    if path == "split":
        split = SplitPass(gl, mesh, texture, encoding, shape)  # type: ignore[arg-type]
        split.draw(EYE, placement)
        split.read_into(tensor.reshape(-1))
        return tensor
    tensors = PackedPass(gl, texture.shape[2], encoding, deferred="deferred" in path)
    PackedAvatar(tensors, mesh, texture).draw(tensors.begin(shape), EYE, placement)
    tensors.read_into(shape, tensor.reshape(-1))
    return tensor


def tied(real: F64, encoding: Quantisation) -> NDArray[np.bool_]:
    """Where rounding may go either way."""
    return np.asarray(np.abs(real / encoding.scale - np.floor(real / encoding.scale) - 0.5) < TIE)


def assert_bytes(tensor: U8, real: F64, encoding: Quantisation) -> None:
    """`tensor` is `real`, quantised; most of it is no tie, and reaches both clamps and far between them."""
    expected = float_raster.quantise(real, encoding.scale, encoding.zero_point)
    free = ~tied(real, encoding)
    assert free.mean() > 0.9
    assert {0, 255} <= set(expected[free].tolist())
    assert len(np.unique(expected[free])) > 100
    np.testing.assert_array_equal(tensor[free], expected[free])
    assert (np.abs(tensor.astype(int) - expected) <= 1).all()


def texture_through(encoding: Quantisation, shape: tuple[int, int], channels: int, seed: int = 0) -> F64:
    """(h,w,C) as FP16 holds it: q from 40 below 0 to 40 above 255, in every channel."""
    q = np.random.default_rng(seed).uniform(-40, 295, (*shape, channels))
    return ((q - encoding.zero_point) * encoding.scale).astype(np.float16).astype(np.float64)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("name", ENCODINGS)
def test_every_texel_becomes_its_byte(gl: Any, path: str, name: str) -> None:
    """A rectangle over the whole tensor, as large as its texture: pixel centres are texel centres."""
    shape, encoding = (16, 24), ENCODINGS[name]
    texture = texture_through(encoding, shape, 16)
    assert_bytes(packed(gl, path, rectangle(-1, -1, 1, 1), texture, encoding, shape), texture, encoding)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("channels", [4, 8, 12])
def test_fewer_channels_are_packed_alike(gl: Any, path: str, channels: int) -> None:
    shape, encoding = (16, 24), ENCODINGS["of the default avatar's kind"]
    texture = texture_through(encoding, shape, channels, seed=1)
    assert_bytes(packed(gl, path, rectangle(-1, -1, 1, 1), texture, encoding, shape), texture, encoding)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("name", ENCODINGS)
def test_the_background_is_the_zero_point_and_no_more(gl: Any, path: str, name: str) -> None:
    """The rectangle covers 8 x 12 pixels from row 4, column 3: they are the texture, all others the zero point."""
    shape, encoding = (16, 24), ENCODINGS[name]
    texture = texture_through(encoding, (8, 12), 16)
    x0, x1, y0, y1 = 3 / 12 - 1, 15 / 12 - 1, 1 - 12 / 8, 1 - 4 / 8
    tensor = packed(gl, path, rectangle(x0, y0, x1, y1), texture, encoding, shape)
    assert_bytes(tensor[4:12, 3:15], texture, encoding)
    tensor[4:12, 3:15] = encoding.zero_point
    assert (tensor == encoding.zero_point).all()


@pytest.mark.parametrize("path", PATHS)
def test_between_texels_the_texture_is_interpolated_and_clamped_at_its_edge(gl: Any, path: str) -> None:
    """Twice as large as its texture, and at a third of it: shares of 1/4 and 3/4, and of 1/2, which are exact."""
    encoding = Quantisation(1 / 64, 128)
    steps = np.random.default_rng(3).integers(-11, 12, (8, 12, 8)) * 16 + 0.25
    texture = steps * encoding.scale  # sixteenths of these steps are whole numbers and a quarter, never near a tie
    for shape in ((16, 24), (4, 6)):
        column, row = (np.indices(shape)[::-1] + 0.5) / np.array(shape[::-1])[:, None, None]
        real = float_raster.sample(texture, np.stack([column, row], axis=-1))
        tensor = packed(gl, path, rectangle(-1, -1, 1, 1), texture, encoding, shape)
        assert not tied(real, encoding).any()
        np.testing.assert_array_equal(tensor, float_raster.quantise(real, encoding.scale, encoding.zero_point))


@pytest.mark.parametrize("deferred", [False, True], ids=["one pass", "deferred"])
def test_a_bodys_bytes_are_the_oracles_at_its_own_uv(gl: Any, person: Any, camera: Any, deferred: bool) -> None:
    """Where the body is and where its texture is read is taken from the drawn UV image, the bytes from the oracle."""
    encoding, shape = ENCODINGS["of the default avatar's kind"], (160, 96)
    rows, columns = np.indices((64, 64)) * (2 * np.pi / 64)
    waves = [200 * np.sin((1 + c % 3) * rows + c) * np.cos((1 + c % 4) * columns) for c in range(16)]
    texture = (np.stack(waves, axis=-1) * encoding.scale).astype(np.float16).astype(np.float64)
    joints, view = person.pose(np.random.default_rng(5).normal(0, 0.2, 165)), camera((0.8, 1.3, 2.4), (0, 0.9, 0))
    image = UvRaster(gl, person.mesh).render(joints, *view, shape)
    covered = image[..., 2] > 0
    tensors = PackedPass(gl, 16, encoding, deferred)
    avatar = PackedAvatar(tensors, person.mesh, texture)
    avatar.draw(tensors.begin(shape), view[0], Placement(joints, view[1], (0, 0, *shape)))
    tensor = np.zeros((*shape, 16), np.uint8)
    tensors.read_into(shape, tensor.reshape(-1))
    assert covered.sum() > 1000
    assert_bytes(tensor[covered], float_raster.sample(texture, image[covered][:, :2].astype(float)), encoding)
    assert (tensor[~covered] == encoding.zero_point).all()


@pytest.mark.parametrize("deferred", [False, True], ids=["one pass", "deferred"])
def test_a_tensor_is_drawn_anew_each_frame(gl: Any, deferred: bool) -> None:
    """Near before far, far before near, beside each other in one tensor, then an empty one: nothing is left over."""
    encoding, shape = Quantisation(0.5, 7), (8, 16)
    tensors = PackedPass(gl, 4, encoding, deferred)
    near, far = (
        PackedAvatar(tensors, SkinnedMesh(gl, rectangle(-1, -1, 1, 1, z)[0]), np.full((1, 1, 4), level))
        for z, level in ((-0.5, 20.0), (0.5, 60.0))
    )
    for order in ((near, far), (far, near)):
        target = tensors.begin(shape)
        for avatar in order:
            avatar.draw(target, EYE, Placement(STILL, EYE, (0, 0, 8, 8)))
        order[0].draw(target, EYE, Placement(STILL, EYE, (2, 9, 5, 6)))
        tensor = np.zeros((*shape, 4), np.uint8)
        tensors.read_into(shape, tensor.reshape(-1))
        expected = np.full((*shape, 4), 7)
        expected[:, :8], expected[2:7, 9:15] = 47, 47 if order[0] is near else 127
        # A deferred pass keeps only the last u and v of a pixel, so of two that overlap the texture is the last one's.
        if deferred and order[0] is near:
            assert (tensor[:, 8:] == expected[:, 8:]).all()
            continue
        assert (tensor == expected).all()
    tensors.begin(shape)
    tensors.read_into(shape, tensor.reshape(-1))
    assert (tensor == 7).all()


@pytest.mark.parametrize("more", [0, 100, 156])
def test_random_views_are_the_references_and_wrong_bytes_show(
    gl: Any, more: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wider than high: two pixels at edges may be another triangle's. With `more` added to every byte none is near."""

    class Wrong(PackedPass):
        def read_into(self, shape: Any, tensor: Any) -> None:
            super().read_into(shape, tensor)
            tensor += np.uint8(more)

    monkeypatch.setattr(raster_oracle, "PackedPass", Wrong)
    rows = raster_oracle.compare(gl, 3, (64, 96))
    assert rows.shape == (3, 5) and len({*rows[:, 0].tolist()}) == 3, "every view is another"
    for pixels, differ, values, near, wrong in rows:
        assert 50 < pixels < 64 * 96 / 2 and differ <= 2
        assert 16 * (pixels - differ) <= values <= 16 * pixels and values % 16 == 0
        if more:
            assert near <= 2 * 16 and abs(wrong - 16 * (64 * 96 - pixels)) <= 16 * differ
        else:
            assert wrong == 0 and near >= values - 2 * 16
