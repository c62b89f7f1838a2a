"""The clothed body: garments stand off, layers are skinned by the body's weights, everything is finite."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from itertools import count, islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from trilane.arrays import shape_buckets
from trilane.avatars.bundle import bundle_folder
from trilane.body.body import ShapedBody, load_body
from trilane.body.joints import JOINT_INDEX, Skeleton
from trilane.errors import BadInputError
from trilane.scene.motion.builtin import BUILTIN
from trilane.training import clothing, subject
from trilane.training.clothing import (
    ANKLES,
    DANCER,
    DEFAULT,
    GARMENTS,
    HANGING,
    HIKER,
    LOOKS,
    clothing_layers,
    find_landmarks,
    look_named,
    look_of,
)
from trilane.training.random_views import (
    ATTITUDES,
    BANDS,
    ClothedSurface,
    Cropper,
    look_at,
    perspective,
    random_pose,
    random_view,
)
from trilane.training.surface import (
    ANGLES,
    BodyArrays,
    Smoother,
    body_arrays,
    obscurance,
    shell,
    shoe,
    smoothstep,
    vertex_areas,
    vertex_normals,
)

#: Percentile of a layer's vertices, metres that it stands off the body at least, and the farthest at most. Hair is cut
#: out of a cap that lies close on the face.
STANDOFF = {
    "shirt": (30, 0.015, 0.09),
    "trousers": (30, 0.015, 0.09),
    "hair": (98, 0.020, 0.09),
    "shoe": (50, 0.004, 0.06),
}


@pytest.fixture(scope="module")
def whole(body: ShapedBody) -> BodyArrays:
    return body_arrays(body)


@pytest.fixture(scope="module")
def layers(whole):
    landmarks = find_landmarks(whole.vertices, whole.joints, whole.weights)
    return {layer.material: layer for layer in clothing_layers(whole, landmarks)}


@pytest.mark.parametrize("material", STANDOFF)
def test_layers_stand_off_the_body(layers, material):
    percent, least, most = STANDOFF[material]
    layer = layers[material]
    height = np.linalg.norm(layer.vertices - layer.below, axis=1)
    assert np.percentile(height, percent) >= least
    assert height.max() <= most


@pytest.mark.parametrize("material", ["skin", "shirt", "trousers", "hair"])
def test_layers_have_the_weights_of_the_body_below(whole, layers, material):
    number = {tuple(point): index for index, point in enumerate(whole.vertices)}
    layer = layers[material]
    below = [number[tuple(point)] for point in layer.below]
    assert np.array_equal(layer.weights, whole.weights[below])


def check_layers(layers: Any, outer_first: list[str]) -> None:
    assert list(layers) == outer_first
    for layer in layers.values():
        assert np.allclose(layer.weights.sum(axis=1), 1, atol=1e-5) and layer.weights.min() >= 0
        assert all(np.isfinite(part).all() for part in (layer.vertices, layer.normal, layer.light))
        assert layer.light.min() >= 0 and layer.light.max() <= 1 + 1e-9


def test_layers_are_as_they_were(held, layers):
    check_layers(layers, ["trousers", "shirt", "hair", "shoe", "sole", "skin"])
    for material, layer in layers.items():
        for name in ("vertices", "faces", "below", "weights", "normal", "light", "mark"):
            held(f"{material} {name}", getattr(layer, name))


def test_obscurance_sees_what_stands_before_it():
    point, up, down = np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0]]), np.array([[0.0, -1.0, 0.0]])
    above = np.array([[0.0, 0.05, 0.0]])
    area = np.array([0.01])
    assert obscurance(point, up, above, down, area, 0.25)[0] < 0.7
    assert obscurance(point, down, above, down, area, 0.25)[0] == 1.0
    assert obscurance(point, up, above * 100, down, area, 0.25)[0] == 1.0


# The default body's clothes and its training samples stay what they were: the committed avatar was trained on them.

Held = Callable[[str, Any], None]


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
def test_random_views(held: Held, body: ShapedBody, band: str) -> None:
    views = [random_view(np.random.default_rng((3, number)), band, body.joints) for number in range(40)]
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


def test_crops(held: Held, body: ShapedBody) -> None:
    """Of the first twelve views that show the body."""
    skeleton, cropper = Skeleton(body.joints, body.body.parents), Cropper(body)

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


# The dancer: what hangs off her body is as far from it as cloth and hair are, and moves with it.


@pytest.fixture(scope="module")
def dancing() -> ShapedBody:
    return load_body(bundle_folder("default") / "body.npz").shape(DANCER.betas)


@pytest.fixture(scope="module")
def worn(dancing: ShapedBody) -> Any:
    """Layers by material. Their obscurance is coarse, which takes a third of the time."""
    arrays = body_arrays(dancing)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clothing, "EMITTERS", 600)
        found = clothing_layers(arrays, find_landmarks(arrays.vertices, arrays.joints, arrays.weights), DANCER)
    return {layer.material: layer for layer in found}


def uses_of_edges(faces: Any) -> Any:
    """Edges (E,2) and how many faces have each."""
    edges = np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(edges, axis=0, return_counts=True)


def test_all_that_the_dancer_wears_is_whole(worn: Any) -> None:
    check_layers(worn, ["blouse", "skirt", "cap", "long_hair", "shoe", "sole", "skin"])


def test_the_skirt_is_one_tube_around_both_legs(dancing: ShapedBody, worn: Any) -> None:
    """Open at hem and waist alone. All of the legs is 15 mm inside of it; where legs part, it goes around the gap."""
    layer = worn["skirt"]
    edges, uses = uses_of_edges(layer.faces)
    rings = layer.vertices.reshape(-1, ANGLES, 3)
    assert set(uses) == {1, 2} and (uses == 1).sum() == 2 * ANGLES
    assert set(edges[uses == 1].ravel() // ANGLES) == {0, len(rings) - 1}
    body = dancing.vertices
    legs = np.abs(body[:, 0]) < 0.3
    for ring in rings:
        centre = ring.mean(axis=0)
        inside = body[legs & (np.abs(body[:, 1] - centre[1]) < 0.008)] - centre
        around = ring - centre
        turn, radius = np.arctan2(around[:, 0], around[:, 2]), np.hypot(around[:, 0], around[:, 2])
        limit = np.interp(np.arctan2(inside[:, 0], inside[:, 2]), turn, radius, period=2 * np.pi)
        assert (limit - np.hypot(inside[:, 0], inside[:, 2])).min() > 0.012
    hem = rings[0]
    knee = dancing.joints[JOINT_INDEX["left_knee"]]
    assert hem[0, 1] == pytest.approx(knee[1] + 0.02, abs=1e-9) and np.ptp(hem[:, 0]) > 2 * knee[0] + 0.15


def test_no_leg_shows_through_the_skirt_in_a_walk(dancing: ShapedBody, worn: Any) -> None:
    """Of the walk and the wave. In the turn after them thighs cross, and cloth folds between them."""
    layer, skeleton = worn["skirt"], Skeleton(dancing.joints, dancing.body.parents)
    hem, hip = layer.vertices[:, 1].min(), dancing.joints[JOINT_INDEX["left_hip"], 1]
    height, legs = dancing.vertices[:, 1], np.abs(dancing.vertices[:, 0]) < 0.3
    hidden = legs & (height > hem + 0.03) & (height < hip + 0.05)
    cloth, skin = ClothedSurface([layer]), ClothedSurface([worn["skin"]])
    for pose in BUILTIN["walk-wave-turn"]().poses[:350:25]:
        posed = skeleton.pose(pose)
        surface, points = cloth.posed(posed), skin.posed(posed)[hidden]
        nearest = cKDTree(surface).query(points)[1]
        out = np.einsum("ij,ij->i", points - surface[nearest], vertex_normals(surface, layer.faces)[nearest])
        assert out.max() < -0.008


def test_long_hair_is_a_closed_sheet_that_stands_off_the_back(dancing: ShapedBody, worn: Any) -> None:
    """Closed where outside and inside meet; behind the face; 3 to 9 cm off the skin of the back."""
    layer, joints = worn["long_hair"], dancing.joints
    _, same = np.unique(np.round(layer.vertices, 6), axis=0, return_inverse=True)
    faces = same.reshape(-1)[layer.faces]
    apart = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    _, uses = uses_of_edges(faces[apart])
    assert set(uses) <= {2, 4}, "an edge of 2 faces, or one of outside and inside at an end"
    neck, eye = joints[JOINT_INDEX["neck"]], joints[JOINT_INDEX["left_eye"]]
    assert layer.vertices[:, 1].min() == pytest.approx(neck[1] - 0.20 - 0.035, abs=0.003)
    assert layer.vertices[:, 2].max() < eye[2] - 0.04
    outside = layer.vertices.reshape(-1, ANGLES, 3)[:, : ANGLES // 2].reshape(-1, 3)
    behind = outside[(np.abs(outside[:, 0]) < 0.05) & (outside[:, 1] < neck[1])]
    off = cKDTree(dancing.vertices).query(behind)[0]
    assert off.min() > 0.065 and off.max() < 0.09 and len(off) > 50


def test_long_hair_turns_with_the_head_above_and_stays_on_the_back_below(worn: Any) -> None:
    layer = worn["long_hair"]
    order = np.argsort(layer.vertices[:, 1])
    assert (layer.weights[order[-200:], JOINT_INDEX["head"]] == 1).all()
    assert (layer.weights[order[:200], JOINT_INDEX["spine3"]] == 1).all()


# Looks: what a look says is what the shader is compiled with, and the avatar of a look says whose it is.


@pytest.mark.parametrize("look", LOOKS.values(), ids=LOOKS)
def test_a_look_is_complete(look: Any) -> None:
    """The same colours for all, each within sRGB; garments that there are; no more coefficients than a body has."""
    assert set(look.colours) == set(DEFAULT.colours) and set(look.garments) <= set(GARMENTS) | set(HANGING)
    assert all(0 <= share <= 1 for colour in look.colours.values() for share in colour)
    assert len(look.betas) <= 10


def test_where_legs_end_is_measured_from_the_joint_of_the_look(whole: Any) -> None:
    """Over the ankle: 20 mm for trousers that end 20 mm over it, the shin and 55 mm for shorts."""
    landmarks = find_landmarks(whole.vertices, whole.joints, whole.weights)
    assert DEFAULT.definitions(landmarks)["LEGS_END"] == "(0.02)"
    shin = whole.joints[4, 1] - whole.joints[7, 1]
    found = HIKER.definitions(landmarks)
    assert float(found["LEGS_END"].strip("()")) == pytest.approx(shin + 0.055, abs=1e-12) and shin > 0.3
    assert (found["SLEEVE_END"], found["SKIN"]) == ("(1.8)", "vec3(0.53, 0.35, 0.25)")


def test_an_avatar_says_whose_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    monkeypatch.setattr(subject, "SampleRenderer", lambda shaped, look, **_: made.append((shaped, look)))
    monkeypatch.setattr(subject, "load_body", {Path("b"): SimpleNamespace(shape=lambda betas: betas)}.__getitem__)
    hiker = subject.clothed_subject(Path("b"), 2, "hiker")
    assert hiker.person == subject.Person(Path("b"), HIKER.betas) and made == [(HIKER.betas, HIKER)]
    assert look_of(hiker.facts) is HIKER and hiker.source.args[:2] == (Path("b"), "hiker")  # type: ignore[attr-defined]
    assert look_of(subject.clothed_subject(Path("b"), 2).facts) is DEFAULT
    assert look_of({}) is DEFAULT, "avatars that were trained before there were looks"
    with pytest.raises(BadInputError, match="expected one of default, hiker, dancer"):
        look_named("nobody")
