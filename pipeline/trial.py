"""Times placements with real frames. Rule: placements run in turns, a few frames each, the same frames.

Running units are moved from the cores of one placement to those of the next, while frames go through them. A slice of
frames takes a fraction of a second, so what slows the machine for a second slows all placements that are compared. From
run to run the machine may differ by more than two placements do. Placements with other numbers of threads need
processes of their own, which stand still while others have their turn.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from trilane.machine import awake
from trilane.pipeline.controls import Interrupts
from trilane.pipeline.description import Pipeline
from trilane.pipeline.memory import Assets
from trilane.pipeline.realtime_clock import RealtimeClock
from trilane.pipeline.result import Failure, RunLog, UnitError
from trilane.pipeline.surroundings import OtherPrograms, on_cores, prompt_answers, unit_processes
from trilane.pipeline.unit_processes import UnitProcesses, start_units
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.core import Core, run_loop
from trilane.scheduler.events import Action, Event
from trilane.scheduler.policy import run_settings
from trilane.transport.messages import Message, RunJob

SLICE: Final = 16  # frames of a placement in its turn
SKIPPED: Final = 6  # first frames of a slice that do not count, as they were under way when the units were moved
DRAIN: Final = 6  # frames behind the last slice, so that its own frames are not the last in the pipeline
PERIOD_NS: Final = 33_333_333
HANG_NS: Final = 10_000_000_000

#: The cores of each unit.
Cores = Mapping[str, tuple[int, ...]]


class Group(NamedTuple):
    """Placements that the processes of `pipeline` can have in turn; the cores in `pipeline` itself do not matter."""

    pipeline: Pipeline
    places: Sequence[Cores]


class Round(NamedTuple):
    """A turn of every placement.

    `frame_ns`: mean frame time of each placement in ns, group by group.
    `others`: share of other programs, see `OtherPrograms.share`.
    """

    frame_ns: tuple[float, ...]
    others: float


def try_in_turns(
    groups: Sequence[Group],
    windows: Sequence[int],
    assets: Assets,
    starter: UnitStarter,
    is_enough: Callable[[Sequence[Round]], bool] = lambda _: False,
) -> list[Round]:
    """Return a round for each of `windows`, or fewer once `is_enough` says that they are enough.

    `groups`: placements to try; each round begins with another one.
    `windows`: for each round, the first of the SLICE frames that every placement does.
    `assets`, `starter`: arrays and fork server, as for a run.

    Raises TrilaneError when a unit cannot start or a stage fails, and KeyboardInterrupt when interrupted.
    """
    rounds: list[Round] = []
    cores = sorted({core for group in groups for place in group.places for own in place.values() for core in own})
    with contextlib.ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts())
        stack.enter_context(prompt_answers())
        stack.enter_context(awake())
        stack.enter_context(on_cores(tuple(cores)))
        lives = [stack.enter_context(_started(group, assets, starter, interrupts)) for group in groups]
        for turn, first in enumerate(windows):
            others = OtherPrograms(cores, [pid for live in lives for pid in live.pids])
            frame_ns = tuple(ns for live in lives for ns in live.one_round(turn, first))
            rounds.append(Round(frame_ns, others.share()))
            if is_enough(rounds):
                break
    return rounds


class _Replaying(UnitProcesses):
    """Units whose every slice does the same frames of the scene: those from `first` on."""

    first = 0

    def send(self, unit: str, message: Message) -> None:
        if isinstance(message, RunJob):
            message = message._replace(frame=self.first + message.frame % SLICE)
        super().send(unit, message)


@contextlib.contextmanager
def _started(group: Group, assets: Assets, starter: UnitStarter, interrupts: Interrupts) -> Iterator[_Live]:
    with unit_processes(group.pipeline, assets, starter, _Replaying) as processes:
        start_units(processes, list(group.pipeline.units), interrupts)
        yield _Live(group, processes, interrupts)


class _Live:
    """A group whose processes run."""

    def __init__(self, group: Group, processes: _Replaying, interrupts: Interrupts) -> None:
        self._group, self._processes, self._interrupts = group, processes, interrupts

    @property
    def pids(self) -> list[int]:
        return list(self._processes.pids.values())

    def one_round(self, turn: int, first: int) -> list[float]:
        """Return the frame time of each place in ns, on the frames from `first` on.

        Each `turn` begins with another place.
        """
        count = len(self._group.places)
        order = [(turn + number) % count for number in range(count)]
        self._processes.first = first
        settings = run_settings("pipelined", SLICE * count + DRAIN, PERIOD_NS, hang_ns=HANG_NS)
        core = Core(self._group.pipeline.graph(), settings)
        log = RunLog()
        clock = RealtimeClock(core, self._processes, self._interrupts, log, None, None, None)
        turns = _Turns(core, clock, self._processes, [self._group.places[place] for place in order])
        run_loop(core, turns)
        if self._interrupts.count:
            raise KeyboardInterrupt
        if core.ledger.presented_count < SLICE * count:
            failure = log.failure or Failure("; ".join(log.messages) or "frames were lost")
            raise UnitError(failure.message, failure.exit_code)
        by_place = dict(zip(order, turns.frame_ns(), strict=True))
        return [by_place[place] for place in range(count)]


class _Turns:
    """The `trilane.scheduler.core.Clock` that moves the units to the next of `places` after each SLICE frames."""

    def __init__(self, core: Core, clock: RealtimeClock, processes: UnitProcesses, places: Sequence[Cores]) -> None:
        self._core, self._clock, self._processes, self._places = core, clock, processes, places
        self._scheduler_unit = core.graph.stages[0].unit
        self._begun: list[int] = []  # how many frames were presented when each place had its turn

    def wait(self, deadline_ns: int) -> tuple[int, tuple[Event, ...]]:
        presented = self._core.ledger.presented_count
        if len(self._begun) < len(self._places) and presented >= SLICE * len(self._begun):
            place = self._places[len(self._begun)]
            self._begun.append(presented)
            for unit, cores in place.items():
                self._processes.move(unit, cores)
            # The scheduler shares the cores of the first stage's unit, as it does in a run.
            os.sched_setaffinity(0, place[self._scheduler_unit])
        return self._clock.wait(deadline_ns)

    def perform(self, now_ns: int, actions: tuple[Action, ...]) -> None:
        self._clock.perform(now_ns, actions)

    def frame_ns(self) -> list[float]:
        """Return the mean time between presented frames of each place in ns, without its first SKIPPED frames."""
        presented_ns = self._core.ledger.presented_ns
        ends = [*self._begun[1:], SLICE * len(self._places)]
        spans = [(begin + SKIPPED, end) for begin, end in zip(self._begun, ends, strict=True)]
        return [(presented_ns[end - 1] - presented_ns[begin - 1]) / (end - begin) for begin, end in spans]
