"""One run, prediction or trial as a row: what was asked, its speed, its error, and where each comes from.

Rule: a figure is taken over from a document as it stands there; nothing is measured or guessed here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from trilane.figure_sources import COMPUTED, MEASURED, NO_FIGURES

HOST = "host"
#: Keys of a document's `config` that are no settings, or that the row has by other names.
NOT_SETTINGS = ("avatar_dirs", "shapes", "own_pixels", "works", "posed_vertices", "pace_ns", "units", "cuts", "record")


@dataclass(frozen=True)
class Entry:
    """`name`: of its folder or trial. `clock`: host or virtual. `machine`: in a line. `settings`: by dotted key.

    `command`: word by word; empty where none is known. `frame_ms`, `low_ms`, `high_ms`: mean frame time and its 95 %
    interval, None where there is none. `psnr_db`: the error; `error_source`: where it comes from, or why there is none.
    `video`: of a run. `failure`: why there are no figures.
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
    error_source: str = NO_FIGURES
    facts: Mapping[str, Any] = field(default_factory=dict)
    video: Path | None = None
    failure: str = ""

    @property
    def speed_source(self) -> str:
        return MEASURED if self.clock == HOST else COMPUTED

    @property
    def group(self) -> tuple[str, str]:
        """Entries of one group are compared with each other: those of one clock and machine."""
        return self.clock, self.machine


def entry_of(name: str, document: Mapping[str, Any], video: Path | None = None) -> Entry:
    """The row of a report.json, of a prediction, or of a failed trial, which has a `failure` alone."""
    times, made = _mapping(document, "frame_time_ms"), _mapping(document, "made")
    machine = _mapping(document, "machine")
    psnr_db, source = _error(document)
    return Entry(
        name,
        str(document.get("clock", HOST)),
        _machine_line(machine),
        dict(_settings(_mapping(document, "config"))),
        tuple(map(str, made.get("command") or ())),
        _number(times.get("mean")),
        _number(times.get("mean_low", times.get("low"))),
        _number(times.get("mean_high", times.get("high"))),
        _number(document.get("fps")),
        _number(_mapping(document, "latency_ms").get("mean")),
        psnr_db,
        source,
        machine,
        video if video is not None and video.is_file() else None,
        str(document.get("failure") or ""),
    )


def _error(document: Mapping[str, Any]) -> tuple[float | None, str]:
    """The least PSNR of the avatars; that of the run itself where it was compared with the reference."""
    check = _mapping(document, "check")
    if (own := _number(check.get("psnr_db"))) is not None:
        return own, f"{MEASURED}, {check.get('frames')} frames"
    avatars = [facts for facts in _mapping(document, "accuracy").values() if isinstance(facts, Mapping)]
    if not avatars:
        return None, NO_FIGURES
    known = [(_number(facts.get("psnr_db")), str(facts.get("source", ""))) for facts in avatars]
    if any(value is None for value, _ in known):
        why = next((str(facts["why"]) for facts in avatars if facts.get("why")), "")
        return None, f"{NO_FIGURES}: {why}" if why else NO_FIGURES
    return min((value, source) for value, source in known if value is not None)


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
            yield f"{prefix}{key}", f"{value:g}" if isinstance(value, float) else str(value)


def _machine_line(machine: Mapping[str, Any]) -> str:
    cpu, gl = _mapping(machine, "cpu"), _mapping(machine, "gl")
    if cpu:
        return f"{cpu.get('model')}, {len(cpu.get('cores_allowed') or ())} cores, {gl.get('renderer', 'no OpenGL')}"
    return str(machine.get("title") or machine.get("profile") or "a machine that is not named")


def _mapping(document: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    found = document.get(key)
    return found if isinstance(found, Mapping) else {}


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def varied(entries: list[Entry]) -> list[str]:
    """The settings of which two entries have different values, in the order in which they first stand."""
    keys = dict.fromkeys(key for entry in entries for key in entry.settings)
    return [key for key in keys if len({entry.settings[key] for entry in entries if key in entry.settings}) > 1]
