"""The four load patterns of MLPerf inference and what makes a result valid. Rule: names, patterns and the number of
queries that a percentile needs are LoadGen's, so that both can be laid side by side; the warm-up is not counted.

Reddi et al., MLPerf Inference Benchmark, ISCA 2020, sections III and V.
"""

from __future__ import annotations

import math
import random
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from trilane.errors import TrilaneError
from trilane.pipeline.requests import FrameRequestQueue

CONFIDENCE = 0.99
WARM_UP = 8
#: Scenario: the percentile of its queries' latency that is judged. Offline is judged by its rate.
PERCENTILES = {"single-stream": 0.90, "multi-stream": 0.99, "server": 0.99, "offline": 0.90}
STALLED_S = 60.0


@dataclass(frozen=True)
class Load:
    """`seconds`: least duration. `rate`: queries a second that a server is asked. `limit_ms`: on the percentile of a
    server's latency. `samples`: frames in a query of multi-stream. `seed`: of the arrivals."""

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
    """What is asked of a `FrameRequestQueue`, and when it was answered.

    Shared by the thread that asks and the one that runs.

    A query is `size` frames and is answered with the last of them.
    """

    size: int = 1
    asked_s: list[float] = field(default_factory=list)
    answered_s: list[float] = field(default_factory=list)
    over: bool = False
    changed: threading.Condition = field(default_factory=threading.Condition)
    _frames: int = 0

    def ask(self, inlet: FrameRequestQueue, count: int = 1) -> None:
        """`count` queries, now."""
        self.asked_s += [time.monotonic()] * count
        inlet.ask(count * self.size)

    def answered(self, _frame: int) -> None:
        """For `FrameRequestQueue`."""
        with self.changed:
            self._frames += 1
            if self._frames % self.size == 0:
                self.answered_s.append(time.monotonic())
                self.changed.notify_all()

    def ended(self) -> None:
        """For `FrameRequestQueue`."""
        with self.changed:
            self.over = True
            self.changed.notify_all()

    def wait(self) -> None:
        """Until every query is answered. Raises TrilaneError when the run ends first or nothing moves."""
        with self.changed:
            while len(self.answered_s) < len(self.asked_s) and not self.over:
                if not self.changed.wait(STALLED_S):
                    raise TrilaneError(f"no query was answered for {STALLED_S:.0f} s")
            if len(self.answered_s) < len(self.asked_s):
                raise TrilaneError("the run ended before every query was answered")

    def warm_up(self, inlet: FrameRequestQueue) -> None:
        """A few queries that are not counted."""
        self.ask(inlet, WARM_UP)
        self.wait()
        self.forget()

    def forget(self) -> None:
        """Count from now on."""
        self.asked_s.clear()
        self.answered_s.clear()

    @property
    def latencies_ms(self) -> list[float]:
        """Of the answered ones, in the order in which they were asked."""
        return [(end - begin) * 1e3 for begin, end in zip(self.asked_s, self.answered_s, strict=False)]


def play(load: Load, inlet: FrameRequestQueue, queries: Queries) -> None:
    """Ask as `load` says until it has lasted long enough and has queries enough, and wait for the answers."""
    queries.warm_up(inlet)
    PATTERNS[load.scenario](load, inlet, queries)
    queries.wait()


def _one_at_a_time(load: Load, inlet: FrameRequestQueue, queries: Queries) -> None:
    end = time.monotonic() + load.seconds
    needed = queries_needed(load.percentile)
    while time.monotonic() < end or len(queries.asked_s) < needed:
        queries.ask(inlet)
        queries.wait()


def _poisson(load: Load, inlet: FrameRequestQueue, queries: Queries) -> None:
    gaps = random.Random(load.seed)
    at = time.monotonic()
    end, needed = at + load.seconds, queries_needed(load.percentile)
    while (at := at + gaps.expovariate(load.rate)) < end or len(queries.asked_s) < needed:
        if queries.over:
            return
        time.sleep(max(0.0, at - time.monotonic()))
        queries.ask(inlet)


def _all_at_once(load: Load, inlet: FrameRequestQueue, queries: Queries) -> None:
    """As many as last for the time, by the rate that a first few show."""
    few = queries_needed(load.percentile)
    queries.ask(inlet, few)
    queries.wait()
    rate = few / (queries.answered_s[-1] - queries.asked_s[0])
    queries.forget()
    queries.ask(inlet, max(few, math.ceil(1.1 * rate * load.seconds)))


PATTERNS: dict[str, Callable[[Load, FrameRequestQueue, Queries], None]] = {
    "single-stream": _one_at_a_time,
    "multi-stream": _one_at_a_time,
    "server": _poisson,
    "offline": _all_at_once,
}


def tail(queries: int, late: int, share: float) -> float:
    """Chance that at most `late` of `queries` are late when each is with probability `share`: the binomial's tail."""
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
    """The least number of queries of which `late` may be beyond a limit so that `percentile` of all that could be
    asked are within it, at `CONFIDENCE`: 64 for 0.90 and 662 for 0.99 with one late query."""
    low, high = late, late + 1
    while tail(high, late, 1 - percentile) > 1 - CONFIDENCE:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if tail(middle, late, 1 - percentile) > 1 - CONFIDENCE else (low, middle)
    return high


def bound_ms(latencies_ms: list[float], percentile: float) -> float | None:
    """What `percentile` of all latencies are within, at `CONFIDENCE`; None when the queries are too few to say.

    Of `late` queries that may be beyond it one fewer is left out, as LoadGen does.
    """
    if len(latencies_ms) < queries_needed(percentile):
        return None
    late = 1
    while queries_needed(percentile, late + 1) <= len(latencies_ms):
        late += 1
    return sorted(latencies_ms)[-late]


def verdict(load: Load, latencies_ms: list[float], lasted_s: float) -> list[str]:
    """What makes the result invalid, in sentences; none when it is valid."""
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
