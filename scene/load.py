"""Loads scene files (TOML), and turns an error of the schema into one sentence for people.

Rule: the first defect is named with its file and key; the values of a file are never changed.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from trilane.errors import BadInputError
from trilane.files import read_text
from trilane.near_miss import did_you_mean
from trilane.scene.schema import Scene
from trilane.unexpected_value import unexpected_in

INPUT_SHOULD = "Input should be "
ENDING = ".toml"
LONGEST_FOUND = 80
#: Type of a pydantic error -> what was expected, where pydantic's own text is not fit for people.
EXPECTED = {
    "too_short": "at least {min_length} of them",
    "too_long": "at most {max_length} of them",
    "model_type": "a table",
    "tuple_type": "a list",
    "string_type": "text in quotes",
    "float_type": "a number, without quotes",
    "bool_type": "true or false, without quotes",
    "int_type": "a whole number, without quotes or decimal point",
    "string_too_short": "at least one character",
    "string_pattern_mismatch": "letters, digits, spaces, dots, hyphens and underscores",
}
#: Types of pydantic errors of numbers out of range, or between two steps.
IN_STEPS = ("multiple_of", "greater_than_equal", "less_than_equal")
#: Key of the scene -> why it cannot be what it was, where the range alone does not tell.
REASONS = {"error_budget_px": "numbers are rounded, so nothing is drawn without an error"}
BUILT_IN_PREFIX = "builtin:"
BUILT_IN = ("room", "default", "hiker")  # a background, avatars


def bad_input(where: str | Path, error: ValidationError) -> BadInputError:
    """The first defect that `error` lists, as a BadInputError about `where` with the key."""
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"])
    place = f"{where}: {key}" if key else str(where)
    if first["type"] == "extra_forbidden":
        remedy = did_you_mean(str(first["loc"][-1]), _keys_beside(first["loc"])) or "correct its spelling or remove it"
        return BadInputError(place, "an unknown key", "a key of the scene schema", remedy)
    if first["type"] == "missing":
        return BadInputError(place, "nothing", "a value", "add the key")
    unexpected = unexpected_in(first)
    if unexpected is not None:
        return BadInputError.at(place, unexpected)
    value = repr(first["input"])
    short = value if len(value) <= LONGEST_FOUND else value[:LONGEST_FOUND] + "..."
    expected = _steps(first) or EXPECTED.get(first["type"], "").format(**first.get("ctx", {}))
    return BadInputError(place, short, expected or str(first["msg"]).removeprefix(INPUT_SHOULD), _remedy(first))


def _steps(first: Mapping[str, Any]) -> str:
    """All that a number must be that has to be a multiple of another; empty for other errors."""
    if first["type"] not in IN_STEPS or not isinstance(first["loc"][-1], str):
        return ""
    limits = ("multiple_of", "ge", "le")
    known = {key: getattr(one, key) for one in _field(first["loc"]).metadata for key in limits if hasattr(one, key)}
    return "a multiple of {multiple_of} from {ge} to {le}".format(**known) if len(known) == len(limits) else ""


def _remedy(first: Mapping[str, Any]) -> str:
    """How to mend a value, of one of the `errors()` of a scene; empty when what was expected says all."""
    if first["type"] == "literal_error":
        return did_you_mean(str(first["input"]), _choices(first["loc"]))
    return REASONS.get(".".join(map(str, first["loc"])), "") if first["type"] == "greater_than" else ""


def _keys_beside(loc: tuple[int | str, ...]) -> list[str]:
    """The keys of the table in which the key at `loc` stands."""
    return list(_table_of(loc).model_fields)


def _choices(loc: tuple[int | str, ...]) -> list[str]:
    """The words that the key at `loc` may be; of a key that may be nothing else."""
    return [str(word) for word in get_args(_field(loc).annotation)]


def _field(loc: tuple[int | str, ...]) -> FieldInfo:
    """The schema's field of the key at `loc`."""
    return _table_of(loc).model_fields[str(loc[-1])]


def _table_of(loc: tuple[int | str, ...]) -> type[BaseModel]:
    """The schema of the table in which the key at `loc` stands."""
    table: type[BaseModel] = Scene
    for key in loc[:-1]:
        if isinstance(key, str):
            kind = table.model_fields[key].annotation
            kinds = (each for each in (kind, *get_args(kind)) if isinstance(each, type))
            table = next(each for each in kinds if issubclass(each, BaseModel))
    return table


def scene_from(where: str | Path, values: Mapping[str, Any]) -> Scene:
    """`values` as a Scene. Raises BadInputError that names `where` and the key."""
    try:
        return Scene.model_validate(values)
    except ValidationError as error:
        raise bad_input(where, error) from None


def scene_names() -> list[str]:
    """Names of the scenes that come with the package."""
    folder = files("trilane.scene.scenes")
    return sorted(item.name.removesuffix(ENDING) for item in folder.iterdir() if item.name.endswith(ENDING))


def find_scene(name: str) -> Path:
    """The file of a scene: a path, or the name of one that comes with the package. Raises BadInputError."""
    if name in scene_names():
        return Path(str(files("trilane.scene.scenes") / f"{name}{ENDING}"))
    path = Path(name)
    if path.suffix != ENDING:
        expected = f"a {ENDING} file or one of {', '.join(scene_names())}"
        raise BadInputError("scene", repr(name), expected, did_you_mean(name, scene_names()))
    return path


def load_scene(path: Path) -> dict[str, Any]:
    """The values of a scene file, checked against the schema; paths in it are made absolute from its folder.

    Raises BadInputError naming the line or the key.
    """
    try:
        values = tomllib.loads(read_text(path, "a scene file (TOML)"))
    except (ValueError, RecursionError) as error:  # also of numbers and lists that are too long
        raise BadInputError(path, f"no valid TOML ({error})", "a scene file (TOML)") from None
    values.setdefault("name", path.stem)
    scene = scene_from(path, values)
    base = path.absolute().parent
    values["background"] = located(scene.background, base)
    values["camera"] = {**values.get("camera", {}), "source": located(scene.camera.source, base)}
    avatars = values.get("avatars", [{}])
    values["avatars"] = [
        {**raw, "motion": located(spec.motion, base), "bundle": located(spec.bundle, base)}
        for raw, spec in zip(avatars, scene.avatars, strict=True)
    ]
    return values


def located(source: str, base: Path) -> str:
    """`source` unchanged if it names something built in, else as a path that starts at `base`.

    Raises BadInputError for an empty text.
    """
    if not source:
        raise BadInputError("name of a file", "nothing", "a path, or the name of something built in")
    return source if source in BUILT_IN or source.startswith(BUILT_IN_PREFIX) else str(base / source)
