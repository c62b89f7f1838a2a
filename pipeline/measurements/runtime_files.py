"""Readers of files that network runtimes write.

The tools write these formats:
- ONNX Runtime's profile (`profiler.cc`): a JSON array with one event on each line, times in us. If the session was not
  closed, the array is cut off.
- The log of `benchmark_model` of TFLite and LiteRT: times in us, but of operators in ms.
- TensorRT's layers from `trtexec --exportProfile`: times in ms.
- The app benchmarks of react-native-executorch: times in ms.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any, Final

from trilane.pipeline.measurements.measurement import (
    PER_MS,
    ROUNDING,
    Kind,
    Measurement,
    Measurements,
    contradiction,
    falling,
    number_in,
)

#: Contents of the session events that are runs, by the event's name.
RUNS: Final = {
    "model_run": "a call of the session",
    "SequentialExecutor::Execute": "the nodes of a run",
    "ParallelExecutor::Execute": "the nodes of a run",
}
NODE_ENDING: Final = "_kernel_time"


def read_ort(events: Sequence[Any]) -> Measurements:
    """Return the measurements in the events of ONNX Runtime's profile."""
    found = Measurements("ONNX Runtime profile", "times of each call of the session, and of each node")
    for index, event in enumerate(events):
        row = f"event {index}"
        if not isinstance(event, dict):
            found.refuse(row, "no table")
            continue
        name, category = str(event.get("name", "")), event.get("cat")
        row = f"{row}: {name}"
        if category == "Session" and name in RUNS:
            found.sample(row, name, "run", event.get("dur"), "us", RUNS[name])
        elif category == "Node" and name.endswith(NODE_ENDING):
            facts = event.get("args")
            facts = facts if isinstance(facts, dict) else {}
            hardware, operator = str(facts.get("provider", "")), str(facts.get("op_name", ""))
            what = f"a node, {operator}" if operator else "a node"
            node = name.removesuffix(NODE_ENDING) or operator  # version 0.4 names no node
            found.sample(row, node, "layer", event.get("dur"), "us", what, hardware=hardware)
        elif category == "Session":
            found.skip("loading and preparing the session")
        else:
            found.skip("fences and kernels inside nodes")
    return found


PAIR: Final = re.compile(r"\b(count|first|curr|min|max|avg|std|p5|median|p95)=(\S+)")
SUMMARY: Final = re.compile(r"Inference timings in us: (.*)")
GRAPH: Final = re.compile(r"(?:--graph=|Graph: \[)([^\s\]\\]+)")
LITERT: Final = re.compile(
    r"Inference \((avg|min|max|std|median|p5|p95)\):\s+(\S+)\s*(us|ms|s)?(?:\s*\((\d+) runs?\))?"
)
APPLIED: Final = re.compile(r"applied (\w+) delegate.*completely executed")
OF_START: Final = "Benchmark Initialization"
OPERATORS: Final = "Run Order"


def is_benchmark(text: str) -> bool:
    """Return whether a text has lines that `benchmark_model` writes."""
    return re.search(r"\bcount=\d+ (first|curr)=|Inference timings in us:|Inference \(avg\):", text) is not None


