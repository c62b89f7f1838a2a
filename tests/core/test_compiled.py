"""The compiled core: it is what its sources say, and answers as they do."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

import pytest

from trilane.compiled import MODULES, check, form, library
from trilane.errors import MissingPartError

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "trilane"
#: Prints a digest of every step of runs under all policies and edges, with units that die.
TRACES = """
import hashlib, random
from trilane.scheduler.core import __file__ as core
from trilane.scheduler.events import Settings, chain
from trilane.scheduler.virtual import simulate
stages = (("pose", "cpu"), ("raster", "gpu"), ("infer", "dsp"), ("composite", "gpu"), ("present", "cpu"))
service = lambda stage, unit, frame, begin: random.Random(f"{stage} {frame}").randint(1, 9000)
found = []
for policy in ("sequential", "pipelined", "latest", "deadline"):
    for edge in ("single", "double", "triple", "fifo:3", "orphan"):
        settings = Settings(80, policy, period_ns=7000, deadline_ns=40000, latch_ns=500)
        faults = [(150_000, "dsp"), (310_000, "gpu")]
        done = simulate(chain(stages, edge, "composite"), settings, service, restart_ns=9000, faults=faults, keep=True)
        found.append(repr((done.recording.steps, done.report, done.jobs)))
print(core.endswith(".so"), hashlib.sha256("".join(found).encode()).hexdigest())
"""


def tree(folder: Path) -> Path:
    """The sources that are compiled, alone."""
    for name in MODULES:
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copy(PACKAGE / name, folder / name)
    return folder


def traces(package_root: Path) -> tuple[str, str]:
    """Whether the core there is compiled, and the digest."""
    environment = {**os.environ, "PYTHONPATH": str(package_root)}
    done = subprocess.run(
        [sys.executable, "-c", TRACES], env=environment, cwd=package_root, capture_output=True, text=True, check=True
    )
    compiled, digest = done.stdout.split()
    return compiled, digest


def test_the_compiled_core_answers_as_its_sources_do(tmp_path: Path) -> None:
    if form() == "interpreted":
        pytest.skip("no compiled core here: it takes a C compiler when Trilane is installed")
    for folder in ("scheduler", "transport"):
        shutil.copytree(PACKAGE / folder, tmp_path / "trilane" / folder, ignore=shutil.ignore_patterns("*.so"))
    for name in ("__init__.py", "compiled.py", "errors.py", "unexpected_value.py"):
        shutil.copy(PACKAGE / name, tmp_path / "trilane")
    as_python, as_compiled = traces(tmp_path), traces(PACKAGE.parent)
    assert (as_python[0], as_compiled[0]) == ("False", "True")
    assert as_python[1] == as_compiled[1]


def test_sources_alone_are_interpreted(tmp_path: Path) -> None:
    """And so they are beside what another Python compiled."""
    package = tree(tmp_path)
    assert form(package) == "interpreted"
    (package / "scheduler" / "core.cpython-27-x86_64-linux-gnu.so").touch()
    assert form(package) == "interpreted"


def test_sources_that_changed_after_they_were_compiled_do_not_run(tmp_path: Path) -> None:
    package = tree(tmp_path)
    (package / "scheduler" / f"core{EXTENSION_SUFFIXES[0]}").touch()
    before = library(package)
    with (package / "transport" / "slots.py").open("a") as file:
        file.write("\n")
    assert library(package) != before
    assert form(package) == "stale"
    with pytest.raises(MissingPartError, match="make compile"):
        check(package)


def test_the_library_is_named_after_the_sources_that_there_are() -> None:
    """Every module that is compiled is a file; a renamed or forgotten one would stop the build."""
    assert all((PACKAGE / name).is_file() for name in MODULES)
    joined = b"\0".join((PACKAGE / name).read_bytes() for name in MODULES)
    assert library(PACKAGE) == f"trilane_core_{hashlib.sha256(joined).hexdigest()[:16]}"
    folder = PACKAGE / "scheduler"
    compiled = {name.removeprefix("scheduler/") for name in MODULES if name.startswith("scheduler/")}
    interpreted = {
        "__init__.py",
        "beside.py",
        "placement.py",
        "placement_list.py",
        "placement_model.py",
        "places.py",
        "release.py",
        "turns.py",
        "uncertainty.py",
    }
    assert {path.name for path in folder.glob("*.py")} - compiled == interpreted
