"""`trilane trace`: the timeline of a run for trace viewers, made again from its journal.

Rule: this file talks to the person; what a trace holds is in `trilane.apps.explain`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trilane.apps.cli.commands import Commands
from trilane.apps.cli.console import spinner, stderr_console
from trilane.errors import BadInputError

app = Commands()

EPILOG = """\b
Examples:
  trilane trace runs/20261122T101500Z-default
  trilane trace walk --chrome-json --out walk.json
"""

RunArgument = Annotated[Path, typer.Argument(help="Run folder, or its name below runs/.")]
ChromeOption = Annotated[bool, typer.Option("--chrome-json", help="Chrome's JSON instead of Perfetto's packets.")]
OutOption = Annotated[Path | None, typer.Option("--out", help="File to write; trace.pftrace or trace.json in RUN.")]


@app.command(epilog=EPILOG)
def trace(run: RunArgument, chrome_json: ChromeOption = False, out: OutOption = None) -> None:
    """Write the timeline of a run, from its journal, for ui.perfetto.dev or chrome://tracing.

    docs/trace.md says what every track is.
    """
    from trilane.apps.explain.trace import CHROME_NAME, NAME, write_run
    from trilane.apps.live.followed_run import RunState, follow

    followed = follow(run)
    if out is None and followed.state is RunState.GOES_ON:
        raise BadInputError(run, "a run that goes on", "--out FILE for its trace so far", "its folder is its own")
    target = out or followed.folder / (CHROME_NAME if chrome_json else NAME)
    with spinner("writing the trace"):
        write_run(followed.whole(), target, chrome=chrome_json)
    stderr_console().print(f"trace: {target}", soft_wrap=True, markup=False)
