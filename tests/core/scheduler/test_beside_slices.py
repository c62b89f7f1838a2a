"""Cores that are divided in equal shares, against a simulated kernel that gives slices: the frame times are as good.

Rule: a second implementation. The driver divides a core at every moment; here time goes by in steps, each core gives
its threads slices in turn, and each unit of each pipeline is a thread that does its jobs, the latest stage first.
"""

from __future__ import annotations

from random import Random
from typing import Any

import pytest

from trilane.hw_profiles.application import application_graph
from trilane.scheduler.events import Settings, Stop
from trilane.scheduler.shared_units import Member, simulate_beside

STEP_MS, SLOTS, MS = 0.1, 2, 1_000_000
SECONDS, WARM = 4.0, 10
#: ms of a frame's stages, as they were measured on a machine with two cores, at 256x256, 384x384 and 512x512.
SMALL, MIDDLE, LARGE = (3.6, 7.3, 8.4, 8.3, 3.6), (4.4, 12.3, 20.5, 11.7, 4.4), (3.9, 13.5, 33.0, 12.5, 3.9)
UNITS = ("cpu", "gpu", "dsp", "gpu", "cpu")
STAGES = ("pose", "raster", "infer", "composite", "present")
#: The rule for any run on two cores.
CORE = {"cpu": "0", "gpu": "0", "dsp": "1"}


class Thread:
    """A unit of a pipeline. `stage`: that it does now, -1 none."""

    def __init__(self, unit: str) -> None:
        self.unit, self.stage, self.left = unit, -1, 0.0


class SlicedPipeline:
    """Edges with two slots each, and three threads. `spread`: of a job's time."""

    def __init__(self, ms: tuple[float, ...], seed: int, spread: float) -> None:
        self.ms, self.random, self.spread = ms, Random(seed), spread
        self.full, self.taken = [0] * 4, [0] * 4
        self.threads = [Thread(unit) for unit in CORE]
        self.presented: list[float] = []

    def begin(self, thread: Thread) -> bool:
        """Whether the thread has a job now."""
        for stage in reversed(range(5)):
            has_input, has_slot = stage == 0 or self.full[stage - 1] > 0, stage == 4 or self.taken[stage] < SLOTS
            if UNITS[stage] == thread.unit and has_input and has_slot:
                thread.stage, thread.left = stage, self.ms[stage] * self.random.gauss(1, self.spread)
                if stage > 0:
                    self.full[stage - 1] -= 1
                if stage < 4:
                    self.taken[stage] += 1
                return True
        return False

    def end(self, thread: Thread, now_ms: float) -> None:
        stage, thread.stage = thread.stage, -1
        if stage > 0:
            self.taken[stage - 1] -= 1
        if stage == 4:
            self.presented.append(now_ms)
        else:
            self.full[stage] += 1


def sliced_ms(pipelines: list[SlicedPipeline], slice_ms: float) -> list[float]:
    """Mean frame time of each."""
    queues: dict[str, list[tuple[SlicedPipeline, Thread]]] = {"0": [], "1": []}
    ran = dict.fromkeys(queues, 0.0)
    for step in range(round(1e3 * SECONDS / STEP_MS)):
        for pipeline in pipelines:
            for thread in pipeline.threads:
                if thread.stage < 0 and pipeline.begin(thread):
                    queues[CORE[thread.unit]].append((pipeline, thread))
        for core, queue in queues.items():
            if not queue:
                continue
            pipeline, thread = queue[0]
            thread.left -= STEP_MS
            ran[core] += STEP_MS
            if thread.left <= 0:
                queue.pop(0)
                pipeline.end(thread, step * STEP_MS)
                ran[core] = 0.0
            elif ran[core] >= slice_ms:
                queue.append(queue.pop(0))
                ran[core] = 0.0
    return [(each.presented[-1] - each.presented[WARM]) / (len(each.presented) - 1 - WARM) for each in pipelines]


def member(ms: tuple[float, ...]) -> Member:
    """The same pipeline, each job of a stage with the same time."""
    times = {stage: round(each * MS) for stage, each in zip(STAGES, ms, strict=True)}
    stop: Any = ((round(SECONDS * 1e9), Stop()),)
    return Member(
        application_graph(), Settings(1 << 40, hang_ns=1 << 50), lambda name, *_: times[name], CORE, inputs=stop
    )


def computed_ms(first: tuple[float, ...], second: tuple[float, ...], divided: set[str]) -> list[float]:
    runs = simulate_beside([member(first), member(second)], divided=divided)
    return [run.report["frame_time_ms"]["mean"] for run in runs]


def simulated_ms(first: tuple[float, ...], second: tuple[float, ...], slice_ms: float) -> list[float]:
    return sliced_ms([SlicedPipeline(first, 1, 0.1), SlicedPipeline(second, 2, 0.1)], slice_ms)


@pytest.mark.parametrize(
    ("first", "second", "slice_ms"),
    [(SMALL, SMALL, 3.0), (SMALL, MIDDLE, 3.0), (SMALL, LARGE, 3.0), (MIDDLE, LARGE, 3.0), (SMALL, MIDDLE, 1.0)],
)
def test_equal_shares_are_nearly_what_slices_give(
    first: tuple[float, ...], second: tuple[float, ...], slice_ms: float
) -> None:
    """Within the tenth that is asked of a prediction of two pipelines."""
    assert computed_ms(first, second, {"0", "1"}) == pytest.approx(simulated_ms(first, second, slice_ms), rel=0.1)


def test_turns_to_the_end_of_each_job_are_not() -> None:
    """They give the pipeline with the longer jobs as many frames as the other one."""
    sliced, turns = simulated_ms(SMALL, LARGE, 3.0), computed_ms(SMALL, LARGE, set())
    assert sliced[1] / sliced[0] > 1.4
    assert turns[1] / turns[0] < 1.1


def test_alone_on_two_cores_the_fuller_one_decides() -> None:
    """Units of the first core need 22.8 ms a frame; a job ends with a step, which adds 0.05 ms to each of four."""
    (frame_ms,) = sliced_ms([SlicedPipeline(SMALL, 1, 0.0)], 1.0)
    assert 22.8 <= frame_ms <= 22.8 + 4 * STEP_MS
