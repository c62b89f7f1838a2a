"""What is compared: run folders, reports and predictions, from disk. Rule: what cannot be compared is refused by name.

A run folder with a journal has every frame; a report alone, or a prediction, has summaries. What a run that was killed
would have said of itself in its report follows from its journal (`journal_document.py`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from pydantic_core import from_json

from trilane.apps.comparison.journal_document import document_of
from trilane.apps.comparison.run_frames import RunFrames, read_frames
from trilane.apps.live.followed_run import FollowedRun, RunState, folder_of
from trilane.apps.report import MAX_REPORT_BYTES, read_report
from trilane.errors import BadInputError
from trilane.files import require_file
from trilane.pipeline.journal import NAME as JOURNAL

EXPECTED: Final = "a run folder, its report.json, or what `trilane predict --json` printed"
#: Keys that a prediction of the application has, and a report has not.
OF_A_PREDICTION: Final = ("expected_error", "network", "frame_time_ms", "units", "stages")


class Kind(StrEnum):
    """What there is of a run. RUN: every frame; REPORT: summaries; PREDICTION: summaries that a model computed."""

    RUN = "run"
    REPORT = "report"
    PREDICTION = "prediction"


@dataclass(frozen=True)
class Told:
    """One run: `name` as given, `document` as JSON with the keys of a report, `frames` of a run with a journal.

    `remark`: what a person should know of one that has no report.
    """

    name: str
    kind: Kind
    document: Mapping[str, Any]
    frames: RunFrames | None = None
    remark: str = ""


@dataclass(frozen=True)
class Side:
    """One or several runs of one kind, which stand for it."""

    name: str
    runs: tuple[Told, ...]


def read_side(text: str) -> Side:
    """`text`: a path, or several joined by commas. Raises BadInputError, also for a run that is named twice."""
    names = [text] if text.strip() and _is_there(text) else text.split(",")
    for name in names:
        if not name.strip():
            raise BadInputError(repr(text), "an empty name", EXPECTED, "leave no comma over")
    seen: set[str] = set()
    for name in names:
        place = os.path.realpath(name)
        if place in seen:
            remedy = "twice the same run is no surer than once"
            raise BadInputError(repr(text), f"{name} twice", "each run once", remedy)
        seen.add(place)
    return Side(text, tuple(read_told(name) for name in names))


def read_told(name: str) -> Told:
    """The run at the path `name`, or of this name, as `trilane top` finds it.

    Raises BadInputError naming what is missing, cut off or of another schema.
    """
    try:
        path = folder_of(Path(name)) or Path(name)
        if path.is_dir():
            return _of_folder(name, path)
    except OSError as error:
        raise BadInputError.of_os_error(name, error, EXPECTED) from None
    found = _document(path)
    if all(key in found for key in OF_A_PREDICTION):
        return Told(name, Kind.PREDICTION, found)
    if "networks" in found or "rows" in found:
        remedy = "the application with a network is predicted with --application"
        raise BadInputError(path, "predictions of bare networks or of a table", EXPECTED, remedy)
    return Told(name, Kind.REPORT, read_report(path).as_json())


def _is_there(text: str) -> bool:
    try:
        return Path(text).exists()
    except OSError:  # many names are longer together than one may be
        return False


def _of_folder(name: str, path: Path) -> Told:
    journal = path / JOURNAL
    if not os.path.lexists(journal):
        return Told(name, Kind.REPORT, read_report(path).as_json())
    if os.path.lexists(path / "report.json"):
        return Told(name, Kind.RUN, read_report(path).as_json(), read_frames(journal))
    frames = read_frames(journal)
    return Told(name, Kind.RUN, document_of(frames, journal), frames, _without_report(path, frames))


def _without_report(path: Path, frames: RunFrames) -> str:
    if frames.is_whole:
        return "it has no report: compared by its journal"
    if FollowedRun(path).state is RunState.GOES_ON:
        return "it still goes on and has no report: compared by the frames until now"
    return "it did not end by itself and has no report: compared by the frames of its journal until then"


def _document(path: Path) -> Mapping[str, Any]:
    try:
        if (size := require_file(path, EXPECTED)) > MAX_REPORT_BYTES:
            raise BadInputError(path, f"{size} bytes", f"at most {MAX_REPORT_BYTES}")
        document = from_json(path.read_bytes())
    except OSError as error:
        raise BadInputError.of_os_error(path, error, EXPECTED) from None
    except ValueError as error:
        raise BadInputError(path, str(error), EXPECTED) from None
    if not isinstance(document, dict):
        raise BadInputError(path, f"a JSON {type(document).__name__}", EXPECTED)
    return {str(key): value for key, value in document.items()}
