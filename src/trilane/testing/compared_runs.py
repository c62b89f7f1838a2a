"""Runs to be compared, in virtual time. Rule: what each job takes follows from the seed alone."""

from __future__ import annotations

import json
import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from trilane.pipeline.journal import NAME, JournalWriter, journal_of
from trilane.scheduler.events import Settings, chain
from trilane.scheduler.virtual import Simulation, simulate
from trilane.testing.run_report import make_report

MS: Final = 1_000_000
#: Stage: its unit, and how long a job of it takes in the mean, ms.
STAGES: Final = {
    "pose": ("cpu", 2.0),
    "raster": ("gpu", 4.0),
    "infer": ("dsp", 9.0),
    "composite": ("gpu", 3.0),
    "present": ("cpu", 2.0),
}


def simulated(
    seed: int,
    *,
    policy: str = "pipelined",
    frames: int = 200,
    factors: Mapping[str, float] | None = None,
    period_ms: float = 0,
) -> Simulation:
    """A run whose service times scatter by 5 %. `factors`: of a stage's time, by its name. `period_ms`: of frames."""
    draw = random.Random(seed)
    scale = {stage: (factors or {}).get(stage, 1.0) * ms * MS for stage, (_, ms) in STAGES.items()}

    def service(stage: str, *_: Any) -> int:
        return round(scale[stage] * draw.lognormvariate(0, 0.05))

    graph = chain([(stage, unit) for stage, (unit, _) in STAGES.items()], "double", "composite")
    return simulate(graph, Settings(frames, policy, round(period_ms * MS)), service, keep=True)


def write_run(folder: Path, run: Simulation, **changes: Any) -> Path:
    """A run folder with a report and a journal. `changes`: of the report's keys."""
    folder.mkdir()
    assert run.recording is not None
    policy = run.recording.settings.policy
    report = make_report(**{**run.report, "policy": policy, "baseline": None, **changes})
    (folder / "report.json").write_text(json.dumps(report), encoding="utf-8")
    with JournalWriter(folder / NAME) as journal:
        for record in journal_of(run.recording, run.jobs, {"clock": report["clock"]}, run.report):
            journal.add(record)
    return folder
