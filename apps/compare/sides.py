"""The runs to compare, read from disk: run folders, reports, predictions and imported times, with their settings.

Rule: an error names what cannot be compared. A run folder with a journal has every frame; a report alone, or a
prediction, has summaries. A run that was killed has no report. Its journal gives the keys that a comparison reads.

An imported time is compared with the imported time or the stage of the same name. If a file has exactly one wall time,
this time is the frame time. The state of the machine is not known. Therefore two imported times count as differing by
chance as much as any two runs on the host clock.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import sqrt
from pathlib import Path
from statistics import stdev
from typing import Annotated, Any, Final, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from pydantic_core import from_json, to_json

from trilane.apps.compare.difference import COMPARED, STATISTICS
from trilane.apps.compare.run_frames import Key, RunFrames, read_frames
from trilane.apps.run.report import MAX_REPORT_BYTES, REPORT_FILE, read_report
from trilane.apps.run.verdict import Trust, trust_of
from trilane.apps.watch.followed_run import FollowedRun, RunState, folder_of
from trilane.errors import BadInputError
from trilane.files import require_file
from trilane.pipeline.file_keys import LONGEST_MS
from trilane.pipeline.journal import NAME as JOURNAL
from trilane.pipeline.journal import config_of, read_journal
from trilane.pipeline.reckoning import places_of, reckoned
from trilane.pipeline.run_metrics import Bound, Record, metrics_in
from trilane.units import HOST_CLOCK

EXPECTED: Final = (
    "a run folder, its report.json, what `trilane predict --json` printed, or a JSON file with `measurements`"
)
#: A document with all these keys is a prediction of the application.
OF_A_PREDICTION: Final = ("expected_error", "network", "frame_time_ms", "units", "stages")
#: Facts in the first record of a journal that a report has too.
FACTS: Final = ("config", "machine", "made", "accuracy")
#: Parts of a report that say how the run was made.
PARTS: Final = (
    *("clock", "policy", "edge", "config", "stages"),
    *("caps.performance_profile", "machine", "made", "idle_cores"),
)
#: Keys that a report has both at its top and in `config`, and that a prediction has only in `config`.
TWICE: Final = ("policy", "edge")
#: Keys that differ between any two runs.
ALWAYS_DIFFERENT: Final = ("made.at", "made.command")


class RunKind(StrEnum):
    """The kind of data of a run.

    RUN: every frame. REPORT: summaries. PREDICTION: summaries that a model computed. TIMES: imported measurements.
    """

    RUN = "run"
    REPORT = "report"
    PREDICTION = "prediction"
    TIMES = "times"


#: Statistics of times in ms, by name; None if unknown.
Statistics = dict[str, float | None]


class ComparedCounts(Record, extra="ignore", allow_inf_nan=False):
    """Counts of a run's frames. The fields here and in the classes below have the names of a report's keys."""

    requested: int
    presented: int
    lost_by_cause: dict[str, int] = Field(default={})
    dropped: dict[str, int] = Field(default={})


class ComparedStage(Record, extra="ignore", allow_inf_nan=False):
    """Unit and times of a stage."""

    unit: str
    service_ms: Statistics = Field(default={})
    wait_ms: Statistics = Field(default={})
    cpu_ms: Statistics | None = None


class ComparedUnit(Record, extra="ignore", allow_inf_nan=False):
    """Shares and cores of a unit."""

    busy: float
    idle: dict[str, float | None]
    cores: tuple[int, ...] = ()


class ComparedFigures(Record, extra="ignore", allow_inf_nan=False):
    """What a comparison reads of a report, a prediction or imported times, besides the settings.

    `deviation`: for imported times, the standard error of every figure, as a share of the figure; None if unknown.
    """

    clock: str
    machine: dict[str, Any]
    frames: ComparedCounts | None = None
    frame_time_ms: Statistics
    latency_ms: Statistics
    stages: dict[str, ComparedStage]
    units: dict[str, ComparedUnit]
    bound: Bound | None = None
    other_programs: float | None = None
    accuracy: dict[str, Any] = Field(default={})
    check: dict[str, Any] | None = None
    deviation: float | None = None

    @field_validator("frame_time_ms")
    @classmethod
    def _takes_time(cls, times: Statistics) -> Statistics:
        if (mean := times.get("mean")) is not None and mean <= 0:
            raise ValueError(f"its mean is {mean:g} ms, and a frame takes more than 0")
        return times


@dataclass(frozen=True)
class ComparedRun:
    """One run of a side.

    `name`: name as the user gave it.
    `kind`: kind of its data.
    `figures`: figures of the run.
    `settings`: settings and facts of the machine, by dotted key, without keys that always differ.
    `unknown`: names in `PARTS` whose values are not known.
    `trust`: whether the times can be trusted. Predictions and imported times are not judged.
    `frames`: frames from the journal; None for a run without a journal.
    `remark`: remark for the user on a run without a report, "" for a run with a report.
    """

    name: str
    kind: RunKind
    figures: ComparedFigures
    settings: Mapping[str, Any]
    unknown: tuple[str, ...]
    trust: Trust
    frames: RunFrames | None = None
    remark: str = ""


def compared_run(
    name: str,
    kind: RunKind,
    document: Mapping[str, Any],
    frames: RunFrames | None = None,
    remark: str = "",
    unknown: tuple[str, ...] = (),
) -> ComparedRun:
    """Return the run of a `document`, which is JSON with the keys of a report. Parameters: see `ComparedRun`.

    Raises BadInputError if a key that a comparison reads is missing or wrong.
    """
    try:
        figures = ComparedFigures.model_validate(document)
    except ValidationError as error:
        raise _refused(f"{name}: ", error, EXPECTED) from None
    is_judged = kind in (RunKind.RUN, RunKind.REPORT)
    trust = trust_of(document) if is_judged else Trust(True, ())
    return ComparedRun(name, kind, figures, _settings(document), unknown, trust, frames, remark)


def _refused(where: str, error: ValidationError, expected: str) -> BadInputError:
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"])
    return BadInputError(f"{where}{key}".rstrip(".: "), first["msg"].lower().removeprefix("value error, "), expected)


@dataclass(frozen=True)
class Side:
    """One side of a comparison: one run, or several runs of one configuration. `name`: name as the user gave it."""

    name: str
    runs: tuple[ComparedRun, ...]


def read_side(text: str) -> Side:
    """Read the runs of a side.

    `text`: a path, or several paths joined by commas.
    Raises BadInputError for an empty name, for a run that is named twice, and as `read_told` does.
    """
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


def read_told(name: str) -> ComparedRun:
    """Read a run, report, prediction or imported times.

    `name`: path of a file or run folder, or name of a run as `trilane watch` accepts it.
    Raises BadInputError for a name that leads to no run or file, and for content that is broken or cannot be compared.
    """
    try:
        path = folder_of(Path(name)) or Path(name)
        if path.is_dir():
            return _of_folder(name, path)
    except OSError as error:
        raise BadInputError.of_os_error(name, error, EXPECTED) from None
    return _of_file(name, path)


def _of_file(name: str, path: Path) -> ComparedRun:
    found = _document(path)
    if isinstance(found.get(MEASUREMENTS), list):
        return compared_run(name, RunKind.TIMES, imported(found, path), unknown=PARTS)
    if all(key in found for key in OF_A_PREDICTION):
        return compared_run(name, RunKind.PREDICTION, found)
    if "networks" in found or "rows" in found:
        remedy = "the application with a network is predicted with --application"
        raise BadInputError(path, "predictions of bare networks or of a table", EXPECTED, remedy)
    return compared_run(name, RunKind.REPORT, read_report(path).as_json())


def _is_there(text: str) -> bool:
    try:
        return Path(text).exists()
    except OSError:  # several names together may be longer than one path may be
        return False


def _of_folder(name: str, path: Path) -> ComparedRun:
    journal = path / JOURNAL
    saved = [] if os.path.lexists(journal) else sorted(path.glob("*.json"))
    if saved and not os.path.lexists(path / REPORT_FILE):
        if len(saved) > 1:
            found = ", ".join(each.name for each in saved[:4])
            raise BadInputError(path, f"{len(saved)} documents ({found})", "one prediction", "name its file")
        return _of_file(name, saved[0])
    if not os.path.lexists(journal):
        return compared_run(name, RunKind.REPORT, read_report(path).as_json())
    if os.path.lexists(path / REPORT_FILE):
        return compared_run(name, RunKind.RUN, read_report(path).as_json(), read_frames(journal))
    frames = read_frames(journal)
    document, unknown = _journal_document(frames, journal)
    return compared_run(name, RunKind.RUN, document, frames, _without_report(path, frames), unknown)


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


def _journal_document(frames: RunFrames, path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return (keys of a report that a comparison reads, unknown names in `PARTS`) for a run without a report.

    Settings come from the journal's first record, and figures from the frames. If the run has ended, the figures in the
    last record replace these figures. Otherwise, the bound and the efficiencies so far are added.
    `frames`: frames of the journal.
    `path`: path of the journal.
    Raises BadInputError for facts of a wrong form.
    """
    facts = from_json(to_json(dict(frames.begun.facts)))
    for name in FACTS:
        if not isinstance(facts.get(name, {}), dict):
            raise BadInputError(f"{path}: {name}", repr(facts[name])[:80], "names and their values, as in report.json")
    found = {
        "clock": facts.get("clock", "host"),
        "policy": frames.begun.settings.policy,
        "config": facts.get("config", {}),
        "machine": facts.get("machine", {}),
        "accuracy": facts.get("accuracy", {}),
        "frames": _counts(frames),
        "frame_time_ms": _times(frames, Key("frame time")),
        "latency_ms": _times(frames, Key("latency")),
        "stages": {
            stage.name: {
                "unit": stage.unit,
                "service_ms": _times(frames, Key("service", stage.name)),
                "wait_ms": _times(frames, Key("wait", stage.name)),
            }
            for stage in frames.begun.graph.stages
        },
        "units": {unit: _unit(frames, unit, config_of(frames.begun)) for unit in frames.begun.graph.units},
        **{name: facts[name] for name in ("made",) if name in facts},
        **_at_the_end(frames, path),
    }
    if "edge" in found["config"]:
        found.setdefault("edge", found["config"]["edge"])
    return found, tuple(part for part in PARTS if part not in (facts if part in FACTS else found))


