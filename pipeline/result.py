"""What a run hands back. Rule: plain data; a recording is written only where the caller asks for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from trilane.pipeline.run_metrics import RunMetrics
from trilane.scheduler.causes import Drop, Loss
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.recording import Recording


@dataclass(frozen=True)
class Failure:
    """Why a run ended early: one sentence and the exit code that it asks for."""

    message: str
    exit_code: int = 1


@dataclass(frozen=True)
class RunResult:
    """A finished run.

    `report`: what the run measured; who calls it adds the machine and the configuration.
    `jobs`, `recording`: of a run without a journal; of one with it they are empty, and the journal has them
    (`trilane.pipeline.journal.Worked`).
    `lost`, `dropped`: frames by cause. `startup_ms`: of each unit. `metrics`: of each stage, the means
    over the jobs that gave them.
    `rungs`: of a run with a ladder of work, how many presented frames had each, and `rung_switches`, how often one had
    another than the frame before.
    `messages`: what went wrong on the way, such as a unit that died and was restarted.
    `failure`: set when a stage failed or a unit could not be kept alive; what was done until then is still here.
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
