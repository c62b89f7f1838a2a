"""The loop that every driver runs. Rule: one loop for all clocks; drivers differ in their `Clock` alone."""

from __future__ import annotations

from typing import Protocol

from trilane.scheduler.causes import Outcome
from trilane.scheduler.core import Core
from trilane.scheduler.events import NEVER, Action, Event


class Clock(Protocol):
    """The world around the core: it knows the time, hears what happens and does what the core says."""

    def wait(self, deadline_ns: int) -> tuple[int, tuple[Event, ...]]:
        """Wait until something happens or the deadline comes; return the time and what has happened.

        Times never go back. It may return without an event at any time.

        `deadline_ns`: latest time of return; NEVER when only an event can bring the core on. The first call of a run
        has NEVER. It must return the first events: a `UnitReady` for each unit that is up.
        """
        ...

    def perform(self, now_ns: int, actions: tuple[Action, ...]) -> None:
        """Do what the core answered at `now_ns`: one action or more."""
        ...


class Recorder(Protocol):
    """Takes the steps of a run, such as `trilane.scheduler.recording.Recording`."""

    def add(self, now_ns: int, events: tuple[Event, ...], actions: tuple[Action, ...], core: Core) -> None:
        """Add a step of `core` that has just been taken, and whose actions were performed."""
        ...


def run_loop(core: Core, clock: Clock, recording: Recorder | None = None) -> Outcome:
    """Run `core` until it finishes, and add every step to `recording`.

    Raises what `clock` raises, KeyError and UnitLifeError (see Core.step).
    """
    wait, perform = clock.wait, clock.perform  # looked up once: they are called for every step
    deadline_ns: int = NEVER
    while True:
        now_ns, events = wait(deadline_ns)
        actions, deadline_ns = core.step(now_ns, events)
        if actions:
            perform(now_ns, actions)
        if recording is not None:
            recording.add(now_ns, events, actions, core)
        if core.outcome is not None:
            return core.outcome
