"""Data of the house as a whole: every profile's numbers are held, and no dataclass is changed by chance."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from trilane.hw_profiles.load import profile_folder, profile_names

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "trilane"
KINDS = ("measured", "published", "fitted", "assumed", "unknown")


def leaves(data: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(data, dict):
        for name, value in data.items():
            yield from leaves(value, f"{key}.{name}")
    elif isinstance(data, list):
        for number, value in enumerate(data):
            yield from leaves(value, f"{key}[{number}]")
    else:
        yield key, data


@pytest.mark.parametrize("name", profile_names())
def test_the_numbers_and_words_of_a_profile_are_held(held: Callable[[str, Any], None], name: str) -> None:
    """Words by the numbers of their letters, so that one file holds all."""
    data = tomllib.loads((profile_folder() / f"{name}.toml").read_text(encoding="utf-8"))
    found = sorted(leaves(data))
    held("keys", [sum(key.encode()) for key, _ in found])
    held("numbers", [value for _, value in found if isinstance(value, int | float)])
    held("words", [sum(value.encode()) for _, value in found if isinstance(value, str)])


#: Dataclasses that are filled bit by bit; every other one is frozen.
FILLED = {
    "BvhJoint",
    "LoadGenPlayer",
    "LoadGenVerdict",
    "Queries",
    "Recording",
    "Signals",
    "ThermalState",
    "Throttle",
    "_Extent",
    "_Hierarchy",
    "_Player",
    "_VirtualUnit",
    "_Words",
}


def dataclasses() -> Iterator[tuple[str, str]]:
    """Name of every dataclass of the package, and how it is decorated; links are followed."""
    tops = [path.resolve() for path in PACKAGE.iterdir() if path.is_dir() and path.name != "testing"]
    for file in (*PACKAGE.glob("*.py"), *(file for top in tops for file in top.rglob("*.py"))):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                decorators = [ast.unparse(each) for each in node.decorator_list]
                yield from ((node.name, each) for each in decorators if each.startswith("dataclass"))


def test_what_is_not_filled_bit_by_bit_is_frozen() -> None:
    found = list(dataclasses())
    assert len(found) > 60
    assert {name for name, decorator in found if "frozen=True" not in decorator} == FILLED
