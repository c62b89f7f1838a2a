"""How the tree reads, in numbers: `python tests/support/house.py [ROOT]` prints one table of product and tests.

A one-importer module has under 100 lines, and exactly one other module imports it, from the same package.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

PRODUCT = (
    "src/trilane", "apps", "avatars", "bench", "body", "hw_profiles", "pipeline", "scene", "scheduler", "shaders",
    "stages", "training", "transport",
)  # fmt: skip
SMALL_LINES = 100
Functions = ast.FunctionDef | ast.AsyncFunctionDef


def sources(root: Path, folders: tuple[str, ...]) -> dict[str, str]:
    """Text of each Python file below `folders`, by its path from `root`; links are not followed."""
    found: dict[str, str] = {}
    for folder in folders:
        for path in sorted((root / folder).rglob("*.py")):
            inner = path.relative_to(root)
            if not any((root / parent).is_symlink() for parent in inner.parents) and "build" not in inner.parts:
                found[str(inner)] = path.read_text(encoding="utf-8")
    return found


def module_name(path: str) -> str:
    """The dotted name below `trilane`, of a package without `__init__`."""
    parts = Path(path.removeprefix("src/trilane/")).with_suffix("").parts
    return ".".join(("trilane", *parts)).removesuffix(".__init__")


def imports(tree: ast.AST) -> Iterator[str]:
    """Names of modules that may be imported: `from a import b` gives a and a.b."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def one_importer(texts: dict[str, str], trees: dict[str, ast.Module]) -> int:
    """Modules under 100 lines with one importer, which is in the same package."""
    names = {module_name(path): path for path in texts}
    importers: dict[str, set[str]] = {name: set() for name in names}
    for path, tree in trees.items():
        for name in {*imports(tree)} & {*names}:
            if names[name] != path:
                importers[name].add(module_name(path))
    return sum(
        len(by) == 1 and next(iter(by)).rpartition(".")[0] == name.rpartition(".")[0]
        for name, by in importers.items()
        if texts[names[name]].count("\n") < SMALL_LINES and not names[name].endswith("__init__.py")
    )


def comments(text: str) -> int:
    """Comments of `text`, docstrings apart."""
    return sum(token.type == tokenize.COMMENT for token in tokenize.generate_tokens(io.StringIO(text).readline))


def parameters(trees: dict[str, ast.Module]) -> list[int]:
    """Number of parameters of each function, `self` and `cls` apart, in order."""
    found = []
    for tree in trees.values():
        for node in ast.walk(tree):
            if isinstance(node, Functions):
                named = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                found.append(sum(each.arg not in ("self", "cls") for each in named))
    return sorted(found)


def any_in_signatures(trees: dict[str, ast.Module]) -> int:
    """`Any` in annotations of parameters and results."""
    count = 0
    for tree in trees.values():
        for node in ast.walk(tree):
            if isinstance(node, Functions):
                every = [
                    *node.args.posonlyargs,
                    *node.args.args,
                    *node.args.kwonlyargs,
                    node.args.vararg,
                    node.args.kwarg,
                ]
                notes = [each.annotation for each in every if each is not None] + [node.returns]
                count += sum(
                    isinstance(part, ast.Name) and part.id == "Any" for note in notes if note for part in ast.walk(note)
                )
    return count


def class_names(trees: dict[str, ast.Module]) -> tuple[int, int]:
    """Public class names that are there twice or more, and the most that one is."""
    names = [node.name for tree in trees.values() for node in tree.body if isinstance(node, ast.ClassDef)]
    twice = {name: names.count(name) for name in names if not name.startswith("_") and names.count(name) > 1}
    return len(twice), max(twice.values(), default=0)


def attributes(trees: dict[str, ast.Module]) -> tuple[int, int]:
    """Calls of `monkeypatch`, and private names that are read."""
    patched = private = 0
    for tree in trees.values():
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute):
                own = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
                patched += isinstance(node.value, ast.Name) and node.value.id == "monkeypatch"
                private += node.attr.startswith("_") and not node.attr.startswith("__") and not own
            elif isinstance(node, ast.ImportFrom):
                private += sum(a.name.startswith("_") and not a.name.startswith("__") for a in node.names)
    return patched, private


def main(root: Path) -> None:
    """Print the table."""
    rows: list[tuple[str, object]] = []
    for what, folders in (("product", PRODUCT), ("tests", ("tests",))):
        texts = sources(root, folders)
        trees = {path: ast.parse(text) for path, text in texts.items()}
        lines = sum(text.count("\n") for text in texts.values())
        rows += [(f"{what}: files", len(texts)), (f"{what}: lines", lines)]
        small = sum(text.count("\n") < SMALL_LINES for text in texts.values())
        rows += [(f"{what}: files under {SMALL_LINES} lines", f"{small} ({small / len(texts):.0%})")]
        if what == "tests":
            patched, private = attributes(trees)
            rows += [("tests: uses of monkeypatch", patched), ("tests: private names read", private)]
            continue
        counts = parameters(trees)
        heads = sum(
            len(ast.unparse(n).splitlines())
            for t in trees.values()
            for n in ast.walk(t)
            if isinstance(n, ast.Import | ast.ImportFrom)
        )
        twice, most = class_names(trees)
        rows += [
            ("product: one-importer modules", one_importer(texts, trees)),
            ("product: parameters, 95th percentile and most", f"{counts[int(0.95 * len(counts))]}, {counts[-1]}"),
            ("product: comments in 100 lines", f"{100 * sum(map(comments, texts.values())) / lines:.1f}"),
            ("product: import statements in 100 lines", f"{100 * heads / lines:.1f}"),
            ("product: `Any` in signatures", any_in_signatures(trees)),
            ("product: public class names there twice or more, most", f"{twice}, {most}"),
        ]
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print(f"{name:{width}}  {value}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
