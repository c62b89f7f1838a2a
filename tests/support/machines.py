"""The command of `make test-machines`: some tests once more on each machine of tests/machines.toml.

Rule: every row is printed, with what it did or with the reason why it cannot be tried here. A row begins with the test
of tests/machines/test_rows.py that has its name, which says whether the machine is what the row asks for. What pytest
printed is kept in .venv/machines/NAME.log.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
import tomllib
import venv
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from fnmatch import fnmatchcase
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from trilane import machine
from trilane.errors import BadInputError, did_you_mean

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "tests" / "machines.toml"
KEPT = ROOT / ".venv" / "machines"
PYENV = Path("~/.pyenv/versions")
EXTRAS = ("openvino", "metrics", "dev")
#: Of `dev`: style, types and wheels are not checked on these machines.
NOT_HERE = ("ruff", "mypy", "setuptools", "build")
NO_NETWORK = ("Network is unreachable", "Temporary failure in name resolution", "Connection refused")


class CannotRunError(Exception):
    """The row cannot be tried here; its text says why."""


@dataclass(frozen=True)
class Row:
    """One machine; the fields are described at the head of tests/machines.toml."""

    name: str
    stands_for: str
    tests: list[str] = field(default_factory=list)
    environment: dict[str, str] = field(default_factory=dict)
    wrapper: list[str] = field(default_factory=list)
    machine: dict[str, Any] = field(default_factory=dict)
    without_programs: list[str] = field(default_factory=list)
    needs: list[str] = field(default_factory=list)
    umask: int = -1
    checkout: str = ""
    python: str = ""
    lowest: bool = False

    @property
    def own_test(self) -> str:
        return f"tests/machines/test_rows.py::test_{re.sub('[-.]', '_', self.name)}"


@dataclass(frozen=True)
class Outcome:
    """What a row did. `failures`: a line for each; `reason`: why it could not be tried."""

    name: str
    passed: int = 0
    skipped: int = 0
    failures: tuple[str, ...] = ()
    seconds: float = 0.0
    reason: str = ""

    def __str__(self) -> str:
        if self.reason:
            return f"{self.name:20}  not run: {self.reason}"
        said = f"{self.passed} passed, {len(self.failures)} failed, {self.skipped} skipped"
        return f"{self.name:20}  {said}  {self.seconds:.0f} s"


def load_rows(file: Path = TABLE) -> tuple[list[Row], list[str]]:
    """The rows, and the tests of every row. Raises BadInputError for a row with a key that none has, or without one."""
    table = tomllib.loads(file.read_text(encoding="utf-8"))
    return [_row(f"{file}, row {number}", row) for number, row in enumerate(table["row"], 1)], table["everywhere"]


def _row(where: str, row: Mapping[str, Any]) -> Row:
    known = [each.name for each in fields(Row)]
    where += f" ({row['name']})" if "name" in row else ""
    for key in row.keys() - set(known):
        raise BadInputError(f"{where}: {key}", "a key that no row has", ", ".join(known), did_you_mean(key, known))
    for key in ("name", "stands_for"):
        if key not in row:
            raise BadInputError(where, f"no {key}", "a name and what it stands for")
    return Row(**row)


def outcome_of(row: Row, text: str, code: int, told: Path, seconds: float) -> Outcome:
    """From what pytest told a file and printed. A row in which no test passed has shown nothing."""
    found: dict[str, Any] = {"failed": [], "skipped": [], "passed": 0}
    if told.is_file():
        found = json.loads(told.read_text(encoding="utf-8"))
        told.unlink()
    failures = found["failed"]
    if not failures and (code != 0 or not found["passed"]):
        failures = [f"pytest ended with exit code {code}: {text.rstrip().rpartition(chr(10))[2]}"]
    return Outcome(row.name, found["passed"], len(found["skipped"]), tuple(failures), seconds)


def lowest_versions(project: Mapping[str, Any]) -> list[str]:
    """What a run and its tests need, each `>=` as `==`. `project`: that of pyproject.toml."""
    extras = [line for extra in EXTRAS for line in project["optional-dependencies"][extra]]
    return [line.replace(">=", "==") for line in (*project["dependencies"], *extras) if not line.startswith(NOT_HERE)]


def find_python(version: str) -> Path:
    """A Python `version`, such as 3.13: this one, of PATH, or of pyenv. Raises CannotRunError."""
    if version == "{}.{}".format(*sys.version_info):
        return Path(sys.executable)
    own = PYENV.expanduser().glob(f"{version}.*/bin/python")
    newest_first = sorted(map(str, own), key=lambda path: int(Path(path).parts[-3].split(".")[2]), reverse=True)
    # pyenv also puts a program of every version on PATH, which fails where that version is not chosen
    for path in (machine.here.program(f"python{version}"), *newest_first):
        if (
            path
            and subprocess.run([path, "-c", "import venv, ensurepip"], capture_output=True, check=False).returncode == 0
        ):
            return Path(path)
    raise CannotRunError(f"no Python {version} on PATH or in {PYENV}")


def environment_python(row: Row, wanted: Sequence[str]) -> Path:
    """The Python of the row's environment, which is made unless one for the same packages is there.

    Raises CannotRunError where there is no such Python or no network, CalledProcessError with pip's words.
    """
    python = find_python(row.python)
    if str(python) == sys.executable and not row.lowest:
        return python
    folder = KEPT / row.name
    stamp, text = folder / "made-of", "\n".join([str(python), *wanted])
    if not (stamp.is_file() and stamp.read_text(encoding="utf-8") == text):
        shutil.rmtree(folder, ignore_errors=True)
        subprocess.run([python, "-m", "venv", folder], check=True, capture_output=True, text=True)
        pip = [str(folder / "bin/python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *wanted]
        done = subprocess.run(pip, capture_output=True, text=True, check=False)
        if any(words in done.stderr for words in NO_NETWORK):
            raise CannotRunError("pip reaches no package index")
        done.check_returncode()
        stamp.write_text(text, encoding="utf-8")
    return folder / "bin/python"


@contextmanager
def checkout(name: str) -> Iterator[tuple[Path, Path]]:
    """The root of a copy of the tree in a folder `name` and its Python; for "" this tree and Python.

    The copy has every file that git knows or would take, and the real inputs beside it. The packages of its environment
    are those of this one. Raises CalledProcessError outside a checkout of git.
    """
    if not name:
        yield ROOT, Path(sys.executable)
        return
    words = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    with TemporaryDirectory(prefix="trilane-copy-") as folder:
        copy = Path(folder, name)
        for path in (each for each in listed if os.path.lexists(ROOT / each)):
            (copy / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / path, copy / path, follow_symlinks=False)
        if (ROOT.parent / "shared").is_dir():
            Path(folder, "shared").symlink_to(ROOT.parent / "shared")
        made = copy / ".venv"
        venv.create(made, symlinks=True)
        (site,) = made.glob("lib/python*/site-packages")
        there = sysconfig.get_path("purelib")
        (site / "packages.pth").write_text(f"import site; site.addsitedir({there!r})\n", encoding="utf-8")
        yield copy, made / "bin/python"


@contextmanager
def path_without(patterns: Sequence[str]) -> Iterator[str]:
    """A PATH with every program but those whose names fit."""
    path = os.environ.get("PATH", os.defpath)
    if not patterns:
        yield path
        return
    with TemporaryDirectory(prefix="programs-") as folder:
        for place in path.split(os.pathsep):
            for program in sorted(Path(place).iterdir()) if Path(place).is_dir() else ():
                link = Path(folder, program.name)
                if not link.is_symlink() and not any(fnmatchcase(program.name, each) for each in patterns):
                    link.symlink_to(program)
        yield folder


def run_row(row: Row, everywhere: Sequence[str]) -> Outcome:
    """The row's tests on its machine."""
    began = time.monotonic()
    try:
        for need in row.needs:
            if not Path(need).exists() and machine.here.program(need) is None:
                raise CannotRunError(f"needs {need}")
        return _run(row, everywhere, began)
    except CannotRunError as why:
        return Outcome(row.name, reason=str(why))
    except subprocess.CalledProcessError as error:
        lines = [line for line in (error.stderr or "").splitlines() if line.startswith("ERROR")] or ["no words"]
        failure = f"its environment could not be made: {lines[-1]}"
        return Outcome(row.name, failures=(failure,), seconds=time.monotonic() - began)


