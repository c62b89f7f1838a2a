"""The result of a run. Rule: plain data; a recording is written only where the caller asks for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from trilane.pipeline.run_metrics import RunMetrics
from trilane.scheduler.causes import Drop, Loss
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.recording import Recording


@dataclass(frozen=True)
class Failure:
    """Why a run ended early.

    `message`: one sentence.
    `exit_code`: exit code that the failure asks for.
    """

    message: str
    exit_code: int = 1


@dataclass(frozen=True)
class RunResult:
    """A finished run.

    `report`: what the run measured; the caller adds the machine and the configuration.
    `requested`, `presented`: numbers of frames.
    `lost`, `dropped`: numbers of frames by cause.
    `pids`: process id of each unit.
    `startup_ms`: start-up time of each unit in ms.
    `jobs`, `recording`: jobs and steps of a run without a journal. With a journal both are empty, and the journal has
    them (`trilane.pipeline.journal.Worked`).
    `metrics`: means of what each stage reported, over the jobs that reported it.
    `rungs`: number of presented frames on each rung, for a run with a ladder of work.
    `rung_switches`: how often a frame had another rung than the frame before.
    `messages`: texts of what went wrong on the way, such as a unit that died and was restarted.
    `interrupted`: whether a signal ended the run.
    `failure`: set when a stage failed or a unit could not be kept alive; the other fields hold what was done until
    then.
    """

    report: RunMetrics
    requested: int
    presented: int
    lost: Mapping[Loss, int]
    dropped: Mapping[Drop, int]
    pids: Mapping[str, int]
    startup_ms: Mapping[str, float]
    jobs: tuple[JobRecord, ...]
    recording: Recording
    metrics: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    rungs: Mapping[int, int] = field(default_factory=dict)
    rung_switches: int = 0
    messages: tuple[str, ...] = ()
    interrupted: bool = False
    failure: Failure | None = None
