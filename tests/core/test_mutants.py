"""The faults of `make mutants`: what is drawn, what it becomes, where it is put, how it is judged."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import pytest

from trilane.testing.mutants.control import Controls
from trilane.testing.mutants.draw import code_files, draw
from trilane.testing.mutants.fault import Fault, fault_between
from trilane.testing.mutants.reach import Reach, Reached, load_reach, measure_reach
from trilane.testing.mutants.results import Result, Unchanging, controls_table, fails, table
from trilane.testing.mutants.text_faults import text_faults
from trilane.testing.mutants.tree_copy import TreeCopy
from trilane.testing.mutants.trial import Trial, noticed

SHADER = """\
// clamp(x, 0.0, 255.0)
uniform float scale;
void main() {
  float q = floor(value.xy / scale) + 0.5;
  q = clamp(q, 0.0, 255.0);
}
"""
SOURCE = """\
def area(width: int, height: int) -> int:
    if width < 0:
        raise ValueError
    return width * height
"""


def results_of(text: str, suffix: str) -> set[str]:
    """What the changed line becomes, for every fault."""
    return {fault_between("f", edit.kind, text, edit.make()).after for edit in text_faults(text, suffix)}


def test_shader_faults_are_those_of_the_table_and_leave_comments_alone() -> None:
    assert results_of(SHADER, ".frag") == {
        "float q = round(value.xy / scale) + 0.5;",
        "float q = ceil(value.xy / scale) + 0.5;",
        "float q = floor(value.yx / scale) + 0.5;",
        "float q = floor(value.xy * scale) + 0.5;",
        "float q = floor(value.xy / scale) - 0.5;",
        "float q = floor(value.xy / scale) + 0.6;",
        "q = clamp(q, 0.1, 255.0);",
        "q = clamp(q, 0.0, 255.1);",
        "q = clamp(0.0, q, 255.0);",
        ";",
    }


def test_table_faults_change_numbers_and_rows_but_no_text() -> None:
    table_text = 'a = 2\n# b = 3\nname = "x 3"\nrate = 8e3\n'
    assert results_of(table_text, ".toml") == {"a = 3", "rate = 10000.0", "", "a = 2 # b = 3 rate = 8e3"} - {
        "a = 2 # b = 3 rate = 8e3"
    }


def test_what_may_stand_in_any_order_is_not_exchanged() -> None:
    pytest.importorskip("cosmic_ray")
    from trilane.testing.mutants.python_faults import python_faults

    source = "try:\n    a = max(b, c) in (d, e)\nexcept (F, G):\n    h = min(p(q, r), s), np.hypot(t, u)\n"
    made = [edit.make() for edit in python_faults(source) if edit.kind.endswith("Exchanged")]
    assert made == [
        source.replace("min(p(q, r), s), np.hypot(t, u)", "np.hypot(t, u), min(p(q, r), s)"),
        source.replace("(q, r)", "(r, q)"),
    ]


def test_a_fault_is_put_where_it_was_drawn() -> None:
    """Of two places with the same line the one nearest to the fault's; lines added above move it along."""
    text = "a = 1\nb = 0\n\n\na = 1\nc = 0\n"
    fault = fault_between("f.py", "Number", text, "a = 1\nb = 0\n\n\na = 2\nc = 0\n")
    assert fault == Fault("f.py", 5, "Number", "a = 1\n", "a = 2\n")
    assert fault.put_into("# new\n" + text) == "# new\na = 1\nb = 0\n\n\na = 2\nc = 0\n"
    assert fault.still_fits(text) and not fault.still_fits("b = 0\n") and not fault.still_fits("aa = 1\n")
    with pytest.raises(ValueError, match="no longer"):
        fault.put_into("b = 0\n")


@pytest.mark.parametrize(
    ("path", "folder"),
    [
        ("scheduler/core.py", "scheduler"),
        ("stages/gpu/raster.py", "stages/gpu"),
        ("stages/config.py", "stages"),
        ("scene/camera/trajectories.py", "scene/camera"),
        ("apps/cli/run.py", "apps"),
        ("src/trilane/units.py", "trilane"),
    ],
)
def test_faults_are_counted_by_folder(path: str, folder: str) -> None:
    assert Fault(path, 1, "", "", "").folder == folder


def test_only_the_projects_code_is_drawn_from() -> None:
    tracked = ["scheduler/core.py", "tests/core/test_x.py", "docs/a.md", "shaders/a.frag", "hw_profiles/b.toml"]
    others = ["src/trilane/testing/doubles.py", "pyproject.toml", ".ci/run", "src/trilane/units.py"]
    assert code_files(tracked + others) == [
        "scheduler/core.py",
        "shaders/a.frag",
        "hw_profiles/b.toml",
        "src/trilane/units.py",
    ]


