"""What avatars are trained, quantised and validated with is held: printed/training-protocol.txt has every number.

Rule: the committed avatar and its figures were made with these numbers; others make another avatar. A change is meant
when the file is written anew (`TRILANE_WRITE_PRINTED=1`) and its difference is read. The numbers are read from the
sources, since some of the modules need PyTorch.
"""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
FILE = Path(__file__).resolve().parents[1] / "printed" / "training-protocol.txt"
PLAIN = (
    *(ast.Constant, ast.Tuple, ast.List, ast.Set, ast.Dict, ast.UnaryOp, ast.BinOp, ast.operator, ast.unaryop),
    ast.expr_context,
)


def lines() -> Iterator[str]:
    for path in sorted((ROOT / "training").rglob("*.py")):
        module = ".".join(path.relative_to(ROOT / "training").with_suffix("").parts)
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for statement in tree.body:
            targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
            for name in targets:
                if isinstance(name, ast.Name) and name.id.isupper() and has_numbers_alone(statement.value):  # type: ignore[attr-defined]
                    yield f"{module}.{name.id} = {ast.unparse(statement.value)}"  # type: ignore[attr-defined]
        yield from (f"{module}.{text}" for text in (*fields(tree), *defaults(tree)))


def fields(tree: ast.Module) -> Iterator[str]:
    """`Table.key = number` of every key of a settings table whose default is a number or made of them."""
    for table in tree.body:
        for field in table.body if isinstance(table, ast.ClassDef) else []:
            if isinstance(field, ast.AnnAssign) and isinstance(field.value, ast.Call):
                for keyword in field.value.keywords:
                    if keyword.arg == "default" and has_numbers_alone(keyword.value):
                        yield f"{table.name}.{ast.unparse(field.target)} = {ast.unparse(keyword.value)}"


def defaults(tree: ast.Module) -> Iterator[str]:
    """`function(argument=number)` of every default that is a number or made of them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            usual = [*node.args.posonlyargs, *node.args.args]
            named = zip(usual[len(usual) - len(node.args.defaults) :], node.args.defaults, strict=True)
            for argument, value in [*named, *zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)]:
                if value is not None and has_numbers_alone(value):
                    yield f"{node.name}({argument.arg}={ast.unparse(value)})"


def has_numbers_alone(value: ast.expr) -> bool:
    """Whether it is made of numbers, with words as keys at the most."""
    parts = list(ast.walk(value))
    return all(isinstance(part, PLAIN) for part in parts) and any(
        isinstance(part, ast.Constant) and isinstance(part.value, int | float) for part in parts
    )


def test_what_avatars_are_made_with_is_held() -> None:
    found = "".join(f"{line}\n" for line in lines())
    if "TRILANE_WRITE_PRINTED" in os.environ:
        FILE.write_text(found, encoding="utf-8")
    assert found.splitlines() == FILE.read_text(encoding="utf-8").splitlines()
