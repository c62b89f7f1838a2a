"""The runner of the table of machines: what it reads, tells and cannot run. No row of the table is run here."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from support import machines
from support.machines import (
    TABLE,
    Outcome,
    Row,
    load_rows,
    lowest_versions,
    outcome_of,
    run_row,
)

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


def test_lowest_versions() -> None:
    extras = {"openvino": ["o>=2025.0"], "metrics": [], "dev": ["p>=8", "q", "ruff>=0.9"], "other": ["r>=1"]}
    project = {"dependencies": ["numpy>=1.26"], "optional-dependencies": extras}
    assert lowest_versions(project) == ["numpy==1.26", "o==2025.0", "p==8", "q"]


def test_a_row_without_what_it_needs_is_not_run_and_says_so() -> None:
    row = Row("some", "", needs=["/nowhere/at/all"])
    assert str(run_row(row, [])) == "some                  not run: needs /nowhere/at/all"


def test_lowest_versions_of_this_project_are_numbers() -> None:
    """No bound is written in another way, which would be taken for none."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = lowest_versions(project)
    assert all(re.fullmatch(r"[\w.-]+(==[\d.]+)?", line) for line in lines)
    assert [line for line in lines if "==" not in line] == ["pytest-timeout"]
