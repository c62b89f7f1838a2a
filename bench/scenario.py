"""Does the pipeline answer as a service should: one query at a time, several, at random moments, all at once?

Rule: the whole pipeline answers, from pose to presented frame. A result is valid or says why not, and MLCommons LoadGen
can ask for the same load and evaluate it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from trilane.bench.lib.load import PATTERNS, Load, Queries, bound_ms, play, verdict
from trilane.bench.lib.loadgen import LoadGenPlayer, load_generator
from trilane.errors import BadInputError, TrilaneError
from trilane.pipeline.controls import FrameRequestQueue
from trilane.pipeline.description import Pipeline
from trilane.pipeline.memory import Assets
from trilane.pipeline.run import run_pipeline
from trilane.stages.avatar_pipeline import avatar_pipeline
from trilane.stages.configure import configure
from trilane.stages.run_options import RunOptions

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
    """One row for each scenario and each of `judge`: `trilane` or `loadgen`, MLCommons' own.

    Scenarios: single-stream, multi-stream (`samples` frames a query), server (`rate` queries a second at random
    moments, each to be answered within `limit_ms`), offline. A row's `verdict` is VALID when it lasted `seconds`, has
    as many queries as its percentile needs, and for a server when few enough were late; `because` says why not.
    `percentile_ms`: the latency that `percentile` of all queries are within.

    Raises BadInputError, MissingPartError, TrilaneError when a run fails.
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
    """Do one run under `load`; return its row, and LoadGen's summary where LoadGen evaluates it.

    `pipeline`, `assets`: pipeline to run, and the arrays that its stages may read.
    `load`: pattern and its limits.
    `evaluated_by`: one of `JUDGES`.
    `policy`: policy of the scheduler.
    Raises TrilaneError when the run fails.
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
    return _row(load, queries, loadgen), loadgen.verdict.summary if loadgen is not None else ""


@dataclass
class _Player(threading.Thread):
    """Asks for frames on a thread of its own.

    `requests`: queue of the run; asking begins when it is open.
    `work`: function that asks, and waits for the answers.
    `errors`: errors that `work` raised.
    """

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

    def __hash__(self) -> int:
        return id(self)


def _row(load: Load, queries: Queries, loadgen: LoadGenPlayer | None) -> dict[str, Any]:
    latencies = queries.latencies_ms
    lasted_s = queries.answered_s[-1] - queries.asked_s[0]
    reasons = verdict(load, latencies, lasted_s)
    return {
        "scenario": load.scenario,
        "judge": "trilane" if loadgen is None else "loadgen",
        "verdict": "VALID" if (loadgen.verdict.valid if loadgen is not None else not reasons) else "INVALID",
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
