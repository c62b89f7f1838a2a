"""One run of a scene, from a checked configuration to a complete run folder, and the check of its frames.

Rule: a run folder is complete. If a run was interrupted or failed, its report says so, and the folder has the frames
that were presented before. A run without a presented frame leaves no folder.

`check_run` compares losslessly stored pictures of the run with pictures of two kinds. The truth is the clothed body
that the avatar was trained on. The float path is computed without quantisation, GPU raster and plan. The difference
from the float path is therefore the image error that these three cause.
"""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np

from trilane import machine
from trilane.apps.run.report import REPORT_FILE, Report, write_report
from trilane.apps.run.report_facts import avatar_report, config_facts, resolution_note, resolution_of
from trilane.apps.run.run_folder import RunFolder
from trilane.arrays import F64, U8, Mask
from trilane.bench.lib.picture_error import psnr_of_frames, require_metrics
from trilane.errors import TrilaneError, require
from trilane.hw_profiles.governor import Governor
from trilane.hw_profiles.profile_files import load_runnable
from trilane.pipeline import journal
from trilane.pipeline.controls import Interrupts, RunControls
from trilane.pipeline.result import Failure, JournalFile, RunResult
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.policy import policy_named
from trilane.signals import INTERRUPTED
from trilane.stages.avatar_pipeline import run_avatar
from trilane.stages.configure import Checked
from trilane.stages.placing import placed
from trilane.stages.run_options import RunOptions
from trilane.units import HOST

if TYPE_CHECKING:
    from trilane.apps.experiments.picture_errors import ErrorFigures
    from trilane.apps.run.pace import Pace
    from trilane.avatars.bundle import Bundle

BASELINE_POLICY = "sequential"
ENDLESS = 1_000_000_000  # frames of a watched run that no number limits: a year at 30 frames a second
NO_VIDEO = "no video, no contact sheet and no checksum: the frames were presented without, as was asked for"
TRUTH = "the truth: the clothed body that the avatar was trained on"
FLOAT_PATH = "the float path: float64 body and raster, FP32 network"
STEPS = 255


@dataclass(frozen=True)
class Prepared:
    """A run whose options are checked.

    `options`: options of the run. `checked`: configuration that follows from the options.
    `pace`: pace of a chip that the jobs keep; None for a run at full speed.
    `command`: words of the command line.
    """

    options: RunOptions
    checked: Checked
    pace: Pace | None = None
    command: tuple[str, ...] = ()


@dataclass(frozen=True)
class Hooks:
    """Callbacks of a run.

    `progress(what, done, total)`: function that gets the number of frames done and of all frames. `what` is the policy
    during a run, and `check` during the check.
    `message(text)`: function that gets messages for a person.
    """

    progress: Callable[[str, int, int], None]
    message: Callable[[str], None]


@dataclass(frozen=True)
class Watched:
    """The viewer of a live run, which shows and steers the run.

    `frames`: number of frames; None for the scene's number.
    `window`: path of the window (`trilane.transport.live_window`) that shows the run's newest picture.
    `controls`: requests of the viewer to the run.
    `begins(folder, checked)`: function that is called after the units are placed and before they start. It gets the
    folder that will contain the journal, and the configuration of the run.
    """

    frames: int | None
    window: Path
    controls: RunControls
    begins: Callable[[Path, Checked], None]


