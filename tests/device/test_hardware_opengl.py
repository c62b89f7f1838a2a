"""The packed tensor on a hardware driver: within the float64 oracle's bounds, the same however it is read back."""

from __future__ import annotations

import pytest

from support import raster_oracle
from trilane.bench import readback
from trilane.stages.gpu.opengl import describe, open_context


@pytest.mark.usefixtures("hardware_gl")
def test_the_packed_tensor_is_the_oracles() -> None:
    """A thousandth of the pixels may lie on the other side of an edge, and of the values be off by more than a step."""
    ctx = open_context()
    assert describe(ctx).hardware
    pixels, uncovered, values, near, wrong = raster_oracle.compare(ctx, 20, (256, 256)).sum(axis=0)
    assert wrong == 0
    assert uncovered <= 1e-3 * pixels
    assert near >= 0.999 * values


@pytest.mark.usefixtures("hardware_gl")
@pytest.mark.parametrize("channels", [4, 16])
def test_every_readback_gives_the_same_bytes_and_names_the_fastest(channels: int) -> None:
    """The bench itself fails when a pixel buffer's bytes differ from those read directly."""
    found = readback.measure(sizes=(256,), channels=(channels,), repeats=5)
    assert found["driver"]["hardware"]
    assert found["fastest"]["readback"]
