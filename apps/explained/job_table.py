"""Every job of a run as a row: as CSV, as Parquet, or for NumPy.

Rule: rows are written as they are read, so that the memory does not grow with the run. A run is read twice: once for
the names of the figures that its stages report, which are the last columns.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Final

from trilane.apps.explained.run import explained_jobs, open_journal
from trilane.errors import BadInputError, MissingPartError
from trilane.pipeline.journal import Worked
from trilane.pipeline.timeline import ExplainedJob
from trilane.writing import write_atomically

#: Column -> its value of a job, and its type. Times are ns of the run's clock, lengths of time ns; docs/explain.md says
#: what each means.
COLUMNS: dict[str, tuple[type, Callable[[ExplainedJob], Any]]] = {
    "frame": (int, lambda one: one.job.frame),
    "stage": (str, lambda one: one.job.stage),
    "unit": (str, lambda one: one.job.unit),
    "ready_ns": (int, lambda one: one.job.ready_ns),
    "dispatch_ns": (int, lambda one: one.job.dispatch_ns),
    "begin_ns": (int, lambda one: one.job.begin_ns),
    "end_ns": (int, lambda one: one.job.end_ns),
    "preempted_ns": (int, lambda one: one.job.preempted_ns),
    "asleep_ns": (int, lambda one: one.job.asleep_ns),
    "preempted_before_ns": (int, lambda one: one.job.preempted_before_ns),
    "wait_ns": (int, lambda one: one.job.begin_ns - one.job.ready_ns),
    "wait_cause": (str, lambda one: one.cause),
    "wait_cause_ns": (int, lambda one: one.waits_ns.get(one.cause, 0)),
    "behind_stage": (str, lambda one: one.behind.stage if one.behind is not None else ""),
    "behind_frame": (int, lambda one: one.behind.frame if one.behind is not None else -1),
    "rung": (int, lambda one: one.rung),
    "skips": (bool, lambda one: one.skips),
}
ROWS_AT_ONCE: Final = 8192
ENDINGS = (".csv", ".parquet")


def figure_names(folder: Path) -> list[str]:
    """The names of the figures that the stages of a run report, sorted. Raises BadInputError."""
    _, records = open_journal(folder)
    return sorted({name for record in records if isinstance(record, Worked) for name in record.figures})


def job_rows(folder: Path, figures: Sequence[str]) -> Iterator[tuple[Any, ...]]:
    """A row for each job, in the order of their ends: COLUMNS, then `figures`, None where the stage has none."""
    values = [value for _, value in COLUMNS.values()]
    for one in explained_jobs(*open_journal(folder)):
        yield (*(value(one) for value in values), *(one.figures.get(name) for name in figures))


def check_ending(target: Path) -> None:
    """Raises BadInputError for a name that ends in none of ENDINGS."""
    if target.suffix.lower() not in ENDINGS:
        raise BadInputError("--jobs", f"'{target}'", f"a name that ends in {' or '.join(ENDINGS)}")


def write_jobs(folder: Path, target: Path) -> int:
    """Every job of the run in `folder` as `target`, .csv or .parquet, by the name's ending; how many there are.

    Raises BadInputError for another ending, a folder that is no run's and a place that cannot be written;
    MissingPartError where .parquet lacks its library.
    """
    check_ending(target)
    figures = figure_names(folder)
    write = _write_parquet if target.suffix.lower() == ".parquet" else _write_csv
    with write_atomically(target) as draft:
        return write(draft, figures, job_rows(folder, figures))


def _write_csv(target: Path, figures: Sequence[str], rows: Iterator[tuple[Any, ...]]) -> int:
    count = 0
    with target.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*COLUMNS, *figures])
        for count, row in enumerate(rows, start=1):  # noqa: B007 - handed back
            writer.writerow([int(value) if isinstance(value, bool) else value for value in row])
    return count


def _write_parquet(target: Path, figures: Sequence[str], rows: Iterator[tuple[Any, ...]]) -> int:
    try:
        import pyarrow as arrow
        from pyarrow.parquet import ParquetWriter
    except ImportError as error:
        raise MissingPartError(f"a table as Parquet needs {error.name or 'pyarrow'}", extra="table") from None
    words = arrow.dictionary(arrow.int32(), arrow.string())
    kinds = {int: arrow.int64(), str: words, bool: arrow.bool_()}
    fields = [(name, kinds[kind]) for name, (kind, _) in COLUMNS.items()]
    schema = arrow.schema(fields + [(name, arrow.float64()) for name in figures])
    count = 0
    with ParquetWriter(target, schema) as writer:
        while some := list(islice(rows, ROWS_AT_ONCE)):
            count += len(some)
            by_column = zip(*some, strict=True)
            columns = [arrow.array(column, field.type) for column, field in zip(by_column, schema, strict=True)]
            writer.write_batch(arrow.record_batch(columns, schema=schema))
    return count
