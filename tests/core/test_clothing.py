"""The clothed body: garments stand off, layers are skinned by the body's weights, everything is finite."""

from __future__ import annotations

import numpy as np
import pytest

from trilane.avatars.bundle import bundle_folder
from trilane.body.body import load_body
from trilane.training.clothing.layers import GARMENTS, MATERIALS, clothing_layers
from trilane.training.clothing.looks import DEFAULT, find_landmarks
from trilane.training.surface import BodyArrays, obscurance, shell, vertex_normals

#: Percentile of a layer's vertices, metres that it stands off the body at least, and the farthest at most. Hair is cut
#: out of a cap that lies close on the face.
STANDOFF = {
    "shirt": (30, 0.015, 0.09),
    "trousers": (30, 0.015, 0.09),
    "hair": (98, 0.020, 0.09),
    "shoe": (50, 0.004, 0.06),
}


@pytest.fixture(scope="module")
def body():
    shaped = load_body(bundle_folder("default") / "body.npz").shape()
    raw = shaped.body
    return BodyArrays(
        shaped.vertices.astype(np.float64),
        raw.faces.astype(np.int64),
        raw.uv.astype(np.float64),
        raw.uv_faces.astype(np.int64),
        raw.weights.astype(np.float64),
        shaped.joints,
    )


@pytest.fixture(scope="module")
def layers(body):
    landmarks = find_landmarks(body.vertices, body.joints, body.weights)
    return {layer.material: layer for layer in clothing_layers(body, landmarks)}


def test_every_material_has_a_layer(layers):
    assert set(layers) == {*DEFAULT.garments, "shoe", "sole", "skin"}
    assert set(MATERIALS) == set(GARMENTS) | {"shoe", "sole", "skin"}


@pytest.mark.parametrize("material", STANDOFF)
def test_layers_stand_off_the_body(layers, material):
    percent, least, most = STANDOFF[material]
    layer = layers[material]
    height = np.linalg.norm(layer.vertices - layer.below, axis=1)
    assert np.percentile(height, percent) >= least
    assert height.max() <= most


@pytest.mark.parametrize("material", ["skin", "shirt", "trousers", "hair"])
def test_layers_have_the_weights_of_the_body_below(body, layers, material):
    number = {tuple(point): index for index, point in enumerate(body.vertices)}
    layer = layers[material]
    below = [number[tuple(point)] for point in layer.below]
    assert np.array_equal(layer.weights, body.weights[below])


def test_weights_sum_to_one_and_all_is_finite(layers):
    for layer in layers.values():
        assert np.allclose(layer.weights.sum(axis=1), 1, atol=1e-5)
        assert all(np.isfinite(part).all() for part in (layer.vertices, layer.normal, layer.light))
        assert layer.light.min() >= 0 and layer.light.max() <= 1 + 1e-9


def test_layers_are_as_they_were(held, layers):
    """Outer ones first."""
    assert list(layers) == ["trousers", "shirt", "hair", "shoe", "sole", "skin"]
    for material, layer in layers.items():
        for name in ("vertices", "faces", "below", "weights", "normal", "light", "mark"):
            held(f"{material} {name}", getattr(layer, name))


def test_shell_keeps_its_distance():
    square = np.array([[x, 0.0, z] for x in range(6) for z in range(6)], np.float64)
    corner = [(6 * x + z, 6 * x + z + 1, 6 * x + z + 6) for x in range(5) for z in range(5)]
    faces = np.array(corner + [(b, b + 6 - 0, c) for _, b, c in corner])
    raised = shell(square, faces, np.full(36, 0.3), np.full(36, 0.25), rounds=5)
    up = np.sign(vertex_normals(square, faces)[:, 1])
    assert ((raised - square)[:, 1] * up >= 0.25 - 1e-9).all()


def test_obscurance_sees_what_stands_before_it():
    point, up, down = np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0]]), np.array([[0.0, -1.0, 0.0]])
    above = np.array([[0.0, 0.05, 0.0]])
    area = np.array([0.01])
    assert obscurance(point, up, above, down, area, 0.25)[0] < 0.7
    assert obscurance(point, down, above, down, area, 0.25)[0] == 1.0
    assert obscurance(point, up, above * 100, down, area, 0.25)[0] == 1.0
