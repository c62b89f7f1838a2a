"""One trial: a configuration of a command, with the name that its configuration gives it.

Rule: pure. The name is a hash of what is asked and of nothing else: not of the machine, the folder or the moment.
"""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any

#: Of an option: as its command converts it. Lists are of options that collect several.
Value = str | int | float | bool | list[Any]
Options = Mapping[str, Value]
ID_DIGITS = 16


class Clock(StrEnum):
    """Whether a trial takes time on its machine, which it needs for itself, or computes the time of another one."""

    HOST = "host"
    VIRTUAL = "virtual"


@dataclass(frozen=True)
class TriedCommand:
    """`clock` of its result, and does it write a run folder."""

    clock: Clock
    has_folder: bool = False


#: Commands that a sweep can try, by their first word.
COMMANDS = {
    "run": TriedCommand(Clock.HOST, has_folder=True),
    "predict": TriedCommand(Clock.VIRTUAL),
    "accuracy": TriedCommand(Clock.HOST),
    "bench": TriedCommand(Clock.HOST),
}


@dataclass(frozen=True)
class Trial:
    """`command`: its words, such as `bench raster`. `options`: by name, without dashes. `words`: them, as typed.

    `repeat`: counted from 1.
    """

    command: tuple[str, ...]
    options: Options
    words: tuple[str, ...]
    repeat: int = 1

    @cached_property
    def id(self) -> str:
        """The first 16 digits of the SHA-256 of the canonical configuration."""
        return hashlib.sha256(canonical(self.command, self.options, self.repeat).encode()).hexdigest()[:ID_DIGITS]

    @property
    def arguments(self) -> list[str]:
        """What stands after `trilane` on its command line."""
        return [*self.command, *self.words, "--json"]

    @property
    def line(self) -> str:
        """The command line that does it once more, without its run folder."""
        return shlex.join(["trilane", *self.arguments])

    @property
    def kind(self) -> TriedCommand:
        return COMMANDS[self.command[0]]


def canonical(command: tuple[str, ...], options: Options, repeat: int = 1) -> str:
    """JSON without spaces, keys sorted. The first repeat is not named, so that more repeats leave its name as it is.

    Raises ValueError for NaN and infinities.
    """
    named: dict[str, Any] = {"command": list(command), "options": dict(options)}
    if repeat > 1:
        named["repeat"] = repeat
    return json.dumps(named, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
