"""The Typer application that every module of commands makes, and what all its commands refuse.

Rule: an option that takes one value is given at most once; a second value would silently replace the first. What is
wrong with a value is said as everywhere: what was found, what was expected.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from enum import Enum
from typing import Any, Literal, get_args, get_origin

import typer
from pydantic import ValidationError
from typer.core import TyperCommand, TyperOption

from trilane.errors import BadInputError, did_you_mean


class OnceCommand(TyperCommand):
    """A command whose options have one value each, but for those that collect several."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Raises BadInputError naming an option that was given again or has a value of another kind or range.

        Its other spelling (`--no-hud`) is the same option.
        """
        _, _, given = self.make_parser(ctx).parse_args(args=list(args))
        for option, times in Counter(given).items():
            if times > 1 and isinstance(option, TyperOption) and not _may_be_repeated(option):
                names = " or ".join([*option.opts, *option.secondary_opts])
                raise BadInputError("options", f"{names} given {times} times", "it once", "it takes one value")
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter as error:
            if isinstance(error.__cause__, ValidationError) and error.param is not None:
                raise _wrong_value(error.param, error.__cause__) from None
            raise


def _wrong_value(parameter: Any, error: ValidationError) -> BadInputError:
    """What pydantic found wrong with the value of an option or argument."""
    first, kind = error.errors()[0], parameter.type_descriptor.annotation
    where = parameter.opts[0]
    found = first["input"]
    choices = [each.value for each in kind] if isinstance(kind, type) and issubclass(kind, Enum) else get_args(kind)
    if choices and get_origin(kind) in (None, Literal):
        words = [str(each) for each in choices]
        return BadInputError(where, repr(found), f"one of {', '.join(words)}", did_you_mean(str(found), words))
    expected = first["msg"].removeprefix("Input should be ").partition(",")[0]
    return BadInputError(where, repr(found), expected)


def _may_be_repeated(option: TyperOption) -> bool:
    """Options that collect values, and flags that can only say the same thing again."""
    return option.multiple or option.count or (option.is_flag and not option.secondary_opts)


def given(ctx: typer.Context) -> set[str]:
    """The parameters that the command line gives."""
    sources = {name: ctx.get_parameter_source(name) for name in ctx.params}
    return {name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"}


class Commands(typer.Typer):
    """A Typer application without markup and shell completion; its commands are `OnceCommand`s."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(rich_markup_mode=None, add_completion=False, **settings)

    def command(self, name: str | None = None, **settings: Any) -> Callable[[Any], Any]:
        """As `typer.Typer.command`."""
        return super().command(name, cls=OnceCommand, **settings)
