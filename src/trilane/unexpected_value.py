"""A value that is not what it should be, described in parts.

Rule: `UnexpectedValue` is raised where the place of the value (a file, key or option) is not known. A caller that knows
the place turns it into a `BadInputError` with `BadInputError.at`. This module imports nothing of Trilane, so that the
scheduler's core may raise the error too.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class UnexpectedValue(ValueError):  # noqa: N818 - the value is at fault, as in ValueError
    """A value that is not what it should be.

    `found`, `expected`: sentence parts. `remedy`: how to fix the value; may be empty.
    """

    def __init__(self, found: str, expected: str, remedy: str = "") -> None:
        super().__init__(found, expected, remedy)
        self.found, self.expected, self.remedy = found, expected, remedy

    def __str__(self) -> str:
        return f"found {self.found}, expected {self.expected}" + (f"; {self.remedy}" if self.remedy else "")


INPUT_SHOULD = "Input should be "
#: Expected value in words, by the type of a pydantic error; only where pydantic's own text is not fit for people.
EXPECTED = {
    "too_short": "at least {min_length} of them",
    "too_long": "at most {max_length} of them",
    "model_type": "a table",
    "tuple_type": "a list",
    "string_type": "text in quotes",
    "float_type": "a number, without quotes",
    "bool_type": "true or false, without quotes",
    "int_type": "a whole number, without quotes or decimal point",
}


def expected_in(details: Mapping[str, Any], words: Mapping[str, str] = EXPECTED) -> str:
    """Return what a value should be, in words.

    `details`: one of the `errors()` of a pydantic ValidationError. `words`: expected value by the type of the error.
    """
    known = words.get(details["type"])
    return known.format(**details.get("ctx", {})) if known else str(details["msg"]).removeprefix(INPUT_SHOULD)


def unexpected_in(details: Mapping[str, Any]) -> UnexpectedValue | None:
    """Return the UnexpectedValue that a validator raised; None for an error of another kind.

    `details`: one of the `errors()` of a pydantic ValidationError.
    """
    cause = details.get("ctx", {}).get("error")
    return cause if isinstance(cause, UnexpectedValue) else None
