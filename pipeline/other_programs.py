"""Measures the share of other programs in the time of cores.

Rule: what is not ours is theirs, by the kernel's counts.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Mapping, Sequence

import psutil

from trilane import machine


class OtherPrograms:
    """Counts from its creation on.

    `cores`: numbers of the cores that count.
    `pids`: processes that are ours beside this one.
    """

    def __init__(self, cores: Sequence[int], pids: Sequence[int] = ()) -> None:
        self._cores, self._processes = cores, [psutil.Process(pid) for pid in (os.getpid(), *pids)]
        self._stat = machine.here.proc / "stat"
        self._begin_s, self._before_s = time.monotonic(), self._others_s()

    def share(self) -> float:
        """Return the others' share of the time of the cores, at most 1.

        The kernel counts in steps of 10 ms, so under 0.1 s the share says little.
        """
        had_s = max(time.monotonic() - self._begin_s, 1e-9) * len(self._cores)
        return min(max(self._others_s() - self._before_s, 0.0) / had_s, 1.0)

    def _others_s(self) -> float:
        own = [process.cpu_times() for process in self._processes]
        own_s: float = sum(times.user + times.system for times in own)
        return busy_s(self._stat.read_text(), self._cores) - own_s


def beside_units(cores: Sequence[int], pids: Mapping[str, int]) -> Callable[[Mapping[str, int]], float | None]:
    """Count from now on what others have of `cores`, beside the processes `pids` of units.

    Return a function that takes the units' present processes and returns the others' share. It returns None if a unit
    has died in between, because its CPU time is then unknown.
    """
    try:
        others = OtherPrograms(cores, [*pids.values()])
    except (psutil.Error, OSError):
        return lambda _: None

    def share(now: Mapping[str, int]) -> float | None:
        with contextlib.suppress(psutil.Error, OSError):
            return others.share() if now == pids else None
        return None

    return share


def busy_s(stat: str, cores: Sequence[int]) -> float:
    """Return how many seconds `cores` were not idle since the system began, including steal time.

    `stat`: text of /proc/stat (proc_stat(5)): cpuN user nice system idle iowait irq softirq steal guest guest_nice. The
    guests' time is also counted in user and nice.
    """
    names = {f"cpu{core}" for core in cores}
    rows = [line.split() for line in stat.splitlines()]
    busy = [[*map(int, fields[:3]), *map(int, fields[5:8])] for name, *fields in rows if name in names]
    steps = sum(map(sum, busy))
    return steps / os.sysconf("SC_CLK_TCK")
