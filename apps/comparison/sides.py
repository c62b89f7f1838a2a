"""What is compared: run folders, reports and predictions, from disk. Rule: what cannot be compared is refused by name.

A run folder with a journal has every frame; a report alone, or a prediction, has summaries.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from pydantic_core import from_json

from trilane.apps.comparison.run_frames import RunFrames, read_frames
from trilane.apps.report import MAX_REPORT_BYTES, read_report
from trilane.errors import BadInputError
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
    """One run: `name` as given, `document` as JSON with the keys of a report, `frames` of a run with a journal."""

    name: str
    kind: Kind
    document: Mapping[str, Any]
    frames: RunFrames | None = None


@dataclass(frozen=True)
class Side:
    """One or several runs of one kind, which stand for it."""

    name: str
    runs: tuple[Told, ...]


def read_side(text: str) -> Side:
    """`text`: a path, or several joined by commas. Raises BadInputError."""
    names = [text] if Path(text).exists() else text.split(",")
    return Side(text, tuple(read_told(name) for name in names))


def read_told(name: str) -> Told:
    """The run at the path `name`. Raises BadInputError naming what is missing, cut off or of another schema."""
    path = Path(name)
    if path.is_dir():
        document = read_report(path).as_json()
        journal = path / JOURNAL
        if not journal.exists():
            return Told(name, Kind.REPORT, document)
        return Told(name, Kind.RUN, document, read_frames(journal))
    found = _document(path)
    if all(key in found for key in OF_A_PREDICTION):
        return Told(name, Kind.PREDICTION, found)
    if "networks" in found or "rows" in found:
        remedy = "the application with a network is predicted with --application"
        raise BadInputError(path, "predictions of bare networks or of a table", EXPECTED, remedy)
    return Told(name, Kind.REPORT, read_report(path).as_json())


def _document(path: Path) -> Mapping[str, Any]:
    try:
        if path.stat().st_size > MAX_REPORT_BYTES:
            raise BadInputError(path, f"{path.stat().st_size} bytes", f"at most {MAX_REPORT_BYTES}")
        document = from_json(path.read_bytes())
    except OSError as error:
        raise BadInputError.of_os_error(path, error, EXPECTED) from None
    except ValueError as error:
        raise BadInputError(path, str(error), EXPECTED) from None
    if not isinstance(document, dict):
        raise BadInputError(path, f"a JSON {type(document).__name__}", EXPECTED)
    return {str(key): value for key, value in document.items()}
