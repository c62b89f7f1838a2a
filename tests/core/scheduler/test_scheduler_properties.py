"""Random graphs, service times, policies and faults: what must hold in every one of them, after every step."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilane.pipeline.run_metrics import FrameCounts
from trilane.scheduler.core import Core
from trilane.scheduler.events import (
    Abort,
    Dispatch,
    Event,
    FrameRequest,
    Graph,
    Hold,
    Job,
    JobDone,
    Outcome,
    OutcomeKind,
    Settings,
    StageSpec,
    Stop,
)
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
    pairs = [(first, last) for first in range(len(units)) for last in range(first + 2, len(units))]
    first, last = draw(st.sampled_from([(0, 0), *pairs]))
    met = draw(st.sampled_from([*stages[: first + 1], *stages[last:]])).name  # by every frame
    return Graph(stages, tuple(rules), met, (f"s{first}", f"s{last}") if last else None)


def skips_of(seed: int, share: float) -> Any:
    """`share` of the frames skip, of those that are told to be fresh a tenth of that."""

    def skips(frame: int, fresh: bool) -> bool:
        return random.Random(f"{seed} skip {frame}").random() < (share / 10 if fresh else share)

    return skips


def service_of(seed: int) -> Any:
    """Service times from 1 to 1000 ns that depend on stage and frame alone."""
    return lambda stage, _unit, frame, _begin_ns: random.Random(f"{seed} {stage} {frame}").randint(1, 1000)


def first_of(graph: Graph) -> StageSpec:
    """The stage at which the bypass begins."""
    assert graph.bypass is not None
    return next(stage for stage in graph.stages if stage.name == graph.bypass[0])


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
                own = len(core.flow.edges[position - 1].state)
                bypassed = core.graph.stages.index(first_of(core.graph)) if job.slot_in >= own else position - 1
                read[bypassed].append(job.slot_in - own if job.slot_in >= own else job.slot_in)
            if job.slot_out >= 0:
                written[position].append(job.slot_out)
    for index, edge in enumerate(core.flow.edges):
        by_state: dict[str, list[int]] = {FREE: [], WRITING: [], READY: [], READING: []}
        for slot, state in enumerate(edge.state):
            by_state[state].append(slot)
        assert sorted(written[index]) == by_state[WRITING]
        assert sorted(read[index]) == by_state[READING]
        assert sorted(slot for line in edge.lines for slot in line) == by_state[READY]
        assert sorted(edge.free) == by_state[FREE]
        for line in edge.lines:
            waiting = [edge.frame[slot] for slot in line]
            assert waiting == sorted(waiting)
            assert {core.frames[frame].skips for frame in waiting if line is not edge.ready} <= {True}
            held += waiting
    assert sorted(held) == sorted(core.frames)


@settings(max_examples=150)
@given(
    graph=graphs(),
    policy=st.sampled_from(POLICIES),
    seed=st.integers(0, 2**32),
    message_delay_ns=st.integers(0, 50),
    period_ns=st.integers(1, 2000),
    limits=st.tuples(st.integers(0, 5), st.integers(0, 3), st.integers(0, 3000)),
    latch_ns=st.integers(0, 1500),
    faults=st.lists(st.tuples(st.integers(0, 60_000), st.sampled_from(UNITS)), max_size=4),
    skipping=st.sampled_from([0.0, 0.3, 0.7, 1.0]),
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
    skipping: float,
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
        graph,
        run,
        service_of(seed),
        message_delay_ns=message_delay_ns,
        restart_ns=5000,
        faults=faults,
        skips=skips_of(seed, skipping),
        keep=True,
    )
    assert driver.run() == Outcome(OutcomeKind.DONE)
    frames = driver.core.report(clock="virtual")["frames"]
    assert frames["presented"] + frames["lost"] + sum(frames["dropped"].values()) == 60
    presented = driver.core.ledger.presented_frames
    assert presented == sorted(set(presented))
    for row in driver.core.report(clock="virtual")["units"].values():
        parts = [row["busy"], *row["idle"].values()]
        assert sum(parts) == pytest.approx(1)
        assert min(parts) >= 0
    assert driver.recording is not None
    check_bypass(graph, driver.recording.steps, faults)
    core = Core(graph, run)
    for now_ns, events, actions in driver.recording.steps:
        assert core.step(now_ns, events).actions == actions
        check(core)


@settings(max_examples=150)
@given(
    graph=graphs(),
    policy=st.sampled_from(POLICIES),
    seed=st.integers(0, 2**32),
    is_paced=st.booleans(),
    limits=st.tuples(st.integers(0, 5), st.integers(0, 3), st.integers(0, 3000)),
    faults=st.lists(st.tuples(st.integers(0, 20_000), st.sampled_from(UNITS)), max_size=4),
    ends=st.lists(st.tuples(st.integers(0, 30_000), st.sampled_from([Stop(), Abort()])), max_size=2),
    held=st.lists(st.tuples(st.integers(0, 20_000), st.sampled_from([-1, 0, 2])), max_size=3),
    asked=st.lists(st.tuples(st.integers(0, 20_000), st.integers(1, 25)), max_size=5),
)
def test_however_a_run_ends_its_frames_add_up(
    graph: Graph,
    policy: str,
    seed: int,
    is_paced: bool,
    limits: tuple[int, int, int],
    faults: list[tuple[int, str]],
    ends: list[tuple[int, Event]],
    held: list[tuple[int, int]],
    asked: list[tuple[int, int]],
) -> None:
    """Interrupted, aborted, given up, held, or asked for frames: `not_begun` is what no job began and none dropped."""
    in_flight, in_queue, timeout_ns = limits
    is_asked = bool(asked) and not is_paced
    run = Settings(
        60,
        policy,
        period_ns=0 if is_asked else 300 if is_paced or policy in ("latest", "deadline") else 0,
        deadline_ns=8000,
        in_flight=in_flight,
        in_queue=in_queue,
        queue_timeout_ns=timeout_ns,
        asked=is_asked,
        max_failures=1,
    )
    events = [*ends, *((at, Hold(frames)) for at, frames in held), (40_000, Hold(-1)), (40_001, Abort())]
    events += [(at, FrameRequest(frames)) for at, frames in asked] if is_asked else []
    driver = VirtualDriver(
        graph,
        run,
        service_of(seed),
        restart_ns=5000,
        faults=[fault for fault in faults if fault[1] in graph.units],
        inputs=events,
        keep=True,
    )
    driver.run()
    assert driver.recording is not None
    for requested in (60, driver.core.source.released):
        frames = FrameCounts.model_validate(driver.core.report(clock="virtual", requested=requested)["frames"])
        at_source = sum(count for cause, count in frames.dropped.items() if cause.startswith("source->"))
        actions = [action for step in driver.recording.steps for action in step[2]]
        begun = {action.job.frame for action in actions if isinstance(action, Dispatch)}
        assert frames.not_begun == requested - len(begun) - at_source >= 0


def check_bypass(graph: Graph, steps: Any, faults: list[tuple[int, str]]) -> None:
    """No skipped stage has a job of a frame that skips; no stage does frames out of order, but after a fault again."""
    jobs: dict[int, Job] = {}
    skipped: set[int] = set()
    for _, events, actions in steps:
        skipped |= {jobs[event.job].frame for event in events if isinstance(event, JobDone) and event.skips}
        jobs |= {action.job.id: action.job for action in actions if isinstance(action, Dispatch)}
    assert not {job.frame for job in jobs.values() if job.stage in graph.bypassed} & skipped
    assert all(not job.fresh or job.stage == first_of(graph).name for job in jobs.values())
    for stage in graph.stages:
        order = [job.frame for job in jobs.values() if job.stage == stage.name]
        assert order == sorted(order) or faults
        assert order == sorted(set(order)) or faults


@settings(max_examples=150)
@given(
    graph=graphs(KEEPING),
    seed=st.integers(0, 2**32),
    message_delay_ns=st.integers(0, 100),
    skipping=st.sampled_from([0.0, 0.5]),
)
def test_pipelined_is_never_slower_than_sequential(
    graph: Graph, seed: int, message_delay_ns: int, skipping: float
) -> None:
    took = {}
    for policy in ("sequential", "pipelined"):
        skips = skips_of(seed, skipping)
        driver = VirtualDriver(
            graph, Settings(40, policy), service_of(seed), message_delay_ns=message_delay_ns, skips=skips
        )
        driver.run()
        ledger = driver.core.ledger
        assert len(ledger.presented_ns) == 40
        assert ledger.presented_ns == sorted(ledger.presented_ns)
        took[policy] = ledger.end_ns - ledger.start_ns
    assert took["pipelined"] <= took["sequential"]
