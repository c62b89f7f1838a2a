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
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any, Final

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
from trilane.pipeline.file_keys import PortInput, PortType, PythonStage, StageKeys
from trilane.pipeline.pipeline_file import (
    FORM,
    IF_EMPTY,
    MOST_BYTES,
    TABLES,
    PipelineFile,
    checked_tables,
)
from trilane.scheduler.period_bound import PeriodBound
from trilane.scheduler.policy import POLICIES
from trilane.transport.slots import edge_rule
from trilane.units import HOST, NS_PER_MS, SUSTAINED

#: Largest total size of one stream's slots. A run keeps them in shared memory.
MOST_STREAM_BYTES: Final = 2 << 30
DIGITS: Final = 6  # behind the point of a time in ms, because the scheduler counts nanoseconds


@dataclass(frozen=True)
class CheckedFile:
    """A pipeline file without a fault, or the pipeline of a scene.

    `name`: file or scene, as it was named. `types`: types of the ports.
    `prices`: time of each stage, by name; a stage without a known time is absent.
    `bound`: lower bound on the period; None if the time of a stage is not known.
    `rules`, `memory`: rule and bytes of each stream's slots, by the stage that writes the stream. The bytes are None if
    a type is not known.
    `past`: stages that a frame on the bypass skips. `imports`: factories in Python that a run imports.
    `notes`: sentences about a scene; None for a pipeline file.
    """

    name: str
    file: PipelineFile
    types: PortTypes
    prices: Mapping[str, StagePrice]
    bound: PeriodBound | None
    rules: Mapping[str, str]
    memory: Mapping[str, int | None]
    past: Sequence[str]
    imports: Sequence[str]
    notes: Sequence[str] | None = None

    def time_ms(self, stage: str) -> float | None:
        """Return the mean time of a job of `stage`, by its name; None if it is not known."""
        return self.prices[stage].time.mean_ms if stage in self.prices else None

    @property
    def period_ms(self) -> float | None:
        return None if self.bound is None else float(self.bound.period_ns) / NS_PER_MS

    def as_json(self) -> dict[str, Any]:
        """Return what `trilane check --json` prints."""
        file, run = self.file, self.file.run
        routes = []
        if file.bypass is not None:
            begin, way = file.bypass
            share = None if way.taken is None else float(way.taken)
            routes = [{"from": begin, "to": way.to, "past": list(self.past), "share": share}]
        return {
            "schema": 1,
            "file": self.name,
            "run": run.model_dump(mode="json", exclude_defaults=True) | {"policy": run.policy},
            "latency_to": file.latency_to,
            "units": {name: {"hardware": file.hardware(name)} for name in file.units},
            "stages": [
                {
                    "name": name,
                    "unit": stage.unit,
                    "kind": stage.kind,
                    "what": what(stage),
                    "in": [{"port": each.port, "from": source(each), **_sync(each)} for each in stage.inputs],
                    "every": stage.every,
                    "time_ms": self.time_ms(name),
                    "time_from": self.prices[name].source if name in self.prices else "",
                }
                for name, stage in file.stages.items()
            ],
            "streams": [
                {
                    "from": name,
                    "to": file.readers[name],
                    "slots": edge_rule(rule).slots,
                    "rule": rule,
                    "ports": {port: str(kind) for port, kind in self.types.get(name, {}).items()},
                    "memory_bytes": self.memory[name],
                }
                for name, rule in self.rules.items()
            ],
            "routes": routes,
            "period_ms": self.period_ms,
            "cycle": list(self.bound.stages) if self.bound else [],
            "limit": self.bound.limit if self.bound else "",
            "memory_bytes": sum(filter(None, self.memory.values())),
            "memory_unknown": [name for name, size in self.memory.items() if size is None],
            "imports": self.imports,
            **({} if self.notes is None else {"notes": self.notes}),
        }


