"""docs/limits.md states each limit and deadline as the code has it: who reads 120 s waits for 120 s."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

TABLE = Path(__file__).resolve().parents[2] / "docs" / "limits.md"
#: Seconds of a unit in the table, and of one in the ending of a constant's name.
UNITS = {"": None, "s": 1.0, "ms": 1e-3, "us": 1e-6}
ENDINGS = {"_S": 1.0, "_MS": 1e-3, "_NS": 1e-9}
ROW = re.compile(r"^\| `([\w.]+)\.([A-Z_]+)` \| ([\d.]+) ?(s|ms|us|) \| \S.* \|$", re.MULTILINE)
ROWS = {f"{module}.{name}": (float(number), unit) for module, name, number, unit in ROW.findall(TABLE.read_text())}


def test_every_row_of_the_table_is_read() -> None:
    assert len(ROWS) == sum(line.startswith("| `") for line in TABLE.read_text().splitlines()) > 40


@pytest.mark.parametrize("name", ROWS)
def test_the_code_has_what_the_table_says(name: str) -> None:
    number, unit = ROWS[name]
    module, _, constant = name.rpartition(".")
    try:
        value = getattr(import_module(f"trilane.{module}"), constant)
    except ModuleNotFoundError as error:
        if str(error.name).startswith("trilane"):
            raise
        value = written_value(module, constant)
    if unit:
        assert value * ENDINGS[re.search(r"_[A-Z]+$", constant)[0]] == pytest.approx(number * UNITS[unit], rel=1e-12)
    else:
        assert value == number


def written_value(module: str, constant: str) -> Any:
    """The literal that a module which needs an extra gives to `constant`, read without importing it."""
    folder, _, name = module.rpartition(".")
    source = (files(f"trilane.{folder}") / f"{name}.py").read_text(encoding="utf-8")
    for node in ast.parse(source).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == constant for target in targets):
            return ast.literal_eval(node.value)  # type: ignore[attr-defined]
    raise AssertionError(f"{module} has no {constant}")


def test_a_literal_is_read_as_it_is_imported() -> None:
    assert written_value("apps.compare.pages", "MOST_STILLS") == import_module("trilane.apps.compare.pages").MOST_STILLS
    with pytest.raises(AssertionError, match="NONE"):
        written_value("apps.compare.pages", "NONE")
