"""What the benches measure with: clocks that are told the time, arrays that are held, sums by hand."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from itertools import count
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.bench import pipeline as pipeline_bench
from trilane.bench.lib import fixture, load
from trilane.bench.lib.float_raster import quantise, rasterise, sample
from trilane.bench.lib.limits import LIMITS, check_limits
from trilane.bench.lib.load import Load, Queries
from trilane.errors import BadInputError, TrilaneError
from trilane.pipeline.controls import FrameRequestQueue
from trilane.pipeline.run_metrics import StageTimes, TimeSummary
from trilane.scheduler.events import Settings, chain
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.virtual import simulate

Held = Callable[[str, Any], None]


class Clock:
    """Stands for a module's `time`: a second of it passes for every look and for what is slept."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        self.now += 1.0
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def perf_counter_ns(self) -> int:
        return round(self.now * 1e9)


def test_variants_take_turns_and_the_warm_up_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """`a` takes 2 s, `b` 3 s, and each its round's number of milliseconds more."""
    clock, rounds, order = Clock(), {"a": count(), "b": count()}, []
    monkeypatch.setattr(fixture, "time", clock)

    def run(name: str, seconds: float) -> None:
        order.append(name)
        clock.now += seconds + next(rounds[name]) / 1000

    times = fixture.interleaved_ms({"a": lambda: run("a", 2.0), "b": lambda: run("b", 3.0)}, 3)
    assert "".join(order) == "ab" * (5 + 3)
    assert times["a"] == pytest.approx([2005, 2006, 2007])
    assert times["b"] == pytest.approx([3005, 3006, 3007])


def test_a_summary_is_median_minimum_and_ninetieth_percentile() -> None:
    assert fixture.summary_ms([float(n) for n in range(11)]) == {"median_ms": 5.0, "min_ms": 0.0, "p90_ms": 9.0}
    assert fixture.summary_ms([5.0, 1.0, 2.0, 4.0])["median_ms"] == 3.0


def test_the_standing_body_is_held(held: Held) -> None:
    found = fixture.standing(channels=3)
    for name in ("joints", "view", "projection", "texture"):
        held(name, getattr(found, name))
    held("weights", found.arrays.weight)
    clip = found.projection @ found.view
    world = np.array([0.0, fixture.HEIGHT_M + fixture.FRAME_M / 2, 0.0, 1.0])
    place = clip @ world
    assert place[1] / place[3] == pytest.approx(1.0), "the picture is as high as its frame"


@pytest.mark.parametrize("option", sorted(set(LIMITS) - {"threads"}))
def test_both_ends_of_a_range_are_taken_and_no_more(option: str) -> None:
    low, high = LIMITS[option]
    step = 1 if isinstance(low, int) else 1e-4
    check_limits({option: low})
    check_limits({option: (low, high)})
    for bad in (low - step, high + 1):
        with pytest.raises(BadInputError, match=re.escape(f"expected {low:g} to {high:g}")):
            check_limits({option: [low, bad]})


class Pipeline:
    """Stands for a run: every frame that is asked for is answered `delay` seconds of the clock later."""

    def __init__(self, clock: Clock, queries: Queries, delay: float = 0.25) -> None:
        self._clock, self._queries, self._delay = clock, queries, delay
        self.asked: list[int] = []

    def request(self, frames: int) -> None:
        self.asked.append(frames)
        for frame in range(frames):
            self._clock.now += self._delay
            self._queries.answered(frame)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    told = Clock()
    monkeypatch.setattr(load, "time", told)
    return told


def played(clock: Clock, asked: Load) -> tuple[list[int], Queries]:
    queries = Queries(size=asked.samples if asked.scenario == "multi-stream" else 1)
    pipeline = Pipeline(clock, queries)
    load.play(asked, pipeline, queries)  # type: ignore[arg-type]
    return pipeline.asked, queries


def test_one_query_at_a_time_until_there_are_enough_and_the_time_has_passed(clock: Clock) -> None:
    """Eight to warm up together, then 64 of a frame each; each takes the delay and the clock's next look."""
    asked, queries = played(clock, Load("single-stream", seconds=1.0))
    assert asked == [8] + [1] * 64
    assert queries.latencies_ms == pytest.approx([1250.0] * 64)
    asked, _ = played(clock, Load("single-stream", seconds=1000.0))
    assert len(asked) - 1 == pytest.approx(1000 / 3.25, abs=2), "looks at the clock: loop, ask, answer"


def test_a_query_of_several_frames_is_answered_with_the_last(clock: Clock) -> None:
    asked, queries = played(clock, Load("multi-stream", seconds=1.0, samples=3))
    assert asked == [24] + [3] * 662
    assert queries.latencies_ms == pytest.approx([3 * 250.0 + 1000.0] * 662)


