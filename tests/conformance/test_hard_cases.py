"""Hard inputs and networks: the picture is near the float network's on every runtime, and wrong pictures are not."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from trilane.apps.experiments.hard_cases import (  # noqa: E402  # noqa: E402
    EXCEEDED,
    HOLDS,
    IDEAL_STEPS,
    INPUTS,
    NETWORKS,
    SHIFT,
    error_of,
    make_case,
    make_pair,
)
from trilane.training.quantising import calibration  # noqa: E402
from trilane.training.quantising import quantise as quantise_module  # noqa: E402

torch.set_num_threads(1)

WRONG = {
    "constant": lambda picture: np.broadcast_to(np.median(picture, axis=(0, 1)), picture.shape),
    "down": lambda picture: np.roll(picture, SHIFT, axis=0),
    "up, edge repeated": lambda picture: np.pad(picture, ((0, SHIFT), (0, 0), (0, 0)), "edge")[SHIFT:],
    "right": lambda picture: np.roll(picture, SHIFT, axis=1),
    "left, edge repeated": lambda picture: np.pad(picture, ((0, 0), (0, SHIFT), (0, 0)), "edge")[:, SHIFT:],
    "red and blue exchanged": lambda picture: picture[..., [2, 1, 0, 3]],
}

pair_of = functools.cache(make_pair)


@pytest.fixture(scope="module", params=itertools.product(NETWORKS, INPUTS), ids=", ".join)
def row(request):
    return request.param


@pytest.fixture(scope="module")
def case(row):
    network, name = row
    return make_case(pair_of(network), name)


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_picture_is_above_the_bound(case, wrong):
    picture = case.wanted[0]
    assert np.abs(WRONG[wrong](picture) - picture).mean() > case.bound
    assert case.tells


def test_the_picture_is_near_the_float_networks(quick_runtime, case):
    """Every picture keeps the bound of its own network's steps and that of ideal ones."""
    error = error_of(case, quick_runtime)
    assert error <= case.bound <= case.own_bound
    assert case.verdict(error) == HOLDS


def test_ranges_four_times_as_wide_fail(monkeypatch):
    """Every step is four times as coarse; the float network's pictures are the same."""
    sound = quantise_module.limit_logits

    def widen(model, ranges):
        sound(model, ranges)
        for name in ranges.keys():  # noqa: SIM118 - no dict
            ranges[name].lowest, ranges[name].highest = 4 * ranges[name].lowest, 4 * ranges[name].highest

    monkeypatch.setattr(quantise_module, "limit_logits", widen)
    assert_rows_fail_that_hold_when_sound("instance")


def test_weights_of_a_quarter_of_the_steps_fail(monkeypatch):
    monkeypatch.setattr(calibration, "WEIGHT_TOP", {True: 16, False: 16})
    assert_rows_fail_that_hold_when_sound("batch")


def assert_rows_fail_that_hold_when_sound(network):
    pair = make_pair(network)
    for name in ("usual", "little but background"):
        case = make_case(pair, name)
        assert case.source == IDEAL_STEPS
        assert case.verdict(error_of(case, "ort")) == EXCEEDED
