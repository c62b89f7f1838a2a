"""Turns from directions, by hand: frames, least turns between any two directions, means of turns, twists of limbs."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trilane.scene.motion.tracks import angle_between, unit
from trilane.scene.motion.turns import frames_along, hinge, least_turns, level_with, limb_turns, mean_turn
from trilane.scene.rotations import about

X, Y, Z = np.eye(3)


def test_frames_are_rotations_with_one_direction_exact() -> None:
    left, up = np.array([[2.0, 0, 0], [0, 0, -3], [0, 0, -1]]), np.array([[1.0, 5, 0], [0, 1, 0], [0, 0, 4]])
    for first, exact, other in (("left", left, up), ("up", up, left)):
        frames = frames_along(exact, other, first)
        assert np.linalg.det(frames) == pytest.approx(1)
        assert frames @ np.swapaxes(frames, 1, 2) == pytest.approx(np.tile(np.eye(3), (3, 1, 1)))
        assert frames[:, :, 0 if first == "left" else 1] == pytest.approx(unit(exact))
        assert (np.einsum("ta,ta->t", frames[:2, :, 1 if first == "left" else 0], other[:2]) > 0).all()
    assert frames_along(left, up, "left")[1] == pytest.approx(np.stack([-Z, Y, np.cross(-Z, Y)], axis=1))


def test_the_least_turn_between_any_two_directions() -> None:
    """Its angle is the one between them and its axis is perpendicular to both, also for opposite ones."""
    random = np.random.default_rng(3)
    a, b = random.normal(size=(2, 50, 3))
    b[0], b[1], b[2] = 3 * a[0], -a[1], -a[2] + 1e-9
    turns = least_turns(a, b)
    assert np.linalg.det(turns) == pytest.approx(1)
    assert (turns @ unit(a)[..., None])[..., 0] == pytest.approx(unit(b), abs=1e-7)
    cosines = (np.trace(turns, axis1=1, axis2=2) - 1) / 2
    assert np.arccos(np.clip(cosines, -1, 1)) == pytest.approx(angle_between(a, b), abs=1e-6)
    assert least_turns(np.zeros((1, 3)), X[None]) == pytest.approx(np.eye(3)[None])


def test_a_mean_of_turns_is_in_their_middle() -> None:
    assert mean_turn(about(1, np.radians([10.0, 30.0, 50.0]))) == pytest.approx(about(1, np.radians(30)))
    base, turns = about(0, np.array([0.3, 0.9, 2.0])), about(0, np.array([0.3, 0.9, 2.0])) @ about(2, 1.1)
    turns[2] = turns[2] @ about(1, 0.7)
    levelled = level_with(turns, base, np.array([True, True, False]))
    assert levelled[:2] == pytest.approx(base[:2])
    assert levelled[2] == pytest.approx(base[2] @ about(2, 1.1) @ about(1, 0.7) @ about(2, -1.1))


def test_a_hinge_counts_from_15_degrees_on() -> None:
    for degrees, length in ((14.0, 0.0), (-14.0, 0.0), (30.0, 0.5 - math.sin(math.radians(15))), (90.0, None)):
        lower = [math.cos(math.radians(degrees)), math.sin(math.radians(degrees)), 0]
        axis = hinge(np.array([[7.0, 0, 0]]), 2 * np.array([lower]))[0]
        assert axis == pytest.approx((1 - math.sin(math.radians(15)) if length is None else length) * Z)


@pytest.mark.parametrize("twist", [0.0, 1.0, 3.0, -2.0])
def test_a_limb_twists_as_its_carrier_up_to_a_constant(twist: float) -> None:
    """The carrier turns about the bone by 0, 0.4 and 0.8 rad; a bend about Z in the first frame tells the zero."""
    turns = about(0, np.array([0.0, 0.4, 0.8]))
    carrier = turns @ about(0, twist) @ about(1, 0.5)  # whose bone is where X is before the last turn
    bones = np.tile(X, (3, 1))
    axes = np.array([Z, 0 * Z, 0 * Z])
    found = limb_turns(Y, bones, carrier, [(X, axes)])
    assert (found @ Y) == pytest.approx(bones)
    assert found[0] @ X == pytest.approx(Z)
    assert found == pytest.approx(turns @ found[0])
    free = limb_turns(Y, bones, carrier, [])
    assert (free @ Y) == pytest.approx(bones)
