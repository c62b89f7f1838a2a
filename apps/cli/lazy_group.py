"""A group of commands whose modules are imported when they are called.

Rule: nothing but Typer is imported here, because `trilane --help` imports this module.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from typer.core import TyperCommand, TyperGroup


def lazy_group(lines: Mapping[str, str], command_of: Callable[[str], Any]) -> type[TyperGroup]:
    """Return the class of a group of commands. A mistyped name is answered with the most similar ones.

    `lines`: the line of each command for `--help`, by name. `command_of`: function that imports a command by its name.
    """

    class LazyGroup(TyperGroup):
        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            # Stand-ins are enough for `--help`, completion and suggestions.
            self.commands = {name: TyperCommand(name, help=line) for name, line in lines.items()}

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            name, stand_in, rest = super().resolve_command(ctx, args)
            return name, None if name is None or stand_in is None else command_of(name), rest

    return LazyGroup
