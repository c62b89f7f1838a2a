"""Does the pipeline answer as a service should: one query at a time, several, at random moments, all at once?

Rule: the whole pipeline answers, from pose to presented frame. A result is valid, or says why it is invalid. MLCommons
LoadGen can create the same load and evaluate the run.
"""

from __future__ import annotations

import importlib
import math
import random
import re
import tempfile
import threading
import time
from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from trilane.errors import BadInputError, MissingPartError, TrilaneError
from trilane.pipeline.controls import FrameRequestQueue
from trilane.pipeline.description import Pipeline
from trilane.pipeline.memory import Assets
from trilane.pipeline.run import run_pipeline
from trilane.stages.avatar_pipeline import avatar_pipeline
from trilane.stages.configure import configure
from trilane.stages.run_options import RunOptions
from trilane.transport.slots import RULES
from trilane.units import either

JUDGES = ("trilane", "loadgen")
MAX_FRAMES = 1_000_000
LIMITS = {"--seconds": (0.1, 3600.0), "--rate": (0.1, 1000.0), "--limit-ms": (1.0, 60_000.0), "--samples": (1, 64)}


def measure(
    scenario: tuple[str, ...] = ("single-stream", "server"),
    judge: tuple[str, ...] = ("trilane",),
    avatar: str = "default",
    size: str = "256x256",
    seconds: float = 20.0,
    rate: float = 15.0,
    limit_ms: float = 250.0,
    samples: int = 4,
    policy: str = "pipelined",
    edge: str = "double",
    runtime: str = "auto",
    seed: int = 1,
) -> dict[str, Any]:
    """Measure one run of the avatar's pipeline for each scenario and each `judge`.

    The judge evaluates the run: `trilane`, or `loadgen` of MLCommons. There are four scenarios:
    `single-stream`: the next query comes after each answer.
    `multi-stream`: the same, with `samples` frames in a query.
    `server`: `rate` queries a second come at random moments, and each is late after `limit_ms`.
    `offline`: all queries come at once.

    `rows` has a row for each run:
    `scenario`, `judge`: scenario and judge of the run.
    `verdict`: VALID or INVALID. A run is valid if it lasted `seconds`, had as many queries as its percentile needs and,
    for a server, had few enough late answers.
    `because`: reasons why the run is invalid, by the judge `trilane`.
    `queries`, `seconds`, `rate`: number of queries, duration, and queries a second; under `loadgen`, a query has one
    frame.
    `p50_ms`, `max_ms`: median and largest latency of the queries.
    `percentile`: share of the queries that is judged.
    `percentile_ms`: latency that this share of all queries does not exceed; null for too few queries.

    Further keys:
    `summaries`: LoadGen's summaries.
    `accuracy`: image error of the avatar.
    `config`: settings of the bench.

    Raises BadInputError for an option out of range, MissingPartError if a library is not installed, TrilaneError if a
    run fails.
    """
    _check(scenario, judge, {"--seconds": seconds, "--rate": rate, "--limit-ms": limit_ms, "--samples": samples})
    if "loadgen" in judge:
        load_generator()
    request = RunOptions(size=size, avatar=avatar, frames=MAX_FRAMES, runtime=runtime)
    checked = configure(request, Path.cwd()).changed(record=False)
    pipeline = avatar_pipeline(checked.config, checked.assets, edge)
    rows, summaries = [], {}
    for name in scenario:
        load = Load(name, seconds, rate, limit_ms, samples, seed)
        for evaluated_by in judge:
            row, summary = run_scenario(pipeline, checked.assets, load, evaluated_by, policy)
            rows.append(row)
            summaries[f"{name}, {evaluated_by}"] = summary
    return {
        "rows": rows,
        "summaries": {name: text for name, text in summaries.items() if text},
        "accuracy": dict(checked.accuracy),
        "config": {"size": size, "policy": policy, "edge": edge, "runtime": checked.config.runtime, "seed": seed},
    }


