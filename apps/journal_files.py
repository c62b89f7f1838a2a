"""What a run folder has from its journal: the recording and the trace. Rule: it is read once, record by record."""

from __future__ import annotations

from pathlib import Path

from trilane.apps.explain.trace import NAME, TraceWriter
from trilane.pipeline.journal import Begun, Stepped, read_journal
from trilane.scheduler.recording import header_line, step_line

EVENTS = "events.jsonl"


def write_from_journal(journal: Path, folder: Path) -> None:
    """Write the recording and the trace into `folder`. Raises BadInputError for a journal that is none."""
    trace: TraceWriter | None = None
    with (folder / EVENTS).open("w", encoding="utf-8") as events, (folder / NAME).open("wb") as file:
        for record in read_journal(journal):
            if isinstance(record, Begun):
                trace = TraceWriter(file, record)
                events.write(header_line(record.graph, record.settings))
            elif trace is not None:
                trace.add(record)
                if isinstance(record, Stepped):
                    events.write(step_line(*record))
        if trace is not None:
            trace.close()
