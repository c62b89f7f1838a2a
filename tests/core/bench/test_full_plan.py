"""The parts of the plan `full` against closed forms and second implementations: body, supersampled raster, network."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from onnx import numpy_helper

from support.small_inputs import net
from trilane.arrays import F64
from trilane.avatars.bundle import bundle_folder, load_bundle
from trilane.avatars.network_file import check_network, reshaped
from trilane.bench.lib import full_picture
from trilane.bench.lib.full_picture import SAMPLES, FullBody, supersampled
from trilane.body.body import load_body
from trilane.body.joints import Skeleton
from trilane.body.skinning import CpuSkinner
from trilane.stages.gpu.skinned_mesh import MeshArrays, avatar_mesh

EYE = np.eye(4)


def test_the_body_is_that_of_the_other_skinner_with_every_blend_shape() -> None:
    """`CpuSkinner` rounds joints, rest shape and features to float32: at two metres that is less than 2 µm."""
    rng = np.random.default_rng(1)
    body = load_body(bundle_folder("default") / "body.npz")
    count = len(body.v_template)
    blend = np.zeros((count, 3, 486), np.float32)
    blend[:300] = rng.normal(0, 1e-4, (300, 3, 486))
    body = replace(
        body,
        posedirs=blend,
        shape_dirs=rng.normal(0, 0.01, (count, 3, 10)).astype(np.float32),
        expression_dirs=rng.normal(0, 0.01, (count, 3, 10)).astype(np.float32),
    )
    betas, expression = rng.normal(size=10), rng.normal(size=4)
    pose, translation = rng.normal(0, 0.5, (55, 3)), rng.normal(size=3)
    world = EYE.copy()
    world[:3] = [[0, 0, 1, 0.3], [0, 1, 0, -0.2], [-1, 0, 0, 0.7]]
    shaped = body.shape(betas, expression)
    posed = Skeleton(shaped.joints, body.parents).pose(pose, translation, world)
    own = FullBody(body, betas.tolist(), expression.tolist()).vertices(pose, translation, world)
    assert np.abs(own - CpuSkinner(shaped).vertices(posed)).max() < 2e-6
    plain = FullBody(replace(body, posedirs=None), betas.tolist(), expression.tolist())
    assert np.abs(own - plain.vertices(pose, translation, world)).max() > 1e-3


def flat(corners: F64) -> MeshArrays:
    """One triangle, whose u and v run from 0 to 1 over the tensor."""
    uv = np.stack([(corners[:, 0] + 1) / 2, (1 - corners[:, 1]) / 2], axis=-1)
    return MeshArrays(
        position=corners.astype(np.float32),
        uv=uv.astype(np.float32),
        joint=np.zeros((3, 4), np.uint8),
        weight=np.eye(1, 4, dtype=np.float32).repeat(3, axis=0),
        triangles=np.array([[0, 1, 2]], np.uint32),
        source=np.arange(3),
    )


@pytest.mark.parametrize("seed", range(8))
def test_a_flat_triangle_covers_its_area(seed: int) -> None:
    """A half-plane that holds the middle of a cell holds half of the cell: each cell on the rim is off by half at most.

    An edge meets at most as many cells as it crosses grid lines, and one more.
    """
    shape = (32, 64)
    corners = np.c_[np.random.default_rng(seed).uniform(-0.95, 0.95, (3, 2)), np.zeros(3)]
    tensor = supersampled(corners, flat(corners), EYE, shape, np.ones((4, 4, 3), np.float32))
    place = np.stack([(corners[:, 0] + 1) / 2 * shape[1], (1 - corners[:, 1]) / 2 * shape[0]], axis=-1)
    first, second = place[1] - place[0], place[2] - place[0]
    area = abs(first[0] * second[1] - first[1] * second[0]) / 2
    cells = sum(np.ceil(np.abs(b - a) * SAMPLES).sum() + 1 for a, b in pairwise([*place, place[0]]))
    assert abs(tensor[..., 0].sum() - area) <= cells / 2 / SAMPLES**2
    assert set((tensor * SAMPLES**2).ravel().tolist()) <= set(range(SAMPLES**2 + 1))
    assert np.array_equal(tensor[..., 0], tensor[..., 2])


def test_a_tensor_pixel_is_read_around_its_middle() -> None:
    """The mean of a ramp over points that lie evenly around a pixel's middle is the ramp there: nothing is shifted."""
    corners = np.array([[-3.0, -1, 0], [1, 3, 0], [1, -1, 0]])
    side, shape = 16, (8, 12)
    ramp = (np.arange(side) + 0.5) / side
    texture = np.stack(np.meshgrid(ramp, ramp), axis=-1).astype(np.float32)
    tensor = supersampled(corners, flat(corners), EYE, shape, texture)
    row, column = np.indices(shape)
    clear = (column >= 1) & (column <= 10) & (row >= 1) & (row <= 6)
    expected = np.stack([(column + 0.5) / shape[1], (row + 0.5) / shape[0]], axis=-1)
    assert np.abs(tensor - expected)[clear].max() < 1e-6


