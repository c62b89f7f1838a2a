"""The service time of each stage while the other units are quiet. Rule: measured on the run's own processes and slots.

The last stage is not measured: it may write files. Efficiency needs these times.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise
from statistics import fmean, median

from trilane.pipeline.lifecycle import START_S, listen_before_run
from trilane.pipeline.run_log import UnitError
from trilane.pipeline.signals import Interrupts
from trilane.pipeline.unit_processes import UnitProcesses
from trilane.scheduler.events import Graph, StageAlone
from trilane.transport.job_pipe import PACKETS
from trilane.transport.messages import Duration, RunIsolated

LIMIT_S = 10.0  # no further frame is begun after this
REPEATS = 2
AT_ONCE = PACKETS - 4  # of the messages that a job pipe holds; the others are for what else may be under way


class IsolatedTimes:
    """Fills `mean_ns` by calls of `measure`. The units must be ready and without a job."""

    def __init__(self, graph: Graph, processes: UnitProcesses, interrupts: Interrupts) -> None:
        self._graph, self._processes, self._interrupts = graph, processes, interrupts
        self._times_ns: dict[str, list[float]] = defaultdict(list)

    @property
    def mean_ns(self) -> dict[str, float]:
        """Mean service time in ns of each stage that was measured."""
        return {stage: fmean(times) for stage, times in self._times_ns.items()}

    def measure(self, frames: list[int]) -> None:
        """Do `frames`, and note what their jobs take.

        Each frame goes down the chain through the first slot of every edge; then each unit repeats its stages in turn
        and without a pause, as it meets them in a pipelined run. The first repetition follows a pause and does not
        count. Raises UnitError when a stage fails, KeyboardInterrupt when interrupted.
        """
        end = time.monotonic() + LIMIT_S
        chain = self._graph.stages[:-1]
        for frame in frames:
            if frame != frames[0] and time.monotonic() > end:
                break
            for position, stage in enumerate(chain):
                self._durations_ns(stage.unit, [position], frame)
            for unit in self._graph.units:
                own = [position for position, stage in enumerate(chain) if stage.unit == unit]
                times = self._durations_ns(unit, own * (1 + REPEATS), frame)[len(own) :]
                for index, position in enumerate(own):
                    self._times_ns[chain[position].name].append(median(times[index :: len(own)]))

    def of_rungs(self, frames: Sequence[int], rungs: int, follow: Sequence[str]) -> list[StageAlone]:
        """What each stage of `follow` takes, alone, on each of so many `rungs` of a ladder: the most of `frames`.

        Nothing is said of one that does not take less on every further rung, such as where nobody is on the screen in
        any of the frames. Raises as `measure`.
        """
        chain = self._graph.stages[:-1]
        times = {name: [0] * rungs for name in follow}
        for frame in frames:
            for rung in range(rungs):
                for position, stage in enumerate(chain):
                    repeats = REPEATS if stage.name in follow else 0
                    took = min(self._durations_ns(stage.unit, [position] * (1 + repeats), frame, rung)[-REPEATS:])
                    if stage.name in follow:
                        times[stage.name][rung] = max(times[stage.name][rung], took)
        return [
            StageAlone(name, rung, ns)
            for name, of_rungs in times.items()
            if all(more > less for more, less in pairwise(of_rungs))
            for rung, ns in enumerate(of_rungs)
        ]

    def _durations_ns(self, unit: str, positions: list[int], frame: int, rung: int = 0) -> list[int]:
        """Of jobs of the unit's stages at `positions`, as many handed to it at once as its pipe holds."""
        durations: list[int] = []
        for first in range(0, len(positions), AT_ONCE):
            batch = positions[first : first + AT_ONCE]
            for position in batch:
                place = self._processes.places[self._graph.stages[position].name]
                self._processes.send(unit, RunIsolated(place, frame, 0 if position else -1, 0, rung))
            durations += self._answers(unit, len(batch))
        return durations

    def _answers(self, unit: str, count: int) -> list[int]:
        durations: list[int] = []
        end = time.monotonic() + START_S
        while len(durations) < count:
            if time.monotonic() > end:
                raise UnitError(f"unit {unit} did not end its jobs within {START_S:.0f} s")
            messages = listen_before_run(self._processes, self._interrupts)
            durations += [message.value for name, message in messages if name == unit and isinstance(message, Duration)]
        return durations
