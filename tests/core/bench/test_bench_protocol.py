"""What the benches measure with is held: numbers, tables and defaults, as printed/bench-protocol.txt has them.

Rule: figures of two days compare only while sizes, rounds, warm-ups, limits and defaults stay. A change is meant when
the file is written anew (`TRILANE_WRITE_PRINTED=1`) and its difference is read.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import os
import pkgutil
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import trilane.bench
from trilane import machine
from trilane.bench import LIMITS, check_limits
from trilane.errors import BadInputError

FILE = Path(__file__).parents[1] / "printed/bench-protocol.txt"
ROOT = Path(__file__).resolve().parents[3]
OF_THE_MACHINE = {"threads"}


def modules() -> Iterator[ModuleType]:
    yield trilane.bench
    for found in sorted(pkgutil.walk_packages(trilane.bench.__path__, "trilane.bench."), key=lambda each: each.name):
        yield importlib.import_module(found.name)


def constants(module: ModuleType) -> Iterator[tuple[str, Any]]:
    """Names in capitals that the module itself assigns."""
    for statement in ast.parse(inspect.getsource(module)).body:
        targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
        for target in targets:
            for name in target.elts if isinstance(target, ast.Tuple) else [target]:
                if isinstance(name, ast.Name) and name.id.isupper():
                    yield name.id, getattr(module, name.id)


def rows_of(name: str, value: Any) -> Iterator[str]:
    """A line for a value, and one for each row of a table that has more."""
    rows = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, tuple) else ()
    if not rows:
        yield f"{name} = {shown(value)}"
    for key, row in rows:
        if key not in OF_THE_MACHINE:
            yield f"{name}[{key!r}] = {shown(row)}"


def shown(value: Any) -> str:
    """One value: a function or class by its name, bytes in hexadecimal, many of them by their number."""
    if isinstance(value, bytes):
        return value.hex() if len(value) < 100 else f"{len(value)} bytes, {sum(value)} in all"
    return getattr(value, "__qualname__", None) or " ".join(repr(value).split())


def defaults(function: Any) -> str:
    parameters = inspect.signature(function).parameters.values()
    return ", ".join(f"{each.name}={shown(each.default)}" for each in parameters if each.default is not each.empty)


def lines() -> Iterator[str]:
    for module in modules():
        name = module.__name__.removeprefix("trilane.bench.")
        for key, value in constants(module):
            yield from rows_of(f"{name}.{key}", value)
        for key, value in vars(module).items():
            if getattr(value, "__module__", "") != module.__name__:
                continue
            if dataclasses.is_dataclass(value):
                is_fixed = value.__dataclass_params__.frozen  # type: ignore[attr-defined]
                yield f"{name}.{key}({defaults(value)}){', frozen' if is_fixed else ''}"
            elif inspect.isfunction(value) and defaults(value):
                yield f"{name}.{key}({defaults(value)})"


def test_what_the_benches_measure_with_is_held() -> None:
    found = "".join(f"{line}\n" for line in lines()).replace(str(ROOT), "ROOT")
    if "TRILANE_WRITE_PRINTED" in os.environ:
        FILE.write_text(found, encoding="utf-8")
    assert found.splitlines() == FILE.read_text(encoding="utf-8").splitlines()


def test_threads_may_be_four_to_a_core() -> None:
    assert LIMITS["threads"] == (0, 4 * machine.here.core_count())


@pytest.mark.parametrize("option", sorted(set(LIMITS) - {"threads"}))
def test_both_ends_of_a_range_are_taken_and_no_more(option: str) -> None:
    low, high = LIMITS[option]
    step = 1 if isinstance(low, int) else 1e-4
    check_limits({option: low})
    check_limits({option: (low, high)})
    for bad in (low - step, high + 1):
        with pytest.raises(BadInputError, match=re.escape(f"expected {low:g} to {high:g}")):
            check_limits({option: [low, bad]})
