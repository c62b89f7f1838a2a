"""A run of a pipeline file, from its options to its run folder.

`pipeline_of` turns the file into a pipeline for this machine: factories, slots, and the units' cores. `run_file` runs
the pipeline.

Rule: nothing is printed here. The types of all ports are known before a slot is made. Only the units' processes import
the user's code, after a message has named its modules.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Protocol

from trilane.apps.check.port_types import PortTypes, port_types, read_networks, require_weights, value_type
from trilane.apps.run.report import REPORT_FILE, write_report
from trilane.apps.run.report_facts import made_facts, report_of
from trilane.apps.run.run_files import VIDEO, join_folder, write_files
from trilane.apps.run.run_folder import RunFolder, default_place
from trilane.apps.run.run_job import ENDLESS, Hooks, RunOutcome, error_of, exit_code_of, sensors
from trilane.errors import BadInputError, UnwrittenError
from trilane.hw_profiles.graph_file import GraphFile, fed_inputs
from trilane.hw_profiles.host import settings_of, usable_cores
from trilane.machine import require_memory
from trilane.pipeline import journal
from trilane.pipeline.controls import Interrupts, RunControls
from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage, StageInput, UnitSettings
from trilane.pipeline.file_graph import DEFAULT_FRAMES, bypass_of, edge_rules
from trilane.pipeline.file_graph import settings_of as scheduler_settings
from trilane.pipeline.file_keys import (
    BlockStage,
    EncodeBlock,
    OnnxStage,
    PortInput,
    PortType,
    PythonStage,
    StageKeys,
    TimedStage,
    VideoBlock,
    port_type,
)
from trilane.pipeline.pipeline_file import PipelineFile, assignments, read_pipeline, stage_inputs
from trilane.pipeline.result import Failure, JournalFile, RunResult
from trilane.pipeline.run import run_pipeline
from trilane.pipeline.stage import payload_bytes
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.placement import Place
from trilane.signals import INTERRUPTED
from trilane.stages.blocks.video import DEFAULT_FPS, FoundPictures, footage
from trilane.stages.dsp.runtime import resolve
from trilane.stages.machine_facts import machine_facts
from trilane.stages.run_options import RunOptions
from trilane.transport.slots import edge_rule

BLOCKS: Final = "trilane.stages.blocks"
ENCODE: Final = f"{BLOCKS}.video:build_encode"
#: Block -> module in BLOCKS, and factory in it.
FACTORIES: Final = {
    "busy": "own_code:build_load",
    "discard": "own_code:build_load",
    "encode": "video:build_encode",
    "overlay": "pictures:build_overlay",
    "prepare": "pictures:build_prepare",
    "video": "video:build_video",
}
SEGMENTS: Final = "segments"  # folder of the first video's segments, where `trilane.apps.run.run_files` expects it
TOKEN: Final = {"": PortType("u8", (1,))}  # port of a block `busy`, which writes one byte


def pipeline_of(file: PipelineFile, run_folder: Path) -> Pipeline:
    """Return the pipeline that `file` describes, with units on the cores that `cores_of` gives them.

    `run_folder`: folder for the files of the run.
    Raises BadInputError that names the wrong key, and MissingPartError if a runtime is not installed.
    """
    networks = read_networks(file)
    types = _all_types(file, networks)
    rules = edge_rules(file)
    stages = tuple(_stage(file, name, types, networks, run_folder) for name in file.stages)
    if file.bypass is not None:
        stages = _bypassed(file, stages, types, rules)
    edges = tuple(PipelineEdge(payload_bytes=payload_bytes(types[name]), rule=rules[name]) for name in file.readers)
    return Pipeline(
        stages=stages,
        edges=edges,
        units=cores_of(file, usable_cores()),
        latency_to=file.latency_to,
        bypass=bypass_of(file),
        warms_up=False,
        from_release=file.run.fps is not None or file.run.arrivals is not None,
        module_folders=(file.folder.absolute(),),
    )


def preload_of(file: PipelineFile) -> tuple[str, ...]:
    """Return the names of Trilane's modules that the fork server imports for the stages of `file`."""
    made = [_factory(stage) for stage in file.stages.values() if not isinstance(stage, TimedStage)]
    return tuple(dict.fromkeys(factory.partition(":")[0] for factory in made))


