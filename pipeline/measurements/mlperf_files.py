"""Readers of MLPerf's results: the summary of LoadGen, and the result file of the mobile app.

In SingleStream the next query begins when the last one has ended, so a latency is a service time. In the other
scenarios queries wait for each other, or are many at once: their latencies are wall times with queueing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, Final

from trilane.pipeline.measurements.measurement import (
    QUEUEING,
    Figures,
    Found,
    Kind,
    Measurement,
    contradiction,
    is_finite,
)

SINGLE: Final = "SingleStream"
SCENARIOS: Final = (SINGLE, "MultiStream", "Server", "Offline")
TITLE: Final = "MLPerf Results Summary"
LINE: Final = re.compile(r"^\s*(?P<key>[\w .%/()]+?)\s*:\s*(?P<value>.*)$")
LATENCY: Final = re.compile(r"(Min|Max|Mean|[\d.]+ percentile) latency \(ns\)")
PROCESSED: Final = re.compile(r"Processed at least \d+ queries \((\d+)\)")
RATE_SLACK: Final = 0.25  # relative: the app's throughput contains what it does between queries


def read_loadgen(text: str) -> Found:
    """Read mlperf_log_summary.txt."""
    found = Found("LoadGen summary", "latencies of queries, as percentiles")
    facts: dict[str, tuple[str, str]] = {}
    count = None
    for number, line in enumerate(text.splitlines(), 1):
        processed, pair = PROCESSED.search(line), LINE.match(line)
        count = int(processed[1]) if processed else count
        if pair:
            facts.setdefault(pair["key"], (f"line {number}", pair["value"].strip()))
    scenario = facts.get("Scenario", ("", ""))[1]
    if scenario not in SCENARIOS:
        found.refuse(facts.get("Scenario", ("Scenario", ""))[0], f"the scenario is {scenario!r}, none of {SCENARIOS}")
        return found
    found.says = _says(scenario)
    if facts.get("Mode", ("", "PerformanceOnly"))[1] == "AccuracyOnly":
        found.refuse(f"{facts['Mode'][0]}: Mode", "a run for accuracy, whose latencies are not measured with care")
        return found
    _add_latencies(found, scenario, facts, count)
    return found


def _says(scenario: str) -> str:
    if scenario == SINGLE:
        return "latencies of one query at a time (SingleStream): service times"
    return f"latencies of queries that wait for each other ({scenario}): wall times with queueing"


def _add_latencies(found: Found, scenario: str, facts: Mapping[str, tuple[str, str]], count: int | None) -> None:
    kind: Kind = "run" if scenario == SINGLE else "wall"
    ms: dict[str, float] = {}
    for key, (place, value) in facts.items():
        named = LATENCY.fullmatch(key)
        if named is None:
            continue
        time = found.ms(f"{place}: {key}", _number(value), "ns", kind, key)
        if time is not None:
            ms[named[1].removesuffix(" percentile")] = time
    place = facts.get("Mean latency (ns)", ("Mean latency (ns)", ""))[0]
    row = f"{place}: Mean latency (ns)"
    if "Mean" not in ms:
        if "Mean latency (ns)" not in facts:
            found.refuse(row, "no mean latency: the file is cut short or of another version")
        return
    percentiles = sorted((float(key), value) for key, value in ms.items() if key[0].isdigit())
    for (lower, time), (upper, other) in pairwise(percentiles):
        if time > other:
            found.refuse(
                row, f"the percentile {lower:g} ({time:g} ms) is above the percentile {upper:g} ({other:g} ms)"
            )
            return
    figures = Figures(ms["Mean"], None, ms.get("Min"), ms.get("50.00"), ms.get("95.00"), ms.get("Max"))
    wrong = contradiction(figures) or _of_rate(scenario, facts, ms["Mean"])
    if wrong:
        found.refuse(row, wrong)
        return
    single = scenario == SINGLE
    if not single:
        found.refuse(row, f"as a time of a stage: {QUEUEING}, and the scenario is {scenario}")
    name = facts.get("SUT name", ("", "query"))[1] or "query"
    what = "a query, one at a time" if single else f"a query under {scenario}, with queueing"
    more = {f"p{key:g}_ms": value for key, value in percentiles}
    result = facts.get("Result is", ("", ""))[1]
    hint = f"LoadGen calls the result {result}" if result and result != "VALID" else ""
    found.add(
        Measurement(
            name, kind, "ns", what, (), count, figures.mean, None, figures.low, figures.p50, figures.p95, figures.high,
            service=single, hint=hint, more=more,
        )
    )  # fmt: skip


def _of_rate(scenario: str, facts: Mapping[str, tuple[str, str]], mean_ms: float) -> str:
    """Say whether the rate of a SingleStream run contradicts its mean latency."""
    rate = _number(facts.get("QPS w/o loadgen overhead", ("", ""))[1])
    if scenario == SINGLE and isinstance(rate, float) and rate > 0 and abs(rate * mean_ms / 1e3 - 1) > RATE_SLACK:
        return f"a mean of {mean_ms:g} ms beside {rate:g} queries a second: a unit is wrong"
    return ""


def _number(text: str) -> object:
    try:
        return float(text)
    except ValueError:
        return text


def read_mlperf_app(document: Mapping[str, Any]) -> Found:
    """Read the result file of MLPerf's mobile app. Its latencies are seconds."""
    found = Found("MLPerf app results", "mean latency of each benchmark; service times from SingleStream alone")
    for index, result in enumerate(document["results"]):
        row = f"results[{index}]"
        if not isinstance(result, dict):
            found.refuse(row, "no table")
            continue
        name, scenario = str(result.get("benchmark_id", index)), result.get("loadgen_scenario")
        run = result.get("performance_run")
        loadgen = run.get("loadgen") if isinstance(run, dict) else None
        if not isinstance(loadgen, dict):
            found.skip("a benchmark without a run for performance")
        elif scenario not in SCENARIOS:
            found.refuse(f"{row}: {name}", f"the scenario is {str(scenario)[:40]!r}, none of {SCENARIOS}")
        else:
            _add_result(found, f"{row}: {name}", name, str(scenario), result, loadgen)
    return found


