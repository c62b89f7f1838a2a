"""Hard numbers keep their bounds, which are worked out by hand here, and a fault in the code breaks a row."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from decimal import Decimal
from typing import Any

import numpy as np
import pytest

from trilane.apps.experiments import hard_numbers, hard_rotations
from trilane.apps.experiments.hard_numbers import time_cases
from trilane.apps.experiments.hard_rotations import PI, HardNumber, U, exact_turn, turn_error, worst
from trilane.avatars.bundle import bundle_folder
from trilane.body import joints, skinning
from trilane.body.body import ShapedBody, load_body, weights_of_one
from trilane.body.joints import Posed, Skeleton
from trilane.body.skinning import TopWeights
from trilane.errors import BadInputError


@pytest.fixture(scope="module")
def shaped() -> ShapedBody:
    return load_body(bundle_folder("default") / "body.npz").shape()


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer random rotations than the command draws."""
    monkeypatch.setattr(hard_rotations, "RANDOM", 2000)
    monkeypatch.setattr(hard_rotations, "CHUNK", 1000)


def failing(cases: Iterable[HardNumber]) -> list[str]:
    return [case.name for case in cases if not case.holds]


def test_a_row_holds_up_to_its_bound() -> None:
    held = [HardNumber("", error, 2.0, "", "").holds for error in (0.0, 2.0, 2.1, math.nan, math.inf)]
    assert held == [True, True, False, False, False]


@pytest.mark.parametrize(
    ("errors", "bounds", "found"),
    [
        ([1.0, 3.0], [2.0, 9.0], (1.0, 2.0)),
        ([0.0, 0.0], [1.0, 5.0], (0.0, 5.0)),
        ([0.0, 1e-9], [0.0, 0.0], (1e-9, 0.0)),
        ([[1.0, 2.0]], 4.0, (2.0, 4.0)),
    ],
)
def test_the_error_nearest_to_its_bound_stands_for_all(errors: Any, bounds: Any, found: tuple[float, float]) -> None:
    assert worst(errors, bounds) == found


def test_an_error_that_is_no_number_stands_for_all() -> None:
    error, bound = worst([1.0, math.nan], [2.0, 7.0])
    assert (math.isnan(error), bound) == (True, 7.0)


def test_exact_turns_are_those_of_paper() -> None:
    """A quarter turn about z takes x to y; half a turn about x mirrors y and z; pi as a float misses pi by 1.22e-16."""
    quarter = exact_turn([0.0, 0.0, math.pi / 2])
    assert [[round(float(entry), 12) for entry in row] for row in quarter] == [[-1, -1, 0], [1, -1, 0], [0, 0, 0]]
    half = exact_turn([math.pi, 0.0, 0.0])
    assert float(half[2][1]) == pytest.approx(float(PI - Decimal(math.pi)), rel=1e-12)
    assert float(half[1][1] + 2) == pytest.approx((1.2246467991473532e-16) ** 2 / 2, rel=1e-9)


def test_tiny_exact_turns_are_their_cross_product() -> None:
    found = exact_turn([1e-40, 2e-40, 3e-40])
    assert [float(found[0][1]), float(found[0][2]), float(found[1][2])] == [-3e-40, 2e-40, -1e-40]
    assert float(found[0][0]) == pytest.approx(-(4 + 9) / 2 * 1e-80)


def test_a_turn_that_is_no_number_is_an_error() -> None:
    assert math.isnan(turn_error(np.full((3, 3), np.nan), exact_turn([0.0, 0.0, 0.0])))
    assert turn_error(np.full((3, 3), 0.25), exact_turn([0.0, 0.0, 0.0])) == 0.25


def test_the_bound_of_a_turn_at_three_angles() -> None:
    """At 2: s = h = 1, e = 10 U, f = 4.5 U: 60 + 9 + 6 = 75 U. Near 0: 2 e = 10 U t, s f and s U add 2 and 3 U t."""
    bounds = hard_rotations.turn_bound(np.array([0.0, 1e-8, 2.0]))
    assert bounds[0] == 0.0
    assert bounds[1] == pytest.approx(1.01 * 15e-8 * U, rel=1e-6)
    assert bounds[2] == pytest.approx(1.01 * 75 * U, rel=1e-12)


def test_angles_near_half_a_turn_and_a_whole_one_are_what_they_are_called() -> None:
    """sin(pi - d) = d and sin(pi + d) = sin(2 pi - d) = -d."""
    names = ("pi - 1e-7", "pi + 1e-7", "2 pi - 1e-7")
    assert [math.sin(hard_rotations.ANGLES[name]) for name in names] == pytest.approx([1e-7, -1e-7, -1e-7], rel=1e-6)
    assert math.cos(hard_rotations.ANGLES["2 pi - 1e-7"]) == pytest.approx(1)


