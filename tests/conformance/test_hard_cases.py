"""Numerically hard inputs and networks: the picture stays near the float network's, on every runtime."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

from trilane.apps.experiments.hard_cases import INPUTS, NETWORKS, error_of, make_pair  # noqa: E402
from trilane.stages.dsp.runtime import RUNTIMES  # noqa: E402

torch.set_num_threads(1)


@pytest.fixture(scope="module", params=NETWORKS)
def pair(request):
    return make_pair(request.param)


@pytest.mark.parametrize("case", INPUTS)
@pytest.mark.parametrize("runtime", [name for name in RUNTIMES if name != "qnn"])
def test_the_picture_is_near_the_float_networks(skip_without, pair, runtime, case):
    skip_without(runtime)
    assert error_of(pair, case, runtime) <= pair.bounds[case]
