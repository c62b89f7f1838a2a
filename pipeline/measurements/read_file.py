"""Reads the measurements of other tools: finds the format of a file by its content, and calls the reader of the format.

    read = read_measurements(Path("profile.csv"))
    read.tool, read.measurements, read.refused
    chosen(read, "RPC (execute) time", "street.toml: stages.seg.time_ms")

The file may come from a stranger: sizes are checked before memory is allocated, and a defect becomes one BadInputError.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from trilane.errors import BadInputError, did_you_mean
from trilane.files import HEAD_BYTES, read_bytes, read_text, require_file, whole_number
from trilane.pipeline.measurements import runtime_files, trace_slices, vendor_files
from trilane.pipeline.measurements.measurement import CYCLES, PER_MS, QUEUEING, Measurement, Measurements, number_in

MOST_TEXT_BYTES: Final = 64 << 20
MOST_TRACE_BYTES: Final = 256 << 20
KNOWN: Final = (
    "a QNN profile, QHAS, ONNX Runtime profile, benchmark_model log, LoadGen summary, MLPerf app result, TensorRT "
    "profile, AI Hub profile, ExecuTorch benchmark or Perfetto trace"
)
#: Columns of the CSV that `trilane times --csv` writes.
OWN_COLUMNS: Final = ("name", "kind", "unit", "sample", "ms")


def read_measurements(path: Path) -> Measurements:
    """Return the measurements in the file `path`.

    Raises BadInputError for a file of no known tool, and for a file without a usable measurement.
    """
    found = _found(path)
    found.path = path
    if not found.measurements:
        first = f": {found.refused[0].row}: {found.refused[0].reason}" if found.refused else ""
        raise BadInputError(path, f"no usable time in the {found.tool}{first}", "times of runs or layers")
    return found


def _found(path: Path) -> Measurements:
    size = require_file(path, KNOWN)
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
        if trace_slices.is_perfetto(head):
            return trace_slices.read_perfetto(read_bytes(path, MOST_TRACE_BYTES, KNOWN))
        if size > MOST_TEXT_BYTES:
            raise BadInputError(path, f"{size} bytes", f"at most {MOST_TEXT_BYTES}", "measure for a shorter time")
        return _of_text(path, read_text(path, KNOWN))
    except OSError as error:
        raise BadInputError.of_os_error(path, error, KNOWN) from None
    except BadInputError as error:
        if str(path) in error.where:
            raise
        # the reader of a format does not know the path
        raise BadInputError(path, f"{error.found} in {error.where}", error.expected, error.remedy) from None


def _of_text(path: Path, text: str) -> Measurements:
    lines = text.lstrip().splitlines()[:20]
    if text.lstrip()[:1] in ("{", "[") and (document := _of_json(path, text)) is not None:
        return document
    if vendor_files.is_qnn(lines):
        return vendor_files.read_qnn(text)
    if vendor_files.TITLE in text:
        return vendor_files.read_loadgen(text)
    if runtime_files.is_benchmark(text):
        return runtime_files.BenchmarkLog(text).found
    if lines and tuple(lines[0].split(",")) == OWN_COLUMNS:
        return _read_own(text)
    if trace_slices.PERFETTO_TEXT.match(text):
        remedy = f"convert it with Perfetto's tool: traceconv binary {path.name} trace.pftrace"
        raise BadInputError(path, "a Perfetto trace as text", "the trace itself, or JSON", remedy)
    if trace_slices.FTRACE_TEXT.search(text[:HEAD_BYTES]):
        remedy = f"convert it with Perfetto's tool: traceconv json {path.name} trace.json"
        raise BadInputError(path, "a trace as text (ftrace or systrace)", "JSON, or a trace of Perfetto", remedy)
    raise BadInputError(path, f"text that begins with {(lines or [''])[0][:60]!r}", KNOWN)


def _of_json(path: Path, text: str) -> Measurements | None:
    """Return the measurements of a JSON document; None if `text` is a log of benchmark_model that begins like JSON.

    Raises BadInputError for any other text that is not JSON, and for JSON of no known tool.
    """
    try:
        document = json.loads(text, parse_int=whole_number)
    except RecursionError:
        raise BadInputError(path, "lists or tables in each other, too deep", KNOWN) from None
    except ValueError as error:
        events, broken = _events_by_line(text)
        if events:
            cut = _of_events(events)
            for place in broken:
                cut.refuse(place, "no event in JSON: the line is cut off or damaged")
            return cut
        if runtime_files.is_benchmark(text):
            return None
        raise BadInputError(path, f"no JSON ({error})", KNOWN) from None
    found = _of_table(document) if isinstance(document, dict) else _of_list(document)
    if found is None:
        keys = f"the keys {', '.join(map(repr, list(document)[:4]))}" if isinstance(document, dict) else "a list"
        raise BadInputError(path, f"JSON with {keys}, of no known tool", KNOWN)
    return found


def _of_table(document: Mapping[str, Any]) -> Measurements | None:
    data = document.get("data")
    data = data if isinstance(data, dict) else document
    tables = document and all(isinstance(each, dict) for each in document.values())
    if "execution_summary" in document or "execution_detail" in document:
        return vendor_files.read_ai_hub(document)
    if "htp_overall_summary" in data:
        return vendor_files.read_qhas(data)
    if vendor_files.is_mlperf_app(document):
        return vendor_files.read_mlperf_app(document)
    if isinstance(document.get("cases"), list):
        return runtime_files.read_executorch(document)
    if isinstance(document.get("traceEvents"), list):
        return _of_events(document["traceEvents"])
    if tables and all(runtime_files.CUT.match(name) for name in document):
        return runtime_files.read_cut_means(document)
    return None


def _of_list(document: object) -> Measurements | None:
    if not isinstance(document, list):
        return None
    if runtime_files.is_tensorrt(document):
        return runtime_files.read_tensorrt(document)
    if vendor_files.is_mlperf_app(document):
        return vendor_files.read_mlperf_app(document)
    tables = [each for each in document[:20] if isinstance(each, dict)]
    if any("average_time_ms" in each for each in tables):
        return runtime_files.read_layer_means(document)
    if any("ph" in each for each in tables):
        return _of_events(document)
    return None


def _of_events(events: Sequence[Any]) -> Measurements:
    """Return the measurements in trace events of ONNX Runtime (categories Session and Node) or of another tool."""
    categories = {
        each.get("cat") for each in events[:1000] if isinstance(each, dict) and isinstance(each.get("cat"), str)
    }
    if categories & {"Session", "Node"}:
        return runtime_files.read_ort(events)
    return trace_slices.read_chrome(events)


def _events_by_line(text: str) -> tuple[list[Any], list[str]]:
    """Return (events, places of the lines that are no event) from a cut-off JSON list with one event on each line."""
    events, broken = [], []
    for number, line in enumerate(text.splitlines(), 1):
        bare = line.strip().removeprefix('{"traceEvents":').removeprefix("[").removesuffix("]").rstrip(", ")
        if bare in ("", "]}", "{", "}"):
            continue
        try:
            event = json.loads(bare, parse_int=whole_number)
        except (ValueError, RecursionError):
            event = None
        if isinstance(event, dict) and "ph" in event:
            events.append(event)
        else:
            broken.append(f"line {number}")
    return events, broken


def _read_own(text: str) -> Measurements:
    """Return the measurements in the text of a CSV that `trilane times --csv` wrote."""
    found = Measurements("CSV of trilane times", "samples, as another tool measured them")
    lines = text.splitlines()
    reader, last = csv.DictReader(lines), len(lines)
    try:
        for row in reader:
            place, unit, kind = f"line {reader.line_num}: {row['name']}", str(row["unit"]), row["kind"]
            if None in row:
                found.refuse(place, f"more cells than the {len(OWN_COLUMNS)} of the header: a comma in a number?")
                continue
            if reader.line_num == last and not text.endswith("\n"):
                found.refuse(place, "the file ends within the row")
                continue
            if unit not in PER_MS or kind not in ("run", "layer", "wall"):
                found.refuse(place, f"the unit {unit!r} or the kind {kind!r} is unknown")
                continue
            value = row["ms"] and number_in(row["ms"])
            found.sample(place, str(row["name"]), kind, value, "ms")  # type: ignore[arg-type]
    except csv.Error as error:
        found.refuse(f"line {reader.line_num}", f"no CSV: {error}")
    return found


def chosen(read: Measurements, name: str, where: str) -> Measurement:
    """Return the measurement that gives the time of a stage.

    `name`: name of the measurement; empty: the file must have exactly one run, which is returned.
    `where`: place that errors name.

    Raises BadInputError for an unknown name, and for a measurement that cannot be a service time. Without a name, it
    is also raised if the file does not have exactly one run.
    """
    if name:
        found = [each for each in read.measurements if each.name == name]
        if not found:
            known = [each.name for each in read.measurements]
            shown = ", ".join(map(repr, known[:8])) + (" …" if len(known) > 8 else "")
            raise BadInputError(where, f"no measurement {name!r} in {read.path.name}", shown, did_you_mean(name, known))
        found.sort(key=lambda each: ("run", "layer", "wall").index(each.kind))
    else:
        found = [each for each in read.measurements if each.kind == "run" and each.service]
        if len(found) != 1:
            raise _not_one(read, found, where)
    one = found[0]
    if one.unit == CYCLES or one.mean_ms is None:
        raise BadInputError(
            where, f"{one.name!r}, of which {read.path.name} has only cycles", "a time", "cycles are shares"
        )
    if not one.service:
        raise BadInputError(where, f"{one.name!r}, {one.what}", "a time of a job", QUEUEING)
    return one


def _not_one(read: Measurements, runs: Sequence[Measurement], where: str) -> BadInputError:
    """Return the error for a file without exactly one of `runs`; it lists the measurements that a name can choose."""
    usable = runs or [each for each in read.measurements if each.service and each.unit != CYCLES]
    listed = [f"{each.name!r}" if runs else f"{each.name!r} ({each.what})" for each in usable or read.measurements]
    shown = ", ".join(listed[:8]) + (" …" if len(listed) > 8 else "")
    remedy = "give one with --name" if where == "--name" else 'add name = "..." of one of them'
    if not usable:
        remedy = "measure one job at a time, such as LoadGen's SingleStream"
    count = f"{len(runs)} runs" if runs else "no run"
    return BadInputError(where, f"{count} in {read.path.name}{':' if runs else ', only'} {shown}", "one", remedy)