def check_file(file: PipelineFile) -> CheckedFile:
    """Check the networks, ports and slots of a pipeline file. Raises BadInputError for the first fault in them."""
    types = port_types(file, read_networks(file))
    prices = {name: price for name in file.stages if (price := given_price(file, name)) is not None}
    rules = edge_rules(file)
    bound = bound_of(file, prices)[1] if len(prices) == len(file.stages) else None
    memory = {name: _memory(file, name, rule, types.get(name)) for name, rule in rules.items()}
    past = () if file.bypass is None else graph_of(file, rules).bypassed
    imports = sorted({each.python for each in file.stages.values() if isinstance(each, PythonStage)})
    return CheckedFile(str(file.path), file, types, prices, bound, rules, memory, past, imports)


def what(stage: StageKeys) -> str:
    """Return the stage's network file, Python factory or block; "" for a stage with a set time and nothing to run."""
    return str(getattr(stage, stage.kind)) if stage.kind != "time_ms" else ""


def source(each: PortInput) -> str:
    """Return the stage that an input reads, or `STAGE.PORT`."""
    return f"{each.stage}.{each.from_port}" if each.from_port else each.stage


def _sync(each: PortInput) -> dict[str, Any]:
    return {"sync": "latest", "max_age_ms": each.max_age_ms or None} if each.latest else {"sync": "frame"}


def _memory(file: PipelineFile, name: str, rule: str, ports: Mapping[str, PortType] | None) -> int | None:
    """Return the bytes of the slots behind stage `name`; None if the types of its `ports` are not known.

    `rule`: rule of the edge. Raises BadInputError for more than MOST_STREAM_BYTES.
    """
    if not ports:
        return None
    slots, slot_bytes = edge_rule(rule).slots, sum(port.payload_bytes for port in ports.values())
    if slots * slot_bytes > MOST_STREAM_BYTES:
        found = f"{slots} slots of {slot_bytes >> 20} MiB behind {name}"
        expected = f"at most {MOST_STREAM_BYTES >> 30} GiB for a stream"
        raise BadInputError(f"{file.path}: edges.{name}", found, expected, "fewer slots or a smaller port")
    return slots * slot_bytes


def is_scene(text: str) -> bool:
    """Return whether `text` names a bundled scene, or a TOML file with keys but without any table of a pipeline file.

    Raises BadInputError for a TOML file that is empty, too large or unreadable.
    """
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


def check_scene(text: str, profile: str | None = None) -> tuple[CheckedFile, str]:
    """Return the checked pipeline of a scene, and the text of a pipeline file that describes it.

    `text`: name of a bundled scene, or a file.
    `profile`: chip for which the times of the stages are computed; None for stages without times.

    Raises BadInputError for a faulty scene or chip, and MissingPartError if a part that a run needs is not installed.
    """
    from trilane.stages.avatar_pipeline import avatar_pipeline
    from trilane.stages.configure import configure
    from trilane.stages.run_options import RunOptions

    options = RunOptions(scene=text, skinning="gpu")
    configured = configure(options, Path.cwd())
    pipeline, scene = avatar_pipeline(configured.config, configured.assets, options.edge), configured.config.scene
    run: dict[str, Any] = {"policy": options.policy, "frames": scene.frames}
    if POLICIES[options.policy].paced:
        run["fps"] = scene.fps
    times, taken = ({}, {}) if profile is None else _priced(text, profile)
    tables = tables_of(pipeline, run, times, taken)
    checked = check_file(checked_tables(tables, Path(f"{scene.name}.toml")))
    notes = [*unsaid(pipeline)]
    if profile is None or checked.file.bypass is None or (share := checked.file.bypass[1].taken) is None:
        notes.append("without times: --profile CHIP adds the times of a chip")
    else:
        notes.append(f"times are means of {profile}, {SUSTAINED}, for frames that the network paints")
        notes.append(f"{float(share):.1%} of the scene's frames need no new picture and take the route")
    head = [f"the pipeline of the scene {scene.name}, as `trilane run {text}` runs it"]
    if checked.bound is not None:
        cycle = " -> ".join(checked.bound.stages)
        head.append(f"period {checked.period_ms:.6g} ms or more, by {checked.bound.limit}: {cycle}")
    return replace(checked, name=text, imports=[], notes=notes), file_text(tables, [*head, *notes])


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


