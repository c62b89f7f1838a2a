"""The house in layers: every folder imports from lower rows alone, and no files import each other in a circle."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "trilane"
#: From the ground up; docs/pipeline.md shows the same table. What stands in one row does not import from that row.
ROWS = (
    (
        "arrays",
        "cache",
        "errors",
        "machine",
        "files",
        "options",
        "signals",
        "unet_tables",
        "unexpected_value",
        "units",
        "writing",
    ),
    ("transport",),
    ("scheduler", "body"),
    ("pipeline",),
    ("scene", "avatars", "hw_profiles"),
    ("stages",),
    ("training",),
    ("bench",),
    ("apps",),
    ("__init__", "__main__"),
)
ROW_OF = {name: row for row, names in enumerate(ROWS, start=1) for name in names}
SHADERS = "shaders"  # no Python but its empty __init__

Imports = Mapping[str, set[str]]


def modules() -> dict[str, Path]:
    """Every module of the package by its name without `trilane.`; links are followed."""
    tops = [path for path in PACKAGE.iterdir() if path.is_dir() and path.name != "__pycache__"]
    files = [*PACKAGE.glob("*.py"), *(file for top in tops for file in top.resolve().rglob("*.py"))]
    roots = {top.resolve(): top.name for top in tops}

    def name(file: Path) -> str:
        for root, top in roots.items():
            if file.is_relative_to(root):
                parts = (top, *file.relative_to(root).with_suffix("").parts)
                return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        return file.stem

    return {name(file): file for file in files}


def imported(source: str, known: set[str]) -> Iterator[str]:
    """The modules of `known` that `source` imports, anywhere in it: also in functions and under TYPE_CHECKING."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        else:
            continue
        yield from ({name.removeprefix("trilane.") for name in names if name.startswith("trilane.")} & known)


def targets(module: str, source: str, known: set[str]) -> set[str]:
    """The modules that `module` imports, without the packages that those stand in."""
    names = set(imported(source, known)) - {module}
    return {name for name in names if not any(other.startswith(name + ".") for other in names)}


def imports_of(files: Mapping[str, str]) -> dict[str, set[str]]:
    return {module: targets(module, source, set(files)) for module, source in files.items()}


def upward(graph: Imports) -> list[str]:
    """A sentence for every import that does not go to a lower row, or within the folder."""
    sentences = []
    for module, targets in graph.items():
        top = module.split(".")[0]
        for target in targets:
            other = target.split(".")[0]
            if top in (other, SHADERS) or (ROW_OF[top] == ROW_OF.get(other) == 1):
                continue
            if ROW_OF.get(other, len(ROWS) + 1) >= ROW_OF[top]:
                sentences.append(f"{module} (row {ROW_OF[top]}) imports {target}")
    return sentences


def circle(graph: Imports) -> list[str]:
    """Modules that import each other in a circle, the first such circle; empty when there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


@pytest.fixture(scope="module")
def graph() -> dict[str, set[str]]:
    return imports_of({name: path.read_text(encoding="utf-8") for name, path in modules().items()})


def test_every_folder_has_a_row(graph: Imports) -> None:
    assert {module.split(".")[0] for module in graph} == {*ROW_OF, SHADERS}
    assert len(graph) > 200


def test_every_import_goes_down(graph: Imports) -> None:
    assert upward(graph) == []


def test_no_files_import_each_other_in_a_circle(graph: Imports) -> None:
    assert circle(graph) == []


@pytest.mark.parametrize(
    "statement",
    [
        "from trilane.scene.schema import Scene",
        "import trilane.stages.config",
        "from trilane.apps import interface",
        "def late():\n    from trilane.pipeline.run import run_pipeline",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from trilane.body.joints import JOINTS",
    ],
)
def test_an_upward_import_is_found(graph: Imports, statement: str) -> None:
    """Of the scheduler: to rows above it, and to the other folder of its own row."""
    added = targets("scheduler.core", statement, set(graph))
    assert len(upward({**graph, "scheduler.core": {*graph["scheduler.core"], *added}})) == 1


def test_a_circle_is_found(graph: Imports) -> None:
    assert set(circle({**graph, "scheduler.events": {"scheduler.core"}})) >= {"scheduler.events", "scheduler.core"}
