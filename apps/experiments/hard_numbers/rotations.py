"""Rotations at the angles where formulas break, and a million at random.

Rule: the reference has sixty digits (`exact_turn`), and the bound follows from the formula of body/kinematics.py.

The bound. h = |v| / 2 is off by at most 2.5 U of itself (a sum of three squares, its root). Each part of the quaternion
is then off by at most e = U (2.5 h + 7.5 s), s = min(1, h), its first part by at most f = U (2.5 h + 2). An entry of
R - I is a sum of at most two products of parts, doubled, so it is off by at most

    (4 s + 2) e + 2 s f + 6 s U        where U^2 and smaller are left out and the whole is taken 1.01 times for them.

Below the least normal number each of the eight roundings may add the least number that there is.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from trilane.apps.experiments.hard_numbers.exact_turn import exact_turn, turn_error
from trilane.apps.experiments.hard_numbers.hard_number import HIGHAM, HardNumber, U, worst
from trilane.arrays import F64
from trilane.body.kinematics import rodrigues, turn
from trilane.scene.rotations import quat_from_rotvec, rotvec_from_quat

ANGLES = {
    "0": 0.0,
    "5e-324, the least number": 5e-324,
    "1e-160": 1e-160,
    "1e-12": 1e-12,
    "1e-9": 1e-9,
    "1e-6": 1e-6,
    "1e-3": 1e-3,
    "pi - 1e-7": np.pi - 1e-7,
    "pi": np.pi,
    "pi + 1e-7": np.pi + 1e-7,
    "2 pi - 1e-7": 2 * np.pi - 1e-7,
    "2 pi": 2 * np.pi,
    "100 pi": 100 * np.pi,
    "1e6": 1e6,
}
#: Angles whose vector a quaternion gives back: up to half a turn.
RETURNED = ("1e-12", "1e-6", "1e-3", "pi - 1e-7")
RANDOM, CHUNK, SEED = 1_000_000, 100_000, 17
LEAST = 2.0**-1074


def rotation_cases() -> Iterator[HardNumber]:
    """A row for each angle, for orthonormality and determinant of random rotations, and for the way back."""
    axes = _axes()
    for name, angle in ANGLES.items():
        vectors = axes * angle
        errors = [turn_error(turn(vector), exact_turn(vector.tolist())) for vector in vectors]
        bounds = turn_bound(np.full(len(axes), angle))
        yield HardNumber(f"rotation by {name}, {len(axes)} axes", *worst(errors, bounds), "entry of R - I", HIGHAM)
    yield from _random_cases()
    for name in RETURNED:
        vectors = axes * ANGLES[name]
        back = rotvec_from_quat(quat_from_rotvec(vectors))
        errors = np.abs(back - vectors).max(axis=1)
        bounds = return_bound(np.full(len(axes), ANGLES[name]))
        yield HardNumber(f"rotation by {name} to a quaternion and back", *worst(errors, bounds), "rad", HIGHAM)


def turn_bound(angle: F64) -> F64:
    """How far an entry of R - I may be off, by the angle in radians (...)."""
    s, e, f = _parts(np.asarray(angle, np.float64))
    return np.asarray(1.01 * ((4 * s + 2) * e + 2 * s * f + 6 * s * U) + np.where(angle > 0, 8 * LEAST, 0.0))


def return_bound(angle: F64) -> F64:
    """How far a part of the vector may be off that came back from a quaternion, radians, by the angle up to pi (...).

    The angle is 2 atan2(sine, w), off by 2 (f + sqrt(3) e) and four roundings; the axis is divided by sine.
    """
    _, e, f = _parts(np.asarray(angle, np.float64))
    sine = np.sin(np.minimum(angle / 2, np.pi / 2))
    axis = (1 + np.sqrt(3)) * e / np.maximum(sine, LEAST) + 3 * U
    return np.asarray(1.01 * (2 * (f * sine + np.sqrt(3) * e) + 4 * U * angle + angle * axis) + 8 * LEAST)


def _parts(angle: F64) -> tuple[F64, F64, F64]:
    """s, e and f of the bound."""
    h = angle / 2
    s = np.minimum(1.0, h)
    return s, U * (2.5 * h + 7.5 * s), U * (2.5 * h + 2)


def _axes() -> F64:
    """Unit vectors (26, 3): to the faces, edges and corners of a cube."""
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    directions = grid[np.abs(grid).any(axis=1)]
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def _random_cases() -> Iterator[HardNumber]:
    """R^T R = I and det R = 1 of random rotations by 0 to 2 pi.

    With each entry off by at most b, an entry of R^T R is off by 2 sqrt(3) b (the columns have length 1) and by three
    roundings; the determinant by b times the sum of all cofactors, at most 3 sqrt(3), and by ten roundings.
    """
    rng = np.random.default_rng(SEED)
    square, volume = [], []
    for _ in range(RANDOM // CHUNK):
        axis = rng.normal(size=(CHUNK, 3))
        vectors = axis / np.linalg.norm(axis, axis=1, keepdims=True) * rng.uniform(0, 2 * np.pi, (CHUNK, 1))
        matrices = rodrigues(vectors)
        entry = turn_bound(np.linalg.norm(vectors, axis=1)) + U
        product = np.einsum("nki,nkj->nij", matrices, matrices) - np.eye(3)
        square.append(worst(np.abs(product).max(axis=(1, 2)), 2 * np.sqrt(3) * entry + 4 * U))
        triple = np.einsum("ni,ni->n", matrices[:, 0], np.cross(matrices[:, 1], matrices[:, 2]))
        volume.append(worst(np.abs(triple - 1), 3 * np.sqrt(3) * entry + 10 * U))
    name = f"{RANDOM:,} random rotations"
    yield HardNumber(f"{name}: R^T R", *worst(*np.transpose(square)), "entry of R^T R - I", HIGHAM)
    yield HardNumber(f"{name}: determinant", *worst(*np.transpose(volume)), "det R - 1", HIGHAM)
