"""Readers of files that vendors' tools write: Qualcomm's profiles, and MLPerf's results.

Qualcomm's tools write these formats:
- The QNN execution provider of ONNX Runtime (`qnn_backend_manager.cc`) writes a CSV with seven columns. It appends the
  rows of each run, and does not quote identifiers.
- `qnn-profile-viewer` writes the same table after some lines of text. Its header has blanks, each of its rows has
  `EXECUTE`, and there is a row for `qnn-net-run` itself.
- QHAS of QAIRT writes JSON with the table `htp_overall_summary`.
- `download_profile()` of qai-hub returns JSON with times in us.

Cycles become shares of a run, never times, because the files do not state the clock.

MLPerf's files are the summary of LoadGen, and the result file of the mobile app.

In LoadGen's scenario SingleStream, a query begins when the query before has ended, so a latency is a service time. In
all other scenarios queries wait for each other or come many at once, so a latency is a wall time with queueing.

Versions: LoadGen before 1.0 writes `Single Stream` and `Performance`. The app before 4.0 states no latencies, but the
duration of all queries (`loadgen_info.duration`, or `duration_ms`). The file of an app before 3.0 is a list of results.
In SingleStream the app's throughput is the reciprocal of the 90th percentile.

Source: the results that mlcommons publishes (mobile_results_v2.1 to v5.0).
"""

from __future__ import annotations

import csv
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, Final

from trilane.pipeline.measurements.measurement import (
    CYCLES,
    PER_MS,
    Kind,
    Measurement,
    Measurements,
    contradiction,
    falling,
    is_finite,
    number_in,
)

QNN_COLUMNS: Final = ("Msg Timestamp", "Message", "Time", "Unit of Measurement", "Timing Source", "Event Level")
IDENTIFIER: Final = "Event Identifier"
#: Unit of time for each unit in the CSV. Counts, bytes and objects (NO_TIMES) are no times.
QNN_UNITS: Final = {"US": "us", "MICROSEC": "us", "MS": "ms", "NS": "ns", "S": "s", "CYCLES": CYCLES}
NO_TIMES: Final = ("COUNT", "BYTES", "OBJECT", "NONE", "INF/SEC", "UNKNOWN", "")
#: Times of one execution, the outermost first: each contains the next.
NET_RUN: Final = "NetRun (execute) time"
WHOLE: Final = "QNN (execute) time"
NESTED: Final = (
    (NET_RUN, "whole call, with input and output"),
    (WHOLE, "whole call, with all waiting"),
    ("RPC (execute) time", "to the accelerator and back"),
    ("QNN accelerator (execute) time", "accelerator, with memory and power"),
    ("Accelerator (execute) time", "accelerator"),
    ("Accelerator (execute excluding wait) time", "accelerator, without waiting"),
)
WHAT: Final = dict(NESTED)
NESTED_SLACK: Final = 0.01  # share by which a time may be longer than a time that contains it
RATE_SLACK: Final = 0.02  # largest relative difference between a rate and the reciprocal of its time


def is_qnn(lines: Sequence[str]) -> bool:
    """Return whether one of the first 20 lines of a file is the header of the QNN CSV."""
    begins = [line.lstrip("\ufeff").split(",")[:3] for line in lines[:20]]
    return any([cell.strip() for cell in cells] == list(QNN_COLUMNS[:3]) for cells in begins)


