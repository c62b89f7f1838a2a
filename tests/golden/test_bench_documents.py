"""`bench raster` and `readback`: their documents on times that are told."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import moderngl
import numpy as np
import pytest

from trilane.bench import raster, readback
from trilane.bench.lib.fixture import ENCODING, standing
from trilane.bench.lib.gpu_buffering import SubUpload
from trilane.bench.raster import SplitPass
from trilane.errors import BadInputError, TrilaneError
from trilane.stages.gpu.opengl import Driver, describe
from trilane.stages.gpu.packed_pass import PackedPass
from trilane.stages.gpu.skinned_mesh import SkinnedMesh
from trilane.training.sample_renderer import UvRaster

Variants = Mapping[str, Callable[[], object]]


class Told:
    """Stands for `interleaved_ms`: every variant runs once and took three times its place from 1, once, and twice."""

    def __init__(self) -> None:
        self.asked: list[tuple[dict[str, Any], int]] = []

    def __call__(self, variants: Variants, repeats: int) -> dict[str, list[float]]:
        self.asked.append((dict(variants), repeats))
        for run in variants.values():
            run()
        return {name: [3.0 * place, place, 2.0 * place] for place, name in enumerate(variants, start=1)}


def summary(place: float) -> dict[str, float]:
    return {"median_ms": 2.0 * place, "min_ms": place, "p90_ms": pytest.approx(2.8 * place)}


@pytest.fixture(params=[True, False], ids=["hardware", "software"])
def driver(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Driver:
    told = Driver("v", "r", "3.3", request.param)
    for module in (raster, readback):
        monkeypatch.setattr(module, "describe", lambda _ctx: told)
    return told


@pytest.fixture
def opened(gl: Any, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The benches draw in the shared context; the threads that they asked for."""
    threads: list[int] = []
    for module in (raster, readback):
        monkeypatch.setattr(module, "open_context", lambda *asked: threads.extend(asked) or gl)
    return threads


