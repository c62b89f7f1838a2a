"""What a run hands back. Rule: plain data; nothing here acts, and no file is written but the events on request."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

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

    `report` holds the keys of report.json that a run knows (DESIGN: clock, frames, frame_time_ms, latency_ms, fps,
    deadline_misses, stages, units with pid and cores, efficiency); the caller adds machine, config and plan.
    `failure` is set when a stage failed or a unit could not be kept alive; what was done until then is still here.
    `messages` tells a person what went wrong on the way (a unit that died and was restarted, ...).
    """

    report: dict[str, Any]
    requested: int
    presented: int
    lost: Mapping[str, int]
    dropped: Mapping[str, int]
    pids: Mapping[str, int]
    startup_ms: Mapping[str, float]
    jobs: tuple[JobRecord, ...]
    recording: Recording
    figures: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    messages: tuple[str, ...] = ()
    interrupted: bool = False
    failure: Failure | None = None
