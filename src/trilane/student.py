"""Student's t distribution: its tails in closed form, and its quantiles."""

from __future__ import annotations

from functools import lru_cache
from math import atan, cos, erfc, inf, pi, sin, sqrt
from typing import Final

CONFIDENCE: Final = 0.95


@lru_cache(maxsize=4096)
def student_tails(t: float, freedom: float) -> float:
    """Return the probability that Student's t is beyond ±`t`.

    `freedom`: degrees of freedom, a whole number or inf.
    Source: Abramowitz and Stegun, Handbook of Mathematical Functions, 26.7.3 and 26.7.4.
    """
    if freedom == inf or t == inf:
        return erfc(t / sqrt(2))
    angle, odd = atan(t / sqrt(freedom)), int(freedom) % 2
    term = cos(angle) if odd else 1.0
    total = term if freedom > 1 else 0.0
    for count in range(2 + odd, int(freedom) - 1, 2):
        term *= cos(angle) ** 2 * (count - 1) / count
        total += term
    inside = 2 / pi * (angle + sin(angle) * total) if odd else sin(angle) * total
    return max(1 - inside, 0.0)


@lru_cache(maxsize=256)
def student_quantile(freedom: float, confidence: float = CONFIDENCE) -> float:
    """Return the two-sided quantile q of Student's t: |t| exceeds q with probability 1 - `confidence`.

    `freedom`: degrees of freedom, a whole number or inf.
    """
    low, high = 0.0, 1e3
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if student_tails(middle, freedom) > 1 - confidence else (low, middle)
    return low
