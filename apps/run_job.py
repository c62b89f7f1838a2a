"""One run from a checked configuration to a complete run folder.

Rule: whatever the units did, what is in the folder is whole: a run that was interrupted or failed says so in its
report and keeps the frames that were presented; a run that presented none leaves no folder. A run that could not
write on leaves what it wrote in a folder that is not whole (run_folder.py).
"""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trilane import machine
from trilane.apps.report import Report, build_report, config_facts, write_report
from trilane.apps.resolution import resolution_note, resolution_of
from trilane.apps.run_check import asked_frames, check_run
from trilane.apps.run_folder import RunFolder
from trilane.errors import TrilaneError
from trilane.hw_profiles.governor import Governor
from trilane.hw_profiles.load import load_runnable
from trilane.pipeline import journal
from trilane.pipeline.controls import RunControls
from trilane.pipeline.result import RunResult
from trilane.pipeline.run_record import JournalFile
from trilane.pipeline.signals import Interrupts
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.policy import policy_named
from trilane.stages.avatar_pipeline import run_avatar
from trilane.stages.configure import Checked
from trilane.stages.placing import placed
from trilane.stages.run_options import RunOptions

if TYPE_CHECKING:
    from trilane.apps.pace import Pace

BASELINE_POLICY = "sequential"
HOST = "host"
INTERRUPTED = 130
NO_VIDEO = "no video, no contact sheet and no checksum: the frames were presented without, as was asked for"


@dataclass(frozen=True)
class Prepared:
    """A run whose options were checked.

    `checked`: configuration that follows from `options`.
    `pace`: chip's pace at which jobs are held; None: as fast as it goes.
    `command`: words by which the run was asked for.
    """

    options: RunOptions
    checked: Checked
    pace: Pace | None = None
    command: tuple[str, ...] = ()


@dataclass(frozen=True)
class Hooks:
    """Who is told. `progress(what, presented, requested)`; `message(text)`."""

    progress: Callable[[str, int, int], None]
    message: Callable[[str], None]


@dataclass(frozen=True)
class Watched:
    """A run that somebody looks at and steers while it goes on.

    `frames`: how many; None: the scene's. `window`: to look through (`trilane.transport.live_window`).
    `controls`: what is asked of it. `begins(folder, checked)`: called when its units are placed, before they start.
    """

    frames: int | None
    window: Path
    controls: RunControls
    begins: Callable[[Path, Checked], None]


@dataclass(frozen=True)
class Outcome:
    """`report` as written, `folder` that holds it, and the exit code that the run asks for."""

    report: Report
    folder: Path
    exit_code: int


