"""The frame of the command line: what help, errors, `--debug` and the end of the process say, word by word."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import trilane
from trilane.apps.cli import main as cli
from trilane.errors import BadInputError, MissingPartError, TrilaneError

Command = Callable[..., tuple[str, str]]
DEFECT = "this is a defect of Trilane, --debug shows where"


def fail_with(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    def fail() -> None:
        raise error

    monkeypatch.setattr("trilane.stages.machine_facts.gl_facts", fail)


ERRORS = {
    "a failed run": (TrilaneError("it [b]failed"), 1, "it [b]failed"),
    "bad input": (BadInputError("f.npy", "a", "b", "do c"), 2, "f.npy: found a, expected b; do c"),
    "a missing part": (MissingPartError("no engine", "make it"), 3, "no engine; install it with: make it"),
    "a missing package": (
        ModuleNotFoundError("x", name="engine"),
        3,
        "the Python package engine is missing; install it with: the line",
    ),
    "a file": (PermissionError(13, "Permission denied", "/a/file"), 1, "/a/file: permission denied"),
    "the system": (OSError(28, "No space left on device"), 1, "the system: no space left on device"),
    "a defect": (KeyError("k"), 1, f"KeyError: 'k'; {DEFECT}"),
}


@pytest.mark.parametrize("case", ERRORS)
def test_an_error_is_one_sentence(case: str, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    error, code, said = ERRORS[case]
    monkeypatch.setattr(cli, "install_line", lambda: "the line")
    fail_with(monkeypatch, error)
    assert command("doctor", code=code) == ("", f"error: {said}\n")
    monkeypatch.setattr("sys.argv", ["trilane", "doctor", "--debug"])
    with pytest.raises(type(error)):
        cli.main()


def test_an_interrupt_is_130(monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    fail_with(monkeypatch, KeyboardInterrupt())
    assert "Traceback" not in command("doctor", code=130)[1]


def test_help_without_words_and_with_either_spelling(command: Command) -> None:
    (long, _), (short, _) = command("--help"), command("-h")
    assert long == short
    out, err = command(code=2)
    assert (out + err).strip() == long.strip()
    assert "\n    0 done, 1 the run failed, 2 wrong usage or bad input,\n" in long
    for name, group in (("body", "vertices"), ("avatar", "inspect"), ("profiles", "check"), ("bench", "scheduler")):
        out, err = command(name, code=2)
        assert f"Usage: trilane {name} [OPTIONS] COMMAND" in out + err and f"  {group}" in out + err


def test_a_command_that_is_none_and_an_option_that_is_none(command: Command) -> None:
    out, err = command("fly", code=2)
    assert (out, "No such command 'fly'" in err) == ("", True)
    out, err = command("doctor", "--fly", code=2)
    assert (out, "Usage: trilane doctor" in err, "No such option: --fly" in err) == ("", True, True)


WRONG_VALUES = {
    ("--policy", "fly"): "--policy: found 'fly', expected one of sequential, pipelined, latest, deadline",
    ("--frames", "x"): "--frames: found 'x', expected a whole number",
}


@pytest.mark.parametrize("words", WRONG_VALUES, ids=" ".join)
def test_a_value_that_is_none(words: tuple[str, ...], command: Command) -> None:
    out, err = command("run", *words, code=2)
    assert (out, WRONG_VALUES[words] in err) == ("", True)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("rnu",), "No such command 'rnu'. Did you mean 'run'?"),
        (("bench", "schedular"), "No such command 'schedular'. Did you mean 'scheduler'?"),
        (("avatar", "inspekt"), "No such command 'inspekt'. Did you mean 'inspect'?"),
        (("doctor", "--jsn"), "No such option: --jsn (Possible options: --json)"),
    ],
)
def test_a_mistyped_word_is_answered_with_the_nearest(words: tuple[str, ...], said: str, command: Command) -> None:
    assert said in command(*words, code=2)[1]


def test_the_version_is_all_that_is_printed(command: Command) -> None:
    assert command("--version", "doctor") == (f"trilane {trilane.__version__}\n", "")


@pytest.mark.parametrize(
    ("left", "code"), [("SystemExit(3)", 3), ("SystemExit('text')", 0), ("KeyboardInterrupt", 130)]
)
def test_the_process_ends_with_its_code_and_what_it_printed(left: str, code: int) -> None:
    script = f"""
from trilane.apps.cli import main as cli
def main():
    print("x", end="")
    raise {left}
cli.main = main
cli.entry()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (code, "x", "interrupted\n" * (code == 130))


@pytest.mark.parametrize("writes", ["print('x', flush=True)", "print('x')"], ids=["at once", "at the end"])
def test_a_stdout_that_takes_no_more_is_named(writes: str) -> None:
    script = (
        "import sys; from trilane.apps.cli import main as cli; "
        f"cli.app = lambda **_: ({writes}, sys.exit(0)); cli.entry()"
    )
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([sys.executable, "-c", script], stdout=full, stderr=subprocess.PIPE, text=True)
    said = "error: stdout: no space left on device; free space there, or write the output elsewhere\n"
    assert (done.returncode, done.stderr) == (1, said)
