"""What a run folder has from its journal: the recording and the trace. Rule: it is read once, record by record."""

from __future__ import annotations

from pathlib import Path

from trilane.apps.trace import write_trace
from trilane.pipeline.journal import Begun, Stepped, Worked, read_journal
from trilane.pipeline.journal_slices import JournalSlices
from trilane.scheduler.accounts import IdleSlice
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.recording import header_line, step_line

EVENTS, TRACE = "events.jsonl", "trace.pftrace"


def write_from_journal(journal: Path, folder: Path) -> None:
    """Write EVENTS and TRACE into `folder`. Raises BadInputError for a journal that is none."""
    jobs: list[JobRecord] = []
    idle: list[IdleSlice] = []
    units: tuple[str, ...] = ()
    with (folder / EVENTS).open("w", encoding="utf-8") as events:
        slices: JournalSlices | None = None
        for record in read_journal(journal):
            if isinstance(record, Begun):
                slices, units = JournalSlices(record.graph), record.graph.units
                events.write(header_line(record.graph, record.settings))
            elif slices is not None:
                idle += slices.add(record)
                if isinstance(record, Stepped):
                    events.write(step_line(*record))
                elif isinstance(record, Worked):
                    jobs.append(record.job)
        if slices is not None:
            idle += slices.end()
    write_trace(jobs, units, folder / TRACE, idle)
