"""Readers of MLPerf's results: the summary of LoadGen, and the result file of the mobile app.

In SingleStream the next query begins when the last one has ended, so a latency is a service time. In the other
scenarios queries wait for each other, or are many at once: their latencies are wall times with queueing.

Versions: LoadGen before 1.0 writes `Single Stream` and `Performance`. The app before 4.0 states no latencies, but how
long all queries took (`loadgen_info.duration`, or `duration_ms`), and before 3.0 its file is a list of results. In
SingleStream the app's throughput is one over the 90th percentile.
Source: the results that mlcommons publishes (mobile_results_v2.1 to v5.0).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, Final

from trilane.pipeline.measurements.measurement import (
    Figures,
    Found,
    Kind,
    Measurement,
    contradiction,
    is_finite,
)

SINGLE: Final = "SingleStream"
OFFLINE: Final = "Offline"
SCENARIOS: Final = (SINGLE, "MultiStream", "Server", OFFLINE)
TITLE: Final = "MLPerf Results Summary"
LATENCY: Final = re.compile(r"(Min|Max|Mean|[\d.]+ percentile) latency \(ns\)")
PROCESSED: Final = re.compile(r"Processed at least \d+ queries \((\d+)\)")
RATE_SLACK: Final = 0.25  # relative, between a rate and the time that it is one over
RATE_ROUNDING: Final = 0.005  # of the rates that LoadGen prints
UNIT_SLACK: Final = 10.0  # between a rate of the 90th percentile and the mean: a wrong unit is further off
WHOLE_MS: Final = "measured_duration_ms"  # of all queries, where the app states nothing of LoadGen
ACCURACY: Final = ("AccuracyOnly", "Accuracy")


def read_loadgen(text: str) -> Found:
    """Read mlperf_log_summary.txt."""
    found = Found("LoadGen summary", "latencies of queries, as percentiles")
    facts: dict[str, tuple[str, str]] = {}
    count = None
    for number, line in enumerate(text.splitlines(), 1):
        if TITLE in line and "Scenario" in facts:
            found.refuse(f"line {number}", "another summary begins: give each its own file")
            break
        processed, (key, colon, value) = PROCESSED.search(line), line.partition(":")
        count = int(processed[1]) if processed else count
        if colon:
            facts.setdefault(key.strip(), (f"line {number}", value.strip()))
    scenario = facts.get("Scenario", ("", ""))[1].replace(" ", "")
    if scenario not in SCENARIOS:
        found.refuse(facts.get("Scenario", ("Scenario", ""))[0], f"the scenario is {scenario!r}, none of {SCENARIOS}")
        return found
    found.says = _says(scenario)
    if facts.get("Mode", ("", ""))[1] in ACCURACY:
        found.refuse(f"{facts['Mode'][0]}: Mode", "a run for accuracy, whose latencies are not measured with care")
        return found
    _add_latencies(found, scenario, facts, count)
    return found


def _says(scenario: str) -> str:
    if scenario == SINGLE:
        return "latencies of one query at a time (SingleStream): service times"
    if scenario == OFFLINE:
        return "one query with all samples (Offline): a throughput, and no latency of a run"
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
    name = facts.get("SUT name", ("", "query"))[1] or "query"
    more = {f"p{key:g}_ms": value for key, value in percentiles}
    result = facts.get("Result is", ("", ""))[1]
    hints = [f"LoadGen calls the result {result}"] if result and result != "VALID" else []
    rate = _number(facts.get("Samples per second", ("", ""))[1])
    if scenario == OFFLINE and is_finite(rate):
        hints.append(f"{rate:g} samples a second")
        more["samples_per_second"] = rate
    found.add(
        Measurement(
            name, kind, "ns", _what(scenario), (), count, figures.mean, None, figures.low, figures.p50, figures.p95,
            figures.high, service=scenario == SINGLE, hint="; ".join(hints), more=more,
        )
    )  # fmt: skip


def _what(scenario: str) -> str:
    if scenario == SINGLE:
        return "query, one at a time"
    return "all samples at once (Offline)" if scenario == OFFLINE else f"query, with queueing ({scenario})"


def _of_rate(scenario: str, facts: Mapping[str, tuple[str, str]], mean_ms: float) -> str:
    """Say whether the rate of a SingleStream run contradicts its mean latency."""
    rate = _number(facts.get("QPS w/o loadgen overhead", ("", ""))[1])
    if scenario != SINGLE or not isinstance(rate, float) or rate <= 0:
        return ""
    if abs(rate - 1e3 / mean_ms) > RATE_SLACK * rate + RATE_ROUNDING:
        return f"a mean of {mean_ms:g} ms beside {rate:g} queries a second: a unit is wrong"
    return ""


def _number(text: str) -> object:
    try:
        return float(text)
    except ValueError:
        return text


def is_mlperf_app(document: object) -> bool:
    """Say whether a document is one result of MLPerf's mobile app, or a list of them."""
    several = document if isinstance(document, list) else [document]
    return any(isinstance(result, dict) and "loadgen_scenario" in result for _, result in _results(several))


def _results(documents: Sequence[Any]) -> Iterator[tuple[str, Any]]:
    """Yield the place and the table of each benchmark."""
    for number, each in enumerate(documents):
        results = each.get("results") if isinstance(each, dict) else None
        for index, result in enumerate(results if isinstance(results, list) else []):
            yield f"results[{index}]" if len(documents) == 1 else f"[{number}].results[{index}]", result


