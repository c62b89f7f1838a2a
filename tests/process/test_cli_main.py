"""The command line's frame: help, version, exit codes, where things are printed."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from trilane.apps.cli import doctor
from trilane.apps.cli import main as cli
from trilane.errors import MissingPartError

HEAVY = ("numpy", "pydantic", "onnxruntime", "moderngl", "av", "rich.table")


def run_trilane(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "trilane.apps.cli.main", *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **environment},
    )


def run_here(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["trilane", *arguments])
    with pytest.raises(SystemExit) as left:
        cli.main()
    return int(left.value.code or 0)


def test_help_names_every_command_and_the_exit_codes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_here(monkeypatch, "--help") == 0
    text = capsys.readouterr().out
    for word in (*cli.COMMANDS, "Examples:", "Exit codes:", "130 interrupted"):
        assert word in text


def test_help_imports_nothing_heavy() -> None:
    probe = f"""
import sys
from trilane.apps.cli.main import main
sys.argv = ["trilane", "--help"]
try:
    main()
except SystemExit:
    print([name for name in {HEAVY} if name in sys.modules], file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=False)
    assert done.stderr == "[]\n"


WRONG_USAGE = {
    ("fly",): "Error: No such command 'fly'.",
    ("run", "--fly"): "Error: No such option: --fly",
    ("run", "--policy", "fly"): "error: --policy: found 'fly', expected one of sequential, pipelined, latest, deadline",
    ("run", "--frames", "x"): "error: --frames: found 'x', expected a whole number",
}


@pytest.mark.parametrize("arguments", WRONG_USAGE, ids=" ".join)
def test_wrong_usage_is_2_and_said_on_stderr(
    arguments: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_here(monkeypatch, *arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert WRONG_USAGE[arguments] in err


def test_debug_shows_the_traceback_wherever_it_stands() -> None:
    for arguments in (["--debug", "run", "nowhere"], ["run", "nowhere", "--debug"]):
        done = run_trilane(*arguments)
        assert "Traceback" in done.stderr
        assert "BadInputError" in done.stderr


def raise_from_doctor(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    def fail() -> None:
        raise error

    monkeypatch.setattr("trilane.stages.machine_facts.gl_facts", fail)


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (MissingPartError("no engine", "apt-get install engine"), 3, "install it with: apt-get install engine"),
        (ModuleNotFoundError("no", name="engine"), 3, "the Python package engine is missing"),
        (OSError(28, "No space left on device", "/a/file"), 1, "/a/file: no space left on device"),
        (ZeroDivisionError("by zero"), 1, "ZeroDivisionError: by zero; this is a defect"),
    ],
)
def test_an_error_is_one_line_and_its_exit_code(
    error: BaseException, code: int, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    raise_from_doctor(monkeypatch, error)
    assert run_here(monkeypatch, "doctor", "--json") == code
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err
    assert len(err.splitlines()) == 1


def test_an_interrupt_is_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    raise_from_doctor(monkeypatch, KeyboardInterrupt())
    assert run_here(monkeypatch, "doctor") == 130
    assert "Traceback" not in capsys.readouterr().err


def test_doctor_prints_one_document_and_says_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("trilane.stages.machine_facts.gl_facts", lambda: None)
    assert run_here(monkeypatch, "doctor", "--json") == 3
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert err == ""
    assert not document["complete"]
    broken = {check["name"]: check for check in document["checks"] if check["needed"] and not check["works"]}
    assert list(broken) == ["EGL and OpenGL"]
    assert "libegl1" in broken["EGL and OpenGL"]["install"]
    assert document["machine"]["cpu"]["cores"] >= 1


def test_doctor_prints_a_table_without_colour_when_asked() -> None:
    done = run_trilane("doctor", NO_COLOR="1")
    assert done.returncode in (0, doctor.MISSING)
    assert "EGL and OpenGL" in done.stdout
    assert "\x1b[" not in done.stdout


def test_what_the_encoding_of_stdout_lacks_is_a_question_mark() -> None:
    """And so it is in a locale without one."""
    words = ("profiles", "show", "snapdragon-888")
    done, by_locale = run_trilane(*words, PYTHONIOENCODING="ascii"), run_trilane(*words)
    assert (done.returncode, done.stderr, by_locale.returncode, by_locale.stderr) == (0, "", 0, "")
    assert "| value    | ? % | kind" in done.stdout


def test_completion_knows_the_commands_and_their_options() -> None:
    found = {}
    for words, place in (("trilane ru", "1"), ("trilane run --pol", "2")):
        done = run_trilane(_TRILANE_COMPLETE="complete_bash", COMP_WORDS=words, COMP_CWORD=place)
        found[words] = done.stdout.split()
    assert found == {"trilane ru": ["run"], "trilane run --pol": ["--policy"]}
