"""Measures, before a run, what units need for a frame. Rule: frames go through in the order of a run, one at a time.

Every frame goes through all stages before the next one, and through the slots of an edge in turn. That matters because
the time of a stage depends on what it did last, on what its slot holds, and on how long it rested. Only time in which
the unit had its cores counts, because others may use the machine meanwhile.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from statistics import median
from typing import NamedTuple

from trilane.pipeline.controls import Interrupts
from trilane.pipeline.description import Pipeline
from trilane.pipeline.memory import Assets, edge_regions, share_assets
from trilane.pipeline.result import UnitError
from trilane.pipeline.unit_processes import START_S, UnitProcesses, listen_before_run, start_units
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.events import Graph, StageAlone
from trilane.scheduler.placement import Times, UnitWork
from trilane.transport.messages import Done, RunJob
from trilane.transport.slots import edge_rule
from trilane.unexpected_value import UnexpectedValue

WARM_UP = 2  # frames that do not count; most edges have as many slots
LIMIT_S = 0.5  # seconds after the warm-up from which no further frame is begun


class Chain:
    """The stages of `graph`, which must be a chain; the last stage is left out unless `whole`.

    `processes`: process of each unit, ready and without a job.
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
        """Let every stage do frame `number`, one stage after the other, and return their answers by stage.

        Raises UnitError when a stage fails or does not answer, and KeyboardInterrupt when interrupted.
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
    """Return the time that each stage of `follow` takes alone on each of `rungs` rungs of a ladder.

    Each time is the median over `frames`. All frames go through one rung before the next, so that no frame follows
    itself. With several frames, the first of each rung warms up. A stage is left out unless it takes less time on every
    further rung. Stages are left out, for example, if nobody is on the screen in any of the frames. Raises as
    `Chain.frame` does.
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
    """Measured times.

    `times`: work of each unit, by number of threads.
    `took_ns`: times of each frame in ns, by stage of the first pipeline.
    """

    times: Times
    took_ns: Mapping[str, Sequence[int]]


def rehearse(
    pipeline: Pipeline, variants: Sequence[Pipeline], frames: Sequence[int], assets: Assets, starter: UnitStarter
) -> Rehearsed:
    """Measure what each unit needs for a frame; the caller removes the files that the last stage writes.

    `pipeline`: pipeline whose units are all measured, on `frames`.
    `variants`: the same pipeline with other settings of some units; only these are measured again, between the other
    stages.
    `assets`, `starter`: arrays and fork server, as for a run.

    Raises TrilaneError when a unit cannot start or a stage fails, and KeyboardInterrupt when interrupted.
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
    """Return the answers of all stages to each of `frames` without the first WARM_UP.

    LIMIT_S holds for the frames that count. Of WARM_UP frames or fewer, only the last one counts.
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
    """Return the work of each unit for a frame: the sum over its stages of the median times in `done`."""
    works = {}
    for unit, settings in pipeline.units.items():
        names = [stage.name for stage in pipeline.stages_of(unit)]
        took_ns = [median(_took_ns(each[name]) for each in done) for name in names]
        cpu_ns = [median(each[name].cpu_ns for each in done) / settings.threads for name in names]
        core_ns = sum(map(min, cpu_ns, took_ns))
        works[unit] = UnitWork(round(sum(took_ns)), round(core_ns), len(names))
    return works


def _took_ns(done: Done) -> int:
    """Return how long a job took without the time in which it had no core, in ns."""
    return done.t_end_ns - done.t_begin_ns - done.preempted_ns
