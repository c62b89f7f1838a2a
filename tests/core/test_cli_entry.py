"""The frame of the command line: what help, errors, `--debug` and the end of the process say, word by word."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer

import trilane
from trilane.apps.cli import main as cli
from trilane.apps.cli.commands import Commands, OnceCommand
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


def test_the_word_error_alone_is_red(monkeypatch: pytest.MonkeyPatch) -> None:
    from rich.console import Console

    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, color_system="standard", width=20)
    monkeypatch.setattr("trilane.apps.cli.console.stderr_console", lambda: console)
    with pytest.raises(SystemExit) as left:
        cli._fail("a sentence that is longer than the screen", 7)
    assert left.value.code == 7
    assert screen.getvalue() == "\x1b[1;31merror: \x1b[0ma sentence that is longer than the screen\n"


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
    group: Any = typer.main.get_command(cli.app)
    context = typer.Context(group)
    assert group.list_commands(context) == list(cli.COMMANDS)
    assert group.get_command(context, "fly") is None
    for name, (_, line) in cli.COMMANDS.items():
        assert (group.get_command(context, name).name, group.get_command(context, name).help) == (name, line)


def test_the_version_is_all_that_is_printed(command: Command) -> None:
    assert command("--version", "doctor") == (f"trilane {trilane.__version__}\n", "")


def test_markup_and_shells_leave_a_command_alone() -> None:
    app = Commands(help="what it is")
    assert (app.rich_markup_mode, app._add_completion) == (None, False)

    @app.command("named", epilog="an end")
    def function() -> None:
        """What it does."""

    (info,) = app.registered_commands
    assert (info.name, info.cls, info.epilog) == ("named", OnceCommand, "an end")
    assert cli.app.rich_markup_mode is None
    assert cli.app.pretty_exceptions_enable is False


class Stream(io.StringIO):
    def __init__(self, error: Exception | None = None) -> None:
        super().__init__()
        self.flushed, self._error = 0, error

    def flush(self) -> None:
        self.flushed += 1
        if self._error is not None:
            raise self._error


@pytest.mark.parametrize(
    ("left", "code"),
    [
        (None, 0),
        (SystemExit(3), 3),
        (SystemExit(None), 0),
        (SystemExit("text"), 0),
        (KeyboardInterrupt(), 130),
    ],
)
@pytest.mark.parametrize("error", [None, BrokenPipeError(), ValueError("closed")])
def test_the_process_ends_at_once_with_its_code(
    left: BaseException | None, code: int, error: Exception | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both streams are flushed first, though one of them cannot be."""
    out, err = Stream(error), Stream()
    ends: list[int] = []

    def main() -> None:
        if left is not None:
            raise left

    monkeypatch.setattr(cli, "main", main)
    monkeypatch.setattr(cli, "sys", SimpleNamespace(stdout=out, stderr=err))
    monkeypatch.setattr(os, "_exit", ends.append)
    cli.entry()
    assert (ends, out.flushed, err.flushed) == ([code], 1, 1)


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