def test_all_at_once_asks_a_tenth_more_than_the_time_takes(clock: Clock) -> None:
    """64 queries first, answered after 80 s (a look and a quarter each), then 1.1 * 0.8 a second * 201 s."""
    asked, queries = played(clock, Load("offline", seconds=201.0))
    assert asked == [8, 64, 177]
    assert len(queries.asked_s) == 177


def test_a_server_is_asked_at_the_moments_of_its_seed(clock: Clock, held: Held) -> None:
    moments: list[float] = []
    queries = Queries()
    pipeline = Pipeline(clock, queries, delay=0.0)
    monotonic = clock.now

    class Told(Pipeline):
        def request(self, frames: int) -> None:
            moments.append(clock.now - monotonic)
            super().request(frames)

    del pipeline
    load._poisson(Load("server", 1.0, rate=0.05, seed=3), Told(clock, queries, 0.0), queries)  # type: ignore[arg-type]
    assert len(moments) == 662
    held("moments", moments)


def test_the_end_of_a_run_ends_the_wait(clock: Clock) -> None:
    del clock
    queries = Queries()
    queries.asked_s = [1.0, 2.0]
    queries.answered_s = [1.5]
    queries.ended()
    with pytest.raises(TrilaneError, match="ended before every query"):
        queries.wait()
    queries.answered(0)
    queries.wait()
    assert len(queries.answered_s) == 2


def test_requests_reach_the_queue_by_frames() -> None:
    asked: list[int] = []

    class Requests(FrameRequestQueue):
        def request(self, count: int = 1) -> None:
            asked.append(count)

    Queries(size=3).ask(Requests(lambda _: None, lambda: None), 5)
    assert asked == [15]


def corners() -> Iterator[np.ndarray]:
    yield np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, 1.0, 0.0]])
    yield np.array([[-1.0, -1.0, 0.5], [-1.0, 1.0, 0.5], [1.0, -1.0, 0.5]])


@pytest.mark.parametrize("cull", [False, True])
def test_the_reference_raster_of_a_half_picture(cull: bool) -> None:
    """A triangle over the lower left half of 4 x 4 pixels: centres on the diagonal belong to neither a left nor a top
    edge of it. The second triangle winds the other way and is behind; culled or not, it is not seen."""
    world = np.vstack(list(corners()))
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]] * 2)
    image = rasterise(world, np.array([[0, 1, 2], [3, 4, 5]]), uv, np.eye(4), (4, 4), cull)
    rows, columns = np.indices((4, 4))
    assert np.array_equal(image.coverage, columns < rows)
    assert set(image.triangle[image.coverage]) == {0}
    expected = np.stack([(columns + 0.5) / 4, 1 - (rows + 0.5) / 4], axis=2)
    np.testing.assert_allclose(image.uv[image.coverage], expected[image.coverage], atol=1e-12)
    assert not image.depth[image.coverage].any()
    turned = rasterise(world[3:], np.array([[0, 1, 2]]), uv[:3], np.eye(4), (4, 4), cull)
    assert turned.coverage.sum() == (0 if cull else 6)
    if not cull:
        np.testing.assert_allclose(turned.depth[turned.coverage], 0.5)


def test_bytes_of_the_reference_round_halves_to_even_and_clamp() -> None:
    real = np.array([-99.0, -0.3, 0.25, 0.75, 1.25, 999.0])
    assert quantise(real, 0.5, 3).tolist() == [0, 2, 3, 5, 5, 255]


def test_the_reference_samples_between_texels_and_clamps_at_the_edge() -> None:
    texture = np.array([[[0.0], [1.0]], [[2.0], [3.0]]])
    uv = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.5, 0.5], [-1.0, 2.0], [0.625, 0.25]])
    assert sample(texture, uv)[:, 0].tolist() == [0.0, 1.0, 2.0, 1.5, 2.0, 0.75]


def job(ready: int, dispatch: int, begin: int, end: int) -> JobRecord:
    return JobRecord("infer", "dsp", 0, ready, dispatch, begin, end)


def test_idle_between_jobs_by_hand() -> None:
    """0-10 a job; the next input comes at 14 (starved 4), is dispatched at 17 (3) and begun at 20 (overhead 3); the
    last one's was there and it is dispatched at once, but begins at 41: overhead 1. Span 50, idle 11.
    """
    jobs = [job(14, 17, 20, 40), job(0, 0, 0, 10), job(5, 6, 41, 50)]
    assert pipeline_bench.idle_between_jobs(jobs) == pytest.approx(
        {"idle": 11 / 50, "starved": 4 / 50, "undispatched": 3 / 50, "overhead": 4 / 50}
    )


