"""Spearman's rank correlation, by hand."""

from __future__ import annotations

import pytest

from trilane.bench.placement import rank_correlation


def test_ranks_that_agree_and_ranks_that_do_not() -> None:
    """By hand: 1 - 6 sum(d^2) / (n (n^2 - 1)) without equal values."""
    assert rank_correlation([1, 5, 9, 700], [2, 3, 4, 5]) == pytest.approx(1)
    assert rank_correlation([1, 2, 3], [9, 8, 7]) == pytest.approx(-1)
    assert rank_correlation([1, 2, 3, 4, 5], [2, 1, 4, 3, 5]) == pytest.approx(1 - 6 * 4 / (5 * 24))
    # ranks 1, 2.5, 2.5, 4 and 1, 2, 3, 4: covariance 2.25 + 0 + 0 + 2.25 = 4.5, spreads 4.5 and 5
    assert rank_correlation([1, 2, 2, 3], [1, 2, 3, 4]) == pytest.approx(4.5 / (4.5 * 5) ** 0.5)
    assert rank_correlation([1, 1], [1, 2]) is None
    with pytest.raises(ValueError, match="argument 2"):
        rank_correlation([1, 2], [1])
