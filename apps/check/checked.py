"""Checks a pipeline file or a scene: the document of `trilane check`, and the drawing of the graph.

The document states stages, streams, least period and memory. A scene is checked as the pipeline of its run, written as
a pipeline file. If a chip is given, the stages get times as in `trilane predict SCENE`.

Rule: nothing runs here, and no Python of the file is imported. The modules of scenes and avatars take longer to import
than all other modules. Therefore only the check of a scene imports them.

The drawing has a lane for each unit, a box for each stage and a line for each input. A dashed line is an input that
takes the newest frame. A dotted line is the bypass. The stages that determine the period have a thick border.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any, Final, NamedTuple

from trilane.apps.check.port_types import PortTypes, port_types, read_networks
from trilane.errors import BadInputError
from trilane.files import read_bytes
from trilane.hw_profiles.pipeline_prediction import StagePrice, bound_of, given_price
from trilane.hw_profiles.profile_files import load_runnable
from trilane.hw_profiles.schema import corners_of
from trilane.hw_profiles.shared_chip import alone_ms
from trilane.hw_profiles.tenants import SKIPS
from trilane.pipeline.description import file_text, tables_of, unsaid
from trilane.pipeline.file_graph import edge_rules, graph_of
from trilane.pipeline.file_keys import PythonStage, StageKeys
from trilane.pipeline.pipeline_file import (
    FORM,
    IF_EMPTY,
    MOST_BYTES,
    TABLES,
    PipelineFile,
    checked_tables,
    read_pipeline,
)
from trilane.scheduler.policy import POLICIES
from trilane.transport.slots import edge_rule
from trilane.units import HOST, NS_PER_MS, SUSTAINED

#: Largest total size of one stream's slots. A run keeps them in shared memory.
MOST_STREAM_BYTES: Final = 2 << 30
DIGITS: Final = 6  # behind the point of a time in ms, because the scheduler counts nanoseconds


def check_file(path: Path) -> dict[str, Any]:
    """Check a pipeline file, its networks and its ports, and return what `trilane check --json` prints.

    Raises BadInputError for the first fault in these files.
    """
    return _document_of(read_pipeline(path))


def _document_of(file: PipelineFile) -> dict[str, Any]:
    """Return the result of `check_file` for the pipeline file `file`, which was read before.

    Raises BadInputError for the first fault in its networks and ports.
    """
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
    """Return a list with the bypass as a mapping; an empty list if the file has no bypass.

    The keys are `from` and `to`: stages where the bypass begins and ends; `past`: names of the stages between the two;
    `share`: share of the frames that take the bypass, None if the file does not state it.

    `file`: pipeline file. `rules`: rule of each edge, by the stage that writes to the edge.
    """
    if file.bypass is None:
        return []
    begin, way = file.bypass
    share = None if way.taken is None else float(way.taken)
    return [{"from": begin, "to": way.to, "past": list(graph_of(file, rules).bypassed), "share": share}]


def _what(stage: StageKeys) -> str:
    """Return the stage's network file, Python factory or block; "" for a stage with a set time and nothing to run."""
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


class CheckedScene(NamedTuple):
    """The check of a scene.

    `document`: result of `check_file` for the scene's pipeline, with the further key `notes`: list of sentences.
    `text`: pipeline file that describes this pipeline.
    """

    document: dict[str, Any]
    text: str


def is_scene(text: str) -> bool:
    """Return whether `text` is the name of a bundled scene, or a TOML file without any table of a pipeline file."""
    from trilane.scene.schema import scene_names

    path = Path(text)
    if text in scene_names():
        return True
    if path.suffix != ".toml" or not path.is_file():
        return False
    try:
        tables = tomllib.loads(read_bytes(path, MOST_BYTES, FORM, IF_EMPTY).decode())
    except (ValueError, RecursionError):
        return False
    return bool(tables) and not {*tables} & {*TABLES}