def read_qnn(text: str) -> Measurements:
    """Return the measurements in a CSV of the QNN execution provider, which has one run or many."""
    found = Measurements("QNN profile (CSV)", "times of each run; of its nodes only cycles, which are shares")
    cycles: dict[str, list[float]] = defaultdict(list)
    run = _Run(found)
    for place, cells, identifier, graph in _qnn_rows(text, found):
        row = f"{place}: {identifier}"
        unit = cells["Unit of Measurement"].strip().upper()
        if unit in NO_TIMES:
            found.skip("a count, not a time")
        elif unit not in QNN_UNITS:
            found.refuse(row, f"the unknown unit {unit!r}: expected US or CYCLES")
        elif not _fits_name(unit, identifier, cells["Event Level"]):
            found.refuse(row, f"the unit is {unit}, but the name says {identifier!r}")
        else:
            value = number_in(cells["Time"])
            if QNN_UNITS[unit] == CYCLES:
                if (number := found.number(row, value, "the count of cycles")) is not None:
                    cycles[identifier if cells["Event Level"] == "SUB-EVENT" else ""].append(number)
            elif "execute" not in identifier.lower():
                found.skip("no time of a run, such as preparing the graph or acquiring memory")
            else:
                run.take(row, identifier, value, QNN_UNITS[unit], graph)
    run.finish()
    nodes = {name: sum(values) / len(values) for name, values in cycles.items() if name}
    _add_shares(found, nodes, {name: len(cycles[name]) for name in nodes})
    if of_runs := cycles.get(""):
        found.skipped["cycles of a run, whose clock is not known"] += len(of_runs)
    return found


def _qnn_rows(text: str, found: Measurements) -> Iterator[tuple[str, dict[str, str], str, str]]:
    """Yield (place, cells by column, name of the event, graph) of each row; refuse damaged rows.

    The graph is "" for a row that names none. In files that were joined a header may come again. Each line is parsed by
    itself, so that an open quote damages only one row.
    """
    header: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        place = f"line {number}"
        try:
            cells = next(csv.reader([line]), [])
        except csv.Error as error:
            found.refuse(place, f"no CSV: {error}")
            continue
        if cells and cells[0].strip() == QNN_COLUMNS[0]:
            header = [cell.strip() for cell in cells]
            missing = [name for name in (*QNN_COLUMNS[2:4], IDENTIFIER) if name not in header]
            if missing:
                found.refuse(place, f"a header without the column {missing[0]!r}")
                header = []
        elif header and cells:
            if len(cells) < len(header):
                found.refuse(f"{place}: {cells[-1]}", f"{len(cells)} cells of {len(header)}: the row is cut short")
            elif len(cells) > len(header) and header[-1] != IDENTIFIER:
                found.refuse(f"{place}: {cells[0]}", f"{len(cells)} cells, {len(header)} in the header")
            else:
                # the tool does not quote identifiers, which may have commas
                named = dict(zip(header, cells, strict=False))
                last = ",".join(cells[len(header) - 1 :]) if header[-1] == IDENTIFIER else named[IDENTIFIER]
                event = _event(named, last.strip())
                yield place, named, event, last.strip() if event == NET_RUN else ""


def _event(named: dict[str, str], identifier: str) -> str:
    """Return the name of a row's event.

    This is the identifier, with two exceptions: a row of `qnn-net-run` has the graph's name as identifier, and an event
    without a name has NULL. The texts of other columns are cleaned in place in `named`.
    """
    for column in ("Event Level", "Message", "Timing Source"):
        named[column] = named.get(column, "").strip().upper()
    if named["Message"] == "EXECUTE" and named["Event Level"] == "ROOT":
        if named["Timing Source"] == "NETRUN":
            return NET_RUN
        if identifier.upper() == "NULL":
            return WHOLE
    return identifier


def _fits_name(unit: str, identifier: str, level: str) -> bool:
    """Return whether a row's unit agrees with its event's name. The name of a node need not contain `(cycles)`."""
    if QNN_UNITS[unit] == CYCLES and level == "SUB-EVENT":
        return identifier not in WHAT
    return ("(cycles)" in identifier.lower()) == (QNN_UNITS[unit] == CYCLES)


