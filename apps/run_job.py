"""One run from a checked configuration to a complete run folder.

Rule: whatever the units did, what is in the folder is whole: a run that was interrupted or failed says so in its
report and keeps the frames that were presented; a run that presented none leaves no folder.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trilane.apps.pace import Pace, compare
from trilane.apps.report import Report, build_report, write_report
from trilane.apps.run_folder import RunFolder
from trilane.apps.trace import write_trace
from trilane.apps.video import contact_sheet, join_segments, run_checksum
from trilane.errors import TrilaneError
from trilane.hw_profiles.governor import Governor
from trilane.hw_profiles.load import load_runnable
from trilane.pipeline.result import RunResult
from trilane.pipeline.run import run_pipeline
from trilane.pipeline.signals import Interrupts
from trilane.stages.config import RunConfig
from trilane.stages.cpu.present import SEGMENTS

BASELINE_POLICY = "sequential"
HOST = "host"
INTERRUPTED = 130


@dataclass(frozen=True)
class Plan:
    """How to run: the policy, frames of the sequential run beside it (0: none), a chip's pace to keep, and the
    performance profile whose caps hold (None: no cap). `latch_ms`: of the poses, but not of the run beside it.
    """

    policy: str = "pipelined"
    baseline_frames: int = 60
    pace: Pace | None = None
    performance_profile: str | None = None
    latch_ms: float = 0.0


@dataclass(frozen=True)
class Hooks:
    """Who is told. `progress(what, presented, requested)`; `message(text)`."""

    progress: Callable[[str, int, int], None]
    message: Callable[[str], None]


@dataclass(frozen=True)
class Outcome:
    """`report` as written, `folder` that holds it, and the exit code that the run asks for."""

    report: Report
    folder: Path
    exit_code: int


def run_to_folder(
    config: RunConfig, target: Path, plan: Plan, hooks: Hooks, *, machine: dict[str, Any], facts: Mapping[str, Any]
) -> Outcome:
    """Run `config` and leave the run folder at `target`. `facts` are added to the report.

    Raises BadInputError when `target` cannot be written, and TrilaneError when no frame was presented.
    """
    with RunFolder(target) as folder:
        config = config.model_copy(update={"out_dir": folder.work})
        result = _run(config, plan, plan.policy, None, hooks)
        with Interrupts() as late:  # from here on a signal waits until the folder is whole
            baseline, stopped = _baseline(config, plan, hooks) if _went_well(result) else (None, False)
            known = {**facts, **_write_files(result, folder.work, config.scene.fps)}
            if plan.pace is not None:
                known["pace"] = compare(plan.pace, plan.policy, config.scene.frames, result.jobs)
            report = build_report(result, config, machine=machine, baseline=baseline, facts=known)
            _tell(report, hooks)
            write_report(report, folder.work / "report.json")
            place = folder.complete()
        return Outcome(report, place, INTERRUPTED if stopped or late.count else _exit_code(result))


def _tell(report: Report, hooks: Hooks) -> None:
    """What a person should not have to find in the report."""
    presented = report.frames.presented
    if report.video and report.video.frames < presented:
        hooks.message(
            f"video.mp4 holds {report.video.frames} of {presented} frames: a writer was killed before its last"
        )
    if report.stage_metrics.get("pose", {}).get("visible") == 0:
        hooks.message("no avatar was in the picture in any frame")


def _went_well(result: RunResult) -> bool:
    return not result.interrupted and result.failure is None


def _run(config: RunConfig, plan: Plan, policy: str, frames: int | None, hooks: Hooks) -> RunResult:
    """The run under `policy`. Raises TrilaneError when it ended before any frame was presented."""
    capped = plan.performance_profile is not None
    result = run_pipeline(
        config,
        policy=policy,
        frames=frames,
        on_progress=lambda presented, requested: hooks.progress(policy, presented, requested),
        on_message=hooks.message,
        latch_ms=plan.latch_ms if policy == plan.policy else 0.0,
        governor=Governor(load_runnable(HOST), str(plan.performance_profile)) if capped else None,
    )
    if result.presented:
        return result
    if result.interrupted:
        raise KeyboardInterrupt
    raise _error_of(result)


def _error_of(result: RunResult) -> TrilaneError:
    failure = result.failure
    error = TrilaneError(failure.message if failure else "no frame was presented: " + "; ".join(result.messages))
    error.exit_code = failure.exit_code if failure else error.exit_code
    return error


def _baseline(config: RunConfig, plan: Plan, hooks: Hooks) -> tuple[RunResult | None, bool]:
    """The first frames of the same scene again, one frame at a time, with the same work; its pictures are not kept.

    None when it was not asked for or did not complete; and whether it was interrupted.
    """
    if not plan.baseline_frames or plan.policy == BASELINE_POLICY:
        return None, False
    place = config.out_dir / BASELINE_POLICY
    place.mkdir()
    frames = min(plan.baseline_frames, config.scene.frames)
    try:
        result = _run(config.model_copy(update={"out_dir": place}), plan, BASELINE_POLICY, frames, hooks)
    except KeyboardInterrupt:
        return None, True
    except TrilaneError as error:
        hooks.message(f"the {BASELINE_POLICY} run beside it failed and is left out: {error}")
        return None, False
    finally:
        shutil.rmtree(place)
    return (result if _went_well(result) else None), result.interrupted


def _exit_code(result: RunResult) -> int:
    if result.interrupted:
        return INTERRUPTED
    return 0 if result.failure is None else result.failure.exit_code


def _write_files(result: RunResult, work: Path, fps: float) -> dict[str, Any]:
    """Everything but the report; what the report says of it."""
    segments = work / SEGMENTS
    files: dict[str, Any] = {"video": None, "checksum": None}
    if segments.is_dir():
        joined = join_segments(sorted(segments.glob("*.mp4")), work / "video.mp4", fps)
        files["checksum"] = run_checksum(sorted(segments.glob("*.sha256")))
        if joined is not None:
            files["video"] = {"frames": joined.frames, "seconds": joined.seconds}
            contact_sheet(work / "video.mp4", work / "contact.png", fps)
        shutil.rmtree(segments)
    result.recording.write(work / "events.jsonl")
    write_trace(result.jobs, result.recording.graph.units, work / "trace.pftrace")
    return files
