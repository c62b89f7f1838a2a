"""Describes a pipeline as data: stages, the edges between them, and the units that they run on.

Rule: this module does not know what a stage does; it knows only the name of the stage's factory. A `Pipeline` is plain
data, so that JSON can carry it to a unit's process.

The module also writes a description as the text of a pipeline file, and says what such a file cannot contain:

    tables = tables_of(pipeline, {"policy": "latest", "fps": 30.0}, {"camera": 0.4})
    text = file_text(tables, unsaid(pipeline))

`pipeline_file.checked_tables` reads the same tables, so every written file can be checked and predicted.
"""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Self

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationError,
    model_validator,
)
from pydantic.functional_validators import ModelWrapValidatorHandler

from trilane.errors import BadInputError
from trilane.scheduler.events import Graph, Input, StageSpec
from trilane.scheduler.placement import Place
from trilane.scheduler.state import build
from trilane.transport.packets import FRAME_FIELDS, header_dtype
from trilane.transport.slots import DEFAULT_EDGE, edge_rule
from trilane.unexpected_value import UnexpectedValue, unexpected_in
from trilane.units import NS_PER_MS

LONGEST_FOUND = 120  # characters of a wrong value that a message shows
LONGEST_NAME = 40  # characters of a stage or unit; a socket of that name must fit into a path of 107 bytes
#: Only ASCII: each character is one byte of a path, and the name is a key of TOML without quotes.
LETTERS = "[A-Za-z0-9_-]"
MOST_EDGES = 200  # edges of one unit; all its descriptors must fit into one message of 250 descriptors
FACTORY = r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$"


