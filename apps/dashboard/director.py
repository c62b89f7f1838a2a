"""What the page asks of the runs, done. Rule: a change is checked as a command line is before a run is stopped."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from trilane.apps.dashboard.channel import Asked, Message, Refused, RunBegins, StateIs
from trilane.apps.dashboard.choices import choices_of, reasons_against
from trilane.apps.dashboard.controls import OF_A_NEW_RUN, controls_of_run
from trilane.apps.dashboard.known_runs import facts_of_checked
from trilane.apps.live.followed_run import run_name
from trilane.apps.run_job import Prepared
from trilane.errors import TrilaneError
from trilane.pipeline.controls import ALL, RunControls
from trilane.stages.configure import Checked
from trilane.stages.run_options import NOTHING, RunOptions, kind_of
from trilane.units import UNITS

RUNNING, PAUSED, RESTARTING, ENDED, FAILED = "running", "paused", "restarting", "ended", "failed"
#: Controls that hold the run or let it go: how many frames it may release, and what it does then.
HOLDS: Final = {"play": (ALL, RUNNING), "pause": (0, PAUSED), "step": (1, PAUSED)}


class Director:
    """The runs under one page, one after the other. `do` is called by another thread than the rest.

    `prepare`: checks a run. `send`: hands a message to the server.
    """

    def __init__(self, prepare: Callable[[RunOptions], Prepared], send: Callable[[Message], None]) -> None:
        self._prepare, self._send = prepare, send
        self._lock = threading.Lock()
        self._now: Prepared | None = None
        self._next: Prepared | None = None
        self._controls: RunControls | None = None

    def begin(self, prepared: Prepared) -> RunControls:
        """The way into the run of `prepared`, which begins now."""
        with self._lock:
            self._now, self._next, self._controls = prepared, None, RunControls()
            return self._controls

    def show(self, machine: Mapping[str, Any], folder: Path, checked: Checked) -> None:
        """The run writes into `folder`; it runs `checked`."""
        assert self._now is not None
        options = self._now.options
        facts = facts_of_checked(run_name(folder), checked, options, machine)
        choices = choices_of(facts.config)
        controls = controls_of_run(UNITS, choices, reasons_against(options))
        self._send(RunBegins(str(folder), asdict(facts), [asdict(control) for control in controls]))
        self._send(StateIs(RUNNING, ""))

    def take_next(self) -> Prepared | None:
        """The run that was asked for in place of the one that has ended, once."""
        with self._lock:
            taken, self._next = self._next, None
            return taken

    def do(self, asked: Asked) -> None:
        """What the page asks for; its server has looked at name and value."""
        with self._lock:
            controls = self._controls
        if controls is None:
            return
        if asked.control in HOLDS:
            frames, state = HOLDS[asked.control]
            controls.hold(frames)
            self._send(StateIs(state, ""))
        elif asked.control == "kill" and asked.value in UNITS:
            controls.kill(str(asked.value))
        elif asked.control in OF_A_NEW_RUN and isinstance(asked.value, str):
            self._change(controls, asked.control, asked.value)

    def _change(self, controls: RunControls, name: str, value: str) -> None:
        with self._lock:
            current = self._next or self._now
        assert current is not None
        try:
            asked = None if value == NOTHING else kind_of(RunOptions.model_fields[name])(value)
            prepared = self._prepare(current.options.changed(**{name: asked}))
        except TrilaneError as error:
            self._send(Refused(name, str(error)))
            return
        with self._lock:
            self._next = prepared
        self._send(StateIs(RESTARTING, f"{name.replace('_', ' ')} {value}: the run begins anew"))
        controls.stop()
