"""The figures of smaller tensors: which views, sizes and means, with painter and renderer that are told."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("skimage")
from trilane import machine
from trilane.arrays import U8
from trilane.training import validate
from trilane.training.validate import ValidationPlan


@dataclass(frozen=True)
class Crop:
    shape: tuple[int, int]


@dataclass(frozen=True)
class Sample:
    name: str
    crop: Crop


def square(side: int, grey: int) -> U8:
    """A grey square without anything transparent."""
    picture = np.full((side, side, 4), grey, np.uint8)
    picture[..., 3] = 255
    return picture


def test_every_view_is_painted_at_every_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three views, of which the second shows nobody. In the first, greys are 64 off in the own size and 128 in the
    smaller one, in the third 32 in both: 20 log10(255 / 64) = 12.01 dB, and so on.
    """
    views = ["first", "nobody", "third"]
    asked: list[Any] = []

    def painter(renderer: Any, bundle: Any, runtime: str, threads: int) -> Any:
        asked.append((renderer, bundle, runtime, threads))

        def paint(sample: Any, uv: str) -> U8:
            assert uv == f"uv of {sample.name}"
            off = {64: 64, 32: 128}[sample.crop.shape[0]] if sample.name == "first" else 32
            return square(sample.crop.shape[0], off)

        return paint

    def planned(renderer: Any, per_band: int, seed: int, motions: Any, size: str) -> list[Any]:
        asked.append((renderer, per_band, seed, motions, size))
        return [Sample(name=name, crop=Crop((9, 9))) for name in views]

    def rendered(sample: Any) -> tuple[str, U8]:
        truth = square(64, 0)
        if sample.name == "nobody":
            truth[..., 3] = 0
        return f"uv of {sample.name}", truth

    monkeypatch.setattr(validate, "integer_painter", painter)
    monkeypatch.setattr(validate, "plan_validation", planned)
    monkeypatch.setattr(validate, "held_out_motions", lambda names: ("motions", names))
    renderer: Any = SimpleNamespace(render=rendered)
    bundle: Any = SimpleNamespace(read_network=lambda: SimpleNamespace(shape=(1, 64, 64, 12)))
    plan = ValidationPlan(
        held_out=("/far/a.bvh", "builtin:b"), seeds=(5, 6), per_band=3, runtimes=("x", "y"), threads=2
    )
    before, looks = machine.here.now().date(), list[int]()
    found = validate.measure_sizes(bundle, plan, renderer, lambda: looks.append(1))
    assert before <= found.date <= machine.here.now().date()
    assert asked == [(renderer, bundle, "x", 2), (renderer, 3, 5, ("motions", plan.held_out), "64x64")]
    assert (found.runtime, found.seed, found.per_band, found.held_out) == ("x", 5, 3, ("a.bvh", "builtin:b"))
    assert len(looks) == 3
    db = {off: 20 * np.log10(255 / off) for off in (32, 64, 128)}
    assert list(found.psnr_db) == ["64x64", "32x32"]
    assert found.psnr_db == {
        "64x64": round((db[64] + db[32]) / 2, 2),
        "32x32": round((db[128] + db[32]) / 2, 2),
    }


def test_sizes_are_whole_steps_of_the_networks_own() -> None:
    """Three quarters and a half, down to whole steps of 32 pixels, and at least one."""
    assert validate.sizes_of((512, 256)) == [(512, 256), (384, 192), (256, 128)]
    assert validate.sizes_of((160, 96)) == [(160, 96), (96, 64), (64, 32)]
    assert validate.sizes_of((32, 32)) == [(32, 32)]


def test_light_is_linear_between_its_ends() -> None:
    """IEC 61966-2-1: linear below 0.04045, and both ways undo each other."""
    encoded = np.linspace(0, 1, 1001)
    linear = validate._linear(encoded)
    assert linear[[0, 1000]].tolist() == [0.0, 1.0]
    assert linear[40] == pytest.approx(0.04 / 12.92) and linear[500] == pytest.approx(0.2140411, rel=1e-6)
    assert validate._encoded(linear) == pytest.approx(encoded, abs=2e-7)
    assert validate._encoded(np.array([0.003])) == pytest.approx([0.03876])