def imports_of(file: PipelineFile) -> list[str]:
    """Return the names of the modules of the user's own code that a run of `file` imports, sorted."""
    return sorted({each.python.partition(":")[0] for each in file.stages.values() if isinstance(each, PythonStage)})


def frames_of(file: PipelineFile) -> int:
    """Return the number of frames of a run of `file`.

    The key `run.frames` states the number. Without this key, the run lasts as long as the shortest video. Without a
    video, the number is DEFAULT_FRAMES.
    Raises BadInputError for a video that cannot be read.
    """
    if file.run.frames is not None:
        return file.run.frames
    counts = []
    for stage in file.stages.values():
        if isinstance(stage, VideoBlock) and not stage.is_camera:
            found = _footage_of(file, stage)
            rate = file.run.fps / found.fps if file.run.fps and found.fps else 1.0
            counts += [max(round(found.pictures * rate), 1)] if found.pictures else []
    return min(counts, default=DEFAULT_FRAMES)


def _footage_of(file: PipelineFile, stage: VideoBlock) -> FoundPictures:
    """Return facts about the video that `stage` reads. Raises BadInputError that names the stage's key `path`."""
    try:
        return footage(file.folder / stage.path)
    except BadInputError as error:
        name = next(each for each, one in file.stages.items() if one is stage)
        where = f"{file.path}: stages.{name}.path: {error.where}"
        raise BadInputError(where, error.found, error.expected, error.remedy) from None


def picture_fps(file: PipelineFile) -> float:
    """Return the rate of the videos that a run of `file` writes, in frames a second.

    The key `run.fps` states the rate. Without this key, it is the rate of the first video with a known rate that the
    run reads. Without such a video, it is DEFAULT_FPS. Raises BadInputError for a video that cannot be read.
    """
    if file.run.fps is not None:
        return file.run.fps
    videos = [stage for stage in file.stages.values() if isinstance(stage, VideoBlock) and not stage.is_camera]
    rates = [_footage_of(file, stage).fps for stage in videos]
    return next((rate for rate in rates if rate), DEFAULT_FPS)


def picture_size(pipeline: Pipeline) -> dict[str, dict[str, int]]:
    """Return the size of the pictures that the first block `encode` reads, as {"output": {"width": w, "height": h}}.

    The sides are in pixels. Without a block `encode`, the result is empty.
    """
    for stage in pipeline.stages:
        if stage.factory == ENCODE:
            read = stage.settings["reads"][0]
            height, width, _ = port_type(stage.settings["streams"][read["stream"]][read["port"]]).shape
            return {"output": {"width": width, "height": height}}
    return {}


def with_window(pipeline: Pipeline, window: Path) -> Pipeline:
    """Return a copy of `pipeline` whose first block `encode` also shows the newest picture in the file `window`.

    Without a block `encode`, the copy equals `pipeline`.
    """
    name = next((stage.name for stage in pipeline.stages if stage.factory == ENCODE), "")
    stages = tuple(
        stage
        if stage.name != name
        else stage.model_copy(
            update={"settings": {**stage.settings, "keys": {**stage.settings["keys"], "window": str(window)}}}
        )
        for stage in pipeline.stages
    )
    return pipeline.model_copy(update={"stages": stages})


def segments_of(file: PipelineFile) -> dict[str, str]:
    """Return the name of a folder for the video segments of each block `encode`, by the name of the block's stage."""
    names = [name for name, stage in file.stages.items() if isinstance(stage, EncodeBlock)]
    return {name: f"{SEGMENTS}.{name}" if place else SEGMENTS for place, name in enumerate(names)}


