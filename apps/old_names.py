"""Old names of commands and options, which work until the version `GONE_IN`, with a note.

Rule: all names that were only replaced by a new name are listed here, and nowhere else. Command lines, axes of a sweep
and options of a program are translated before any other code reads them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

#: Version in which the old names are gone.
GONE_IN: Final = "0.3"


class Renamed(NamedTuple):
    """An option of `command` that was called `old` and is now called `new`. Both names include the dashes.

    `values`: regular expression for the values that the old option could have. With any other value, `old` means the
    present option of the same name.
    """

    command: str
    old: str
    new: str
    values: str = ".*"

    def means(self, value: object) -> bool:
        """Return whether `old`, given with `value`, means the option with the new name `new`."""
        return re.fullmatch(self.values, str(value), re.DOTALL) is not None


COMMANDS: Final = {"accuracy": "quality", "dashboard": "show", "top": "watch"}
OPTIONS: Final = (
    Renamed("run", "--output", "--picture"),
    Renamed("plan", "--output", "--picture"),
    Renamed("plan", "--picture", "--out", r"(?!\d+x\d+$).*"),
    Renamed("predict", "--engine-runtime", "--runtime"),
    Renamed("predict", "--runtime", "--unit", "cpu|gpu|dsp|all"),
    Renamed("avatar create-data", "--output", "--picture"),
)
#: Options of the present `trilane explain` that take a value.
OF_EXPLAIN: Final = frozenset({"--slowest", "--jobs"})
#: Options that `trilane explain` had while it still explained scenes.
OF_A_SCENE: Final = frozenset(
    {"--motion", "--camera", "--avatar", "--frames", "--fps", "--picture", "--output", "--size", "--skinning"}
    | {"--cores", "--profile", "--performance-profile"}
)
#: Commands whose arguments are another command with its options.
WITH_COMMAND: Final = ("sweep", "tune")

Note = Callable[[str], object]


def in_new_names(words: Sequence[str], note: Note) -> list[str]:
    """Return a command line with new names in place of old names.

    `words`: words of the command line, without `trilane`.
    `note`: function that gets a sentence about each old name.
    """
    if not words:
        return []
    first, rest = words[0], list(words[1:])
    if first in WITH_COMMAND:
        known = {*COMMANDS, *(each.command for each in OPTIONS)}
        place = next((place for place, word in enumerate(rest) if word in known), len(rest))
        return [first, *rest[:place], *in_new_names(rest[place:], note)]
    command = COMMANDS.get(first, first)
    if first == "explain" and _is_of_a_scene(rest):
        command = "plan"
    if command != first:
        what = "`trilane explain` of a scene" if command == "plan" else f"`trilane {first}`"
        note(_said(what, f"`trilane {command}`"))
    group = next((each.command for each in OPTIONS if each.command == " ".join([command, *rest[:1]])), command)
    return [command, *_options(group, rest, note)]


def in_new_name(command: str, name: str, value: object, note: Note = lambda _: None) -> str:
    """Return the present name of an option. Example: the option `output` of `run` is called `picture` now.

    `command`: command to which the option belongs.
    `name`: present or old name of the option, without dashes.
    `value`: value of the option.
    `note`: function that gets a sentence about an old name.
    """
    for each in OPTIONS:
        if each.command == command and each.old == f"--{name.replace('_', '-')}" and each.means(value):
            note(_said(name, each.new.removeprefix("--")))
            return each.new.removeprefix("--")
    return name


def _options(command: str, words: Sequence[str], note: Note) -> Iterator[str]:
    """Yield the words of a command line, with old names of options replaced by new names.

    `command`: command, with its subcommand if it has one.
    `words`: words after the command.
    `note`: as in `in_new_names`.
    """
    for place, word in enumerate(words):
        name, equals, own = word.partition("=")
        value: Any = own if equals else next(iter(words[place + 1 :]), "")
        new = next((each.new for each in OPTIONS if each[:2] == (command, name) and each.means(value)), None)
        if new is None:
            yield word
        else:
            note(_said(name, new))
            yield f"{new}{equals}{own}"


def _is_of_a_scene(words: Sequence[str]) -> bool:
    """Return whether a command line asks for the plan of a scene, and not for an explanation of a run.

    `words`: words after `trilane explain`.
    """
    left, names = iter(words), []
    for word in left:
        option, equals, _ = word.partition("=")
        if not option.startswith("-"):
            names.append(word)
        elif option in OF_A_SCENE:
            return True
        elif option in OF_EXPLAIN and not equals:
            next(left, None)
    return any(map(_is_scene, names))


def _is_scene(name: str) -> bool:
    """Return whether `name` means a scene. If a run folder has the same name, the name means the run."""
    from trilane.apps.watch.followed_run import folder_of
    from trilane.scene.schema import scene_names

    return name.endswith(".toml") or (name in scene_names() and folder_of(Path(name)) is None)


def _said(old: str, new: str) -> str:
    return f"{old} is called {new} now; the old name is gone in Trilane {GONE_IN}"
