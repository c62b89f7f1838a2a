"""Many runs, predictions and trials as one table: options, speed, error, and the source of each.

Rule: figures are copied from documents, never measured or guessed. Every speed has its image error beside it, or a note
that the error is unknown. Page, CSV and Parquet have the same columns and numbers. The size of a file is checked before
the file is read. A file that cannot be read is refused by name before anything is written.
"""

from __future__ import annotations

import csv
import json
import math
import re
import shlex
from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

from trilane.apps.compare.frontier import SAME_DB, frontier, knees
from trilane.apps.run.report import MAX_REPORT_BYTES, REPORT_FILE
from trilane.apps.sweep.store import TRIALS, TrialRecord, read_trials
from trilane.errors import BadInputError, MissingPartError
from trilane.files import instead_of_file, require_file
from trilane.hw_profiles.schema import SHARE_TEXT
from trilane.scene.schema import Scene
from trilane.scheduler.stats import CONFIDENCE_TEXT
from trilane.units import COMPUTED, HOST_CLOCK, MEASURED, NO_FIGURES
from trilane.writing import write_atomically

#: Origins of an image error.
OF_RUN, OF_AVATAR = "errors of the runs themselves", "errors of the avatars' validations"
#: Kinds of an interval of the frame time.
BY_SCATTER, BY_MODEL = f"{CONFIDENCE_TEXT}, scatter of the run's frames", f"{SHARE_TEXT}, of the model"
#: Keys of a scene that do not change its content. Another bundle may be another network of the same person.
HOW_DRAWN = (
    *("size", "plan", "texture_filter", "error_budget_px", "error_budget_db", "most_side", "memory_mb"),
    *("avatars[0].bundle", "avatars[0].name"),
)
#: Keys of a scene whose values are shown without the key. The keys of the first avatar hold for every avatar.
WITHOUT_KEY = ("name", "background", "output.width", "output.height", "camera.source", "avatars[0].motion")
#: Keys of a document's `config` that are no settings, or that the row has under other names.
NOT_SETTINGS = (
    *("avatar_dirs", "networks", "shapes", "changes", "own_pixels", "size_curves"),
    *("works", "posed_vertices", "pace_ns", "units", "cuts", "record"),
)
VIDEO = "video.mp4"
EXPECTED = "a run folder, a sweep's folder, a prediction that was saved with --json, or a folder of these"
MOST = 10_000
FIGURES = (
    *("frame_ms", "low_ms", "high_ms", "psnr_db", "on_frontier"),
    *("verdict", "bound", "trust", "other_programs"),
    *("frames_per_s", "latency_ms", "worst_psnr_db", "p1_psnr_db"),
)
SOURCES = ("speed_source", "interval", "error_source", "shows", "clock", "machine", "failure", "trial", "command")