def _at_the_end(frames: RunFrames, path: Path) -> dict[str, Any]:
    """Return the figures of the whole run from the last record of a journal.

    If the run has not ended, return only the bound and the efficiencies so far.
    `frames`: frames of the journal.
    `path`: path of the journal.
    Raises BadInputError for figures of a wrong form.
    """
    if frames.ended is None:
        begun, records = frames.begun, read_journal(path)
        return dict(reckoned(begun.graph, begun.settings, places_of(begun), records).figures)
    return metrics_in(from_json(to_json(dict(frames.ended.report))), f"{path}, last record").as_json()


def _counts(frames: RunFrames) -> dict[str, Any]:
    """Return the numbers of frames so far, with the keys of `frames` in a report.

    `requested` is the sum of presented, lost and dropped frames; frames in flight do not count.
    """
    lost = dict(frames.counted.lost) if frames.counted else {}
    dropped = dict(frames.counted.dropped) if frames.counted else {}
    asked = frames.presented + sum(lost.values()) + sum(dropped.values())
    return {"requested": asked, "presented": frames.presented, "lost_by_cause": lost, "dropped": dropped}


def _times(frames: RunFrames, key: Key) -> dict[str, float]:
    series = frames.series[key]
    if not len(series.values):
        return {}
    return {name: float(STATISTICS[name](series.values, series.weights)) for name in ("mean", *COMPARED)}


