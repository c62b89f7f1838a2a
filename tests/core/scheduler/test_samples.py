"""Statistics of any number of times: exact while they are few, then within the stated error and of bounded size."""

from __future__ import annotations

import random
from array import array
from math import exp

import numpy as np
import pytest

from trilane.pipeline.run import RELATIVE_ERROR, DdSketch
from trilane.scheduler.events import NEVER, chain
from trilane.scheduler.ledger import Books, Ledger
from trilane.scheduler.stats import MOST_BLOCKS, MOST_EXACT, MOVED_AT_ONCE, FrameTimeSamples, Samples, summary_ms

RANKS = (50, 90, 95, 99)


class Counting:
    """A sketch that keeps what it is given."""

    def __init__(self) -> None:
        self.values: list[int] = []

    def add(self, value: int) -> None:
        self.values.append(value)

    def percentile(self, share: float) -> float:
        return 1e6 * share


def times(count: int, seed: int = 3) -> list[int]:
    """Skewed, as frame times are: 5 ms and more, some of a second."""
    draw = np.random.default_rng(seed)
    return (5e6 * draw.lognormal(0.3, 0.8, count)).astype(int).tolist()


@pytest.mark.parametrize("sketch", [None, DdSketch])
def test_few_values_are_exact(sketch: type[DdSketch] | None) -> None:
    values = times(MOST_EXACT)
    found = Samples(sketch)
    for value in values:
        found.add(value)
    assert found.is_exact and found.kept == array("q", values)
    assert found.summary_ms() == summary_ms(values)
    assert Samples().summary_ms() == summary_ms([]) and Samples().mean == 0


def test_more_values_are_within_the_error_and_their_number_mean_and_largest_exact() -> None:
    """Of 25,000 values, against NumPy's lower ranks, which is what the sketch bounds."""
    values = times(25_000)
    found = Samples(DdSketch)
    for value in values:
        found.add(value)
    row, exact = found.summary_ms(), summary_ms(values)
    assert not found.is_exact and len(found.kept) == 0
    assert [row[key] for key in ("mean", "max", "samples")] == [exact[key] for key in ("mean", "max", "samples")]
    for rank in RANKS:
        expected = np.percentile(values, rank, method="lower") / 1e6
        assert abs(row[f"p{rank}"] - expected) <= RELATIVE_ERROR * expected + 1e-6
    assert row != exact


def test_values_move_into_the_sketch_a_few_at_a_time_and_none_is_lost() -> None:
    found, made = Samples(lambda: made[-1]), [Counting()]  # type: ignore[has-type]
    values = list(range(1, MOST_EXACT + 101))
    random.Random(1).shuffle(values)
    for value in values:
        found.add(value)
    assert len(made[0].values) == 99 * (MOVED_AT_ONCE + 1)
    assert len(found.kept) == len(values) - len(made[0].values)
    assert found.summary_ms()["p50"] == 0.5
    assert sorted(made[0].values) == sorted(values)


def test_the_interval_of_a_long_run_is_that_of_all_its_frames() -> None:
    """30,000 frames are 1,875 blocks of 16: each of the ten batches begins at most five of them later or earlier."""
    values = times(30_000)
    bounded, whole = FrameTimeSamples(DdSketch), FrameTimeSamples()
    for value in values:
        bounded.add(value)
        whole.add(value)
    assert (len(bounded._blocks), bounded._block_frames) == (1875, 16)
    found, expected = bounded.row(), whole.row()
    width = expected["mean_high"] - expected["mean_low"]  # type: ignore[operator]
    for key in ("mean_low", "mean_high"):
        assert abs(found[key] - expected[key]) < 0.1 * width  # type: ignore[operator]
    for key in ("mean", "max", "samples", "ema20_min", "ema20_max", "jitter"):
        assert found[key] == expected[key]
    assert bounded.fps_interval() == {
        "fps_low": pytest.approx(1e3 / found["mean_high"]),  # type: ignore[operator]
        "fps_high": pytest.approx(1e3 / found["mean_low"]),  # type: ignore[operator]
    }


def test_blocks_are_joined_in_pairs() -> None:
    """When there are 2,048 of one frame, 1 2 3 4 ... becomes 1.5 3.5 ...; then a block has two frames."""
    row = FrameTimeSamples()
    for value in range(1, MOST_BLOCKS + 4):
        row.add(value)
    assert (row._blocks[:2], len(row._blocks), row._open_frames) == ([1.5, 3.5], MOST_BLOCKS // 2 + 1, 1)
    assert (row._blocks[-1], row._block_frames) == (MOST_BLOCKS + 1.5, 2)


def test_a_ledger_with_a_sketch_holds_no_frame() -> None:
    """Deadlines of the frames, or of their times; rungs counted with the changes between them."""
    graph, frames = chain((("a", "u"),), "single", "a"), MOST_EXACT + 20
    bounded, whole = Ledger(graph, Books(sketch=DdSketch)), Ledger(graph)
    for number in range(frames):
        for ledger in (bounded, whole):
            ledger.presented(number, 10 * number, 5, 10 * number - number % 2 + 1, rung=number // 10_000 % 2)
    assert (bounded.presented_frames, bounded.lateness_ns) == ([], [])
    assert (whole.presented_frames, whole.presented_ns[:3]) == ([*range(frames)], [0, 10, 20])
    assert (whole.latency_ns, whole.lateness_ns[:3]) == ([5] * frames, [-1, 0, -1])
    assert (bounded.is_exact, whole.is_exact) == (False, True)
    assert (dict(bounded.rungs), bounded.rung_switches) == ({0: 10_020, 1: 10_000}, 2)
    found, expected = (each.report(clock="virtual", requested=frames, not_begun=0) for each in (bounded, whole))
    for key in ("fps", "frames", "deadline_misses", "xrbench"):
        assert found[key] == expected[key]


def test_frame_times_above_a_target_are_missed_deadlines() -> None:
    """Times of 10 and 30 ns against 20; the frames' own deadlines do not count then."""
    ledger = Ledger(chain((("a", "u"),), "single", "a"), Books(target_period_ns=20))
    for end_ns in (0, 10, 40):
        ledger.presented(0, end_ns, 5, NEVER if end_ns else -100)
    report = ledger.report(clock="virtual", requested=3, not_begun=0)
    assert report["deadline_misses"] == 1
    score = sum(1 / (1 + exp(15 * late / 1e6)) for late in (-10, 10)) / 2
    assert report["xrbench"]["real_time"] == pytest.approx(score, abs=1e-12)