def read_entries(places: Sequence[Path]) -> list[Entry]:
    """Read the entries of all `places`, in order.

    If several entries have the same name, the name of the folder around each of them is added in front. In a folder of
    runs and sweeps, a run or sweep that cannot be read becomes an entry with a `failure`.
    `places`: run folders, folders of sweeps, saved predictions, or folders of runs and sweeps.
    Raises BadInputError for a place that cannot be read or has no entries, and for more than `MOST` entries.
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
    elif (place / REPORT_FILE).is_file():
        yield replace(entry_of(place.name, _document(place / REPORT_FILE), place / VIDEO), within=within)
    elif (place / TRIALS).is_file():
        trials = list(read_trials(place).values())
        for name, trial in zip(_names(trials), trials, strict=True):
            yield replace(_trial(place, trial, name), within=place.absolute().name)
    else:
        for folder in sorted(path for path in place.iterdir() if path.is_dir() and path.suffix != ".partial"):
            if (folder / REPORT_FILE).is_file() or (folder / TRIALS).is_file():
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


def _names(trials: Sequence[TrialRecord]) -> list[str]:
    """Return names for the trials of one sweep: the values of the options that differ, such as `256, openvino`.

    If several of these options have numbers, these options are written with their names. An option that is on or off is
    written as `key` or `no key`. If several trials would have the same name, the number of the repeat is added to each.
    If their names are still the same, the id is added. A trial without any such option is named by its id.
    `trials`: last record of each trial.
    """
    options = [dict(_settings(trial.options)) for trial in trials]
    keys = [key for key in dict.fromkeys(chain(*options)) if len({each.get(key) for each in options}) > 1]
    numbers = [key for key in keys if all(_is_number(each.get(key, "")) for each in options)]
    with_key = set(numbers) if len(numbers) > 1 else set()
    parts = [[_named(key, each.get(key), key in with_key) for key in keys] for each in options]
    names = [", ".join(filter(None, each)) for each in parts]
    for own in ([f"repeat {trial.repeat}" for trial in trials], [_text(trial.id) for trial in trials]):
        counts = Counter(names)
        names = [
            ", ".join(filter(None, (name, own[number]))) if counts[name] > 1 else name
            for number, name in enumerate(names)
        ]
    return [name or _text(trial.id) for name, trial in zip(names, trials, strict=True)]


def _named(key: str, value: str | None, has_key: bool) -> str:
    if value is None:
        return ""
    if value == "False":
        return f"no {key}"
    if value == "True":
        return key
    return f"{key} {value}" if has_key else str(value)


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _trial(folder: Path, trial: TrialRecord, name: str) -> Entry:
    document = {"clock": trial.clock, "machine": trial.host, **(trial.result or {})}
    document["made"] = {**_mapping(document, "made"), "command": list(trial.command)}
    if trial.status != "done":
        ended = f"{trial.status}, exit code {trial.exit_code}"
        document["failure"] = f"{ended}: {trial.error}" if trial.error else ended
    entry = entry_of(name, document, _video(folder, trial.folder), trial.options)
    return replace(entry, trial=_text(trial.id))


def _video(folder: Path, name: str | None) -> Path | None:
    """Return the path of the video in a trial's run folder.

    None is returned without a run folder or a video, or if its name leads out of the sweep's folder.
    `folder`: folder of the sweep.
    `name`: name of the run folder from the trial's record.
    """
    if name is None:
        return None
    try:
        place = (folder / name).resolve() / VIDEO
        return place if place.is_relative_to(folder.resolve()) and place.is_file() else None
    except (OSError, ValueError):  # a name that is too long, or with a NUL
        return None


@dataclass(frozen=True)
class Entry:
    """One run, prediction or trial as a row of the table.

    `name`: name of its folder, or the options in which its trial differs from others. `trial`: id of its trial, "" for
    a run or prediction.
    `within`: name of the folder around the run folder; for a trial, name of the sweep's folder.
    `clock`: host or virtual. `machine`: the machine in one line. `facts`: facts about the machine.
    `settings`: values by dotted key. `command`: words of the command, empty if it is unknown.
    `frame_ms`, `low_ms`, `high_ms`: mean frame time and the ends of its interval, None if unknown.
    `interval`: kind of the interval: `BY_SCATTER`, `BY_MODEL`, or "" without an interval.
    `frames_per_s`: frame rate. `latency_ms`: mean latency. Both are None if unknown.
    `psnr_db`: mean PSNR over frames. `worst_psnr_db`, `p1_psnr_db`: worst frame and 1st percentile of a run's own
    frames. All are None if unknown.
    `error_source`: source of the PSNR, or why the PSNR is unknown. `error_of`: `OF_RUN` with the reference pictures,
    `OF_AVATAR`, or "" without a PSNR.
    `failure`: why the run or trial failed, or why it cannot be read; "" for neither.
    `verdict`: PASS or FAIL, with the target rate. `bound`: the unit and the stages that bound the run. `trust`: "sure"
    or "UNSURE". All are "" if unknown.
    `other_programs`: share of the time of its cores that other programs had, None if unknown.
    `video`: video of a run, None if the file is missing. `shows`: content of the pictures in words.
    """

    name: str
    clock: str
    machine: str
    settings: Mapping[str, str]
    command: tuple[str, ...] = ()
    frame_ms: float | None = None
    low_ms: float | None = None
    high_ms: float | None = None
    frames_per_s: float | None = None
    latency_ms: float | None = None
    psnr_db: float | None = None
    worst_psnr_db: float | None = None
    p1_psnr_db: float | None = None
    error_source: str = NO_FIGURES
    facts: Mapping[str, Any] = field(default_factory=dict)
    video: Path | None = None
    failure: str = ""
    interval: str = ""
    error_of: str = ""
    shows: str = ""
    within: str = ""
    verdict: str = ""
    bound: str = ""
    trust: str = ""
    other_programs: float | None = None
    trial: str = ""

    @property
    def speed_source(self) -> str:
        """The source of the speed, measured or computed; "" without a speed."""
        return "" if self.frame_ms is None else MEASURED if self.clock == HOST_CLOCK else COMPUTED

    @property
    def group(self) -> tuple[str, str, str, str]:
        """The key of the entry's group: clock, machine, content of the pictures, and kind of error.

        Only entries of one group are compared, because only their times and errors have the same meaning.
        """
        return self.clock, self.machine, self.shows, self.error_of


def entry_of(
    name: str, document: Mapping[str, Any], video: Path | None = None, options: Mapping[str, Any] | None = None
) -> Entry:
    """Return the entry of a run, a prediction or a trial.

    `name`: name of the entry.
    `document`: content of the report or prediction. For a failed trial, it has a `failure` and may lack all figures.
    `video`: path of the video, which may be missing; None for a run without a video.
    `options`: options of a trial, which are added to the settings; None for no trial.
    """
    times, made = _mapping(document, "frame_time_ms"), _mapping(document, "made")
    machine, config = _mapping(document, "machine"), _mapping(document, "config")
    psnr_db, source, error_of = _error(document)
    check = _mapping(document, "check")
    low, high = _interval(times)
    return Entry(
        _text(name),
        str(document.get("clock", HOST_CLOCK)),
        _machine_line(machine),
        dict(_settings(config)) | dict(_settings(options or {})),
        tuple(map(_text, _sequence(made.get("command")))),
        _time(times.get("mean")),
        low,
        high,
        _time(document.get("fps")),
        _time(_mapping(document, "latency_ms").get("mean")),
        psnr_db,
        number_of(check.get("worst_psnr_db")),
        number_of(check.get("p1_psnr_db")),
        error_source=_text(source),
        facts=machine,
        video=video if video is not None and video.is_file() else None,
        failure=_text(document.get("failure") or ""),
        **_verdict(_mapping(document, "verdict")),
        interval="" if low is None else BY_SCATTER if "mean_low" in times else BY_MODEL,
        error_of=error_of,
        shows=_shows(_mapping(config, "scene")),
        other_programs=number_of(document.get("other_programs")),
    )


def _verdict(verdict: Mapping[str, Any]) -> dict[str, str]:
    """Return the fields `verdict`, `bound` and `trust` of an entry; no fields if `verdict` is empty.

    `verdict`: key `verdict` of a report or prediction.
    """
    if not verdict:
        return {}
    bound = _mapping(verdict, "bound")
    named = f"{bound.get('unit')}: {' + '.join(map(str, _sequence(bound.get('stages'))))}" if bound else ""
    passed = f"{'PASS' if verdict.get('pass') is True else 'FAIL'} at {number_of(verdict.get('target_fps')) or 0:g} fps"
    trust = "sure" if verdict.get("trusted") is True else "UNSURE"
    return {"verdict": _text(passed), "bound": _text(named), "trust": trust}


def _interval(times: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """Return the lower and upper end of the interval of the mean frame time, ms; (None, None) if it is unknown.

    The interval from a run's own frames is preferred to the interval of a model.
    `times`: key `frame_time_ms` of a report or prediction.
    """
    names = ("mean_low", "mean_high") if "mean_low" in times else ("low", "high")
    low, high = (_time(times.get(name)) for name in names)
    return (None, None) if low is None or high is None else (low, high)


def _shows(scene: Mapping[str, Any]) -> str:
    """Return the content of the pictures of `scene` in words. Scenes with the same words show the same pictures.

    The size of the tensor and the network do not change these words. Content that differs from the defaults is named
    with its key.
    `scene`: key `scene` of a document's `config`.
    """
    output, camera = _mapping(scene, "output"), _mapping(scene, "camera")
    bodies = [body for body in _sequence(scene.get("avatars")) if isinstance(body, Mapping)]
    picture = f"{output.get('width')}x{output.get('height')}" if output else None
    parts = [scene.get("name"), picture, camera.get("source"), *(body.get("motion") for body in bodies)]
    return _text(", ".join(str(part) for part in [*parts, scene.get("background"), *_unusual(scene)] if part))


def _unusual(scene: Mapping[str, Any]) -> Iterator[str]:
    """Yield key and value of the settings of `scene` that differ from the defaults, such as `frames 60`.

    Settings in `HOW_DRAWN` and `WITHOUT_KEY` are left out.
    """
    usual = dict(_settings(Scene().model_dump(mode="json")))
    for key, value in _settings(scene):
        plain = re.sub(r"^avatars\[\d+\]", "avatars[0]", key)
        if plain not in (*HOW_DRAWN, *WITHOUT_KEY) and usual.get(plain) != value:
            yield f"{key} {value}"


def _error(document: Mapping[str, Any]) -> tuple[float | None, str, str]:
    """Return the fields `psnr_db`, `error_source` and `error_of` of an entry.

    If the frames of a run were checked, the PSNR is the run's. Otherwise, it is the PSNR of the worst avatar, or
    None if the PSNR of any avatar is unknown.
    `document`: report or prediction.
    """
    check = _mapping(document, "check")
    if (own := number_of(check.get("psnr_db"))) is not None:
        against = f"against {str(check.get('against')).partition(':')[0]}"
        return own, f"{MEASURED}, {check.get('frames')} frames {against}", _text(f"{OF_RUN} {against}")
    avatars = [facts for facts in _mapping(document, "accuracy").values() if isinstance(facts, Mapping)]
    if not avatars:
        return None, NO_FIGURES, ""
    known = [(number_of(facts.get("psnr_db")), str(facts.get("source", ""))) for facts in avatars]
    if any(value is None for value, _ in known):
        why = next((str(facts["why"]) for facts in avatars if facts.get("why")), "")
        return None, f"{NO_FIGURES}: {why}" if why else NO_FIGURES, ""
    least, source = min((value, source) for value, source in known if value is not None)
    return least, source, OF_AVATAR


def _settings(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield (dotted key, value as text) for each value in the nested mapping `config`, without None and `NOT_SETTINGS`.

    `prefix`: start of the dotted keys.
    """
    for key, value in config.items():
        if not prefix and key in NOT_SETTINGS:
            continue
        if isinstance(value, Mapping):
            yield from _settings(value, f"{prefix}{key}.")
        elif isinstance(value, list) and all(isinstance(each, Mapping) for each in value):
            for number, each in enumerate(value):
                yield from _settings(each, f"{prefix}{key}[{number}].")
        elif value is not None:
            yield _text(f"{prefix}{key}"), f"{value:g}" if isinstance(value, float) else _text(value)


