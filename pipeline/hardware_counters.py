"""Counts instructions and cache misses of a unit's jobs through perf_event_open.

Rule: a figure is the processor's count, or is reported as absent. Counts are those of user mode. They cover the thread
that opens them and all threads that it and its threads begin later, which the kernel adds up (`inherit`). A processor
with fewer counters than events counts each for a part of the time; such counts are scaled to the whole time.

Each event is opened and read by itself, because `inherit` and a group do not go together (`man 2 perf_event_open`).
Some kernels refuse to read such a group (ECHILD). If a figure cannot be read, the job goes on without it.
"""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Sequence
from contextlib import closing
from typing import Final, NamedTuple

from trilane import machine

MOST_PARANOID: Final = 2  # setting up to which a process may still count its own user mode

# linux/perf_event.h
ATTR: Final = struct.Struct("=IIQQQQQIIQ")  # type, size, config, period, sample_type, read_format, flags, 0, 0, 0
ROW: Final = struct.Struct("=QQQ")  # the count, time enabled, time running
INHERIT, EXCLUDE_KERNEL, EXCLUDE_HYPERVISOR = 1 << 1, 1 << 5, 1 << 6
ENABLED_TIME, RUNNING_TIME = 1, 2
CLOSE_ON_EXEC: Final = 8
HARDWARE: Final = 0


class CounterReading(NamedTuple):
    """An event to count.

    `name`: name of the figure.
    `kind`, `config`: the kernel's type and number of the event.
    """

    name: str
    kind: int
    config: int


class Reading(NamedTuple):
    """One reading of a counter.

    `value`: its count.
    `enabled_ns`: time for which the count was asked for.
    `running_ns`: time for which the processor counted.
    """

    value: int
    enabled_ns: int
    running_ns: int


KINDS: Final = (CounterReading("instructions", HARDWARE, 1), CounterReading("cache_misses", HARDWARE, 3))


class HardwareCounters:
    """Counts every event that the kernel allows, from now on, for this thread and the threads that come from it.

    Raises OSError when none of `kinds` can be counted.
    """

    def __init__(self, kinds: Sequence[CounterReading] = KINDS) -> None:
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
        """The names of the figures that are counted."""
        return list(self._files)

    def begin(self) -> None:
        """Note that a job begins."""
        self._before = self._read()

    def figures(self) -> dict[str, float]:
        """Return the figures of the job that has begun, by name.

        Figures that the processor did not count, or that nobody could read, are left out.
        """
        figures = {}
        for name, now in self._read().items():
            before = self._before.get(name)
            if before is not None and now.running_ns > before.running_ns:
                scale = (now.enabled_ns - before.enabled_ns) / (now.running_ns - before.running_ns)
                figures[name] = (now.value - before.value) * scale
        return figures

    def close(self) -> None:
        """Count no longer."""
        while self._files:
            os.close(self._files.popitem()[1])

    def _read(self) -> dict[str, Reading]:
        readings = {}
        for name, file in self._files.items():
            try:
                row = machine.here.read_counter(file, ROW.size)
            except OSError:
                continue
            if len(row) == ROW.size:  # the kernel ends the file of an event that it had to give up
                readings[name] = Reading._make(ROW.unpack(row))
        return readings


class NoCounters:
    """Takes the place of counters where there are none."""

    def begin(self) -> None: ...

    def figures(self) -> dict[str, float]:
        """Return no figures, as nothing was counted."""
        return {}

    def close(self) -> None: ...


def counters_here() -> HardwareCounters | NoCounters:
    """Return counters of this thread, or `NoCounters` where `absence` gives a reason."""
    try:
        return HardwareCounters()
    except OSError:
        return NoCounters()


def absence() -> str | None:
    """Return why nothing can be counted here, as part of a sentence; None where something can be."""
    try:
        with closing(HardwareCounters()):
            return None
    except OSError as error:
        return _reason(error)


def availability() -> str:
    """Return the counted events as a fact of the machine, or that nothing is counted, and why."""
    try:
        with closing(HardwareCounters()) as counters:
            return ", ".join(counters.names)
    except OSError as error:
        return f"absent: {_reason(error)}"


def _open(kind: CounterReading) -> int:
    """Open a counter and return its file; raises OSError."""
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
    """Return the kernel's setting; None where it has none."""
    try:
        return int((machine.here.proc / "sys/kernel/perf_event_paranoid").read_text())
    except (OSError, ValueError):
        return None


def remedy(why: str) -> str:
    """Return the command, or the condition, that removes the reason from `absence`."""
    if "perf_event_paranoid" in why:
        return f"sysctl kernel.perf_event_paranoid={MOST_PARANOID}"
    return "needs a machine of its own" if "virtual" in why else "allow perf_event_open"
