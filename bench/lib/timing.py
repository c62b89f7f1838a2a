"""Times of variants that run interleaved in this process. Rule: a busy machine hits all variants alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np

WARM_UP = 5


def interleaved_ms(variants: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, list[float]]:
    """Milliseconds of each variant in each of `repeats` rounds, after a warm-up; a round runs every variant once."""
    times: dict[str, list[float]] = {name: [] for name in variants}
    for round_number in range(-WARM_UP, repeats):
        for name, run in variants.items():
            start = time.perf_counter_ns()
            run()
            if round_number >= 0:
                times[name].append((time.perf_counter_ns() - start) / 1e6)
    return times


def summary_ms(times_ms: list[float]) -> dict[str, float]:
    """Median, minimum and 90th percentile in milliseconds."""
    return {
        "median_ms": float(np.median(times_ms)),
        "min_ms": float(np.min(times_ms)),
        "p90_ms": float(np.percentile(times_ms, 90)),
    }
