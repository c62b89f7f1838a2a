"""A run of a pipeline file under a dashboard. Its page holds the run, steps it, and kills units.

Rule: this process runs the pipeline; the page's server is another process, and neither waits for the other. There is
one run: what else changes it is in the file.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from trilane.apps.dashboard.access import ServerAddress, listen
from trilane.apps.dashboard.channel import ChangesAsked, ControlAsked, RunBegins, ServerLink, StateIs
from trilane.apps.dashboard.live_run import ENDED, FAILED, HOLDS, RUNNING, OpenHooks
from trilane.apps.dashboard.run_facts import controls_of_file, facts_of_file
from trilane.apps.run.run_file import run_file
from trilane.apps.run.run_job import RunOutcome
from trilane.apps.watch.followed_run import run_name
from trilane.errors import TrilaneError
from trilane.pipeline.controls import RunControls
from trilane.pipeline.description import Pipeline
from trilane.stages.run_options import RunOptions

#: Sides of the window where the file writes no video, so that it has no picture.
NO_PICTURE: Final = (2, 2)


def run_file_live(
    options: RunOptions, hooks: OpenHooks, command: tuple[str, ...], port: int | None, tell: Callable[[str], None]
) -> RunOutcome:
    """Run the pipeline file of `options` until an interrupt, or for its number of frames.

    The parameters, and the errors raised, are those of `trilane.apps.dashboard.live_run.run_live`.
    """
    with contextlib.ExitStack() as stack:
        place = stack.enter_context(contextlib.closing(listen(port)))
        watch = FileWatch(lambda height, width, hear: _link(stack, place, height, width, hear, tell))
        tell(f"dashboard: {place.url}")
        try:
            outcome = run_file(options, hooks, command, watch)
        except TrilaneError as error:
            watch.ends(FAILED, str(error))
            raise
        failure = outcome.report.failure
        watch.ends(FAILED if failure else ENDED, failure or "")
        return outcome


def _link(
    stack: contextlib.ExitStack,
    place: ServerAddress,
    height: int,
    width: int,
    hear: Callable[[ControlAsked | ChangesAsked], None],
    tell: Callable[[str], None],
) -> ServerLink:
    return stack.enter_context(contextlib.closing(ServerLink(place, height, width, hear, tell)))


class FileWatch:
    """A `trilane.apps.run.run_file.Watch`: the page of the run.

    `link`: function that makes the link to the page's server, from the height and width of pictures and from the
    function that hears requests, on a thread of its own.
    """

    def __init__(self, link: Callable[[int, int, Callable[[ControlAsked | ChangesAsked], None]], ServerLink]) -> None:
        self.controls = RunControls()
        self._make = link
        self._link: ServerLink | None = None

    def begins(self, folder: Path, pipeline: Pipeline, facts: Mapping[str, Any]) -> Path:
        config = facts["config"]
        output = config["scene"].get("output")
        sides = (output["height"], output["width"]) if output else NO_PICTURE
        height, width = (max(side // 2 * 2, 2) for side in sides)  # as the video has them
        link = self._link = self._make(height, width, self.do)
        said = facts_of_file(run_name(folder), config, facts["machine"])
        controls = controls_of_file(list(pipeline.units))
        link.send(RunBegins(str(folder), asdict(said), [asdict(control) for control in controls]))
        link.send(StateIs(RUNNING, ""))
        return link.window

    def ends(self, state: str, why: str) -> None:
        """Tell the page that the run is over."""
        if self._link is not None:
            self._link.send(StateIs(state, why))

    def do(self, asked: ControlAsked | ChangesAsked) -> None:
        """Carry out a request of the page, whose server has already checked name and value: it asks for no changes."""
        if isinstance(asked, ChangesAsked):
            return
        if asked.control in HOLDS:
            frames, state = HOLDS[asked.control]
            self.controls.hold(frames)
            if self._link is not None:
                self._link.send(StateIs(state, ""))
        elif asked.control == "kill":
            self.controls.kill(str(asked.value))