@dataclass(frozen=True)
class RunOutcome:
    """How a run ended. `report`: written report. `folder`: run folder. `exit_code`: exit code for the command."""

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
) -> RunOutcome:
    """Do the prepared run and leave the run folder at `target`.

    `prepared`: run whose options are checked.
    `target`: path of a folder that does not exist yet.
    `hooks`: callbacks of the run.
    `machine`: result of `machine_facts`.
    `made`: result of `trilane.apps.run.report_facts.made_facts`; None for a run without a command line.
    `starter`: fork server that runs already; None if the units shall not be placed on cores for this run.
    `watched`: viewer of the run; None if nobody watches the run.
    Raises BadInputError if `target` cannot be written. Raises TrilaneError if no frame was presented, KeyboardInterrupt
    if an interruption was the cause. Raises TrilaneError if a file could not be written; the message then names the
    folder in which the written files stay.
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
            facts: dict[str, Any] = {
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
                from trilane.apps.run.pace import compare

                scene = checked.config.scene
                records = journal.read_journal(folder.work / journal.NAME)
                jobs = [record.job for record in records if isinstance(record, journal.Worked)]
                facts["pace"] = compare(pace, options.policy, scene.frames, jobs, edge=options.edge, fps=scene.fps)
            if options.check:
                ended = lambda: result.interrupted or stopped or late.count > 0  # noqa: E731
                facts |= _checked_frames(checked, folder.work, hooks, ended)
            from trilane.apps.run.run_files import write_files

            is_encoded = "encode_ms" in result.metrics.get("present", {})
            recorded = result.presented if is_encoded else 0
            files, unwritten = write_files(folder.work, checked.config.scene.fps, recorded)
            facts |= files
            if unwritten is not None:
                result = replace(result, failure=result.failure or Failure(str(unwritten)))
            folder.release()
            result = _renamed(result, folder.named)
            report = avatar_report(result, checked.config, machine=machine, baseline=baseline, facts=facts)
            _tell(report, hooks)
            write_report(report, folder.work / REPORT_FILE)
            place = folder.complete()
        return RunOutcome(report, place, INTERRUPTED if stopped or late.count else exit_code_of(result))


def _renamed(result: RunResult, named: Callable[[str], str]) -> RunResult:
    """Return `result` with texts that name the final run folder.

    `named`: function that replaces the temporary path in a text, `RunFolder.named`.
    """
    failure = result.failure and replace(result.failure, message=named(result.failure.message))
    return replace(result, failure=failure, messages=tuple(map(named, result.messages)))


class _Job:
    """Does the prepared run, and after it the baseline, which is a `sequential` run of the same scene."""

    def __init__(self, prepared: Prepared, hooks: Hooks, starter: UnitStarter | None, watched: Watched | None) -> None:
        self._options, self._checked, self._pace = prepared.options, prepared.checked, prepared.pace
        self._hooks, self._starter, self._watched = hooks, starter, watched

    def run(self, folder: Path, facts: Mapping[str, Any]) -> RunResult:
        """Do the prepared run in `folder`, and write its journal, which begins with `facts`.

        If no frame was presented, raises KeyboardInterrupt after an interruption, and TrilaneError for another cause.
        """
        file, watched = JournalFile(folder / journal.NAME, facts, sensors), self._watched
        frames, controls = (None, None) if watched is None else (watched.frames, watched.controls)
        total = frames or self._checked.config.scene.frames
        kept = asked_frames(total, self._options.check) if self._options.check else ()
        return self._run(folder, self._options, frames, file, controls, kept)

    def run_baseline(self, folder: Path) -> tuple[RunResult | None, bool]:
        """Run the first frames of the scene again, one frame at a time, in a folder that is removed afterwards.

        Return (result, whether the baseline was interrupted). The result is None if no baseline was requested, if the
        run itself was `sequential`, or if the baseline did not complete.
        """
        if not self._options.baseline_frames or self._options.policy == BASELINE_POLICY:
            return None, False
        place = folder / BASELINE_POLICY
        frames = min(self._options.baseline_frames, self._checked.config.scene.frames)
        try:
            place.mkdir()
            result = self._run(place, self._options.changed(policy=BASELINE_POLICY, latch_ms=0.0), frames)
        except KeyboardInterrupt:
            self._hooks.message(f"interrupted: the {BASELINE_POLICY} run to compare with is left out")
            return None, True
        except (TrilaneError, OSError) as error:
            self._hooks.message(f"the {BASELINE_POLICY} run to compare with failed and is left out: {error}")
            return None, False
        finally:
            shutil.rmtree(place, ignore_errors=True)
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
        raise error_of(result)

    def _release_fps(self, policy: str) -> float | None:
        """Return the rate at which `policy` releases frames, in frames a second; None for the policy's usual rate.

        A rate is only returned for a paced policy in a run at a chip's pace.
        """
        if self._pace is None or not policy_named(policy).paced:
            return None
        from trilane.apps.run.pace import release_fps

        return release_fps(self._pace, self._checked.config.scene.fps)


def _checked_frames(checked: Checked, work: Path, hooks: Hooks, interrupted: Callable[[], bool]) -> dict[str, Any]:
    """Check the run's frames, and return {"check": block `check` of the report}.

    If the check fails or is interrupted, return {"notes": the notes of the report, and a last note that says why}.
    `checked`: configuration of the run. `work`: run folder; its lossless pictures are removed after the check.
    `hooks`: callbacks of the run. `interrupted`: function that returns whether the check shall end; it is called before
    the check and after each frame.
    """

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


def sensors() -> dict[str, float]:
    """Return the figures that the journal samples during a run: the sensor's temperature in °C.

    Without a sensor, the result is empty.
    """
    celsius = machine.here.sensor_c()
    return {} if celsius is None else {"temperature_c.sensor": celsius}


def _is_complete(result: RunResult) -> bool:
    return not result.interrupted and result.failure is None


def error_of(result: RunResult) -> TrilaneError:
    failure = result.failure
    error = TrilaneError(failure.message if failure else "no frame was presented: " + "; ".join(result.messages))
    error.exit_code = failure.exit_code if failure else error.exit_code
    return error


def exit_code_of(result: RunResult) -> int:
    if result.interrupted:
        return INTERRUPTED
    return 0 if result.failure is None else result.failure.exit_code


def _tell(report: Report, hooks: Hooks) -> None:
    """Send messages about frames that the video lacks, smaller tensors, and a run in which no avatar was visible."""
    if report.video is not None and report.video.frames < report.frames.presented:
        shown = f"{report.video.frames} of {report.frames.presented} frames"
        hooks.message(f"video.mp4 holds {shown}: a writer was killed before its last")
    if report.resolution is not None and (stepped := resolution_note(report.resolution)):
        hooks.message(stepped)
    if report.stage_metrics.get("pose", {}).get("visible") == 0:
        hooks.message("no avatar was in the picture in any frame")


def _import_writers() -> None:
    """Import the modules that write the run folder's files, while the units start."""
    from trilane.apps.run import run_files  # noqa: F401