def cores_of(file: PipelineFile, cores: Sequence[int]) -> dict[str, UnitSettings]:
    """Return the cores and the number of threads of each unit of `file`, by the unit's name.

    A unit whose cores the file does not state gets a share of `cores`. These units get one core each, in the order of
    the stages. Remaining cores go to the units among them that run networks, in turn. If there are too few cores, units
    share cores. A unit whose threads the file does not state has one thread for each of its cores.
    `cores`: numbers of the cores that this process may use.
    Raises BadInputError for a core in the file that is not in `cores`.
    """
    open_units = [unit for unit, keys in file.units.items() if keys.cores is None]
    shares: dict[str, list[int]] = {unit: [cores[place % len(cores)]] for place, unit in enumerate(open_units)}
    with_networks = [
        unit
        for unit in open_units
        if any(isinstance(stage, OnnxStage) and stage.unit == unit for stage in file.stages.values())
    ]
    for place, core in enumerate(cores[len(open_units) :] if with_networks else ()):
        shares[with_networks[place % len(with_networks)]].append(core)
    places = {}
    for unit, keys in file.units.items():
        own = tuple(sorted(keys.cores or shares[unit]))
        if absent := set(own) - set(cores):
            found = f"core {', '.join(map(str, sorted(absent)))}"
            expected = f"cores that this process may use: {', '.join(map(str, cores))}"
            raise BadInputError(f"{file.path}: units.{unit}.cores", found, expected, "or leave out `cores`")
        places[unit] = Place(own, keys.threads or len(own))
    return settings_of(places)


def _all_types(file: PipelineFile, networks: Mapping[str, GraphFile]) -> PortTypes:
    """Return the types of the ports that the stages of `file` write, by the name of the stage.

    The types of a stage are a `PortType` for each port, by the name of the port.
    `networks`: networks by stage.
    Raises BadInputError for a camera, for a stage that has a set time and nothing to run, and for a port of unknown
    type.
    """
    types = port_types(file, networks)
    for name, stage in file.stages.items():
        if isinstance(stage, VideoBlock) and stage.is_camera:
            found, expected = "a camera, which a run cannot read yet", "a video or a folder of pictures"
            raise BadInputError(f"{file.path}: stages.{name}.path", found, expected, "record a video of it first")
        if isinstance(stage, TimedStage):
            found, expected = "a time alone, with nothing to run", "onnx, python or block"
            remedy = 'block = "busy" works for a time; `trilane predict` takes times alone'
            raise BadInputError(f"{file.path}: stages.{name}", found, expected, remedy)
        if name in file.readers and name not in types:
            if not isinstance(stage, BlockStage) or stage.block != "busy":
                found, expected = "nothing", "the type of what it writes, such as 'u8 256x256x3'"
                raise BadInputError(f"{file.path}: stages.{name}.out", found, expected, "a run makes its slots by it")
            types[name] = TOKEN
    return types


def _stage(
    file: PipelineFile, name: str, types: PortTypes, networks: Mapping[str, GraphFile], run_folder: Path
) -> PipelineStage:
    stage = file.stages[name]
    streams = stage_inputs(stage)
    inputs = tuple(StageInput(stage=each.stage, latest=each.latest, max_age_ms=each.max_age_ms) for each in streams)
    place_of = {each.stage: place for place, each in enumerate(streams)}
    made = PipelineStage(name=name, unit=stage.unit, factory=_factory(stage), inputs=inputs, every=stage.every)
    settings = {
        "where": f"{file.path.name}: stages.{name}",
        "folder": str(file.folder.absolute()),
        "run_folder": str(run_folder.absolute()),
        "joins": made.joins,
        "reads": [
            {"name": each.port, "stream": place_of[each.stage], "port": _port(file, name, each, types)}
            for each in stage.inputs
        ],
        "streams": [_texts(types[each.stage]) for each in streams],
        "writes": _texts(types.get(name, {})) if name in file.readers else {},
        "keys": _keys(file, name, stage, networks),
    }
    return made.model_copy(update={"settings": settings})


