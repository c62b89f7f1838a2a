"""`make test` in one piece: what its last line says, and what the plugin tells of real runs of pytest."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from support import checks
from support.checks import Allowed, Skip, SkipList, check_tests, load_allowed, main, not_allowed

TESTS = {
    "test_well.py": """
import pytest

def test_passes(): pass

@pytest.mark.slow
def test_is_slow(): pass

def test_wants_a_part(): pytest.skip("a part")

def test_fails(): assert False

@pytest.fixture
def broken(): raise OSError("no")

def test_cannot_begin(broken): pass
""",
    "test_whole.py": "import pytest\npytest.importorskip('antigravity_none')\n\ndef test_never_seen(): pass\n",
    "test_damaged.py": "import antigravity_none\n",
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, text in TESTS.items():
        (tmp_path / name).write_text(text)
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = slow: takes long\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_what_pytest_found_is_told_by_name(folder: Path) -> None:
    """Also where a file cannot be imported, and where a fixture fails."""
    found = check_tests(["-q", "."], folder / "told.json")
    names = {"test_well.py::test_fails", "test_well.py::test_cannot_begin", "test_damaged.py"}
    assert (set(found.failures), found.passed) == (names, 2)
    assert found.skipped == ("test_whole.py", "test_well.py::test_wants_a_part")
    assert not (folder / "told.json").exists()


def test_the_rest_is_what_was_skipped_and_what_is_slow(folder: Path) -> None:
    (folder / "test_damaged.py").unlink()
    (folder / "skipped.txt").write_text("test_whole.py\ntest_well.py::test_wants_a_part\n")
    (folder / "antigravity_none.py").touch()  # the part is there now
    words = ["-p", "support.checks", "--only-rest=skipped.txt", "--tell=told.json", "-q", "-rA"]
    done = subprocess.run([sys.executable, "-m", "pytest", *words], capture_output=True, text=True, check=True)
    assert json.loads((folder / "told.json").read_text()) == {
        "failed": [],
        "skipped": ["test_well.py::test_wants_a_part"],
        "passed": 2,
        "missing": 0,
    }
    assert "PASSED test_whole.py::test_never_seen" in done.stdout and "PASSED test_well.py::test_is_slow" in done.stdout


ONE_WORKER = ("-p", "xdist", *checks.WORKERS, "--numprocesses", "1")


@pytest.mark.parametrize(
    ("workers", "end"),
    [((), "raise KeyboardInterrupt"), (ONE_WORKER, "raise KeyboardInterrupt"), (ONE_WORKER, "os._exit(3)")],
)
def test_tests_that_a_run_never_came_to_are_counted(tmp_path: Path, workers: tuple[str, ...], end: str) -> None:
    """The first fails, the second ends the run, two are left."""
    test = tmp_path / "test_ends.py"
    lines = ["def test_0(): assert False", f"def test_1(): {end}", "def test_2(): pass", "def test_3(): pass"]
    test.write_text("import os\n" + "\n".join(lines))
    found = check_tests([*workers, "-q", f"--rootdir={tmp_path}", str(test)], tmp_path / "told.json")
    names, left = found.failures[:-1], found.failures[-1]
    # the worker that died is its test's failure
    assert [name.rpartition("::")[2] for name in names] == ["test_0", "test_1"][: 2 if workers else 1]
    assert left == f"{2 if workers else 3} tests not run"


ASLEEP = """
import pathlib, time
def test_0(): pass
def test_1():
    pathlib.Path({begun!r}).touch()
    while True: time.sleep(0.01)
