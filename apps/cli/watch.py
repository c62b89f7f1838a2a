"""`trilane watch`, `trilane show` and `trilane trace`: views of one run, during it or after it.

Rule: this file reads options and shows; the figures come from `trilane.apps.watch`, the page from
`trilane.apps.dashboard`, the trace from `trilane.apps.tracing`.
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

from trilane.apps.cli.commands import Commands, NewestRunArgument, PortOption
from trilane.apps.cli.console import print_json, spinner, stderr_console, stdout_console
from trilane.errors import BadInputError, MissingPartError

if TYPE_CHECKING:
    from trilane.apps.watch.live_figures import RunLook

app = Commands()
EPILOG_WATCH = """\b
Examples:
  trilane watch
  trilane watch runs/walk
  trilane watch walk --wait
  trilane watch --json --interval 5 >> figures.jsonl
  trilane watch runs/walk --once --json
  trilane watch runs/walk --openmetrics
"""
OnceOption = Annotated[bool, typer.Option("--once", help="Print the figures once, even if the run goes on.")]
LooksOption = Annotated[
    bool, typer.Option("--json", help="Print one line of JSON for each update; with --once, one document.")
]
OpenMetricsOption = Annotated[
    bool, typer.Option("--openmetrics", help="Print the figures once, in the form of the dashboard's `/metrics`.")
]
WaitOption = Annotated[bool, typer.Option("--wait", help="Wait for a run that has not begun.")]
IntervalOption = Annotated[float, typer.Option(min=0.1, max=3600, help="Seconds between two updates.")]
EPILOG_SHOW = """\b
Examples:
  trilane show
  trilane show runs/20261122T101500Z-default
  trilane show runs/walk --port 8080
"""
EPILOG_TRACE = """\b
Examples:
  trilane trace
  trilane trace runs/20261122T101500Z-default
  trilane trace walk --chrome-json --out walk.json
"""
ChromeOption = Annotated[bool, typer.Option("--chrome-json", help="Chrome's JSON instead of Perfetto's packets.")]
OutOption = Annotated[Path | None, typer.Option("--out", help="File to write; trace.pftrace or trace.json in RUN.")]


@app.command(epilog=EPILOG_WATCH)
def watch(
    run: NewestRunArgument = None,
    once: OnceOption = False,
    json: LooksOption = False,
    openmetrics: OpenMetricsOption = False,
    wait: WaitOption = False,
    interval: IntervalOption = 1.0,
) -> None:
    """Show a run's figures: busy units, frame time, latency, queues, drops, heat and error.

    The command ends with the run, or with Ctrl-C. For a finished run, the last figures are shown. If stdout is no
    terminal, each update is a line.
    """
    from trilane.apps.watch.followed_run import follow
    from trilane.apps.watch.live_figures import looks

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


def _print_openmetrics(look: RunLook) -> None:
    try:
        from trilane.apps.watch.metrics import openmetrics
    except ModuleNotFoundError as error:
        raise MissingPartError(f"--openmetrics needs {error.name}", extra="dashboard") from None
    sys.stdout.write(openmetrics(look.figures).decode())


def _print_lines(first: RunLook, rest: Iterator[RunLook]) -> None:
    for look in chain([first], rest):
        sys.stdout.write(json_text.dumps(look.as_json(), allow_nan=False) + "\n")
        sys.stdout.flush()


def _show(first: RunLook, rest: Iterator[RunLook]) -> None:
    """Show looks on a screen that is redrawn, or line by line where stdout is no terminal."""
    from rich.live import Live

    from trilane.apps.cli.watch_view import ending, heading, line, screen

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
    with Live(screen(first, console.width), console=console, auto_refresh=False) as live:
        for look in rest:
            live.update(screen(look, console.width), refresh=True)


@app.command(epilog=EPILOG_SHOW)
def show(run: NewestRunArgument = None, port: PortOption = None) -> None:
    """Show a finished run in a browser: its pictures, timeline and figures at any moment.

    The page is served at the printed address, to this machine only, until the command is interrupted. For a live run,
    use `trilane run --dashboard`.
    """
    import asyncio

    from trilane.apps.dashboard.access import listen, require_server
    from trilane.apps.watch.followed_run import RunState, follow

    followed = follow(run)
    if followed.state is RunState.GOES_ON:
        remedy = "`trilane watch` shows it; start it with `trilane run --dashboard` to see it in a browser"
        raise BadInputError(followed.folder, "a run that goes on", "one that is over", remedy)
    require_server()
    from trilane.apps.dashboard.app import DashboardApp, server
    from trilane.apps.dashboard.finished_view import FinishedView

    with closing(FinishedView(followed.folder)) as view, closing(listen(port)) as place:
        answers = DashboardApp(view, place.port, place.token)
        stderr_console().print(f"dashboard: {place.url}", soft_wrap=True, markup=False)
        asyncio.run(server(answers).serve(sockets=[place.listener]))


@app.command(epilog=EPILOG_TRACE)
def trace(run: NewestRunArgument = None, chrome_json: ChromeOption = False, out: OutOption = None) -> None:
    """Write the timeline of a run, from its journal, for ui.perfetto.dev or chrome://tracing.

    docs/explain.md says what every track is.
    """
    from trilane.apps.explain.trace import CHROME_NAME, NAME, write_run
    from trilane.apps.watch.followed_run import RunState, follow

    followed = follow(run)
    if out is None and followed.state is RunState.GOES_ON:
        raise BadInputError(
            followed.folder, "a run that goes on", "--out FILE for its trace so far", "its folder is its own"
        )
    target = out or followed.folder / (CHROME_NAME if chrome_json else NAME)
    with spinner("writing the trace"):
        write_run(followed.whole(), target, chrome=chrome_json)
    stderr_console().print(f"trace: {target}", soft_wrap=True, markup=False)
