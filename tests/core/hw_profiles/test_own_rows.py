"""Published latencies judge a fit to five own rows: every chip is left out of the whole fit in turn.

The bounds are what the decision record promises, not what was seen.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from support.own_rows import NEIGHBOUR, cover, evaluated, median_error

DRAWS = 20


@pytest.mark.slow
@pytest.mark.parametrize("chip", NEIGHBOUR)
def test_an_unseen_chip_is_met_from_five_rows(chip: str, shared_data: Path) -> None:
    draws, floor = evaluated(shared_data / "chips", chip, DRAWS)
    rows = [row for draw in draws if draw.engine is not None for row in draw.rows]
    assert 0.7 <= cover(rows, "after") <= 0.9
    before, after = (median_error(rows, after=is_after) for is_after in (False, True))
    assert floor < after < before
    # where half of the error leaves room above what the model can reach at all
    assert after <= before / 2 or before < 4 * floor
