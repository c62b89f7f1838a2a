"""Reference pages have their tables from the code: options of the commands, keys of scenes and of profiles.

Rule: TRILANE_WRITE_PRINTED=1 writes what is generated again; read the difference before committing it.
"""

from __future__ import annotations

import inspect
import json
import os
import re
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

import pytest
import typer
from pydantic import BaseModel

from support.prose import commands
from trilane.hw_profiles import schema as profiles
from trilane.scene.schema import Scene

DOCS = Path(__file__).resolve().parents[2] / "docs"
MARK = re.compile(r"<!-- generated: (\w+) -->\n.*?<!-- end -->\n", re.DOTALL)
#: Defaults of benches depend on the machine.
OF_THE_MACHINE = "bench"


def cell(text: object) -> str:
    return " ".join(str(text).split()).replace("|", "\\|")


def values(parameter: Any, command: Any) -> str:
    """What a parameter takes: its words, or its kind and range."""
    if getattr(parameter, "is_bool_flag", False):
        return ""
    bounds = [
        f"{word} {bound:g}" for word, bound in (("from", parameter.min), ("to", parameter.max)) if bound is not None
    ]
    shown = parameter.display_type(typer.Context(command)).strip("<>").removesuffix(" range")
    return " ".join([shown.replace("|", ", "), *bounds])


def option_tables() -> Iterator[str]:
    for name, command in commands():
        yield f"\n## trilane {name}\n\n{cell((command.help or '').split(chr(8))[0].split(chr(12))[0])}\n"
        shown = [each for each in command.params if not getattr(each, "hidden", False) and each.name != "help"]
        if shown:
            yield "| option | meaning | values | default |\n|---|---|---|---|"
        for each in shown:
            spelled = "`, `".join([*each.opts, *each.secondary_opts] if each.opts[0][0] == "-" else [each.name.upper()])
            default = (
                ""
                if each.default is None or callable(each.default) or name.startswith(OF_THE_MACHINE)
                else each.default
            )
            told = "" if default in ("", False, ()) else f"`{getattr(default, 'value', default)}`"
            meaning = cell(getattr(each, "help", "") or "")
            yield f"| `{spelled}` | {meaning} | {cell(values(each, command))} | {cell(told)} |"


def models_in(kind: Any) -> Iterator[type[BaseModel]]:
    """Models that a type is made of, such as that of a list's items."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        yield kind
    for inner in get_args(kind):
        yield from models_in(inner)


def spelled(kind: Any) -> str:
    """A type in a file's words."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return ", ".join(f"`{word}`" for word in inner)
    if origin in (Union, types.UnionType):
        return ", or ".join(spelled(each) for each in inner if each is not types.NoneType)
    if origin is tuple:
        return "a list"
    words = {
        str: "text",
        int: "whole number",
        float: "number",
        bool: "true or false",
        profiles.Quantity: "number with kind and source",
    }
    return words.get(kind, words.get(getattr(kind, "__origin__", None), "a table"))


def in_a_file(value: object) -> str:
    """A default as TOML writes it; nothing for an empty one."""
    if value in ("", {}):
        return ""
    return f"`{json.dumps(value)}`"


def limits(field: Any) -> str:
    """The range of a field, from its own bounds or those of its validator."""
    signs = {
        "ge": "at least {:g}",
        "gt": "above {:g}",
        "le": "at most {:g}",
        "lt": "below {:g}",
        "multiple_of": "a multiple of {:g}",
    }
    told = [
        text.format(getattr(rule, name))
        for rule in field.metadata
        for name, text in signs.items()
        if getattr(rule, name, None) is not None
    ]
    told += [
        f"{rule.func.low:g} to {rule.func.high:g}"
        for rule in field.metadata
        if isinstance(getattr(rule, "func", None), profiles._Range)
    ]
    return ", ".join(told)


def key_tables(model: type[BaseModel], table: str, seen: set[type[BaseModel]]) -> Iterator[str]:
    """A table of keys for each table of a file, what the code says about it first."""
    seen.add(model)
    yield f"\n### {table}\n\n{cell(inspect.getdoc(model) or '')}\n"
    yield "| key | meaning | value | range | default |\n|---|---|---|---|---|"
    below = []
    for key, field in model.model_fields.items():
        inner = [each for each in models_in(field.annotation) if each is not profiles.Quantity]
        below += [
            (each, f"`[{key}]`" if table == "The file" else f"`{key}` of {table}") for each in inner if each not in seen
        ]
        plain = (
            not field.is_required()
            and field.default not in (None, ())
            and not isinstance(field.default, BaseModel)
            and not inner
        )
        default = "needed" if field.is_required() else in_a_file(field.default) if plain else ""
        meaning = cell(field.description or "")
        yield f"| `{key}` | {meaning} | {spelled(field.annotation)} | {limits(field)} | {default} |"
    for each, name in below:
        if each not in seen:
            yield from key_tables(each, name, seen)


PARTS = {
    "options": ("options.md", option_tables),
    "scene": ("scene.md", lambda: key_tables(Scene, "The file", set())),
    "profile": ("profile-keys.md", lambda: key_tables(profiles.Profile, "The file", set())),
}


@pytest.mark.parametrize("part", PARTS)
def test_what_is_generated_is_that_of_the_code(part: str) -> None:
    name, lines = PARTS[part]
    page = (DOCS / name).read_text(encoding="utf-8")
    assert MARK.findall(page) == [part]
    block = "\n".join(lines())
    made = MARK.sub(lambda _: f"<!-- generated: {part} -->\n{block}\n<!-- end -->\n", page)
    if os.environ.get("TRILANE_WRITE_PRINTED"):
        (DOCS / name).write_text(made, encoding="utf-8")
    else:
        assert page == made


def test_a_key_that_is_no_number_of_a_profile_and_a_range_are_spelled_for_people() -> None:
    assert spelled(profiles.Rate.__origin__) == "number with kind and source"  # type: ignore[attr-defined]
    assert limits(Scene.model_fields["frames"]) == "at least 1, at most 1e+07"
    assert limits(profiles.Memory.model_fields["application_use_fraction"]) == "0 to 0.95"
    assert spelled(Scene.model_fields["plan"].annotation) == "`planned`, `fixed`, `full`"
