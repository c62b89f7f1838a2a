"""Measures the jobs of a unit in the unit's process: times by the kernel, and counts by the processor.

Rule for times: the kernel counts, and its counts are read at moments when no frame waits for the unit. A unit is busy
for at most its CPU time.

CPU time is CLOCK_PROCESS_CPUTIME_ID, over all threads. The run delay of a thread is the time in ns in which the thread
was ready but another thread had the core. Run delay is the second number of `/proc/self/task/TID/schedstat`
(Documentation/scheduler/sched-stats.rst of the kernel). This file is opened once, and read again and again.

A piece of time is a job, or the time between two jobs. Every ns of CPU time is in one piece. Each piece has three
numbers, in ns:
- `wall_ns`: length of the piece;
- `cpu_ns`: CPU time of all threads of the unit's process in the piece;
- `delay_ns`: run delay in the piece, summed over these threads.

Run delay is read after the answer to a job, and before the answer only if the job may have lost more than LOSS_NS.
Before a job, counts are read only in three cases:
- the unit has had the job for longer than HELD_NS;
- its stage's last job lost time;
- other threads may have run between the jobs.

docs/decisions/preempted-time.md says what the two thresholds can hide. It derives preempted time and sleep from the
three numbers. It also proves that the busy times of units that share cores never exceed the time of these cores.

Rule for counts: instructions and cache misses are the processor's counts (perf_event_open), or are reported as absent.
Only user mode counts. A counter covers the thread that opens it, and all threads that this thread or its children begin
later. The kernel adds up their counts (`inherit`). A processor with fewer counters than events counts each event for a
part of the time. Counts for a part of the time are scaled to the whole time.

Each event is opened and read by itself, because `inherit` does not work with a group (`man 2 perf_event_open`). Some
kernels refuse to read a group with `inherit` (ECHILD). If a count cannot be read, the job goes on without it.
"""

from __future__ import annotations

import errno
import os
import struct
import time
from collections.abc import Callable, Sequence, Set
from contextlib import closing
from typing import Final, NamedTuple

from trilane import machine
from trilane.transport.messages import Done

PROCESS = "/proc/self"
TASKS = f"{PROCESS}/task"
_LINE_BYTES = 64  # three numbers of 64 bits
_LINKS_BESIDE_THREADS = 2  # a folder has a link for each folder in it, `.` and its own name


def counts_run_delay(process: str = PROCESS) -> bool:
    """Return whether this kernel counts the run delay of threads (CONFIG_SCHED_INFO).

    `process`: path of the kernel's folder of this process.
    """
    try:
        with open(f"{process}/schedstat", "rb") as file:  # noqa: PTH123 - as the meter reads it
            return int(file.read(_LINE_BYTES).split()[0]) > 0
    except (OSError, ValueError, IndexError):
        return False