def test_2(): pass
"""
RUNNER = """
import sys
from pathlib import Path
from support import checks
checks.STYLE, checks.SKIPPED = (), Path({skipped!r})
checks.GROUPS = ({words!r}, ["--no-such-option"])
sys.exit(checks.main([]))
"""


def test_ctrl_c_ends_quietly_with_what_was_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first test passes, which the worker may not have told yet; the second never ends; the third is left.

    What follows is not begun, and nothing is kept of what was skipped.
    """
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    begun, skipped = tmp_path / "begun", tmp_path / "skipped.txt"
    (tmp_path / "test_asleep.py").write_text(ASLEEP.format(begun=str(begun)))
    words = [*ONE_WORKER, "-q", f"--rootdir={tmp_path}", str(tmp_path / "test_asleep.py")]
    code = RUNNER.format(skipped=str(skipped), words=words)
    runner = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    while not begun.exists():
        assert runner.poll() is None
        time.sleep(0.01)
    os.killpg(runner.pid, signal.SIGINT)
    out, err = runner.communicate()
    assert runner.returncode == 130
    line = r"interrupted; 1 failure \((\d) tests passed, 0 skipped, in \d+ min \d+ s\): (\d) tests not run"
    told = re.fullmatch(line, out.splitlines()[-1])
    assert told is not None
    assert tuple(map(int, told.groups())) in {(0, 3), (1, 2)}
    assert "Traceback" not in err
    assert not skipped.exists()


def test_a_run_of_pytest_that_tells_nothing_has_failed(folder: Path) -> None:
    assert check_tests(["--no-such-option"], folder / "told.json").failures == [
        "pytest --no-such-option (exit code 4, nothing told)"
    ]
    found = check_tests(["-q", "-k", "nothing_of_that_name", "test_well.py"], folder / "told.json")
    assert found.failures == ["pytest -q -k nothing_of_that_name test_well.py (exit code 5)"]


def test_every_check_runs_and_the_last_line_names_every_failure(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (folder / "test_damaged.py").unlink()
    style = [["python", "-c", "raise SystemExit(3)"], ["python", "-c", "print('well')"]]
    monkeypatch.setattr(checks, "STYLE", style)
    monkeypatch.setattr(checks, "GROUPS", (["-q", "-k", "fails"], ["-q", "-k", "passes or wants"]))
    monkeypatch.setattr(checks, "SKIPPED", folder / "skipped.txt")
    with pytest.raises(SystemExit, match="2"):
        main(["--rest"])  # nothing was run yet
    assert "run it first" in capfd.readouterr().err
    assert main([]) == 1
    lines = capfd.readouterr().out.splitlines()
    assert "well" in lines
    assert lines[-1].startswith("2 failures (1 tests passed, ")
    assert lines[-1].endswith(": python -c raise SystemExit(3); test_well.py::test_fails")
    assert "test_well.py::test_wants_a_part" in (folder / "skipped.txt").read_text().splitlines()
    monkeypatch.setattr(checks, "STYLE", style[1:])
    monkeypatch.setattr(checks, "GROUPS", (["-q", "-k", "passes"],))
    assert main([]) == 0
    assert capfd.readouterr().out.splitlines()[-1].startswith("no failures: 2 checks, 1 tests passed, ")


ROW = Allowed("tests/*::test_video*", "no codec *", "a codec")


@pytest.mark.parametrize(
    ("skip", "is_allowed"),
    [
        (Skip("tests/core/test_a.py::test_video_is_read", "no codec x264"), True),
        (Skip("tests/core/test_a.py::test_video_is_read", "could not import 'av'"), False),
        (Skip("tests/core/test_a.py::test_audio", "no codec x264"), False),
    ],
)
def test_both_the_test_and_its_reason_must_match(skip: Skip, is_allowed: bool) -> None:
    assert not_allowed([skip], [ROW]) == ([] if is_allowed else [skip])


class Report:
    """What pytest reports of one test."""

    def __init__(self, reason: str) -> None:
        self.skipped, self.nodeid, self.longrepr = True, "tests/a.py::test_a", ("a.py", 1, f"Skipped: {reason}")


class Session:
    exitstatus = 0


@pytest.mark.parametrize(("reason", "status"), [("hard to do", 1), ("no gpu", 0)])
def test_an_unknown_skip_fails_a_run_that_passed(reason: str, status: int) -> None:
    plugin, session = SkipList([Allowed("*", "no gpu", "a GPU")]), Session()
    plugin.pytest_runtest_logreport(Report(reason))
    plugin.pytest_sessionfinish(session, 0)
    assert plugin.skips == [Skip("tests/a.py::test_a", reason)]
    assert session.exitstatus == status


def test_every_row_of_the_list_says_why() -> None:
    assert all(row.why and row.reason and row.test.startswith("tests/") for row in load_allowed())
