"""The four load patterns of MLPerf inference, and the conditions of a valid result.

Rule: names, patterns and the number of queries that a percentile needs are LoadGen's, so that results can be compared
with LoadGen's; the warm-up is not counted.

Reddi et al., MLPerf Inference Benchmark, ISCA 2020, sections III and V.
"""

from __future__ import annotations

import math
import random
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from trilane.errors import TrilaneError
from trilane.pipeline.controls import FrameRequestQueue

CONFIDENCE = 0.99
WARM_UP = 8
#: Percentile of the queries' latency that decides in each scenario. Offline is decided by its rate.
PERCENTILES = {"single-stream": 0.90, "multi-stream": 0.99, "server": 0.99, "offline": 0.90}
STALLED_S = 60.0
KEEPS_ALL = "single, double and fifo edges drop none, under the policies sequential and pipelined"


@dataclass(frozen=True)
class Load:
    """The load on the pipeline.

    `scenario`: key of `PATTERNS`.
    `seconds`: least duration.
    `rate`: queries a second of the server scenario.
    `limit_ms`: limit of the server scenario on the percentile of its latency.
    `samples`: number of frames in a query of multi-stream.
    `seed`: seed of the moments at which a server's queries arrive.
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
    """Times at which each query was asked of a `FrameRequestQueue` and answered; two threads share it.

    The threads are the one that asks and the run's.
    `size`: number of frames in a query, which is answered with the last of them.
    `asked_s`, `answered_s`: monotonic seconds of the queries that count.
    `over`: whether nothing more counts: the run has ended, or a frame was dropped or lost.
    `why`: sentence about the dropped or lost frame.
    `changed`: condition that is notified with every answer and when it is over.
    """

    size: int = 1
    asked_s: list[float] = field(default_factory=list)
    answered_s: list[float] = field(default_factory=list)
    over: bool = False
    why: str = ""
    changed: threading.Condition = field(default_factory=threading.Condition)
    _frames: int = 0

    def ask(self, requests: FrameRequestQueue, count: int = 1) -> None:
        """Ask `count` queries now."""
        self.asked_s += [time.monotonic()] * count
        requests.request(count * self.size)

    def answered(self, _frame: int) -> None:
        """Note a presented frame; the `FrameRequestQueue` calls this."""
        with self.changed:
            self._frames += 1
            if self._frames % self.size == 0:
                self.answered_s.append(time.monotonic())
                self.changed.notify_all()

    def unanswered(self, causes: Mapping[str, int]) -> None:
        """Note that a frame was dropped or lost, so its query has no answer; the `FrameRequestQueue` calls this."""
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

        Raises TrilaneError when a frame was dropped or lost, when the run ends first, or when nothing is answered for
        `STALLED_S`.
        """
        with self.changed:
            while len(self.answered_s) < len(self.asked_s) and not self.over:
                if not self.changed.wait(STALLED_S):
                    raise TrilaneError(f"no query was answered for {STALLED_S:.0f} s")
            if self.why or len(self.answered_s) < len(self.asked_s):
                raise TrilaneError(self.why or "the run ended before every query was answered")

    def warm_up(self, requests: FrameRequestQueue) -> None:
        """Ask a few queries that are not counted."""
        self.ask(requests, WARM_UP)
        self.wait()
        self.restart()

    def restart(self) -> None:
        """Count only the queries from now on."""
        self.asked_s.clear()
        self.answered_s.clear()

    @property
    def latencies_ms(self) -> list[float]:
        """Latencies of the answered queries, in the order in which they were asked."""
        return [(end - begin) * 1e3 for begin, end in zip(self.asked_s, self.answered_s, strict=False)]


def play(load: Load, requests: FrameRequestQueue, queries: Queries) -> None:
    """Ask as `load` says until the time has passed and there are enough queries, then wait for the answers.

    `load`: pattern and its limits.
    `requests`: queue of the run.
    `queries`: times, which are filled in.
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
    """Ask as many queries at once as will take the time, by the rate that a first few show."""
    few = queries_needed(load.percentile)
    queries.ask(requests, few)
    queries.wait()
    rate = few / (queries.answered_s[-1] - queries.asked_s[0])
    queries.restart()
    queries.ask(requests, max(few, math.ceil(1.1 * rate * load.seconds)))


PATTERNS: dict[str, Callable[[Load, FrameRequestQueue, Queries], None]] = {
    "single-stream": _one_at_a_time,
    "multi-stream": _one_at_a_time,
    "server": _poisson,
    "offline": _all_at_once,
}


def tail(queries: int, late: int, share: float) -> float:
    """Return the tail of the binomial distribution: the chance of at most `late` late ones among `queries`.

    `share`: chance of each query to be late.
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
    """Return the least number of queries that show, at `CONFIDENCE`, that `percentile` of all are within a limit.

    `late` of them may be beyond it: 64 are needed for 0.90, 662 for 0.99, with one late query.
    """
    low, high = late, late + 1
    while tail(high, late, 1 - percentile) > 1 - CONFIDENCE:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if tail(middle, late, 1 - percentile) > 1 - CONFIDENCE else (low, middle)
    return high


def bound_ms(latencies_ms: list[float], percentile: float) -> float | None:
    """Return the latency that `percentile` of all queries are within, at `CONFIDENCE`; None with too few queries.

    It is the k-th largest, with k the number of queries that may be late, as in LoadGen.
    """
    if len(latencies_ms) < queries_needed(percentile):
        return None
    late = 1
    while queries_needed(percentile, late + 1) <= len(latencies_ms):
        late += 1
    return sorted(latencies_ms)[-late]


def verdict(load: Load, latencies_ms: list[float], lasted_s: float) -> list[str]:
    """Say in sentences why the result is invalid; empty when it is valid.

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
