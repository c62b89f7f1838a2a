"""Entries from folders: runs, sweeps, and folders of either.

Rule: every file is opened with its size checked; what cannot be read is refused by name before anything is written.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from trilane.apps.overview.entry import Entry, entry_of
from trilane.apps.report import MAX_REPORT_BYTES
from trilane.apps.sweeps.store import TRIALS, read_trials
from trilane.errors import BadInputError
from trilane.files import instead_of_file, require_file

REPORT, VIDEO = "report.json", "video.mp4"
EXPECTED = "a run folder, a sweep's folder, a prediction that was saved with --json, or a folder of these"
MOST = 10_000


def read_entries(places: Sequence[Path]) -> list[Entry]:
    """The entries of all `places`, in their order; of two with one name each is called after its folder, too.

    A run or a sweep in a folder of these that cannot be read is an entry with a `failure`.
    Raises BadInputError for a place that cannot be read, and where there are no entries.
    """
    entries: list[Entry] = []
    for place in places:
        before = len(entries)
        for entry in _entries(place):
            entries.append(entry)
            if len(entries) > MOST:
                raise BadInputError(place, f"more than {MOST} runs and trials", f"at most {MOST} for a page")
        if len(entries) == before:
            raise BadInputError(place, "no run and no trial", EXPECTED)
    names = Counter(entry.name for entry in entries)
    return [replace(each, name=f"{each.within}/{each.name}") if names[each.name] > 1 else each for each in entries]


def _entries(place: Path) -> Iterator[Entry]:
    within = place.absolute().parent.name
    if place.is_file():
        yield replace(entry_of(place.stem, _document(place)), within=within)
    elif not place.is_dir():
        raise BadInputError(place, instead_of_file(place), EXPECTED)
    elif (place / REPORT).is_file():
        yield replace(entry_of(place.name, _document(place / REPORT), place / VIDEO), within=within)
    elif (place / TRIALS).is_file():
        trials = [_trial(place, trial) for trial in read_trials(place).values()]
        yield from (replace(trial, within=place.absolute().name) for trial in trials)
    else:
        for folder in sorted(path for path in place.iterdir() if path.is_dir() and path.suffix != ".partial"):
            if (folder / REPORT).is_file() or (folder / TRIALS).is_file():
                yield from _one_of_many(folder)


def _one_of_many(folder: Path) -> list[Entry]:
    try:
        return list(_entries(folder))
    except BadInputError as error:
        damaged = entry_of(folder.name, {"failure": f"cannot be read: {error}"})
        return [replace(damaged, within=folder.absolute().parent.name)]


def _document(path: Path) -> Mapping[str, Any]:
    size = require_file(path, EXPECTED)
    if size > MAX_REPORT_BYTES:
        raise BadInputError(path, f"{size} bytes", f"at most {MAX_REPORT_BYTES}")
    try:
        document = json.loads(path.read_text(encoding="utf-8", errors="replace"))
    except (ValueError, RecursionError) as error:
        raise BadInputError(path, str(error), EXPECTED) from None
    if not isinstance(document, dict):
        raise BadInputError(path, f"a {type(document).__name__}", EXPECTED)
    return document


def _trial(folder: Path, trial: Mapping[str, Any]) -> Entry:
    result = trial.get("result")
    document = dict(result) if isinstance(result, dict) else {}
    document["made"] = {**_mapping(document.get("made")), "command": trial.get("command")}
    document.setdefault("clock", trial.get("clock", "host"))
    document.setdefault("machine", trial.get("host"))
    if trial.get("status") != "done":
        error = trial.get("error")
        ended = f"{trial.get('status')}, exit code {trial.get('exit_code')}"
        document["failure"] = f"{ended}: {error}" if error else ended
    video = _video(folder, trial.get("folder"))
    return entry_of(str(trial.get("id")), document, video, _mapping(trial.get("options")))


def _mapping(value: Any) -> dict[str, Any]:
    return dict(value) if isinstance(value, dict) else {}


def _video(folder: Path, name: Any) -> Path | None:
    """The video of a trial's run folder, which has to lie inside the sweep's."""
    if not isinstance(name, str):
        return None
    place = (folder / name).resolve()
    return place / VIDEO if place.is_relative_to(folder.resolve()) else None
