"""What changed in configuration and machine. Rule: every key that differs, and no other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

#: Parts of a report that say how it was made.
PARTS: Final = (
    "clock",
    "policy",
    "edge",
    "config",
    "stages",
    "caps.performance_profile",
    "machine",
    "made",
    "idle_cores",
)
#: Keys of a report that its `config` has too, and of a prediction its `config` alone.
TWICE: Final = ("policy", "edge")
#: Key of a document: the parts of which nobody knows what they were, so nobody knows whether they have changed.
NOT_KNOWN: Final = "not_known"
#: Keys that differ between any two runs.
ALWAYS_DIFFERENT: Final = ("made.at", "made.command")


class Change(NamedTuple):
    """A key, dotted, with its value in the base and in the other run; None where there is no such key."""

    key: str
    base: Any
    other: Any


def changes(base: Mapping[str, Any], other: Mapping[str, Any]) -> list[Change]:
    """The keys of two reports, as JSON, in which the runs were not made alike."""
    first, second = _settings(base), _settings(other)
    found = dict.fromkeys([*first, *second])
    known = [part for part in PARTS if part not in (*base.get(NOT_KNOWN, ()), *other.get(NOT_KNOWN, ()))]
    keys = [key for part in known for key in found if key == part or key.startswith(f"{part}.")]
    return [Change(key, first.get(key), second.get(key)) for key in keys if first.get(key) != second.get(key)]


def _settings(document: Mapping[str, Any]) -> dict[str, Any]:
    units = {name: {"unit": stage["unit"]} for name, stage in document["stages"].items()}
    found: dict[str, Any] = {}
    for part in PARTS:
        value: Any = {**document, "stages": units}
        for key in part.split("."):
            value = value.get(key) if isinstance(value, Mapping) else None
        if value is not None:
            found.update(_flat(part, value))
    for key in TWICE:
        if f"config.{key}" in found:
            found.setdefault(key, found.pop(f"config.{key}"))
    return {key: value for key, value in found.items() if key not in ALWAYS_DIFFERENT}


def _flat(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from _flat(f"{name}.{key}", inner)
    elif isinstance(value, list) and any(isinstance(each, Mapping) for each in value):
        for place, inner in enumerate(value):
            yield from _flat(f"{name}.{place}", inner)
    else:
        yield name, value
