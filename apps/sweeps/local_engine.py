"""Trials on this machine: those of the host clock one at a time, virtual ones on all cores.

Rule: no process is left, whatever ends the loop over the records.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed

from trilane import machine
from trilane.apps.sweeps.perform import Children, Place, perform
from trilane.apps.sweeps.store import Record
from trilane.apps.sweeps.trial import Clock, Trial


def at_once(clock: Clock) -> int:
    """How many trials go on together: one that measures has the machine for itself."""
    return 1 if clock is Clock.HOST else len(machine.here.cores())


def run_here(trials: Sequence[Trial], place: Place, inherited: tuple[int, ...] = ()) -> Generator[Record]:
    """The records of `trials`, of one command, as they end. Closing the generator ends those that go on.

    `inherited`: descriptors that every trial gets.
    """
    children = Children(inherited)
    with ThreadPoolExecutor(at_once(trials[0].kind.clock)) as pool:
        waiting = [pool.submit(perform, trial, place, children) for trial in trials]
        try:
            for ended in as_completed(waiting):
                yield ended.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            children.end()
