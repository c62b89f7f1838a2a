"""The runner of the table of machines: what it reads, tells and cannot run. No row of the table is run here."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from support import machines
from support.machines import (
    TABLE,
    CannotRunError,
    Outcome,
    Row,
    environment_python,
    find_python,
    last_line,
    load_rows,
    lowest_versions,
    outcome_of,
    path_without,
    run_row,
)
from trilane import machine

ROOT = Path(__file__).resolve().parents[2]
ROW = Row("some", "a machine")


def test_every_row_of_the_table_has_a_test_of_its_own_and_tests_that_are_there() -> None:
    rows, everywhere = load_rows()
    own = set(
        re.findall(r"^def (test_\w+)", (TABLE.parent / "machines" / "test_rows.py").read_text("utf-8"), re.MULTILINE)
    )
    assert {row.own_test.partition("::")[2] for row in rows} == own
    for name in {name.partition("::")[0] for row in rows for name in (*row.tests, *everywhere)}:
        assert (ROOT / name).is_file(), name
    assert all(row.tests for row in rows)


@pytest.mark.parametrize(
    ("row", "said"),
    [
        (
            'name = "a"\nstands_for = "b"\nwrappers = []',
            "row 2 (a): wrappers: found a key that no row has, expected name, ",
        ),
        ('name = "a"\nstands_for = "b"\nwrappers = []', "lowest; did you mean 'wrapper'?"),
        ('stands_for = "b"', "row 2: found no name, expected a name and what it stands for"),
        ('name = "a"', "row 2 (a): found no stands_for, expected"),
    ],
)
def test_a_row_of_other_keys_is_refused_by_name(
    row: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "rows.toml"
    file.write_text(f'everywhere = []\n[[row]]\nname = "x"\nstands_for = "y"\n[[row]]\n{row}\n', "utf-8")
    monkeypatch.setattr(machines, "load_rows", lambda: load_rows(file))
    assert machines.main([]) == 2
    out, err = capsys.readouterr()
    assert not out and err.startswith(f"{file}, row 2") and said in err


@pytest.mark.parametrize(
    ("told", "code", "outcome"),
    [
        ('{"failed": [], "skipped": ["b"], "passed": 3}', 0, Outcome("some", 3, 1, (), 2.0)),
        ('{"failed": ["t::x[a b]"], "skipped": [], "passed": 3}', 1, Outcome("some", 3, 0, ("t::x[a b]",), 2.0)),
        ('{"failed": [], "skipped": ["b"], "passed": 0}', 0, ("pytest ended with exit code 0: the end",)),
        ('{"failed": [], "skipped": [], "passed": 3}', 2, ("pytest ended with exit code 2: the end",)),
        ("", 4, ("pytest ended with exit code 4: the end",)),
    ],
)
def test_what_a_row_did(told: str, code: int, outcome: Any, tmp_path: Path) -> None:
    """A row in which nothing passed has failed, and so has one that pytest could not run."""
    file = tmp_path / "told.json"
    if told:
        file.write_text(told, encoding="utf-8")
    found = outcome_of(ROW, "first\nthe end\n", code, file, 2.0)
    assert found == outcome or found.failures == outcome
    assert not file.exists()


def test_lines() -> None:
    passed, failed = Outcome("one", 3, 1, (), 12.4), Outcome("two", 1, 0, ("a::b", "c"), 1.0)
    absent = Outcome("three", reason="needs taskset")
    assert str(passed) == "one                   3 passed, 0 failed, 1 skipped  12 s"
    assert str(failed) == "two                   1 passed, 2 failed, 0 skipped  1 s"
    assert str(absent) == "three                 not run: needs taskset"
    assert last_line([passed, absent]) == "1 machines tried, 1 not; 0 failed"
    assert last_line([passed, failed, absent]) == "2 machines tried, 1 not; FAILED two: a::b; two: c"


def test_lowest_versions() -> None:
    extras = {"openvino": ["o>=2025.0"], "metrics": [], "dev": ["p>=8", "q", "ruff>=0.9"], "other": ["r>=1"]}
    project = {"dependencies": ["numpy>=1.26"], "optional-dependencies": extras}
    assert lowest_versions(project) == ["numpy==1.26", "o==2025.0", "p==8", "q"]


def test_programs_are_hidden_by_name_and_the_first_of_a_name_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        for name in ("gcc-12", "cc", "cat", folder):
            (tmp_path / folder / name).touch()
    monkeypatch.setenv("PATH", f"{tmp_path / 'one'}:{tmp_path / 'two'}:{tmp_path / 'none'}")
    with path_without(["*gcc*", "cc"]) as path:
        links = {link.name: link.readlink() for link in Path(path).iterdir()}
    assert links == {"cat": tmp_path / "one/cat", "one": tmp_path / "one/one", "two": tmp_path / "two/two"}
    assert not Path(path).exists()
    with path_without([]) as path:
        assert path == os.environ["PATH"]


def test_a_python_that_is_not_there_or_does_not_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program of pyenv that stands for no version fails; of several versions the newest is taken."""
    monkeypatch.setattr(machines, "PYENV", tmp_path)
    monkeypatch.setattr(machine.here, "program", lambda _name: None)
    with pytest.raises(CannotRunError, match=r"no Python 3\.99 on PATH or in"):
        find_python("3.99")
    for version, code in (("3.99.2", 0), ("3.99.10", 0), ("3.99.11", 1)):
        program = tmp_path / version / "bin" / "python"
        program.parent.mkdir(parents=True)
        program.write_text(f"#!/bin/sh\nexit {code}\n", encoding="utf-8")
        program.chmod(0o755)
    assert find_python("3.99") == tmp_path / "3.99.10/bin/python"
    assert find_python("{}.{}".format(*sys.version_info)) == Path(sys.executable)