class Model(BaseModel):
    """Base class of data: unknown fields are errors, and values never change."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def _header(value: Any) -> np.dtype[Any]:
    try:
        dtype = np.lib.format.descr_to_dtype(ast.literal_eval(value)) if isinstance(value, str) else value
    except (SyntaxError, TypeError, ValueError, MemoryError, RecursionError):
        dtype = None
    if not isinstance(dtype, np.dtype) or dtype.hasobject or not _begins_with_frame_fields(dtype):
        raise UnexpectedValue(f"header {value!r}", "one made by trilane.transport.packets.header_dtype")
    return dtype


def _begins_with_frame_fields(dtype: np.dtype[Any]) -> bool:
    names = (dtype.names or ())[: len(FRAME_FIELDS)]
    return [(name, dtype[name]) for name in names] == [(name, np.dtype(field)) for name, field in FRAME_FIELDS]


HeaderDtype = Annotated[
    np.dtype[Any],
    PlainValidator(_header),
    PlainSerializer(lambda dtype: repr(np.lib.format.dtype_to_descr(dtype)), return_type=str, when_used="json"),
]


class Described(Model):
    """Base class of the parts of a pipeline's description. A wrong value raises BadInputError."""

    @model_validator(mode="wrap")
    @classmethod
    def _named(cls, values: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        try:
            return handler(values)
        except ValidationError as error:
            raise _bad_input(cls.__name__, error) from None


def _bad_input(what: str, error: ValidationError) -> BadInputError:
    """Return the BadInputError for the first defect in `error`. `what`: name of the checked class."""
    first = error.errors()[0]
    place = ".".join([what, *(str(part) for part in first["loc"])])
    unexpected = unexpected_in(first)
    if unexpected is not None:
        return BadInputError.at(place, unexpected)
    if first["type"] in ("missing", "extra_forbidden"):
        found, expected = ("nothing", "a value") if first["type"] == "missing" else ("an unknown field", "none")
        return BadInputError(place, found, expected)
    return BadInputError(place, repr(first["input"])[:LONGEST_FOUND], first["msg"].removeprefix("Input should be "))


class UnitSettings(Described):
    """The cores and threads that a unit may use.

    `cores`: numbers of cores of this machine.
    `threads`: number of threads, from 1.
    `spin`: whether threads may spin between jobs, so that they begin the next job sooner.
    """

    cores: tuple[int, ...] = Field(min_length=1)
    threads: int = Field(ge=1)
    spin: bool = False


class StageInput(Described):
    """An input of a stage of a graph.

    `stage`: name of the stage whose stream the input reads.
    `latest`: whether the reading stage takes the stream's newest frame, whatever its number.
    `max_age_ms`: longest age in ms at which the newest frame is taken; an older frame counts as absent. 0: any age.
    """

    stage: str
    latest: bool = False
    max_age_ms: float = Field(default=0.0, ge=0, allow_inf_nan=False)


class PipelineStage(Described):
    """One stage of a pipeline.

    `name`, `unit`: names of the stage, and of the unit that runs it.
    `factory`: `module:name` of a `trilane.pipeline.stage.StageFactory`, importable in the unit's process.
    `settings`: JSON values that are handed to the factory.
    `pace_ns`: least time of a job in ns; a shorter job is made longer by a wait at its end. 0: none.
    `inputs`: inputs of the stage; None for a stage of a chain, which reads the stream of the stage before it.
    `every`: distance between the frames that the stage takes: 3 for the first, the fourth and so on.
    """

    name: str = Field(pattern=f"^{LETTERS}+$", max_length=LONGEST_NAME)
    unit: str = Field(pattern=f"^{LETTERS}+$", max_length=LONGEST_NAME)
    factory: str = Field(pattern=FACTORY)
    settings: dict[str, Any] = {}
    pace_ns: int = Field(default=0, ge=0)
    inputs: tuple[StageInput, ...] | None = None
    every: int = Field(default=1, ge=1)

    @property
    def joins(self) -> bool:
        """Whether the stage has several inputs, or one with `latest` (`trilane.pipeline.stage.JoiningStage`)."""
        inputs = self.inputs or ()
        return len(inputs) > 1 or any(each.latest for each in inputs)


class PipelineEdge(Described):
    """The slots that a stage writes. In a chain, the next stage reads them; in a graph, every reader of the stage does.

    `payload_bytes`: size of every packet's payload.
    `header`: dtype of every packet's header, made by `trilane.transport.packets.header_dtype`.
    `rule`: text that `trilane.transport.slots.edge_rule` takes.
    """

    payload_bytes: int = Field(ge=0)
    header: HeaderDtype = header_dtype()
    rule: str = DEFAULT_EDGE


class Pipeline(Described):
    """Stages and the edges between them. Raises BadInputError naming the wrong field, as its parts do.

    `stages`: a chain, or a graph in which each stage has `inputs` and follows the stages that it reads.
    `edges`: edge behind each stage that has a reader, in the order of the stages.
    `units`: cores and threads of each unit that a stage names; the scheduler runs on the cores of the first stage's
    unit.
    `latency_to`: stage at whose end a frame's latency ends; empty for the last stage.
    `bypass`: names of two stages. If the first stage returns a `Skip` for a frame, the frame goes on to the second
    stage, past the stages between. The edge behind the first and the edge before the second have the same header.
    `from_release`: whether the latency begins with a frame's release, as for a camera with a rate.
    `warms_up`: whether the stages of a chain do a frame before the run; must be False if a stage counts its calls.
    `module_folders`: folders where a unit's process first looks for the modules of factories.
    `preload`: modules that are imported once, before the units' processes are forked; none from `module_folders`.
    """

    stages: tuple[PipelineStage, ...] = Field(min_length=1)
    edges: tuple[PipelineEdge, ...]
    units: dict[str, UnitSettings]
    latency_to: str = ""
    bypass: tuple[str, str] | None = None
    from_release: bool = False
    warms_up: bool = True
    module_folders: tuple[Path, ...] = ()
    preload: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _joined(self) -> Self:
        try:
            self._check()
        except UnexpectedValue as error:
            raise BadInputError.at(type(self).__name__, error) from None
        return self

    def _check(self) -> None:
        """Raise UnexpectedValue if stages, edges, units and the bypass do not agree with each other."""
        missing = {stage.unit for stage in self.stages} - set(self.units)
        if missing:
            raise UnexpectedValue(f"no settings of unit {', '.join(sorted(missing))}", "them in `units`")
        build(self.graph())
        for unit in self.units:
            count = sum(unit in {before.unit, *(each.unit for each in after)} for before, after in self.joints.values())
            if count > MOST_EDGES:
                raise UnexpectedValue(f"unit {unit} at {count} edges", f"at most {MOST_EDGES}", "use more units")
        if self.bypass is not None:
            names = self.edges_into(self.bypass[1])
            headers = {edge.header for name, edge in zip(self.joints, self.edges, strict=True) if name in names}
            if len(headers) > 1:
                raise UnexpectedValue(f"different headers of edges {', '.join(names)}", "one, as a bypass joins them")

    def graph(self) -> Graph:
        """Return the graph of the pipeline for the scheduler."""
        stages = tuple(StageSpec(stage.name, stage.unit, _inputs(stage), stage.every) for stage in self.stages)
        rules = tuple(edge.rule for edge in self.edges)
        return Graph(stages, rules, self.latency_to or self.stages[-1].name, self.bypass, self.from_release)

    @property
    def joints(self) -> dict[str, tuple[PipelineStage, tuple[PipelineStage, ...]]]:
        """(Writing stage, reading stages) of each edge, by its name `WRITER->READER`, in the order of `edges`."""
        graph, named = self.graph(), {stage.name: stage for stage in self.stages}
        return {
            graph.edge_name(place): (named[name], tuple(named[reader] for reader in readers))
            for place, (name, readers) in enumerate(graph.streams.items())
        }

    @property
    def edge_names(self) -> list[str]:
        return list(self.joints)

    def edges_into(self, stage: str) -> tuple[str, ...]:
        """Return the names of the edges from which the stage takes frames, in the order of its inputs.

        If a bypass ends at the stage, the edge on which the bypass begins comes last.
        """
        begin, end = self.bypass or ("", "")
        joints, graph = self.joints, self.graph()
        behind = {before.name: name for name, (before, _) in joints.items()}
        place = next(place for place, each in enumerate(self.stages) if each.name == stage)
        own = [behind[each.stage] for each in graph.inputs_of(place)]
        return (*own, *([behind[begin]] if stage == end else []))

    @property
    def rule(self) -> str:
        """The rule of all edges; if rules differ, the rules in the order of `edges`, joined by commas."""
        rules = [edge.rule for edge in self.edges]
        return ",".join(dict.fromkeys(rules) if len(set(rules)) == 1 else rules)

    @property
    def scheduler_cores(self) -> tuple[int, ...]:
        """The numbers of the scheduler's cores: the cores of the first stage's unit."""
        return self.units[self.stages[0].unit].cores

    @property
    def run_cores(self) -> tuple[int, ...]:
        """The numbers of all units' cores, ascending."""
        return tuple(sorted({core for settings in self.units.values() for core in settings.cores}))

    def places(self) -> dict[str, Place]:
        """Return the cores and the number of threads of each unit.

        A unit with a paced stage (`pace_ns`) counts as one thread, because it is busy during the whole pace.
        """
        paced = {stage.unit for stage in self.stages if stage.pace_ns}
        return {
            unit: Place(settings.cores, 1 if unit in paced else settings.threads)
            for unit, settings in self.units.items()
        }

    def stages_of(self, unit: str) -> tuple[PipelineStage, ...]:
        """Return the unit's stages, in the order of `stages`."""
        return tuple(stage for stage in self.stages if stage.unit == unit)

    def with_rule(self, rule: str) -> Pipeline:
        """Return this pipeline with `rule` for every edge. Raises BadInputError for an unknown or unsuitable rule."""
        changed = self.model_copy(update={"edges": tuple(e.model_copy(update={"rule": rule}) for e in self.edges)})
        try:
            edge_rule(rule)
            build(changed.graph())
        except UnexpectedValue as error:
            raise BadInputError.at("the run's settings", error) from None
        return changed


def _inputs(stage: PipelineStage) -> tuple[Input, ...] | None:
    """Return the stage's inputs for the scheduler's graph; None for a stage of a chain."""
    if stage.inputs is None:
        return None
    return tuple(Input(each.stage, each.latest, round(each.max_age_ms * NS_PER_MS)) for each in stage.inputs)


NOT_RUN: Final = (
    "its stages are no blocks and no code of your own: `trilane check` and `predict` take it, `run` does not"
)
NOT_SAID: Final[Mapping[str, Any]] = {}


def tables_of(
    pipeline: Pipeline, run: Mapping[str, Any], times_ms: Mapping[str, float], taken: Mapping[str, Any] = NOT_SAID
) -> dict[str, Any]:
    """Return the tables `run`, `stages` and, if rules differ, `edges` of a pipeline file that describes `pipeline`.

    `run`: keys of the table [run] without `edge` and `latency_to`, which come from the pipeline.
    `times_ms`: mean time of a job of each stage, in ms; a missing stage gets no time.
    `taken`: key `share` or `pattern` that says which frames take the bypass, with its value.
    """
    joints = list(pipeline.joints.values())
    rules = {before.name: edge.rule for (before, _), edge in zip(joints, pipeline.edges, strict=True)}
    sizes = {before.name: edge.payload_bytes for (before, _), edge in zip(joints, pipeline.edges, strict=True)}
    stages: dict[str, dict[str, Any]] = {}
    for place, stage in enumerate(pipeline.stages):
        keys = stages[stage.name] = {"python": stage.factory, "unit": stage.unit}
        if reads := _reads(pipeline, place):
            keys["in"] = reads
        if size := sizes.get(stage.name):
            keys["out"] = f"u8 {size}"
        if stage.every > 1:
            keys["every"] = stage.every
        if stage.name in times_ms:
            keys["time_ms"] = times_ms[stage.name]
    if pipeline.bypass is not None:
        begin, end = pipeline.bypass
        stages[begin]["bypass"] = {"to": end, **taken} if taken else end
    tables = {"run": {**run, "latency_to": pipeline.latency_to or pipeline.stages[-1].name}, "stages": stages}
    if len({*rules.values()}) == 1:
        tables["run"]["edge"] = next(iter(rules.values()))
    elif rules:
        tables["edges"] = rules
    return tables


def _reads(pipeline: Pipeline, place: int) -> str | dict[str, Any] | None:
    """Return the value of the key `in` of the stage at index `place`; None for a stage without inputs.

    In a chain the value is the name of the stage before. In a graph it is a table with a key for each input.
    """
    stage = pipeline.stages[place]
    if stage.inputs is None:
        return pipeline.stages[place - 1].name if place else None
    reads: dict[str, Any] = {}
    for each in stage.inputs:
        reads[each.stage] = each.stage
        if each.latest:
            age = {"max_age_ms": each.max_age_ms} if each.max_age_ms else {}
            reads[each.stage] = {"from": each.stage, "sync": "latest", **age}
    return reads or None


def unsaid(pipeline: Pipeline) -> Iterator[str]:
    """Yield a sentence for each property of the pipeline that a pipeline file cannot state."""
    yield NOT_RUN
    own = max((edge.header.itemsize for edge in pipeline.edges), default=0)
    if own > header_dtype().itemsize:
        yield f"every slot also has a header of {own} bytes: not in this file"
    held = {stage.name: stage.pace_ns for stage in pipeline.stages if stage.pace_ns}
    if held:
        yield f"jobs are held to a least time: {', '.join(f'{name} {ns / 1e6:g} ms' for name, ns in held.items())}"


def file_text(tables: Mapping[str, Any], comments: Sequence[str] = ()) -> str:
    """Return the text of a pipeline file, TOML with one line for each key of a table.

    A stage is one key of the table [stages].

    `tables`: tables of the file, such as from `tables_of`. `comments`: lines before the tables.
    """
    lines = [f"# {each}" for each in comments]
    for name, table in tables.items():
        lines.append(f"[{name}]")
        lines += [f"{key} = {_value(value)}" for key, value in table.items()]
    return "\n".join(lines) + "\n"


def _value(value: object) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_value(each)}" for key, each in value.items()) + " }"
    return quoted(value)


def quoted(value: object) -> str:
    """Return a text, a number, a boolean or a list of them as TOML writes it."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")  # JSON leaves it as it is
