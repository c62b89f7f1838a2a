"""Options as fields of a pydantic model, each with help text, default, range, unit of measure and accepted words.

The command line and Python read the options from the model's fields. Rule: options are listed nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Self, Union, get_args, get_origin

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    TypeAdapter,
    ValidationError,
)
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema

from trilane.errors import BadInputError, did_you_mean
from trilane.unexpected_value import UnexpectedValue, unexpected_in

#: Word for None on the dashboard.
NOTHING: Final = "none"


@dataclass(frozen=True)
class Option:
    """Facts about an option that the type of the option's field does not state.

    `spelling`: name on the command line, such as `--latch`; empty if it follows from the field's name.
    `synonyms`: other names on the command line.
    `is_argument`: whether the command line takes the value without a name.
    `unit`: unit of measure of a number, as a plural noun.
    `words`: the only words that the field accepts; if empty, the field accepts any text.
    `offered`: words that the dashboard's control always offers, besides choices that this machine adds; None if the
    dashboard has no control for the option.
    """

    spelling: str = ""
    synonyms: tuple[str, ...] = ()
    is_argument: bool = False
    unit: str = ""
    words: tuple[str, ...] = ()
    offered: tuple[str, ...] | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Make pydantic refuse a text that is not among `words`; without `words`, every text is accepted."""
        return one_of(*self.words).__get_pydantic_core_schema__(source, handler) if self.words else handler(source)


def option_of(field: FieldInfo) -> Option:
    """Return the field's `Option`; if the field has none, an `Option` of default values."""
    return next((each for each in field.metadata if isinstance(each, Option)), Option())


def kind_of(field: FieldInfo) -> Any:
    """Return the type of the field without limits and without None: str, int, float, bool, Path or tuple."""
    kind: Any = field.annotation
    while get_origin(kind) in (Annotated, Union, UnionType):
        kind = next(each for each in get_args(kind) if each is not NoneType)
    return get_origin(kind) or kind


def element_of(field: FieldInfo) -> Any:
    """Return the type of the elements of a field that is a tuple."""
    kind: Any = field.annotation
    while get_origin(kind) is not tuple:
        kind = get_args(kind)[0]
    return get_args(kind)[0]


def limits_of(field: FieldInfo) -> tuple[float | None, float | None]:
    """Return (least number, largest number) that the field accepts; None for a limit that is absent."""
    least, most = (
        next((getattr(one, key) for one in field.metadata if hasattr(one, key)), None) for key in ("ge", "le")
    )
    return least, most


def text_of(value: object) -> object:
    """Return a path or a whole number (a size) as text, and any other value unchanged."""
    return str(value) if isinstance(value, PurePath) or type(value) is int else value


def texts_of(value: object) -> object:
    return tuple(value) if isinstance(value, Sequence) and not isinstance(value, str) else value


#: Found and expected, for the error about an empty path, which `Path` would turn into the working directory.
EMPTY_PATH: Final = ("an empty path", "a file or a folder")


def path_of(value: object) -> object:
    """Return a text as a path, and any other value unchanged. Raises UnexpectedValue for an empty text."""
    if not isinstance(value, str):
        return value
    return Path(_not_empty(value))


def paths_of(value: object) -> object:
    """Return one path, or several, as a tuple of paths; return any other value unchanged.

    Raises UnexpectedValue for an empty text.
    """
    several = [value] if isinstance(value, str | PurePath) else value
    return tuple(map(path_of, several)) if isinstance(several, Iterable) else value


def _not_empty(text: str) -> str:
    if not text.strip():
        raise UnexpectedValue(*EMPTY_PATH)
    return text


def one_of(*words: str) -> AfterValidator:
    """Return a validator that refuses every text that is not among `words`; it accepts None."""

    def known(word: str | None) -> str | None:
        if word is not None and word not in words:
            raise UnexpectedValue(repr(word), f"one of {', '.join(words)}", did_you_mean(word, words))
        return word

    return AfterValidator(known)


Text = Annotated[str, BeforeValidator(text_of)]
Texts = Annotated[tuple[str, ...], BeforeValidator(texts_of)]
#: The name of something that is bundled with Trilane, or a path.
Name = Annotated[Text, AfterValidator(_not_empty)]
OnePath = Annotated[Path, BeforeValidator(path_of)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Options(BaseModel):
    """Base class of models of options. `model_fields_set` has the names of the options that somebody gave."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    @classmethod
    def checked(cls, values: Mapping[str, Any], *, as_typed: bool = False) -> Self:
        """Return the options with `values`. Raises BadInputError for the first value that is refused.

        `values`: value of each option that is given, by field name.
        `as_typed`: whether the error names the option of the command line in place of the field.
        """
        try:
            return cls(**values)
        except ValidationError as error:
            first = error.errors()[0]
        name = str(first["loc"][0])
        field, where = cls.model_fields[name], cls.spelling(name) if as_typed else name
        unexpected = unexpected_in(first) or UnexpectedValue(repr(first["input"]), expected(field))
        raise BadInputError.at(where, unexpected)

    @classmethod
    def spelling(cls, name: str) -> str:
        """Return the name of field `name` on the command line, such as `--latch`."""
        return option_of(cls.model_fields[name]).spelling or f"--{name.replace('_', '-')}"

    @classmethod
    def value_of(cls, name: str, word: str) -> Any:
        """Return the value of field `name` for `word`, a text of the dashboard. Raises BadInputError if it is unfit."""
        field = cls.model_fields[name]
        try:
            return None if word == NOTHING else TypeAdapter(kind_of(field)).validate_python(word)
        except ValidationError:
            raise BadInputError(name, repr(word), expected(field)) from None

    def changed(self, **values: Any) -> Self:
        """Return a copy whose fields named in `values` have these values. Raises BadInputError as `checked` does."""
        return self.checked({**dict(self), **values})

    def as_json(self) -> dict[str, Any]:
        """Return all options as the report contains them: JSON values by field name."""
        return {
            name: list(value) if isinstance(value, tuple) else str(value) if isinstance(value, PurePath) else value
            for name, value in self
        }


def expected(field: FieldInfo) -> str:
    """Return a description of the values that a field accepts, such as `a whole number, 1 or more`."""
    kind, unit = kind_of(field), option_of(field).unit
    if kind not in (int, float):
        return {str: "text", bool: "true or false", tuple: "a list of texts", Path: "a path"}[kind]
    noun = unit or "a number"
    if kind is int:
        noun = f"a whole number of {unit}" if unit else "a whole number"
    least, most = limits_of(field)
    comma = "," if unit else ""
    if least is None:
        return noun
    return f"{noun}{comma} {least} or more" if most is None else f"{noun}{comma} from {least} to {most}"