def asked_frames(total: int, count: int) -> tuple[int, ...]:
    """Return the numbers of at most `count` frames, evenly spread over the frames 0 to `total` - 1."""
    number = min(count, total)
    return tuple((2 * index + 1) * total // (2 * number) for index in range(number))


def require_parts(bundles: Iterable[Bundle]) -> None:
    """Raise MissingPartError if the check of a run with the avatars `bundles` needs a library that is not installed."""
    from trilane.bench.lib.full_picture import require_float_network

    require([require_metrics, *(partial(require_float_network, bundle) for bundle in bundles)])


def check_run(checked: Checked, folder: Path, told: Callable[[int, int], None] = lambda *_: None) -> dict[str, Any]:
    """Compare the pictures stored in `folder` with the truth and the float path; return the report's block `check`.

    Only bundled avatars have a truth. Without it, the pictures are compared with the float path alone.
    Frames without a visible avatar are left out. The figures count the region that contains the avatars. The IoU
    compares masks of the pixels that differ from the background.
    `checked`: configuration of the run. `folder`: run folder with the stored pictures.
    `told(done, total)`: function that gets the number of frames done and of all frames, after each frame.
    Raises TrilaneError if no stored frame shows an avatar, MissingPartError if a library is not installed, and
    BadInputError if an avatar cannot be read.
    """
    from trilane.apps.experiments.picture_errors import figures
    from trilane.apps.experiments.reference_path import ReferencePath
    from trilane.apps.experiments.scene_pictures import around
    from trilane.bench.lib.full_picture import true_pictures
    from trilane.stages.cpu.present import kept_frames

    files = kept_frames(folder)
    numbers: list[int] = []
    found: dict[str, list[ErrorFigures]] = {}
    path = ReferencePath(checked) if files else None
    true = true_pictures(path.cast, path.gl) if path is not None else None
    for done, (number, file) in enumerate(files.items()):
        assert path is not None
        moment = path.moment(number)
        if moment.boxes:
            numbers.append(number)
            picture, part = np.load(file, allow_pickle=False), around(moment.boxes, path.output)
            wanted = {} if true is None else {TRUTH: true.frame(number, moment.background) / STEPS}
            for against, other in {**wanted, FLOAT_PATH: moment.frame(frozenset()).picture}.items():
                masks = [differs(image, moment.background) for image in (picture, _bytes(other))]
                error = figures(picture[part] / STEPS, other[part], mask=masks[0], reference_mask=masks[1])
                found.setdefault(against, []).append(error)
        told(done + 1, len(files))
    if not found:
        raise TrilaneError("none of the frames that were kept shows an avatar")
    first, *rest = (summed_up(against, errors) for against, errors in found.items())
    return {**first, "frames": len(numbers), "numbers": tuple(numbers), "float_path": rest[0] if rest else None}


def summed_up(against: str, errors: Sequence[ErrorFigures]) -> dict[str, Any]:
    """Return the fields of `trilane.apps.run.report.FrameErrors` for frames with the given `errors`.

    `against`: name of the pictures that the frames were compared with. `errors`: errors of each frame.
    """
    ssim = [error.ssim for error in errors if error.ssim is not None]
    return {
        "against": against,
        **psnr_of_frames([error.psnr_db for error in errors]),
        "mae": fmean(error.mae for error in errors),
        "ssim": fmean(ssim) if ssim else None,
        "flip": fmean(error.flip for error in errors),
        "iou": fmean(error.iou for error in errors if error.iou is not None),
    }


def differs(picture: U8, background: U8) -> Mask:
    """Return a mask (h,w) of the pixels in which `picture` (h,w,3) differs from `background` (h,w,3)."""
    return np.asarray((picture != background).any(axis=2))


def _bytes(picture: F64) -> U8:
    return np.asarray(np.rint(picture * STEPS), np.uint8)
