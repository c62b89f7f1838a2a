"""Summarises the times between presented frames as they come.

Rule: the memory for them does not grow with their number.

While all times are still kept (`trilane.scheduler.samples`), the interval of their mean is computed from them. After
that it is computed from the means of blocks of equally many times, each about a thousandth of the run.
"""

from __future__ import annotations

from collections.abc import Callable
from math import exp
from typing import Final

from trilane.scheduler.samples import Samples, Sketch
from trilane.scheduler.stats import LARGEST_EXPONENT, NS_PER_MS, SCORE_PER_MS
from trilane.scheduler.uncertainty import fps_interval, frame_interval_ms, mean_interval

SPAN: Final = 20  # frames of the exponential average
WEIGHT: Final = 2 / (SPAN + 1)
MOST_BLOCKS: Final = 2048


class FrameTimes:
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
        """Return `frame_time_ms` of a report: summary, exponential average, jitter, interval of the mean.

        The average over SPAN frames (weight 2 / (SPAN + 1)) counts from frame SPAN on, if there are that many. Jitter
        is the mean absolute difference of successive times.
        """
        return {
            **self.samples.summary_ms(),
            f"ema{SPAN}_min": round(self._least / NS_PER_MS, 6),
            f"ema{SPAN}_max": round(self._most / NS_PER_MS, 6),
            "jitter": round(self._steps_ns / max(self.samples.count - 1, 1) / NS_PER_MS, 6),
            **frame_interval_ms(self._interval()),
        }

    def fps_interval(self) -> dict[str, float | None]:
        """Return `fps_low` and `fps_high` of a report."""
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


class Lateness:
    """How late frames were.

    `count`: number of frames that had a deadline.
    `missed`: number of frames that came after it.
    """

    def __init__(self) -> None:
        self.count = self.missed = 0
        self._score = 0.0

    def add(self, late_ns: int) -> None:
        """Add a frame that came `late_ns` after its deadline, or before it if that is negative."""
        self.count += 1
        self.missed += late_ns > 0
        self._score += 1 / (1 + exp(min(SCORE_PER_MS * late_ns / NS_PER_MS, LARGEST_EXPONENT)))

    @property
    def real_time_score(self) -> float | None:
        """The mean of 1 / (1 + e^(15 l)), l the lateness of a frame in ms: 1 in time, 0 late, None for no frame.

        Kwon et al., XRBench, MLSys 2023, section 3.
        """
        return self._score / self.count if self.count else None
