"""Entry point of the `trilane` command: the table of commands, the global options and the exit codes.

Rule: `COMMANDS` names the module of each command. The module has a Typer `app` and is imported when the command is
called. No slow module is imported earlier. An error becomes a message on stderr and an exit code. A traceback is shown
only with `--debug`.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import io
import os
import sys
from collections.abc import Callable, Mapping
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup

from trilane.apps.old_names import in_new_names
from trilane.errors import TrilaneError, install_line, reason
from trilane.machine import require_memory, shortage
from trilane.signals import INTERRUPTED, interrupting

#: Command -> its module, and its line in `trilane --help`.
COMMANDS = {
    "run": ("trilane.apps.cli.run", "Run a scene on the three units and write a run folder."),
    "predict": ("trilane.apps.cli.predict", "Predict frame time, idleness, heat and energy on a chip."),
    "plan": ("trilane.apps.cli.explain", "Say what a scene models, what it leaves out, and the work this saves."),
    "explain": ("trilane.apps.cli.explain", "Say where the time of a run went."),
    "show": ("trilane.apps.cli.watch", "Show a finished run in a browser."),
    "watch": ("trilane.apps.cli.watch", "Show the live figures of a run in a terminal."),
    "trace": ("trilane.apps.cli.watch", "Write the timeline of a run for Perfetto or Chrome."),
    "compare": ("trilane.apps.cli.compare", "Say what differs between runs, by how much and why."),
    "report": ("trilane.apps.cli.compare", "Write one page of many runs, with frame times and image errors."),
    "sweep": ("trilane.apps.cli.sweep", "Try many configurations of a command, on one machine or many."),
    "tune": ("trilane.apps.cli.tune", "Find the fastest configuration within given limits, in few trials."),
    "quality": ("trilane.apps.cli.quality", "Compare runtimes on a scene, and with float on hard cases."),
    "inspect": ("trilane.apps.cli.inspect", "Say what a file is, and what to do if it is not usable."),
    "init": ("trilane.apps.cli.check", "Write a first pipeline file that runs networks on a video."),
    "check": ("trilane.apps.cli.check", "Check a pipeline file: its graph, least period and memory."),
    "times": ("trilane.apps.cli.inspect", "Read what other tools measured: runs, layers, traces."),
    "avatar": ("trilane.apps.cli.avatar", "Look into avatars, export and quantise their networks."),
    "body": ("trilane.apps.cli.body", "Look into body files, pose them, build one."),
    "profiles": ("trilane.apps.cli.profiles", "List, show, check and fit the hardware profiles."),
    "bench": ("trilane.apps.cli.bench", "Measure this machine: raster, readback, crop and more."),
    "doctor": ("trilane.apps.cli.doctor", "Say what this machine has, what is missing and how to install it."),
}

FAILED, MISSING_PART = 1, 3  # Typer itself exits with 2 for wrong usage, and with INTERRUPTED if interrupted

#: Exceptions that libraries raise if they get no memory or no thread. They can have other causes.
OF_MEMORY = (MemoryError, ImportError, RuntimeError)

EPILOG = """\b
Examples:
  trilane run
  trilane run --motion walk.bvh --camera arkit.txt --frames 200 --json
  trilane doctor

\b
Exit codes:
  0 done, 1 the run failed, 2 wrong usage or bad input,
  3 something is not installed, 4 it cannot be told (compare --fail-if),
  130 interrupted