def test_a_seed_draws_the_same_faults_and_each_once(tmp_path: Path) -> None:
    pytest.importorskip("cosmic_ray")
    (tmp_path / "a.py").write_text(SOURCE)
    first, again = (list(islice(draw(tmp_path, ["a.py"], 3), 20)) for _ in range(2))
    assert first == again
    assert len(set(first)) == len(first) == 20
    changed = {fault.after for fault in first}
    assert {"pass", "return height * height"} & changed
    assert not any("int" in fault.after and "->" in fault.after for fault in first)


def test_quick_tests_that_reach_the_line_come_first() -> None:
    """A changed source is looked up by file; a table, which has no lines, too."""
    reach = Reach(
        {
            "slow": Reached("", 9.0, {"a.py": [4]}),
            "quick": Reached("", 1.0, {"a.py": [4, 5], "t.toml": []}),
            "elsewhere": Reached("", 0.5, {"a.py": [9]}),
        },
        {"a.py": "same"},
    )
    at_4 = Fault("a.py", 4, "", "x\n", "")
    assert reach.tests_of(at_4, "same") == ["quick", "slow"]
    assert reach.tests_of(at_4, "other") == ["elsewhere", "quick", "slow"]
    assert reach.tests_of(Fault("a.py", 3, "", "x\ny\n", ""), "same") == ["quick", "slow"]
    assert reach.tests_of(Fault("t.toml", 7, "", "x\n", ""), "") == ["quick"]


def test_the_start_of_the_tests_counts_once() -> None:
    """Starts take 1 s: a and b take 1 + 1 + 3 s, c would make it 9."""
    reach = Reach({name: Reached("", s, {}) for name, s in {"a": 2.0, "b": 4.0, "c": 5.0, "d": 1.0}.items()}, {})
    assert reach.within(["a", "b", "c"], 8.0) == (["a", "b"], 5.0)
    assert reach.within(["a", "b", "c"], 9.0) == (["a", "b", "c"], 9.0)
    assert reach.within(["c", "a"], 0.5) == (["c"], 5.0)
    assert reach.within([], 8.0) == ([], 1.0)


TEST_OF_BOTH = """\
import subprocess, sys
from trilane.folder.double import double
def test_double():
    assert double(2) == 4
def test_in_a_process():
    subprocess.run([sys.executable, "-c", "from trilane.folder.double import half; half(4)"], check=True)
    open("folder/numbers.toml").close()
"""