def _unit(frames: RunFrames, unit: str, config: Mapping[str, Any]) -> dict[str, Any]:
    series = {key: each for key, each in frames.series.items() if key.of == unit and key.measure in ("busy", "idle")}
    shares = {key: float(each.values.sum() / each.weights.sum()) for key, each in series.items()}
    cores = config.get("units", {}).get(unit, {}).get("cores", ())
    return {
        "busy": shares[Key("busy", unit)],
        "idle": {key.cause: share for key, share in shares.items() if key.cause},
        "cores": tuple(cores),
    }


class Change(NamedTuple):
    """A setting or fact of the machine that differs between two runs.

    `key`: dotted key. `base`, `other`: values in the base and in the other run; None if a run lacks the key.
    """

    key: str
    base: Any
    other: Any


def changes(base: ComparedRun, other: ComparedRun) -> list[Change]:
    """Return the settings and facts of the machine that differ between two runs, without parts unknown for a run."""
    first, second = base.settings, other.settings
    found = dict.fromkeys([*first, *second])
    known = [part for part in PARTS if part not in (*base.unknown, *other.unknown)]
    keys = [key for part in known for key in found if key == part or key.startswith(f"{part}.")]
    return [Change(key, first.get(key), second.get(key)) for key in keys if first.get(key) != second.get(key)]


def _settings(document: Mapping[str, Any]) -> dict[str, Any]:
    units = {name: {"unit": stage["unit"]} for name, stage in document["stages"].items()}
    found: dict[str, Any] = {}
    for part in PARTS:
        value: Any = {**document, "stages": units}
        for key in part.split("."):
            value = value.get(key) if isinstance(value, Mapping) else None
        if value is not None:
            found.update(_flat(part, value))
    for key in TWICE:
        if f"config.{key}" in found:
            found.setdefault(key, found.pop(f"config.{key}"))
    return {key: value for key, value in found.items() if key not in ALWAYS_DIFFERENT}


