"""Random graphs, service times, policies, faults and stops: what must hold in every one of them, after every step."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilane.scheduler.core import Core
from trilane.scheduler.events import (
    Abort,
    Dispatch,
    Event,
    Graph,
    Hold,
    Input,
    JobDone,
    Outcome,
    OutcomeKind,
    SetDuty,
    Settings,
    StageSpec,
    Stop,
    unpacked,
)
from trilane.scheduler.virtual import VirtualDriver
from trilane.transport.slots import FREE, READING, READY, WRITING, EdgeSlots

RULES = ["single", "double", "triple", "fifo:3", "orphan:4"]
POLICIES = ["sequential", "pipelined", "latest", "deadline"]
UNITS = ["u0", "u1", "u2", "u3"]
FRAMES = 40


@st.composite
def graphs(draw: st.DrawFn) -> Graph:
    """Forks, joins, inputs of the newest frame, `every`, and one source or several."""
    stages: list[StageSpec] = []
    for place in range(draw(st.integers(2, 8))):
        known = [stage.name for stage in stages]
        read = draw(st.lists(st.sampled_from(known), max_size=3, unique=True)) if known else []
        inputs = tuple(
            Input(name, draw(st.booleans()) and draw(st.booleans()), draw(st.sampled_from([0, 700])))
            for name in sorted(read)
        )
        every = draw(st.sampled_from([1, 1, 1, 1, 2, 3]))
        stages.append(StageSpec(f"s{place}", draw(st.sampled_from(UNITS)), inputs, every))
    newest = {each.stage for stage in stages for each in stage.inputs or () if each.latest}
    read_of = {each.stage for stage in stages for each in stage.inputs or ()}
    edges = tuple(
        draw(st.sampled_from(RULES[1:] if stage.name in newest else RULES)) for stage in stages if stage.name in read_of
    )
    return Graph(tuple(stages), edges, draw(st.sampled_from(stages)).name, from_release=draw(st.booleans()))


def service_of(seed: int) -> Any:
    return lambda stage, _unit, frame, _begin_ns: random.Random(f"{seed} {stage} {frame}").randint(1, 1000)


def check(core: Core) -> None:
    """Each slot's state says who has it: one job writes it, jobs read it, readers wait for it or hold it, or nobody."""
    written: dict[str, list[int]] = {stage.name: [] for stage in core.stages}
    read: dict[str, Counter[int]] = {stage.name: Counter() for stage in core.stages}
    for unit in core.units.values():
        for job in unit.queue:
            inputs = core.graph.inputs_of(core.flow.stage_named[job.stage].position)
            slots = unpacked(job.slot_in, len(inputs)) if inputs else []
            for each, slot in zip(inputs, slots, strict=True):
                if slot >= 0:
                    read[each.stage][slot] += 1
                assert slot >= 0 or each.latest
            if job.slot_out >= 0:
                written[job.stage].append(job.slot_out)
    for stage in core.stages:
        if stage.output is not None:
            check_slots(stage.output, written[stage.name], read[stage.name])
    for stage in core.stages:
        for inlet in stage.inlets:
            frames = [inlet.edge.frame[slot] for slot in inlet.waiting]
            assert frames == sorted(set(frames))
            assert all(frame in core.frames for frame in frames)
            assert not any(core.frames[frame].begun & stage.bit for frame in frames)


def check_slots(edge: EdgeSlots, written: list[int], read: Iterable[int]) -> None:
    waiting = {slot for line in edge.lines for slot in line} | {slot for slot in edge.newest if slot >= 0}
    by_state: dict[str, list[int]] = {FREE: [], WRITING: [], READY: [], READING: []}
    for slot, state in enumerate(edge.state):
        by_state[state].append(slot)
    assert sorted(written) == by_state[WRITING]
    assert sorted(set(read)) == by_state[READING]
    assert by_state[READY] == sorted(waiting - set(read))
    assert sorted(edge.free) == by_state[FREE]
    assert not waiting & {*by_state[FREE], *by_state[WRITING]}
    kept = [edge.frame[slot] for slot in range(len(edge.state)) if edge.state[slot] != FREE]
    assert len(set(kept)) == len(kept)  # no frame in two slots


def check_steps(graph: Graph, run: Settings, driver: VirtualDriver, has_faults: bool) -> None:
    """The same steps, looked at one by one; no stage does a frame twice, or frames out of order, but after a fault."""
    assert driver.recording is not None
    core = Core(graph, run)
    orders: dict[str, list[int]] = {stage.name: [] for stage in graph.stages}
    ended: Counter[int] = Counter()
    for now_ns, events, actions in driver.recording.steps:
        assert core.step(now_ns, events).actions == actions
        ended.update(type(event) is JobDone for event in events)
        if not core.finished:
            check(core)
        assert core.flow.aside == sum(state.is_presented for state in core.frames.values())
        for job in [action.job for action in actions if isinstance(action, Dispatch)]:
            orders[job.stage].append(job.frame)
    assert has_faults or all(order == sorted(set(order)) for order in orders.values())


