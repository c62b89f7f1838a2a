"""What a unit's process measures around its jobs. Rule: every ns from one job's end to the next one's is in one piece.

A piece is a job, or the time between two jobs. The files of the kernel are read between jobs, so that a service time
has nothing of it but one look at the CPU clock, about a microsecond.
"""

from __future__ import annotations

import time
from typing import NamedTuple

from trilane.pipeline.core_meter import CoreMeter
from trilane.pipeline.core_shares import lost_in_job, preempted_ns


class JobTimes(NamedTuple):
    """Of a job; the fields mean what they mean in `trilane.transport.messages.Done`."""

    begin_ns: int
    end_ns: int
    preempted_ns: int
    asleep_ns: int
    preempted_before_ns: int
    cpu_ns: int
    cpu_before_ns: int


class JobClock:
    """For a unit with `cores` cores. `meter`: counts for its process."""

    def __init__(self, meter: CoreMeter, cores: int) -> None:
        self._meter, self._cores = meter, cores
        self._begin_ns = self._end_ns = self._cpu_before_ns = self._preempted_before_ns = 0
        self.restart()

    def restart(self) -> None:
        """The time between two jobs begins now, with the threads that there are."""
        self._meter.look()
        self._meter.delay_ns()
        self._meter.cpu_ns()
        self._end_ns = time.monotonic_ns()

    def begin(self) -> None:
        """A job begins."""
        delay_ns = self._meter.delay_ns()
        cpu_ns = self._cpu_before_ns = self._meter.cpu_ns()
        self._preempted_before_ns = preempted_ns(time.monotonic_ns() - self._end_ns, cpu_ns, delay_ns, self._cores)
        self._begin_ns = time.monotonic_ns()

    def end(self, works_asleep: bool) -> JobTimes:
        """The job has ended. `works_asleep`: it went on while its threads slept."""
        cpu_ns = self._meter.cpu_ns()
        end_ns = self._end_ns = time.monotonic_ns()
        delay_ns = self._meter.delay_ns()
        lost = lost_in_job(end_ns - self._begin_ns, cpu_ns, delay_ns, self._cores, works_asleep)
        before = self._preempted_before_ns
        return JobTimes(self._begin_ns, end_ns, *lost, before, cpu_ns, self._cpu_before_ns)

    def look(self) -> None:
        """Find the threads that the last job began or ended: to be called when its end has been told."""
        self._meter.look()
