"""Every way of moving pixels gives the same bytes; the split baseline gives those of the packed pass."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trilane.bench import raster, readback
from trilane.bench.readback import READBACKS, UPLOADS
from trilane.errors import TrilaneError
from trilane.stages.gpu import opengl as raw


@pytest.mark.parametrize("name", READBACKS)
@pytest.mark.parametrize("words", [1, 2, 4])
def test_readbacks_deliver_each_frame(gl: Any, name: str, words: int) -> None:
    target = gl.framebuffer([gl.texture((16, 8), words, dtype="u4")])
    way = READBACKS[name](gl, 16 * 8 * words * 4)
    tensors = [np.zeros((6, 4 + n, words), np.uint32) for n in range(5)]
    for value, tensor in enumerate(tensors, start=1):
        target.use()
        raw.function("glClearBufferuiv")(raw.COLOR, 0, (raw.ctypes.c_uint * 4)(*[value] * 4))
        way.submit(target, (0, 0, tensor.shape[1], 6), words, tensor.reshape(-1).view(np.uint8))
        if value > way.lag:
            assert (tensors[value - 1 - way.lag] == value - way.lag).all()
    way.drain()
    assert all((tensor == value).all() for value, tensor in enumerate(tensors, start=1))


@pytest.mark.parametrize("name", UPLOADS)
def test_uploads_may_reuse_the_slot(gl: Any, name: str) -> None:
    textures = [gl.texture((5, 3), 4) for _ in range(5)]
    way, image = UPLOADS[name](gl, 60), np.zeros(60, np.uint8)
    for value, texture in enumerate(textures):
        image[:] = value
        way.write(texture, image)
        image[:] = 99
    assert all(set(texture.read()) == {value} for value, texture in enumerate(textures))


def test_a_fence_that_fails_is_an_error(gl: Any) -> None:
    raw.wait_fence(raw.fence())
    with pytest.raises(TrilaneError, match="did not finish"):
        raw.wait_fence(0)
    assert gl.error != "GL_NO_ERROR"


def test_raster_bench_compares_equal_bytes() -> None:
    found = raster.measure(size=96, channels=8, repeats=2)
    assert found["ratios"]["split_over_packed"] == found["split_ms"] / found["packed_ms"]
    assert 0.05 < found["covered"] < 0.5
    assert found["raster_ms"] in [row["median_ms"] for row in found["rows"]]
    assert {row["way"] for row in found["rows"]} == {
        "packed",
        "packed, other way",
        "split",
        "UV bytes alone",
        "CPU unit skins: packed",
        "CPU unit skins: skinning",
    }


def test_readback_bench_has_every_row() -> None:
    found = readback.measure(sizes=[64], channels=[4, 16], repeats=2)
    assert len(found["rows"]) == 2 * len(READBACKS) + len(UPLOADS)
    assert found["fastest"]["readback"] in READBACKS
    assert found["fastest"]["upload"] in UPLOADS