def run_scenario(
    pipeline: Pipeline, assets: Assets, load: Load, evaluated_by: str, policy: str
) -> tuple[dict[str, Any], str]:
    """Do one run under `load`, and return (row of `measure`, LoadGen's summary).

    The summary is "" if LoadGen does not evaluate the run.
    `pipeline`, `assets`: pipeline to run, and the arrays that its stages may read.
    `load`: load pattern and its limits.
    `evaluated_by`: one of `JUDGES`.
    `policy`: policy of the scheduler.
    Raises TrilaneError if the run fails or a query gets no answer, MissingPartError without LoadGen, and
    KeyboardInterrupt if a signal ends the run.
    """
    queries = Queries(size=load.samples if load.scenario == "multi-stream" and evaluated_by == "trilane" else 1)
    loadgen = LoadGenPlayer(load, queries) if evaluated_by == "loadgen" else None
    listener = queries if loadgen is None else loadgen
    requests = FrameRequestQueue(listener.answered, listener.ended, listener.unanswered)
    work = (lambda: play(load, requests, queries)) if loadgen is None else lambda: loadgen.play(requests)
    player = _Player(requests, work)
    player.start()
    try:
        result = run_pipeline(pipeline, MAX_FRAMES, policy=policy, assets=assets, requests=requests)
    finally:
        requests.close()
        player.join()
    if result.failure is not None:
        raise TrilaneError(result.failure.message)
    if result.interrupted:
        raise KeyboardInterrupt
    if player.errors:
        raise player.errors[0]
    return _row(load, queries, loadgen), loadgen.summary if loadgen is not None else ""


@dataclass(eq=False)
class _Player(threading.Thread):
    """A thread that does `work` once the queue `requests` is open. `errors` has a TrilaneError that `work` raised."""

    requests: FrameRequestQueue
    work: Callable[[], None]
    errors: list[TrilaneError] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__(name="player", daemon=True)

    def run(self) -> None:
        self.requests.is_open.wait()
        try:
            self.work()
        except TrilaneError as error:
            self.errors.append(error)
        finally:
            self.requests.end()


def _row(load: Load, queries: Queries, loadgen: LoadGenPlayer | None) -> dict[str, Any]:
    latencies = queries.latencies_ms
    lasted_s = queries.answered_s[-1] - queries.asked_s[0]
    reasons = verdict(load, latencies, lasted_s)
    return {
        "scenario": load.scenario,
        "judge": "trilane" if loadgen is None else "loadgen",
        "verdict": "VALID" if (loadgen.valid if loadgen is not None else not reasons) else "INVALID",
        "queries": len(latencies),
        "seconds": lasted_s,
        "rate": len(latencies) / lasted_s,
        "p50_ms": median(latencies),
        "percentile": load.percentile,
        "percentile_ms": bound_ms(latencies, load.percentile),
        "max_ms": max(latencies),
        "because": "; ".join(reasons) if loadgen is None else "",
    }


def _check(scenarios: tuple[str, ...], judges: tuple[str, ...], numbers: dict[str, float]) -> None:
    for option, values, known in (("--scenario", scenarios, tuple(PATTERNS)), ("--judge", judges, JUDGES)):
        for value in values:
            if value not in known:
                raise BadInputError(option, repr(value), f"one of {', '.join(known)}")
    for option, number in numbers.items():
        low, high = LIMITS[option]
        if not low <= number <= high:
            raise BadInputError(option, f"{number:g}", f"{low:g} to {high:g}")


# The four load patterns of MLPerf inference, and the conditions of a valid result.
#
# Rule: names, patterns and the number of queries for a percentile are as in LoadGen, so that results can be compared.
# The warm-up is not counted.
#
# Reddi et al., MLPerf Inference Benchmark, ISCA 2020, sections III and V.

CONFIDENCE = 0.99
WARM_UP = 8
#: Scenario -> percentile of the queries' latency that is judged. For offline, the rate is judged.
PERCENTILES = {"single-stream": 0.90, "multi-stream": 0.99, "server": 0.99, "offline": 0.90}
STALLED_S = 60.0
KEEPING = either(name for name, rule in RULES.items() if not rule.yields)
KEEPS_ALL = f"a {KEEPING} edge drops none, under the policies sequential and pipelined"


@dataclass(frozen=True)
class Load:
    """The load on the pipeline.

    `scenario`: key of `PATTERNS`.
    `seconds`: least duration of the run.
    `rate`: queries a second, for server.
    `limit_ms`: limit on the percentile of the latency, for server.
    `samples`: number of frames in a query, for multi-stream.
    `seed`: seed of the random moments of queries, for server.
    """

    scenario: str
    seconds: float
    rate: float = 15.0
    limit_ms: float = 250.0
    samples: int = 4
    seed: int = 1

    @property
    def percentile(self) -> float:
        return PERCENTILES[self.scenario]