def run_to_folder(
    prepared: Prepared,
    target: Path,
    hooks: Hooks,
    *,
    machine: Mapping[str, Any],
    made: Mapping[str, Any] | None = None,
    starter: UnitStarter | None = None,
    watched: Watched | None = None,
) -> Outcome:
    """Run what was prepared and leave the run folder at `target`.

    `target`: must not exist yet.
    `hooks`: who is told.
    `machine`: what `machine_facts` said.
    `made`: what `trilane.apps.made.made_facts` said of the command line; None where there is none.
    `starter`: a fork server that was started earlier; without one, the units stay where they were prepared.
    `watched`: by whom; None: by nobody.
    Raises BadInputError when `target` cannot be written, and TrilaneError when no frame was presented or the folder,
    which stays then, could not be written on.
    """
    options, checked, pace = prepared.options, prepared.checked, prepared.pace
    with RunFolder(target) as folder:
        if starter is not None:
            checked = placed(checked, options.policy, starter, str(machine.get("gl")), hooks.message)
            hooks.message(checked.notes[-1])
        if watched is not None:
            checked = checked.changed(window=watched.window)
            watched.begins(folder.work, checked)
        threading.Thread(target=_import_writers, name="imports", daemon=True).start()
        job = _Job(replace(prepared, checked=checked), hooks, starter, watched)
        result = job.run(
            folder.work,
            {
                "config": config_facts(checked.config, options.policy, options.edge),
                "machine": machine,
                "made": made,
                "accuracy": dict(checked.accuracy),
            },
        )
        with Interrupts() as late:  # from here on a signal waits until the folder is whole
            baseline, stopped = job.run_baseline(folder.work) if _is_complete(result) else (None, False)
            facts = {
                "made": made,
                "options": options.as_json(),
                "accuracy": dict(checked.accuracy),
                "notes": _notes(checked),
            }
            if checked.placement is not None:
                facts["placement"] = checked.placement
            if result.rungs:
                facts["resolution"] = resolution_of(result.rungs, result.rung_switches, checked.config, checked.losses)
            if pace is not None:
                from trilane.apps.pace import compare

                scene = checked.config.scene
                records = journal.read_journal(folder.work / journal.NAME)
                jobs = [record.job for record in records if isinstance(record, journal.Worked)]
                facts["pace"] = compare(pace, options.policy, scene.frames, jobs, edge=options.edge, fps=scene.fps)
            if options.check:
                ended = lambda: result.interrupted or stopped or late.count > 0  # noqa: E731
                facts |= _checked_frames(checked, folder.work, hooks, ended)
            facts |= _write_files(folder.work, checked.config.scene.fps)
            report = build_report(result, checked.config, machine=machine, baseline=baseline, facts=facts)
            _tell(report, hooks)
            write_report(report, folder.work / "report.json")
            place = folder.complete()
        return Outcome(report, place, INTERRUPTED if stopped or late.count else _exit_code(result))


class _Job:
    """The runs of one job: the one that was asked for, and the sequential one to compare with."""

    def __init__(self, prepared: Prepared, hooks: Hooks, starter: UnitStarter | None, watched: Watched | None) -> None:
        self._options, self._checked, self._pace = prepared.options, prepared.checked, prepared.pace
        self._hooks, self._starter, self._watched = hooks, starter, watched

    def run(self, folder: Path, facts: Mapping[str, Any]) -> RunResult:
        """The run that was asked for, with its journal, which begins with `facts`.

        Raises TrilaneError when it ended before any frame was presented.
        """
        file, watched = JournalFile(folder / journal.NAME, facts, _sensors), self._watched
        frames, controls = (None, None) if watched is None else (watched.frames, watched.controls)
        total = frames or self._checked.config.scene.frames
        kept = asked_frames(total, self._options.check) if self._options.check else ()
        return self._run(folder, self._options, frames, file, controls, kept)

    def run_baseline(self, folder: Path) -> tuple[RunResult | None, bool]:
        """The first frames of the same scene again, one frame at a time; its pictures are not kept.

        None when it was not asked for or did not complete; and whether it was interrupted.
        """
        if not self._options.baseline_frames or self._options.policy == BASELINE_POLICY:
            return None, False
        place = folder / BASELINE_POLICY
        place.mkdir()
        frames = min(self._options.baseline_frames, self._checked.config.scene.frames)
        try:
            result = self._run(place, self._options.changed(policy=BASELINE_POLICY, latch_ms=0.0), frames)
        except KeyboardInterrupt:
            self._hooks.message(f"interrupted: the {BASELINE_POLICY} run to compare with is left out")
            return None, True
        except TrilaneError as error:
            self._hooks.message(f"the {BASELINE_POLICY} run to compare with failed and is left out: {error}")
            return None, False
        finally:
            shutil.rmtree(place)
        return (result if _is_complete(result) else None), result.interrupted

    def _run(
        self,
        folder: Path,
        options: RunOptions,
        frames: int | None,
        file: JournalFile | None = None,
        controls: RunControls | None = None,
        kept: tuple[int, ...] = (),
    ) -> RunResult:
        policy, profile = options.policy, options.performance_profile
        result = run_avatar(
            self._checked.config.model_copy(update={"out_dir": folder, "kept": kept}),
            self._checked.assets,
            policy=policy,
            edge=options.edge,
            frames=frames,
            pace_fps=self._release_fps(policy),
            latch_ms=options.latch_ms,
            governor=None if profile is None else Governor(load_runnable(HOST), profile),
            journal=file,
            controls=controls,
            starter=self._starter,
            on_progress=lambda presented, requested: self._hooks.progress(policy, presented, requested),
            on_message=self._hooks.message,
        )
        if result.presented:
            return result
        if result.interrupted:
            raise KeyboardInterrupt
        raise _error_of(result)

    def _release_fps(self, policy: str) -> float | None:
        """At a chip's pace, the rate of policies that need one; else they have the scene's."""
        if self._pace is None or not policy_named(policy).paced:
            return None
        from trilane.apps.pace import release_fps

        return release_fps(self._pace, self._checked.config.scene.fps)