def test_an_environment_is_made_once_and_again_for_other_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[list[str]] = []
    answers = iter(["", "", "ERROR: [Errno 101] Network is unreachable", "ERROR: no such version"])

    def run(words: list[Any], **_: Any) -> subprocess.CompletedProcess[str]:
        ran.append([str(word) for word in words])
        (tmp_path / "low").mkdir(exist_ok=True)
        said = next(answers) if "pip" in ran[-1] else ""
        return subprocess.CompletedProcess(words, 1 if said else 0, "", said)

    monkeypatch.setattr(machines, "KEPT", tmp_path)
    monkeypatch.setattr(machines, "find_python", lambda _version: Path("/python"))
    monkeypatch.setattr(subprocess, "run", run)
    row = Row("low", "", python="3.99", lowest=True)
    assert environment_python(row, ["a==1"]) == tmp_path / "low/bin/python"
    assert [words[:3] for words in ran] == [["/python", "-m", "venv"], [str(tmp_path / "low/bin/python"), "-m", "pip"]]
    assert environment_python(row, ["a==1"]) == tmp_path / "low/bin/python"
    assert len(ran) == 2
    environment_python(row, ["a==2"])
    assert (len(ran), ran[-1][-1]) == (4, "a==2")
    with pytest.raises(CannotRunError, match="no package index"):
        environment_python(row, ["a==3"])
    with pytest.raises(subprocess.CalledProcessError):
        environment_python(row, ["a==3"])


def test_a_row_without_what_it_needs_is_not_run_and_says_so() -> None:
    row = Row("some", "", needs=["/nowhere/at/all"])
    assert str(run_row(row, [])) == "some                  not run: needs /nowhere/at/all"


def test_lowest_versions_of_this_project_are_numbers() -> None:
    """No bound is written in another way, which would be taken for none."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = lowest_versions(project)
    assert all(re.fullmatch(r"[\w.-]+(==[\d.]+)?", line) for line in lines)
    assert [line for line in lines if "==" not in line] == ["pytest-timeout"]
