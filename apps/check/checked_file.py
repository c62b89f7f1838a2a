"""The document of `trilane check` about a pipeline file: stages, streams, least period, memory. Also its drawing.

Rule: nothing runs here, and no Python of the file is imported.

The drawing has a lane for each unit, a box for each stage and a line for each input. A dashed line is an input that
takes the newest frame. A dotted line is the bypass. The stages that determine the period have a thick border.
"""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any, Final

from trilane.apps.check.port_types import PortTypes, port_types, read_networks
from trilane.errors import BadInputError
from trilane.hw_profiles.pipeline_prediction import StagePrice, bound_of, given_price
from trilane.pipeline.file_graph import edge_rules, graph_of
from trilane.pipeline.file_keys import PythonStage, StageKeys
from trilane.pipeline.pipeline_file import PipelineFile, read_pipeline
from trilane.transport.slots import edge_rule
from trilane.units import NS_PER_MS

#: Largest total size of one stream's slots. A run keeps them in shared memory.
MOST_STREAM_BYTES: Final = 2 << 30


def check_file(path: Path) -> dict[str, Any]:
    """Check a pipeline file, its networks and its ports, and return what `trilane check --json` prints.

    Raises BadInputError.
    """
    return document_of(read_pipeline(path))


def document_of(file: PipelineFile) -> dict[str, Any]:
    """Return the result of `check_file` for a file that is already read. Raises BadInputError."""
    types = port_types(file, read_networks(file))
    prices = {name: price for name in file.stages if (price := given_price(file, name)) is not None}
    known = prices if len(prices) == len(file.stages) else None
    rules = edge_rules(file)
    period: dict[str, Any] = {"period_ms": None, "cycle": [], "limit": ""}
    if known is not None:
        _, bound = bound_of(file, known)
        period = {
            "period_ms": float(bound.period_ns) / NS_PER_MS,
            "cycle": list(bound.stages),
            "limit": bound.limit,
        }
    streams = [_stream(file, name, rule, types) for name, rule in rules.items()]
    memory = [each["memory_bytes"] for each in streams]
    return {
        "schema": 1,
        "file": str(file.path),
        "run": file.run.model_dump(mode="json", exclude_defaults=True) | {"policy": file.run.policy},
        "latency_to": file.latency_to,
        "units": {name: {"hardware": file.hardware(name)} for name in file.units},
        "stages": [_stage(file, name, prices.get(name)) for name in file.stages],
        "streams": streams,
        "routes": _routes(file, rules),
        **period,
        "memory_bytes": sum(each for each in memory if each is not None),
        "memory_unknown": [each["from"] for each in streams if each["memory_bytes"] is None],
        "imports": sorted({each.python for each in file.stages.values() if isinstance(each, PythonStage)}),
    }


def _stage(file: PipelineFile, name: str, price: StagePrice | None) -> dict[str, Any]:
    stage = file.stages[name]
    return {
        "name": name,
        "unit": stage.unit,
        "kind": stage.kind,
        "what": _what(stage),
        "in": [_input(each) for each in stage.inputs],
        "every": stage.every,
        "time_ms": None if price is None else price.time.mean_ms,
        "time_from": "" if price is None else price.source,
    }


