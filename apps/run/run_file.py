"""A run of a pipeline file as somebody asked for it, from options to a run folder.

Rule: nothing is printed here. The modules of the file's own code are named before any of them is imported.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Protocol

from trilane.apps.run.file_pipeline import (
    frames_of,
    imports_of,
    picture_fps,
    picture_size,
    pipeline_of,
    preload_of,
    segments_of,
    with_window,
)
from trilane.apps.run.report import write_report
from trilane.apps.run.report_facts import made_facts, report_of
from trilane.apps.run.run_files import VIDEO, join_folder, write_files
from trilane.apps.run.run_folder import RunFolder, default_place
from trilane.apps.run.run_job import ENDLESS, Hooks, RunOutcome, error_of, exit_code_of, sensors
from trilane.errors import BadInputError, UnwrittenError
from trilane.machine import require_memory
from trilane.pipeline import journal
from trilane.pipeline.controls import Interrupts, RunControls
from trilane.pipeline.description import Pipeline
from trilane.pipeline.file_graph import settings_of
from trilane.pipeline.file_keys import EncodeBlock, OnnxStage
from trilane.pipeline.pipeline_file import PipelineFile, assignments, read_pipeline
from trilane.pipeline.result import Failure, JournalFile, RunResult
from trilane.pipeline.run import HANG_NS, run_pipeline
from trilane.pipeline.unit_starter import UnitStarter
from trilane.stages.machine_facts import machine_facts
from trilane.stages.run_options import RunOptions

AUTO: Final = "auto"
#: Options of a run that stand for keys of [run] of a pipeline file, and all that it takes beside the file itself.
OF_THE_RUN: Final = ("frames", "fps", "policy", "edge")
TAKEN: Final = (*OF_THE_RUN, "runtime", "changes", "out")


class Watch(Protocol):
    """Somebody who watches a run and steers it, until it is told to end if the options say no number of frames.

    `controls`: requests to the run.
    """

    controls: RunControls

    def begins(self, folder: Path, pipeline: Pipeline, facts: Mapping[str, Any]) -> Path:
        """Hear that a run begins, before its units start, and return the window for its pictures.

        `folder`: folder that the run's journal will be in. `facts`: `config` and `machine` of the report.
        """


def run_file(
    options: RunOptions,
    hooks: Callable[[], AbstractContextManager[Hooks]],
    command: tuple[str, ...] = (),
    watch: Watch | None = None,
) -> RunOutcome:
    """Check the options and the pipeline file, run it and leave its run folder.

    `hooks`, `command`, and the errors raised: as in `trilane.apps.run.asked_run.run_asked`. `watch`: who watches.
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
    """Return the checked file with what the options change. Raises BadInputError, also for an option of a scene."""
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
    """A run that was asked for, and what its report says of it."""

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
        self.settings = settings_of(file, ENDLESS if is_endless else frames, hang_ns=HANG_NS)
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
        write_report(report, folder.work / "report.json")
        place = folder.complete()
    return RunOutcome(report, place, 130 if late.count else exit_code_of(result))


def _written(file: PipelineFile, work: Path, fps: float, result: RunResult) -> tuple[dict[str, Any], RunResult]:
    """Write the files of the folder and the file's own videos; return what the report says of them, and the result."""
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
    """Copy a video to its place, which is whole at any time. Raises BadInputError where it cannot be written."""
    partial = target.with_name(f"{target.name}.partial")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(video, partial)
        partial.replace(target)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise BadInputError.of_os_error(target, error, "a place for the video", "change `path` of the stage") from None
