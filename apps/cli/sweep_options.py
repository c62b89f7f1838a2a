"""The options of the commands that a sweep can try, as the commands themselves define them.

Rule: there is no second list of options. The command's own parser interprets names, spellings and values.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

import typer

from trilane.apps.cli.bench import BENCHES, bench_command
from trilane.apps.cli.console import note
from trilane.apps.cli.main import command_of
from trilane.apps.old_names import COMMANDS as OLD_COMMANDS
from trilane.apps.old_names import in_new_name
from trilane.apps.sweep.definition import COMMANDS, Options, Value
from trilane.errors import BadInputError, did_you_mean

#: Option that a sweep refuses, because it is not part of a trial's configuration -> reason.
NOT_SWEPT = {
    "json": "every trial has it",
    "out": "the sweep's own --out is the folder of all its trials",
    "plot": "every trial would write the same file",
    "trace": "every trial would write the same file",
    "dashboard": "it waits for a person",
    "port": "it is of --dashboard",
}


class SweptCommand:
    """A command that a sweep tries, with the options of this command.

    `words`: words of the command, such as `run`, or `bench` and the name of a bench. An old name becomes the new name.
    Raises BadInputError for a command that a sweep cannot try.
    """

    def __init__(self, words: Sequence[str]) -> None:
        first = words[0] if words else ""
        self.words = (OLD_COMMANDS.get(first, first), *words[1:]) if words else ()
        self._command = _command(self.words)
        self._parameters = {_name(each): each for each in self._command.params if _name(each) not in NOT_SWEPT}

    def in_new_names(self, given: Mapping[str, Sequence[Value]], where: str) -> dict[str, Sequence[Value]]:
        """Return the values of options by their new names, and print a note for each old name.

        `given`: values by old or new name. `where`: place that an error names, such as a file and its table. Raises
        BadInputError if an option is given by its old name and its new name.
        """
        found: dict[str, Sequence[Value]] = {}
        for old, values in given.items():
            name = in_new_name(" ".join(self.words), old, next(iter(values), ""), note)
            if name in found:
                raise BadInputError(where, f"{name} twice", "it once", f"{old} is its old name" if old != name else "")
            found[name] = values
        return found

    def values_of(self, tokens: Sequence[str]) -> dict[str, list[Value]]:
        """Return the values that the command line gives each option: name of the option -> values in the typed order.

        `tokens`: words of the command line after the command. Raises BadInputError for an unknown option, and for a
        missing or wrong value.
        """
        found: dict[str, list[Value]] = {}
        arguments = [name for name, each in self._parameters.items() if each.param_type_name == "argument"]
        left = iter(tokens)
        for token in left:
            name, value = self._option(token, left) if token.startswith("-") else ("".join(arguments[:1]), token)
            if not name:
                raise BadInputError("options", repr(token), f"options of {' '.join(self.words)}")
            found.setdefault(name, []).append(self.converted(name, value))
        return found

    def converted(self, name: str, value: Any, where: str = "") -> Value:
        """Return the value of option `name` after the command's own conversion, as plain data.

        `value`: value as typed, or as read from a sweep file. `where`: place that an error names, such as a file and
        its table; "" for the command line. Raises BadInputError for a value that the command refuses.
        """
        parameter = self._named(name, where)
        words = self.words_of({name: value})
        place = f"{where or 'options'}: {name}"
        if _is_flag(parameter) != isinstance(value, bool):
            expected = "true or false" if _is_flag(parameter) else "text or a number"
            raise BadInputError(place, repr(value), expected)
        try:
            with self._command.make_context(self.words[-1], list(words)) as context:
                return _plain(context.params[parameter.name])
        except BadInputError as error:
            if not where:
                raise
            raise BadInputError(place, error.found, error.expected, error.remedy) from None
        except typer.BadParameter as error:
            raise BadInputError(place, repr(value), f"a value that {' '.join(self.words)} takes", str(error)) from None

    def words_of(self, options: Options) -> tuple[str, ...]:
        """Return `options`, values by name, as the words of a command line."""
        words: list[str] = []
        for name, value in options.items():
            words += self._typed(self._named(name), value)
        return tuple(words)

    def _named(self, name: str, where: str = "") -> Any:
        if name in NOT_SWEPT:
            raise BadInputError(where or "options", f"--{name}", "options of the trials", NOT_SWEPT[name])
        if name not in self._parameters:
            expected = f"an option of {' '.join(self.words)}"
            raise BadInputError(where or "options", f"unknown {name!r}", expected, did_you_mean(name, self._parameters))
        return self._parameters[name]

    def _option(self, token: str, left: Iterator[str]) -> tuple[str, Value]:
        """Return the name and the value of the option that begins with `token`.

        `left`: words after `token`. The first of them is the value, unless `token` contains `=` or the option is a
        flag. Raises BadInputError for an unknown option, for a missing value, and for a value of a flag.
        """
        spelling, has_value, value = token.partition("=")
        for name, parameter in self._parameters.items():
            if spelling in (*parameter.opts, *parameter.secondary_opts) and parameter.param_type_name == "option":
                if _is_flag(parameter):
                    if has_value:
                        raise BadInputError("options", repr(token), f"{spelling} without a value")
                    return name, spelling in parameter.opts
                return name, value if has_value else _next(spelling, left)
        self._named(spelling.lstrip("-"))  # raises an error, except for the name of an argument
        raise BadInputError("options", spelling, f"an option of {' '.join(self.words)}", "it is given without a name")

    @staticmethod
    def _typed(parameter: Any, value: Value) -> Iterator[str]:
        if _is_flag(parameter):
            spellings = parameter.opts if value else parameter.secondary_opts
            yield from spellings[:1]  # none, if the flag is off and has no opposite
            return
        for each in value if isinstance(value, list) else [value]:
            if parameter.param_type_name == "argument":
                yield str(each)
            elif str(each).startswith("-"):
                yield f"{parameter.opts[0]}={each}"
            else:
                yield from (parameter.opts[0], str(each))


def _command(words: tuple[str, ...]) -> Any:
    known = [*(name for name in COMMANDS if name != "bench"), *(f"bench {name}" for name in BENCHES)]
    text = " ".join(words)
    if text not in known:
        benches = ", ".join(BENCHES)
        expected = f"one of {', '.join(COMMANDS)} NAME, NAME being one of {benches}" if words[:1] == ("bench",) else ""
        expected = expected or f"one of {', '.join(COMMANDS)} NAME, or a file (.toml)"
        raise BadInputError("command", repr(text), expected, did_you_mean(text, known))
    if words[0] == "bench":
        return bench_command(words[1])
    return command_of(words[0])


def _next(spelling: str, left: Iterator[str]) -> str:
    value = next(left, None)
    if value is None:
        raise BadInputError("options", f"{spelling} without a value", "a value after it")
    return value


def _name(parameter: Any) -> str:
    return str(parameter.opts[0]).lstrip("-")


def _is_flag(parameter: Any) -> bool:
    return bool(getattr(parameter, "is_flag", False))


def _plain(value: Any) -> Value:
    if isinstance(value, Enum):
        return _plain(value.value)
    if isinstance(value, str | bool | int | float):
        return value
    return [_plain(each) for each in value] if isinstance(value, Iterable) else str(Path(value))