def _machine_line(machine: Mapping[str, Any]) -> str:
    cpu, gl = _mapping(machine, "cpu"), _mapping(machine, "gl")
    if cpu:
        cores = len(_sequence(cpu.get("cores_allowed")))
        return _text(f"{cpu.get('model')}, {cores} cores, {gl.get('renderer', 'no OpenGL')}")
    return _text(machine.get("title") or machine.get("profile") or "a machine that is not named")


def _mapping(document: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    found = document.get(key)
    return found if isinstance(found, Mapping) else {}


def _sequence(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _text(value: Any) -> str:
    """Return `value` as text that UTF-8 can encode. A lone surrogate, as in a file name without UTF-8, becomes `?`."""
    return str(value).encode("utf-8", "replace").decode("utf-8")


def number_of(value: Any) -> float | None:
    """Return `value` as a finite float.

    None is returned for a value that is no number, not finite, or too large for a float.
    """
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _time(value: Any) -> float | None:
    """Return `value` as a float if it is a finite number above 0, otherwise None."""
    number = number_of(value)
    return number if number is not None and number > 0 else None


def varied(entries: Sequence[Entry]) -> list[str]:
    """Return the keys of settings that differ between the `entries` with such a key, in the order of appearance."""
    keys = dict.fromkeys(key for entry in entries for key in entry.settings)
    return [key for key in keys if len({entry.settings[key] for entry in entries if key in entry.settings}) > 1]


def told_choices(entries: Sequence[Entry]) -> Iterator[str]:
    """Yield a sentence about each group with two or more entries that have a frame time and a PSNR.

    The sentence names the knee of the group. For a group without a knee, it names the quickest entry and the one with
    the best picture.
    """
    at = knees(entries)
    known: dict[Hashable, dict[int, tuple[float, float, str]]] = {}
    for number, entry in enumerate(entries):
        if entry.frame_ms is not None and entry.psnr_db is not None:
            held = f" ({entry.verdict}, {entry.trust})" if entry.verdict else ""
            known.setdefault(entry.group, {})[number] = (entry.frame_ms, entry.psnr_db, f"{entry.name}{held}")
    for group, rows in known.items():
        quick_ms, quick_db, quickest = min(rows.values(), key=lambda row: (row[0], -row[1]))
        top_db = max(db for _, db, _ in rows.values())
        best_ms, best_db, best = min(row for row in rows.values() if row[1] >= top_db - SAME_DB)
        if group in at:
            ms, db, knee = rows[at[group]]
            yield (
                f"Knee: {knee} has {ms:.1f} ms a frame and {db:.1f} dB. The best picture, {best}, takes "
                f"{best_ms - ms:.1f} ms more for {best_db - db:.2f} dB. The quickest, {quickest}, saves "
                f"{ms - quick_ms:.1f} ms and loses {db - quick_db:.1f} dB."
            )
        elif quickest == best and len(rows) > 1:
            yield f"Best: {best} has {best_ms:.1f} ms a frame and {best_db:.1f} dB, the quickest and the best picture."
        elif len(rows) > 1:
            yield (
                f"No knee: the quickest, {quickest}, has {quick_ms:.1f} ms a frame and {quick_db:.1f} dB. The best "
                f"picture, {best}, takes {best_ms - quick_ms:.1f} ms more for {best_db - quick_db:.2f} dB."
            )


def table_rows(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Return a row for each entry: values by the names of the columns; None for a missing value.

    The columns are `name`, the settings in which `entries` differ, `FIGURES` and `SOURCES`.
    """
    settings = varied(entries)
    return [
        {
            "name": entry.name,
            **{key: entry.settings.get(key) for key in settings},
            **{key: on if key == "on_frontier" else getattr(entry, key) for key in FIGURES},
            **{key: getattr(entry, key) for key in SOURCES[:-1]},
            "command": shlex.join(entry.command),
        }
        for entry, on in zip(entries, frontier(entries), strict=True)
    ]


def write_csv(target: Path, entries: Sequence[Entry]) -> None:
    """Write the table of `entries`, one or more, as CSV into the file `target`.

    Raises BadInputError if `target` cannot be written.
    """
    with write_atomically(target) as draft, draft.open("w", encoding="utf-8", newline="") as file:
        rows = table_rows(entries)
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def write_parquet(target: Path, entries: Sequence[Entry]) -> None:
    """Write the table of `entries` as Parquet into the file `target`.

    Raises MissingPartError without pyarrow, BadInputError if `target` cannot be written.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise MissingPartError(f"a table as Parquet needs {error.name or 'pyarrow'}", extra="table") from None
    with write_atomically(target) as draft:
        parquet.write_table(pyarrow.Table.from_pylist(table_rows(entries)), draft)
