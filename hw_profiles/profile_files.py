"""Reads hardware profiles: TOML files that may extend each other, checked against the schema.

Every defect of a file becomes a `BadInputError` that names the file, the key, what was found and what was expected.
The profile `host` also gets the numbers that `host.py` computes for this machine.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from trilane.errors import BadInputError
from trilane.hw_profiles.host import host_tables
from trilane.hw_profiles.schema import Profile
from trilane.unexpected_value import unexpected_in
from trilane.units import HOST

MAX_BYTES = 1_000_000
MAX_DEPTH = 8
#: Keys of a quantity. An extending profile replaces a whole quantity, never only its value or its source.
WHOLE = frozenset(["value", "kind", "source"])
UNIT_HINT = "units of measure end the name"


def profile_folder() -> Path:
    """Return the folder of the bundled profiles."""
    return Path(str(resources.files("trilane.hw_profiles")))


def profile_names() -> list[str]:
    """Return the names of the bundled profiles, including templates."""
    return sorted(path.stem for path in profile_folder().glob("*.toml"))


def load_profile(name: str | Path) -> Profile:
    """Return the profile `name`: the name of a bundled profile, or the path of a TOML file.

    Raises BadInputError if there is no such profile, or if it has a defect.
    """
    data, path = load_tables(name)
    if path.stem == HOST:
        data = _overlay(data, host_tables())
    return parse_profile(data, path)


def load_runnable(name: str | Path) -> Profile:
    """Return the profile `name`, as `load_profile` does.

    Raises BadInputError also for a template, which describes no chip.
    """
    profile = load_profile(name)
    if profile.template:
        chips = [other for other in profile_names() if not load_profile(other).template]
        raise BadInputError("profile", f"the template {profile.name}", "one of " + ", ".join(chips))
    return profile


def load_tables(name: str | Path) -> tuple[dict[str, Any], Path]:
    """Return (merged tables of the profile `name`, not yet checked; its path). Raises BadInputError."""
    path = _find(str(name), Path())
    return merged_tables(path), path


def parse_profile(data: Mapping[str, Any], path: Path) -> Profile:
    """Return the profile of the tables `data`. `path`: file to name in errors. Raises BadInputError."""
    try:
        return Profile.model_validate(data)
    except ValidationError as error:
        raise _bad_input(error, path) from None


def merged_tables(path: Path, seen: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Return the tables of `path`, merged over the tables of the profile that it extends.

    `seen`: files that extend `path`, directly or through other files.

    Raises BadInputError for a cycle, more than MAX_DEPTH files in a row, or a file that is missing or cannot be read.
    """
    path = path.resolve()
    if path in seen:
        chain = " -> ".join(p.name for p in (*seen[seen.index(path) :], path))
        raise BadInputError(f"{path}: extends", f"the cycle {chain}", "a profile that does not extend itself")
    if len(seen) >= MAX_DEPTH:
        raise BadInputError(f"{path}: extends", f"more than {MAX_DEPTH} profiles in a row", "fewer")
    data = _read(path)
    parent = data.pop("extends", None)
    if parent is None:
        return data
    if not isinstance(parent, str):
        raise BadInputError(f"{path}: extends", repr(parent), "the name of a profile")
    try:
        base = merged_tables(_find(parent, path.parent), (*seen, path))
    except BadInputError as error:
        if error.where != "profile":
            raise
        raise BadInputError(f"{path}: extends", error.found, error.expected) from None
    base.pop("template", None)
    merged: dict[str, Any] = _overlay(base, data)
    return merged


def _find(name: str, beside: Path) -> Path:
    if name.endswith(".toml"):
        path = beside / name
        if path.is_file():
            return path
        raise BadInputError("profile", f"no file {path}", "a TOML file that can be read")
    for folder in (beside, profile_folder()):
        path = folder / f"{name}.toml"
        if name.replace("-", "").replace("_", "").isalnum() and path.is_file():
            return path
    names = profile_names()
    close = difflib.get_close_matches(name, names, 1)
    hint = f"did you mean {close[0]}?" if close else ""
    raise BadInputError("profile", f"no profile {name!r}", "a .toml file or one of " + ", ".join(names), hint)


def _read(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise BadInputError(path, f"{path.stat().st_size} bytes", f"at most {MAX_BYTES}")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # bytes that are no text, numbers that are too long, deep lists
        raise BadInputError(path, str(error), "TOML in UTF-8") from None
    except OSError as error:
        raise BadInputError.of_os_error(path, error, "a file that can be read") from None


def _overlay(base: Any, over: Any) -> Any:
    if not (isinstance(base, dict) and isinstance(over, dict)) or WHOLE & over.keys():
        return over
    return {key: _overlay(base.get(key), over[key]) if key in over else base[key] for key in base | over}


def _bad_input(error: ValidationError, path: Path) -> BadInputError:
    first, count = error.errors(include_url=False)[0], error.error_count()
    keys = [str(part) for part in first["loc"] if part != "[key]"]
    more = f"and {count - 1} more" if count > 1 else ""
    where, message = f"{path}: {'.'.join(keys) or 'the profile'}", first["msg"]
    if first["type"] == "extra_forbidden":
        known = list(_siblings(keys))
        close = difflib.get_close_matches(keys[-1], known, 1, 0.5)
        expected = f"`{close[0]}`" if close else "one of " + ", ".join(known)
        remedy = f"{UNIT_HINT}; {more}" if more else UNIT_HINT
        return BadInputError(where, f"the unknown key `{keys[-1]}`", expected, remedy)
    unexpected = unexpected_in(first)
    if unexpected is not None:
        return BadInputError(where, unexpected.found, unexpected.expected, more)
    if first["type"] == "missing":
        return BadInputError(where, "nothing", "this key", more)
    text = message.removeprefix("Input should be ").removeprefix("Field ")
    expected = text[:1].lower() + text[1:]
    if "Quantity" in message:
        expected = "a table { value = ..., kind = ..., source = ... }"
    return BadInputError(where, _short(first["input"]), expected, more)


def _short(value: Any) -> str:
    if isinstance(value, dict | list):
        return f"a {'table' if isinstance(value, dict) else 'list'}"
    text = repr(value)
    return text if len(text) < 60 else text[:57] + "..."


def _siblings(keys: Sequence[str]) -> Iterator[str]:
    """Yield the keys that the schema allows beside the last of `keys`, a path of keys from the root."""
    model: Any = Profile
    for key in keys[:-1]:
        fields = getattr(model, "model_fields", {})
        annotation = fields[key].annotation if key in fields else model
        model = (getattr(annotation, "__args__", ()) or (annotation,))[-1]  # `Model` for `dict[str, Model]`
    yield from getattr(model, "model_fields", {})