def _run(row: Row, everywhere: Sequence[str], began: float) -> Outcome:
    with checkout(row.checkout) as (root, python), path_without(row.without_programs) as path:
        if row.python:
            project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
            wanted = lowest_versions(project)
            python = environment_python(row, wanted if row.lowest else [line.replace("==", ">=") for line in wanted])
        environment = {
            **os.environ,
            "PATH": path,
            "PYTHONPATH": os.pathsep.join(str(root / folder) for folder in ("tests/machines", "tests", "src")),
            "TRILANE_TEST_MACHINE": json.dumps(row.machine),
            **row.environment,
        }
        tests = [row.own_test, *row.tests, *everywhere]
        wrapper = [word.format(first_core=machine.here.cores()[0]) for word in row.wrapper]
        KEPT.mkdir(parents=True, exist_ok=True)
        told = KEPT / f"{row.name}.json"
        told.unlink(missing_ok=True)
        plugins = ["-p", "no:cacheprovider", "-p", "support.checks", f"--tell={told}"]
        if row.lowest:  # an old package may use what a newer one of its own has deprecated
            plugins += ["-W", "ignore::DeprecationWarning"]
        words = [*wrapper, str(python), "-m", "pytest", "--quiet", "--color=no", *plugins, *tests]
        done = subprocess.run(
            words,
            cwd=root,
            env=environment,
            umask=row.umask,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            check=False,
        )
    text = done.stdout.decode(errors="replace")
    (KEPT / f"{row.name}.log").write_text(text, encoding="utf-8")
    return outcome_of(row, text, done.returncode, told, time.monotonic() - began)


