"""Runs the trials of a sweep that are not done, on an engine, and keeps each as it ends.

Rule: only a lost trial is tried again, `TRIES` times in all; only this process writes the sweep's folder.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from typing import Any

from trilane.apps.sweeps.store import Record, Store, is_ended
from trilane.apps.sweeps.trial import Trial

TRIES = 3
#: Does trials and yields their records as they end; closing it ends what goes on.
Engine = Callable[[Sequence[Trial]], Generator[Record]]


def run_sweep(trials: Sequence[Trial], store: Store, engine: Engine, told: Callable[[Record], None]) -> None:
    """Do what is left of `trials`.

    `store`: entered; what it has is not done again.
    `told`: hears of each trial that ended for good.
    """
    left = [trial for trial in trials if not is_ended(store.done.get(trial.id))]
    for attempt in range(1, TRIES + 1):
        lost_now: list[Trial] = []
        for record in _records(engine, left):
            if record["status"] == "lost" and attempt < TRIES:
                lost_now += [trial for trial in left if trial.id == record["id"]]
                continue
            store.add({**record, "tries": attempt})
            told(record)
        left = lost_now


def _records(engine: Engine, trials: list[Trial]) -> Iterator[Record]:
    if trials:
        with closing(engine(trials)) as records:
            yield from records


def summary(trials: Sequence[Trial], store: Store, before: set[str]) -> dict[str, Any]:
    """How the trials of a sweep ended, and a line for each.

    `before`: names of those that were done when it began.
    """
    rows = [row_of(trial, store.done.get(trial.id)) for trial in trials]
    counts = Counter(row["status"] for row in rows)
    return {
        "folder": str(store.folder),
        "counts": {
            "trials": len(rows),
            **{status: counts[status] for status in ("done", "failed", "lost", "planned")},
            "skipped": sum(trial.id in before for trial in trials),
        },
        "trials": rows,
    }


def row_of(trial: Trial, record: Record | None) -> dict[str, Any]:
    """A trial in a summary: what it is and, unless it is planned, how it ended."""
    ended = record or {"status": "planned", "exit_code": None, "error": None, "seconds": None}
    return {
        "id": trial.id,
        "command": ["trilane", *trial.arguments],
        "options": dict(trial.options),
        "repeat": trial.repeat,
        **{key: ended[key] for key in ("status", "exit_code", "error", "seconds")},
    }