def _flat(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from _flat(f"{name}.{key}", inner)
    elif isinstance(value, list) and any(isinstance(each, Mapping) for each in value):
        for place, inner in enumerate(value):
            yield from _flat(f"{name}.{place}", inner)
    else:
        yield name, value


MEASUREMENTS: Final = "measurements"
EXPECTED_TIMES: Final = "imported times: JSON with `measurements`, each with `name`, `kind` and `mean_ms`"
WALL: Final = "wall"
#: Name of the unknown unit of imported stages.
UNIT: Final = "imported"
#: Shortest plausible time, ms: a millionth of a nanosecond.
SHORTEST_MS = 1e-12
Ms = Annotated[float, Field(ge=0, le=LONGEST_MS)]


class ImportedTime(BaseModel):
    """An imported time, of a stage or of a whole run.

    `name`: name of the measurement, which is compared with the stage or measurement of the same name.
    `kind`: kind of the time, such as `run`, `layer` or `wall`.
    `count`: number of the single times. `sd_ms`: their standard deviation.
    `mean_ms`, `p50_ms`: mean and median of the single times.
    `samples_ms`: the single times, empty if the file does not have them.
    `file`: file of the measurement.
    Numbers that are unknown are None.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    name: str = Field(min_length=1)
    kind: str
    count: int | None = Field(default=None, ge=0, le=1 << 53)
    mean_ms: Ms | None = None
    sd_ms: Ms | None = None
    p50_ms: Ms | None = None
    samples_ms: tuple[Ms, ...] = ()
    file: str = ""

    @property
    def ms(self) -> float:
        """The mean in ms or, without a mean, the median; 0 for a measurement in another unit, such as cycles."""
        return self.mean_ms or self.p50_ms or 0.0

    @property
    def error(self) -> float | None:
        """The standard error of the mean, as a share of the mean; None if it is unknown."""
        count = len(self.samples_ms) or self.count or 0
        deviation = stdev(self.samples_ms) if len(self.samples_ms) > 1 else self.sd_ms
        return None if deviation is None or count < 2 else deviation / sqrt(count) / self.ms


def imported(document: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return those keys of a report that a comparison reads, from imported times.

    `document`: content of the file with imported times.
    `path`: path of the file.
    Raises BadInputError for a wrong value, for no time at all, for times of several files, and for a name that occurs
    twice.
    """
    rows = [_imported_time(row, f"{path}: {MEASUREMENTS}.{place}") for place, row in enumerate(document[MEASUREMENTS])]
    rows = [row for row in rows if row.ms >= SHORTEST_MS]
    if not rows:
        raise BadInputError(f"{path}: {MEASUREMENTS}", "no time", "one or more", "docs/compare.md has the keys")
    if len(files := {row.file for row in rows}) > 1:
        remedy = "give several runs of one kind as A.json,B.json"
        raise BadInputError(path, f"times of {len(files)} files", "the times of one file", remedy)
    rows = _told_apart(rows)
    names = [row.name for row in rows]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise BadInputError(f"{path}: {MEASUREMENTS}", f"{twice!r} twice", "each name once")
    walls = [row for row in rows if row.kind == WALL]
    frames = walls[0] if len(walls) == 1 else None  # the frame time
    return {
        "clock": HOST_CLOCK,
        "stages": {
            row.name: {"unit": UNIT, "service_ms": _imported_statistics(row)} for row in rows if row is not frames
        },
        "units": {},
        "config": {},
        "machine": {},
        "frame_time_ms": _imported_statistics(frames) if frames else {},
        "latency_ms": {},
        # The largest known standard error counts for every figure.
        "deviation": max((error for row in rows if (error := row.error) is not None), default=None),
    }


def _imported_time(row: Any, where: str) -> ImportedTime:
    try:
        return ImportedTime.model_validate(row)
    except ValidationError as error:
        raise _refused(f"{where}.", error, EXPECTED_TIMES) from None


def _told_apart(rows: Sequence[ImportedTime]) -> list[ImportedTime]:
    """Return `rows`, with the kind added to each name that several rows have."""
    counts = Counter(row.name for row in rows)
    longer = [row.model_copy(update={"name": f"{row.name} ({row.kind})"}) for row in rows]
    return [long if counts[row.name] > 1 else row for row, long in zip(rows, longer, strict=True)]


def _imported_statistics(row: ImportedTime) -> dict[str, float]:
    return {"mean": row.ms} | ({} if row.p50_ms is None else {"p50": row.p50_ms})