COLUMN, LANE, BOX, HEIGHT, LEFT, TOP = 170, 84, 130, 44, 90, 20
OVER: Final = 10  # pixels between a row of boxes and a line that passes above them
LETTERS: Final = 17  # of a stage's name, at most, in its box
DASHES, DOTS = " stroke-dasharray='5 4'", " stroke-dasharray='1 4'"
STYLE: Final = "font-family='sans-serif' font-size='12'"


def draw_graph(checked: CheckedFile) -> str:
    """Return the drawing of a pipeline as the text of an SVG file."""
    file, cells = checked.file, _cells(checked.file)
    width, height = LEFT + COLUMN * (1 + max(column for column, _ in cells.values())), TOP
    places: dict[str, tuple[int, int]] = {}
    body = []
    for unit in file.units:
        own = {name: cells[name] for name, stage in file.stages.items() if stage.unit == unit}
        lane = LANE * (1 + max(row for _, row in own.values()))
        body.append(
            f"<rect x='0' y='{height}' width='{width}' height='{lane - 6}' fill='#f3f4f6'/>"
            f"<text x='10' y='{height + 20}' {STYLE} font-weight='bold'>{escape(unit)}</text>"
        )
        places |= {name: (LEFT + COLUMN * column, height + LANE * row + 16) for name, (column, row) in own.items()}
        height += lane
    body += [
        _line(places[each.stage], places[name], DASHES if each.latest else "")
        for name, stage in file.stages.items()
        for each in stage.inputs
    ]
    if file.bypass is not None:
        body.append(_line(places[file.bypass[0]], places[file.bypass[1].to], DOTS))
    body += [_box(checked, name, *places[name]) for name in file.stages]
    head = f"<svg xmlns='http://www.w3.org/2000/svg' width='{width}' height='{height}' viewBox='0 0 {width} {height}'>"
    return "\n".join([head, "<rect width='100%' height='100%' fill='white'/>", *body, "</svg>", ""])


def _cells(file: PipelineFile) -> dict[str, tuple[int, int]]:
    """Return (column, row) of each stage, by its name. Column 0 is on the left, row 0 on top in the lane of the unit.

    A stage stands to the right of every stage that it reads. Stages in one lane and column get different rows.
    """
    found: dict[str, tuple[int, int]] = {}
    used = Counter[tuple[str, int]]()
    for name, stage in file.stages.items():
        column = 1 + max((found[each.stage][0] for each in stage.inputs), default=-1)
        found[name] = column, used[stage.unit, column]
        used[stage.unit, column] += 1
    return found


def _box(checked: CheckedFile, name: str, x: int, y: int) -> str:
    stage, time_ms = checked.file.stages[name], checked.time_ms(name)
    time = stage.kind if time_ms is None else f"{time_ms:g} ms"
    every = f" every {stage.every}" if stage.every > 1 else ""
    short = name if len(name) <= LETTERS else name[: LETTERS - 1] + "…"
    is_bound = checked.bound is not None and name in checked.bound.stages
    border = "stroke='#b91c1c' stroke-width='3'" if is_bound else "stroke='#374151'"
    return (
        f"<g><title>{escape(name)}: {escape(what(stage) or stage.kind)}</title>"
        f"<rect x='{x}' y='{y}' width='{BOX}' height='{HEIGHT}' rx='5' fill='white' {border}/>"
        f"<text x='{x + 8}' y='{y + 18}' {STYLE}>{escape(short)}</text>"
        f"<text x='{x + 8}' y='{y + 35}' {STYLE} fill='#6b7280'>{escape(time + every)}</text></g>"
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