"""


def command_of(name: str) -> Any:
    """Import the module of command `name`, and return the command or the group of commands.

    The module's `app` is the command itself, or has it among its commands. Raises TrilaneError if memory is too short.
    """
    require_memory(part=2)  # with less, NumPy's import or the kernel would end the process
    command = typer.main.get_command(importlib.import_module(COMMANDS[name][0]).app)
    command = getattr(command, "commands", {}).get(name, command)
    command.name = name
    return command


def lazy_group(lines: Mapping[str, str], command_of: Callable[[str], Any]) -> type[TyperGroup]:
    """Return the class of a group whose commands are imported when they are called.

    For a mistyped name, the group suggests similar names. `lines`: line in `--help` of each command, by the command's
    name. `command_of`: function that takes a command's name, imports the command and returns it.
    """

    class LazyGroup(TyperGroup):
        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            # Placeholders without options are enough for `--help`, completion and suggestions.
            self.commands = {name: TyperCommand(name, help=line) for name, line in lines.items()}

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            name, stand_in, rest = super().resolve_command(ctx, args)
            return name, None if name is None or stand_in is None else command_of(name), rest

    return LazyGroup


app = typer.Typer(
    name="trilane",
    cls=lazy_group({name: line for name, (_, line) in COMMANDS.items()}, command_of),
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    epilog=EPILOG,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from trilane import __version__

        print(f"trilane {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error; may stand anywhere.")] = False,
) -> None:
    """Run, measure and predict a real-time neural-avatar pipeline on CPU, GPU and DSP units."""


def _fail(message: str, code: int, details: tuple[str, ...] = ()) -> NoReturn:
    from rich.text import Text

    from trilane.apps.cli.console import stderr_console, without_controls

    lines = "\n".join(map(without_controls, (message, *details)))
    stderr_console().print(Text.assemble(("error: ", "bold red"), lines), soft_wrap=True)
    raise SystemExit(code)


def describe(error: Exception) -> tuple[str, int]:
    """Return the sentence to print about an `error` that no command handled, and the exit code of the process."""
    if isinstance(error, TrilaneError):
        return str(error), error.exit_code
    if isinstance(error, ModuleNotFoundError):
        return f"the Python package {error.name} is missing; install it with: {install_line()}", MISSING_PART
    if isinstance(error, OF_MEMORY) and (short := shortage()):
        return f"memory is short: {short}; {type(error).__name__}: {error}", FAILED
    if isinstance(error, MemoryError):
        return f"memory is short: {error or 'nothing says how much was wanted'}", FAILED
    if isinstance(error, OSError) and not error.filename and _is_of_stdout(error):
        return f"stdout: {reason(error)}; free space there, or write the output elsewhere", FAILED
    if isinstance(error, FileNotFoundError) and not error.filename and not _has_working_directory():
        return "the working directory was removed; change to another one", FAILED
    if isinstance(error, OSError):
        return f"{error.filename or 'the system'}: {reason(error)}", FAILED
    return f"{type(error).__name__}: {error}; this is a defect of Trilane, --debug shows where", FAILED


def _has_working_directory() -> bool:
    try:
        os.getcwd()  # noqa: PTH109 - this is what fails
    except FileNotFoundError:
        return False
    return True


def _is_of_stdout(error: OSError) -> bool:
    """Return whether a failed write to stdout caused `error`: a full disk, a full quota or an I/O error.

    The function writes one more byte to stdout. If this write fails with the same error number, stdout is the cause.
    """
    if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EIO):
        return False
    try:
        os.write(sys.stdout.fileno(), b"\n")
    except (OSError, ValueError) as again:  # ValueError: stdout has no file descriptor, so it is no file
        return getattr(again, "errno", None) == error.errno
    return False


def _call(arguments: list[str]) -> None:
    """Run the command line `arguments`, and flush stdout when the command ends. Ends with the command's SystemExit.

    Raises OSError if the flush fails, such as on a full disk. A pipe that its reader has closed is no error.
    """
    try:
        app(args=arguments, prog_name="trilane")
    except SystemExit:
        with contextlib.suppress(BrokenPipeError, ValueError):
            sys.stdout.flush()
        raise


def _in_new_names(arguments: list[str]) -> list[str]:
    """Return `arguments` with each old name of a command or option replaced by its new name.

    Prints a note on stderr for each old name. `arguments`: words of the command line after `trilane`.
    """
    notes: dict[str, None] = {}
    words = in_new_names(arguments, notes.setdefault)
    if notes:
        from trilane.apps.cli.console import note

        for text in notes:
            note(text)
    return words


def main() -> None:
    """Run the command line of `sys.argv`. Ends with SystemExit and one of the exit codes in `EPILOG`.

    With `--debug`, an error of the command is raised instead, so that Python prints its traceback.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # characters that the locale's encoding lacks become question marks
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    debug = len(arguments) < len(sys.argv) - 1
    try:
        _call(_in_new_names(arguments))
    except Exception as error:
        if debug:
            raise
        _fail(*describe(error), error.details if isinstance(error, TrilaneError) else ())


def entry() -> NoReturn:
    """Call `main`, and end the process without Python's clean-up, which would take 0.1 s."""
    code: object = 0
    try:
        with interrupting():
            main()
    except SystemExit as left:
        code = left.code
    except KeyboardInterrupt as interrupt:
        if not interrupt.args:  # otherwise a message about the interrupt was already printed
            os.write(2, b"interrupted\n")
        code = INTERRUPTED
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # the reader may have closed the stream
            stream.flush()
    os._exit(code if isinstance(code, int) else 0)


if __name__ == "__main__":
    entry()
