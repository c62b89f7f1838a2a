"""A camera that is turned about what it looks at, against a camera that was put there by hand."""

from __future__ import annotations

import numpy as np
import pytest

from trilane.arrays import F64
from trilane.scene.camera.path import look_at
from trilane.scene.camera_placement import HIGHEST_DEG, LOWEST_DEG, steered

PIVOT: F64 = np.array([1.0, 0.9, -2.0])


def placed(azimuth_deg: float, elevation_deg: float, distance_m: float) -> F64:
    """A level camera that looks at the pivot from there; at 0, 0 from along +Z."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    arm = np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    return look_at(PIVOT + distance_m * arm, PIVOT)


@pytest.mark.parametrize(
    ("start", "turn", "zoom", "end"),
    [
        ((0, 0, 4), (90, 0), 1.0, (90, 0, 4)),
        ((30, 10, 4), (-75, 20), 1.0, (-45, 30, 4)),
        ((30, 10, 4), (0, 0), 2.0, (30, 10, 2)),
        ((-100, 40, 3), (200, -30), 0.5, (100, 10, 6)),
        ((20, 30, 4), (0, 500), 1.0, (20, HIGHEST_DEG, 4)),
        ((20, 30, 4), (5, -500), 1.0, (25, LOWEST_DEG, 4)),
        ((20, -30, 4), (0, -10), 1.0, (20, -30, 4)),
    ],
)
def test_a_camera_that_looks_at_the_pivot_is_where_it_would_be_put(
    start: tuple[float, float, float], turn: tuple[float, float], zoom: float, end: tuple[float, float, float]
) -> None:
    np.testing.assert_allclose(steered(placed(*start), PIVOT, *turn, zoom), placed(*end), atol=1e-12)


def test_without_a_turn_the_view_keeps_every_bit() -> None:
    view = placed(33, 7, 3.3)
    assert steered(view, PIVOT, 0.0, 0.0, 1.0).tobytes() == view.tobytes()


def test_a_camera_that_looks_past_the_pivot_keeps_it_at_the_same_place_of_the_picture() -> None:
    view = look_at(np.array([2.0, 1.5, 2.0]), np.array([0.0, 1.2, 0.5]))
    before = view[:3, :3] @ PIVOT + view[:3, 3]
    turned = steered(view, PIVOT, 40.0, 15.0, 1.0)
    np.testing.assert_allclose(turned[:3, :3] @ PIVOT + turned[:3, 3], before, atol=1e-12)
    nearer = steered(view, PIVOT, 40.0, 15.0, 3.0)
    np.testing.assert_allclose(nearer[:3, :3] @ PIVOT + nearer[:3, 3], before / 3, atol=1e-12)
    np.testing.assert_allclose(turned[:3, :3] @ turned[:3, :3].T, np.eye(3), atol=1e-12)


def test_a_camera_over_the_pivot_turns_about_the_vertical_alone() -> None:
    view = np.eye(4)
    view[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # looks down
    view[:3, 3] = -view[:3, :3] @ (PIVOT + np.array([0, 3, 0]))
    turned = steered(view, PIVOT, 90.0, 20.0, 1.0)
    np.testing.assert_allclose(turned[:3, :3] @ PIVOT + turned[:3, 3], [0, 0, -3], atol=1e-12)
    assert np.isfinite(turned).all()