def test_runs_are_compared_with_the_sequential_ones_before_and_after() -> None:
    """Sequential frames of 30 and 34 ms, hops 2 and 4, in which b takes 9 and 11 and a 10: gain 32 / 16 = 2, bound
    (20 + 3) / 10, of the bound 2 / 2.3. The sequential run beside itself alone: 19 and 2 over 10."""
    base = {"frame_ms": 30.0, "hops_ms": 2.0, "units_ms": {"a": 10.0, "b": 9.0}}
    row = {"frame_ms": 16.0, "hops_ms": None, "units_ms": {"a": 12.0, "b": 9.0}}
    after = {"frame_ms": 34.0, "hops_ms": 4.0, "units_ms": {"a": 10.0, "b": 11.0}}
    pipeline_bench._compare([base, row], after)
    assert (row["gain"], row["bound"], row["gain_of_bound"]) == pytest.approx((2.0, 2.3, 2 / 2.3))
    assert (row["slowest"], row["alone_ms"], row["all_alone_ms"], row["in_run_over_alone"]) == ("a", 10, 20, 1.2)
    assert (base["gain"], base["bound"]) == pytest.approx((1.0, 2.1))


def test_a_row_is_medians_sums_and_the_commonest_name() -> None:
    def run(fps: float, slowest: str, lost: int) -> dict[str, Any]:
        latencies = [round(fps * 1e6) + 1000 * k for k in range(100)]
        row = {"fps": fps, "slowest": slowest, "lost": lost, "hops_ms": None, "gain_of_bound": fps / 10}
        return row | {"latencies_ns": latencies}

    setting = pipeline_bench.Setting("default", "256", 2, "pipelined", "double")
    row = pipeline_bench._summary(setting, [run(5.0, "gpu", 1), run(9.0, "dsp", 2), run(6.0, "gpu", 4)])
    assert row == vars(setting) | {
        "fps": 6.0,
        "slowest": "gpu",
        "lost": 7,
        "hops_ms": None,
        "gain_of_bound": 0.6,
        "of_bound_low": 0.5,
        "of_bound_high": 0.9,
        "latency_p50_ms": pytest.approx(
            6.0495
        ),  # of the 300: the 50 th and 51 st of those from 6 ms on, in steps of 1 µs
        "latency_p99_ms": pytest.approx(9.09601),  # at rank 0.99 * 299 = 296.01, which is 96.01 of those from 9 ms on
    }
    few = pipeline_bench._summary(setting, [run(5.0, "gpu", 1), run(9.0, "dsp", 2)])
    assert (few["latency_p50_ms"], few["latency_p99_ms"]) == (pytest.approx(7.0495), None)


def test_latency_is_from_the_pose_to_the_composited_picture() -> None:
    """A pose of 3, a picture of 5, and 2 to present it, one frame at a time."""
    took = {"pose": 3, "composite": 5, "present": 2}
    graph = chain((("pose", "u"), ("composite", "v"), ("present", "u")), "double", "composite")
    run = simulate(graph, Settings(3, "sequential"), lambda stage, *_: took[stage], keep=True)
    assert run.recording is not None
    assert pipeline_bench.latencies_ns(run.recording, run.jobs) == [8, 8, 8]


def test_sequential_comes_first_and_once() -> None:
    pairs = pipeline_bench._pairs(("sequential", "pipelined"), ("double", "single"))
    assert pairs == [
        ("sequential", "double"),
        ("sequential", "single"),
        ("pipelined", "double"),
        ("pipelined", "single"),
    ]
    with pytest.raises(BadInputError, match="--policy"):
        pipeline_bench._check(("best",), ("double",), (1,))
    with pytest.raises(BadInputError, match="--edge"):
        pipeline_bench._check(("latest",), ("quadruple",), (1,))
    with pytest.raises(BadInputError, match="--cores"):
        pipeline_bench._check(("latest",), ("double",), (0,))


def stage(unit: str, mean: float) -> StageTimes:
    times = TimeSummary(mean=mean, p50=mean, p90=mean, p95=mean, p99=mean, max=mean)
    return StageTimes(unit=unit, service_ms=times, wait_ms=times)


def test_what_a_unit_takes_is_without_the_time_in_which_it_had_no_core() -> None:
    """Two poses of 3 ms in the mean, of which one lacked its core for 2 ms."""

    class Result:
        report = SimpleNamespace(
            units={"cpu": None, "gpu": None},
            stages={"pose": stage("cpu", 3.0), "raster": stage("gpu", 5.0), "present": stage("cpu", 2.0)},
        )
        jobs = tuple(JobRecord("pose", "cpu", n, 0, 0, 0, 9, preempted_ns=n * 2_000_000) for n in range(2))

    assert pipeline_bench._units_ms(Result) == {"cpu": 4.0, "gpu": 5.0}  # type: ignore[arg-type]
