"""Run folders that no run wrote. Rule: the journal is that of a run in virtual time, the report was made by hand."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from support.run_report import make_report
from trilane.pipeline.journal import NAME, JournalWriter, Worked, journal_of
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.virtual import Simulation


@contextmanager
def locked(folder: Path) -> Iterator[Path]:
    """Hold the lock of a run's `folder`, as the run does while it goes on."""
    lock = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield folder
    finally:
        os.close(lock)


def write_run(
    folder: Path,
    run: Simulation,
    jobs: Iterable[JobRecord] | None = None,
    *,
    cores: Mapping[str, tuple[int, ...]] | None = None,
    figures: Mapping[str, Mapping[str, float]] | None = None,
    clock: str = "host",
) -> Path:
    """The folder of a run that `simulate` made with `keep`.

    `jobs`: in place of its own, such as ones that lost time. `cores`: of each unit. `figures`: that the jobs of a stage
    report. `clock`: that the journal names.
    """
    assert run.recording is not None
    folder.mkdir()
    report = make_report()
    units = {unit: {"cores": list(own)} for unit, own in (cores or {}).items()}
    facts = {"clock": clock, "accuracy": report["accuracy"], "config": {**report["config"], "units": units}}
    with JournalWriter(folder / NAME) as journal:
        for record in journal_of(run.recording, run.jobs if jobs is None else jobs, facts, run.report):
            of_stage = (figures or {}).get(record.job.stage, {}) if isinstance(record, Worked) else {}
            journal.add(record._replace(figures=of_stage) if isinstance(record, Worked) else record)
    (folder / "report.json").write_text(json.dumps(report), encoding="utf-8")
    return folder
