"""Measures units before a run: their work for a frame (rehearsal), and the fastest placement (trial).

The rehearsal measures the work of each unit for a frame. Rule: frames go through the stages in the order of a run, one
frame at a time.

Every frame goes through all stages before the next frame begins, and the slots of an edge are used in turn. This
matters: the time of a stage depends on its last frame, the content of its slot, and how long the stage has rested.
Only time in which the unit had its cores counts, because other programs may use the machine.

The trial measures the frame times of a few placements. Rule: placements run in turns, a few frames each, and all do the
same frames.

Running units are moved from the cores of one placement to the cores of the next, while frames go through them. A turn
of a placement takes a fraction of a second. Therefore a disturbance that lasts a second slows all placements alike. In
separate runs, the machine may change by more than two placements differ. Placements with other numbers of threads need
processes of their own, which are idle while other placements have their turn.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from statistics import median
from typing import Final, NamedTuple

from trilane.machine import awake
from trilane.pipeline.controls import Interrupts
from trilane.pipeline.description import Pipeline
from trilane.pipeline.memory import Assets, edge_regions, share_assets
from trilane.pipeline.realtime_clock import RealtimeClock
from trilane.pipeline.result import Failure, RunLog, UnitError
from trilane.pipeline.surroundings import OtherPrograms, on_cores, prompt_answers, unit_processes
from trilane.pipeline.unit_processes import START_S, UnitProcesses, listen_before_run, start_units
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.core import Core, run_loop
from trilane.scheduler.events import Action, Event, Graph, StageAlone
from trilane.scheduler.placement import Times, UnitWork
from trilane.scheduler.policy import run_settings
from trilane.transport.messages import Done, Message, RunJob
from trilane.transport.slots import edge_rule
from trilane.unexpected_value import UnexpectedValue

WARM_UP = 2  # first frames, which do not count; most edges have two slots
LIMIT_S = 0.5  # seconds after the warm-up after which no further frame begins


class Chain:
    """Sends single frames through the stages of `graph`. Raises UnexpectedValue if it is no chain.

    `processes`: for each unit, the `UnitProcesses` with the unit's process, which must be ready and have no job.
    `interrupts`: signals, which end the wait for an answer.
    `whole`: whether the last stage, which may write files, takes part.
    """

    def __init__(
        self, graph: Graph, processes: Mapping[str, UnitProcesses], interrupts: Interrupts, *, whole: bool
    ) -> None:
        if not graph.is_chain:
            raise UnexpectedValue("a graph", "a chain", "the stages of a graph may count their calls")
        self._stages = graph.stages if whole else graph.stages[:-1]
        self._slots = [edge_rule(edge).slots for edge in graph.edges]
        self._processes, self._interrupts = processes, interrupts
        self._frames = self._jobs = 0

    def frame(self, number: int, rung: int = 0) -> dict[str, Done]:
        """Let every stage do frame `number`, one stage after the other, and return the units' answers by stage.

        `rung`: rung of the frame's work.

        Raises UnitError if a stage fails or does not answer, and KeyboardInterrupt when interrupted.
        """
        slots = [-1, *(self._frames % count for count in self._slots), -1]
        self._frames += 1
        found = {}
        for place, stage in enumerate(self._stages):
            self._jobs += 1
            processes = self._processes[stage.unit]
            position, since_ns = processes.places[stage.name], time.monotonic_ns()
            slot_in, slot_out = slots[place : place + 2]
            job = RunJob(self._jobs, position, number, slot_in, slot_out, 0, since_ns, fresh=1, rung=rung)
            processes.send(stage.unit, job)
            found[stage.name] = self._answer(stage.unit, processes)
        return found

    def _answer(self, unit: str, processes: UnitProcesses) -> Done:
        end = time.monotonic() + START_S
        while time.monotonic() < end:
            for name, message in listen_before_run(processes, self._interrupts):
                if name == unit and isinstance(message, Done):
                    return message
        raise UnitError(f"unit {unit} did not end a job within {START_S:.0f} s")


def on_rungs(chain: Chain, frames: Sequence[int], rungs: int, follow: Sequence[str]) -> list[StageAlone]:
    """Return the isolated time of each stage of `follow` on each rung of a ladder of work.

    Rung 0 is all the work; each further rung is a smaller share of it.

    Each time is the median over `frames`. All frames are done on one rung before the next rung, so that no stage does
    the same frame twice in a row. With several frames, the first frame of each rung warms up and does not count. A
    stage that is not faster on each further rung is left out, for example if nobody is on the screen in these frames.

    `frames`: numbers of the frames that are done.
    `rungs`: number of rungs.
    `follow`: names of the stages whose time follows the work.

    Raises as `Chain.frame` does.
    """
    medians: dict[str, list[float]] = {name: [] for name in follow}
    for rung in range(rungs):
        done = [chain.frame(frame, rung) for frame in frames]
        for name, of_rungs in medians.items():
            of_rungs.append(median(_took_ns(each[name]) for each in (done[1:] or done)))
    return [
        StageAlone(name, rung, round(ns))
        for name, of_rungs in medians.items()
        if all(more > less for more, less in pairwise(of_rungs))
        for rung, ns in enumerate(of_rungs)
    ]


class Rehearsed(NamedTuple):
    """The results of a rehearsal.

    `times`: work of each unit, by the unit's name and number of threads.
    `took_ns`: for each stage, the time of its job in ns in each frame that counts, with the settings of `pipeline`.
    """

    times: Times
    took_ns: Mapping[str, Sequence[int]]


def rehearse(
    pipeline: Pipeline, variants: Sequence[Pipeline], frames: Sequence[int], assets: Assets, starter: UnitStarter
) -> Rehearsed:
    """Measure the work of each unit for a frame. The caller must remove the files that the last stage writes.

    `pipeline`: pipeline whose units are all measured.
    `variants`: the same pipeline with other settings of some units; only these units are measured again.
    `frames`: numbers of the frames that are done.
    `assets`, `starter`: arrays and fork server, as for a run.

    Raises TrilaneError if a unit cannot start or a stage fails, and KeyboardInterrupt when interrupted.
    """
    with contextlib.ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts())
        assets_fd = share_assets(assets)
        stack.callback(os.close, assets_fd)
        regions = stack.enter_context(edge_regions(pipeline))

        @contextlib.contextmanager
        def running(described: Pipeline, units: Sequence[str]) -> Iterator[dict[str, UnitProcesses]]:
            with contextlib.closing(UnitProcesses(described, regions, assets_fd, starter)) as processes:
                start_units(processes, units, interrupts)
                yield dict.fromkeys(units, processes)

        first = stack.enter_context(running(pipeline, list(pipeline.units)))
        done = timed(Chain(pipeline.graph(), first, interrupts, whole=True), frames)
        took_ns = {stage.name: [_took_ns(each[stage.name]) for each in done] for stage in pipeline.stages}
        works = works_of(pipeline, done)
        found = {unit: {pipeline.units[unit].threads: work} for unit, work in works.items()}
        for variant in variants:
            changed = [unit for unit, settings in variant.units.items() if settings != pipeline.units[unit]]
            with running(variant, changed) as again:
                chain = Chain(pipeline.graph(), {**first, **again}, interrupts, whole=True)
                works = works_of(variant, timed(chain, frames))
            for unit in changed:
                found[unit][variant.units[unit].threads] = works[unit]
        return Rehearsed(found, took_ns)


def timed(chain: Chain, frames: Sequence[int]) -> list[dict[str, Done]]:
    """Send `frames` through the chain; return the units' answers by stage, for each frame that counts.

    The first WARM_UP frames do not count. If there are no further frames, the last frame counts. No frame begins later
    than LIMIT_S after the warm-up.
    """
    warm_up = min(WARM_UP, len(frames) - 1)
    for frame in frames[:warm_up]:
        chain.frame(frame)
    end, done = time.monotonic() + LIMIT_S, list[dict[str, Done]]()
    for frame in frames[warm_up:]:
        if done and time.monotonic() > end:
            break
        done.append(chain.frame(frame))
    return done


def works_of(pipeline: Pipeline, done: Sequence[Mapping[str, Done]]) -> dict[str, UnitWork]:
    """Return the work of each unit for a frame: the sum of the median times of the unit's stages.

    `done`: for each frame, the units' answers by stage.
    """
    works = {}
    for unit, settings in pipeline.units.items():
        names = [stage.name for stage in pipeline.stages_of(unit)]
        took_ns = [median(_took_ns(each[name]) for each in done) for name in names]
        cpu_ns = [median(each[name].cpu_ns for each in done) / settings.threads for name in names]
        core_ns = sum(map(min, cpu_ns, took_ns))
        works[unit] = UnitWork(round(sum(took_ns)), round(core_ns), len(names))
    return works


def _took_ns(done: Done) -> int:
    """Return the time of a job in ns, without the time in which it had no core."""
    return done.t_end_ns - done.t_begin_ns - done.preempted_ns


SLICE: Final = 16  # frames of a placement in its turn
SKIPPED: Final = 6  # first frames of a slice, which do not count: they were in flight when the units were moved
DRAIN: Final = 6  # frames after the last slice, so that the pipeline does not run empty during the slice
PERIOD_NS: Final = 33_333_333

#: The cores of each unit.
Cores = Mapping[str, tuple[int, ...]]


class Group(NamedTuple):
    """Placements with the same numbers of threads. The same processes can do all of them.

    `pipeline`: pipeline of these processes; the cores in its settings do not matter.
    `places`: for each placement, the cores of each unit.
    """

    pipeline: Pipeline
    places: Sequence[Cores]


class Round(NamedTuple):
    """The result of one turn of every placement.

    `frame_ns`: mean frame time of each placement in ns, in the order of the groups and of their placements.
    `others`: share of the cores' time that other programs had (`OtherPrograms.share`).
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
    """Run the placements in turns, and return the measured rounds: one for each of `windows`, or fewer.

    `groups`: placements to try. Within a group, each round begins with another placement.
    `windows`: for each round, the number of the first of the SLICE frames that every placement does.
    `assets`, `starter`: arrays and fork server, as for a run.
    `is_enough`: function that takes the rounds so far, and returns whether to end here.

    Raises TrilaneError if a unit cannot start or a stage fails, and KeyboardInterrupt when interrupted.
    """
    rounds: list[Round] = []
    cores = sorted({core for group in groups for place in group.places for own in place.values() for core in own})
    with contextlib.ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts())
        stack.enter_context(prompt_answers())
        stack.enter_context(awake())
        stack.enter_context(on_cores(tuple(cores)))
        lives = []
        for group in groups:
            processes = stack.enter_context(unit_processes(group.pipeline, assets, starter, _Replaying))
            start_units(processes, list(group.pipeline.units), interrupts)
            lives.append(_Live(group, processes, interrupts))
        for turn, first in enumerate(windows):
            others = OtherPrograms(cores, [pid for live in lives for pid in live.pids])
            frame_ns = tuple(ns for live in lives for ns in live.one_round(turn, first))
            rounds.append(Round(frame_ns, others.share()))
            if is_enough(rounds):
                break
    return rounds


