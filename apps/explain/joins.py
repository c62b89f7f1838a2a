"""What stages with several inputs waited for: which input of each frame came last, and how long after the others.

Rule: an input came when the job that wrote it ended. Inputs of the newest frame are not waited for.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, Final

from trilane.pipeline.timeline import ExplainedJob
from trilane.scheduler.events import Graph
from trilane.units import NS_PER_MS

KEPT: Final = 1024  # frames whose ends are kept for each stage; far more than can be in flight


class Joins:
    """Takes the jobs of a run in the order of their ends."""

    def __init__(self, graph: Graph) -> None:
        reads = {stage.name: graph.inputs_of(place) for place, stage in enumerate(graph.stages)}
        by_frame = {name: [each.stage for each in inputs if not each.latest] for name, inputs in reads.items()}
        self._reads = {name: read for name, read in by_frame.items() if len(read) > 1}
        self._ends: dict[str, dict[int, int]] = {name: {} for read in self._reads.values() for name in read}
        self._last = {name: Counter[str]() for name in self._reads}
        self._after_ns = {name: Counter[str]() for name in self._reads}

    def add(self, explained: ExplainedJob) -> None:
        """Take the next job that has ended."""
        job = explained.job
        if read := self._reads.get(job.stage):
            ends = sorted((self._ends[name].get(job.frame, -1), name) for name in read)
            if ends[0][0] >= 0:
                self._last[job.stage][ends[-1][1]] += 1
                self._after_ns[job.stage][ends[-1][1]] += ends[-1][0] - ends[-2][0]
        if (kept := self._ends.get(job.stage)) is not None:
            kept[job.frame] = job.end_ns
            if len(kept) > KEPT:
                del kept[next(iter(kept))]

    def rows(self) -> list[dict[str, Any]]:
        """Return, for each stage that joins, in how many jobs each input came last, and how long after the others."""
        return [
            {
                "stage": stage,
                "inputs": {
                    name: {"last": last[name], "after_ms": self._after_ns[stage][name] / max(last[name], 1) / NS_PER_MS}
                    for name in self._reads[stage]
                },
            }
            for stage, last in self._last.items()
        ]


def said(row: dict[str, Any]) -> str:
    """Return a sentence on a row of `Joins.rows`: what the stage waited for, what was last most often first."""
    inputs = sorted(row["inputs"].items(), key=lambda each: -each[1]["last"])
    jobs = sum(each["last"] for _, each in inputs)
    found = [
        f"for {name} in {each['last']} of {jobs} jobs, {each['after_ms']:.2f} ms after the others"
        for name, each in inputs
        if each["last"]
    ]
    never = [name for name, each in inputs if not each["last"]]
    rest = f"; never for {', '.join(never)}" if never else ""
    return f"{row['stage']} waited {'; '.join(found) or 'for nothing'}{rest}"
