"""Placements in turns in virtual time: which frames each has, where the units are then, and the frame times by hand."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from trilane import machine
from trilane.pipeline import rehearsal
from trilane.pipeline.rehearsal import DRAIN, SKIPPED, SLICE, Group
from trilane.scheduler.core import Core
from trilane.scheduler.events import Settings, chain
from trilane.scheduler.virtual import VirtualDriver

MS = 1_000_000
GRAPH = chain([("draw", "a"), ("show", "b")], "double", "draw")
PIPELINE: Any = SimpleNamespace(graph=lambda: GRAPH)
#: The core of unit b -> how long it takes for a frame, of which it is the busiest unit.
SHOW_MS = {1: 4, 2: 7, 3: 5}
PLACES = [{"a": (8, 9), "b": (core,)} for core in SHOW_MS]


class Processes:
    """Where the units are, and how often they were moved."""

    first = 0

    def __init__(self) -> None:
        self.at: dict[str, tuple[int, ...]] = {}
        self.moves: list[tuple[str, tuple[int, ...]]] = []
        self.pids = {"a": 71, "b": 72}

    def move(self, unit: str, cores: tuple[int, ...]) -> None:
        self.at[unit] = cores
        self.moves.append((unit, cores))


class VirtualClock:
    """In place of the clock of the machine."""

    def __init__(self, core: Core, processes: Processes, *_: object) -> None:
        def service(stage: str, _unit: str, _frame: int, _begin_ns: int) -> int:
            return (1 if stage == "draw" else SHOW_MS[processes.at["b"][0]]) * MS

        self._driver = VirtualDriver(core.graph, Settings(1), service)
        self._driver.core = core

    def wait(self, deadline_ns: int) -> Any:
        return self._driver.wait(deadline_ns)

    def perform(self, now_ns: int, actions: Any) -> None:
        self._driver.perform(now_ns, actions)


@pytest.fixture
def live(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """A group that runs in virtual time; `own`: the cores of this process, one after the other."""

    def made(interrupts: int = 0) -> Any:
        processes = Processes()
        one = rehearsal._Live(Group(PIPELINE, PLACES), processes, SimpleNamespace(count=interrupts))  # type: ignore[arg-type]
        return SimpleNamespace(one=one, processes=processes, own=own, settings=settings)

    own: list[Any] = []
    settings: list[Any] = []

    def clock(core: Core, *others: Any) -> VirtualClock:
        settings.append(core.settings)
        return VirtualClock(core, *others)

    monkeypatch.setattr(rehearsal, "RealtimeClock", clock)
    monkeypatch.setattr(rehearsal, "os", SimpleNamespace(sched_setaffinity=lambda pid, cores: own.append((pid, cores))))
    return made


@pytest.mark.parametrize(("turn", "order"), [(0, [1, 2, 3]), (1, [2, 3, 1]), (2, [3, 1, 2]), (4, [2, 3, 1])])
def test_a_frame_takes_what_the_unit_takes_where_it_is(live: Any, turn: int, order: list[int]) -> None:
    """Unit b is the busiest, so the time between frames is its own. The times come in the order of the places."""
    made = live()
    assert made.one.one_round(turn, 40) == [4.0 * MS, 7.0 * MS, 5.0 * MS]
    assert made.processes.moves == [move for core in order for move in (("a", (8, 9)), ("b", (core,)))]
    assert made.own == [(0, (8, 9))] * 3
    assert made.processes.first == 40
    assert made.one.pids == [71, 72]
    (settings,) = made.settings
    assert (settings.frames, settings.policy, settings.period_ns) == (3 * 16 + 6, "pipelined", 0)
    assert (settings.hang_ns, SKIPPED) == (10_000_000_000, 6)


def test_the_frames_that_were_under_way_do_not_count() -> None:
    """Frames come every 10 ms in the first slice and 20 ms in the second; the six after the move take 100 ms each."""
    steps = [10.0] * SLICE + [100.0] * SKIPPED + [20.0] * (SLICE - SKIPPED) + [500.0] * DRAIN
    ledger = SimpleNamespace(presented_ns=[], presented_count=0)
    core: Any = SimpleNamespace(ledger=ledger, graph=GRAPH)
    processes = Processes()

    class Clock:
        def wait(self, deadline_ns: int) -> str:
            assert deadline_ns == 99
            last = ledger.presented_ns[-1] if ledger.presented_ns else 0.0
            ledger.presented_ns.append(last + steps[ledger.presented_count])
            ledger.presented_count += 1
            return "events"

        def perform(self, now_ns: int, actions: Any) -> None:
            told.append((now_ns, actions))

    told: list[Any] = []
    clock: Any = Clock()
    own = {"a": machine.here.cores()}
    places: Any = [{**own, "b": (5,)}, {**own, "b": (6,)}]
    turns = rehearsal._Turns(core, clock, processes, places)  # type: ignore[arg-type]
    where = []
    for _ in steps:
        assert turns.wait(99) == "events"  # type: ignore[comparison-overlap]
        where.append(processes.at["b"][0])
    assert where == [5] * SLICE + [6] * (SLICE + DRAIN)
    assert turns.frame_ns() == [10.0, 20.0]
    turns.perform(3, ("action",))  # type: ignore[arg-type]
    assert told == [(3, ("action",))]


def test_a_round_that_was_interrupted_is_none(live: Any) -> None:
    with pytest.raises(KeyboardInterrupt):
        live(interrupts=1).one.one_round(0, 0)