class CoreMeter:
    """Counts CPU time and run delay of this process from its creation on. `look` finds threads that begin later.

    `others`: ids of threads whose run delay is not counted.
    `process`: path of the kernel's folder of this process.
    """

    def __init__(self, others: Set[int] = frozenset(), process: str = PROCESS) -> None:
        self._others, self._tasks = others, f"{process}/task"
        self._files: dict[int, int] = {}  # file of each thread
        self._seen_ns: dict[int, int] = {}  # run delay of each thread when it was last read, by the thread's file
        self._threads = self._born_ns = 0
        self._folder = os.open(self._tasks, os.O_RDONLY | os.O_CLOEXEC) if counts_run_delay(process) else -1
        self._cpu_ns = time.process_time_ns()
        self.look()
        self._born_ns = 0  # the run delay of these threads before this moment does not count

    @property
    def threads(self) -> int:
        """The number of threads that the last call of `look` found."""
        return len(self._files)

    def cpu_ns(self) -> int:
        """Return the CPU time in ns of all threads of the process since the last call."""
        cpu_ns = time.process_time_ns()
        passed_ns, self._cpu_ns = cpu_ns - self._cpu_ns, cpu_ns
        return passed_ns

    def delay_ns(self) -> int:
        """Return the sum of the threads' run delays since the last call, in ns."""
        delay_ns, self._born_ns = self._born_ns, 0
        for file, seen_ns in self._seen_ns.items():
            try:
                now_ns = int(os.pread(file, _LINE_BYTES, 0).split()[1])
            except ProcessLookupError:  # the thread has ended; `look` closes its file
                continue
            if now_ns != seen_ns:
                delay_ns += now_ns - seen_ns
                self._seen_ns[file] = now_ns
        return delay_ns

    def look(self) -> None:
        """If the number of threads has changed, find the threads that have begun or ended since the last call."""
        if self._folder < 0:
            return
        threads = os.fstat(self._folder).st_nlink - _LINKS_BESIDE_THREADS
        if threads == self._threads:
            return
        self._threads = threads
        alive = {int(name) for name in os.listdir(self._folder)} - self._others  # noqa: PTH208 - by descriptor
        for thread in self._files.keys() - alive:
            file = self._files.pop(thread)
            del self._seen_ns[file]
            os.close(file)
        for thread in alive - self._files.keys():
            self._open(thread)

    def _open(self, thread: int) -> None:
        try:
            file = os.open(f"{self._tasks}/{thread}/schedstat", os.O_RDONLY | os.O_CLOEXEC)
        except (FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
            return
        try:
            delay_ns = int(os.pread(file, _LINE_BYTES, 0).split()[1])
        except ProcessLookupError:  # it has ended since its file was opened
            os.close(file)
            return
        self._files[thread], self._seen_ns[file] = file, delay_ns
        self._born_ns += delay_ns

    def close(self) -> None:
        """Close all files of the kernel that the meter has opened."""
        for file in self._seen_ns:
            os.close(file)
        self._files.clear()
        self._seen_ns.clear()
        if self._folder >= 0:
            os.close(self._folder)
            self._folder = -1


class Lost(NamedTuple):
    """Parts of a piece of time in which a unit did not work, in ns.

    `preempted_ns`: time for which the unit waited for a core.
    `asleep_ns`: time for which the unit slept.
    """

    preempted_ns: int
    asleep_ns: int


def most_preempted_ns(wall_ns: int, cpu_ns: int, cores: int) -> int:
    """Return the longest time in ns for which a unit can have waited for its cores.

    It is `wall_ns` less `cpu_ns` / `cores` (the CPU time of each core, if all cores have the same), but at least 0.

    `wall_ns`: length of the piece of time.
    `cpu_ns`: CPU time of the unit's threads in it, summed over the threads.
    `cores`: number of the unit's cores.
    """
    return max(wall_ns - -(-cpu_ns // cores), 0)


def preempted_ns(wall_ns: int, cpu_ns: int, delay_ns: int, cores: int) -> int:
    """Return the time in ns for which a unit waited for its cores.

    The time in which threads were ready is cpu + delay, summed over the threads. Therefore, on average,
    m = max((cpu + delay) / wall, 1) threads were ready. The unit waited for delay / m, but not longer than
    `most_preempted_ns`. With one core the result is min(delay, wall - cpu).

    `wall_ns`: length of the piece of time.
    `cpu_ns`, `delay_ns`: CPU time and run delay of the unit's threads in it, summed over the threads.
    `cores`: number of the unit's cores.
    """
    if not delay_ns:
        return 0
    waited_ns = delay_ns * wall_ns // max(cpu_ns + delay_ns, wall_ns)
    return min(waited_ns, most_preempted_ns(wall_ns, cpu_ns, cores))


def lost_in_job(wall_ns: int, cpu_ns: int, delay_ns: int, cores: int, has_device: bool) -> Lost:
    """Return the parts of a job in which its unit was preempted or asleep.

    In all other time of the job the unit was busy. Without a device, this busy time is at most `cpu_ns`.

    `wall_ns`: length of the job.
    `cpu_ns`, `delay_ns`: CPU time and run delay of the unit's threads in the job, summed over the threads.
    `cores`: number of the unit's cores.
    `has_device`: whether a device (a graphics card, a modelled chip) works while the unit's threads sleep.
    """
    preempted = preempted_ns(wall_ns, cpu_ns, delay_ns, cores)
    asleep = 0 if has_device else wall_ns - preempted - cpu_ns
    return Lost(preempted, asleep if asleep > 0 else 0)


LOSS_NS: Final = 20_000
HELD_NS: Final = 100_000  # longer than a hand-over takes
JOBS_PER_LOOK: Final = 64  # jobs between two searches for new threads, if no job loses time


class JobClock:
    """Measures the jobs of a unit. The calls for a job are `begin`, `end`, `done` and `answered`, in this order.

    `meter`: meter of the unit's process.
    `cores`, `stages`: number of cores and of stages of the unit.
    `now_ns`: function that returns the time in ns.
    """

    def __init__(
        self, meter: CoreMeter, cores: int, stages: int, now_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
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
        """Begin the time between two jobs now, and count from now on all threads that exist."""
        self._look()
        self._meter.delay_ns()
        self._meter.cpu_ns()
        self._delay_before_ns = self._cpu_before_ns = 0
        self._end_ns = self._now_ns()

    def begin(self, stage: int, dispatch_ns: int) -> None:
        """Note that a job begins. `stage`: index of its stage in the unit. `dispatch_ns`: time of its hand-over."""
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
        """Note that the job has ended. `works_asleep`: whether the sleep of its threads counts as busy."""
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
        """Return the answer to the job that has ended.

        `sampled_ns`: time at which the job sampled its frame; 0 if its stage does not sample.
        `metrics`: metrics of the stage for this job, by name.
        `skips`: whether its frame takes the bypass.
        """
        return Done(
            id=job_id,
            t_begin_ns=self._begin_ns,
            t_end_ns=self._end_ns,
            t_sampled_ns=sampled_ns,
            preempted_ns=self._preempted_ns,
            asleep_ns=self._asleep_ns,
            preempted_before_ns=self._preempted_before_ns,
            skips=int(skips),
            cpu_ns=self._cpu_ns,
            cpu_before_ns=self._cpu_before_ns,
            metrics=metrics,
        )

    def answered(self) -> None:
        """Read the counts of the time since the job's end; called after the answer was sent.

        If the run delay was not read at the job's end, part of it belongs to the job. Therefore the run delay counts
        only up to the length of the time since the job's end. In this time the calling thread did not sleep.
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


MOST_PARANOID: Final = 2  # largest kernel.perf_event_paranoid with which a process may count its own user mode

# linux/perf_event.h
ATTR: Final = struct.Struct("=IIQQQQQIIQ")  # type, size, config, period, sample_type, read_format, flags, 0, 0, 0
ROW: Final = struct.Struct("=QQQ")  # the count, time enabled, time running
INHERIT, EXCLUDE_KERNEL, EXCLUDE_HYPERVISOR = 1 << 1, 1 << 5, 1 << 6
ENABLED_TIME, RUNNING_TIME = 1, 2
CLOSE_ON_EXEC: Final = 8
HARDWARE: Final = 0


class CountedEvent(NamedTuple):
    """An event to count.

    `name`: name of the count in the report.
    `kind`, `config`: type and number of the event for perf_event_open.
    """

    name: str
    kind: int
    config: int


class Reading(NamedTuple):
    """One reading of a counter.

    `value`: count so far.
    `enabled_ns`: time in ns for which the counter was enabled so far.
    `running_ns`: part of `enabled_ns` in which the processor counted.
    """

    value: int
    enabled_ns: int
    running_ns: int


KINDS: Final = (CountedEvent("instructions", HARDWARE, 1), CountedEvent("cache_misses", HARDWARE, 3))


class HardwareCounters:
    """Counts events of the processor, for this thread and for all threads that it begins later.

    `kinds`: events to count; an event that the kernel refuses is left out.
    Raises OSError if no event can be counted.
    """

    def __init__(self, kinds: Sequence[CountedEvent] = KINDS) -> None:
        self._files: dict[str, int] = {}
        self._before: dict[str, Reading] = {}
        refused: OSError | None = None
        for kind in kinds:
            try:
                self._files[kind.name] = _open(kind)
            except OSError as error:
                refused = refused or error
        if not self._files and refused is not None:
            raise refused
        self.begin()

    @property
    def names(self) -> list[str]:
        """The names of the events that are counted."""
        return list(self._files)

    def begin(self) -> None:
        """Begin to count for a new job."""
        self._before = self._read()

    def figures(self) -> dict[str, float]:
        """Return the counts since `begin`, by the event's name.

        An event that the processor did not count, or whose count cannot be read, is left out.
        """
        figures = {}
        for name, now in self._read().items():
            before = self._before.get(name)
            if before is not None and now.running_ns > before.running_ns:
                scale = (now.enabled_ns - before.enabled_ns) / (now.running_ns - before.running_ns)
                figures[name] = (now.value - before.value) * scale
        return figures

    def close(self) -> None:
        while self._files:
            os.close(self._files.popitem()[1])

    def _read(self) -> dict[str, Reading]:
        readings = {}
        for name, file in self._files.items():
            try:
                row = machine.here.read_counter(file, ROW.size)
            except OSError:
                continue
            if len(row) == ROW.size:  # the file of an event that the kernel gave up is empty
                readings[name] = Reading._make(ROW.unpack(row))
        return readings


class NoCounters:
    """Takes the place of `HardwareCounters` on a machine where nothing can be counted."""

    def begin(self) -> None: ...

    def figures(self) -> dict[str, float]:
        """Return an empty dict: there are no counts."""
        return {}

    def close(self) -> None: ...


def counters_here() -> HardwareCounters | NoCounters:
    """Return counters for this thread, or `NoCounters` if nothing can be counted here."""
    try:
        return HardwareCounters()
    except OSError:
        return NoCounters()


def absence() -> str | None:
    """Return the reason why nothing can be counted here, as part of a sentence; None if an event can be counted."""
    try:
        with closing(HardwareCounters()):
            return None
    except OSError as error:
        return _reason(error)


def availability() -> str:
    """Return the names of the events that can be counted here, or `absent:` with the reason."""
    try:
        with closing(HardwareCounters()) as counters:
            return ", ".join(counters.names)
    except OSError as error:
        return f"absent: {_reason(error)}"


def _open(kind: CountedEvent) -> int:
    """Open a counter of the event `kind`, and return its file descriptor. Raises OSError."""
    flags = INHERIT | EXCLUDE_KERNEL | EXCLUDE_HYPERVISOR
    attributes = ATTR.pack(kind.kind, ATTR.size, kind.config, 0, 0, ENABLED_TIME | RUNNING_TIME, flags, 0, 0, 0)
    return machine.here.open_counter(attributes, CLOSE_ON_EXEC)


def _reason(error: OSError) -> str:
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.EOPNOTSUPP, errno.EINVAL):
        return "this machine shows no counters of its processor, as most virtual machines"
    if error.errno in (errno.EACCES, errno.EPERM):
        level = paranoid_level()
        if level is not None and level > MOST_PARANOID:
            return f"kernel.perf_event_paranoid is {level}"
        return "this process may not call perf_event_open, as in many containers"
    return f"perf_event_open: {(error.strerror or str(error)).lower()}"


def paranoid_level() -> int | None:
    """Return the kernel's setting kernel.perf_event_paranoid; None if the kernel lacks it."""
    try:
        return int((machine.here.proc / "sys/kernel/perf_event_paranoid").read_text())
    except (OSError, ValueError):
        return None


def remedy(why: str) -> str:
    """Return the remedy for a reason: a command, or part of a sentence. `why`: reason, from `absence`."""
    if "perf_event_paranoid" in why:
        return f"sysctl kernel.perf_event_paranoid={MOST_PARANOID}"
    return "needs a machine of its own" if "virtual" in why else "allow perf_event_open"
