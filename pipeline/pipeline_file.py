"""Reads a pipeline file: TOML that describes stages, their inputs, and the units that they run on.

    file = read_pipeline(Path("street.toml"))
    file.stages["detector"].unit, stage_inputs(file.stages["overlay"])

Rule: a defect becomes one BadInputError that names the file and the key. The file may come from a stranger. Sizes are
checked before memory is allocated, no path leads out of the file's folder, and no module of the file is imported.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from math import lcm
from pathlib import Path
from posixpath import normpath
from typing import Any, Final, TypeVar

from pydantic import ValidationError

from trilane.errors import BadInputError, did_you_mean
from trilane.files import instead_of_file, read_bytes
from trilane.pipeline.file_keys import (
    BLOCKS,
    ENDS,
    FORMS,
    KINDS,
    MOST_SAMPLES,
    MOST_SDS,
    MOST_STAGES,
    NAME,
    BusyBlock,
    BypassKeys,
    EncodeBlock,
    InputKeys,
    Keys,
    OnnxStage,
    PortInput,
    PrepareBlock,
    PythonStage,
    RunKeys,
    StageKeys,
    StageTime,
    TimedStage,
    UnitKeys,
    VideoBlock,
    read_input,
    shown,
)
from trilane.pipeline.measurements.measurement import Measurement
from trilane.pipeline.measurements.read_file import chosen, read_measurements
from trilane.scheduler.events import MOST_INPUTS
from trilane.scheduler.policy import POLICIES
from trilane.transport.slots import DEFAULT_EDGE, EDGE_WORDS, edge_rule
from trilane.unexpected_value import UnexpectedValue, unexpected_in
from trilane.units import UNITS

MOST_BYTES: Final = 16 << 20
MOST_PERIOD: Final = 100_000  # of a stage, in frames: the least common multiple of all `every` up to it
LIKE: Final = 0.8  # least likeness, by difflib, of a name and the name that was probably meant
TABLES: Final = ("run", "units", "stages", "edges")
STAGES: Final = re.compile(rb"""^\s*(\[\s*["']?stages["']?\s*[\].]|["']?stages["']?\s*[.=])""", re.MULTILINE)
#: A comma between two assignments, not one in a list or a table.
BETWEEN: Final = re.compile(rf",(?=\s*(?:{'|'.join(TABLES)})\.)")
FORM: Final = "a pipeline file, TOML in UTF-8"
IF_EMPTY: Final = "`trilane init` writes a first file from networks and a video"
LEAVE_OUT: Final = "leave it out"
IN_BRACES: Final = "put its keys in braces: { KEY = VALUE, KEY = VALUE }"
#: Tables that a stage's key may hold, by the key.
INNER: Final[dict[str, type[Keys]]] = {"in": InputKeys, "time_ms": StageTime, "bypass": BypassKeys}

AnyKeys = TypeVar("AnyKeys", bound=Keys)


@dataclass(frozen=True)
class PipelineFile:
    """A checked pipeline file.

    `path`: path of the file; paths in the file are relative to the file's folder.
    `run`: keys of the table [run].
    `stages`: stages by name, in the order of the file; but each stage comes after the stages that it reads.
    `units`: every unit that a stage names, in the order of the stages.
    `edges`: rules that the table [edges] states, by the stage that writes the stream.
    `tables`: tables of the file as they were read, without checks.
    """

    path: Path
    run: RunKeys
    units: Mapping[str, UnitKeys]
    stages: Mapping[str, StageKeys]
    edges: Mapping[str, str]
    tables: Mapping[str, Any] = field(repr=False, compare=False)

    @property
    def folder(self) -> Path:
        return self.path.parent

    def hardware(self, unit: str) -> str | None:
        """Return the unit of a hardware profile (cpu, gpu or dsp) for which `unit` stands; None if there is none."""
        return self.units[unit].hardware or (unit if unit in UNITS else None)

    @property
    def readers(self) -> dict[str, list[str]]:
        """The names of the readers of each stage that has readers, by the stage's name, in the order of the stages."""
        found: dict[str, list[str]] = {name: [] for name in self.stages}
        for name, stage in self.stages.items():
            for source in dict.fromkeys(each.stage for each in stage.inputs):
                found[source].append(name)
        return {name: readers for name, readers in found.items() if readers}

    @property
    def periods(self) -> dict[str, int]:
        """The distance, in frames, between the frames that each stage takes, by the stage's name.

        It is the least common multiple of `every` of the stage and of the stages that feed it, except by `latest`.
        """
        found: dict[str, int] = {}
        for name, stage in self.stages.items():
            found[name] = lcm(stage.every, *(found[each.stage] for each in stage.inputs if not each.latest))
        return found

    @property
    def out_of_row(self) -> str:
        """The name of the first stage that breaks the chain; "" if all stages form a chain.

        This stage leaves out frames, or does not read exactly the stage before it.
        """
        before: tuple[PortInput, ...] = ()
        for name, stage in self.stages.items():
            if stage_inputs(stage) != before or stage.every != 1:
                return name
            before = (PortInput("", name),)
        return ""

    @property
    def is_chain(self) -> bool:
        """Whether each stage takes every frame, and reads only the stage before it."""
        return not self.out_of_row

    @property
    def bypass(self) -> tuple[str, BypassKeys] | None:
        """(Name of the stage at which the bypass begins, keys of the bypass); None without a bypass."""
        return next(((name, stage.bypass) for name, stage in self.stages.items() if stage.bypass is not None), None)

    @property
    def latency_to(self) -> str:
        """The stage at whose end the latency ends."""
        return self.run.latency_to or [name for name in self.stages if name not in self.readers][-1]

    def changed(self, assignments: Sequence[str]) -> PipelineFile:
        """Return a copy with changed values. Raises BadInputError for a bad assignment, or if the copy has a defect.

        `assignments`: texts KEY=VALUE, such as `stages.seg.unit=dsp`.
        """
        tables = dict(self.tables)
        for text in assignments:
            tables = _assigned(tables, text)
        _check_new_stages(tables, list(self.stages))
        return checked_tables(tables, self.path)


def read_pipeline(path: Path) -> PipelineFile:
    """Return the pipeline file at `path`, checked. Raises BadInputError for a file that is missing or has a defect."""
    return checked_tables(tables_of(path), path)


def tables_of(path: Path) -> dict[str, Any]:
    """Return the tables of a pipeline file by name, not checked yet. Raises BadInputError if it is no TOML."""
    data = read_bytes(path, MOST_BYTES, FORM, IF_EMPTY)
    try:
        return tomllib.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise BadInputError(path, "bytes that are no text in UTF-8", FORM, "save it as UTF-8") from None
    except (ValueError, RecursionError) as error:
        raise _of_toml(path, str(error)) from None


def is_pipeline_file(path: Path) -> bool:
    """Return whether a file looks like a pipeline file: a .toml with stages. A scene is a .toml without stages."""
    if path.suffix != ".toml" or not path.is_file():  # reading a pipe could wait for ever
        return False
    try:
        with path.open("rb") as file:
            text = file.read(MOST_BYTES)
    except OSError:
        return False
    return STAGES.search(text) is not None


def _of_toml(path: Path, message: str) -> BadInputError:
    """Return the error for a defect in TOML. `message`: message of the TOML reader."""
    place = re.search(r" \(at line (\d+), column \d+\)$", message)
    where = f"{path}, line {place[1]}" if place else str(path)
    text = message[: place.start()] if place else message
    if "verwrite" in text or "twice" in text or "mutate" in text or "more than once" in text:
        return BadInputError(where, "the same name twice", "each name once", f"TOML says: {text}")
    return BadInputError(where, "no TOML", "TOML", f"TOML says: {text}" if text else "")


def checked_tables(tables: Mapping[str, Any], path: Path) -> PipelineFile:
    """Return the checked file with these tables. `path`: path of the file. Raises BadInputError for a defect."""
    for name in tables:
        if name not in TABLES:
            found = f"the unknown key {name!r}"
            raise BadInputError(path, found, f"tables {', '.join(TABLES)}", did_you_mean(name, TABLES) or LEAVE_OUT)
    run = _checked(RunKeys, _table(tables, "run", path), f"{path}: run")
    written = _table(tables, "stages", path)
    if not 1 <= len(written) <= MOST_STAGES:
        remedy = "do in one stage what several do" if written else IF_EMPTY
        raise BadInputError(f"{path}: stages", f"{len(written)} stages", f"1 to {MOST_STAGES}", remedy)
    units = {
        name: _checked(UnitKeys, keys, f"{path}: units.{name}") for name, keys in _table(tables, "units", path).items()
    }
    for table in ("units", "stages"):
        for name in _table(tables, table, path):
            if not re.fullmatch(NAME, name):
                raise BadInputError(f"{path}: {table}", f"the name {shown(name)}", FORMS[NAME], "choose another name")
    stages = _in_order({name: _stage(name, keys, path) for name, keys in written.items()}, path)
    for name, stage in stages.items():
        if meant := _slip(stage.unit, [*units, *UNITS]):
            where, found = f"{path}: stages.{name}.unit", f"the unknown unit {stage.unit!r}"
            remedy = f"did you mean {meant!r}? if not, add {stage.unit} = {{}} to [units]"
            raise BadInputError(where, found, f"one of {', '.join(dict.fromkeys([*units, *UNITS]))}", remedy)
    edges = _table(tables, "edges", path)
    used = {stage.unit: units.get(stage.unit, UnitKeys()) for stage in stages.values()}
    file = PipelineFile(path, run, used, stages, edges, tables)
    _check_together(file)
    return file


def _slip(unit: str, known: Sequence[str]) -> str:
    """Return the known unit that a name probably misspells; "" if the name is probably right.

    A name that differs from a known unit only in a number or a letter at its end, such as gpu2 or npu_b, is right.
    """
    stem = unit.rstrip("0123456789")
    if unit in known or any(stem == name.rstrip("0123456789") or unit[:-1] == name[:-1] for name in known):
        return ""
    return next(iter(get_close_matches(unit, known, 1, LIKE)), "")


def _table(tables: Mapping[str, Any], name: str, path: Path) -> Mapping[str, Any]:
    table = tables.get(name, {})
    if not isinstance(table, dict):
        raise BadInputError(f"{path}: {name}", shown(table), "a table", f"begin it with the line [{name}]")
    return table


def _checked(model: type[AnyKeys], values: object, where: str) -> AnyKeys:
    """Return a table of the file as an instance of `model`. Raises BadInputError, which names the wrong key."""
    if not isinstance(values, dict):
        raise BadInputError(where, shown(values), f"a table with {', '.join(model.known())}", IN_BRACES)
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise _bad_input(model, error, where) from None


def _bad_input(model: type[Keys], error: ValidationError, where: str) -> BadInputError:
    """Return the error for one of the defects that pydantic found: an unknown key, else the first defect.

    An unknown key may be misspelt, and so explain the other defects.
    """
    errors = error.errors(include_url=False)
    first = next((each for each in errors if each["type"] == "extra_forbidden"), errors[0])
    place = [str(part) for part in first["loc"]]
    where = ".".join([where, *place])
    if first["type"] == "extra_forbidden":
        known = (INNER.get(place[0], model) if len(place) > 1 else model).known()
        hint = did_you_mean(place[-1], known) or LEAVE_OUT
        return BadInputError(where, f"the unknown key {place[-1]!r}", f"one of {', '.join(known)}", hint)
    unexpected = unexpected_in(first)
    if unexpected is not None:
        remedy = unexpected.remedy or _meaning(model, place[0] if place else "")
        return BadInputError(where, unexpected.found, unexpected.expected, remedy)
    if first["type"] == "missing":
        return BadInputError(where, "nothing", "this key", _meaning(model, place[0]))
    said = first["msg"].removeprefix("Input should be ").removeprefix("Value should have ")
    expected = FORMS.get(first.get("ctx", {}).get("pattern", "")) or said.partition(" after validation")[0]
    return BadInputError(where, shown(first["input"]), expected, _meaning(model, place[0]))


def _meaning(model: type[Keys], key: str) -> str:
    """Return `key` and its description as part of a sentence; empty for a key without a description."""
    fields = {one.alias or name: one for name, one in model.model_fields.items()}
    text = (fields[key].description or "") if key in fields else ""
    return f"{key}: {text[:1].lower()}{text[1:].rstrip('.')}" if text else ""


def _stage(name: str, values: object, path: Path) -> StageKeys:
    """Check the table of one stage, and return the stage as an instance of its kind. Raises BadInputError."""
    where = f"{path}: stages.{name}"
    if not isinstance(values, dict):
        expected = "a table with a unit and one of onnx, python, block, time_ms"
        raise BadInputError(where, shown(values), expected, IN_BRACES)
    kinds = [kind for kind in KINDS if kind in values]
    named = [kind for kind in kinds if kind != "time_ms"] or kinds
    if len(named) != 1:
        known = [*KINDS, "unit", "in"]
        near = [hint for key in values if key not in known and (hint := did_you_mean(key, list(KINDS)))]
        found = " and ".join(named) or "none of onnx, python, block, time_ms"
        raise BadInputError(where, found, "exactly one of them", near[0] if near else "they say what the stage is")
    model = KINDS[named[0]]
    if named[0] == "block":
        block = values["block"]
        if not isinstance(block, str) or block not in BLOCKS:
            hint = did_you_mean(block, BLOCKS) if isinstance(block, str) else ""
            hint = hint or "python in place of block takes code of your own"
            raise BadInputError(f"{where}.block", shown(block), f"one of {', '.join(BLOCKS)}", hint)
        model = BLOCKS[block]
    inputs = _inputs(values["in"], f"{where}.in") if "in" in values else ()
    stage = _with_times(_checked(model, {**values, "in": inputs}, where), f"{where}.time_ms", path.parent)
    _check_ports(stage, where)
    if isinstance(stage, OnnxStage) and not (model_path := path.parent / stage.onnx).is_file():
        found = f"{instead_of_file(model_path)} at {model_path}"
        raise BadInputError(f"{where}.onnx", found, "an ONNX file", f"put {stage.onnx} beside {path.name}")
    return stage


def _with_times(stage: StageKeys, where: str, folder: Path) -> StageKeys:
    """Return the stage; if `time_ms` names a file, `time_ms` gets the times from this file. Raises BadInputError."""
    time = stage.time_ms
    if time is None or time.source is None:
        return stage
    one = chosen(read_measurements(folder / time.source), time.name or "", where)
    return stage.model_copy(update={"time_ms": time_of(one)})


def time_of(measurement: Measurement) -> StageTime:
    """Return a measurement as the time of a stage: at most MOST_SAMPLES samples, or else its mean and sd."""
    if measurement.samples_ms:
        return StageTime(samples=measurement.samples_ms[:MOST_SAMPLES])
    mean, sd = measurement.mean_ms or 0.0, measurement.sd_ms or 0.0
    return StageTime(mean=mean, sd=min(sd, MOST_SDS * mean))


def _inputs(value: object, where: str) -> tuple[PortInput, ...]:
    """Return the inputs of a stage. `value`: its key `in`: a stage, stage.port, or ports. Raises BadInputError."""
    # A table is one input, such as { from = "camera", sync = "latest" }, or a table of ports.
    ports = value if isinstance(value, dict) else {"": value}
    if "from" in ports and ports.keys() <= {*InputKeys.known()}:
        ports = {"": value}
    if not ports:
        raise BadInputError(where, "an empty table", "a port, such as { frame = 'camera' }", "a source has no `in`")
    found = []
    for port, each in ports.items():
        place = f"{where}.{port}" if port else where
        if port and not re.fullmatch(NAME, port):
            raise BadInputError(where, f"port {port!r}", FORMS[NAME], "choose another name")
        try:
            found.append(read_input(port, each))
        except UnexpectedValue as error:
            raise BadInputError.at(place, error) from None
        except ValidationError as error:
            raise _bad_input(InputKeys, error, place) from None
    return tuple(found)


def _check_ports(stage: StageKeys, where: str) -> None:
    """Raise BadInputError if a stage reads through a port that its kind lacks, or not through a port that it needs."""
    known = stage.in_ports
    if known is None:
        return
    ports = [each.port for each in stage.inputs]
    if not known and ports:
        raise BadInputError(f"{where}.in", "an input", f"none, as {stage.named_kind} is a source", LEAVE_OUT)
    first = next(iter(known), "")
    for port in ports:
        if port and port not in known:
            names = [name for name in known if name]
            expected = f"one of {', '.join(names)}" if names else "a stage alone, as it has one input"
            hint = did_you_mean(port, names) or LEAVE_OUT
            raise BadInputError(f"{where}.in.{port}", f"the unknown port {port!r}", expected, hint)
    read = {port or first for port in ports}
    for port, needed in known.items():
        if needed and port not in read:
            name = f"the input {port!r}" if port else "an input"
            remedy = f'add in = {{ {port} = "STAGE" }}' if port else 'add in = "STAGE"'
            raise BadInputError(f"{where}.in", f"nobody who feeds {name} of {stage.named_kind}", "a stage", remedy)


def _in_order(stages: Mapping[str, StageKeys], path: Path) -> dict[str, StageKeys]:
    """Return the stages in the order of the file, changed only so that each stage follows the stages that it reads.

    Raises BadInputError for an unknown stage or port, and for stages that wait for each other in a circle.
    """
    for name, stage in stages.items():
        _check_sources(name, stage, stages, path)
    left, done = dict(stages), dict[str, StageKeys]()
    while left:
        name = next((name for name, stage in left.items() if all(each.stage in done for each in stage.inputs)), "")
        if not name:
            circle = _circle(left)
            where, found = f"{path}: stages.{circle[-1]}.in", f"the circle {' -> '.join(circle)}"
            remedy = "take one of these inputs away"
            raise BadInputError(where, found, "stages that do not wait for themselves", remedy)
        done[name] = left.pop(name)
    return done


def _check_sources(name: str, stage: StageKeys, stages: Mapping[str, StageKeys], path: Path) -> None:
    """Check the inputs of one stage. Raises BadInputError.

    The stages and ports that it reads must exist, and these stages must write something. It may read at most
    MOST_INPUTS stages. It must read all ports of one stage with the same `sync` and age.
    """
    synced: dict[str, PortInput] = {}
    for each in stage.inputs:
        where = f"{path}: stages.{name}.in" + (f".{each.port}" if each.port else "")
        if each.stage not in stages:
            expected = f"a stage of the file: {', '.join(stages)}"
            hint = did_you_mean(each.stage, stages) or "add it to [stages]"
            raise BadInputError(where, f"the unknown stage {each.stage!r}", expected, hint)
        source = stages[each.stage]
        if source.named_kind in ENDS:
            found, remedy = f"{each.stage!r}, a {source.named_kind}", "read what it reads"
            raise BadInputError(where, found, "a stage that writes something", remedy)
        ports = source.out_ports
        if each.from_port and ports is not None and each.from_port not in ports:
            names = [port for port in ports if port]
            expected = f"one of {', '.join(names)}" if names else f"{each.stage!r} alone, which has one port"
            found = f"the unknown port {each.from_port!r} of {each.stage}"
            hint = did_you_mean(each.from_port, names) or f"write '{each.stage}{'.' if names else ''}{ports[0]}'"
            raise BadInputError(where, found, expected, hint)
        if not each.from_port and ports is not None and len(ports) > 1:
            found = f"{each.stage!r}, which has the ports {', '.join(ports)}"
            raise BadInputError(where, found, "one of them", f"write '{each.stage}.{ports[0]}'")
        before = synced.setdefault(each.stage, each)
        if (before.latest, before.max_age_ms) != (each.latest, each.max_age_ms):
            found = f"{each.stage!r} with another sync or age than before"
            raise BadInputError(where, found, "the same for its ports", "write the same sync and max_age_ms for each")
    if len(synced) > MOST_INPUTS:
        found = f"{len(synced)} stages"
        raise BadInputError(f"{path}: stages.{name}.in", found, f"at most {MOST_INPUTS}", "join some of them before")


def _circle(stages: Mapping[str, StageKeys]) -> list[str]:
    """Return the names of stages in a circle, in the direction of the frames; the first name comes again at the end.

    `stages`: stages that each wait for another one of them.
    """
    seen: list[str] = []
    name = next(iter(stages))
    while name not in seen:
        seen.append(name)
        name = min(each.stage for each in stages[name].inputs if each.stage in stages)
    return [name, *reversed(seen[seen.index(name) :])]


def _check_together(file: PipelineFile) -> None:
    """Check that the tables of the file agree with each other. Raises BadInputError."""
    _check_run(file)
    _check_edges(file)
    _check_written(file)
    for name, period in file.periods.items():
        if period > MOST_PERIOD:
            found = f"a frame of {period}, by every {file.stages[name].every} and those before"
            remedy = "choose numbers that divide each other, such as 2 and 4"
            raise BadInputError(f"{file.path}: stages.{name}.every", found, f"one of at most {MOST_PERIOD}", remedy)
    for name, stage in file.stages.items():
        _check_stage_together(file, name, stage)
    _check_bypass(file)


def _check_run(file: PipelineFile) -> None:
    path, run = file.path, file.run
    if run.fps is not None and run.arrivals is not None:
        raise BadInputError(f"{path}: run.arrivals", "arrivals beside fps", "one or the other", "leave one out")
    if POLICIES[run.policy].paced and run.fps is None and run.arrivals is None:
        remedy = "add fps = 30 to [run]"
        raise BadInputError(f"{path}: run.policy", f"{run.policy} without a rate", "fps or arrivals", remedy)
    if run.latency_to and run.latency_to not in file.stages:
        found, expected = f"the unknown stage {run.latency_to!r}", f"a stage of the file: {', '.join(file.stages)}"
        hint = did_you_mean(run.latency_to, file.stages) or f"{LEAVE_OUT}: the last stage counts then"
        raise BadInputError(f"{path}: run.latency_to", found, expected, hint)


def _check_edges(file: PipelineFile) -> None:
    readers = file.readers
    for name, rule in file.edges.items():
        where = f"{file.path}: edges.{name}"
        if name not in readers:
            kind = "a stage that nobody reads" if name in file.stages else "an unknown stage"
            remedy = did_you_mean(name, readers) or LEAVE_OUT
            raise BadInputError(where, kind, f"one of {', '.join(readers) or 'none, as nobody reads'}", remedy)
        if not isinstance(rule, str):
            raise BadInputError(where, shown(rule), EDGE_WORDS, 'such as "double"')
        try:
            edge_rule(rule)
        except UnexpectedValue as error:
            raise BadInputError.at(where, error) from None


def _check_written(file: PipelineFile) -> None:
    """Raise BadInputError if a video is written to the path of another video that the pipeline writes or reads."""
    taken = {normpath(stage.path): name for name, stage in file.stages.items() if isinstance(stage, VideoBlock)}
    for name, stage in file.stages.items():
        if isinstance(stage, EncodeBlock) and (other := taken.setdefault(normpath(stage.path), name)) != name:
            found = f"{stage.path!r}, the path of {other}"
            raise BadInputError(f"{file.path}: stages.{name}.path", found, "a file of its own", "choose another name")


def _check_stage_together(file: PipelineFile, name: str, stage: StageKeys) -> None:
    where = f"{file.path}: stages.{name}"
    if isinstance(stage, OnnxStage) and stage.time_ms is None and file.hardware(stage.unit) is None:
        remedy = f'add {stage.unit} = {{ hardware = "dsp" }} to [units]'
        found = f"the unknown unit {stage.unit!r} for a network"
        raise BadInputError(f"{where}.unit", found, f"{', '.join(UNITS)}, or a unit with hardware", remedy)
    if isinstance(stage, PrepareBlock):
        other = file.stages.get(stage.like)
        if not isinstance(other, OnnxStage):
            networks = [each for each, one in file.stages.items() if isinstance(one, OnnxStage)]
            found = f"{stage.like!r}, {'no network' if other else 'an unknown stage'}"
            expected = f"one of {', '.join(networks)}" if networks else "a stage with onnx"
            hint = did_you_mean(stage.like, networks) or "name the network that reads this stage"
            raise BadInputError(f"{where}.like", found, expected, hint)
    for each in stage.inputs:
        rule = file.edges.get(each.stage, file.run.edge or DEFAULT_EDGE)
        if each.latest and edge_rule(rule).slots < 2:
            found = f"edge {rule!r} behind {each.stage}, whose newest frame {name} holds"
            remedy = f'add {each.stage} = "double" to [edges]'
            raise BadInputError(f"{file.path}: edges.{each.stage}", found, "two slots or more", remedy)


def _check_bypass(file: PipelineFile) -> None:
    if file.bypass is None:
        return
    (begin, way), names = file.bypass, list(file.stages)
    where, stage = f"{file.path}: stages.{begin}.bypass", file.stages[begin]
    if others := [name for name in names if name != begin and file.stages[name].bypass is not None]:
        remedy = f"leave it out here, or at {begin}"
        raise BadInputError(f"{file.path}: stages.{others[0]}.bypass", "a second bypass", "one in a file", remedy)
    if not isinstance(stage, PythonStage | BusyBlock | TimedStage):
        remedy = "put a stage with python before it, which says what has nothing to do"
        raise BadInputError(where, f"a bypass at {stage.named_kind}", "python, busy or only time_ms", remedy)
    if other := file.out_of_row:
        remedy = "let each stage read the one before it alone, without every"
        raise BadInputError(where, f"a bypass in a pipeline with branches, at {other}", "a row of stages", remedy)
    behind = names[names.index(begin) + 2 :]
    if way.to not in behind:
        found = f"{way.to!r}, {'a stage before or next to it' if way.to in names else 'an unknown stage'}"
        expected = f"one of {', '.join(behind)}" if behind else "two stages or more behind it"
        hint = did_you_mean(way.to, behind) or "a bypass goes past one stage at least"
        raise BadInputError(f"{where}.to", found, expected, hint)
    if file.latency_to in names[names.index(begin) + 1 : names.index(way.to)]:
        where, found = f"{file.path}: run.latency_to", f"{file.latency_to!r}, past which frames of {begin} may go"
        raise BadInputError(where, found, "a stage that every frame meets", f"such as {way.to}")


def assignments(text: str) -> list[str]:
    """Return the assignments in `text`, a value of `--set`; commas separate them."""
    return BETWEEN.split(text)


def _assigned(tables: Mapping[str, Any], text: str) -> dict[str, Any]:
    """Return `tables` changed by `text` (KEY=VALUE); a VALUE that is no TOML counts as text. Raises BadInputError."""
    key, equals, value = text.partition("=")
    parts = [part.strip() for part in key.split(".")]
    if not equals or not all(parts) or parts[0] not in TABLES or len(parts) < 2:
        remedy = f"begin with one of {', '.join(f'{name}.' for name in TABLES)}"
        raise BadInputError("--set", repr(text), "KEY=VALUE, such as stages.seg.unit=dsp", remedy)
    try:
        read = tomllib.loads(f"value = {value}")
        new = read["value"] if len(read) == 1 else value
    except (ValueError, RecursionError):
        new = value.strip()
    return _with_value(tables, parts, new)


def _check_new_stages(tables: Mapping[str, Any], names: Sequence[str]) -> None:
    """Raise BadInputError for a new stage without a kind, because its name in --set is probably misspelt."""
    for name, keys in tables["stages"].items():
        if name not in names and isinstance(keys, dict) and not {*keys} & {*KINDS}:
            expected = f"a stage of the file: {', '.join(names)}"
            hint = did_you_mean(name, names) or f"a new stage needs one of {', '.join(KINDS)}"
            raise BadInputError("--set", f"the unknown stage {name!r}", expected, hint)


def _with_value(tables: Mapping[str, Any], parts: Sequence[str], value: object) -> dict[str, Any]:
    if len(parts) == 1:
        return {**tables, parts[0]: value}
    inner = tables.get(parts[0], {})
    if not isinstance(inner, dict):
        found = f"{parts[1]!r} of {parts[0]}, which is {shown(inner)}"
        remedy = f"set all of {parts[0]}: {{ {parts[1]} = VALUE }}"
        raise BadInputError("--set", found, "a key of a table", remedy)
    return {**tables, parts[0]: _with_value(inner, parts[1:], value)}


def stage_inputs(stage: StageKeys) -> tuple[PortInput, ...]:
    """Return one input, without names of ports, for each stage that `stage` reads.

    All ports that a stage writes belong to one stream.
    """
    return tuple({each.stage: replace(each, port="", from_port="") for each in stage.inputs}.values())
