"""One run, prediction or trial as a row: what was asked, its speed, its error, and where each comes from.

Rule: a figure is taken over from a document as it stands there; nothing is measured or guessed here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from trilane.figure_sources import COMPUTED, MEASURED, NO_FIGURES
from trilane.scene.schema import Scene

HOST = "host"
#: What an error is of, and what an interval of the frame time holds.
OF_RUN, OF_AVATAR = "errors of the runs themselves", "errors of the avatars' validations"
BY_SCATTER, BY_MODEL = "95 %, scatter of the run's frames", "80 %, of the model"
#: Keys of a scene that say how it is drawn, not what; another bundle may be another network of the same person.
HOW_DRAWN = (
    *("size", "plan", "texture_filter", "error_budget_px", "error_budget_db", "most_side", "memory_mb"),
    *("avatars[0].bundle", "avatars[0].name"),
)
#: The overview shows the values of these keys of a scene without the key. Every avatar has the keys of the first.
WITHOUT_KEY = ("name", "background", "output.width", "output.height", "camera.source", "avatars[0].motion")
#: Keys of a document's `config` that are no settings, or that the row has by other names.
NOT_SETTINGS = (
    "avatar_dirs",
    "shapes",
    "changes",
    "own_pixels",
    "works",
    "posed_vertices",
    "pace_ns",
    "units",
    "cuts",
    "record",
)


@dataclass(frozen=True)
class Entry:
    """`name`: of its folder or trial. `clock`: host or virtual. `machine`: in a line. `settings`: by dotted key.

    `command`: word by word; empty where none is known. `frame_ms`, `low_ms`, `high_ms`: mean frame time and its
    interval, None where there is none; `interval`: what that holds. `psnr_db`: the error, a mean;
    `worst_psnr_db`, `p1_psnr_db`: of a run's own frames, the worst and the 1st percentile; `error_source`: where it
    comes from, or why there is none; `error_of`: `OF_RUN` and against what, `OF_AVATAR`, or empty. `shows`: what the
    pictures are of. `video`: of a run. `failure`: why there are no figures. `within`: name of the folder of its run, or
    of its sweep.
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

    @property
    def speed_source(self) -> str:
        """Empty without a speed."""
        return "" if self.frame_ms is None else MEASURED if self.clock == HOST else COMPUTED

    @property
    def group(self) -> tuple[str, str, str, str]:
        """Entries of one group are compared with each other: their times and their errors mean the same."""
        return self.clock, self.machine, self.shows, self.error_of


def entry_of(
    name: str, document: Mapping[str, Any], video: Path | None = None, options: Mapping[str, Any] | None = None
) -> Entry:
    """The row of a report.json, of a prediction, or of a failed trial, which has a `failure` alone.

    `options`: of a trial, settings beside those of its document.
    """
    times, made = _mapping(document, "frame_time_ms"), _mapping(document, "made")
    machine, config = _mapping(document, "machine"), _mapping(document, "config")
    psnr_db, source, error_of = _error(document)
    check = _mapping(document, "check")
    low, high = _interval(times)
    return Entry(
        _text(name),
        str(document.get("clock", HOST)),
        _machine_line(machine),
        dict(_settings(config)) | dict(_settings(options or {})),
        tuple(map(_text, _sequence(made.get("command")))),
        _time(times.get("mean")),
        low,
        high,
        _time(document.get("fps")),
        _time(_mapping(document, "latency_ms").get("mean")),
        psnr_db,
        _number(check.get("worst_psnr_db")),
        _number(check.get("p1_psnr_db")),
        error_source=_text(source),
        facts=machine,
        video=video if video is not None and video.is_file() else None,
        failure=_text(document.get("failure") or ""),
        interval="" if low is None else BY_SCATTER if "mean_low" in times else BY_MODEL,
        error_of=error_of,
        shows=_shows(_mapping(config, "scene")),
    )


def _interval(times: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """That of the mean by a run's own frames, else that of a model."""
    names = ("mean_low", "mean_high") if "mean_low" in times else ("low", "high")
    low, high = (_time(times.get(name)) for name in names)
    return (None, None) if low is None or high is None else (low, high)


def _shows(scene: Mapping[str, Any]) -> str:
    """What the frames of `scene` are of, in words; a smaller tensor or another network shows the same.

    Whatever is not as usual is named by its key: two scenes of the same words show the same pictures.
    """
    output, camera = _mapping(scene, "output"), _mapping(scene, "camera")
    bodies = [body for body in _sequence(scene.get("avatars")) if isinstance(body, Mapping)]
    picture = f"{output.get('width')}x{output.get('height')}" if output else None
    parts = [scene.get("name"), picture, camera.get("source"), *(body.get("motion") for body in bodies)]
    return _text(", ".join(str(part) for part in [*parts, scene.get("background"), *_unusual(scene)] if part))


def _unusual(scene: Mapping[str, Any]) -> Iterator[str]:
    """Keys of `scene` with their values, such as `frames 60`, where a scene has others unless it says so."""
    usual = dict(_settings(Scene().model_dump(mode="json")))
    for key, value in _settings(scene):
        plain = re.sub(r"^avatars\[\d+\]", "avatars[0]", key)
        if plain not in (*HOW_DRAWN, *WITHOUT_KEY) and usual.get(plain) != value:
            yield f"{key} {value}"


def _error(document: Mapping[str, Any]) -> tuple[float | None, str, str]:
    """PSNR, where it comes from and what it is of: of the run itself where it was compared, else its avatars' least."""
    check = _mapping(document, "check")
    if (own := _number(check.get("psnr_db"))) is not None:
        against = f"against {str(check.get('against')).partition(':')[0]}"
        return own, f"{MEASURED}, {check.get('frames')} frames {against}", _text(f"{OF_RUN} {against}")
    avatars = [facts for facts in _mapping(document, "accuracy").values() if isinstance(facts, Mapping)]
    if not avatars:
        return None, NO_FIGURES, ""
    known = [(_number(facts.get("psnr_db")), str(facts.get("source", ""))) for facts in avatars]
    if any(value is None for value, _ in known):
        why = next((str(facts["why"]) for facts in avatars if facts.get("why")), "")
        return None, f"{NO_FIGURES}: {why}" if why else NO_FIGURES, ""
    least, source = min((value, source) for value, source in known if value is not None)
    return least, source, OF_AVATAR


def _settings(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """The leaves of `config` by dotted key."""
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
    """`value` as text that any file can hold: half a surrogate pair, as of a file's name that is no UTF-8, is a `?`."""
    return str(value).encode("utf-8", "replace").decode("utf-8")


def _number(value: Any) -> float | None:
    """None for what is no number, and for NaN, infinities and integers beyond a float, which JSON may hold."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _time(value: Any) -> float | None:
    """A number above 0."""
    number = _number(value)
    return number if number is not None and number > 0 else None


def varied(entries: list[Entry]) -> list[str]:
    """The settings of which two entries have different values, in the order in which they first stand."""
    keys = dict.fromkeys(key for entry in entries for key in entry.settings)
    return [key for key in keys if len({entry.settings[key] for entry in entries if key in entry.settings}) > 1]
