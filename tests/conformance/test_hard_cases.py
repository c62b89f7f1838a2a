"""Hard inputs and networks: the picture is near the float network's on every runtime, and wrong pictures are not."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from trilane.apps.experiments.hard_cases import SHIFT, error_of, make_case, make_pair  # noqa: E402
from trilane.apps.experiments.hard_networks import INPUTS, NETWORKS  # noqa: E402

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
def case(request):
    network, name = request.param
    return make_case(pair_of(network), name)


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_picture_is_above_the_bound(case, wrong):
    picture = case.wanted[0]
    assert np.abs(WRONG[wrong](picture) - picture).mean() > case.bound
    assert case.tells


def test_the_picture_is_near_the_float_networks(quick_runtime, case):
    assert error_of(case, quick_runtime) <= case.bound
