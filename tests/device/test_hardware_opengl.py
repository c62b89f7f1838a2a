"""The packed tensor on a hardware driver: within the float64 oracle's bounds, the same however it is read back."""

from __future__ import annotations

import pytest

from trilane.bench import oracle, readback


@pytest.mark.usefixtures("hardware_gl")
def test_the_packed_tensor_is_the_oracles() -> None:
    """Within the bounds that the bench states for every driver."""
    found = oracle.measure(views=20, size=256)
    assert found["driver"]["hardware"]
    assert found["background_bytes_wrong"] == oracle.BOUNDS["background_bytes_wrong"]
    assert found["coverage_differs"] <= oracle.BOUNDS["coverage_differs"]
    assert found["within_one_step"] >= oracle.BOUNDS["within_one_step"]


@pytest.mark.usefixtures("hardware_gl")
@pytest.mark.parametrize("channels", [4, 16])
def test_every_readback_gives_the_same_bytes_and_names_the_fastest(channels: int) -> None:
    """The bench itself fails when a pixel buffer's bytes differ from those read directly."""
    found = readback.measure(sizes=(256,), channels=(channels,), repeats=5)
    assert found["driver"]["hardware"]
    assert found["fastest"]["readback"]
