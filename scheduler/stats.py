"""Summaries of the times of a run: percentiles, means with their uncertainty, and scores.

Rule: while there are few values, percentiles are exact (linear between ranks, without bins). Percentiles of many values
come from a sketch; `is_exact` says which holds. A sketch is a structure of bounded size that gives percentiles within a
stated error. This folder contains no sketch: the caller of `Samples` provides one for a run that may last for days.
Without a sketch, all values are kept.

The confidence interval of the mean frame time follows from the run's own frames. Successive frames are not independent,
so the method is nonoverlapping batch means. The times are cut into batches of equal length. A batch has more frames
than one slow frame can delay. The means of the batches count as independent, and Student's t over them gives the
interval. Once a sketch holds the times, the interval is computed from the means of blocks. Each block has the same
number of times, about a thousandth of the run.

Sources: Schmeiser, "Batch Size Effects in the Analysis of Simulation Output", Operations Research 30 (1982), who finds
little use in more than 10 to 30 batches; Law, Simulation Modeling and Analysis, chapter 9.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from math import atan, ceil, comb, cos, erfc, exp, inf, log, pi, sin, sqrt
from statistics import fmean, stdev
from typing import Final, Protocol

from trilane.scheduler.events import NEVER
from trilane.units import NS_PER_MS, NS_PER_S

#: Probability with which an interval of measured values contains the true value, as a number and in words.
CONFIDENCE: Final = 0.95
CONFIDENCE_TEXT: Final = f"{100 * CONFIDENCE:.0f} %"
SCORE_PER_MS = 15.0
LARGEST_ENERGY_MJ = 1500.0
LARGEST_EXPONENT = 700.0  # e to this power is still a number
#: The percentiles of a summary: name -> share of the values below it.
PERCENTILES: Final = {f"p{rank}": rank / 100 for rank in (50, 90, 95, 99)}


def percentile(ordered: Sequence[int], share: float) -> float:
    """Return the percentile at `share` (0 to 1) of sorted values, linear between ranks; 0 without values."""
    if not ordered:
        return 0.0
    place = share * (len(ordered) - 1)
    low = int(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (ordered[high] - ordered[low]) * (place - low)


def summary_ms(values_ns: Iterable[int]) -> dict[str, float]:
    """Return `mean`, PERCENTILES and `max` in ms (0 without values), and the number `samples`."""
    ordered = sorted(values_ns)
    return _summary_row(
        len(ordered), sum(ordered), ordered[-1] if ordered else 0, lambda share: percentile(ordered, share)
    )


def _summary_row(count: int, total: int, largest: int, percentile_of: Callable[[float], float]) -> dict[str, float]:
    """Return `summary_ms` of `count` values in ns, from their sum, the largest and a function for percentiles."""
    if not count:
        return dict.fromkeys(("mean", *PERCENTILES, "max", "samples"), 0)
    percentiles = {name: percentile_of(share) for name, share in PERCENTILES.items()}
    row = {"mean": total / count, **percentiles, "max": largest}
    return {**{key: round(value / NS_PER_MS, 6) for key, value in row.items()}, "samples": count}


def samples_needed(share: float) -> int:
    """Return how many samples are needed so that the largest exceeds a percentile with a probability of 95 %.

    This is the least n with 1 - share^n >= 0.95: 29 for p90, 59 for p95, 299 for p99. With fewer samples, the
    probability that all of them are below the percentile is over 5 %.
    Source: Wilks, Annals of Mathematical Statistics 12 (1941), 91-96.
    `share`: the percentile as a share, such as 0.99 for p99; above 0 and below 1.
    """
    return ceil(log(1 - CONFIDENCE) / log(share))


#: The number of samples that each percentile above the median needs, by the percentile's name.
NEEDED: Final = {name: samples_needed(share) for name, share in PERCENTILES.items() if share > 0.5}


def median_interval(values: Sequence[float], confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return two of `values` (low, high): their distribution's median lies between them with at least `confidence`.

    By the sign test they are the k-th least and the k-th largest of the n values. k is the largest number with
    P(B(n, 1/2) < k) <= (1 - confidence) / 2, where B is binomial. If no k >= 1 meets this (below six values for 0.95),
    the least and the largest value are returned. Raises ValueError for no values.
    """
    if not values:
        raise ValueError("no values")
    ordered, outside, rank = sorted(values), 0.0, 0
    while (outside := outside + comb(len(ordered), rank) / 2 ** len(ordered)) <= (1 - confidence) / 2:
        rank += 1
    rank = max(rank, 1)
    return ordered[rank - 1], ordered[-rank]


def energy_score(frame_mj: float) -> float:
    """Return the energy score of a frame of `frame_mj` millijoules: 1 for 0 mJ, 0 for `LARGEST_ENERGY_MJ` and more.

    Source: Kwon et al., XRBench, MLSys 2023, section 3; the largest energy is theirs.
    """
    return max(0.0, 1 - frame_mj / LARGEST_ENERGY_MJ)


