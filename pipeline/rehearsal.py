"""What each unit needs for a frame, measured before the run. Rule: one unit works at a time, and its files are lost.

The caller gives a pipeline whose files go to a folder that is thrown away, so that the last stage is measured too. What
counts is time in which the unit had its cores: others may use the machine meanwhile.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Sequence
from statistics import fmean

from trilane.pipeline.description import Pipeline
from trilane.pipeline.lifecycle import START_S, listen_before_run, start_units
from trilane.pipeline.regions import edge_regions
from trilane.pipeline.run_log import UnitError
from trilane.pipeline.shared_assets import Assets, share_assets
from trilane.pipeline.signals import Interrupts
from trilane.pipeline.unit_processes import UnitProcesses
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.places import Work
from trilane.transport.messages import Done, RunJob

REPEATS = 3  # of a stage for each frame, after one that warms up; the shortest counts
LIMIT_S = 0.5  # no further frame is begun after this


def rehearse(
    pipeline: Pipeline, variants: Sequence[Pipeline], frames: Sequence[int], assets: Assets, starter: UnitStarter
) -> dict[str, dict[int, Work]]:
    """Unit, then threads, to its work for a frame.

    `pipeline`: of whose units all are measured, with the mean over `frames`.
    `variants`: the same with other settings of some units, which alone are measured again, with the last of the frames.
    `assets`, `starter`: as for a run.
    Raises TrilaneError when a unit cannot start or a stage fails, KeyboardInterrupt when interrupted.
    """
    with contextlib.ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts())
        assets_fd = share_assets(assets)
        stack.callback(os.close, assets_fd)
        regions = stack.enter_context(edge_regions(pipeline))

        @contextlib.contextmanager
        def running(described: Pipeline, units: Sequence[str]) -> Iterator[_Rehearsal]:
            with contextlib.closing(UnitProcesses(described, regions, assets_fd, starter)) as processes:
                start_units(processes, units, interrupts)
                yield _Rehearsal(described, processes, interrupts)

        with running(pipeline, list(pipeline.units)) as first:
            works, last = first.measure(frames)
        found = {unit: {pipeline.units[unit].threads: work} for unit, work in works.items()}
        for variant in variants:
            changed = [unit for unit, settings in variant.units.items() if settings != pipeline.units[unit]]
            with running(variant, changed) as again:
                for unit in changed:
                    other = again.work_of(unit, last)
                    threads = variant.units[unit].threads
                    found[unit][threads] = _in_proportion(works[unit], first.works[unit, last], other)
        return found


def _in_proportion(mean: Work, before: Work, after: Work) -> Work:
    """`mean` of some frames, where one of them took `before` and now takes `after`."""
    serial_ns = mean.serial_ns * after.serial_ns // max(before.serial_ns, 1)
    core_ns = mean.core_ns * after.core_ns // max(before.core_ns, 1)
    return Work(serial_ns, core_ns, mean.jobs)


class _Rehearsal:
    """Jobs of the units of `pipeline`, one at a time, through the first slot of every edge."""

    def __init__(self, pipeline: Pipeline, processes: UnitProcesses, interrupts: Interrupts) -> None:
        self._pipeline, self._processes, self._interrupts = pipeline, processes, interrupts
        self._jobs = 0
        self.works: dict[tuple[str, int], Work] = {}

    def measure(self, frames: Sequence[int]) -> tuple[dict[str, Work], int]:
        """The mean work of each unit, and the last of the frames that were done."""
        end, done = time.monotonic() + LIMIT_S, list[int]()
        while len(done) < len(frames) and (not done or time.monotonic() < end):
            done.append(frames[len(done)])
            for stage in self._pipeline.stages:
                self._run(stage.name, done[-1])
            for unit in self._pipeline.units:
                self.works[unit, done[-1]] = self.work_of(unit, done[-1])
        return {unit: self._mean(unit, done) for unit in self._pipeline.units}, done[-1]

    def work_of(self, unit: str, frame: int) -> Work:
        """The unit's stages on what their input slots hold."""
        stages = self._pipeline.stages_of(unit)
        rounds = [[self._run(stage.name, frame) for stage in stages] for _ in range(1 + REPEATS)]
        shortest = [min(round_[place] for round_ in rounds[1:]) for place in range(len(stages))]
        return Work(sum(ns for ns, _ in shortest), sum(ns for _, ns in shortest), len(stages))

    def _mean(self, unit: str, frames: Sequence[int]) -> Work:
        works = [self.works[unit, frame] for frame in frames]
        serial_ns, core_ns = (round(fmean(work[field] for work in works)) for field in range(2))
        return Work(serial_ns, core_ns, len(self._pipeline.stages_of(unit)))

    def _run(self, name: str, frame: int) -> tuple[int, int]:
        """How long a job took without the time in which it had no core, and its CPU time for each thread."""
        position = next(place for place, stage in enumerate(self._pipeline.stages) if stage.name == name)
        unit, is_last = self._pipeline.stages[position].unit, position == len(self._pipeline.stages) - 1
        slots = (0 if position else -1, -1 if is_last else 0)
        self._jobs += 1
        now_ns = time.monotonic_ns()
        job = RunJob(self._jobs, self._processes.places[name], frame, *slots, epoch=0, t_dispatch_ns=now_ns, fresh=1)
        self._processes.send(unit, job)
        done = self._answer(unit)
        took_ns = done.t_end_ns - done.t_begin_ns - done.preempted_ns
        return took_ns, min(done.cpu_ns // self._pipeline.units[unit].threads, took_ns)

    def _answer(self, unit: str) -> Done:
        end = time.monotonic() + START_S
        while time.monotonic() < end:
            for name, message in listen_before_run(self._processes, self._interrupts):
                if name == unit and isinstance(message, Done):
                    return message
        raise UnitError(f"unit {unit} did not end a job within {START_S:.0f} s")
