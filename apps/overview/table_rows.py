"""The entries as one table: a row each, the settings that differ between them, speed, error and where both come from.

Rule: the page, the CSV and the Parquet file have the same columns and the same numbers.
"""

from __future__ import annotations

import csv
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trilane.apps.overview.entry import Entry, varied
from trilane.apps.overview.frontier import frontier
from trilane.errors import MissingPartError
from trilane.writing import write_atomically

FIGURES = (
    *("frame_ms", "low_ms", "high_ms", "frames_per_s", "latency_ms"),
    *("psnr_db", "worst_psnr_db", "p1_psnr_db", "on_frontier"),
)
SOURCES = ("speed_source", "interval", "error_source", "shows", "clock", "machine", "failure", "command")


def columns(entries: Sequence[Entry]) -> list[str]:
    """`name`, the settings that vary, `FIGURES`, `SOURCES`."""
    return ["name", *varied(list(entries)), *FIGURES, *SOURCES]


def table_rows(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """A row for each entry; a cell without a value is None."""
    settings = varied(list(entries))
    return [
        {
            "name": entry.name,
            **{key: entry.settings.get(key) for key in settings},
            **{key: getattr(entry, key) for key in FIGURES[:-1]},
            "on_frontier": on,
            **{key: getattr(entry, key) for key in SOURCES[:-1]},
            "command": shlex.join(entry.command),
        }
        for entry, on in zip(entries, frontier(entries), strict=True)
    ]


def write_csv(target: Path, entries: Sequence[Entry]) -> None:
    """Raises BadInputError where nothing can be written."""
    with write_atomically(target) as draft, draft.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns(entries))
        writer.writeheader()
        writer.writerows(table_rows(entries))


def write_parquet(target: Path, entries: Sequence[Entry]) -> None:
    """Raises MissingPartError without pyarrow, BadInputError where nothing can be written."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise MissingPartError(f"a table as Parquet needs {error.name or 'pyarrow'}", extra="table") from None
    with write_atomically(target) as draft:
        parquet.write_table(pyarrow.Table.from_pylist(table_rows(entries)), draft)