class _Run:
    """Collects the times of executions, one after the other. The times of an execution may come in any order.

    A name that comes again begins the next execution. The time of the whole execution, if it comes after its parts,
    ends the execution. A row of `qnn-net-run` names the graph of an execution.
    """

    def __init__(self, found: Measurements) -> None:
        self._found = found
        self._rows: dict[str, tuple[str, float, str]] = {}
        self._graph = ""
        self._ended: list[tuple[str, str, str, float, str]] = []  # graph, row, name, value, unit

    def take(self, row: str, name: str, value: object, unit: str, graph: str) -> None:
        if name not in WHAT:
            self._found.sample(row, name, "run", value, unit, "as its name says")
            return
        if name in self._rows:
            self.end()
        self._graph = graph or self._graph
        if self._found.ms(row, value, unit, "run") is not None:
            self._rows[name] = (row, float(value), unit)  # type: ignore[arg-type]
        if name == WHOLE and self._rows.keys() - {WHOLE, NET_RUN}:
            self.end()

    def end(self) -> None:
        """End the execution: keep a longest series of times that fit into each other, and refuse the others."""
        names = [name for name, _ in NESTED if name in self._rows]
        ms = [self._rows[name][1] / PER_MS[self._rows[name][2]] for name in names]
        kept = falling(ms, NESTED_SLACK)
        for index, name in enumerate(names):
            row, value, unit = self._rows[name]
            if index in kept:
                self._ended.append((self._graph, row, name, value, unit))
                continue
            around = next((k for k in reversed(kept) if k < index and ms[index] > ms[k]), None)
            inside = next((k for k in kept if k > index and ms[index] < ms[k]), None)
            other, word = (names[around], "longer") if around is not None else (names[inside or 0], "shorter")
            place = "around" if around is not None else "within"
            self._found.refuse(row, f"{ms[index]:g} ms is {word} than {other!r} {place} it")
        self._rows, self._graph = {}, ""

    def finish(self) -> None:
        """Add the times of all executions to the measurements; if there are several graphs, names contain the graph."""
        self.end()
        several = len({graph for graph, *_ in self._ended if graph}) > 1
        for graph, row, name, value, unit in self._ended:
            said = f"{name} of {graph or 'an unnamed graph'}" if several else name
            self._found.sample(row, said, "run", value, unit, WHAT[name])


def _add_shares(found: Measurements, nodes: Mapping[str, float], counts: Mapping[str, int | None]) -> None:
    whole = sum(nodes.values())
    for name, mean in nodes.items():
        share = mean / whole if whole else None
        what = "cycles: a share, no time"
        found.add(
            Measurement(
                name, "layer", CYCLES, what, count=counts[name], share=share, service=False, more={"cycles": mean}
            )
        )  # fmt: skip


def read_qhas(data: Mapping[str, Any]) -> Measurements:
    """Return the measurements in the summary of a QHAS analysis. `data`: its table `data`, which has all others."""
    found = Measurements(
        "QHAS summary", "the mean time of a run with its traffic; of operators only cycles, which are shares"
    )
    rows = _rows(data.get("htp_overall_summary"))
    if not rows:
        found.refuse("htp_overall_summary", "no rows")
    for index, summary in enumerate(rows):
        row, name = f"htp_overall_summary.data[{index}]", "" if len(rows) == 1 else f" (htp {index})"
        more = {key: value for key in QHAS_MORE if is_finite(value := summary.get(key))}
        time = found.ms(f"{row}: time_us", summary.get("time_us"), "us", "run")
        rate = summary.get("inf_per_s")
        if time is not None and is_finite(rate) and abs(rate * time / 1e3 - 1) > RATE_SLACK:
            found.refuse(f"{row}: time_us", f"{time:g} ms beside {rate:g} inferences a second: a unit is wrong")
            time = None
        elif time is not None:
            what = "run, with what is around the graph"
            found.add(Measurement(f"time_us{name}", "run", "us", what, mean_ms=time, more=more))
        execute = found.ms(f"{row}: graph_execute_us", summary.get("graph_execute_us"), "us", "run")
        if execute is not None and time is not None and execute > 1.01 * time:
            found.refuse(
                f"{row}: graph_execute_us", f"{execute:g} ms, longer than the {time:g} ms of time_us around it"
            )
        elif execute is not None:
            found.add(Measurement(f"graph_execute_us{name}", "run", "us", "the graph alone", mean_ms=execute))
    nodes = {}
    for index, node in enumerate(_rows(data.get("qnn_op_instances_nodes"))):
        name = str(node.get("qnn_op", index))
        place = f"qnn_op_instances_nodes.data[{index}]: {name}"
        cycles = found.number(place, node.get("cycles"), "the count of cycles")
        if cycles is not None:
            nodes[name] = cycles
    _add_shares(found, nodes, dict.fromkeys(nodes))
    return found


