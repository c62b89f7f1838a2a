"""Old names of commands and options, which work for one more version, with a note.

Rule: a name that was only replaced by another stands here and nowhere else. Command lines, axes of a sweep and options
of a program are translated before any other code reads them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

#: Version in which the old names are gone.
GONE_IN: Final = "0.3"


class Renamed(NamedTuple):
    """An option of `command` that was called `old` and is called `new`. Both names include the dashes.

    `values`: regular expression. A value that matches it shows that `old` means the old option. With any other value,
    `old` means the option that has this name now.
    """

    command: str
    old: str
    new: str
    values: str = ".*"

    def means(self, value: object) -> bool:
        """Return whether `old`, given with `value`, means the old option."""
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
#: Options of today's `trilane explain` that take a value.
OF_EXPLAIN: Final = frozenset({"--slowest", "--jobs"})
#: Options that `trilane explain` had when it explained a scene.
OF_A_SCENE: Final = frozenset(
    {"--motion", "--camera", "--avatar", "--frames", "--fps", "--picture", "--output", "--size", "--skinning"}
    | {"--cores", "--profile", "--performance-profile"}
)
#: Commands whose arguments are another command with its options.
WITH_COMMAND: Final = ("sweep", "tune")

Note = Callable[[str], object]


def in_new_names(words: Sequence[str], note: Note) -> list[str]:
    """Return the command line `words`, which lacks `trilane`, with new names in place of old ones.

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
    """Return the present name of the option `name` of `command`: `output` gives `picture`. Names have no dashes.

    `value`: value of the option. `note`: as in `in_new_names`.
    """
    for each in OPTIONS:
        if each.command == command and each.old == f"--{name.replace('_', '-')}" and each.means(value):
            note(_said(name, each.new.removeprefix("--")))
            return each.new.removeprefix("--")
    return name


def _options(command: str, words: Sequence[str], note: Note) -> Iterator[str]:
    """Yield `words`, the arguments of `command`, with new names of options in place of old ones."""
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
    """Return whether the words after `trilane explain` ask for the plan of a scene."""
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
    """Return whether `name` means a scene, and not the folder of a run with the same name."""
    from trilane.apps.watch.followed_run import folder_of
    from trilane.scene.schema import scene_names

    return name.endswith(".toml") or (name in scene_names() and folder_of(Path(name)) is None)


def _said(old: str, new: str) -> str:
    return f"{old} is called {new} now; the old name is gone in Trilane {GONE_IN}"
