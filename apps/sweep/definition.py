"""Defines a sweep: a command with fixed options and axes, its named trials, and its TOML file.

Rule: the same definition gives the same trials in the same order on every machine. A trial's name is a hash of its
command, options and repeat alone, not of machine, folder or time. An error names the first defect of a file with its
key. This module does not know the options of any command.
"""

from __future__ import annotations

import hashlib
import json
import math
import random
import shlex
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from trilane.errors import BadInputError, did_you_mean
from trilane.files import read_text

#: Value of an option, as its command converts it; a list for an option that collects several.
Value = str | int | float | bool | list[Any]
Options = Mapping[str, Value]
ID_DIGITS = 16
MOST_TRIALS = 100_000
EXPECTED = "a sweep (docs/sweeps.md)"
#: Key -> the type of its value, and how messages describe such a value.
KEYS: dict[str, tuple[type, str]] = {
    "command": (str, "a command in quotes, such as 'run' or 'bench raster'"),
    "kind": (str, "grid, list or random"),
    "count": (int, "a whole number"),
    "seed": (int, "a whole number"),
    "repeats": (int, "a whole number"),
    "options": (dict, "a table of options"),
    "axes": (dict, "a table of lists"),
}


class SweepKind(StrEnum):
    """How the values of the axes are combined.

    GRID: every combination. LIST: the n-th values of all axes, for each n. RANDOM: a sample of GRID.
    """

    GRID = "grid"
    LIST = "list"
    RANDOM = "random"


@dataclass(frozen=True)
class Definition:
    """A sweep to be done.

    `command`: words of the command. `options`: fixed options and their values.
    `axes`: option -> values to try, at least one. `kind`: how the values of the axes are combined.
    `count`: number of configurations that RANDOM draws; None for GRID and LIST. `seed`: seed of RANDOM.
    `repeats`: number of trials of each configuration.
    """

    command: tuple[str, ...]
    options: Options = field(default_factory=dict)
    axes: Mapping[str, Sequence[Value]] = field(default_factory=dict)
    kind: SweepKind = SweepKind.GRID
    count: int | None = None
    seed: int = 0
    repeats: int = 1


def trials_of(definition: Definition, words: Callable[[Options], Sequence[str]]) -> list[Trial]:
    """Return the trials of a sweep in their order. The last axis changes fastest.

    All configurations run once before any is repeated: if the machine slows down, all configurations slow down.

    `definition`: the sweep. `words`: function that returns options as the words of a command line.

    Raises BadInputError for an axis without values or with the name of a fixed option, and for axes of unequal length
    in a LIST. Raises it also for a `count` out of range, more than `MOST_TRIALS` trials, and a trial given twice.
    """
    configurations = [*_configurations(definition)]
    made = [
        Trial(definition.command, options, tuple(words(options)), repeat)
        for repeat in range(1, definition.repeats + 1)
        for options in configurations
    ]
    seen: set[str] = set()
    for trial in made:
        if trial.id in seen:
            raise BadInputError("axes", f"{trial.line} twice", "each trial once", "repeats = 2 measures it again")
        seen.add(trial.id)
    return made


def _configurations(definition: Definition) -> Iterator[Options]:
    _check(definition)
    names = list(definition.axes)
    if definition.kind is SweepKind.LIST and names:
        combinations: Iterator[Sequence[Value]] = zip(*definition.axes.values(), strict=True)
    else:
        combinations = (_combination(definition, number) for number in _numbers(definition))
    for values in combinations:
        yield {**definition.options, **dict(zip(names, values, strict=True))}


def _check(definition: Definition) -> None:
    for name in definition.axes:
        if not definition.axes[name]:
            raise BadInputError(f"axes.{name}", "no value", "at least one")
        if name in definition.options:
            raise BadInputError(f"axes.{name}", "an axis that is a fixed option too", "one of them")
    lengths = {name: len(values) for name, values in definition.axes.items()}
    if definition.kind is SweepKind.LIST and len(set(lengths.values())) > 1:
        found = ", ".join(f"{count} of {name}" for name, count in lengths.items())
        raise BadInputError("axes", found, "as many values of each", "a list takes the axes side by side")
    if _count(definition) * definition.repeats > MOST_TRIALS:
        found = f"{_count(definition) * definition.repeats} trials"
        raise BadInputError("axes", found, f"at most {MOST_TRIALS}", "draw some of them: kind = 'random' with a count")


def _count(definition: Definition) -> int:
    """Return the number of configurations. Raises BadInputError if the `count` of RANDOM is missing or out of range."""
    if definition.kind is SweepKind.LIST:
        return max((len(values) for values in definition.axes.values()), default=1)
    whole = math.prod(len(values) for values in definition.axes.values())
    if definition.kind is SweepKind.GRID:
        return whole
    if definition.count is None or not 1 <= definition.count <= whole:
        found = "none" if definition.count is None else str(definition.count)
        raise BadInputError("count", found, f"1 to {whole}", "so many combinations the axes have")
    return definition.count


def _numbers(definition: Definition) -> Sequence[int]:
    """Return the numbers of the combinations to try, ascending: the whole grid or, for RANDOM, a sample of the grid."""
    whole = math.prod(len(values) for values in definition.axes.values())
    if definition.kind is SweepKind.RANDOM:
        return sorted(random.Random(definition.seed).sample(range(whole), _count(definition)))
    return range(whole)


def _combination(definition: Definition, number: int) -> list[Value]:
    """Return the values of combination `number` of the grid, one for each axis. The last axis changes fastest."""
    digits: list[Value] = []
    for values in reversed(list(definition.axes.values())):
        number, place = divmod(number, len(values))
        digits.append(values[place])
    return digits[::-1]


