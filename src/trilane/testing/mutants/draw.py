"""Which faults are tried. Rule: every line is equally likely, then every kind of fault in it."""

from __future__ import annotations

import random
from collections import defaultdict
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

from trilane.testing.mutants.fault import Edit, Fault, fault_between
from trilane.testing.mutants.python_faults import python_faults
from trilane.testing.mutants.text_faults import COMMENT, text_faults

SUFFIXES = {".py", *COMMENT}
LARGEST_FRUITLESS = 1000
#: Not code of the project: tests, what installs it, this tool and the doubles.
OUTSIDE = ("tests/", "docs/", "src/trilane/testing/", "setup.py", "pyproject.toml", ".")


def code_files(tracked: Sequence[str]) -> list[str]:
    """The files that faults are put into."""
    return [path for path in tracked if Path(path).suffix in SUFFIXES and not path.startswith(OUTSIDE)]


def draw(root: Path, paths: Sequence[str], seed: int) -> Iterator[Fault]:
    """Faults without end, none twice; ends when many draws in a row bring none that is new. `paths`: `code_files`."""
    chance = random.Random(seed)
    texts = {path: (root / path).read_text(encoding="utf-8") for path in paths}
    weights = [len(text.splitlines()) for text in texts.values()]
    seen: set[Fault] = set()
    fruitless = 0
    while fruitless < LARGEST_FRUITLESS:
        fruitless += 1
        path = chance.choices(paths, weights)[0]
        fault = _one(path, texts[path], chance)
        if fault and fault not in seen:
            seen.add(fault)
            fruitless = 0
            yield fault


def _one(path: str, text: str, chance: random.Random) -> Fault | None:
    """A fault of the file, or None when what was drawn changes nothing or is no Python."""
    by_line = _edits(path, text)
    if not by_line:
        return None
    kinds = by_line[chance.choice(sorted(by_line))]
    edit = chance.choice(kinds[chance.choice(sorted(kinds))])
    changed = edit.make()
    if changed == text or (path.endswith(".py") and not _is_python(changed)):
        return None
    return fault_between(path, edit.kind, text, changed)


@cache
def _edits(path: str, text: str) -> dict[int, dict[str, list[Edit]]]:
    """Every fault of a file, by line and kind."""
    found: dict[int, dict[str, list[Edit]]] = defaultdict(lambda: defaultdict(list))
    suffix = Path(path).suffix
    for edit in python_faults(text) if suffix == ".py" else text_faults(text, suffix):
        found[edit.line][edit.kind].append(edit)
    return found


def _is_python(text: str) -> bool:
    try:
        compile(text, "fault", "exec")
    except SyntaxError:
        return False
    return True
