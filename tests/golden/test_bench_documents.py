"""`bench raster` and `readback`: what they refuse, and the split pass beside the packed one."""

from __future__ import annotations

from typing import Any

import moderngl
import numpy as np
import pytest

from trilane.bench import raster, readback
from trilane.bench.lib.fixture import ENCODING, standing
from trilane.bench.raster import SplitPass
from trilane.errors import BadInputError, TrilaneError
from trilane.stages.gpu.skinned_mesh import SkinnedMesh


@pytest.fixture
def opened(gl: Any, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The benches draw in the shared context; the threads that they asked for."""
    threads: list[int] = []
    for module in (raster, readback):
        monkeypatch.setattr(module, "open_context", lambda *asked: threads.extend(asked) or gl)
    return threads


def test_bytes_that_differ_are_refused() -> None:
    """A step in one of a thousand bytes is let pass, in two it is not, and two steps never are."""
    packed = np.full(1000, 7, np.uint8)
    for wrong, step in ((1, 1), (0, 0)):
        other = packed.copy()
        other[:wrong] -= step
        raster._check_equal({"packed": packed, "split": other})
    for wrong, step in ((2, 1), (1, 2)):
        other = packed.copy()
        other[:wrong] -= np.uint8(step)
        with pytest.raises(TrilaneError, match=f"split gave other bytes than packed: {step} steps at most"):
            raster._check_equal({"packed": packed, "split": other})


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"size": 0}, "--size: found 0, expected 1 to 4096"),
        ({"size": 4097}, "--size: found 4097, expected 1 to 4096"),
        ({"channels": 5}, "--channels: found 5, expected 4, 8, 12 or 16"),
    ],
)
def test_a_tensor_that_cannot_be_is_refused(asked: dict[str, int], words: str) -> None:
    with pytest.raises(BadInputError, match=f"^{words}$"):
        raster.measure(**asked)


def test_split_passes_fill_a_tensor_that_is_no_square(gl: Any) -> None:
    """Wider than high, with other channels than four: as the packed pass fills it."""
    body, shape = standing(8), (40, 64)
    mesh = SkinnedMesh(gl, body.arrays)
    split = SplitPass(gl, mesh, body.texture, ENCODING, shape)
    packed = raster.packed_variant(gl, body, shape, deferred=False)
    placement = raster.Placement(body.joints(0), body.projection, (0, 0, *shape))
    tensors = np.zeros((2, *shape, 8), np.uint8)
    for _ in range(2):  # the second draw begins where the first has left its targets
        gl.disable(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        split.draw(body.view, placement)
        split.read_into(tensors[0].reshape(-1))
    packed(tensors[1:].reshape(1, -1), 0)
    steps = np.abs(tensors[0].astype(int) - tensors[1])
    assert steps.max() <= 1 and (steps > 0).mean() < 2e-3 and (tensors[0] != 128).any(axis=(0, 1)).all()
    with pytest.raises(BadInputError):
        SplitPass(gl, mesh, np.full_like(body.texture, np.nan), ENCODING, shape)


def test_the_fastest_has_the_least_sum_of_medians() -> None:
    """By turns `a` takes 3 + 3, `b` 5 + 2 and, as the others alone, less; by moves `b` is the quicker."""
    rows = [
        {"kind": kind, "way": way, "turn": {"median_ms": turn}, "move": {"median_ms": move}}
        for kind, way, turn, move in (
            ("readback", "a", 3.0, 9.0),
            ("readback", "b", 5.0, 1.0),
            ("upload", "c", 0.5, 0.5),
            ("readback", "a", 3.0, 9.0),
            ("readback", "b", 2.0, 8.0),
        )
    ]
    assert readback._fastest(rows, "readback", "turn") == "a"
    assert readback._fastest(rows, "readback", "move") == "b"
    assert readback._fastest(rows, "upload", "turn") == "c"


@pytest.mark.usefixtures("opened")
@pytest.mark.parametrize("kind", ["readback", "upload"])
def test_variants_that_give_other_bytes_are_refused(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    table = readback.READBACKS if kind == "readback" else readback.UPLOADS

    class Wrong:
        lag = 0

        def __init__(self, *_: Any) -> None:
            """Nothing is done either."""

        def submit(self, *_: Any) -> None:
            """Leaves the tensor empty."""

        drain = write = submit

    monkeypatch.setitem(table, "wrong", Wrong)  # type: ignore[arg-type]
    with pytest.raises(TrilaneError, match=f"{kind} wrong gave other bytes than (direct|were written)"):
        readback.measure(sizes=(32,), channels=(4,), repeats=1)
