"""Traces as files: of a run from its journal, and of runs in virtual time. Rule: a file is whole or not there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from trilane.apps.tracing.packets import PacketSink
from trilane.apps.tracing.writer import write_chrome_trace, write_trace, write_tracks
from trilane.pipeline.journal import Record, journal_of
from trilane.scheduler.virtual import Simulation
from trilane.writing import write_atomically


def write_run(records: Iterable[Record], target: Path, *, chrome: bool = False) -> None:
    """The trace of a run's journal. `chrome`: as Chrome's JSON. Raises BadInputError."""
    with write_atomically(target) as draft:
        if chrome:
            with draft.open("w", encoding="utf-8") as text:
                write_chrome_trace(records, text)
        else:
            with draft.open("wb") as file:
                write_trace(records, file)


def write_predicted(runs: Mapping[str, Simulation], facts: Mapping[str, Any], target: Path) -> None:
    """The trace of runs in virtual time that were kept, each a group of tracks by its name. Raises BadInputError.

    `facts`: that are known of all of them, as of `Begun`.
    """
    records: dict[str, Iterable[Record]] = {}
    for name, run in runs.items():
        assert run.recording is not None
        records[name] = journal_of(run.recording, run.jobs, {"clock": "virtual", **facts}, run.report)
    with write_atomically(target) as draft, draft.open("wb") as file:
        write_tracks(PacketSink(file), records)