@dataclass
class Queries:
    """The times at which queries were asked, and the times at which they were answered.

    Two threads share this object: the thread that asks and the thread of the run.
    `size`: number of frames in a query. The last frame answers the query.
    `asked_s`, `answered_s`: times of the queries that count, in order, in seconds of the monotonic clock.
    `over`: whether further answers do not count, because the run has ended or a frame was dropped or lost.
    `why`: sentence about the dropped or lost frame; "" if there is no such frame.
    `changed`: condition that is notified of every answer, and when `over` becomes true.
    """

    size: int = 1
    asked_s: list[float] = field(default_factory=list)
    answered_s: list[float] = field(default_factory=list)
    over: bool = False
    why: str = ""
    changed: threading.Condition = field(default_factory=threading.Condition)
    _frames: int = 0

    def ask(self, requests: FrameRequestQueue, count: int = 1) -> None:
        """Ask `count` queries now, and note the time. `requests`: queue of the run."""
        self.asked_s += [time.monotonic()] * count
        requests.request(count * self.size)

    def answered(self, _frame: int) -> None:
        """Note a presented frame, which may complete a query. The `FrameRequestQueue` calls this."""
        with self.changed:
            self._frames += 1
            if self._frames % self.size == 0:
                self.answered_s.append(time.monotonic())
                self.changed.notify_all()

    def unanswered(self, causes: Mapping[str, int]) -> None:
        """Note that frames were dropped or lost, so that their queries get no answer.

        The `FrameRequestQueue` calls this. `causes`: number of frames by cause.
        """
        frames = ", ".join(f"{cause} {count}" for cause, count in causes.items())
        self.why = f"frames of queries were dropped or lost ({frames}), and every query must be answered: {KEEPS_ALL}"
        self.ended()

    def ended(self) -> None:
        """Note that the run is over; the `FrameRequestQueue` calls this."""
        with self.changed:
            self.over = True
            self.changed.notify_all()

    def wait(self) -> None:
        """Wait until every query is answered.

        Raises TrilaneError if a frame was dropped or lost, if the run ends first, or if no answer comes in `STALLED_S`.
        """
        with self.changed:
            while len(self.answered_s) < len(self.asked_s) and not self.over:
                if not self.changed.wait(STALLED_S):
                    raise TrilaneError(f"no query was answered for {STALLED_S:.0f} s")
            if self.why or len(self.answered_s) < len(self.asked_s):
                raise TrilaneError(self.why or "the run ended before every query was answered")

    def warm_up(self, requests: FrameRequestQueue) -> None:
        """Ask `WARM_UP` queries that do not count, and wait for their answers. Raises the errors of `wait`.

        `requests`: queue of the run.
        """
        self.ask(requests, WARM_UP)
        self.wait()
        self.restart()

    def restart(self) -> None:
        """Forget all queries, so that only later queries count."""
        self.asked_s.clear()
        self.answered_s.clear()

    @property
    def latencies_ms(self) -> list[float]:
        """The latencies of the answered queries in ms, in the order in which the queries were asked."""
        return [(end - begin) * 1e3 for begin, end in zip(self.asked_s, self.answered_s, strict=False)]


def play(load: Load, requests: FrameRequestQueue, queries: Queries) -> None:
    """Ask queries in the pattern of `load`, and wait for the answers.

    The queries go on for at least the duration of `load`, and until there are enough for its percentile.
    `requests`: queue of the run.
    `queries`: object that notes the times of the queries.
    Raises the errors of `Queries.wait`.
    """
    queries.warm_up(requests)
    PATTERNS[load.scenario](load, requests, queries)
    queries.wait()


def _one_at_a_time(load: Load, requests: FrameRequestQueue, queries: Queries) -> None:
    end = time.monotonic() + load.seconds
    needed = queries_needed(load.percentile)
    while time.monotonic() < end or len(queries.asked_s) < needed:
        queries.ask(requests)
        queries.wait()


def _poisson(load: Load, requests: FrameRequestQueue, queries: Queries) -> None:
    gaps = random.Random(load.seed)
    at = time.monotonic()
    end, needed = at + load.seconds, queries_needed(load.percentile)
    while (at := at + gaps.expovariate(load.rate)) < end or len(queries.asked_s) < needed:
        if queries.over:
            return
        time.sleep(max(0.0, at - time.monotonic()))
        queries.ask(requests)


