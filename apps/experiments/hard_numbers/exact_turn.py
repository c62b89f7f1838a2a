"""Rotations to sixty digits, by Python's decimal numbers: a second computation of what body/kinematics.py does.

Rule: nothing is shared with the code that is tested. R - I = a [v]x + b [v]x^2, a = sin(t) / t, b = (1 - cos(t)) / t^2,
t = |v|, with series in t^2 after t was reduced by multiples of 2 pi.
"""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal, localcontext

import numpy as np

from trilane.arrays import F64

DIGITS = 80
PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459230781640628620899862803482534211706798")
#: Where sin(t) / t and (1 - cos(t)) / t^2 are taken by the first terms of their series, to all digits.
TINY = Decimal("1e-30")


def exact_turn(rotvec: Sequence[float]) -> list[list[Decimal]]:
    """R - I of the axis-angle vector `rotvec` (3,), radians, below 1e9 of magnitude."""
    with localcontext() as context:
        context.prec = DIGITS
        x, y, z = (Decimal(float(value)) for value in rotvec)
        squared = x * x + y * y + z * z
        sine, cosine = _factors(squared)
        return [
            [-cosine * (y * y + z * z), cosine * x * y - sine * z, cosine * x * z + sine * y],
            [cosine * x * y + sine * z, -cosine * (x * x + z * z), cosine * y * z - sine * x],
            [cosine * x * z - sine * y, cosine * y * z + sine * x, -cosine * (x * x + y * y)],
        ]


def turn_error(found: F64, exact: Sequence[Sequence[Decimal]]) -> float:
    """The largest difference of an entry of `found` (3, 3); NaN where one is no number."""
    if not np.isfinite(found).all():
        return float("nan")
    with localcontext() as context:
        context.prec = DIGITS
        differences = [abs(Decimal(float(found[i, j])) - exact[i][j]) for i in range(3) for j in range(3)]
        return float(max(differences))


def _factors(squared: Decimal) -> tuple[Decimal, Decimal]:
    """sin(t) / t and (1 - cos(t)) / t^2 of t^2."""
    angle = squared.sqrt()
    if angle < TINY:
        return 1 - squared / 6, Decimal("0.5") - squared / 24
    turned = angle % (2 * PI)
    if turned > PI:
        turned -= 2 * PI
    sine, cosine_below_one = _series(turned)
    return sine / angle, cosine_below_one / squared


def _series(angle: Decimal) -> tuple[Decimal, Decimal]:
    """sin and 1 - cos of an angle of at most pi, by Taylor's series."""
    term, sine, missing = angle, angle, Decimal(0)
    power = Decimal(1)
    for n in range(1, 60):
        power = -power * angle * angle / ((2 * n - 1) * (2 * n))
        missing -= power
        term = -term * angle * angle / ((2 * n) * (2 * n + 1))
        sine += term
    return sine, missing