class BenchmarkLog:
    """Reads a log of `benchmark_model`, which may contain several benchmarks, line by line.

    `found`: measurements in the log.

    The last line of figures before a summary is about the measured runs; an earlier one is about the warm-up.
    """

    def __init__(self, text: str) -> None:
        says = "count, mean, spread and percentiles of the runs, warm-up apart; of operators the mean"
        self.found = Measurements("TFLite benchmark_model log", says)
        self._graph, self._starting, self._in_order, self._columns = "benchmark", False, False, list[str]()
        self._announced = 0
        self._lines: list[str] = []  # of this benchmark
        self._figures: tuple[str, dict[str, str]] | None = None
        self._is_warm = False  # whether a warm-up came before `_figures`
        self._litert: dict[str, tuple[str, str, str | None, str | None]] = {}
        for number, line in enumerate(text.splitlines(), 1):
            self._line(f"line {number}", line)
        self._flush_litert()
        self._flush("")

    def _line(self, place: str, line: str) -> None:
        graph = GRAPH.search(line)
        if graph:
            self._flush_litert()
            self._flush("")
            self._announced, self._lines = 0, []
            self._graph = PurePosixPath(graph[1].replace("\\", "/")).name or self._graph
        self._lines.append(line)
        if "Running benchmark for at least" in line:
            self._announced += 1
        if "Profiling Info for" in line:
            self._starting = OF_START in line
        if "===" in line:
            self._columns = []
            self._in_order = OPERATORS in line
        summary, pairs, litert = SUMMARY.search(line), dict(PAIR.findall(line)), LITERT.search(line)
        if summary:
            self._flush(place, summary[1])
        elif "count" in pairs and ("avg" in pairs or "curr" in pairs) and not line.strip().startswith("Memory (bytes)"):
            self._of_figures(place, line, pairs)
        elif litert:
            if litert[1] in self._litert:
                self._flush_litert()
            self._litert[litert[1]] = (place, litert[2], litert[3], litert[4])
        elif "\t" in line and not self._starting:
            self._operator(place, line)

    def _of_figures(self, place: str, line: str, pairs: dict[str, str]) -> None:
        self._flush_litert()
        if "Timings (microseconds)" in line:
            if self._starting:
                self.found.skip("time to start")
            else:
                self._take(place, pairs, f"{self._graph}, sum of operators")
            return
        if self._figures is not None and self._is_warm:
            self._flush(place)  # the figures of the log before, in a file of several logs
        elif self._figures is not None:  # two such lines in a row: the first one is the warm-up
            self.found.skip("warm-up")
            self._is_warm = True
        self._figures = (place, pairs)

    def _flush(self, place: str, summary: str = "") -> None:
        """Add the last line of figures. `summary`: text that repeats the mean, for a check; empty: there is no text."""
        figures, self._figures, self._is_warm = self._figures, None, False
        stated = re.search(r"Inference \(avg\): ([^\s,]+)", summary)
        average = number_in(stated[1]) if stated else None
        if figures is None:
            if summary:
                self._only_summary(place, average)
            return
        row, pairs = figures
        if not summary and self._announced == 1:
            self.found.refuse(f"{row}: {self._graph}", "a warm-up: the log ends before the runs do")
            return
        mean, name = number_in(pairs.get("avg", pairs.get("curr", ""))), f"{row}: {self._graph}"
        if stated:
            number = self.found.number(f"{place}: {self._graph}", average, "Inference (avg)")
            if number is None:
                return
            if isinstance(mean, float) and abs(number - mean) > ROUNDING * abs(mean) + 0.5:
                self.found.refuse(name, f"avg={mean:g}, but {place} says Inference (avg): {number:g}")
                return
        self._take(row, pairs, self._graph)

    def _take(self, place: str, pairs: Mapping[str, str], name: str) -> None:
        """Add the measurement in a line of figures in us. A line about a single run has a time in place of a mean."""
        times = {key: number_in(value) for key, value in pairs.items() if key != "count"}
        times.setdefault("avg", times.get("curr", ""))
        self._add(place, name, number_in(pairs["count"]), times, "us")

    def _only_summary(self, place: str, average: object) -> None:
        row = f"{place}: {self._graph}"
        time = self.found.ms(row, average, "us", "run", "Inference (avg)")
        if time is not None:
            what, hardware = "runs, the mean alone", _ran_by(self._lines)
            self.found.add(Measurement(self._graph, "run", "us", what, mean_ms=time, hardware=hardware))

    def _flush_litert(self) -> None:
        """Add the measurement in a block of lines of newer versions, with one figure and its unit in each line."""
        if "avg" not in self._litert:
            self._litert = {}
            return
        place, _, unit, count = self._litert["avg"]
        times = {
            key: _in_unit(number_in(value), of or unit or "us", unit or "us")
            for key, (_, value, of, _) in self._litert.items()
        }
        self._litert = {}
        if self._figures is not None:
            self._of_block(place, times["avg"], unit or "us")
            return
        self._add(place, self._graph, float(count) if count else None, times, unit or "us")

    def _of_block(self, place: str, average: object, unit: str) -> None:
        """Add the line of figures before a block of lines, which repeats these figures with two digits.

        If the block's mean `average`, in `unit`, contradicts the line, refuse the line.
        """
        assert self._figures is not None
        row, pairs = self._figures
        mean, factor = number_in(pairs.get("avg", "")), PER_MS["us"] / PER_MS[unit]
        if isinstance(mean, float) and isinstance(average, float) and abs(average * factor - mean) > 0.006 * factor:
            self._figures, self._is_warm = None, False
            said = f"avg={mean:g} us, but {place} says Inference (avg): {average:g} {unit}"
            self.found.refuse(f"{row}: {self._graph}", said)
            return
        self._flush("")

    def _add(self, place: str, name: str, count: object, times: Mapping[str, object], unit: str) -> None:
        """Add a measurement. Refuse it if a figure is no number, or if figures contradict each other.

        `count`: number of runs; None if the tool does not state it.
        `times`: figures in `unit`, by the tool's key, such as `avg`.
        """
        row = f"{place}: {name}"
        if count is not None and (not isinstance(count, float) or count < 1 or count != count // 1):
            self.found.refuse(row, f"count is {count}, not a whole number of runs")
            return
        ms: dict[str, float] = {}
        for key, value in times.items():
            time = self.found.ms(row, value, unit, "layer" if key == "std" else "run", key)
            if time is None:
                return
            ms[key] = time
        runs = int(count) if isinstance(count, float) else None
        mean, sd, low, p50, p95, high = (ms.get(key) for key in ("avg", "std", "min", "median", "p95", "max"))
        what, hardware = "runs after the warm-up, figures alone", _ran_by(self._lines)
        made = Measurement(name, "run", unit, what, (), runs, mean, sd, low, p50, p95, high, hardware=hardware)
        like_means = [replace(made, mean_ms=ms[key]) for key in ("first", "curr", "p5") if key in ms]
        if wrong := next(filter(None, map(contradiction, [made, *like_means])), ""):
            self.found.refuse(row, wrong)
            return
        self.found.add(made)

    def _operator(self, place: str, line: str) -> None:
        """Add a row of the table of operators in run order. The first row of the table names the columns."""
        cells = [cell.strip() for cell in line.strip("\r\n").split("\t")][1:]
        if any(cell.lower() == "[node type]" for cell in cells):
            self._columns = [cell.strip("[]").lower() for cell in cells]
        elif self._columns and self._in_order and len(cells) == len(self._columns):
            named = dict(zip(self._columns, cells, strict=True))
            name = f"{named['node type']} {named.get('name', '')}".strip()
            time = self.found.ms(f"{place}: {name}", number_in(named.get("avg ms", "")), "ms", "layer", "avg ms")
            if time is not None:
                calls = number_in(named.get("times called", ""))
                more = {"times_called": calls} if isinstance(calls, float) else {}
                self.found.add(
                    Measurement(name, "layer", "ms", "an operator, the mean of a call", mean_ms=time, more=more)
                )


def _ran_by(lines: Sequence[str]) -> str:
    """Return the delegate that ran the whole graph, from the lines of a log; "" if the log does not show it.

    XNNPACK runs, on the CPU, the operators that other delegates leave. Therefore it ran the whole graph only if the log
    names no other delegate.
    """
    named = [line for line in lines if "delegate" in line.lower() and "\t" not in line]  # tables have tabs
    applied = [said[1] for line in named if (said := APPLIED.search(line))]
    if applied:
        return applied[-1]
    return "XNNPACK" if named and all("xnnpack" in line.lower() for line in named) else ""


def _in_unit(value: object, of: str, unit: str) -> object:
    """Convert a number from the unit of time `of` to `unit`; return a value that is no number unchanged."""
    return value / PER_MS[of] * PER_MS[unit] if isinstance(value, float) and of != unit else value


def is_tensorrt(document: Sequence[Any]) -> bool:
    """Return whether a JSON list is one that `trtexec --exportProfile` writes."""
    tables = [each for each in document[:3] if isinstance(each, dict)]
    return any("averageMs" in each or "timeMs" in each for each in tables)


def read_tensorrt(document: Sequence[Any]) -> Measurements:
    """Return the mean time of each layer that TensorRT exports, and the sum of these times as a run."""
    found = Measurements(
        "TensorRT profile", "the mean of each layer; their sum is the run without what lies between them"
    )
    count, whole = None, 0.0
    for index, layer in enumerate(document):
        row = f"row {index}"
        if isinstance(layer, dict) and set(layer) == {"count"}:
            number = found.number(row, layer["count"], "count")
            count = int(number) if number and number == int(number) else None
            if count is None and number is not None:
                found.refuse(row, f"count is {number:g}, not a whole number of runs")
            continue
        if not isinstance(layer, dict):
            found.refuse(row, "no table")
            continue
        time = _of_tensorrt(found, f"{row}: {layer.get('name', '')}", layer, count)
        if time is not None:
            whole += time
    if whole and not found.refused_count:
        what = "the sum of the layers' means, worked out here"
        found.add(Measurement("all layers", "run", "ms", what, count=count, mean_ms=whole))
    return found


def _of_tensorrt(found: Measurements, row: str, layer: Mapping[str, Any], count: int | None) -> float | None:
    """Add one layer to `found`, and return its mean in ms; None if it is refused."""
    mean = found.ms(row, layer.get("averageMs"), "ms", "layer", "averageMs")
    if mean is None:
        return None
    total, median = layer.get("timeMs"), layer.get("medianMs")
    if total is not None:
        number = found.number(row, total, "timeMs")
        if number is None:
            return None
        if count and abs(number / count - mean) > 1e-3 * mean + 1e-5:
            found.refuse(row, f"averageMs is {mean:g}, but timeMs / count is {number / count:g}")
            return None
    p50 = None if median is None else found.ms(row, median, "ms", "layer", "medianMs")
    share = layer.get("percentage")
    share = share / 100 if isinstance(share, int | float) and 0 <= share <= 100 else None
    name = str(layer.get("name", ""))
    found.add(Measurement(name, "layer", "ms", "a layer, the mean", (), count, mean, p50_ms=p50, share=share))
    return mean


def read_layer_means(document: Sequence[Any]) -> Measurements:
    """Return the measurements in a list of layers with `average_time_ms`, as scripts make from TensorRT's profiles."""
    found = Measurements("table of layers' means", "the mean of each layer")
    for index, layer in enumerate(document):
        facts = layer if isinstance(layer, dict) else {}
        name = str(facts.get("name", index))
        time = found.ms(f"row {index}: {name}", facts.get("average_time_ms"), "ms", "layer", "average_time_ms")
        if time is not None:
            found.add(Measurement(name, "layer", "ms", "a layer, the mean", mean_ms=time))
    return found


CUT: Final = re.compile(r"^(.*)_at_(-?\d{1,18})$")


def read_cut_means(document: Mapping[str, Any]) -> Measurements:
    """Return the measurements in a table of mean times of networks that are cut after layer N (`NAME_at_N`).

    The part of a network behind a later cut (`total_time`) cannot take longer than the part behind an earlier cut. A
    time that contradicts this is refused.
    """
    found = Measurements("table of times by cut", "the mean for each place at which a network is cut")
    made: dict[str, Measurement] = {}
    rests: dict[str, list[tuple[int, float, str]]] = defaultdict(list)
    for name, facts in document.items():
        key = next((key for key in ("total_time", "mean_time") if key in facts), "")
        cut = CUT.match(name)
        if key == "total_time" and facts[key] == 0:
            found.refuse(name, "the time is 0: a run takes time")
            continue
        time = found.ms(name, facts.get(key), "ms", "run", key or "the time")
        if time is None:
            continue
        what = "a run with this cut" if key == "mean_time" else "the rest behind the cut"
        made[name] = Measurement(name, "run", "ms", what, mean_ms=time)
        if cut and key == "total_time":
            rests[cut[1]].append((int(cut[2]), time, name))
    for points in rests.values():
        for name, reason in rising_rests(points):
            del made[name]
            found.refuse(name, reason)
    for each in made.values():
        found.add(each)
    return found


def rising_rests(points: Sequence[tuple[int, float, str]]) -> Iterator[tuple[str, str]]:
    """Yield (name to remove, reason) for each time that must be removed so that times never rise from cut to cut.

    A longest subsequence of times that never rises stays, see `falling`.

    `points`: (number of the layer of the cut, time in ms of the part of the network behind the cut, name).
    """
    ordered = sorted(points)
    kept = falling([time for _, time, _ in ordered])
    for index, (_, time, name) in enumerate(ordered):
        at = bisect_left(kept, index)
        if kept[at : at + 1] == [index]:
            continue
        is_below = at < len(kept) and time < ordered[kept[at]][1]
        lower, upper = (index, kept[at]) if is_below else (kept[at - 1], index)
        (cut, before, _), (later, after, _) = ordered[lower], ordered[upper]
        yield name, f"rest times rise again: {before:g} ms behind cut {cut}, {after:g} ms behind the later cut {later}"


def read_executorch(document: Mapping[str, Any]) -> Measurements:
    """Return the measurements of react-native-executorch: calls of a network, and wall times of the app around them."""
    says = "runs of each network as its runtime sees them, and wall times of the app around them"
    found = Measurements("react-native-executorch benchmarks", says)
    for index, case in enumerate(document["cases"]):
        row = f"cases[{index}]"
        if not isinstance(case, dict):
            found.refuse(row, "no table")
            continue
        name = str(case.get("id", index))
        if case.get("status") != "ok":
            found.skip("a case that failed")
            continue
        _add_stats(found, f"{row}.pipeline: {name}", f"{name}/pipeline", "wall", case.get("pipeline"))
        native = case.get("native")
        methods = native.get("methods") if isinstance(native, dict) else None
        for method in methods if isinstance(methods, list) else []:
            if isinstance(method, dict) and method.get("status") == "ok":
                label = str(method.get("method", ""))
                _add_stats(found, f"{row}.native.{label}: {name}", f"{name}/{label}", "run", method.get("stats"))
    return found


def _add_stats(found: Measurements, row: str, name: str, kind: Kind, stats: object) -> None:
    if not isinstance(stats, dict):
        found.skip("a case without figures")
        return
    ms: dict[str, float | None] = {}
    for key in ("mean", "stdev", "min", "median", "max", "p90"):
        if key in stats:
            ms[key] = found.ms(row, stats[key], "ms", "layer" if key == "stdev" else kind, key)
            if ms[key] is None:
                return
    count = stats.get("count")
    what = "calls of the network in its runtime" if kind == "run" else "wall time, with all around the network"
    made = Measurement(
        name, kind, "ms", what, (), count, ms.get("mean"), ms.get("stdev"), ms.get("min"), ms.get("median"), None,
        ms.get("max"), service=kind == "run", more={"p90_ms": p90} if (p90 := ms.get("p90")) is not None else {},
    )  # fmt: skip
    wrong = contradiction(made)
    if wrong or made.mean_ms is None:
        found.refuse(row, wrong or "no mean")
        return
    if count is not None and (not isinstance(count, int) or isinstance(count, bool) or count < 1):
        found.refuse(row, f"count is {count!r}, not a whole number of runs")
        return
    found.add(made)