def _all_at_once(load: Load, requests: FrameRequestQueue, queries: Queries) -> None:
    """Ask all queries at once: 10 % more than the pipeline answers in `load.seconds`, and enough for the percentile.

    A run has at most MAX_FRAMES queries. A few earlier ones, which do not count, show how many it answers in a second.
    """
    few = queries_needed(load.percentile)
    queries.ask(requests, few)
    queries.wait()
    rate = few / (queries.answered_s[-1] - queries.asked_s[0])
    queries.restart()
    queries.ask(requests, min(MAX_FRAMES - WARM_UP - few, max(few, math.ceil(1.1 * rate * load.seconds))))


PATTERNS: dict[str, Callable[[Load, FrameRequestQueue, Queries], None]] = {
    "single-stream": _one_at_a_time,
    "multi-stream": _one_at_a_time,
    "server": _poisson,
    "offline": _all_at_once,
}


def tail(queries: int, late: int, share: float) -> float:
    """Return the probability that at most `late` of `queries` queries are late, by the binomial distribution.

    `share`: probability that a single query is late.
    """
    logs = [
        math.lgamma(queries + 1)
        - math.lgamma(k + 1)
        - math.lgamma(queries - k + 1)
        + k * math.log(share)
        + (queries - k) * math.log1p(-share)
        for k in range(min(late, queries) + 1)
    ]
    return min(1.0, math.fsum(math.exp(value) for value in logs))


def queries_needed(percentile: float, late: int = 1) -> int:
    """Return how many queries are needed to show, with `CONFIDENCE`, that the share `percentile` keeps a latency limit.

    `percentile`: share of all queries, such as 0.99. `late`: number of queries that may exceed the limit. With one late
    query, 64 queries are needed for 0.90, and 662 for 0.99.
    """
    numbers = range(MAX_FRAMES)
    return bisect_left(numbers, True, late + 1, key=lambda n: tail(n, late, 1 - percentile) <= 1 - CONFIDENCE)


def bound_ms(latencies_ms: list[float], percentile: float) -> float | None:
    """Return the latency that the share `percentile` of all queries does not exceed, with `CONFIDENCE`.

    As in LoadGen, the result is the k-th largest of `latencies_ms`, where k is the number of queries that may be late.
    For too few queries, the result is None.
    """
    late = 0
    while tail(len(latencies_ms), late + 1, 1 - percentile) <= 1 - CONFIDENCE:
        late += 1
    return sorted(latencies_ms)[-late] if late else None


def verdict(load: Load, latencies_ms: list[float], lasted_s: float) -> list[str]:
    """Return sentences that say why the result of a run is invalid; an empty list for a valid result.

    `load`: load of the run.
    `latencies_ms`: latencies of all queries.
    `lasted_s`: seconds from the first query to the last answer.
    """
    needed = queries_needed(load.percentile)
    reasons = []
    if lasted_s < load.seconds:
        reasons.append(f"it lasted {lasted_s:.1f} s, expected {load.seconds:g} s")
    if len(latencies_ms) < needed:
        reasons.append(f"{len(latencies_ms)} queries, expected {needed} for the {100 * load.percentile:g}th percentile")
    elif load.scenario == "server":
        late = sum(latency > load.limit_ms for latency in latencies_ms)
        if tail(len(latencies_ms), late, 1 - load.percentile) > 1 - CONFIDENCE:
            reasons.append(
                f"{late} of {len(latencies_ms)} queries took longer than {load.limit_ms:g} ms, too many for "
                f"{100 * load.percentile:g} % within it"
            )
    return reasons


# A run that MLCommons LoadGen evaluates: LoadGen asks, measures, and says in its summary whether the run is valid.
#
# Rule: LoadGen decides when queries come and what counts. This code turns queries into frames, and frames into answers.

NAMES = {"single-stream": "SingleStream", "multi-stream": "MultiStream", "server": "Server", "offline": "Offline"}
VERDICT = re.compile(r"^Result is : (\w+)", re.MULTILINE)
SAMPLES = 64  # size of the library that LoadGen draws samples from; for any sample, the motion's next frame is shown
SUMMARY = "mlperf_log_summary.txt"


