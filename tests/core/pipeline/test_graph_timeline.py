"""The frames of a graph as a journal tells them, against what the scheduler itself does with them on random graphs."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import pytest

from trilane.pipeline.journal import Stepped, journal_of
from trilane.pipeline.timeline import ExplainedJob, Gone, Presented, Timeline
from trilane.scheduler.core import Core
from trilane.scheduler.events import Drop, DropCause, Graph, Input, Loss, Settings, StageSpec
from trilane.scheduler.flow import Flow
from trilane.scheduler.ledger import JobRecord, Ledger
from trilane.scheduler.recording import Recording
from trilane.scheduler.state import FrameState, StageState
from trilane.scheduler.virtual import simulate


def drawn(seed: int) -> tuple[Graph, Settings, dict[str, int], list[tuple[int, str]]]:
    """A random graph, settings, the time of each stage, and deaths of units."""
    rng = random.Random(seed)
    stages: list[StageSpec] = []
    policy = rng.choice(("pipelined", "latest", "deadline", "sequential"))
    for place in range(rng.randint(2, 8)):
        sources = [stage.name for stage in stages]
        read = rng.sample(sources, min(len(sources), rng.randint(1, 3)))
        if (
            place and policy != "deadline" and rng.random() < 0.1
        ):  # of several sources the journal does not name the late
            read = []
        inputs = tuple(Input(name, latest=rng.random() < 0.25 * (each > 0)) for each, name in enumerate(read))
        every = rng.choice((2, 3)) if rng.random() < 0.2 else 1
        stages.append(StageSpec(f"s{place}", f"u{rng.randint(0, 3)}", inputs, every))
    read = {each.stage for stage in stages for each in stage.inputs or ()}
    bare = Graph(tuple(stages), ("double",) * len(read), "s0")
    newest = {each.stage for stage in stages for each in stage.inputs or () if each.latest}
    rules = []
    for name, readers in bare.streams.items():
        # Which of several readers' frames a mailbox replaces depends on its side; the journal does not say it.
        usual = ["double", "fifo:3", "orphan:4", *(["triple"] if len(readers) == 1 else [])]
        rules.append(rng.choice([*usual, *([] if name in newest else ["single"])]))
    graph = Graph(tuple(stages), tuple(rules), rng.choice(stages).name)
    period_ns = rng.choice((7, 11, 30)) if policy in ("latest", "deadline") or rng.random() < 0.5 else 0
    deadline_ns = 60 if policy == "deadline" else 0
    in_flight = rng.choice((0, 0, 2, 3))
    settings = Settings(40, policy, period_ns=period_ns, deadline_ns=deadline_ns, in_flight=in_flight)
    deaths = [(rng.randint(1, 600), f"{rng.choice(graph.units)}") for _ in range(rng.choice((0, 0, 1, 3)))]
    return graph, settings, {stage.name: rng.randint(1, 20) for stage in stages}, sorted(deaths)


def run(seed: int) -> tuple[Recording, Sequence[JobRecord], dict[str, Any]]:
    graph, settings, times, deaths = drawn(seed)
    made = simulate(
        graph, settings, lambda stage, _u, frame, _b: times[stage] + frame % 3, restart_ns=25, faults=deaths, keep=True
    )
    assert made.recording is not None
    return made.recording, made.jobs, made.report


def _noted(monkeypatch: pytest.MonkeyPatch, of: type, name: str, note: Callable[..., None]) -> None:
    """Let a method call `note` with its arguments before it does its work."""
    real = getattr(of, name)

    def method(self: Any, *args: Any) -> Any:
        note(self, *args)
        return real(self, *args)

    monkeypatch.setattr(of, name, method)


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """What the scheduler does with frames: those presented, dropped and lost, with cause and release."""
    found: list[tuple[Any, ...]] = []
    noted = partial(_noted, monkeypatch)

    def dropped(flow: Flow, frame: int, behind: StageState, before: StageState | None, cause: DropCause) -> None:
        readers = before.name if before is not None else ",".join(each.name for each in behind.readers)
        writer = "source" if behind is before else behind.name
        if not flow.frames[frame].is_presented:
            found.append((frame, flow.frames[frame].release_ns, str(Drop(f"{writer}->{readers}", cause))))

    def lost(flow: Flow, frame: int, loss: Loss) -> None:
        if not flow.frames[frame].is_presented:
            found.append((frame, flow.frames[frame].release_ns, str(loss)))

    def left(flow: Flow, frame: int) -> None:
        state: FrameState = flow.frames[frame]
        if not state.is_presented:
            ends = ",".join(stage.name for stage in flow.stages if stage.output is None)
            found.append((frame, state.release_ns, str(Drop(ends, DropCause.EVERY))))

    def presented(_ledger: Ledger, frame: int, end_ns: int, latency_ns: int, *_rest: Any) -> None:
        found.append((frame, end_ns, latency_ns if latency_ns >= 0 else None))

    def at_source(core: Core, frame: int, release_ns: int, cause: DropCause) -> None:
        found.append((frame, release_ns, str(Drop(f"source->{core.graph.stages[0].name}", cause))))

    noted(Core, "_count_drop_at_source", at_source)
    noted(Flow, "_count_drop", dropped)
    noted(Flow, "mark_lost", lost)
    noted(Flow, "_leave", left)
    noted(Ledger, "presented", presented)
    return found


@pytest.mark.parametrize("seed", range(300))
def test_the_timeline_tells_which_frames_a_graph_presents_drops_and_loses(
    seed: int, told: list[tuple[Any, ...]]
) -> None:
    recording, jobs, report = run(seed)
    records = list(journal_of(recording, jobs, {}, report))
    core = Core(recording.graph, recording.settings)
    told.clear()
    expected: list[list[tuple[Any, ...]]] = []
    for record in records[1:]:
        if isinstance(record, Stepped):
            core.step(record.now_ns, record.events)
            expected.append([*told])
            told.clear()
    timeline = Timeline(recording.graph, recording.settings, waits=True, idle=True)
    found: list[list[tuple[Any, ...]]] = []
    for record in records[1:]:
        if isinstance(record, Stepped):
            found.append([])
        for fact in timeline.add(record):
            if isinstance(fact, Gone):
                found[-1].append((fact.frame, fact.release_ns, fact.cause))
            elif isinstance(fact, Presented):
                found[-1].append((fact.frame, fact.end_ns, fact.latency_ns))
            elif isinstance(fact, ExplainedJob):
                assert sum(fact.waits_ns.values()) == fact.job.begin_ns - fact.job.ready_ns
    assert [sorted(step, key=str) for step in found] == [sorted(step, key=str) for step in expected]
    assert (timeline.frames, timeline.is_over) == ({}, True)
    counted = report["frames"]
    assert (timeline.presented, timeline.not_begun) == (counted["presented"], counted["not_begun"])