def _bypassed(
    file: PipelineFile, stages: Sequence[PipelineStage], types: PortTypes, rules: Mapping[str, str]
) -> tuple[PipelineStage, ...]:
    """Return `stages` as a chain with the bypass of `file`.

    The stage where the bypass begins gets the keys of the bypass in its settings. The stage where the bypass ends gets
    the ports of the stage where the bypass begins.
    `types`: types of all ports. `rules`: rule of each edge, by the name of the stage that writes to the edge.
    """
    assert file.bypass is not None
    begin, way = file.bypass
    found = []
    for stage in stages:
        settings = dict(stage.settings)
        if stage.name == begin:
            settings["keys"] = {**settings["keys"], "bypass": way.model_dump(mode="json")}
        elif stage.name == way.to:
            own = file.stages[way.to].inputs[0].stage
            settings["bypass"] = {"behind": edge_rule(rules[own]).slots, "ports": _texts(types[begin])}
        found.append(stage.model_copy(update={"inputs": None, "settings": settings}))
    return tuple(found)


def _factory(stage: StageKeys) -> str:
    """Return the factory of a stage, as `module:function`."""
    if isinstance(stage, BlockStage):
        return f"{BLOCKS}.{FACTORIES[stage.block]}"
    return f"{BLOCKS}.{'network' if isinstance(stage, OnnxStage) else 'own_code'}:build"


def _keys(file: PipelineFile, name: str, stage: StageKeys, networks: Mapping[str, GraphFile]) -> dict[str, Any]:
    """Return the keys of `stage` that only its kind of stage has, with facts from other tables of `file`.

    `name`: name of the stage. `networks`: networks by stage.
    Raises BadInputError for a network without weights or with an input that is not numbers, and for a video that cannot
    be read. Raises MissingPartError if a runtime is not installed.
    """
    common = set(StageKeys.model_fields)
    keys: dict[str, Any] = {
        key: value for key, value in stage.model_dump(mode="json").items() if key not in common and value is not None
    }
    if isinstance(stage, OnnxStage):
        resolve(stage.runtime)
        graph = networks[name]
        values = [(value.name, value_type(value)) for value in fed_inputs(graph)]
        require_weights(graph, f"{file.path}: stages.{name}.onnx")
        keys["inputs"] = {}
        for each, found in values:
            if found is None:
                odd, remedy = f"an input {each!r} of no numbers", "export it with inputs of numbers alone"
                raise BadInputError(f"{file.path}: stages.{name}.onnx", odd, "numbers", remedy)
            keys["inputs"][each] = str(found)
    elif isinstance(stage, VideoBlock):
        keys["fps"] = file.run.fps
    elif isinstance(stage, EncodeBlock):
        keys |= {"fps": picture_fps(file), "segments": segments_of(file)[name]}
    return keys


def _port(file: PipelineFile, name: str, each: PortInput, types: PortTypes) -> str:
    """Return the name of the port that input `each` of stage `name` reads.

    `file`: pipeline file, which errors name. `types`: types of all ports.
    Raises BadInputError if the input names a port that does not exist, or names none although there are several.
    """
    ports = types[each.stage]
    if each.from_port or len(ports) == 1:
        chosen = each.from_port or next(iter(ports))
        if chosen in ports:
            return chosen
    where = f"{file.path}: stages.{name}.in" + (f".{each.port}" if each.port else "")
    found = f"{each.stage!r}, which has the ports {', '.join(ports)}"
    raise BadInputError(where, found, "one of them", f"write '{each.stage}.{next(iter(ports))}'")


