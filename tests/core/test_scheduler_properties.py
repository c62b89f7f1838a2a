"""Random graphs, service times, policies and faults: what must hold in every one of them, after every step."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilane.scheduler.causes import Outcome, OutcomeKind
from trilane.scheduler.core import Core
from trilane.scheduler.events import Graph, Settings, StageSpec
from trilane.scheduler.virtual import VirtualDriver
from trilane.transport.slots import FREE, READING, READY, WRITING

EDGES = ["single", "double", "triple", "fifo:1", "fifo:3", "orphan", "orphan:4"]
KEEPING = ["single", "double", "fifo:1", "fifo:3"]
POLICIES = ["sequential", "pipelined", "latest", "deadline"]
UNITS = ["cpu", "gpu", "dsp"]


@st.composite
def graphs(draw: st.DrawFn, edges: list[str] = EDGES) -> Graph:
    units = draw(st.lists(st.sampled_from(UNITS), min_size=1, max_size=6))
    stages = tuple(StageSpec(f"s{index}", unit) for index, unit in enumerate(units))
    rules = draw(st.lists(st.sampled_from(edges), min_size=len(units) - 1, max_size=len(units) - 1))
    return Graph(stages, tuple(rules), draw(st.sampled_from(stages)).name)


def service_of(seed: int) -> Any:
    """Service times from 1 to 1000 ns that depend on stage and frame alone."""
    return lambda stage, _unit, frame, _begin_ns: random.Random(f"{seed} {stage} {frame}").randint(1, 1000)


def check(core: Core) -> None:
    """No slot in two hands, none lost, every frame in flight in one place."""
    written: dict[int, list[int]] = {index: [] for index in range(len(core.flow.edges))}
    read: dict[int, list[int]] = {index: [] for index in range(len(core.flow.edges))}
    held = []
    for unit in core.units.values():
        for job in unit.queue:
            position = core.flow.stage_named[job.stage].position
            held.append(job.frame)
            if job.slot_in >= 0:
                read[position - 1].append(job.slot_in)
            if job.slot_out >= 0:
                written[position].append(job.slot_out)
    for index, edge in enumerate(core.flow.edges):
        by_state: dict[str, list[int]] = {FREE: [], WRITING: [], READY: [], READING: []}
        for slot, state in enumerate(edge.state):
            by_state[state].append(slot)
        assert sorted(written[index]) == by_state[WRITING]
        assert sorted(read[index]) == by_state[READING]
        assert sorted(edge.ready) == by_state[READY]
        assert sorted(edge.free) == by_state[FREE]
        held += [edge.frame[slot] for slot in edge.ready]
        waiting = [edge.frame[slot] for slot in edge.ready]
        assert waiting == sorted(waiting)
    assert sorted(held) == sorted(core.frames)


@settings(max_examples=150, deadline=None)
@given(
    graph=graphs(),
    policy=st.sampled_from(POLICIES),
    seed=st.integers(0, 2**32),
    message_delay_ns=st.integers(0, 50),
    period_ns=st.integers(1, 2000),
    limits=st.tuples(st.integers(0, 5), st.integers(0, 3), st.integers(0, 3000)),
    latch_ns=st.integers(0, 1500),
    faults=st.lists(st.tuples(st.integers(0, 60_000), st.sampled_from(UNITS)), max_size=4),
)
def test_no_slot_is_owned_twice_no_frame_is_lost_or_out_of_order(
    graph: Graph,
    policy: str,
    seed: int,
    message_delay_ns: int,
    period_ns: int,
    limits: tuple[int, int, int],
    latch_ns: int,
    faults: list[tuple[int, str]],
) -> None:
    in_flight, in_queue, timeout_ns = limits
    run = Settings(
        60,
        policy,
        period_ns=period_ns,
        deadline_ns=8000,
        in_flight=in_flight,
        in_queue=in_queue,
        queue_timeout_ns=timeout_ns,
        latch_ns=latch_ns,
        hang_ns=10**7,
        max_failures=20,
    )
    faults = [fault for fault in faults if fault[1] in graph.units]
    driver = VirtualDriver(
        graph, run, service_of(seed), message_delay_ns=message_delay_ns, restart_ns=5000, faults=faults, keep=True
    )
    assert driver.run() == Outcome(OutcomeKind.DONE)
    frames = driver.core.ledger.report(clock="virtual", requested=60)["frames"]
    assert frames["presented"] + frames["lost"] + sum(frames["dropped"].values()) == 60
    presented = driver.core.ledger.presented_frames
    assert presented == sorted(set(presented))
    for row in driver.core.ledger.report(clock="virtual", requested=60)["units"].values():
        parts = [row["busy"], *row["idle"].values()]
        assert sum(parts) == pytest.approx(1)
        assert min(parts) >= 0
    assert driver.recording is not None
    core = Core(graph, run)
    for now_ns, events, actions in driver.recording.steps:
        assert core.step(now_ns, events).actions == actions
        check(core)


@settings(max_examples=150, deadline=None)
@given(graph=graphs(KEEPING), seed=st.integers(0, 2**32), message_delay_ns=st.integers(0, 100))
def test_pipelined_is_never_slower_than_sequential(graph: Graph, seed: int, message_delay_ns: int) -> None:
    took = {}
    for policy in ("sequential", "pipelined"):
        driver = VirtualDriver(graph, Settings(40, policy), service_of(seed), message_delay_ns=message_delay_ns)
        driver.run()
        ledger = driver.core.ledger
        assert len(ledger.presented_ns) == 40
        assert ledger.presented_ns == sorted(ledger.presented_ns)
        took[policy] = ledger.end_ns - ledger.start_ns
    assert took["pipelined"] <= took["sequential"]
