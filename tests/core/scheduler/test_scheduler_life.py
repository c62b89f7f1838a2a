"""A unit's life by the table: every state, every event; and what the watchdog answers."""

from __future__ import annotations

import pytest

from trilane.hw_profiles.application import application_graph
from trilane.scheduler import state as watchdog
from trilane.scheduler.core import Core
from trilane.scheduler.events import (
    NEVER,
    Dispatch,
    Event,
    Job,
    JobDone,
    JobFailed,
    Kill,
    Pinged,
    Pong,
    SchedulerStalled,
    Settings,
    Start,
    UnitDied,
    UnitReady,
)
from trilane.scheduler.state import (
    DOWN,
    HELD_JOBS,
    IGNORED,
    READY,
    REFUSED,
    STARTING,
    STATES,
    STOPPING,
    TABLE,
    DeadlinePassed,
    UnitLifeError,
    UnitState,
)

HANG_NS, START_NS = 100, 50
EVENT_OF: dict[type, Event] = {
    UnitReady: UnitReady("dsp"),
    UnitDied: UnitDied("dsp"),
    Pinged: Pinged("dsp"),
    Pong: Pong("dsp"),
    JobDone: JobDone("dsp", 99, 0, 1, 0),
    JobFailed: JobFailed("dsp", 99),
}


def core_with_dsp(state: int) -> Core:
    """A core at time 10 whose DSP has come to `state`; the other units are still starting."""
    core = Core(application_graph(), Settings(10, "sequential", hang_ns=HANG_NS, start_ns=START_NS))
    core.step(0, (UnitReady("dsp"),))
    if state == STOPPING:
        core.step(0, (Pinged("dsp"),))
        assert core.step(HANG_NS).actions == (Kill("dsp"),)
    if state in (STARTING, DOWN):
        assert core.step(5, (UnitDied("dsp"),)).actions == (Start("dsp"),)
    if state == DOWN:
        assert core.step(10, (UnitDied("dsp"),)).actions == ()
    assert core.units["dsp"].life == state
    return core


@pytest.mark.parametrize("event", TABLE, ids=lambda event: event.__name__)
@pytest.mark.parametrize("state", range(len(STATES)), ids=STATES)
def test_every_event_in_every_state_does_what_the_table_says(state: int, event: type) -> None:
    core, after = core_with_dsp(state), TABLE[event][state]
    unit = core.units["dsp"]
    unit.failures = 1  # so that a unit that dies now is not started again in the same step
    if event is DeadlinePassed:
        if after == REFUSED:
            assert unit.deadline_ns == NEVER
        else:
            _pass_deadline(core, unit, state)
            assert unit.life == after
    elif after == REFUSED:
        with pytest.raises(UnitLifeError, match=f"unit dsp is {STATES[state]}: {event.__name__} cannot happen"):
            core.step(HANG_NS, (EVENT_OF[event],))
    else:
        before = (unit.life, unit.deadline_ns)
        core.step(core.now_ns, (EVENT_OF[event],))
        if after == IGNORED:
            assert (unit.life, unit.deadline_ns) == before
        else:
            assert unit.life == after


def _pass_deadline(core: Core, unit: UnitState, state: int) -> None:
    if state == READY:
        core.step(10, (Pinged("dsp"),))
    assert core.step(unit.deadline_ns - 1).actions == ()
    assert core.step(unit.deadline_ns).actions == ((Start if state == DOWN else Kill)("dsp"),)


def test_a_job_that_ends_while_its_unit_is_stopped_still_counts_and_one_of_a_dead_unit_does_not() -> None:
    core = Core(application_graph(), Settings(10, "sequential", hang_ns=HANG_NS))
    (pose,) = core.step(0, tuple(UnitReady(unit) for unit in core.units)).actions
    assert isinstance(pose, Dispatch)
    assert core.step(HANG_NS).actions == (Kill("cpu"),)
    done = JobDone("cpu", pose.job.id, 0, HANG_NS, 0)
    (raster,) = core.step(HANG_NS + 1, (done,)).actions
    assert isinstance(raster, Dispatch)
    assert (core.units["cpu"].life, core.units["cpu"].deadline_ns) == (STOPPING, NEVER)
    core.step(HANG_NS + 2, (UnitDied("gpu"), JobDone("gpu", raster.job.id, 0, 1, 0)))
    assert core.ledger.lost_by_cause == {"died:gpu": 1}