def _routes(file: PipelineFile, rules: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the bypass, if any: its ends, the stages between them, and the share of frames that take the bypass.

    `rules`: rule of each edge, by the stage that writes to it.
    """
    if file.bypass is None:
        return []
    begin, way = file.bypass
    share = None if way.taken is None else float(way.taken)
    return [{"from": begin, "to": way.to, "past": list(graph_of(file, rules).bypassed), "share": share}]


def _what(stage: StageKeys) -> str:
    """Return the stage's network file, Python factory or block; "" for a stage that has only a time."""
    return str(getattr(stage, stage.kind)) if stage.kind != "time_ms" else ""


def _input(each: Any) -> dict[str, Any]:
    source = f"{each.stage}.{each.from_port}" if each.from_port else each.stage
    sync = {"sync": "latest", "max_age_ms": each.max_age_ms or None} if each.latest else {"sync": "frame"}
    return {"port": each.port, "from": source, **sync}


def _stream(file: PipelineFile, name: str, rule: str, types: PortTypes) -> dict[str, Any]:
    ports: Mapping[str, Any] = types.get(name, {})
    slots = edge_rule(rule).slots
    slot_bytes = sum(port.payload_bytes for port in ports.values()) if ports else None
    if slot_bytes is not None and slots * slot_bytes > MOST_STREAM_BYTES:
        found = f"{slots} slots of {slot_bytes >> 20} MiB behind {name}"
        expected = f"at most {MOST_STREAM_BYTES >> 30} GiB for a stream"
        raise BadInputError(f"{file.path}: edges.{name}", found, expected, "fewer slots or a smaller port")
    return {
        "from": name,
        "to": file.readers[name],
        "slots": slots,
        "rule": rule,
        "ports": {port: str(kind) for port, kind in ports.items()},
        "memory_bytes": None if slot_bytes is None else slots * slot_bytes,
    }


COLUMN, LANE, BOX, HEIGHT, LEFT, TOP = 170, 84, 130, 44, 90, 20
OVER: Final = 10  # pixels between a row of boxes and a line that passes above them
LETTERS: Final = 17  # of a stage's name, at most, in its box
DASHES: Final = {"frame": "", "latest": " stroke-dasharray='5 4'"}
DOTS: Final = " stroke-dasharray='1 4'"
STYLE: Final = "font-family='sans-serif' font-size='12'"


def draw_graph(document: Mapping[str, Any]) -> str:
    """Return the drawing of a pipeline as an SVG. `document`: result of `check_file`."""
    columns = _columns(document)
    rows = _rows(document, columns)
    tops, height = _lanes(document, rows)
    places = {name: (LEFT + COLUMN * columns[name], tops[unit] + LANE * row + 16) for name, (unit, row) in rows.items()}
    width, names = LEFT + COLUMN * (1 + max(columns.values())), [*tops]
    ends = [*[tops[unit] for unit in names[1:]], height]
    body = [
        f"<rect x='0' y='{tops[unit]}' width='{width}' height='{end - tops[unit] - 6}' fill='#f3f4f6'/>"
        f"<text x='10' y='{tops[unit] + 20}' {STYLE} font-weight='bold'>{escape(unit)}</text>"
        for unit, end in zip(names, ends, strict=True)
    ]
    body += [
        _line(places[each["from"].partition(".")[0]], places[stage["name"]], DASHES[each["sync"]])
        for stage in document["stages"]
        for each in stage["in"]
    ]
    body += [_line(places[each["from"]], places[each["to"]], DOTS) for each in document["routes"]]
    body += [_box(stage, *places[stage["name"]], stage["name"] in document["cycle"]) for stage in document["stages"]]
    head = f"<svg xmlns='http://www.w3.org/2000/svg' width='{width}' height='{height}' viewBox='0 0 {width} {height}'>"
    return "\n".join([head, "<rect width='100%' height='100%' fill='white'/>", *body, "</svg>", ""])


def _columns(document: Mapping[str, Any]) -> dict[str, int]:
    """Return the column of each stage: to the right of every stage that it reads."""
    found: dict[str, int] = {}
    for stage in document["stages"]:
        before = [found[each["from"].partition(".")[0]] for each in stage["in"]]
        found[stage["name"]] = max(before, default=-1) + 1
    return found


def _rows(document: Mapping[str, Any], columns: Mapping[str, int]) -> dict[str, tuple[str, int]]:
    """Return each stage's unit, and its row in the unit's lane. Stages in one lane and column get different rows."""
    used: dict[tuple[str, int], int] = {}
    found = {}
    for stage in document["stages"]:
        key = stage["unit"], columns[stage["name"]]
        found[stage["name"]] = stage["unit"], used.get(key, 0)
        used[key] = used.get(key, 0) + 1
    return found


def _lanes(document: Mapping[str, Any], rows: Mapping[str, tuple[str, int]]) -> tuple[dict[str, int], int]:
    """Return the y coordinate of the top of each unit's lane, and the height of the drawing, both in pixels."""
    tops, top = {}, TOP
    for unit in document["units"]:
        tops[unit] = top
        top += LANE * (1 + max(row for other, row in rows.values() if other == unit))
    return tops, top


def _box(stage: Mapping[str, Any], x: int, y: int, is_bound: bool) -> str:
    time = "" if stage["time_ms"] is None else f"{stage['time_ms']:g} ms"
    every = f" every {stage['every']}" if stage["every"] > 1 else ""
    name = stage["name"] if len(stage["name"]) <= LETTERS else stage["name"][: LETTERS - 1] + "…"
    border = "stroke='#b91c1c' stroke-width='3'" if is_bound else "stroke='#374151'"
    return (
        f"<g><title>{escape(stage['name'])}: {escape(stage['what'] or stage['kind'])}</title>"
        f"<rect x='{x}' y='{y}' width='{BOX}' height='{HEIGHT}' rx='5' fill='white' {border}/>"
        f"<text x='{x + 8}' y='{y + 18}' {STYLE}>{escape(name)}</text>"
        f"<text x='{x + 8}' y='{y + 35}' {STYLE} fill='#6b7280'>{escape((time or stage['kind']) + every)}</text></g>"
    )


def _line(start: tuple[int, int], end: tuple[int, int], dashes: str) -> str:
    x, y, to_x, to_y = start[0] + BOX, start[1] + HEIGHT // 2, end[0], end[1] + HEIGHT // 2
    bend = (x + to_x) // 2
    path = f"M {x} {y} C {bend} {y} {bend} {to_y} {to_x} {to_y}"
    if y == to_y and to_x - x > COLUMN:  # the line passes above the boxes between its ends
        over = y - HEIGHT // 2 - OVER
        path = f"M {x} {y} C {x + OVER} {over} {x} {over} {x + 2 * OVER} {over} H {to_x - 2 * OVER}"
        path += f" C {to_x} {over} {to_x - OVER} {over} {to_x} {to_y}"
    return f"<path d='{path}' fill='none' stroke='#6b7280'{dashes}/><circle cx='{to_x}' cy='{to_y}' r='3'/>"
