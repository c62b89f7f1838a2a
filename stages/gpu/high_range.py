"""Pictures of high dynamic range, PQ or HLG, as sRGB of eight bits.

Rule: light is computed by the published curves, rolled off above what a common display shows by the curve of ITU-R
BT.2390 on the largest of the three primaries, which keeps the hue, and only then brought to the primaries of sRGB.
Sources: PQ, HLG and its system gamma are ITU-R BT.2100-2; the roll-off is BT.2390-10, 5.4.1; reference white at
203 cd/m2 is BT.2408-5; the matrix is that of BT.2087-0.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, F64, U8

PQ, HLG = "PQ", "HLG"
#: Light of white in the result, and the brightest light that is told from it, cd/m2.
WHITE, PEAK = 203.0, 1000.0
HLG_GAMMA = 1.2  # of a display whose peak is 1000 cd/m2
STEPS = 4096
M1 = 0.1593017578125
LUMA_2020 = np.array([0.2627, 0.6780, 0.0593], np.float32)
SRGB_FROM_2020 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)


def to_srgb(codes: NDArray[np.uint16], transfer: str, is_wide: bool) -> U8:
    """(h,w,3) uint8 sRGB of `codes` (h,w,3), R'G'B' of `transfer`, 0 to 65535.

    `is_wide`: whether their primaries are those of BT.2020; else they are those of sRGB.
    """
    light = _eotf(transfer)[codes >> 4]
    if transfer == HLG:
        luma = light @ LUMA_2020
        light *= (PEAK * np.power(np.maximum(luma, 1e-6), HLG_GAMMA - 1))[..., None]
    brightest = np.maximum(np.maximum(light[..., 0], light[..., 1]), light[..., 2])
    steps = np.sqrt(np.minimum(brightest, PEAK)) * ((STEPS - 1) / np.sqrt(PEAK))
    shown = light * _gains()[steps.astype(np.int32)][..., None]
    if is_wide:
        shown = shown @ SRGB_FROM_2020.T
    shade: U8 = _srgb()[(np.sqrt(np.clip(shown, 0, 1)) * (STEPS - 1) + 0.5).astype(np.int32)]
    return shade


@cache
def _eotf(transfer: str) -> F32:
    """Of each of STEPS codes: PQ's light in cd/m2; HLG's light of the scene, 0 to 1."""
    code = np.arange(STEPS) / (STEPS - 1)
    if transfer == PQ:
        return pq_light(code).astype(np.float32)
    a = 0.17883277
    b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
    return np.where(code <= 0.5, code**2 / 3, (np.exp((code - c) / a) + b) / 12).astype(np.float32)


def pq_light(code: F64) -> F64:
    """cd/m2 of PQ's `code`, 0 to 1."""
    power = np.power(code, 1 / 78.84375)
    return np.asarray(10000 * np.power(np.maximum(power - 0.8359375, 0) / (18.8515625 - 18.6875 * power), 1 / M1))


def pq_code(light: F64) -> F64:
    """PQ's code, 0 to 1, of `light` in cd/m2."""
    power = np.power(light / 10000, M1)
    return np.asarray(np.power((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power), 78.84375))


@cache
def _gains() -> F32:
    """What light is multiplied by, in STEPS steps of its square root up to that of PEAK."""
    light = np.maximum(np.linspace(0, np.sqrt(PEAK), STEPS), 1e-3) ** 2
    gains: F32 = (roll_off(light) / light).astype(np.float32)
    return gains


def roll_off(light: F64) -> F64:
    """Light of a display, 1 for white, of `light` up to PEAK: BT.2390's spline between codes of PQ."""
    peak = pq_code(np.array(PEAK))
    code, most = pq_code(light) / peak, float(pq_code(np.array(WHITE)) / peak)
    knee = 1.5 * most - 0.5
    t = np.clip((code - knee) / (1 - knee), 0, 1)
    spline = (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee) + (3 * t**2 - 2 * t**3) * most
    return np.asarray(pq_light(np.where(code < knee, code, spline) * peak) / WHITE)


@cache
def _srgb() -> U8:
    """sRGB of the square of each of STEPS numbers from 0 to 1."""
    light = (np.arange(STEPS) / (STEPS - 1)) ** 2
    curve = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.power(light, 1 / 2.4) - 0.055)
    return (curve * 255 + 0.5).astype(np.uint8)
