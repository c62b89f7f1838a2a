"""A run under a dashboard: `trilane run`'s own code, again whenever the page asks for another configuration.

Rule: this process runs the pipeline and answers the page's server, which is a process of its own; neither waits for the
other. What can be changed while the run goes on is. For the rest the run is ended cleanly and begins anew; each of
these runs leaves a folder of its own.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from trilane.apps.asked_run import early_processes, prepare, run_prepared
from trilane.apps.dashboard.channel import Refused, StateIs
from trilane.apps.dashboard.director import ENDED, FAILED, Director
from trilane.apps.dashboard.serve import listen
from trilane.apps.dashboard.server_link import ServerLink
from trilane.apps.run_job import Hooks, Outcome, Prepared, Watched
from trilane.errors import TrilaneError
from trilane.stages.configure import GlFacts, required_machine
from trilane.stages.run_options import RunOptions

ENDLESS: Final = 1_000_000_000  # frames: a year at 30 a second

OpenHooks = Callable[[], AbstractContextManager[Hooks]]


def run_live(
    options: RunOptions, hooks: OpenHooks, command: tuple[str, ...], port: int | None, tell: Callable[[str], None]
) -> Outcome:
    """Run what the options ask for, and then what the page asks for, until it is interrupted; the last run's outcome.

    `options`: with a number of frames each run ends after so many.
    `hooks`, `command`: as `run_asked` takes them. `port`: as `listen` takes it.
    `tell`: is given the page's address, and sentences for a person.
    Raises as `run_asked`.
    """
    with early_processes() as (starter, gl):
        first = prepare(options.changed(baseline_frames=0), gl, command)
        output = first.checked.config.scene.output
        runs = _Runs(
            partial(prepare, gl=gl, command=command),
            gl,
            partial(run_prepared, hooks=hooks, starter=starter, gl=gl),
            tell,
        )
        with contextlib.closing(listen(port)) as place:
            runs.link = ServerLink(place, output.height, output.width, runs.director.do, tell)
            tell(f"dashboard: {place.url}")
        with contextlib.closing(runs.link):
            return runs.run_all(first)


class _Runs:
    """One run after the other. `link`: to the server, set before the first."""

    link: ServerLink

    def __init__(
        self,
        prepare: Callable[[RunOptions], Prepared],
        gl: GlFacts,
        run: Callable[..., Outcome],
        tell: Callable[[str], None],
    ) -> None:
        self._gl, self._run, self._tell = gl, run, tell
        self._count = 0
        self.director = Director(prepare, lambda message: self.link.send(message))

    def run_all(self, first: Prepared) -> Outcome:
        """Until no other is asked for, or one fails. Raises TrilaneError when the first has presented no frame."""
        now, before = first, None
        while True:
            try:
                outcome = self._run_one(now)
            except TrilaneError as error:
                following = self.director.take_next() or before
                if following is None:
                    self.link.send(StateIs(FAILED, str(error)))
                    raise
                self.link.send(Refused("", f"the run did not begin: {error}"))
                now, before = following, None
                continue
            following = self.director.take_next()
            if following is None or outcome.exit_code:
                failure = outcome.report.failure
                self.link.send(StateIs(FAILED if failure else ENDED, failure or ""))
                return outcome
            self._tell(f"run folder: {outcome.folder}")
            now, before = following, now

    def _run_one(self, prepared: Prepared) -> Outcome:
        options = prepared.options
        controls = self.director.begin(prepared)
        show = partial(self.director.show, required_machine(self._gl))
        frames = None if options.frames else ENDLESS
        self._count += 1
        if options.out is not None:
            prepared = replace(prepared, options=options.changed(out=_numbered(options.out, self._count)))
        return self._run(prepared, watched=Watched(frames, self.link.window, controls, show))


def _numbered(folder: Path, number: int) -> Path:
    """The folder of run `number` of those under one page: the first has the name that was asked for."""
    return folder if number == 1 else folder.with_name(f"{folder.name}-{number}")