def read_mlperf_app(document: Mapping[str, Any] | Sequence[Any]) -> Found:
    """Read the result file of MLPerf's mobile app. Its latencies are seconds."""
    found = Found("MLPerf app results", "")
    divided = stated = False
    for row, result in _results(document if isinstance(document, list) else [document]):
        if not isinstance(result, dict):
            found.refuse(row, "no table")
            continue
        name, scenario = str(result.get("benchmark_id", row)), result.get("loadgen_scenario")
        run = result.get("performance_run")
        if not isinstance(run, dict):
            found.skip("a benchmark without a run for performance")
        elif scenario not in SCENARIOS:
            found.refuse(f"{row}: {name}", f"the scenario is {str(scenario)[:40]!r}, none of {SCENARIOS}")
        elif loadgen := _loadgen(run):
            stated = True
            _add_result(found, f"{row}: {name}", name, str(scenario), result, loadgen)
        elif scenario == SINGLE and "measured_samples" in run:
            divided = True
            _add_result(found, f"{row}: {name}", name, SINGLE, result, _of_older_app(found, f"{row}: {name}", run))
        else:
            found.skip("a benchmark without latencies")
    figures = ["mean latency as LoadGen states it"] if stated else []
    figures += ["duration of the run by its number of samples"] if divided else []
    found.says = f"of each benchmark the {' or the '.join(figures)}; service times from SingleStream alone"
    return found


def _loadgen(run: Mapping[str, Any]) -> dict[str, Any]:
    """Return the table with LoadGen's latencies: versions from 4.0 on call it `loadgen`; {} if there is none."""
    older = run.get("loadgen_info")
    table = older if isinstance(older, dict) and "latency_mean" in older else run.get("loadgen")
    return table if isinstance(table, dict) else {}


def _of_older_app(found: Found, row: str, run: Mapping[str, Any]) -> dict[str, Any]:
    """Return what newer versions state of a run: the mean is the time of all queries by their number."""
    info = run.get("loadgen_info")
    info = info if isinstance(info, dict) else {}
    key = next((key for key in ("duration", "duration_ms") if key in info), "duration" if info else WHOLE_MS)
    path = f"performance_run.{'loadgen_info.' * bool(info)}{key}"
    value = (info or run).get(key)
    if value is None:
        found.refuse(row, f"no latency and no {path}: give mlperf_log_summary.txt of this run instead")
    whole = None if value is None else found.number(row, value, path)
    count = run["measured_samples"]
    is_count = isinstance(count, int) and not isinstance(count, bool) and count > 0
    mean = None if whole is None else whole / (1e3 if key.endswith("_ms") else 1.0) / (count if is_count else 1)
    valid = info.get("validity", run.get("loadgen_validity", True))
    return {"query_count": count, "latency_mean": mean, "is_result_valid": valid, "what": f"{key} by measured_samples"}


def _add_result(
    found: Found, row: str, name: str, scenario: str, result: Mapping[str, Any], loadgen: Mapping[str, Any]
) -> None:
    kind: Kind = "run" if scenario == SINGLE else "wall"
    if loadgen.get("what") and loadgen["latency_mean"] is None:
        return  # its duration is refused already
    count = loadgen.get("query_count")
    if count is not None and (not isinstance(count, int) or isinstance(count, bool) or count < 1):
        found.refuse(row, f"query_count is {str(count)[:40]}, not a whole number of queries")
        return
    mean = found.ms(row, loadgen.get("latency_mean"), "s", kind, loadgen.get("what", "latency_mean"))
    p90 = found.ms(row, loadgen["latency90"], "s", kind, "latency90") if "latency90" in loadgen else None
    if mean is None:
        return
    throughput = result["performance_run"].get("throughput")
    rate = throughput.get("value") if isinstance(throughput, dict) else throughput
    if scenario == SINGLE and is_finite(rate) and rate > 0 and not _fits(rate, mean, p90):
        found.refuse(row, f"a mean of {mean:g} ms beside {rate:g} queries a second: a unit is wrong")
        return
    settings = result.get("backend_settings")
    hardware = str(settings.get("accelerator_desc", "")) if isinstance(settings, dict) else ""
    more = {} if p90 is None else {"p90_ms": p90}
    hint = "" if loadgen.get("is_result_valid", loadgen.get("validity", True)) else "LoadGen calls the result invalid"
    what = f"{_what(scenario)}: {loadgen.get('what', 'the mean')}"
    found.add(
        Measurement(
            name,
            kind,
            "s",
            what,
            count=count,
            mean_ms=mean,
            hardware=hardware,
            service=scenario == SINGLE,
            hint=hint,
            more=more,
        )
    )


def _fits(rate: float, mean_ms: float, p90_ms: float | None) -> bool:
    """Say whether a rate is one over the 90th percentile; where that is not stated, not a unit away from the mean."""
    if p90_ms is not None:
        return abs(rate * p90_ms / 1e3 - 1) <= RATE_SLACK and mean_ms < UNIT_SLACK * p90_ms < UNIT_SLACK**2 * mean_ms
    return 1 / UNIT_SLACK < rate * mean_ms / 1e3 < UNIT_SLACK