#: Figures of a QHAS summary that a measurement keeps in `more`.
QHAS_MORE: Final = (
    "total_dram_read", "total_dram_write", "total_dram", "peak_vtcm_alloc", "percent_utilization", "inf_per_s",
    "timeline_cycles",
)  # fmt: skip


def _rows(table: object) -> list[dict[str, Any]]:
    rows = table.get("data") if isinstance(table, dict) else None
    return [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []


def read_ai_hub(document: Mapping[str, Any]) -> Measurements:
    """Return the measurements in the result of AI Hub's `download_profile()`, whose times are in us."""
    found = Measurements("AI Hub profile", "times of each run on the device, and the mean of each layer")
    summary = document.get("execution_summary")
    summary = summary if isinstance(summary, dict) else {}
    times = summary.get("all_inference_times")
    for index, value in enumerate(times if isinstance(times, list) else []):
        row = f"execution_summary.all_inference_times[{index}]"
        found.sample(row, "all_inference_times", "run", value, "us", "run on the device, without loading")
    stated = summary.get("estimated_inference_time")
    if stated is not None:
        row = "execution_summary.estimated_inference_time"
        if (time := found.ms(row, stated, "us", "run")) is not None:
            what = "run, as AI Hub estimates it"
            found.add(Measurement("estimated_inference_time", "run", "us", what, mean_ms=time))
    elif not times:
        found.refuse("execution_summary", "neither all_inference_times nor estimated_inference_time")
    for key in ("first_load_time", "warm_load_time", "compile_time"):
        if key in summary:
            found.skip("time to load or compile")
    _add_layers(found, document.get("execution_detail"))
    return found


def _add_layers(found: Measurements, detail: object) -> None:
    times: list[tuple[str, str, float]] = []
    for index, layer in enumerate(detail if isinstance(detail, list) else []):
        row = f"execution_detail[{index}]"
        if not isinstance(layer, dict):
            found.refuse(row, "no table")
            continue
        name, hardware = str(layer.get("name", index)), str(layer.get("compute_unit", ""))
        if layer.get("execution_time") is None:
            found.skip("a layer without a time")
            continue
        time = found.ms(f"{row}: {name}", layer["execution_time"], "us", "layer")
        if time is not None:
            times.append((name, hardware, time))
    whole = sum(time for *_, time in times)
    for name, hardware, time in times:
        share = time / whole if whole else None
        found.add(Measurement(name, "layer", "us", "a layer, the mean", mean_ms=time, share=share, hardware=hardware))


SINGLE: Final = "SingleStream"
OFFLINE: Final = "Offline"
SCENARIOS: Final = (SINGLE, "MultiStream", "Server", OFFLINE)
TITLE: Final = "MLPerf Results Summary"
LATENCY: Final = re.compile(r"(Min|Max|Mean|[\d.]+ percentile) latency \(ns\)")
PROCESSED: Final = re.compile(r"Processed at least \d+ queries \((\d+)\)")
APP_RATE_SLACK: Final = 0.25  # relative difference between a rate and the reciprocal of its time
RATE_ROUNDING: Final = 0.005  # of the rates that LoadGen prints
UNIT_SLACK: Final = 10.0  # largest factor between mean and 90th percentile; a wrong unit gives a larger factor
WHOLE_MS: Final = "measured_duration_ms"  # key of the duration of all queries, if the app states nothing of LoadGen
ACCURACY: Final = ("AccuracyOnly", "Accuracy")


def read_loadgen(text: str) -> Measurements:
    """Return the measurements in LoadGen's summary, mlperf_log_summary.txt."""
    found = Measurements("LoadGen summary", "latencies of queries, as percentiles")
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


def _add_latencies(found: Measurements, scenario: str, facts: Mapping[str, tuple[str, str]], count: int | None) -> None:
    kind: Kind = "run" if scenario == SINGLE else "wall"
    ms: dict[str, float] = {}
    for key, (place, value) in facts.items():
        named = LATENCY.fullmatch(key)
        if named is None:
            continue
        time = found.ms(f"{place}: {key}", number_in(value), "ns", kind, key)
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
    name = facts.get("SUT name", ("", "query"))[1] or "query"
    more = {f"p{key:g}_ms": value for key, value in percentiles}
    result = facts.get("Result is", ("", ""))[1]
    hints = [f"LoadGen calls the result {result}"] if result and result != "VALID" else []
    rate = number_in(facts.get("Samples per second", ("", ""))[1])
    if scenario == OFFLINE and is_finite(rate):
        hints.append(f"{rate:g} samples a second")
        more["samples_per_second"] = rate
    made = Measurement(
        name, kind, "ns", _what(scenario), (), count, ms["Mean"], None, ms.get("Min"), ms.get("50.00"),
        ms.get("95.00"), ms.get("Max"), service=scenario == SINGLE, hint="; ".join(hints), more=more,
    )  # fmt: skip
    if wrong := contradiction(made) or _of_rate(scenario, facts, ms["Mean"]):
        found.refuse(row, wrong)
        return
    found.add(made)


def _what(scenario: str) -> str:
    if scenario == SINGLE:
        return "query, one at a time"
    return "all samples at once (Offline)" if scenario == OFFLINE else f"query, with queueing ({scenario})"


def _of_rate(scenario: str, facts: Mapping[str, tuple[str, str]], mean_ms: float) -> str:
    """Return a sentence if the rate of a SingleStream run contradicts its mean latency; otherwise ""."""
    rate = number_in(facts.get("QPS w/o loadgen overhead", ("", ""))[1])
    if scenario != SINGLE or not isinstance(rate, float) or rate <= 0:
        return ""
    if abs(rate - 1e3 / mean_ms) > APP_RATE_SLACK * rate + RATE_ROUNDING:
        return f"a mean of {mean_ms:g} ms beside {rate:g} queries a second: a unit is wrong"
    return ""


def is_mlperf_app(document: object) -> bool:
    """Return whether a document is one result of MLPerf's mobile app, or a list of such results."""
    several = document if isinstance(document, list) else [document]
    return any(isinstance(result, dict) and "loadgen_scenario" in result for _, result in _results(several))


def _results(documents: Sequence[Any]) -> Iterator[tuple[str, Any]]:
    """Yield (place in the file, value) of each benchmark; in a wrong file, the value may be no table.

    `documents`: results of MLPerf's mobile app.
    """
    for number, each in enumerate(documents):
        results = each.get("results") if isinstance(each, dict) else None
        for index, result in enumerate(results if isinstance(results, list) else []):
            yield f"results[{index}]" if len(documents) == 1 else f"[{number}].results[{index}]", result


def read_mlperf_app(document: Mapping[str, Any] | Sequence[Any]) -> Measurements:
    """Return the measurements in the result file of MLPerf's mobile app, whose latencies are in seconds."""
    found = Measurements("MLPerf app results", "")
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
    """Return the table with LoadGen's latencies; {} if there is none. From 4.0 on the app calls it `loadgen`."""
    older = run.get("loadgen_info")
    table = older if isinstance(older, dict) and "latency_mean" in older else run.get("loadgen")
    return table if isinstance(table, dict) else {}


def _of_older_app(found: Measurements, row: str, run: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table like `_loadgen` of newer versions; its mean is the duration of all queries over their number.

    The mean is in seconds; None if the duration is refused.
    """
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
    found: Measurements, row: str, name: str, scenario: str, result: Mapping[str, Any], loadgen: Mapping[str, Any]
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
    """Return whether a rate in queries a second fits the times of the queries.

    The rate must be about the reciprocal of the 90th percentile, which must be within a factor UNIT_SLACK of the mean.
    Without a percentile, the rate must be within a factor UNIT_SLACK of the reciprocal of the mean.
    """
    if p90_ms is not None:
        return (
            abs(rate * p90_ms / 1e3 - 1) <= APP_RATE_SLACK and mean_ms < UNIT_SLACK * p90_ms < UNIT_SLACK**2 * mean_ms
        )
    return 1 / UNIT_SLACK < rate * mean_ms / 1e3 < UNIT_SLACK