def _add_result(
    found: Found, row: str, name: str, scenario: str, result: Mapping[str, Any], loadgen: Mapping[str, Any]
) -> None:
    kind: Kind = "run" if scenario == SINGLE else "wall"
    mean = found.ms(row, loadgen.get("latency_mean"), "s", kind, "latency_mean")
    if mean is None:
        return
    throughput = result["performance_run"].get("throughput")
    rate = throughput.get("value") if isinstance(throughput, dict) else throughput
    if scenario == SINGLE and is_finite(rate) and rate > 0 and abs(rate * mean / 1e3 - 1) > RATE_SLACK:
        found.refuse(row, f"a mean of {mean:g} ms beside {rate:g} queries a second: a unit is wrong")
        return
    count = loadgen.get("query_count")
    if count is not None and (not isinstance(count, int) or isinstance(count, bool) or count < 1):
        found.refuse(row, f"query_count is {str(count)[:40]}, not a whole number of queries")
        return
    single = scenario == SINGLE
    if not single:
        found.refuse(row, f"as a time of a stage: {QUEUEING}, and the scenario is {scenario}")
    settings = result.get("backend_settings")
    hardware = str(settings.get("accelerator_desc", "")) if isinstance(settings, dict) else ""
    p90 = found.ms(row, loadgen["latency90"], "s", kind, "latency90") if "latency90" in loadgen else None
    more = {} if p90 is None else {"p90_ms": p90}
    hint = "" if loadgen.get("is_result_valid", True) else "LoadGen calls the result invalid"
    what = "a query, one at a time" if single else f"a query under {scenario}, with queueing"
    found.add(
        Measurement(
            name, kind, "s", what, count=count, mean_ms=mean, hardware=hardware, service=single, hint=hint, more=more
        )
    )
