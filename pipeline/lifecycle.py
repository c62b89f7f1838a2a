"""The units' lives outside the run: all are up before it, and closed after it. Rule: the time limits are here."""

from __future__ import annotations

import time
from collections.abc import Iterable

from trilane.pipeline.run_log import RunLog, UnitError
from trilane.pipeline.signals import Interrupts
from trilane.pipeline.unit_processes import UnitMessage, UnitProcesses
from trilane.transport.messages import Close, Closed, Failed, Ready

START_S = 120.0
CLOSE_S = 30.0
POLL_MS = 200


def start_units(processes: UnitProcesses, units: Iterable[str], interrupts: Interrupts) -> dict[str, float]:
    """Start every unit, wait until it is bound to its slots, and return how many ms each unit took.

    Raises UnitError when a unit cannot start, and KeyboardInterrupt when interrupted.
    """
    started_s = {}
    for unit in units:
        started_s[unit] = time.monotonic()
        processes.start(unit)
    waiting = set(started_s)
    end = time.monotonic() + START_S
    took_ms: dict[str, float] = {}
    while waiting:
        if time.monotonic() > end:
            raise UnitError(f"unit {', '.join(sorted(waiting))} was not ready after {START_S:.0f} s")
        for unit, message in listen_before_run(processes, interrupts):
            if isinstance(message, Ready):
                processes.connected(unit)
                took_ms[unit] = (time.monotonic() - started_s[unit]) * 1000
                waiting.discard(unit)
    return took_ms


def listen_before_run(processes: UnitProcesses, interrupts: Interrupts) -> list[UnitMessage]:
    """Return the next messages; raises UnitError when a unit failed or ended, KeyboardInterrupt when interrupted."""
    messages = processes.listen(POLL_MS)
    if interrupts.count:
        raise KeyboardInterrupt
    for unit, message in messages:
        if isinstance(message, Failed):
            raise UnitError(message.message, message.exit_code)
        if message is None:
            raise UnitError(f"unit {unit} ended before the run began{processes.why_ended(unit)}")
    return messages


def close_units(processes: UnitProcesses, log: RunLog, interrupts: Interrupts) -> None:
    """Let the stages complete their files and the processes end.

    `UnitProcesses.close` kills a process that does not end.
    """
    waiting = set(processes.pids)
    for unit in waiting:
        processes.send(unit, Close())
    end = time.monotonic() + CLOSE_S
    # A second interrupt asks to end at once, so it ends the wait too.
    while waiting and time.monotonic() < end and interrupts.count < 2:
        for unit, message in processes.listen(POLL_MS):
            if isinstance(message, Failed):
                log.fail(message.message, message.exit_code)
                log.say(message.message)
            if message is None and unit in waiting:
                log.fail(f"unit {unit} ended before its files were closed{processes.why_ended(unit)}")
            if message is None or isinstance(message, Closed):
                waiting.discard(unit)
    if waiting and interrupts.count < 2:
        log.fail(f"unit {', '.join(sorted(waiting))} did not close its files")
    processes.wait_for_end(list(processes.pids))
