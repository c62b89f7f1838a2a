"""Whether two lists order things alike. Rule: Spearman's coefficient; equal values share the mean of their ranks."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> float | None:
    """Pearson's correlation of the ranks, from -1 to 1; None where one list has no order, for all of it is equal.

    Spearman, American Journal of Psychology 15 (1904), 72-101. Raises ValueError for lists of different lengths.
    """
    pairs = list(zip(_ranks(first), _ranks(second), strict=True))
    middle = (len(pairs) + 1) / 2
    covariance = sum((a - middle) * (b - middle) for a, b in pairs)
    spread = sum((a - middle) ** 2 for a, _ in pairs) * sum((b - middle) ** 2 for _, b in pairs)
    return covariance / sqrt(spread) if spread else None


def _ranks(values: Sequence[float]) -> list[float]:
    ordered = sorted(values)
    return [ordered.index(value) + (ordered.count(value) + 1) / 2 for value in values]
