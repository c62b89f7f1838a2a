"""Units that die or hang. Rule: slots go back to their edge only after the unit's process is gone; what it was doing
is lost and counted, what it only held is done again (a frame whose first stage it held is lost, too)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from trilane.scheduler.events import Job, Kill, Start
from trilane.scheduler.state import NEVER, UnitState

if TYPE_CHECKING:
    from trilane.scheduler.core import Core

#: Wait before a restart, by failures in a row without a finished job between; the last repeats.
BACK_OFF_NS = (0, 100_000_000, 400_000_000, 1_600_000_000)


def on_died(core: Core, unit: UnitState) -> None:
    """Reclaim the unit's slots under a new epoch and plan its restart, or end the run when it fails too often."""
    cause = f"{'hung' if unit.killing else 'died'}:{unit.name}"
    unit.alive = unit.killing = False
    unit.pinged_ns = 0
    unit.room = 0
    unit.starting_ns = None
    core.reset_alarm()
    jobs = list(unit.queue)
    unit.queue.clear()
    for job in jobs[:1]:
        free_slots(core, job)
        core.lose(job.frame, cause)
    for job in reversed(jobs[1:]):
        _put_back(core, job, cause)
    for stage in unit.stages:
        for edge in (stage.input, stage.output):
            if edge is not None:
                edge.epoch += 1
    core.touch(unit)
    unit.failures += 1
    if unit.failures > core.settings.max_failures:
        for frame in list(core.frames):
            core.lose(frame, f"gave_up:{unit.name}")
        core.finish(unit.name)
    else:
        unit.restart_at_ns = core.now_ns + BACK_OFF_NS[min(unit.failures, len(BACK_OFF_NS)) - 1]


def free_slots(core: Core, job: Job) -> None:
    """Both slots of a job that will not end are free again."""
    stage = core.stage_named[job.stage]
    if stage.input:
        stage.input.release(job.slot_in)
        core.touch(core.stages[stage.position - 1].unit)
    if stage.output:
        stage.output.abandon(job.slot_out)
        core.touch(stage.unit)


def _put_back(core: Core, job: Job, cause: str) -> None:
    stage = core.stage_named[job.stage]
    if stage.output:
        stage.output.abandon(job.slot_out)
    if stage.input is None:
        core.lose(job.frame, cause)
        return
    for frame in stage.input.give_back(job.slot_in):
        del core.frames[frame]
        core.ledger.dropped[f"{core.graph.edge_name(stage.position - 1)}:stale"] += 1
    core.touch(core.stages[stage.position - 1].unit)


def check_clocks(core: Core) -> None:
    """Kill what missed its deadline, restart what has waited, and look at units whose time has come."""
    for unit in core.units.values():
        if unit.restart_at_ns is not None and unit.restart_at_ns <= core.now_ns:
            unit.restart_at_ns, unit.starting_ns = None, core.now_ns
            unit.hold_until_ns = 0
            core.ledger.restart(unit.name)
            core.actions.append(Start(unit.name))
        deadline = _hang_deadline(core, unit)
        if deadline is not None and deadline <= core.now_ns:
            unit.killing = True
            unit.room = 0
            core.actions.append(Kill(unit.name))
        if 0 < unit.hold_until_ns <= core.now_ns:
            unit.hold_until_ns = 0
            unit.set_room(core.now_ns)
            core.touch(unit)
        if len(unit.queue) == 1 and core.policy.lead_ns is not None:
            core.touch(unit)


def extend_deadlines(unit: UnitState, ns: int) -> None:
    """Every clock that tells whether the unit hangs runs out so much later."""
    unit.head_since_ns += ns
    if unit.pinged_ns:
        unit.pinged_ns += ns
    if unit.starting_ns is not None:
        unit.starting_ns += ns


def next_alarm_ns(core: Core) -> int:
    """When the first clock of a unit runs out: a restart, a hold, a lead, a job or an answer too late; else NEVER.

    No unit's clock can run out before, until one is set: ending a job and hearing from a unit only postpone it.
    """
    times = []
    for unit in core.units.values():
        if unit.restart_at_ns is not None:
            times.append(unit.restart_at_ns)
        deadline = _hang_deadline(core, unit)
        if deadline is not None:
            times.append(deadline)
        if unit.hold_until_ns > core.now_ns:
            times.append(unit.hold_until_ns)
        if len(unit.queue) == 1 and core.ahead_ns(unit) > core.now_ns:
            times.append(core.ahead_ns(unit))
    return min(times, default=NEVER)


def _hang_deadline(core: Core, unit: UnitState) -> int | None:
    if unit.killing:
        return None
    if unit.starting_ns is not None:
        return unit.starting_ns + core.settings.start_ns
    if not unit.alive:
        return None
    if unit.queue:
        return unit.head_since_ns + core.settings.hang_ns
    return unit.pinged_ns + core.settings.hang_ns if unit.pinged_ns else None
