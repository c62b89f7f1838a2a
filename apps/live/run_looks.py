"""Looking at a run again and again: its figures now, and whether there is more to see.

Rule: it ends with the run. A finished run, or one that was killed, is looked at once, at its last moment.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any, NamedTuple

from trilane.apps.live.figures import Figures
from trilane.apps.live.followed_run import EXPECTED, NO_RECORD, FollowedRun, RunState
from trilane.apps.live.live_figures import LiveFigures
from trilane.errors import BadInputError
from trilane.pipeline.journal import Begun


class Look(NamedTuple):
    """The run `name`, in the folder `name` at the end: what it does, and its figures."""

    name: str
    state: RunState
    figures: Figures

    def as_json(self) -> dict[str, Any]:
        """`run`, and the names of `Figures`."""
        return {"run": self.name, **self.figures.as_json()}


def looks(run: FollowedRun, pause: Callable[[], None]) -> Generator[Look]:
    """At `run` now, and after every `pause` until it has ended. Raises BadInputError for a journal without a record."""
    figures: LiveFigures | None = None
    while True:
        state = run.state  # asked before the journal is read, which has everything then
        for record in run.new():
            if isinstance(record, Begun):
                figures = LiveFigures(record, finds_bound=state is not RunState.FINISHED)
            elif figures is not None:
                figures.add(record)
        if figures is not None:
            yield Look(run.name, state, figures.now(figures.last_ns + run.silent_ns, state))
        elif state is not RunState.GOES_ON:
            raise BadInputError(run.folder, NO_RECORD, EXPECTED)
        if state is not RunState.GOES_ON or (figures is not None and figures.is_over):
            return
        pause()
