"""Which test files reach which lines. Rule: measured in every process of a test, and again when the test changes.

Python by coverage.py; shaders and tables, which are no Python, by which test files open them.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from trilane.testing.mutants.fault import Fault
from trilane.testing.mutants.text_faults import COMMENT
from trilane.testing.mutants.tree_copy import FreeCopies, TreeCopy
from trilane.testing.mutants.trial import NO_TESTS
from trilane.writing import write_bytes

LONGEST_S = 900
SETTINGS = """
[run]
parallel = true
sigterm = true
include = {root}/*
"""
#: Lines of a folder behind a link are told by the folder's own path, so `include` is the whole tree.
CHILDREN = """\
patch =
    _exit
    fork
    subprocess
"""
#: In every Python process of a measurement: note the files with these endings that it opens.
SITE = """
import os, sys
def note(event, arguments, endings={endings!r}, where=os.environ["TRILANE_OPENED"]):
    if event == "open" and isinstance(arguments[0], str) and arguments[0].endswith(endings):
        descriptor = os.open(where, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        os.write(descriptor, (os.path.realpath(arguments[0]) + "\\n").encode())
        os.close(descriptor)
sys.addaudithook(note)
"""


class Reached(NamedTuple):
    """What one test file, of this digest, took in seconds, and the lines that it reached in each file ([] for all)."""

    digest: str
    seconds: float
    lines: dict[str, list[int]]


class Reach:
    """By test file; `sources`: the digests of the files with the lines, to see which have changed since."""

    def __init__(self, tests: Mapping[str, Reached], sources: Mapping[str, str]) -> None:
        self.tests = dict(tests)
        self.sources = dict(sources)

    def tests_of(self, fault: Fault, digest: str) -> list[str]:
        """The test files that reach the fault's line, quickest first; those that reach its file, when none does."""
        span = range(fault.line, fault.line + max(1, fault.old.count("\n")))
        by_file = [name for name, reached in self.tests.items() if fault.path in reached.lines]
        by_line = [name for name in by_file if self._is_there(self.tests[name].lines[fault.path], span)]
        unchanged = self.sources.get(fault.path) == digest
        return sorted(by_line if by_line and unchanged else by_file, key=lambda name: self.tests[name].seconds)

    def within(self, names: Sequence[str], most_s: float) -> tuple[list[str], float]:
        """As many of the test files as take `most_s` together, at least the first, and the seconds that they take.

        They run in one process: what the quickest of all takes is its start, which counts once.
        """
        start_s = min((row.seconds for row in self.tests.values()), default=0.0)
        chosen, seconds = 0, start_s
        for name in names:
            own_s = self.tests[name].seconds - start_s
            if chosen and seconds + own_s > most_s:
                break
            chosen += 1
            seconds += own_s
        return list(names[:chosen]), seconds

    @staticmethod
    def _is_there(lines: list[int], span: range) -> bool:
        return not lines or any(line in span for line in lines)


def digest_of(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()[:16]


def load_reach(file: Path) -> Reach:
    """What was measured before; nothing when there is no file."""
    if not file.is_file():
        return Reach({}, {})
    kept = json.loads(file.read_text(encoding="utf-8"))
    return Reach({name: Reached(*row) for name, row in kept["tests"].items()}, kept["sources"])


def measure_reach(
    trees: Sequence[TreeCopy], test_files: Iterable[str], sources: Iterable[str], file: Path, say: Callable[[str], None]
) -> Reach:
    """Measure the test files that are new or changed, as many at a time as there are copies, and keep all in `file`."""
    root = trees[0].root
    old = load_reach(file)
    wanted = {name: digest_of(root / name) for name in test_files}
    reach = Reach({name: row for name, row in old.tests.items() if wanted.get(name) == row.digest}, old.sources)
    missing = [name for name in wanted if name not in reach.tests]
    if len(missing) == len(wanted):
        reach.sources = {path: digest_of(root / path) for path in sources}

    def measure(number: int) -> Reached | None:
        with free.taken() as tree:
            say(f"what {missing[number]} reaches ({number + 1} of {len(missing)})")
            return _measured(tree, missing[number], wanted[missing[number]])

    free = FreeCopies(trees)
    with ThreadPoolExecutor(len(trees)) as pool:
        for name, reached in zip(missing, pool.map(measure, range(len(missing))), strict=True):
            if reached is None:
                say(f"LEFT OUT, since it fails without a fault: {name}")
                continue
            reach.tests[name] = reached
            write_bytes(file, json.dumps({"tests": reach.tests, "sources": reach.sources}).encode())
    return reach


def _measured(tree: TreeCopy, test_file: str, digest: str) -> Reached | None:
    """None for a test that fails. One that fails because its processes are looked at is measured without them."""
    for settings in (SETTINGS + CHILDREN, SETTINGS):
        begin = time.monotonic()
        opened = _run_under_coverage(tree, test_file, settings)
        if opened is not None:
            seconds = time.monotonic() - begin
            found = _lines(tree, opened)
            return Reached(digest, round(seconds, 2), {path: sorted(lines) for path, lines in sorted(found.items())})
    return None


def _run_under_coverage(tree: TreeCopy, test_file: str, settings: str) -> Path | None:
    """The file with the names of the tables and shaders that were opened; None when the test fails."""
    tree.clean()
    (tree.temporary / "sitecustomize.py").write_text(SITE.format(endings=tuple(COMMENT)), encoding="utf-8")
    file, opened = tree.temporary / "coveragerc", tree.temporary / "opened"
    file.write_text(settings.format(root=tree.root.resolve()), encoding="utf-8")
    environment = {
        **tree.environment(),
        "COVERAGE_FILE": str(tree.temporary / "coverage"),
        "TRILANE_OPENED": str(opened),
    }
    environment["PYTHONPATH"] += f":{tree.temporary}"
    words = [sys.executable, "-m", "coverage", "run", f"--rcfile={file}", "-m", "pytest", "-q", "-p"]
    done = subprocess.run(
        [*words, "no:cacheprovider", "--timeout=0", test_file],
        cwd=tree.root,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        timeout=LONGEST_S,
    )
    return opened if done.returncode in (0, NO_TESTS) else None


def _lines(tree: TreeCopy, opened: Path) -> dict[str, set[int]]:
    """The lines by file that the processes have noted; none for a file that was only opened."""
    from coverage import CoverageData
    from coverage.exceptions import DataError

    lines: dict[str, set[int]] = {}
    for part in tree.temporary.glob("coverage.*"):
        data = CoverageData(str(part))
        try:
            data.read()
        except DataError:  # its process was killed while it wrote
            continue
        for measured in data.measured_files():
            path, reached = _inside(tree, measured), data.lines(measured)
            if path and reached:
                lines.setdefault(path, set()).update(reached)
    for name in opened.read_text(encoding="utf-8").splitlines() if opened.is_file() else ():
        path = _inside(tree, name)
        if path:
            lines.setdefault(path, set())
    return lines


def _inside(tree: TreeCopy, name: str) -> str:
    """The path in the tree, links followed; empty for a file outside."""
    real, root = Path(name).resolve(), tree.root.resolve()
    return real.relative_to(root).as_posix() if real.is_relative_to(root) else ""