def check_scene(text: str, profile: str | None = None) -> CheckedScene:
    """Check a scene, and return the document of the check with the scene's pipeline.

    `text`: name of a bundled scene, or a file.
    `profile`: chip for which the times of the stages are computed; None for stages without times.

    Raises BadInputError for a faulty scene or chip, and MissingPartError if a part that a run needs is not installed.
    """
    from trilane.stages.avatar_pipeline import avatar_pipeline
    from trilane.stages.configure import configure
    from trilane.stages.run_options import RunOptions

    options = RunOptions(scene=text, skinning="gpu")
    checked = configure(options, Path.cwd())
    pipeline, scene = avatar_pipeline(checked.config, checked.assets, options.edge), checked.config.scene
    run: dict[str, Any] = {"policy": options.policy, "frames": scene.frames}
    if POLICIES[options.policy].paced:
        run["fps"] = scene.fps
    times: Mapping[str, float] = {}
    taken: Mapping[str, Any] = {}
    if profile is not None:
        times, taken = _priced(text, profile)
    tables = tables_of(pipeline, run, times, taken)
    document = _document_of(checked_tables(tables, Path(f"{scene.name}.toml")))
    notes = [*unsaid(pipeline), *_said(profile, document["routes"][0]["share"])]
    period = document["period_ms"]
    head = [f"the pipeline of the scene {scene.name}, as `trilane run {text}` runs it"]
    if period is not None:
        head.append(f"period {period:.6g} ms or more, by {document['limit']}: {' -> '.join(document['cycle'])}")
    answer = {**document, "file": text, "imports": [], "notes": notes}
    return CheckedScene(answer, file_text(tables, [*head, *notes]))


def _priced(text: str, profile: str) -> tuple[Mapping[str, float], Mapping[str, Any]]:
    """Return what a chip adds to the pipeline file of a scene: the stages' times, and a key of the bypass.

    The times map each stage to the mean time of its jobs in ms, over the frames that need the network. The key of the
    bypass is `pattern`: a text with `1` for each frame that takes the bypass, and `0` for each other frame. If no frame
    takes the bypass, the key is `share` with the value 0.

    `text`: name or file of the scene. `profile`: chip. Raises BadInputError for an unknown chip, and for this machine.
    """
    from trilane.apps.predict.asked_pipelines import asked, avatar

    chip = load_runnable(profile)
    if chip.name == HOST:
        remedy = f"`trilane predict {text} --profile {HOST}` measures this machine"
        raise BadInputError("--profile", HOST, "a chip, as nothing runs for a check", remedy)
    tenant = avatar(asked(text), text)
    means = alone_ms(chip, tenant, corners_of(chip, SUSTAINED))
    rounded = {stage: round(round(ms * NS_PER_MS) / NS_PER_MS, DIGITS) for stage, ms in means.items()}
    pattern = "".join(str(int(place == SKIPS)) for place in tenant.frames)
    return rounded, {"pattern": pattern} if "1" in pattern else {"share": 0}


def _said(profile: str | None, share: float | None) -> list[str]:
    """Return notes on the source of the stages' times, and on the frames that take the bypass.

    `profile`: chip of the times; None for stages without times. `share`: share of the frames that take the bypass; None
    if unknown.
    """
    if profile is None or share is None:
        return ["without times: --profile CHIP adds the times of a chip"]
    said = f"times are means of {profile}, {SUSTAINED}, for frames that the network paints"
    return [said, f"{share:.1%} of the scene's frames need no new picture and take the route"]


COLUMN, LANE, BOX, HEIGHT, LEFT, TOP = 170, 84, 130, 44, 90, 20
OVER: Final = 10  # pixels between a row of boxes and a line that passes above them
LETTERS: Final = 17  # of a stage's name, at most, in its box
DASHES: Final = {"frame": "", "latest": " stroke-dasharray='5 4'"}
DOTS: Final = " stroke-dasharray='1 4'"
STYLE: Final = "font-family='sans-serif' font-size='12'"


def draw_graph(document: Mapping[str, Any]) -> str:
    """Return the drawing of a pipeline as the text of an SVG file. `document`: result of `check_file`."""
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
    """Return the number of each stage's column, by the stage's name. Column 0 is on the left.

    A stage stands to the right of every stage that it reads.
    """
    found: dict[str, int] = {}
    for stage in document["stages"]:
        before = [found[each["from"].partition(".")[0]] for each in stage["in"]]
        found[stage["name"]] = max(before, default=-1) + 1
    return found


def _rows(document: Mapping[str, Any], columns: Mapping[str, int]) -> dict[str, tuple[str, int]]:
    """Return a pair for each stage, by its name: its unit, and its row in the lane of the unit, from 0 at the top.

    Stages in one lane and column get different rows. `document`: result of `check_file`. `columns`: result of
    `_columns`.
    """
    used: dict[tuple[str, int], int] = {}
    found = {}
    for stage in document["stages"]:
        key = stage["unit"], columns[stage["name"]]
        found[stage["name"]] = stage["unit"], used.get(key, 0)
        used[key] = used.get(key, 0) + 1
    return found


def _lanes(document: Mapping[str, Any], rows: Mapping[str, tuple[str, int]]) -> tuple[dict[str, int], int]:
    """Return the y coordinate of the top of each unit's lane, by unit, and the height of the drawing, in pixels.

    `document`: result of `check_file`. `rows`: result of `_rows`.
    """
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
