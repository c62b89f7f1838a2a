"""Finds the units whose time is up, and when the next one's will be. Rule: it only answers; the core acts."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from trilane.scheduler.events import NEVER
from trilane.scheduler.state import UnitState
from trilane.scheduler.unit_life import DOWN, READY, STARTING

#: Verdicts: leave the unit alone, kill its process, start it again, let it work after a hold, see if it takes a job.
NOTHING: Final = 0
KILL: Final = 1
START: Final = 2
RESUME: Final = 3
LOOK: Final = 4

#: Waits before a restart, by the number of failures in a row without a finished job; the last repeats.
BACK_OFF_NS = (0, 100_000_000, 400_000_000, 1_600_000_000)


def verdict(unit: UnitState, now_ns: int, lead_ns: int) -> int:
    """Return what is to be done with the unit now.

    `lead_ns`: lead of the policy; with a lead, the unit's next job may be due.
    """
    if unit.deadline_ns <= now_ns:
        return START if unit.life == DOWN else KILL
    if unit.hold_until_ns <= now_ns:
        return RESUME
    return LOOK if lead_ns and len(unit.queue) == 1 else NOTHING


def next_alarm_ns(units: Iterable[UnitState], now_ns: int, lead_ns: int) -> int:
    """Return when the first verdict other than NOTHING is due, or NEVER.

    Until a deadline or a hold is set, no verdict can be due earlier: a job's end and a Pong only put deadlines off.
    """
    alarm_ns = NEVER
    for unit in units:
        alarm_ns = min(alarm_ns, unit.deadline_ns, unit.hold_until_ns)
        if lead_ns and len(unit.queue) == 1:
            lead_from_ns = unit.expected_end_ns() - lead_ns
            if now_ns < lead_from_ns < alarm_ns:
                alarm_ns = lead_from_ns
    return alarm_ns


def back_off_ns(failures: int) -> int:
    """Return how long a unit stays down after `failures` failures in a row, 1 or more."""
    return BACK_OFF_NS[min(failures, len(BACK_OFF_NS)) - 1]


def extended_deadline_ns(unit: UnitState, ns: int) -> int:
    """Return the unit's deadline, put off by the `ns` for which the scheduler did nothing; a restart is not put off."""
    if unit.deadline_ns == NEVER or unit.life not in (STARTING, READY):
        return unit.deadline_ns
    return unit.deadline_ns + ns
