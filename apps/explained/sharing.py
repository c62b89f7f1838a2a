"""Who had a unit's core while it had a job: units that share cores, named.

Rule: how long a job had no core the kernel counted; that another unit had it follows from which jobs ran then on the
cores that both may use, so it is computed. What no job of the run explains was another program, or a thread between
jobs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from trilane.scheduler.ledger import JobRecord

DELAY: Final = 256  # jobs; of those that ran beside a job all have ended by then


class Taken(NamedTuple):
    """Of a stage's jobs together, ns. `of`: by unit, what was taken by its jobs. `other_ns`: by nobody of the run."""

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
        self._kept: deque[JobRecord] = deque(maxlen=2 * delay)
        self._sums: dict[str, Taken] = {}

    def add(self, job: JobRecord) -> None:
        """The next job that has ended."""
        self._kept.append(job)
        self._waiting.append(job)
        if len(self._waiting) > self._delay:
            self._count(self._waiting.popleft())

    def close(self) -> dict[str, Taken]:
        """After the last job: of each stage, who took how much."""
        while self._waiting:
            self._count(self._waiting.popleft())
        return self._sums

    def taken(self, job: JobRecord) -> dict[str, int]:
        """By unit, how long its jobs had the core that `job` lacked: in proportion to how long they ran then."""
        if not job.preempted_ns:
            return {}
        ran_ns: dict[str, int] = {}
        for other in self._kept:
            if other.unit in self._beside.get(job.unit, ()):
                ran_ns[other.unit] = ran_ns.get(other.unit, 0) + _beside_ns(job, other)
        total_ns = sum(ran_ns.values())
        of_others_ns = min(job.preempted_ns, total_ns)
        return {unit: of_others_ns * ns // total_ns for unit, ns in ran_ns.items() if ns}

    def _count(self, job: JobRecord) -> None:
        was = self._sums.get(job.stage, Taken(job.unit, 0, 0, 0, {}))
        taken = self.taken(job)
        self._sums[job.stage] = Taken(
            job.unit,
            was.jobs + 1,
            was.service_ns + job.end_ns - job.begin_ns,
            was.preempted_ns + job.preempted_ns,
            {unit: was.of.get(unit, 0) + taken.get(unit, 0) for unit in {**was.of, **taken}},
        )


def _beside_ns(job: JobRecord, other: JobRecord) -> int:
    """How long `other` ran within `job`, without its share of time in which it had no core either."""
    ns = min(job.end_ns, other.end_ns) - max(job.begin_ns, other.begin_ns)
    if ns <= 0:
        return 0
    length_ns = other.end_ns - other.begin_ns
    return ns * max(length_ns - other.preempted_ns - other.asleep_ns, 0) // length_ns
