"""High range to sRGB against the curves of BT.2100 and BT.2390 written out one number after the other."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trilane.stages.gpu.video_reader import HLG, PQ, pq_code, pq_light, roll_off, to_srgb


def shown(transfer: str, red: float, green: float, blue: float, is_wide: bool = True) -> list[int]:
    codes = np.array([[[red, green, blue]]]) * 65535
    return to_srgb(codes.round().astype(np.uint16), transfer, is_wide)[0, 0].tolist()


def code_of(light: float) -> float:
    """PQ of BT.2100, table 4."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 4096 * 128, 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    y = (light / 10000) ** m1
    return ((c1 + c2 * y) / (1 + c3 * y)) ** m2


def srgb(light: float) -> float:
    return 255 * (12.92 * light if light <= 0.0031308 else 1.055 * light ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize(
    ("light", "code"), [(0.0, 0.0), (100.0, 0.508), (203.0, 0.581), (1000.0, 0.752), (10000.0, 1.0)]
)
def test_the_curve_of_pq(light: float, code: float) -> None:
    """The well-known levels, to three places; and there and back."""
    assert float(pq_code(np.array(light))) == pytest.approx(code, abs=6e-4)
    assert code_of(light) == pytest.approx(float(pq_code(np.array(light))), abs=1e-7)
    assert float(pq_light(pq_code(np.array(light)))) == pytest.approx(light, abs=1e-6)


def test_light_below_the_knee_is_kept_and_the_peak_is_white() -> None:
    """The knee is at 1.5 * 0.581 / 0.752 - 0.5 = 0.659 of the peak's code, which is 89 cd/m2."""
    for light in (0.5, 20.0, 85.0):
        assert float(roll_off(np.array(light))) == pytest.approx(light / 203, rel=1e-6)
    assert float(roll_off(np.array(1000.0))) == pytest.approx(1.0)
    lights = np.linspace(0.1, 1000, 500)
    assert (np.diff(roll_off(lights)) > 0).all()


def test_greys_of_pq() -> None:
    for light in (1.0, 20.0, 85.0):
        grey = shown(PQ, *[code_of(light)] * 3)
        assert grey == pytest.approx([srgb(light / 203)] * 3, abs=1.5)
    assert shown(PQ, 0, 0, 0) == [0, 0, 0]
    assert shown(PQ, *[code_of(1000)] * 3) == [255] * 3 == shown(PQ, 1, 1, 1)


def test_white_is_the_same_in_both() -> None:
    """BT.2408: white is at 58 % of PQ and at 75 % of HLG, 203 cd/m2. BT.2390's spline at it, by hand, gives 160."""
    peak, most = code_of(1000), code_of(203) / code_of(1000)
    knee = 1.5 * most - 0.5
    t = (most - knee) / (1 - knee)
    rolled = (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee) + (3 * t**2 - 2 * t**3) * most
    low, high = 0.0, 1000.0
    for _ in range(60):
        low, high = ((low + high) / 2, high) if code_of((low + high) / 2) < rolled * peak else (low, (low + high) / 2)
    assert low == pytest.approx(160, abs=1)
    assert shown(PQ, *[code_of(203)] * 3) == pytest.approx([srgb(low / 203)] * 3, abs=1.5)
    assert shown(HLG, 0.75, 0.75, 0.75) == pytest.approx([srgb(low / 203)] * 3, abs=1.5)


def test_the_curve_and_the_system_gamma_of_hlg() -> None:
    """At half of the code the scene has 1/12 of its light: 1000 * (1/12)^1.2 = 50.7 cd/m2."""
    assert shown(HLG, 0.5, 0.5, 0.5) == pytest.approx([srgb(1000 * (1 / 12) ** 1.2 / 203)] * 3, abs=1.5)
    assert shown(HLG, 1, 1, 1) == [255] * 3


def test_wide_primaries_are_brought_to_those_of_srgb() -> None:
    """sRGB's own red of 40 cd/m2, in BT.2020 (0.6274, 0.0691, 0.0164), comes back as red; with its hue."""
    wide = [code_of(40 * share) for share in (0.6274, 0.0691, 0.0164)]
    assert shown(PQ, *wide) == pytest.approx([srgb(40 / 203), 0, 0], abs=4)
    assert shown(PQ, code_of(40), 0, 0, is_wide=False) == pytest.approx([srgb(40 / 203), 0, 0], abs=1.5)
    assert math.isclose(sum((1.6605, -0.5876, -0.0728)), 1.0, abs_tol=2e-4)