def test_reach_follows_links_and_processes_and_notes_opened_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder behind a link: lines 1 and 4 are met when it is imported, 2 by a test, 5 by a process of it.

    The tests in it need none of pytest's plugins but the one whose limit they are given.
    """
    pytest.importorskip("coverage")
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.setenv("PYTEST_PLUGINS", "pytest_timeout")
    root = tmp_path / "tree"
    (root / "src" / "trilane").mkdir(parents=True)
    (root / "src" / "trilane" / "__init__.py").touch()
    (root / "folder").mkdir()
    (root / "src" / "trilane" / "folder").symlink_to("../../folder")
    source = "def double(x):\n    return 2 * x\n\ndef half(x):\n    return x / 2\n"
    (root / "folder" / "double.py").write_text(source)
    (root / "folder" / "numbers.toml").write_text("a = 1\n")
    (root / "test_both.py").write_text(TEST_OF_BOTH)
    (root / "test_broken.py").write_text("def test_broken():\n    assert False\n")
    said: list[str] = []
    tests = ["test_both.py", "test_broken.py"]
    reach = measure_reach([TreeCopy(root)], tests, ["folder/double.py"], tmp_path / "reach.json", said.append)
    assert list(reach.tests) == ["test_both.py"]
    assert said[-1].endswith("fails without a fault: test_broken.py")
    lines = reach.tests["test_both.py"].lines
    assert lines["folder/double.py"] == [1, 2, 4, 5]
    assert lines["folder/numbers.toml"] == []
    assert load_reach(tmp_path / "reach.json").tests == reach.tests


def test_the_verdict_counts_each_folder_and_all() -> None:
    """scheduler 8 of 10 (enough), body 3 of 5 (too few), shaders 1 of 4 (too few to judge): 12 of 19 in all."""
    counts = {"scheduler": (8, 10), "body": (3, 5), "shaders": (1, 4)}
    rows = [
        Result(Fault(f"{folder}/a.py", 1, "", "", ""), "a test" if n < noticed else "", 1.0, 1, 1)
        for folder, (noticed, tried) in counts.items()
        for n in range(tried)
    ]
    assert fails(rows) == ["body", "in all"]
    assert [line.split() for line in table(rows)][-1] == ["in", "all", "12", "of", "19", "63.2%"]
    assert fails(rows[:8]) == []


def test_an_untried_fault_is_named_and_a_limit_of_time_is_counted() -> None:
    """Three trials: one noticed by a limit that its control kept, one whose control failed, one that survived."""
    fault = Fault("body/a.py", 3, "Number", "x = 1\n", "x = 2\n")
    rows = [
        Result(fault, "tests/process/test_a.py::test_b", 9.0, 2, 2, by_time=True, control="passed"),
        Result(fault, "tests/process/test_a.py::test_b", 9.0, 2, 2, by_time=True, control="failed"),
        Result(fault, "", 1.0, 2, 2),
    ]
    assert [row.counts for row in rows] == [True, False, True]
    assert controls_table(rows) == [
        "Noticed by a limit of time: 1. Controls without the fault: 1 passed, 1 failed.",
        "  not tried  body/a.py:3 [Number] x = 1  ->  x = 2: tests/process/test_a.py::test_b fails without it too",
    ]


@pytest.mark.parametrize(
    ("code", "output", "found"),
    [
        (0, "3 passed", ("", False)),
        (5, "no tests ran", ("", False)),
        (1, "F\nFAILED tests/a.py::test_b - assert 1 == 2\n", ("tests/a.py::test_b", False)),
        (1, "FAILED tests/a.py::test_b - Failed: Timeout (>60.0s) from pytest-timeout.", ("tests/a.py::test_b", True)),
        (1, "FAILED tests/a.py::test_timeout - TypeError: x", ("tests/a.py::test_timeout", False)),
        (1, "FAILED tests/a.py::test_b - subprocess.TimeoutExpired: Command", ("tests/a.py::test_b", True)),
        (2, "ERROR tests/a.py - NameError: name 'x'", ("tests/a.py", False)),
        (-11, "", ("pytest ended with -11", False)),
        (1, "+++++ Timeout +++++", ("pytest ended with 1", True)),
    ],
)
def test_how_a_trial_ended_is_read_from_what_pytest_says(code: int, output: str, found: tuple[str, bool]) -> None:
    assert noticed(code, output) == found


#: A fault, and the tests that reach it.
WRONG = Fault("a.py", 1, "Number", "x = 1\n", "x = 2\n")
FILES = ("tests/core/test_a.py", "tests/process/test_b.py", "tests/process/test_c.py")


class Script:
    """Runs no tests: says `ends` in turn, and notes whether the fault was there and which files were to run."""

    def __init__(self, *ends: str) -> None:
        self.ends = list(ends)
        self.seen: list[tuple[bool, int]] = []

    def __call__(self, tree: TreeCopy, files: Sequence[str], usual_s: float) -> Trial:
        assert usual_s == 7.0
        self.seen.append(((tree.root / "a.py").read_text() == "x = 2\n", len(files)))
        end = self.ends.pop(0)
        return Trial(end.removesuffix(" late"), end.endswith(" late"), 1.0)


A, B = f"{FILES[0]}::test_x", f"{FILES[1]}::test_y"


@pytest.mark.parametrize(
    ("ends", "answer", "control", "seen"),
    [
        pytest.param([""], "", "", [(True, 3)], id="a survivor needs no control"),
        pytest.param([A, ""], A, "passed", [(True, 3), (False, 1)], id="as far as the file that noticed"),
        pytest.param([B, ""], B, "passed", [(True, 3), (False, 2)], id="a process test"),
        pytest.param(["the end late", ""], "the end", "passed", [(True, 3), (False, 3)], id="the tests did not end"),
        pytest.param([B, B, ""], "", "", [(True, 3), (False, 2), (True, 3)], id="survives"),
        pytest.param([B, B, A, ""], A, "passed", [(True, 3), (False, 2), (True, 3), (False, 1)], id="repeated"),
        pytest.param([B, A, B, B], B, "failed", [(True, 3), (False, 2)] * 2, id="never without the fault either"),
    ],
)
def test_what_fails_without_the_fault_is_not_noticed(
    ends: list[str], answer: str, control: str, seen: list[tuple[bool, int]], tmp_path: Path
) -> None:
    (tmp_path / "tree").mkdir()
    (tmp_path / "tree" / "a.py").write_text("x = 1\n")
    script = Script(*ends)
    trial, came = Controls(script).tried(WRONG, TreeCopy(tmp_path / "tree"), FILES, 7.0)
    assert (trial.noticed_by, came) == (answer, control)
    assert script.seen == seen and script.ends == []


def test_a_control_holds_for_a_test_that_feels_no_load_until_a_limit_of_time_ends_it(tmp_path: Path) -> None:
    """The first of two trials has one; the third, which a limit ended, has its own; one of processes always has."""
    (tmp_path / "tree").mkdir()
    (tmp_path / "tree" / "a.py").write_text("x = 1\n")
    tree, script = TreeCopy(tmp_path / "tree"), Script(A, "", A, f"{A} late", "", B, "", B, "")
    controls = Controls(script)
    assert [controls.tried(WRONG, tree, FILES, 7.0)[1] for _ in range(5)] == [
        "passed",
        "",
        "passed",
        "passed",
        "passed",
    ]
    assert script.ends == []


def test_a_fault_on_the_list_is_known_by_its_lines() -> None:
    row = Unchanging("a.py", "x = 1", "x = 2", "nobody reads x")
    assert row.is_it(Fault("a.py", 90, "Number", "    x = 1\n", "    x = 2\n"))
    assert not row.is_it(Fault("a.py", 90, "Number", "    x = 1\n", "    x = 3\n"))
