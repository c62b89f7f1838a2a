"""Offsets measured on a sphere that wears a shell: what an outline shows is known in closed form."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("scipy", reason="measuring outlines needs the train extra")

from trilane.body.joints import JOINTS
from trilane.training import subject as module
from trilane.training.random_views import look_at, perspective
from trilane.training.subject import Outline, measured_heights, smoothed, stand_off

RADIUS, SHELL, DISTANCE = 0.5, 0.03, 12.0
ROWS = 400
FOV = 2 * np.arctan(0.7 / DISTANCE)
#: Pixels of a metre in the plane through the middle of the sphere.
PX_PER_M = ROWS / (2 * DISTANCE * np.tan(FOV / 2))
#: A shell's outline is not over the sphere's own by the angle between their tangents, less than (R + h) / D: the
#: height is off by the cosine of it, and a bilinear read by a quarter of a pixel.
TOLERANCE_M = SHELL * (RADIUS + SHELL) / DISTANCE + 0.25 / PX_PER_M + 0.2**2 / 2 * RADIUS


def sphere(rings: int = 24, around: int = 48) -> Any:
    """A sphere that the first joint moves; poles are at the top and at the bottom."""
    angle = np.linspace(0, np.pi, rings + 1)[1:-1]
    turn = np.linspace(0, 2 * np.pi, around, endpoint=False)
    ring = np.stack(np.broadcast_arrays(
        np.sin(angle)[:, None] * np.cos(turn), np.cos(angle)[:, None], np.sin(angle)[:, None] * np.sin(turn)
    ), axis=-1).reshape(-1, 3)  # fmt: skip
    vertices = RADIUS * np.concatenate([ring, [[0, 1, 0], [0, -1, 0]]])
    faces, top = [], len(ring)
    for row in range(rings - 2):
        for column in range(around):
            a, b = row * around + column, row * around + (column + 1) % around
            faces += [(a, b, a + around), (b, b + around, a + around)]
    for column in range(around):
        other = (column + 1) % around
        last = (rings - 2) * around
        faces += [(top, other, column), (last + column, last + other, top + 1)]
    weights = np.zeros((len(vertices), JOINTS), np.float32)
    weights[:, 0] = 1
    body = SimpleNamespace(faces=np.array(faces), weights=weights, posedirs=None, offsets=None, skin=None)
    return SimpleNamespace(vertices=vertices.astype(np.float32), body=body)


def disc(radius: float, centre: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """The coverage in 0..1 of each pixel by a sphere of `radius`, whose middle is `centre` metres right and up."""
    place = (np.arange(ROWS) + 0.5 - ROWS / 2) / PX_PER_M
    across = np.hypot(place[None] - centre[0], -place[:, None] - centre[1])
    outline = radius * DISTANCE / np.sqrt(DISTANCE**2 - radius**2)
    return np.clip((outline - across) * PX_PER_M + 0.5, 0, 1).astype(np.float32)


def outline(eye: tuple[float, float, float], shell: float = SHELL, **parts: Any) -> Outline:
    joints = np.tile(np.eye(4)[:3], (JOINTS, 1, 1))
    view = look_at(DISTANCE * np.array(eye) / np.linalg.norm(eye), np.zeros(3))
    pictures = {"covered": disc(RADIUS) > 0.5, "mask": disc(RADIUS + shell)} | parts
    return Outline(joints, None, view, perspective(FOV, 1.0), **pictures)


def normals(shaped: Any) -> np.ndarray:
    return np.asarray(shaped.vertices / RADIUS, np.float64)


@pytest.mark.parametrize("shell", [0.03, 0.07, 0.0, -0.012])
def test_the_end_of_the_mask_is_found_where_the_surface_turns_away(shell: float) -> None:
    shaped = sphere()
    number, height, weight = measured_heights(shaped, normals(shaped), outline((0, 0, 1), shell))
    assert len(number) > 40
    assert np.abs(normals(shaped)[number, 2]).max() < 0.2 + (RADIUS + SHELL) / DISTANCE
    np.testing.assert_allclose(height, shell, atol=TOLERANCE_M)
    np.testing.assert_allclose(weight, PX_PER_M, rtol=0.1)


def test_what_lies_behind_another_limb_or_outside_of_the_picture_is_not_measured() -> None:
    """A limb covers the right side, a wide coat the picture's upper edge."""
    shaped = sphere()
    limb = disc(0.1, (RADIUS + 0.14, 0.0)) > 0.5
    coat = np.maximum(disc(RADIUS + SHELL), disc(0.12, (RADIUS + 0.1, 0.0)))
    coat[: ROWS // 2, 150:250] = 1
    number, height, _ = measured_heights(
        shaped, normals(shaped), outline((0, 0, 1), covered=(disc(RADIUS) > 0.5) | limb, mask=coat)
    )
    at = normals(shaped)[number]
    assert not ((at[:, 0] > 0.99) | (at[:, 1] > 0.98)).any() and len(number) > 20
    np.testing.assert_allclose(height, SHELL, atol=TOLERANCE_M)


def test_offsets_are_the_shell_and_one_wrong_mask_changes_nothing() -> None:
    shaped = sphere()
    eyes = [(np.sin(a), b, np.cos(a)) for a in np.arange(12) * np.pi / 6 for b in (-0.5, 0.1, 0.6)]
    views = [outline(eye) for eye in eyes] + [outline((1, 0.2, 0.3), 0.09)]
    found = stand_off(shaped, views)
    assert found.measured > 0.9 and found.offsets.dtype == np.float32
    np.testing.assert_allclose(found.offsets, SHELL * normals(shaped), atol=TOLERANCE_M)


def test_offsets_are_added_to_those_that_the_body_is_drawn_with() -> None:
    shaped = sphere()
    shaped.body.offsets = np.full_like(shaped.vertices, 0.5)
    eyes = [(np.sin(a), 0.3, np.cos(a)) for a in np.arange(8) * np.pi / 4]
    bare = stand_off(sphere(), [outline(eye) for eye in eyes]).offsets
    np.testing.assert_allclose(stand_off(shaped, [outline(eye) for eye in eyes]).offsets, bare + 0.5, atol=1e-6)


def test_a_garment_stays_where_it_is() -> None:
    """The second half of the vertices is a garment: only the skin is raised to the mask."""
    shaped = sphere()
    half = len(shaped.vertices) // 2
    shaped.body.skin = (half, 1)
    eyes = [(np.sin(a), b, np.cos(a)) for a in np.arange(12) * np.pi / 6 for b in (-0.5, 0.1, 0.6)]
    offsets = stand_off(shaped, [outline(eye) for eye in eyes]).offsets
    assert not offsets[half:].any()
    np.testing.assert_allclose(offsets[:half], SHELL * normals(shaped)[:half], atol=TOLERANCE_M)


def test_a_joint_moves_what_is_measured() -> None:
    """The sphere and its camera are moved by the same, so the picture is the same."""
    shaped, moved = sphere(), outline((0, 0, 1))
    shift = np.array([3.0, -2.0, 5.0])
    joints = np.array(moved.joints)
    joints[0, :, 3] = shift
    view = moved.view.copy()
    view[:3, 3] -= view[:3, :3] @ shift
    one = measured_heights(shaped, normals(shaped), moved)
    other = measured_heights(shaped, normals(shaped), moved._replace(joints=joints, view=view))
    np.testing.assert_array_equal(one[0], other[0])
    np.testing.assert_allclose(one[1], other[1], atol=1e-6)


def test_between_measurements_offsets_are_harmonic_and_a_part_without_any_has_none() -> None:
    """Two triangles with a common edge, and one apart. The minimum of (x0 - 1)^2 + (x3 - 4)^2 + 0.6 times the squares
    over the edges 01, 02, 12, 13, 23: by symmetry x1 = x2 = 2.5, and x0 = (1 + 1.2 * 2.5) / 2.2."""
    faces = np.array([(0, 1, 2), (1, 3, 2), (4, 5, 6)])
    found = smoothed(np.array([1.0, 9.0, 9.0, 4.0, 0, 0, 0]), np.array([1.0, 0, 0, 1, 0, 0, 0]), faces)
    np.testing.assert_allclose(found, [4 / 2.2, 2.5, 2.5, 5 - 4 / 2.2, 0, 0, 0], atol=1e-5)


def test_what_measuring_takes_is_said_by_four_views(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four of 300 took 2 s, so three rounds of all take 3 * 300 / 4 * 2 = 450 s."""
    times, drawn = iter((10.0, 12.0)), []

    def draw(_: Any, samples: Any) -> Any:
        drawn.extend(samples)
        return [outline((0, 0, 1)) for _ in samples]

    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: next(times)))
    monkeypatch.setattr(module, "outlines", draw)
    said = module._cost(SimpleNamespace(shaped=sphere()), range(300))  # type: ignore[arg-type]
    assert drawn == [0, 75, 150, 225]
    assert said == "how far clothes and hair stand off: 300 views, 3 times: about 450 s (by 4 that were measured)"
