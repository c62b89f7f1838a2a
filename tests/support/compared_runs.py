"""Runs to be compared, in virtual time. Rule: what each job takes follows from the seed alone.

Runs as of a machine scatter like real ones: `BETWEEN` and `WITHIN` are what real runs did, not what `trilane compare`
takes them to do.
"""

from __future__ import annotations

import json
import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from support.run_report import make_report
from trilane.pipeline.journal import NAME, JournalWriter, Record, Worked, journal_of
from trilane.scheduler.events import Settings, chain
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.virtual import Simulation, simulate

MS: Final = 1_000_000
#: Stage: its unit, and how long a job of it takes in the mean, ms.
STAGES: Final = {
    "pose": ("cpu", 2.0),
    "raster": ("gpu", 4.0),
    "infer": ("dsp", 9.0),
    "composite": ("gpu", 3.0),
    "present": ("cpu", 2.0),
}


#: Standard deviation of the logarithm of a stage's time on its core, from run to run of one kind, and from job to job:
#: of 23 runs of the default scene, 100 frames each, in which other programs had 80 to 90 % of the cores. Raster and
#: infer varied by 11 and 4 % at another time, which is more than there, so it stands here.
BETWEEN: Final = {"pose": 0.032, "raster": 0.11, "infer": 0.04, "composite": 0.015, "present": 0.066}
WITHIN: Final = {"pose": 0.10, "raster": 0.07, "infer": 0.05, "composite": 0.05, "present": 0.21}
#: The same of the instructions that a job executes: they repeat to 0.1 %; and how many a nanosecond has.
INSTRUCTIONS_BETWEEN: Final = 0.001
INSTRUCTIONS_PER_NS: Final = 4.0
#: Scatter of a loaded run's frame time, and by how much work takes longer beside other programs (docs/decisions).
OF_A_LOADED_RUN, WORK_BESIDE_OTHERS = 0.023, 0.15


def simulated(
    seed: int,
    *,
    policy: str = "pipelined",
    frames: int = 200,
    factors: Mapping[str, float] | None = None,
    period_ms: float = 0,
    within: Mapping[str, float] | None = None,
) -> Simulation:
    """A run. `factors`: of a stage's time, by its name. `period_ms`: of frames. `within`: by how much the service times

    of a stage scatter; 5 % where it is absent.
    """
    draw = random.Random(seed)
    scale = {stage: (factors or {}).get(stage, 1.0) * ms * MS for stage, (_, ms) in STAGES.items()}

    def service(stage: str, *_: Any) -> int:
        return round(scale[stage] * draw.lognormvariate(0, (within or {}).get(stage, 0.05)))

    graph = chain([(stage, unit) for stage, (unit, _) in STAGES.items()], "double", "composite")
    return simulate(graph, Settings(frames, policy, round(period_ms * MS)), service, keep=True)


def on_a_machine(
    seed: int, *, factors: Mapping[str, float] | None = None, frames: int = 100, others: float = 0.0
) -> tuple[Simulation, list[Record]]:
    """A run that scatters as real ones do, and its journal, with the instructions of every job.

    `factors`: of a stage's program, so of its instructions. What the machine does to a run's times it does not do to
    the instructions. `others`: share of the cores that other programs have: every job waits for its core for that share
    of its time, and works longer by 0.15 of it, which is what 56 pairs of runs showed in the mean. The whole run is
    faster or slower by 2.3 %, the scatter that 23 frame times had when others' share was taken out.
    """
    draw, program = random.Random(seed), {stage: (factors or {}).get(stage, 1.0) for stage in STAGES}
    times = {stage: factor * draw.lognormvariate(0, BETWEEN[stage]) for stage, factor in program.items()}
    counts = {
        stage: ms * MS * INSTRUCTIONS_PER_NS * program[stage] * draw.lognormvariate(0, INSTRUCTIONS_BETWEEN)
        for stage, (_, ms) in STAGES.items()
    }
    if others:
        luck = draw.lognormvariate(0, OF_A_LOADED_RUN) * (1 + WORK_BESIDE_OTHERS * others) / (1 - others)
        times = {stage: factor * luck for stage, factor in times.items()}
    run = simulated(seed, frames=frames, factors=times, within=WITHIN)
    assert run.recording is not None
    records = [
        Worked(_beside(record.job, others), {"instructions": counts[record.job.stage]})
        if isinstance(record, Worked)
        else record
        for record in journal_of(run.recording, run.jobs, {"clock": "host"}, run.report)
    ]
    return run, records


def _beside(job: JobRecord, others: float) -> JobRecord:
    lost_ns = round((job.end_ns - job.begin_ns) * others)
    return job._replace(preempted_ns=lost_ns, cpu_ns=job.end_ns - job.begin_ns - lost_ns)


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