def test_a_ping_and_its_pong_do_not_move_the_deadline_of_a_running_job() -> None:
    core = Core(application_graph(), Settings(10, "sequential", hang_ns=HANG_NS))
    core.step(0, tuple(UnitReady(unit) for unit in core.units))
    core.step(50, (Pinged("cpu"),))
    core.step(60, (Pong("cpu"),))
    assert core.step(99).actions == ()
    assert core.step(100).actions == (Kill("cpu"),)


def test_a_stalled_scheduler_extends_the_time_to_start_but_puts_no_restart_off() -> None:
    starting, down = core_with_dsp(STARTING), core_with_dsp(DOWN)
    restart_ns = down.units["dsp"].deadline_ns
    starting.step(10, (SchedulerStalled(1000),))
    down.step(10, (SchedulerStalled(1000),))
    assert starting.units["dsp"].deadline_ns == 5 + START_NS + 1000
    assert down.units["dsp"].deadline_ns == restart_ns


def unit_at(life: int, **fields: int) -> UnitState:
    unit = UnitState("dsp")
    unit.life = life
    for name, value in fields.items():
        setattr(unit, name, value)
    return unit


@pytest.mark.parametrize(
    ("unit", "verdict"),
    [
        (unit_at(READY), watchdog.NOTHING),
        (unit_at(READY, deadline_ns=11), watchdog.NOTHING),
        (unit_at(READY, deadline_ns=10), watchdog.KILL),
        (unit_at(STARTING, deadline_ns=9), watchdog.KILL),
        (unit_at(DOWN, deadline_ns=10), watchdog.START),
        (unit_at(DOWN, deadline_ns=11), watchdog.NOTHING),
        (unit_at(READY, hold_until_ns=10), watchdog.RESUME),
        (unit_at(READY, hold_until_ns=11), watchdog.NOTHING),
        (unit_at(READY, hold_until_ns=5, deadline_ns=10), watchdog.KILL),
    ],
)
def test_a_verdict_follows_from_state_deadline_and_hold(unit: UnitState, verdict: int) -> None:
    before = (unit.life, unit.deadline_ns, unit.hold_until_ns, unit.queue_capacity)
    assert watchdog.verdict(unit, 10, 0) == verdict
    assert (unit.life, unit.deadline_ns, unit.hold_until_ns, unit.queue_capacity) == before


def test_a_policy_that_leads_looks_at_units_with_one_job() -> None:
    unit = unit_at(READY, deadline_ns=1000, head_since_ns=0)
    assert watchdog.verdict(unit, 10, 5) == watchdog.NOTHING
    unit.queue.append(Job(0, "dsp", "infer", 0, 0, 0, 0))
    assert watchdog.verdict(unit, 10, 5) == watchdog.LOOK
    assert watchdog.verdict(unit, 10, 0) == watchdog.NOTHING


def test_the_next_alarm_is_the_first_deadline_or_hold() -> None:
    units = [unit_at(READY), unit_at(READY, deadline_ns=70), unit_at(READY, hold_until_ns=60)]
    assert watchdog.next_alarm_ns(units, 10, 0) == 60
    assert watchdog.next_alarm_ns(units[:1], 10, 0) == NEVER


def test_the_wait_before_a_restart_grows_and_then_stays() -> None:
    waits = [watchdog.back_off_ns(failures) for failures in range(1, 7)]
    assert waits == [0, 100_000_000, 400_000_000, 1_600_000_000, 1_600_000_000, 1_600_000_000]


@pytest.mark.parametrize(
    ("unit", "capacity"),
    [
        (unit_at(READY), HELD_JOBS),
        (unit_at(READY, duty=500), 1),
        (unit_at(READY, hold_until_ns=20), 0),
        (unit_at(STARTING), 0),
        (unit_at(STOPPING), 0),
        (unit_at(DOWN), 0),
    ],
)
def test_only_a_ready_unit_that_is_not_held_back_has_room_for_jobs(unit: UnitState, capacity: int) -> None:
    unit.update_queue_capacity()
    assert unit.queue_capacity == capacity
