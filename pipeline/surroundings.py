"""Prepares the surroundings of a run: checks, cores, memory and processes. Measures the share of other programs.

Rule: a check raises before anything is started. Whatever happens, cores, memory and processes are the same after a run
as before. If a core of the run is busy but does no work of the run, the time counts for other programs.
"""

from __future__ import annotations

import contextlib
import gc
import math
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TypeVar

import psutil

from trilane import machine
from trilane.errors import BadInputError, TrilaneError
from trilane.machine import SHORTEST_SLICE_NS, USUAL_SLICE, use_slice
from trilane.pipeline import fork_server
from trilane.pipeline.description import Pipeline
from trilane.pipeline.memory import Assets, edge_regions, share_assets
from trilane.pipeline.run_metrics import ProcessorState
from trilane.pipeline.unit_processes import UnitProcesses
from trilane.pipeline.unit_starter import UnitStarter

#: Number of files and sockets that a run keeps open, with room for a restarted unit.
LEAST_FILES = 96


def refuse_in_a_unit() -> None:
    """Raise BadInputError in a unit's process: a module that starts a run on import would start units without end."""
    spec = sys.modules["__main__"].__spec__
    if spec is not None and spec.name == fork_server.__name__:
        found = "run_pipeline was called while a unit imported its stages"
        raise BadInputError("run_pipeline", found, 'a call under `if __name__ == "__main__":`')


def check_open_files() -> None:
    """Raise TrilaneError if this process may open too few files for a run."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if limit != resource.RLIM_INFINITY and limit < LEAST_FILES:
        raise TrilaneError(f"open files: found a limit of {limit}, expected at least {LEAST_FILES}: ulimit -n 1024")


def check_cores(pipeline: Pipeline) -> None:
    """Raise BadInputError if a unit has a core that this process may not use."""
    here = machine.here.cores()
    for unit, settings in pipeline.units.items():
        if absent := set(settings.cores).difference(here):
            found, expected = ", ".join(map(str, sorted(absent))), ", ".join(map(str, sorted(here)))
            raise BadInputError(f"cores of unit {unit}", found, f"some of this process's: {expected}")


def check_positive(**values: float | None) -> None:
    """Raise BadInputError for the first value that is 0 or less, or is not finite; None is allowed.

    `values`: values by the name that the message gives them.
    """
    for name, value in values.items():
        if value is not None and not 0 < value < math.inf:
            raise BadInputError(name, str(value), "more than 0")


class OtherPrograms:
    """Counts the CPU time of other programs on some cores, from the creation of this object on.

    `cores`: numbers of the cores.
    `pids`: ids of the run's processes besides this process; they do not count as other programs.
    """

    def __init__(self, cores: Sequence[int], pids: Sequence[int] = ()) -> None:
        self._cores, self._processes = cores, [psutil.Process(pid) for pid in (os.getpid(), *pids)]
        self._stat = machine.here.proc / "stat"
        self._begin_s, self._before_s = time.monotonic(), self._others_s()

    def share(self) -> float:
        """Return the share (0 to 1) of the cores' time that other programs had.

        The kernel counts in steps of 10 ms, so the share is inexact if less than 0.1 s has passed.
        """
        had_s = max(time.monotonic() - self._begin_s, 1e-9) * len(self._cores)
        return min(max(self._others_s() - self._before_s, 0.0) / had_s, 1.0)

    def _others_s(self) -> float:
        own = [process.cpu_times() for process in self._processes]
        own_s: float = sum(times.user + times.system for times in own)
        return busy_s(self._stat.read_text(), self._cores) - own_s


def beside_units(cores: Sequence[int], pids: Mapping[str, int]) -> Callable[[Mapping[str, int]], float | None]:
    """Count the CPU time of other programs on `cores` from now on, and return a function that returns their share.

    The function takes the process id of each unit at the end. If a unit's process has changed, the CPU time of the old
    process is not known, and the function returns None. It returns None too if the kernel's counts cannot be read.

    `pids`: process id of each unit now.
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


def processor_of(cores: Sequence[int]) -> Callable[[], ProcessorState]:
    """Read clock and throttling of `cores` now. Return a function that reads them again, and returns both readings."""
    clock, throttles = machine.here.core_clock_ghz(cores), machine.here.throttles(cores)

    def state() -> ProcessorState:
        now = machine.here.throttles(cores)
        grown = None if now is None or throttles is None else now - throttles
        end = machine.here.core_clock_ghz(cores)
        return ProcessorState(clock_begin_ghz=clock, clock_end_ghz=end, throttles=grown)

    return state


def busy_s(stat: str, cores: Sequence[int]) -> float:
    """Return the time in seconds in which `cores` were not idle since the system's start, summed over the cores.

    Steal time counts as not idle. The guests' time is part of user and nice, so it is not added.

    `stat`: text of /proc/stat (proc_stat(5)): cpuN user nice system idle iowait irq softirq steal guest guest_nice.
    """
    names = {f"cpu{core}" for core in cores}
    rows = [line.split() for line in stat.splitlines()]
    busy = [[*map(int, fields[:3]), *map(int, fields[5:8])] for name, *fields in rows if name in names]
    steps = sum(map(sum, busy))
    return steps / os.sysconf("SC_CLK_TCK")


Processes = TypeVar("Processes", bound=UnitProcesses)
SWITCH_S = 0.0002  # longest time in seconds for which another thread of this process keeps the interpreter


@contextlib.contextmanager
def on_cores(cores: tuple[int, ...]) -> Iterator[None]:
    """Restrict this thread, and threads that it begins, to `cores` inside the `with` block."""
    before = machine.here.cores()
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextlib.contextmanager
def prompt_answers() -> Iterator[None]:
    """Make the scheduler, in this thread, answer without delay inside the `with` block.

    The scheduler then does not wait for the time slice of a unit on its core, or for a thread that draws a progress
    bar. Garbage collection is off, because a run makes no reference cycles.
    """
    switch_s, collects = sys.getswitchinterval(), gc.isenabled()
    sys.setswitchinterval(SWITCH_S)
    gc.disable()
    use_slice(SHORTEST_SLICE_NS)
    try:
        yield
    finally:
        use_slice(USUAL_SLICE)
        sys.setswitchinterval(switch_s)
        if collects:
            gc.enable()


@contextlib.contextmanager
def unit_processes(
    pipeline: Pipeline, assets: Assets, starter: UnitStarter | None, kind: type[Processes]
) -> Iterator[Processes]:
    """Yield `UnitProcesses` for the pipeline, with shared memory, but without a started process. Close all at the end.

    `starter`: fork server; None: one is made.
    `kind`: class of the yielded object.
    """
    with contextlib.ExitStack() as stack:
        used = starter or stack.enter_context(UnitStarter(pipeline.preload))
        assets_fd = share_assets(assets)
        stack.callback(os.close, assets_fd)
        regions = stack.enter_context(edge_regions(pipeline))
        yield stack.enter_context(contextlib.closing(kind(pipeline, regions, assets_fd, used)))