@pytest.mark.usefixtures("few")
def test_rotations_keep_their_bounds() -> None:
    cases = list(hard_rotations.rotation_cases())
    assert failing(cases) == []
    assert len(cases) == len(hard_rotations.ANGLES) + 2 + len(hard_rotations.RETURNED)


def _without_a_series(rotvec: Any) -> Any:
    """Rodrigues' formula as it is often written: no care at 0, 1e-8 in the norm."""
    v = np.asarray(rotvec, np.float64)
    angle = np.sqrt((v * v).sum(axis=-1))[..., None, None] + 1e-8
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*v.shape[:-1], 3, 3) / angle
    return np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)


@pytest.mark.usefixtures("few")
def test_a_formula_without_care_at_zero_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hard_rotations, "turn", _without_a_series)
    failed = failing(hard_rotations.rotation_cases())
    assert {f"rotation by {name}, 26 axes" for name in ("1e-12", "1e-3", "pi")} <= set(failed)


def test_chains_keep_their_bounds(shaped: ShapedBody) -> None:
    cases = list(hard_rotations.chain_cases(shaped))
    assert failing(cases) == []
    assert len(cases) == len(hard_rotations.TURNS) + 1 + len(hard_rotations.PLACES)


def test_places_in_half_precision_fail(shaped: ShapedBody, monkeypatch: pytest.MonkeyPatch) -> None:
    pose = Skeleton.pose

    def rounded(*arguments: Any) -> Posed:
        posed = pose(*arguments)
        posed.matrices[:, :, 3] = posed.matrices[:, :, 3].astype(np.float16)
        return posed

    monkeypatch.setattr(Skeleton, "pose", rounded)
    failed = failing(hard_rotations.chain_cases(shaped))
    assert failed == [f"places of the skinning matrices, {place}" for place in hard_rotations.PLACES]


def test_a_day_of_media_time_keeps_its_bounds() -> None:
    cases = list(time_cases())
    assert failing(cases) == []
    assert len(cases) == 9


def test_weights_are_made_to_sum_to_one() -> None:
    given = np.array([[0.5, 0.5, 0.0], [0.5, 0.4995, 0.0], [1.0005, -0.0005, 0.0]], np.float32)
    found = weights_of_one(given)
    assert found[0].tolist() == [0.5, 0.5, 0.0]
    assert found[1] == pytest.approx([0.5 / 0.9995, 0.4995 / 0.9995, 0.0], rel=1e-7)
    assert found[2].tolist() == [1.0, 0.0, 0.0]


def test_fewer_weights_keep_the_bound_that_is_proved(shaped: ShapedBody) -> None:
    cases = list(hard_numbers._left_out(shaped))
    assert failing(cases) == []
    assert [case.name.split(" skin")[0] for case in cases] == [
        "the 4 largest",
        "the 4 largest of 16 drawn",
        "the 8 largest of 16 drawn",
        "the 12 largest of 16 drawn",
    ]
    assert all(case.error > 0 for case in cases)


def test_weights_that_are_not_scaled_fail(shaped: ShapedBody, monkeypatch: pytest.MonkeyPatch) -> None:
    def unscaled(weights: Any, k: int) -> TopWeights:
        order = np.argsort(-weights, axis=1, kind="stable")[:, :k]
        return TopWeights(order.astype(np.int32), np.take_along_axis(weights, order, axis=1))

    monkeypatch.setattr(skinning, "largest_weights", unscaled)
    monkeypatch.setattr(skinning, "largest_weights", unscaled)
    assert len(failing(hard_numbers._left_out(shaped))) == 4


def test_a_kind_of_case_that_an_error_ends_is_a_row_that_fails() -> None:
    def cases() -> Iterator[HardNumber]:
        yield HardNumber("first", 0.0, 1.0, "m", "")
        raise BadInputError("place", "NaN", "a number")

    kept = list(hard_numbers.kept_going("bodies", cases()))
    assert [(case.name, case.holds) for case in kept] == [
        ("first", True),
        ("bodies, ended by an error: place: found NaN, expected a number", False),
    ]


def test_a_fault_that_gives_no_number_is_told_row_by_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """As JSON has it, which knows no NaN."""
    monkeypatch.setattr(joints, "_TINY", 0.0)
    monkeypatch.setattr(hard_rotations, "ANGLES", {"0": 0.0, "1e-3": 1e-3})
    monkeypatch.setattr(
        hard_numbers, "_cases", lambda: hard_numbers.kept_going("rotations", hard_rotations.rotation_cases())
    )
    monkeypatch.setattr(hard_rotations, "_random_cases", lambda: iter(()))
    monkeypatch.setattr(hard_rotations, "RETURNED", ())
    with np.errstate(invalid="ignore"):
        rows = list(hard_numbers.hard_numbers())
    assert [(row["error"] is None, row["passed"]) for row in rows] == [(True, False), (False, True)]
    json.dumps(rows, allow_nan=False)
