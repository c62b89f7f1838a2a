"""`trilane top`: the figures of a run while it goes on, or as it ended.

Rule: this module reads options and shows looks; they come from `trilane.apps.live.run_looks`.
"""

from __future__ import annotations

import json as json_text
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trilane.apps.cli.commands import Commands
from trilane.apps.cli.console import print_json, spinner, stdout_console
from trilane.errors import BadInputError, MissingPartError

if TYPE_CHECKING:
    from trilane.apps.live.run_looks import Look

app = Commands()

EPILOG = """\b
Examples:
  trilane top
  trilane top runs/walk
  trilane top walk --wait
  trilane top --json --interval 5 >> figures.jsonl
  trilane top runs/walk --once --json
  trilane top runs/walk --openmetrics
"""
RunArgument = Annotated[
    Path | None,
    typer.Argument(help="Run folder, its journal, or its name below runs/; the newest below runs/ if none is given."),
]
OnceOption = Annotated[bool, typer.Option("--once", help="Look once, whether the run goes on or not.")]
LooksOption = Annotated[
    bool, typer.Option("--json", help="Print a JSON document in a line for each look; with --once, one document.")
]
OpenMetricsOption = Annotated[
    bool, typer.Option("--openmetrics", help="Look once and print the figures as `/metrics` of the dashboard has them.")
]
WaitOption = Annotated[bool, typer.Option("--wait", help="Wait for a run that has not begun.")]
IntervalOption = Annotated[float, typer.Option(min=0.1, max=3600, help="Seconds between two looks.")]


@app.command(epilog=EPILOG)
def top(
    run: RunArgument = None,
    once: OnceOption = False,
    json: LooksOption = False,
    openmetrics: OpenMetricsOption = False,
    wait: WaitOption = False,
    interval: IntervalOption = 1.0,
) -> None:
    """Show how busy the units of a run are, its frame time and latency, queues, drops, heat and error.

    It ends with the run; Ctrl-C ends it before. A finished run is shown as it ended. Where stdout is no terminal, each
    look is a line.
    """
    from trilane.apps.live.followed_run import follow
    from trilane.apps.live.run_looks import looks

    if json and openmetrics:
        raise BadInputError("options", "--json and --openmetrics", "one of them")
    followed = follow(run, wait=wait)
    with closing(looks(followed, partial(time.sleep, interval))) as seen:
        with spinner("reading the journal"):
            first = next(seen)
        if openmetrics:
            _print_openmetrics(first)
        elif once and json:
            print_json(first.as_json())
        elif json:
            _print_lines(first, seen)
        else:
            _show(first, iter(()) if once else seen)


def _print_openmetrics(look: Look) -> None:
    try:
        from trilane.apps.live.openmetrics import openmetrics
    except ModuleNotFoundError as error:
        raise MissingPartError(f"--openmetrics needs {error.name}", extra="dashboard") from None
    sys.stdout.write(openmetrics(look.figures).decode())


def _print_lines(first: Look, rest: Iterator[Look]) -> None:
    for look in chain([first], rest):
        sys.stdout.write(json_text.dumps(look.as_json(), allow_nan=False) + "\n")
        sys.stdout.flush()


def _show(first: Look, rest: Iterator[Look]) -> None:
    """On a screen that is drawn anew; line by line where stdout is no terminal."""
    from rich.live import Live

    from trilane.apps.cli.top_view import ending, heading, line, screen

    console = stdout_console()
    if not console.is_terminal:
        sys.stdout.write(heading(first) + "\n")
        written = ""
        for look in chain([first], rest):
            if (said := line(look)) != written:
                sys.stdout.write(said + "\n")
            if look.state is not first.state:
                sys.stdout.write(ending(look) + "\n")
            sys.stdout.flush()
            written = said
        return
    with Live(screen(first), console=console, auto_refresh=False) as live:
        for look in rest:
            live.update(screen(look), refresh=True)