def _checked_frames(checked: Checked, work: Path, hooks: Hooks, interrupted: Callable[[], bool]) -> dict[str, Any]:
    """`check` of the report, or `notes` that say why there is none. Whoever interrupts does not wait for it."""

    def told(done: int, of: int) -> None:
        hooks.progress("check", done, of)
        _require(not interrupted())

    try:
        _require(not interrupted())
        return {"check": check_run(checked, work, told)}
    except TrilaneError as error:
        said = f"the run's frames were not compared: {error}"
        hooks.message(said)
        return {"notes": [*_notes(checked), said]}
    finally:
        from trilane.stages.cpu.present import KEPT_FOLDER

        shutil.rmtree(work / KEPT_FOLDER, ignore_errors=True)


def _require(wanted: bool) -> None:
    if not wanted:
        raise TrilaneError("it was interrupted")


def _notes(checked: Checked) -> list[str]:
    return [*checked.notes, *([] if checked.config.record else [NO_VIDEO])]


def _sensors() -> dict[str, float]:
    """What is looked at in passing."""
    celsius = machine.here.sensor_c()
    return {} if celsius is None else {"temperature_c.sensor": celsius}


def _is_complete(result: RunResult) -> bool:
    return not result.interrupted and result.failure is None


def _error_of(result: RunResult) -> TrilaneError:
    failure = result.failure
    error = TrilaneError(failure.message if failure else "no frame was presented: " + "; ".join(result.messages))
    error.exit_code = failure.exit_code if failure else error.exit_code
    return error


def _exit_code(result: RunResult) -> int:
    if result.interrupted:
        return INTERRUPTED
    return 0 if result.failure is None else result.failure.exit_code


def _tell(report: Report, hooks: Hooks) -> None:
    """What a person should not have to find in the report."""
    if report.video is not None and report.video.frames < report.frames.presented:
        shown = f"{report.video.frames} of {report.frames.presented} frames"
        hooks.message(f"video.mp4 holds {shown}: a writer was killed before its last")
    if report.resolution is not None and (stepped := resolution_note(report.resolution)):
        hooks.message(stepped)
    if report.stage_metrics.get("pose", {}).get("visible") == 0:
        hooks.message("no avatar was in the picture in any frame")


def _import_writers() -> None:
    """What `_write_files` needs, imported while the units start and this process waits for them."""
    from trilane.apps import journal_files, video  # noqa: F401
    from trilane.stages.cpu import present  # noqa: F401


def _write_files(work: Path, fps: float) -> dict[str, Any]:
    """Everything but the report; what the report says of it."""
    from trilane.apps.journal_files import write_from_journal
    from trilane.apps.video import contact_sheet, join_segments, run_checksum
    from trilane.stages.cpu.present import SEGMENTS

    segments = work / SEGMENTS
    facts: dict[str, Any] = {"video": None, "checksum": None}
    if segments.is_dir():
        joined = join_segments(sorted(segments.glob("*.mp4")), work / "video.mp4", fps)
        facts["checksum"] = run_checksum(sorted(segments.glob("*.sha256")))
        if joined is not None:
            facts["video"] = {"frames": joined.frames, "seconds": joined.seconds}
            contact_sheet(work / "video.mp4", work / "contact.png", fps)
        shutil.rmtree(segments)
    write_from_journal(work / journal.NAME, work)
    return facts