def _texts(ports: Mapping[str, PortType]) -> dict[str, str]:
    return {name: str(port) for name, port in ports.items()}


AUTO: Final = "auto"
#: Options that replace the key of the same name in [run] of the file.
OF_THE_RUN: Final = ("frames", "fps", "policy", "edge")
#: All options that may stand beside a pipeline file.
TAKEN: Final = (*OF_THE_RUN, "runtime", "changes", "out")


class Watch(Protocol):
    """A viewer that shows a run and steers the run.

    A watched run lasts until the viewer ends it, unless the option `frames` or the file's key `arrivals` limits the
    number of frames.
    `controls`: requests of the viewer to the run.
    """

    controls: RunControls

    def begins(self, folder: Path, pipeline: Pipeline, facts: Mapping[str, Any]) -> Path:
        """Take note of a run that begins, and return the path of the window that will show the run's pictures.

        The call comes before the units start. `folder`: folder that will contain the journal. `pipeline`: pipeline of
        the run. `facts`: blocks `config`, `machine` and `made` of the report.
        """


def run_file(
    options: RunOptions,
    hooks: Callable[[], AbstractContextManager[Hooks]],
    command: tuple[str, ...] = (),
    watch: Watch | None = None,
) -> RunOutcome:
    """Check the options and the pipeline file, run the pipeline, and leave its run folder.

    `options`: options of the run; `options.scene` is the path of the pipeline file.
    `hooks`, `command`: see `trilane.apps.run.asked_run.run_asked`, which raises the same errors.
    `watch`: viewer of the run; None if nobody watches the run.
    """
    file = asked_file(options)
    require_memory()
    target = options.out or default_place(file.path.stem)
    with RunFolder(target) as folder:
        pipeline = pipeline_of(file, folder.work)
        frames = options.frames or frames_of(file)
        with UnitStarter(preload_of(file)) as starter, hooks() as told:
            if modules := imports_of(file):
                told.message(f"own code: {', '.join(modules)} of {file.folder.absolute()} is imported and run")
            return _run(_Asked(options, file, pipeline, frames, command, watch), folder, told, starter)


def asked_file(options: RunOptions) -> PipelineFile:
    """Return the pipeline file that `options` name, with the keys that `options` change.

    Raises BadInputError for a wrong file or change, and for an option that only scenes have.
    """
    for name in sorted(options.model_fields_set - {"scene", *TAKEN}):
        known = ", ".join(RunOptions.spelling(each) for each in TAKEN)
        found = f"{RunOptions.spelling(name)} with a pipeline file"
        raise BadInputError("options", found, f"one of {known}", "it is an option of the avatar's scenes")
    file = read_pipeline(Path(options.scene))
    given = {name: getattr(options, name) for name in TAKEN if name in options.model_fields_set}
    asked = [f"run.{name}={given[name]}" for name in OF_THE_RUN if given.get(name)]
    if (runtime := given.get("runtime", AUTO)) != AUTO:
        asked += [f"stages.{name}.runtime={runtime}" for name, one in file.stages.items() if isinstance(one, OnnxStage)]
    return file.changed([*asked, *(each for text in options.changes for each in assignments(text))])


class _Asked:
    """A checked run of a pipeline file, with the settings of its scheduler and facts for its report.

    `options`, `file`, `pipeline`: options of the run, file that they name, and pipeline that follows from the file.
    `watch`: viewer of the run; None if nobody watches the run.
    `settings`: settings of the scheduler. `config`, `machine`, `made`: blocks of report.json.
    """

    def __init__(
        self,
        options: RunOptions,
        file: PipelineFile,
        pipeline: Pipeline,
        frames: int,
        command: tuple[str, ...],
        watch: Watch | None,
    ) -> None:
        self.options, self.file, self.pipeline, self.watch = options, file, pipeline, watch
        is_endless = watch is not None and not options.frames and file.run.arrivals is None
        self.settings = scheduler_settings(file, ENDLESS if is_endless else frames)
        self.machine, self.made = machine_facts(), made_facts(command)
        units = {unit: each.model_dump(mode="json") for unit, each in pipeline.units.items()}
        self.config: dict[str, Any] = {
            "pipeline": {"file": str(file.path), **{name: dict(table) for name, table in file.tables.items()}},
            "scene": {"name": file.path.stem, "fps": picture_fps(file), "frames": frames, **picture_size(pipeline)},
            "units": units,
            "policy": self.settings.policy,
            "edge": pipeline.rule,
        }


