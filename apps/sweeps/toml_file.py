"""Reads the file of a sweep (TOML).

Rule: the first defect is named with its key. Whether its options are those of the command is not known here.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from trilane.apps.sweeps.definition import Kind, kind_named
from trilane.errors import BadInputError, did_you_mean
from trilane.files import read_text

EXPECTED = "a sweep (docs/sweeps.md)"
#: Key: the type of its value, and what that is called.
KEYS: dict[str, tuple[type, str]] = {
    "command": (str, "a command in quotes, such as 'run' or 'bench raster'"),
    "kind": (str, "grid, list or random"),
    "count": (int, "a whole number"),
    "seed": (int, "a whole number"),
    "repeats": (int, "a whole number"),
    "options": (dict, "a table of options"),
    "axes": (dict, "a table of lists"),
}


@dataclass(frozen=True)
class SweepFile:
    """What a file says; values of options as it has them."""

    command: tuple[str, ...]
    kind: Kind = Kind.GRID
    count: int | None = None
    seed: int = 0
    repeats: int = 1
    options: dict[str, Any] = field(default_factory=dict)
    axes: dict[str, list[Any]] = field(default_factory=dict)


def read_sweep(path: Path) -> SweepFile:
    """Raises BadInputError when the file cannot be read or is no sweep."""
    try:
        data = tomllib.loads(read_text(path, EXPECTED))
    except (ValueError, RecursionError) as error:  # also of numbers and lists that are too long
        raise BadInputError(path, f"no TOML ({error})", EXPECTED) from error
    for key, value in data.items():
        _check(path, key, value)
    if not data.get("command", "").split():
        raise BadInputError(f"{path}: command", "nothing", KEYS["command"][1])
    if data.get("repeats", 1) < 1:
        raise BadInputError(f"{path}: repeats", str(data["repeats"]), "1 or more")
    for name, values in data.get("axes", {}).items():
        if not isinstance(values, list):
            raise BadInputError(f"{path}: axes.{name}", repr(values), "a list", "a single value goes under [options]")
    kind = kind_named(f"{path}: kind", data.get("kind", Kind.GRID))
    for key in ("count", "seed"):
        if key in data and kind is not Kind.RANDOM:
            raise BadInputError(f"{path}: {key}", f"{key} of a {kind}", "kind = 'random' beside it")
    return SweepFile(**{**data, "kind": kind, "command": tuple(data["command"].split())})


def _check(path: Path, key: str, value: object) -> None:
    if key not in KEYS:
        remedy = did_you_mean(key, KEYS) or "options go under [options] or [axes]"
        raise BadInputError(f"{path}: {key}", "an unknown key", f"one of {', '.join(KEYS)}", remedy)
    kind, expected = KEYS[key]
    if not isinstance(value, kind) or isinstance(value, bool):
        raise BadInputError(f"{path}: {key}", repr(value), expected)
