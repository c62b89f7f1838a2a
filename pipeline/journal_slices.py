"""The jobs and idle slices of a run from its journal. Rule: what the journal says, and nothing else, one by one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from trilane.pipeline.journal import Accounted, Record, Stepped, Worked, read_journal
from trilane.scheduler.accounts import IdleCutter, IdleSlice, Span
from trilane.scheduler.events import Graph
from trilane.scheduler.ledger import JobRecord


class JournalSlices:
    """Fed the records of a journal in order, whether or not the run still goes on.

    `add` hands back the slices that are known by then, in the order of their ends; `end`, after the last record, the
    rest. `span`: as of `IdleCutter`.
    """

    def __init__(self, graph: Graph) -> None:
        self._cutter = IdleCutter(graph)

    @property
    def span(self) -> Span | None:
        return self._cutter.span

    def add(self, record: Record) -> list[IdleSlice]:
        """The next record."""
        match record:
            case Stepped():
                return self._cutter.step(*record)
            case Accounted():
                self._cutter.account(*record)
            case Worked():
                self._cutter.job(record.job)
        return []

    def end(self) -> list[IdleSlice]:
        """Until the last step."""
        return self._cutter.end()


def jobs_of(path: Path) -> Iterator[JobRecord]:
    """The jobs of the journal at `path`, in the order in which their ends were heard. Raises BadInputError."""
    return (record.job for record in read_journal(path) if isinstance(record, Worked))