class _Replaying(UnitProcesses):
    """Units that do the same SLICE frames of the scene again and again. `first`: number of the first frame."""

    first = 0

    def send(self, unit: str, message: Message) -> None:
        if isinstance(message, RunJob):
            message = message._replace(frame=self.first + message.frame % SLICE)
        super().send(unit, message)


class _Live:
    """A `Group` together with its running processes."""

    def __init__(self, group: Group, processes: _Replaying, interrupts: Interrupts) -> None:
        self._group, self._processes, self._interrupts = group, processes, interrupts

    @property
    def pids(self) -> list[int]:
        return list(self._processes.pids.values())

    def one_round(self, turn: int, first: int) -> list[float]:
        """Let every placement of the group have one turn, and return their mean frame times in ns.

        `turn`: index of the placement that begins, modulo the number of placements.
        `first`: number of the first of the SLICE frames that every placement does.

        Raises UnitError if a frame is lost, and KeyboardInterrupt when interrupted.
        """
        count = len(self._group.places)
        order = [(turn + number) % count for number in range(count)]
        self._processes.first = first
        settings = run_settings("pipelined", SLICE * count + DRAIN, PERIOD_NS)
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
    """A `Clock` that moves the units to the next of `places` whenever SLICE frames are presented."""

    def __init__(self, core: Core, clock: RealtimeClock, processes: UnitProcesses, places: Sequence[Cores]) -> None:
        self._core, self._clock, self._processes, self._places = core, clock, processes, places
        self._scheduler_unit = core.graph.stages[0].unit
        self._begun: list[int] = []  # number of frames that were presented when each placement's turn began

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
        """Return the mean frame time of each placement in ns, without the first SKIPPED frames of its turn."""
        presented_ns = self._core.ledger.presented_ns
        ends = [*self._begun[1:], SLICE * len(self._places)]
        spans = [(begin + SKIPPED, end) for begin, end in zip(self._begun, ends, strict=True)]
        return [(presented_ns[end - 1] - presented_ns[begin - 1]) / (end - begin) for begin, end in spans]
