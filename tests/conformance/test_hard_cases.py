"""Numerically hard inputs and networks: the picture stays near the float network's, on every runtime.

Bounds are mean steps of 1/255 of untrained networks. Instance and group norm amplify what is nearly constant, and
ranges that calibration never saw are clamped: there the bounds are wide, and say so.
"""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from trilane.avatars.quantise import quantise  # noqa: E402
from trilane.avatars.training.export import export_onnx  # noqa: E402
from trilane.avatars.training.network import NORMS, UNet  # noqa: E402
from trilane.stages.dsp.runtime import RUNTIMES, RuntimeOptions, load_runtime  # noqa: E402

torch.set_num_threads(1)
SHAPE = (64, 64, 4)
STEPS = {
    "folded": {"constant map": 1, "all background": 1, "saturating": 5, "usual": 1},
    "statistics": {"constant map": 12, "all background": 1, "saturating": 22, "usual": 9},
}


def constant(_rng):
    return np.full(SHAPE, 0.7, np.float32)


def background(_rng):
    return np.zeros(SHAPE, np.float32)


def saturating(rng):
    return (10 * rng.normal(size=SHAPE)).astype(np.float32)


def usual(rng):
    return rng.normal(size=SHAPE).astype(np.float32)


CASES = {"constant map": constant, "all background": background, "saturating": saturating, "usual": usual}


@pytest.fixture(scope="module", params=[*NORMS, "outlier channel"])
def pair(request):
    """A float network, its integers calibrated on usual frames, its bounds. The outlier is a hundredfold channel."""
    torch.manual_seed(0)
    outlier = request.param == "outlier channel"
    network = UNet(norm="batch" if outlier else request.param, width=8, channels=SHAPE[2])
    if outlier:
        with torch.no_grad():
            network.encoder.stem[0].weight[0] *= 100
    rng = np.random.default_rng(0)
    bounds = STEPS["statistics" if request.param in ("instance", "group") else "folded"]
    return network.eval(), quantise(export_onnx(network, *SHAPE[:2]), [usual(rng) for _ in range(4)]).network, bounds


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("runtime", [name for name in RUNTIMES if name != "qnn"])
def test_the_picture_is_near_the_float_networks(pair, runtime, case):
    pytest.importorskip(RUNTIMES[runtime].package)
    network, integer, bounds = pair
    frame = CASES[case](np.random.default_rng(7))
    tensor = np.clip(np.round(frame / integer.input.scale) + integer.input.zero_point, 0, 255).astype(np.uint8)
    image = np.zeros((1, *SHAPE[:2], 4), np.uint8)
    load_runtime(runtime).load(integer, RuntimeOptions()).bind(np.ascontiguousarray(tensor[None]), image).run()
    real = (tensor.astype(np.float32) - integer.input.zero_point) * integer.input.scale
    with torch.no_grad():
        wanted = network(torch.from_numpy(real).permute(2, 0, 1)[None]).permute(0, 2, 3, 1).numpy()
    assert np.isfinite(wanted).all()
    assert np.abs(image - 255 * wanted).mean() <= bounds[case]
