"""The Typer application that every module of commands makes, and what all its commands refuse.

Rule: an option that takes one value is given at most once; a second value would silently replace the first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import typer
from typer.core import TyperCommand, TyperOption

from trilane.errors import BadInputError


class OnceCommand(TyperCommand):
    """A command whose options have one value each, but for those that collect several."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Raises BadInputError naming an option that was given again, also under its other spelling (`--no-hud`)."""
        _, _, given = self.make_parser(ctx).parse_args(args=list(args))
        for option, times in Counter(given).items():
            if times > 1 and isinstance(option, TyperOption) and not _may_be_repeated(option):
                names = " or ".join([*option.opts, *option.secondary_opts])
                raise BadInputError("options", f"{names} given {times} times", "it once", "it takes one value")
        return super().parse_args(ctx, args)


def _may_be_repeated(option: TyperOption) -> bool:
    """Options that collect values, and flags that can only say the same thing again."""
    return option.multiple or option.count or (option.is_flag and not option.secondary_opts)


class Commands(typer.Typer):
    """A Typer application without markup and shell completion; its commands are `OnceCommand`s."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(rich_markup_mode=None, add_completion=False, **settings)

    def command(self, name: str | None = None, **settings: Any) -> Callable[[Any], Any]:
        """As `typer.Typer.command`."""
        return super().command(name, cls=OnceCommand, **settings)