def test_the_raster_bench_draws_the_same_body_in_every_way(
    gl: Any, driver: Driver, opened: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    told = Told()
    monkeypatch.setattr(raster, "interleaved_ms", told)
    passes: list[bool] = []

    class Noted(PackedPass):
        def __init__(self, ctx: Any, channels: int, quantisation: Any, deferred: bool) -> None:
            super().__init__(ctx, channels, quantisation, deferred)
            passes.append(deferred)

    monkeypatch.setattr(raster, "PackedPass", Noted)
    compared: list[Any] = []
    monkeypatch.setattr(raster, "_check_equal", compared.append)
    result = raster.measure(size=96, channels=8, repeats=7, threads=3)
    soft = not driver.hardware
    names = [
        "packed",
        "packed, other way",
        "split",
        "CPU unit skins: packed",
        "CPU unit skins: skinning",
        "UV bytes alone",
    ]
    covered = result.pop("covered")
    assert [list(tensors) for tensors in compared] == [names[:3]]
    assert result == {
        "raster_ms": 8.0 if soft else 2.0,
        "packed_ms": 2.0,
        "split_ms": 6.0,
        "ratios": {"split_over_packed": 3.0},
        "rows": [{"way": name, **summary(place)} for place, name in enumerate(names, start=1)],
        "driver": asdict(driver),
        "config": {"size": 96, "channels": 8, "repeats": 7, "threads": 3, "deferred": soft},
    }
    assert (passes, opened, told.asked[0][1]) == ([soft, not soft, soft], [3], 7)
    variants: Any = told.asked[0][0]
    tensors = {name: variants[name].args[0].reshape(96, 96, -1) for name in names if name != "CPU unit skins: skinning"}
    body = standing(8)
    uv = UvRaster(gl, SkinnedMesh(gl, body.arrays)).render(body.joints, body.view, body.projection, (96, 96))
    on_mesh = uv[..., 2] > 0
    assert covered == pytest.approx(on_mesh.mean(), abs=2e-3) and 0.05 < covered < 0.5
    packed = tensors["packed"].astype(int)
    for name in names[1:4]:
        assert np.mean(tensors[name] != packed) < 2e-3 and np.abs(tensors[name] - packed).max() <= 1, name
    assert (packed[~on_mesh] == 128).all()
    found = tensors["UV bytes alone"]
    assert np.abs(found / 255 - uv[..., :2])[on_mesh].max() < 0.51 / 255 and not found[~on_mesh].any()


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
    placement = raster.Placement(body.joints, body.projection, (0, 0, *shape))
    tensors = np.zeros((2, *shape, 8), np.uint8)
    for _ in range(2):  # the second draw begins where the first has left its targets
        gl.disable(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        split.draw(body.view, placement)
        split.read_into(tensors[0].reshape(-1))
    packed(tensors[1].reshape(-1))
    steps = np.abs(tensors[0].astype(int) - tensors[1])
    assert steps.max() <= 1 and (steps > 0).mean() < 2e-3 and (tensors[0] != 128).any(axis=(0, 1)).all()
    with pytest.raises(BadInputError):
        SplitPass(gl, mesh, np.full_like(body.texture, np.nan), ENCODING, shape)


def test_readbacks_and_uploads_have_rows_of_what_was_told(
    gl: Any, opened: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    driver = describe(gl)
    told = Told()
    done: list[str] = []

    class Noted:
        """The context, of which it is noted what it finishes and copies, and when times are taken."""

        def __getattr__(self, name: str) -> Any:
            if name in ("finish", "copy_framebuffer"):
                done.append(name)
            return getattr(gl, name)

    def timed(variants: Variants, repeats: int) -> dict[str, list[float]]:
        done.append("timed")
        return told(variants, repeats)

    images: list[np.ndarray] = []

    class Kept(SubUpload):
        def write(self, texture: Any, image: np.ndarray) -> None:
            images.append(image.copy())
            super().write(texture, image)

    monkeypatch.setitem(readback.UPLOADS, "sub", Kept)
    monkeypatch.setattr(readback, "describe", lambda _: driver)
    monkeypatch.setattr(readback, "open_context", lambda *asked: opened.extend(asked) or Noted())
    monkeypatch.setattr(readback, "interleaved_ms", timed)
    result = readback.measure(sizes=(32, 64), channels=(4,), repeats=5, threads=2)
    reads = [
        {"kind": "readback", "size": size, "channels": count, "way": way, "lag": lag}
        | {"move": summary(place), "turn": summary(place)}
        for size in (32, 64)
        for count in (4,)
        for place, (way, lag) in enumerate((("direct", 0), ("pbo", 0), ("pbo-orphan", 0), ("pbo-ring", 2)), start=1)
    ]
    writes = [
        {"kind": "upload", "size": size, "channels": 4, "lag": 0, "way": way, "move": summary(place)}
        for size in (32, 64)
        for place, way in enumerate(("sub", "orphan", "ring"), start=1)
    ]
    assert result == {
        "rows": [*reads, *writes],
        "fastest": {"readback": "direct", "upload": "sub"},
        "driver": asdict(driver),
        "time_source": readback.TIME_SOURCES[driver.hardware],
        "config": {"repeats": 5, "threads": 2},
    }
    assert opened == [2] and {repeats for _, repeats in told.asked} == {5}
    read, written = ["timed", "finish", "timed"], ["timed", *["copy_framebuffer", "finish"] * 3]
    for image, size in zip(images, (32, 64), strict=True):
        assert np.array_equal(image, np.random.default_rng(0).integers(0, 256, size * size * 4, dtype=np.uint8))
    assert done == [*read, *read, *written, *written]


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
def test_hardware_is_judged_by_turns_and_software_by_moves(driver: Driver, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readback, "_readback_rows", lambda *_: [])
    monkeypatch.setattr(readback, "_upload_rows", lambda *_: [])
    monkeypatch.setattr(readback, "_fastest", lambda _rows, kind, figure: (kind, figure))
    figure = "turn" if driver.hardware else "move"
    found = readback.measure()["fastest"]
    assert found == {"readback": ("readback", figure), "upload": ("upload", "move")}


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