def _run(asked: _Asked, folder: RunFolder, told: Hooks, starter: UnitStarter) -> RunOutcome:
    config, file = asked.config, asked.file
    facts = {"config": config, "machine": asked.machine, "made": asked.made}
    pipeline, watch = asked.pipeline, asked.watch
    if watch is not None:
        pipeline = with_window(pipeline, watch.begins(folder.work, pipeline, facts))
    try:
        result = run_pipeline(
            pipeline,
            asked.settings.frames,
            fps=asked.config["scene"]["fps"],
            settings=asked.settings,
            journal=JournalFile(folder.work / journal.NAME, facts, sensors),
            controls=None if watch is None else watch.controls,
            starter=starter,
            on_progress=lambda presented, requested: told.progress(asked.settings.policy, presented, requested),
            on_message=told.message,
        )
    except KeyboardInterrupt:
        said = "interrupted: nothing was written"
        told.message(said)
        raise KeyboardInterrupt(said) from None
    if not result.presented:
        if result.interrupted:
            raise KeyboardInterrupt
        raise error_of(result)
    with Interrupts() as late:  # from here on a signal waits until the folder is whole
        written, result = _written(file, folder.work, config["scene"]["fps"], result)
        folder.release()
        options = {name: asked.options.as_json()[name] for name in ("scene", *TAKEN)}
        known = {"made": asked.made, "options": options, **written}
        report = report_of(result, config, machine=asked.machine, facts=known)
        write_report(report, folder.work / REPORT_FILE)
        place = folder.complete()
    return RunOutcome(report, place, INTERRUPTED if late.count else exit_code_of(result))


def _written(file: PipelineFile, work: Path, fps: float, result: RunResult) -> tuple[dict[str, Any], RunResult]:
    """Write the files of the run folder `work`, and copy the videos to the paths that the pipeline file names.

    Return (facts for the report, `result`). If a file of the run folder is incomplete, the returned `result` has a
    failure that says so.
    `file`: pipeline file of the run. `fps`: rate of the videos, in frames a second.
    Raises BadInputError for a broken journal, or for a path of a video that cannot be written.
    """
    segments = segments_of(file)
    videos = {name: work / (VIDEO if place == 0 else f"{name}.mp4") for place, name in enumerate(segments)}
    encoded = {name: min(result.report.stages[name].jobs, 1) for name in videos}
    failed: UnwrittenError | None = None
    for name, video in videos.items():
        if video.name != VIDEO:
            _, removed = join_folder(work / segments[name], video, fps, encoded[name])
            failed = failed or removed
            shutil.rmtree(work / segments[name], ignore_errors=True)
    facts, unwritten = write_files(work, fps, next(iter(encoded.values()), 0))
    if failed := failed or unwritten:
        result = replace(result, failure=result.failure or Failure(str(failed)))
    for name, video in videos.items():
        stage = file.stages[name]
        assert isinstance(stage, EncodeBlock)
        if video.exists():
            _copied(video, file.folder / stage.path)
    return facts, result


def _copied(video: Path, target: Path) -> None:
    """Copy `video` to `target`. An incomplete copy has another name. Raises BadInputError if writing fails."""
    partial = target.with_name(f"{target.name}.partial")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(video, partial)
        partial.replace(target)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise BadInputError.of_os_error(target, error, "a place for the video", "change `path` of the stage") from None