class TrialClock(StrEnum):
    """The clock of a trial.

    HOST: the trial measures, and needs its machine for itself. VIRTUAL: the trial computes times.
    """

    HOST = "host"
    VIRTUAL = "virtual"


@dataclass(frozen=True)
class TriedCommand:
    """A command that a sweep can try.

    `clock`: clock of the command's trials. `has_folder`: whether the command writes a run folder.
    """

    clock: TrialClock
    has_folder: bool = False


#: Commands that a sweep can try, by their first word.
COMMANDS = {
    "run": TriedCommand(TrialClock.HOST, has_folder=True),
    "predict": TriedCommand(TrialClock.VIRTUAL),
    "quality": TriedCommand(TrialClock.HOST),
    "bench": TriedCommand(TrialClock.HOST),
}


@dataclass(frozen=True)
class Trial:
    """One configuration of a command, to be run once.

    `command`: words of the command, such as `bench raster`. `options`: values by the option's name, without dashes.
    `words`: options and values as words of a command line. `repeat`: number of the repeat, from 1 on.
    """

    command: tuple[str, ...]
    options: Options
    words: tuple[str, ...]
    repeat: int = 1

    @cached_property
    def id(self) -> str:
        """The name of the trial: the first 16 hexadecimal digits of the SHA-256 of `canonical`."""
        return hashlib.sha256(canonical(self.command, self.options, self.repeat).encode()).hexdigest()[:ID_DIGITS]

    @property
    def arguments(self) -> list[str]:
        """The words of the trial's command line after `trilane`."""
        return [*self.command, *self.words, "--json"]

    @property
    def line(self) -> str:
        """The command line that repeats the trial by hand. It names no run folder."""
        return shlex.join(["trilane", *self.arguments])

    @property
    def kind(self) -> TriedCommand:
        return COMMANDS[self.command[0]]


def canonical(command: tuple[str, ...], options: Options, repeat: int = 1) -> str:
    """Return a configuration as JSON with the keys `command`, `options` and `repeat`, without spaces, keys sorted.

    The first repeat has no key `repeat`. Therefore the trials of a sweep keep their names if the sweep gets more
    repeats. Parameters: see `Trial`. Raises ValueError for NaN and infinities.
    """
    named: dict[str, Any] = {"command": list(command), "options": dict(options)}
    if repeat > 1:
        named["repeat"] = repeat
    return json.dumps(named, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def read_sweep(path: Path) -> Definition:
    """Read the sweep file `path`, and return its content (docs/sweeps.md). The values of options are not checked.

    Raises BadInputError if it cannot be read or is no sweep file.
    """
    try:
        data = tomllib.loads(read_text(path, EXPECTED))
    except (ValueError, RecursionError) as error:  # numbers and nested lists may be too long for the reader
        raise BadInputError(path, f"no TOML ({error})", EXPECTED) from error
    for key, value in data.items():
        _check_key(path, key, value)
    if not data.get("command", "").split():
        raise BadInputError(f"{path}: command", "nothing", KEYS["command"][1])
    if data.get("repeats", 1) < 1:
        raise BadInputError(f"{path}: repeats", str(data["repeats"]), "1 or more")
    for name, values in data.get("axes", {}).items():
        if not isinstance(values, list):
            raise BadInputError(f"{path}: axes.{name}", repr(values), "a list", "a single value goes under [options]")
    kind = data.get("kind", SweepKind.GRID)
    if kind not in [*SweepKind]:
        expected = f"one of {', '.join(SweepKind)}"
        raise BadInputError(f"{path}: kind", repr(kind), expected, did_you_mean(kind, SweepKind))
    kind = SweepKind(kind)
    for key in ("count", "seed"):
        if key in data and kind is not SweepKind.RANDOM:
            raise BadInputError(f"{path}: {key}", f"{key} of a {kind}", "kind = 'random' beside it")
    return Definition(**{**data, "kind": kind, "command": tuple(data["command"].split())})


def _check_key(path: Path, key: str, value: object) -> None:
    if key not in KEYS:
        remedy = did_you_mean(key, KEYS) or "options go under [options] or [axes]"
        raise BadInputError(f"{path}: {key}", "an unknown key", f"one of {', '.join(KEYS)}", remedy)
    kind, expected = KEYS[key]
    if not isinstance(value, kind) or isinstance(value, bool):
        raise BadInputError(f"{path}: {key}", repr(value), expected)


# The figures that a search can improve or limit.


class GoalMetric(NamedTuple):
    """A figure of a result that can be a goal or have a limit.

    `unit`: unit of the figure. `more_is_better`: whether larger values are better. `path`: keys that lead to the figure
    in the `--json` document; empty for the PSNR, which `entry_of` finds.
    """

    unit: str
    more_is_better: bool
    path: tuple[str, ...]


def value_at(document: Any, path: Sequence[str]) -> Any:
    """Return the value of `document` under the keys `path`, such as `frame_time_ms` and `mean`; None without it."""
    for key in path:
        document = document.get(key) if isinstance(document, dict) else None
    return document


METRICS = {
    "fps": GoalMetric("fps", True, ("fps",)),
    "frame": GoalMetric("ms", False, ("frame_time_ms", "mean")),
    "p95": GoalMetric("ms", False, ("frame_time_ms", "p95")),
    "p99": GoalMetric("ms", False, ("frame_time_ms", "p99")),
    "latency": GoalMetric("ms", False, ("latency_ms", "mean")),
    "power": GoalMetric("W", False, ("power_w",)),
    "energy": GoalMetric("mJ", False, ("energy_mj_per_frame",)),
    "psnr": GoalMetric("dB", True, ()),
    "worst-psnr": GoalMetric("dB", True, ("check", "worst_psnr_db")),
}
