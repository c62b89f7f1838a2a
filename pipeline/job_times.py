"""Measures in a unit's process what happens around its jobs.

Rule: the kernel is asked where no frame waits for the answer.

A piece of time is a job, or the time between two jobs. Every ns of CPU time is in one piece. Run delay is read after
the answer to a job, and before the answer only if the job may have lost more than LOSS_NS. Before a job something is
read in three cases only:
- the unit has had the job for longer than HELD_NS;
- its stage's last job lost time;
- other threads may have run between the jobs.

docs/decisions/preempted-time.md says what the two thresholds can hide.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, Protocol

from trilane.pipeline.core_shares import lost_in_job, most_preempted_ns, preempted_ns
from trilane.transport.messages import Done

LOSS_NS: Final = 20_000
HELD_NS: Final = 100_000  # longer than a hand-over takes
JOBS_PER_LOOK: Final = 64  # jobs between two searches for new threads, where no job loses time


class Meter(Protocol):
    """The part of `trilane.pipeline.core_meter.CoreMeter` that a `JobClock` uses."""

    @property
    def threads(self) -> int: ...

    def cpu_ns(self) -> int: ...

    def delay_ns(self) -> int: ...

    def look(self) -> None: ...


class JobClock:
    """Measures the jobs of a unit with `cores` cores and `stages` stages.

    `meter`: counts of the unit's process.
    `now_ns`: function that returns the time in ns.
    """

    def __init__(self, meter: Meter, cores: int, stages: int, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._meter, self._cores, self._now_ns = meter, cores, now_ns
        self._loses = [False] * stages  # whether the stage's last job may have lost more than LOSS_NS
        self._used_cores = 1  # most cores that the present threads use at a time
        self._stage = self._jobs = 0
        self._begin_ns = self._end_ns = self._cpu_ns = self._cpu_before_ns = 0
        self._preempted_ns = self._asleep_ns = self._preempted_before_ns = 0
        self._delay_before_ns = 0  # run delay since the last job's end, as far as it was read
        self._was_read = False  # whether the run delay was read at the last job's end
        self._knows_cpu = True  # whether the CPU time of the time before the job is known
        self._has_one_thread = False
        self.restart()

    def restart(self) -> None:
        """Begin the time between two jobs now, with the threads that exist."""
        self._look()
        self._meter.delay_ns()
        self._meter.cpu_ns()
        self._delay_before_ns = self._cpu_before_ns = 0
        self._end_ns = self._now_ns()

    def begin(self, stage: int, dispatch_ns: int) -> None:
        """Note that a job of the unit's `stage`-th stage begins, which was dispatched at `dispatch_ns`."""
        self._stage = stage
        begin_ns = self._now_ns()
        is_long = begin_ns - max(dispatch_ns, self._end_ns) > HELD_NS
        self._knows_cpu = is_long or self._loses[stage] or not self._has_one_thread
        if self._knows_cpu:
            if is_long or self._loses[stage]:
                self._delay_before_ns += self._meter.delay_ns()
            self._cpu_before_ns += self._meter.cpu_ns()
            begin_ns = self._now_ns()
        gap_ns = begin_ns - self._end_ns
        self._preempted_before_ns = preempted_ns(gap_ns, self._cpu_before_ns, self._delay_before_ns, self._cores)
        self._begin_ns = begin_ns

    def end(self, works_asleep: bool) -> None:
        """Note that the job has ended. `works_asleep`: whether it went on while its threads slept."""
        cpu_ns = self._meter.cpu_ns()
        end_ns = self._end_ns = self._now_ns()
        wall_ns = end_ns - self._begin_ns
        if not self._knows_cpu and cpu_ns > wall_ns:  # one thread cannot have more
            self._cpu_before_ns += cpu_ns - wall_ns
            cpu_ns = wall_ns
        self._cpu_ns = cpu_ns
        loses = most_preempted_ns(wall_ns, cpu_ns, self._used_cores) > LOSS_NS
        self._was_read = self._loses[self._stage] = loses
        delay_ns = self._meter.delay_ns() if loses else 0
        self._preempted_ns, self._asleep_ns = lost_in_job(wall_ns, cpu_ns, delay_ns, self._cores, works_asleep)

    def done(self, job_id: int, sampled_ns: int, metrics: dict[str, float], skips: bool = False) -> Done:
        """Return the answer to the job that has ended. `skips`: whether its frame takes the bypass."""
        lost = (self._preempted_ns, self._asleep_ns, self._preempted_before_ns)
        times = (self._begin_ns, self._end_ns, sampled_ns, *lost, int(skips), self._cpu_ns, self._cpu_before_ns)
        return Done(job_id, *times, metrics)

    def answered(self) -> None:
        """Read what took place in the job and since; called after the answer was sent.

        This thread did not sleep since the job's end, so a delay that may be the job's counts at most the time since.
        """
        delay_ns = self._meter.delay_ns()
        self._cpu_before_ns = self._meter.cpu_ns()
        self._delay_before_ns = delay_ns if self._was_read else min(delay_ns, self._now_ns() - self._end_ns)
        self._jobs += 1
        if self._was_read or self._jobs % JOBS_PER_LOOK == 0:
            self._look()

    def _look(self) -> None:
        self._meter.look()
        self._used_cores = min(self._cores, max(self._meter.threads, 1))
        self._has_one_thread = self._meter.threads == 1
