"""Many comparisons at a time. Rule: of all that is compared in a pair of runs, nothing is called different by chance

with more than a probability of 1 %. Holm, "A simple sequentially rejective multiple test procedure", Scandinavian
Journal of Statistics 6 (1979): it needs no independence of the comparisons.
"""

from __future__ import annotations

from collections.abc import Sequence

ALPHA = 0.01


def rejected(probabilities: Sequence[float], alpha: float = ALPHA) -> list[bool]:
    """Which of the hypotheses "no difference" fall, each given by the probability of what was seen under it."""
    order = sorted(range(len(probabilities)), key=probabilities.__getitem__)
    fallen = [False] * len(probabilities)
    for rank, place in enumerate(order):
        if probabilities[place] > alpha / (len(order) - rank):
            break
        fallen[place] = True
    return fallen
