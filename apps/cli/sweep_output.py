"""What a sweep shows while it goes on, and how it ended.

Rule: on a terminal one bar with the time left, elsewhere a line for each trial that ended; both on stderr.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Any

from trilane.apps.cli.console import stderr_console, stdout_console

if TYPE_CHECKING:
    from trilane.apps.sweep.definition import Definition

#: Of a trial's result, where it has them: what the table shows beside how it ended.
FIGURES = {"fps": ("fps",), "frame ms": ("frame_time_ms", "mean")}
#: Of trials with `--check`: of the single frames, as in the overview.
ERRORS = {"PSNR, dB": ("check", "psnr_db"), "worst": ("check", "worst_psnr_db"), "1st pct.": ("check", "p1_psnr_db")}


def seconds_left(elapsed_s: float, ended: int, left: int) -> float:
    """If the trials that are left take as long as those that ended, at least one of them."""
    return elapsed_s / ended * left


@contextmanager
def progress(left: int, whole: int) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """Yields what is told of each trial that ended. `left`: how many of the `whole` are not done yet."""
    console = stderr_console()
    if not console.is_terminal:
        yield _plain(console, left, whole)
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[left]}"))
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("trials", total=whole, completed=whole - left, left="")
        begin, ended = time.monotonic(), 0

        def told(record: Mapping[str, Any]) -> None:
            nonlocal ended
            ended += 1
            if record["status"] != "done":
                console.print(_line(record), soft_wrap=True, markup=False)
            text = f"{_time(seconds_left(time.monotonic() - begin, ended, left - ended))} left"
            bar.update(task, completed=whole - left + ended, left=text)

        yield told


def _plain(console: Any, left: int, whole: int) -> Callable[[Mapping[str, Any]], None]:
    begin, ended = time.monotonic(), 0

    def told(record: Mapping[str, Any]) -> None:
        nonlocal ended
        ended += 1
        remaining = _time(seconds_left(time.monotonic() - begin, ended, left - ended))
        place = f"{whole - left + ended}/{whole}"
        console.print(f"{place} {_line(record)}; {remaining} left", soft_wrap=True, markup=False)

    return told


def _line(record: Mapping[str, Any]) -> str:
    took = "" if record["seconds"] is None else f" in {record['seconds']:.1f} s"
    why = f": {record['error']}" if record["error"] else ""
    return f"{record['status']} {_words(record['options'])}{took}{why}"


def _words(options: Mapping[str, Any]) -> str:
    return " ".join(f"{name}={value}" for name, value in options.items())


def _time(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds)))


def print_summary(document: Mapping[str, Any], definition: Definition, records: Mapping[str, Any]) -> None:
    """A row for each trial, a line of counts, and a line for each error that trials ended with.

    `document`: as `--json` prints it.
    `records`: by name, as in `trials.jsonl`.
    """
    from rich.table import Table

    axes = list(definition.axes)
    repeats = ["repeat"] if definition.repeats > 1 else []
    results = {row["id"]: (records.get(row["id"]) or {}).get("result") or {} for row in document["trials"]}
    shown = FIGURES | (ERRORS if any(result.get("check") for result in results.values()) else {})
    table = Table(*axes, *repeats, "status", "seconds", *shown)
    for row in document["trials"]:
        cells = [row["options"][name] for name in axes] + [row[name] for name in repeats]
        figures = [_figure(results[row["id"]], path) for path in shown.values()]
        table.add_row(*(_text(each) for each in [*cells, row["status"], row["seconds"], *figures]))
    stdout_console().print(table)
    counts = document["counts"]
    text = ", ".join(f"{counts[key]} {key}" for key in ("trials", "done", "failed", "lost", "skipped"))
    stdout_console().print(f"{text}; {document['clock']} clock", markup=False)
    errors = Counter((row["status"], row["error"]) for row in document["trials"] if row["error"])
    for (status, error), count in errors.items():
        stdout_console().print(f"{count} {status}: {error}", soft_wrap=True, markup=False)


def _figure(result: Mapping[str, Any], path: tuple[str, ...]) -> Any:
    found: Any = result
    for key in path:
        found = found.get(key) if isinstance(found, dict) else None
    return found


def _text(value: Any) -> str:
    from rich.markup import escape

    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else escape(str(value))