def load_generator() -> Any:
    """Return the module `mlperf_loadgen`. Raises MissingPartError if it is not installed."""
    try:
        return importlib.import_module("mlperf_loadgen")
    except ImportError:
        raise MissingPartError("LoadGen is not installed", extra="loadgen") from None


@dataclass
class LoadGenPlayer:
    """Lets LoadGen request frames from a run.

    `load`: load pattern and its limits, which LoadGen gets.
    `queries`: object that notes the times of the same frames, and an early end of the run.
    `valid`, `summary`: whether LoadGen calls the run valid, and LoadGen's summary as text. `play` sets both.
    """

    load: Load
    queries: Queries
    valid: bool = False
    summary: str = ""
    _ids: list[int] = field(default_factory=list)
    _begun: bool = False
    _completed: int = 0

    def answered(self, frame: int) -> None:
        """Note that `frame` was presented; after the warm-up, tell LoadGen. The `FrameRequestQueue` calls this."""
        self.queries.answered(frame)
        if self._begun and not self.queries.over:
            self._completed = frame - WARM_UP + 1
            self._complete(frame - WARM_UP)

    def unanswered(self, causes: Mapping[str, int]) -> None:
        """Note that frames were dropped or lost, which makes further answers useless.

        The `FrameRequestQueue` calls this. `causes`: number of frames by cause.
        """
        self.queries.unanswered(causes)
        self.ended()

    def ended(self) -> None:
        """Note that the run is over, and complete LoadGen's open samples. The `FrameRequestQueue` calls this."""
        self.queries.ended()
        if self._begun:
            with self.queries.changed:  # two threads may come here, but no sample may be completed twice
                numbers = range(self._completed, len(self._ids))
                self._completed = len(self._ids)
            for number in numbers:
                self._complete(number)

    def play(self, requests: FrameRequestQueue) -> None:
        """Warm the pipeline up, and let LoadGen ask until LoadGen has enough answers. `requests`: queue of the run.

        Raises the errors of `Queries.wait`, and MissingPartError without LoadGen.
        """
        lg = load_generator()
        self.queries.warm_up(requests)
        self._begun = True

        def issue(samples: list[Any]) -> None:
            self._ids += [sample.id for sample in samples]
            self.queries.ask(requests, len(samples))
            if self.queries.over:
                self.ended()

        system = lg.ConstructSUT(issue, lambda: None)
        library = lg.ConstructQSL(SAMPLES, SAMPLES, lambda _: None, lambda _: None)
        try:
            with tempfile.TemporaryDirectory(prefix="trilane-loadgen-") as folder:
                lg.StartTestWithLogSettings(system, library, self._settings(lg), _logs(lg, folder))
                self.summary = (Path(folder) / SUMMARY).read_text(encoding="utf-8")
        finally:
            lg.DestroyQSL(library)
            lg.DestroySUT(system)
        if self.queries.over:
            raise TrilaneError(self.queries.why or "the run ended before LoadGen had its answers")
        line = VERDICT.search(self.summary)
        self.valid = line is not None and line[1] == "VALID"

    def _complete(self, number: int) -> None:
        lg = load_generator()
        lg.QuerySamplesComplete([lg.QuerySampleResponse(self._ids[number], 0, 0)])

    def _settings(self, lg: Any) -> Any:
        load = self.load
        settings = lg.TestSettings()
        settings.scenario = getattr(lg.TestScenario, NAMES[load.scenario])
        settings.mode = lg.TestMode.PerformanceOnly
        settings.min_duration_ms = math.ceil(load.seconds * 1e3)
        settings.min_query_count = queries_needed(load.percentile)
        settings.server_target_qps = load.rate
        settings.server_target_latency_ns = round(load.limit_ms * 1e6)
        settings.server_target_latency_percentile = load.percentile
        settings.single_stream_target_latency_percentile = load.percentile
        settings.multi_stream_target_latency_percentile = load.percentile
        settings.multi_stream_samples_per_query = load.samples
        settings.offline_expected_qps = load.rate
        settings.schedule_rng_seed = load.seed
        return settings


def _logs(lg: Any, folder: str) -> Any:
    output = lg.LogOutputSettings()
    output.outdir = folder
    output.copy_summary_to_stdout = False
    settings = lg.LogSettings()
    settings.log_output = output
    settings.enable_trace = False
    return settings