def check_counts(driver: VirtualDriver) -> None:
    """Each requested frame is counted once, and presented once at most."""
    frames = driver.core.report(clock="virtual")["frames"]
    counted = frames["presented"] + frames["lost"] + sum(frames["dropped"].values())
    assert counted + frames["not_begun"] == FRAMES
    presented = driver.core.ledger.presented_frames
    assert len(set(presented)) == len(presented) == frames["presented"]
    assert not driver.core.frames or driver.core.outcome != Outcome(OutcomeKind.DONE)
    for row in driver.core.report(clock="virtual")["units"].values():
        parts = [row["busy"], *row["idle"].values()]
        assert sum(parts) == pytest.approx(1) or driver.core.ledger.end_ns == driver.core.ledger.start_ns
        assert min(parts) >= 0


@settings(max_examples=150)
@given(
    graph=graphs(),
    policy=st.sampled_from(POLICIES),
    seed=st.integers(0, 2**32),
    is_paced=st.booleans(),
    message_delay_ns=st.integers(0, 50),
    period_ns=st.integers(1, 2000),
    limits=st.tuples(st.integers(0, 4), st.integers(0, 3), st.sampled_from([0, 3000])),
    duty=st.sampled_from([1000, 1000, 400]),
    faults=st.lists(st.tuples(st.integers(0, 40_000), st.sampled_from(UNITS)), max_size=5),
)
def test_every_frame_goes_through_or_is_counted_and_no_slot_is_owned_twice(
    graph: Graph,
    policy: str,
    seed: int,
    is_paced: bool,
    message_delay_ns: int,
    period_ns: int,
    limits: tuple[int, int, int],
    duty: int,
    faults: list[tuple[int, str]],
) -> None:
    """A deadlock would let the driver raise that the simulation stands still."""
    in_flight, in_queue, timeout_ns = limits
    paced = is_paced or policy in ("latest", "deadline")
    run = Settings(
        FRAMES,
        policy,
        period_ns=period_ns if paced else 0,
        deadline_ns=6000,
        in_flight=in_flight,
        in_queue=in_queue,
        queue_timeout_ns=timeout_ns,
        max_failures=20,
    )
    faults = [fault for fault in faults if fault[1] in graph.units]
    driver = VirtualDriver(
        graph,
        run,
        service_of(seed),
        message_delay_ns=message_delay_ns,
        restart_ns=5000,
        faults=faults,
        inputs=[(0, SetDuty(graph.units[0], duty))],
        keep=True,
    )
    assert driver.run() == Outcome(OutcomeKind.DONE)
    check_counts(driver)
    check_steps(graph, run, driver, bool(faults))


@settings(max_examples=150)
@given(
    graph=graphs(),
    policy=st.sampled_from(POLICIES),
    seed=st.integers(0, 2**32),
    is_paced=st.booleans(),
    in_flight=st.integers(0, 3),
    faults=st.lists(st.tuples(st.integers(0, 20_000), st.sampled_from(UNITS)), max_size=4),
    ends=st.lists(st.tuples(st.integers(0, 30_000), st.sampled_from([Stop(), Abort()])), max_size=2),
    held=st.lists(st.tuples(st.integers(0, 20_000), st.sampled_from([-1, 0, 2])), max_size=3),
)
def test_however_a_run_of_a_graph_ends_its_frames_add_up(
    graph: Graph,
    policy: str,
    seed: int,
    is_paced: bool,
    in_flight: int,
    faults: list[tuple[int, str]],
    ends: list[tuple[int, Event]],
    held: list[tuple[int, int]],
) -> None:
    """Stopped, aborted, given up or held."""
    paced = is_paced or policy in ("latest", "deadline")
    run = Settings(FRAMES, policy, period_ns=300 if paced else 0, deadline_ns=6000, in_flight=in_flight, max_failures=1)
    events = [*ends, *((at, Hold(frames)) for at, frames in held), (40_000, Hold(-1)), (60_000, Abort())]
    faults = [fault for fault in faults if fault[1] in graph.units]
    driver = VirtualDriver(graph, run, service_of(seed), restart_ns=5000, faults=faults, inputs=events, keep=True)
    driver.run()
    check_counts(driver)
    check_steps(graph, run, driver, bool(faults))
