"""The faults of `make mutants`: what is drawn, what it becomes, where it is put, how it is judged."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import pytest

from trilane.testing.mutants.draw import code_files, draw
from trilane.testing.mutants.fault import Fault, fault_between
from trilane.testing.mutants.reach import Reach, Reached, load_reach, measure_reach
from trilane.testing.mutants.results import Result, Unchanging, fails, table
from trilane.testing.mutants.text_faults import text_faults
from trilane.testing.mutants.tree_copy import TreeCopy

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
        ("scene/camera/tum.py", "scene/camera"),
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


def test_reach_follows_links_and_processes_and_notes_opened_tables(tmp_path: Path) -> None:
    """A folder behind a link: lines 1 and 4 are met when it is imported, 2 by a test, 5 by a process of it."""
    pytest.importorskip("coverage")
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


def test_a_fault_on_the_list_is_known_by_its_lines() -> None:
    row = Unchanging("a.py", "x = 1", "x = 2", "nobody reads x")
    assert row.is_it(Fault("a.py", 90, "Number", "    x = 1\n", "    x = 2\n"))
    assert not row.is_it(Fault("a.py", 90, "Number", "    x = 1\n", "    x = 3\n"))
