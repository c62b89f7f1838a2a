"""Measures how long this process ran, and how long its threads waited for a core.

Rule: the kernel counts; files stay open.

CPU time is CLOCK_PROCESS_CPUTIME_ID, over all threads. The run delay of a thread is the time in ns in which it was
ready and another thread had the core. It is the second number of `/proc/self/task/TID/schedstat`
(Documentation/scheduler/sched-stats.rst of the kernel). The file is opened once and read again.
"""

from __future__ import annotations

import os
import time
from collections.abc import Set

PROCESS = "/proc/self"
TASKS = f"{PROCESS}/task"
LINE_BYTES = 64  # three numbers of 64 bits
LINKS_BESIDE_THREADS = 2  # a folder has a link for each folder in it, `.` and its own name


def counts_run_delay(process: str = PROCESS) -> bool:
    """Return whether this kernel says how long threads waited for a core (CONFIG_SCHED_INFO)."""
    try:
        with open(f"{process}/schedstat", "rb") as file:  # noqa: PTH123 - as the meter reads it
            return int(file.read(LINE_BYTES).split()[0]) > 0
    except (OSError, ValueError, IndexError):
        return False


class CoreMeter:
    """Counts from its creation on. `look` finds threads that appear later; those in `others` are left out.

    `process`: path of the kernel's folder of this process.
    """

    def __init__(self, others: Set[int] = frozenset(), process: str = PROCESS) -> None:
        self._others, self._tasks = others, f"{process}/task"
        self._files: dict[int, int] = {}  # file of each thread
        self._seen_ns: dict[int, int] = {}  # delay of each file when it was last read
        self._threads = self._born_ns = 0
        self._folder = os.open(self._tasks, os.O_RDONLY | os.O_CLOEXEC) if counts_run_delay(process) else -1
        self._cpu_ns = time.process_time_ns()
        self.look()
        self._born_ns = 0  # what these threads waited before does not count

    @property
    def threads(self) -> int:
        """The number of threads that the last look found."""
        return len(self._files)

    def cpu_ns(self) -> int:
        """Return the CPU time of all threads since the last call, in ns."""
        cpu_ns = time.process_time_ns()
        passed_ns, self._cpu_ns = cpu_ns - self._cpu_ns, cpu_ns
        return passed_ns

    def delay_ns(self) -> int:
        """Return the sum of the threads' run delays since the last call, in ns."""
        delay_ns, self._born_ns = self._born_ns, 0
        for file, seen_ns in self._seen_ns.items():
            try:
                now_ns = int(os.pread(file, LINE_BYTES, 0).split()[1])
            except ProcessLookupError:  # the thread has ended; `look` closes its file
                continue
            if now_ns != seen_ns:
                delay_ns += now_ns - seen_ns
                self._seen_ns[file] = now_ns
        return delay_ns

    def look(self) -> None:
        """Find the threads that have begun and ended since the last look; this is quick if their number is the same."""
        if self._folder < 0:
            return
        threads = os.fstat(self._folder).st_nlink - LINKS_BESIDE_THREADS
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
            delay_ns = int(os.pread(file, LINE_BYTES, 0).split()[1])
        except ProcessLookupError:  # it has ended since its file was opened
            os.close(file)
            return
        self._files[thread], self._seen_ns[file] = file, delay_ns
        self._born_ns += delay_ns

    def close(self) -> None:
        """Close every file."""
        for file in self._seen_ns:
            os.close(file)
        self._files.clear()
        self._seen_ns.clear()
        if self._folder >= 0:
            os.close(self._folder)
            self._folder = -1