def test_the_integer_network_without_rounding_is_its_own_formula() -> None:
    """Two convolutions between the ranges of the bytes; the integer network is as far off as its steps allow."""
    model = net()
    network = reshaped(check_network(model, "net"), 32, 32)
    bytes_in = np.random.default_rng(4).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    real = (bytes_in - 7.0) * 0.5
    weights = {t.name: numpy_helper.to_array(t) for t in model.graph.initializer if t.name in ("w1", "w2")}
    first, second = (0.01 * weights[name][..., 0, 0].astype(float) for name in ("w1", "w2"))
    middle = np.clip(real @ first.T, (0 - 100) * 0.125, (255 - 100) * 0.125)
    expected = np.clip(middle @ second.T, (0 - 11) * 0.25, (255 - 11) * 0.25)
    assert (np.abs(middle @ second.T - expected) > 0).any() and (np.abs(real @ first.T - middle) > 0).any()
    own = full_picture.dequantised(network)(real)
    assert np.abs(own - expected).max() < 1e-3
    session = onnxruntime.InferenceSession(network.model.SerializeToString(), providers=["CPUExecutionProvider"])
    integer = (session.run(None, {"bytes": bytes_in[None]})[0][0] - 11.0) * 0.25
    bound = 0.25 / 2 + np.abs(second).sum(axis=1) * 0.125 / 2
    assert (np.abs(integer - own) <= bound + 1e-3).all()
    assert np.abs(integer - own).max() > 0.1


def test_the_float_network_is_known_by_the_digest_of_the_manifest(drawable_bundle: Path) -> None:
    bundle = load_bundle("default")
    found = full_picture.float_weights(bundle)
    assert found is not None and found.name == "default-network.npz"
    validation = bundle.manifest.validation
    assert validation is not None and validation.model_extra is not None
    changed = validation.model_copy(update={"float": {"network": f"{found.name}, sha256 {'0' * 64}"}})
    other = replace(bundle, manifest=bundle.manifest.model_copy(update={"validation": changed}))
    assert full_picture.float_weights(other) is None
    tiny = load_bundle(drawable_bundle)
    assert full_picture.float_weights(tiny) is None
    paint, said = full_picture.float_network(tiny)
    assert "nothing rounded" in said
    assert paint(np.zeros((32, 64, 4))).shape == (32, 64, 4)


def test_the_trained_network_paints_a_person_where_the_body_is() -> None:
    """In the T pose, straight on: the mask is the body with its clothes, the right way round."""
    pytest.importorskip("torch")
    bundle = load_bundle("default")
    paint, said = full_picture.float_network(bundle)
    assert "default-network.npz" in said
    body = FullBody(load_body(bundle.body_path))
    clip = EYE.copy()
    clip[2, 2] = -0.1
    clip[1, 3] = -body.rest[:, 1].mean()
    mesh = avatar_mesh(load_body(bundle.body_path).shape())
    tensor = supersampled(body.rest, mesh, clip, (160, 160), bundle.read_texture())
    rgba = paint(tensor)
    assert rgba.shape == (160, 160, 4) and rgba.min() >= 0 and rgba.max() <= 1
    mask, body_seen = rgba[..., 3] > 0.5, (tensor != 0).any(axis=-1)
    assert (mask & body_seen).sum() > 0.75 * (mask | body_seen).sum()
    assert (mask[::-1] & body_seen).sum() < 0.6 * (mask | body_seen).sum()
