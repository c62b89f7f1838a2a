"""Finds which stages had a unit's core while the unit had a job.

Rule: the kernel counted how long a job had no core. Which stage had it is computed from the jobs that ran then on cores
that both units may use. What no job of the run explains was another program, or a thread between jobs.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from trilane.scheduler.ledger import JobRecord

DELAY: Final = 256  # in jobs; all that ran beside a job have ended after as many further jobs


class Taken(NamedTuple):
    """Times of all jobs of a stage together, in ns.

    `of`: time that jobs of other stages took from them, by stage.
    `other_ns`: time without a core that no job of the run explains.
    """

    unit: str
    jobs: int
    service_ns: int
    preempted_ns: int
    of: Mapping[str, int]

    @property
    def other_ns(self) -> int:
        return self.preempted_ns - sum(self.of.values())


class Sharing:
    """Takes jobs in the order of their ends. `cores`: numbers of the cores of each unit; empty where not known."""

    def __init__(self, cores: Mapping[str, Sequence[int]], delay: int = DELAY) -> None:
        self._beside = {
            unit: [other for other in cores if other != unit and set(cores[other]) & set(own)]
            for unit, own in cores.items()
        }
        self._delay = delay
        self._waiting: deque[JobRecord] = deque()
        self._jobs: dict[str, list[JobRecord]] = {unit: [] for unit in cores}
        self._sums: dict[str, Taken] = {}

    def add(self, job: JobRecord) -> None:
        """Take the next job that has ended."""
        if self._beside.get(job.unit):
            of_unit = self._jobs[job.unit]
            of_unit.append(job)
            if len(of_unit) > 4 * self._delay:
                del of_unit[: 2 * self._delay]
        self._waiting.append(job)
        if len(self._waiting) > self._delay:
            self._count(self._waiting.popleft())

    def close(self) -> dict[str, Taken]:
        """Return who took how much from each stage, by stage; called after the last job."""
        while self._waiting:
            self._count(self._waiting.popleft())
        return self._sums

    def taken(self, unit: str, begin_ns: int, end_ns: int, lacked_ns: int) -> dict[str, int]:
        """Return, by stage, how long its jobs had the core that `unit` lacked for `lacked_ns` of a piece of time.

        The time is divided in proportion to how long the jobs ran then; no stage gets more than its jobs ran.
        """
        if not lacked_ns:
            return {}
        ran_ns: dict[str, int] = {}
        for other in self._beside.get(unit, ()):
            of_other = self._jobs[other]
            for job in of_other[bisect_right(of_other, begin_ns, key=_end_ns) :]:
                if job.begin_ns >= end_ns:
                    break
                ran_ns[job.stage] = ran_ns.get(job.stage, 0) + _within_ns(job, begin_ns, end_ns)
        total_ns = sum(ran_ns.values())
        of_others_ns = min(lacked_ns, total_ns)
        return {stage: of_others_ns * ns // total_ns for stage, ns in ran_ns.items() if ns}

    def _count(self, job: JobRecord) -> None:
        was = self._sums.get(job.stage, Taken(job.unit, 0, 0, 0, {}))
        taken = self.taken(job.unit, job.begin_ns, job.end_ns, job.preempted_ns)
        self._sums[job.stage] = Taken(
            job.unit,
            was.jobs + 1,
            was.service_ns + job.end_ns - job.begin_ns,
            was.preempted_ns + job.preempted_ns,
            {stage: was.of.get(stage, 0) + taken.get(stage, 0) for stage in {**was.of, **taken}},
        )


def _end_ns(job: JobRecord) -> int:
    return job.end_ns


def _within_ns(job: JobRecord, begin_ns: int, end_ns: int) -> int:
    """Return how long `job` ran between two times, without its share of time in which it had no core or slept."""
    ns = min(job.end_ns, end_ns) - max(job.begin_ns, begin_ns)
    length_ns = job.end_ns - job.begin_ns
    return ns * max(length_ns - job.preempted_ns - job.asleep_ns, 0) // length_ns if ns > 0 else 0
