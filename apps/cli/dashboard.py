"""`trilane dashboard`: a finished run in a browser, at any of its moments.

Rule: this file talks to the person; what is shown is in `trilane.apps.dashboard`.
"""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import Annotated

import typer

from trilane.apps.cli.commands import Commands
from trilane.apps.cli.console import stderr_console
from trilane.apps.cli.options import PortOption
from trilane.errors import BadInputError

app = Commands()

EPILOG = """\b
Examples:
  trilane dashboard runs/20261122T101500Z-default
  trilane dashboard runs/walk --port 8080
"""

FolderArgument = Annotated[Path, typer.Argument(help="Folder of a run, or its name below runs/.")]


@app.command(epilog=EPILOG)
def dashboard(run: FolderArgument, port: PortOption = None) -> None:
    """Show a finished run in a browser: its pictures, timeline and figures at any moment.

    The page is at the address that is printed, on this machine alone, until the command is interrupted. A run that
    goes on is shown by `trilane run --dashboard`.
    """
    from trilane.apps.dashboard.serve import listen, require_server

    require_server()
    from trilane.apps.dashboard.app import DashboardApp
    from trilane.apps.dashboard.finished_view import FinishedView
    from trilane.apps.dashboard.serve import server
    from trilane.apps.live.followed_run import RunState, follow

    followed = follow(run)
    if followed.state is RunState.GOES_ON:
        remedy = "`trilane top` shows it; start it with `trilane run --dashboard` to see it in a browser"
        raise BadInputError(run, "a run that goes on", "one that is over", remedy)
    with contextlib.closing(FinishedView(followed.folder)) as view, contextlib.closing(listen(port)) as place:
        answers = DashboardApp(view, place.port, place.token)
        stderr_console().print(f"dashboard: {place.url}", soft_wrap=True, markup=False)
        asyncio.run(server(answers).serve(sockets=[place.listener]))
