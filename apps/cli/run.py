"""`trilane run`: a scene through the three units, to a run folder and a table.

Rule: this file talks to the person; `trilane.apps.run.asked_run` does the work.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trilane.apps.cli.commands import Commands, JsonOption, PortOption, with_options
from trilane.apps.cli.console import print_json, print_verdict, shown_messages, stderr_console, stdout_console
from trilane.errors import BadInputError
from trilane.stages.run_options import RunOptions

if TYPE_CHECKING:
    from rich.progress import TaskID

    from trilane.apps.run.run_job import Hooks, RunOutcome

app = Commands()

EPILOG = """\b
Examples:
  trilane run
  trilane run --frames 60 --size 192 --out /tmp/run
  trilane run --motion walk.bvh --camera arkit.txt --frames 200 --json
  trilane run --latch 3
  trilane run --no-video --baseline 0 --frames 1000000
  trilane run walk-past --policy latest --edge triple --fps 24 --picture 1280x720
  trilane run --cores cpu=1 --cores gpu=0 --cores dsp=0,1
  trilane run --split /Concat_4_output_0_QuantizeLinear_Output=cpu
  trilane run --performance-profile sustained_high_performance
  trilane run --check 4
  trilane run --calibration entropy:10 --check 4
  trilane run --width 8 --channels 8
  trilane run --dashboard
  trilane run --profile snapdragon-888 --pace --slow-motion 24 --frames 60
  trilane run myscene.toml --background street.mp4 --policy sequential
  trilane run street.toml --frames 300 --set stages.detector.runtime=openvino
"""

TableOption = Annotated[
    bool, typer.Option("--table", help="Print the table of all figures below the verdict (docs/report.md).")
]
DashboardOption = Annotated[
    bool, typer.Option("--dashboard", help="Show the run in a browser; without --frames it runs until Ctrl-C.")
]


@contextmanager
def _hooks() -> Iterator[Hooks]:
    """Show messages, and a progress bar when stderr is a terminal."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
    from rich.text import Text

    from trilane.apps.run.run_job import Hooks

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=stderr_console(), disable=not sys.stderr.isatty())
    tasks: dict[str, TaskID] = {}
    starting = bar.add_task("starting the units", total=None)

    def progress(what: str, presented: int, requested: int) -> None:
        if what not in tasks:
            bar.update(starting, visible=False)
            tasks[what] = bar.add_task(what, total=requested)
        bar.update(tasks[what], completed=presented)

    with bar:
        yield Hooks(progress, lambda text: bar.console.print(Text(text), soft_wrap=True))


@app.command(epilog=EPILOG)
@with_options(RunOptions)
def run(
    options: RunOptions,
    *,
    dashboard: DashboardOption = False,
    port: PortOption = None,
    table: TableOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run a scene or a pipeline file, write a run folder and print a verdict.

    The verdict says whether the run holds its rate, what bounds it, and whether the machine was quiet.
    The folder holds report.json, video.mp4, contact.png, trace.pftrace (open it at ui.perfetto.dev), events.jsonl and
    journal.msgpack. The journal is written while the run goes on.
    docs/report.md explains every key, the policies and the edges.
    """
    from trilane.apps.run.asked_run import run_asked

    if port is not None and not dashboard:
        raise BadInputError("options", "--port without --dashboard", "both or neither")
    if options.check and dashboard:
        raise BadInputError(
            "options", "--check with --dashboard", "one of them", "a run that is steered has no reference"
        )
    command = ("trilane", *sys.argv[1:])
    outcome = _run_live(options, command, port) if dashboard else run_asked(options, _hooks, command)
    _print_outcome(outcome, as_json, table)
    raise typer.Exit(outcome.exit_code)


def _run_live(options: RunOptions, command: tuple[str, ...], port: int | None) -> RunOutcome:
    from trilane.apps.dashboard.access import require_server

    require_server()
    from trilane.pipeline.pipeline_file import is_pipeline_file

    tell = lambda text: stderr_console().print(text, soft_wrap=True, markup=False)  # noqa: E731
    if is_pipeline_file(Path(options.scene)):
        from trilane.apps.dashboard.live_file import run_file_live

        return run_file_live(options, _hooks, command, port, tell)
    from trilane.apps.dashboard.live_run import run_live

    return run_live(options, _hooks, command, port, tell)


def _print_outcome(outcome: RunOutcome, as_json: bool, with_table: bool) -> None:
    """Print the report or its verdict on stdout; the folder, and why a run failed, on stderr."""
    from trilane.apps.run.verdict_facts import verdict_of

    report = outcome.report
    if as_json:
        print_json(report.as_json())
    else:
        print_verdict(verdict_of(report, str(outcome.folder)).lines())
        if with_table:
            from trilane.apps.cli.run_table import run_table

            stdout_console().print(run_table(report))
    stderr_console().print(f"run folder: {outcome.folder}", soft_wrap=True, markup=False)
    for message in shown_messages(report.messages, report.failure):
        stderr_console().print(f"in the run: {message}", soft_wrap=True, markup=False)
    if report.failure:
        stderr_console().print(f"the run failed: {report.failure}", soft_wrap=True, markup=False)
