"""Summaries of times. Rule: percentiles are exact for what was measured (linear between ranks), without bins."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from math import ceil, comb, log

NS_PER_MS = 1e6
CONFIDENCE = 0.95
SCORE_PER_MS = 15.0
LARGEST_ENERGY_MJ = 1500.0
LARGEST_EXPONENT = 700.0  # e to this power is still a number


def percentile(ordered: Sequence[int], share: float) -> float:
    """Interpolate linearly between the two nearest ranks of the sorted `ordered`; return 0 if it is empty."""
    if not ordered:
        return 0.0
    place = share * (len(ordered) - 1)
    low = int(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (ordered[high] - ordered[low]) * (place - low)


def summary_ms(values_ns: Iterable[int]) -> dict[str, float]:
    """Return mean, p50, p90, p95, p99 and max in ms, all 0 without values, and the number of values as `samples`."""
    ordered = sorted(values_ns)
    return summary_row(
        len(ordered), sum(ordered), ordered[-1] if ordered else 0, lambda share: percentile(ordered, share)
    )


def summary_row(count: int, total: int, largest: int, percentile_of: Callable[[float], float]) -> dict[str, float]:
    """Return `summary_ms` of `count` values in ns. `percentile_of`: function that returns their percentiles in ns."""
    if not count:
        return dict.fromkeys(("mean", "p50", "p90", "p95", "p99", "max", "samples"), 0)
    ranks = {f"p{rank}": percentile_of(rank / 100) for rank in (50, 90, 95, 99)}
    row = {"mean": total / count, **ranks, "max": largest}
    return {**{key: round(value / NS_PER_MS, 6) for key, value in row.items()}, "samples": count}


def samples_needed(share: float) -> int:
    """Return how many samples a percentile needs, so that the largest of them exceeds it with 95 % confidence.

    This is the least n with 1 - share^n >= 0.95: 29 for p90, 59 for p95, 299 for p99. With fewer, the samples
    themselves do not show that they reach up to it. Wilks, Annals of Mathematical Statistics 12 (1941), 91-96.
    """
    return ceil(log(1 - CONFIDENCE) / log(share))


def median_interval(values: Sequence[float], confidence: float = 0.95) -> tuple[float, float]:
    """Return the two values between which the median of their distribution lies with at least `confidence`.

    By the sign test: the k-th least and the k-th largest, k the largest with P(B(n, 1/2) < k) <= (1 - confidence) / 2.
    With too few values for that (below six for 0.95), the least and the largest. Raises ValueError for no values.
    """
    if not values:
        raise ValueError("no values")
    ordered, outside, rank = sorted(values), 0.0, 0
    while (outside := outside + comb(len(ordered), rank) / 2 ** len(ordered)) <= (1 - confidence) / 2:
        rank += 1
    rank = max(rank, 1)
    return ordered[rank - 1], ordered[-rank]


def energy_score(frame_mj: float) -> float:
    """Return (E - e) / E, e the millijoules of a frame, E = `LARGEST_ENERGY_MJ`: 1 for nothing, 0 for E and more.

    Kwon et al., XRBench, MLSys 2023, section 3, with their E.
    """
    return max(0.0, 1 - frame_mj / LARGEST_ENERGY_MJ)