MOST_BATCHES = 10
LEAST_BATCHES = 5
#: Least number of frames in a batch: as many as can be in flight in five stages, with two slots between neighbours.
LEAST_FRAMES = 10


def mean_interval(values: Sequence[float], mean: float | None = None) -> tuple[float, float] | None:
    """Return the 95 % interval (low, high) of the mean of an endless run like this one, in the values' unit of measure.

    Return None if the values are fewer than `LEAST_BATCHES` batches of `LEAST_FRAMES`, or if the interval reaches 0.

    `values`: values above 0 in the order of measurement. The first values, which do not fill a batch, count only for
    the mean.
    `mean`: mean of all single values, if `values` are means of blocks; None: the mean of `values`.
    """
    batches = min(len(values) // LEAST_FRAMES, MOST_BATCHES)
    if batches < LEAST_BATCHES:
        return None
    mean = fmean(values) if mean is None else mean
    half = _half_width(values, batches)
    return (mean - half, mean + half) if half < mean else None


def batch_interval(values: Sequence[float]) -> float | None:
    """Return half the width of the 95 % interval of a mean; None for fewer than LEAST_BATCHES batches.

    If there are more than MOST_BATCHES batches, neighbours are merged.

    `values`: one value for each batch, over equal batches of at least LEAST_FRAMES frames.
    """
    batches = min(len(values), MOST_BATCHES)
    return _half_width(values, batches) if batches >= LEAST_BATCHES else None


def _half_width(values: Sequence[float], batches: int) -> float:
    """Return half the width of the 95 % interval, by Student's t over the means of `batches` batches.

    First values that fill no batch do not count.
    """
    length = len(values) // batches
    first = len(values) - batches * length
    means = [fmean(values[first + batch * length : first + (batch + 1) * length]) for batch in range(batches)]
    return student_quantile(batches - 1) * stdev(means) / sqrt(batches)


def frame_interval_ms(interval_ns: tuple[float, float] | None) -> dict[str, float | None]:
    """Return `mean_low` and `mean_high` of the frame time in ms; both are None without an interval.

    `interval_ns`: interval (low, high) of the mean frame time in ns.
    """
    low, high = interval_ns or (None, None)
    return {"mean_low": low and low / NS_PER_MS, "mean_high": high and high / NS_PER_MS}


def fps_interval(interval_ns: tuple[float, float] | None) -> dict[str, float | None]:
    """Return `fps_low` and `fps_high`, in frames a second; both are None without an interval.

    `interval_ns`: interval (low, high) of the mean frame time in ns.
    """
    low, high = interval_ns or (None, None)
    return {"fps_low": high and NS_PER_S / high, "fps_high": low and NS_PER_S / low}


#: Most values that are kept for exact percentiles: runs of some minutes stay exact, and runs of days stay small
#: (docs/decisions/journal.md).
MOST_EXACT: Final = 20_000
#: Number of kept values that move to the sketch with each further value, so that no step of the scheduler takes long.
MOVED_AT_ONCE: Final = 4


class Sketch(Protocol):
    """A structure of bounded size that gives percentiles of any number of values."""

    def add(self, value: int) -> None:
        """Add one value."""

    def percentile(self, share: float) -> float:
        """Return the percentile at `share` (0 to 1), within the error of the sketch."""


class Samples:
    """Values in ns. `count`, `total` and `largest` are exact.

    `kept`: values that are kept, in the order in which they came.
    `is_exact`: whether `kept` has all values. If not, each further value moves a few kept values to the sketch.
    """

    def __init__(self, sketch: Callable[[], Sketch] | None = None) -> None:
        """Begin without values.

        `sketch`: function that makes the sketch for more than MOST_EXACT values; None: all values are kept.
        """
        self.count = self.total = self.largest = 0
        self.kept = array("q")
        self._make_sketch = sketch
        self._sketch: Sketch | None = None

    @property
    def is_exact(self) -> bool:
        return self._sketch is None

    @property
    def mean(self) -> float:
        """The mean in ns; 0 without values."""
        return self.total / self.count if self.count else 0.0

    def add(self, value: int) -> None:
        if value > self.largest or not self.count:
            self.largest = value
        self.count += 1
        self.total += value
        if self._sketch is not None:
            self._sketch.add(value)
            self._move(MOVED_AT_ONCE)
            return
        self.kept.append(value)
        if self._make_sketch is not None and self.count > MOST_EXACT:
            self._sketch = self._make_sketch()

    def summary_ms(self) -> dict[str, float]:
        """Return the summary of all values, with the keys of the function `summary_ms`."""
        sketch = self._sketch
        if sketch is None:
            ordered = sorted(self.kept)
            return _summary_row(self.count, self.total, self.largest, lambda share: percentile(ordered, share))
        self._move(len(self.kept))
        return _summary_row(self.count, self.total, self.largest, sketch.percentile)

    def _move(self, count: int) -> None:
        if self._sketch is not None:
            for _ in range(min(count, len(self.kept))):
                self._sketch.add(self.kept.pop())


SPAN: Final = 20  # frames of the exponential average
WEIGHT: Final = 2 / (SPAN + 1)
MOST_BLOCKS: Final = 2048


class FrameTimeSamples:
    """The times between presented frames. `samples`: the times in ns."""

    def __init__(self, sketch: Callable[[], Sketch] | None = None) -> None:
        self.samples = Samples(sketch)
        self._last_ns = self._steps_ns = 0
        self._average = self._least = self._most = 0.0
        self._blocks: list[float] = []
        self._block_frames = 1
        self._open_ns = self._open_frames = 0

    def add(self, interval_ns: int) -> None:
        """Add the time from one presented frame to the next."""
        number = self.samples.count
        if number:
            self._steps_ns += abs(interval_ns - self._last_ns)
            self._average += WEIGHT * (interval_ns - self._average)
        else:
            self._average = float(interval_ns)
        if number < SPAN:
            self._least = self._most = self._average
        else:
            self._least, self._most = min(self._least, self._average), max(self._most, self._average)
        self._last_ns = interval_ns
        self.samples.add(interval_ns)
        self._add_to_block(interval_ns)

    def row(self) -> dict[str, float | None]:
        """Return the object `frame_time_ms` of a report, in ms.

        It has the keys of the function `summary_ms`, the least and largest exponential average (`ema20_min`,
        `ema20_max`), `jitter`, and the interval of the mean (`mean_low`, `mean_high`). The exponential average (weight
        2 / (SPAN + 1)) counts from frame SPAN on; in a shorter run, only its last value counts. Jitter is the mean
        absolute difference of successive times; None for fewer than two times.
        """
        count = self.samples.count
        return {
            **self.samples.summary_ms(),
            f"ema{SPAN}_min": round(self._least / NS_PER_MS, 6),
            f"ema{SPAN}_max": round(self._most / NS_PER_MS, 6),
            "jitter": round(self._steps_ns / (count - 1) / NS_PER_MS, 6) if count > 1 else None,
            **frame_interval_ms(self._interval()),
        }

    def fps_interval(self) -> dict[str, float | None]:
        """Return `fps_low` and `fps_high` of a report, in frames a second; both are None without an interval."""
        return fps_interval(self._interval())

    def _interval(self) -> tuple[float, float] | None:
        if self.samples.is_exact:
            return mean_interval(self.samples.kept)
        return mean_interval(self._blocks, self.samples.mean)

    def _add_to_block(self, interval_ns: int) -> None:
        self._open_ns += interval_ns
        self._open_frames += 1
        if self._open_frames == self._block_frames:
            self._blocks.append(self._open_ns / self._open_frames)
            self._open_ns = self._open_frames = 0
        if len(self._blocks) == MOST_BLOCKS:
            # Two neighbours become one block, so that the memory stays bounded.
            pairs = zip(self._blocks[::2], self._blocks[1::2], strict=True)
            self._blocks = [(before + after) / 2 for before, after in pairs]
            self._block_frames *= 2


def due_ns(deadline_ns: int, before_ns: int | None, target_period_ns: int) -> int:
    """Return the time in ns after which a frame is late; NEVER if nothing says when the frame is due.

    `deadline_ns`: time of the frame's own deadline; NEVER without one.
    `before_ns`: time at which the frame before it was presented; None if the time since then is no frame time.
    `target_period_ns`: longest frame time that counts as in time; it replaces the deadlines. 0: the deadlines count.
    """
    if not target_period_ns:
        return deadline_ns
    return NEVER if before_ns is None else before_ns + target_period_ns


class Lateness:
    """How late frames were, by `due_ns`.

    `count`: number of frames with a due time.
    `missed`: number of frames that came after their due time.
    """

    def __init__(self) -> None:
        self.count = self.missed = 0
        self._score = 0.0

    def add(self, late_ns: int) -> None:
        """Add a frame that came `late_ns` after its due time; below 0: before it."""
        self.count += 1
        self.missed += late_ns > 0
        self._score += 1 / (1 + exp(min(SCORE_PER_MS * late_ns / NS_PER_MS, LARGEST_EXPONENT)))

    @property
    def real_time_score(self) -> float | None:
        """The mean score of the frames, from 1 (long before the due time) to 0 (late); None without a frame.

        The score of a frame is 1 / (1 + e^(15 l)), where l is its lateness in ms (Kwon et al., XRBench, MLSys 2023,
        section 3).
        """
        return self._score / self.count if self.count else None


@lru_cache(maxsize=4096)
def student_tails(t: float, freedom: float) -> float:
    """Return the probability that the absolute value of Student's t is above `t`, which is at least 0.

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
    """Return the two-sided quantile of Student's t: |t| exceeds it with probability 1 - `confidence`.

    `freedom`: degrees of freedom, a whole number or inf. The quantile is found by bisection.
    """
    low, high = 0.0, 1e3
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if student_tails(middle, freedom) > 1 - confidence else (low, middle)
    return low
