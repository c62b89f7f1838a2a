"""The default body's clothes and its training samples stay what they were: the committed avatar was trained on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from itertools import count, islice
from typing import Any

import numpy as np
import pytest

from trilane.avatars.bundle import bundle_folder
from trilane.body.body import ShapedBody, load_body
from trilane.body.kinematics import Skeleton
from trilane.shapes import shape_buckets
from trilane.training.clothing.layers import GARMENTS, shoe
from trilane.training.clothing.looks import ANKLES, find_landmarks
from trilane.training.random_poses import ATTITUDES, random_pose
from trilane.training.random_views import BANDS, Cropper, look_at, perspective, random_view
from trilane.training.surface import Smoother, body_arrays, obscurance, shell, smoothstep, vertex_areas

Held = Callable[[str, Any], None]


@pytest.fixture(scope="module")
def shaped() -> ShapedBody:
    return load_body(bundle_folder("default") / "body.npz").shape()


@pytest.fixture(scope="module")
def whole(shaped: ShapedBody) -> Any:
    return body_arrays(shaped)


def test_body_arrays(held: Held, whole: Any) -> None:
    for field in fields(whole):
        held(field.name, getattr(whole, field.name))


def test_landmarks(held: Held, whole: Any) -> None:
    landmarks = find_landmarks(whole.vertices, whole.joints, whole.weights)
    for field in fields(landmarks):
        held(field.name, getattr(landmarks, field.name))


@pytest.mark.parametrize("name", GARMENTS)
def test_garments(held: Held, whole: Any, name: str) -> None:
    """On the body, and on points all over it, where no shell hides a term."""
    landmarks = find_landmarks(whole.vertices, whole.joints, whole.weights)
    covers, thickness = GARMENTS[name]
    around = np.random.default_rng(5).uniform((-1, -1.2, -0.3), (1, 0.7, 0.3), (3000, 3))
    for where, points in (("body", whole.vertices), ("around", around)):
        offset, least, rounds = thickness(points, landmarks)
        held(f"{where} covers", covers(points, landmarks))
        held(f"{where} offset", offset)
        held(f"{where} least", least)
        held(f"{where} rounds", rounds)


@pytest.mark.parametrize("sole", [False, True])
@pytest.mark.parametrize("side", [1, -1])
def test_shoes(held: Held, whole: Any, side: int, sole: bool) -> None:
    vertices, faces = shoe(whole.vertices, whole.joints[ANKLES[side]], side, sole)
    held("vertices", vertices)
    held("faces", faces)
    edges = np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    assert set(uses) <= ({2} if sole else {1, 2}), "a sole is closed, an upper is open at the ankle alone"


def test_surface_geometry(held: Held) -> None:
    """On a bumpy sheet of 8 x 8 vertices."""
    rows, columns = np.mgrid[:8, :8].reshape(2, -1).astype(float)
    points = np.stack([columns, 0.3 * np.sin(rows + 0.5 * columns), rows], axis=1)
    first = (8 * np.arange(7)[:, None] + np.arange(7)).ravel()
    faces = np.vstack([np.stack([first, first + 8, first + 1], 1), np.stack([first + 1, first + 8, first + 9], 1)])
    held("areas", vertex_areas(points, faces))
    held("smoothed", Smoother(faces, 64).smooth(points, 3))
    held("shell", shell(points, faces, np.full(64, 0.2), np.linspace(0.1, 0.3, 64), 4))
    normals = np.tile([0.0, 1.0, 0.0], (64, 1))
    held("obscurance", obscurance(points, normals, points + np.array([0.2, 0.4, 0.1]), -normals, np.full(64, 0.3), 1.5))
    assert np.array_equal(smoothstep(1.0, 3.0, np.array([0.0, 1.5, 2.0, 4.0])), [0, 0.25**2 * (3 - 2 * 0.25), 0.5, 1])
    assert smoothstep(3.0, 1.0, np.array([1.5]))[0] == pytest.approx(0.75**2 * (3 - 2 * 0.75))


@pytest.mark.parametrize("attitude", ATTITUDES)
def test_attitudes(held: Held, attitude: str) -> None:
    poses = np.zeros((12, 55, 3))
    for seed, pose in enumerate(poses):
        ATTITUDES[attitude](pose, np.random.default_rng(seed))
    held("poses", poses)


def test_random_poses(held: Held) -> None:
    held("poses", [random_pose(np.random.default_rng((9, number))) for number in range(80)])


@pytest.mark.parametrize("band", [*BANDS, "anywhere"])
def test_random_views(held: Held, shaped: ShapedBody, band: str) -> None:
    views = [random_view(np.random.default_rng((3, number)), band, shaped.joints) for number in range(40)]
    held("view", [view.view for view in views])
    held("projection", [view.projection for view in views])
    held("aspect", [view.aspect for view in views])


def test_a_camera_by_hand() -> None:
    """From (0, 0, 2) to the origin: x to the right, y up, z 2 before it; rolled by 90 degrees up is to the left."""
    eye, at = np.array([0.0, 0.0, 2.0]), np.zeros(3)
    np.testing.assert_allclose(look_at(eye, at) @ [1, 3, 0, 1], [1, 3, -2, 1], atol=1e-12)
    np.testing.assert_allclose(look_at(eye, at, np.pi / 2) @ [1, 3, 0, 1], [3, -1, -2, 1], atol=1e-12)
    clip = perspective(np.pi / 2, 2.0, near=1.0, far=3.0) @ [1.0, 1.0, -1.0, 1.0]
    np.testing.assert_allclose(clip, [0.5, 1.0, -1.0, 1.0], atol=1e-12)
    far = perspective(np.pi / 2, 2.0, near=1.0, far=3.0) @ [0.0, 0.0, -3.0, 1.0]
    assert far[2] / far[3] == pytest.approx(1.0)


def test_crops(held: Held, shaped: ShapedBody) -> None:
    """Of the first twelve views that show the body."""
    skeleton, cropper = Skeleton(shaped.joints, shaped.body.parents), Cropper(shaped)

    def crops() -> Any:
        for number in count():
            rng = np.random.default_rng((4, number))
            posed = skeleton.pose(random_pose(rng))
            view = random_view(rng, "upper_body", posed.joints)
            crop = cropper.crop(posed, view, shape_buckets("256"))
            if crop is not None:
                yield crop

    found = list(islice(crops(), 12))
    held("shapes", [crop.shape for crop in found])
    held("projections", [crop.projection for crop in found])
    held("pixels", [crop.pixels for crop in found])