def last_line(outcomes: Sequence[Outcome]) -> str:
    """Every failure by its row."""
    failed = [f"{outcome.name}: {failure}" for outcome in outcomes for failure in outcome.failures]
    tried = [outcome for outcome in outcomes if not outcome.reason]
    said = f"{len(tried)} machines tried, {len(outcomes) - len(tried)} not; "
    return said + (f"FAILED {'; '.join(failed)}" if failed else "0 failed")


def arguments(names: Sequence[str], words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="make test-machines ARGS=…",
        description="Run some tests once more on each machine of tests/machines.toml.",
        epilog="Example: make test-machines ARGS='--only one-core --only c-locale'",
    )
    parser.add_argument("--only", action="append", choices=names, metavar="NAME", help="only this row; often")
    parser.add_argument("--environments", action="store_true", help="the rows with packages or a Python of their own")
    parser.add_argument("--list", action="store_true", help="print the rows and run none")
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> int:
    try:
        rows, everywhere = load_rows()
    except BadInputError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    options = arguments([row.name for row in rows], words)
    chosen = [
        row for row in rows if (row.name in options.only if options.only else bool(row.python) == options.environments)
    ]
    if options.list:
        print(*(f"{row.name:20}  {row.stands_for}" for row in rows), sep="\n")
        return 0
    outcomes = []
    for row in chosen:
        outcomes.append(run_row(row, everywhere))
        print(outcomes[-1], *(f"  {failure}" for failure in outcomes[-1].failures), sep="\n", flush=True)
    print(last_line(outcomes))
    tried = any(not outcome.reason for outcome in outcomes)
    return int(not tried or any(outcome.failures for outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main())
