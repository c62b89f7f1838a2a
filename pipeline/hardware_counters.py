"""Instructions and cache misses of a unit's jobs, by perf_event_open. Rule: counted by the processor, or said absent.

Counts are of user mode, of the thread that opens them and of all threads that it and its threads begin later, by
`man 2 perf_event_open`: the kernel adds up those of the threads (`inherit`), and one read gives the group. Where the
processor has fewer counters than events it counts for a part of the time; the counts are scaled to the whole.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Final, NamedTuple

SYSCALLS: Final = {"x86_64": 298, "aarch64": 241, "riscv64": 241}
PARANOID: Final = Path("/proc/sys/kernel/perf_event_paranoid")
MOST_PARANOID: Final = 2  # at which a process may still count its own user mode

# linux/perf_event.h
ATTR: Final = struct.Struct("=IIQQQQQIIQ")  # type, size, config, period, sample_type, read_format, flags, 0, 0, 0
INHERIT, EXCLUDE_KERNEL, EXCLUDE_HYPERVISOR = 1 << 1, 1 << 5, 1 << 6
ENABLED_TIME, RUNNING_TIME, GROUP = 1, 2, 8
CLOSE_ON_EXEC: Final = 8
HARDWARE: Final = 0


class Counted(NamedTuple):
    """What is counted: name of the figure, the kernel's type and number of the event."""

    name: str
    kind: int
    config: int


KINDS: Final = (Counted("instructions", HARDWARE, 1), Counted("cache_misses", HARDWARE, 3))


class HardwareCounters:
    """Counts from its making on, of this thread and those that come from it. Raises OSError where it cannot."""

    def __init__(self, kinds: Sequence[Counted] = KINDS) -> None:
        self._names = [kind.name for kind in kinds]
        self._row = struct.Struct(f"={3 + len(kinds)}Q")  # how many, time enabled, time running, the counts
        self._files: list[int] = []
        self._before = b""
        try:
            for kind in kinds:
                self._files.append(_open(kind, self._files[0] if self._files else -1))
            self.begin()
        except OSError:
            self.close()
            raise

    def begin(self) -> None:
        """A job begins."""
        self._before = self._read()

    def figures(self) -> dict[str, float]:
        """Of the job that has begun, by name; nothing where the processor had no counter for it."""
        after = self._row.unpack(self._read())
        (_, enabled_ns, running_ns, *counts) = map(int.__sub__, after, self._row.unpack(self._before))
        if not running_ns:
            return {}
        scale = enabled_ns / running_ns
        return {name: count * scale for name, count in zip(self._names, counts, strict=True)}

    def close(self) -> None:
        """Count no longer."""
        while self._files:
            os.close(self._files.pop())

    def _read(self) -> bytes:
        return os.read(self._files[0], self._row.size)


class NoCounters:
    """In place of counters, where there are none."""

    def begin(self) -> None: ...

    def figures(self) -> dict[str, float]:
        """Nothing was counted."""
        return {}

    def close(self) -> None: ...


def counters_here() -> HardwareCounters | NoCounters:
    """Those of this thread, where `absence` does not say why there are none."""
    try:
        return HardwareCounters()
    except OSError:
        return NoCounters()


def absence() -> str | None:
    """Why nothing can be counted here, as part of a sentence; None where it can."""
    try:
        with closing(HardwareCounters()):
            return None
    except OSError as error:
        return _reason(error)


def availability() -> str:
    """What is counted, or that nothing is and why: a fact of the machine."""
    why = absence()
    return ", ".join(kind.name for kind in KINDS) if why is None else f"absent: {why}"


def _open(kind: Counted, leader: int) -> int:
    """The file of a counter in the group of `leader`, -1 for a group of its own. Raises OSError."""
    number = SYSCALLS.get(platform.machine())
    if number is None:
        raise OSError(errno.ENOSYS, f"no number of perf_event_open is known for {platform.machine()}")
    flags = INHERIT | EXCLUDE_KERNEL | EXCLUDE_HYPERVISOR
    read_format = ENABLED_TIME | RUNNING_TIME | GROUP
    attributes = ATTR.pack(kind.kind, ATTR.size, kind.config, 0, 0, read_format, flags, 0, 0, 0)
    words = (ctypes.c_long(number), ctypes.c_char_p(attributes), ctypes.c_int(0), ctypes.c_int(-1))
    file: int = _LIBC.syscall(*words, ctypes.c_int(leader), ctypes.c_ulong(CLOSE_ON_EXEC))
    if file < 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))
    return file


_LIBC: Final = ctypes.CDLL(None, use_errno=True)
_LIBC.syscall.restype = ctypes.c_long


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
    """What the kernel's setting is, None where it has none."""
    try:
        return int(PARANOID.read_text())
    except (OSError, ValueError):
        return None


def remedy(why: str) -> str:
    """The line that mends what `absence` found, or what it takes."""
    if "perf_event_paranoid" in why:
        return f"sysctl kernel.perf_event_paranoid={MOST_PARANOID}"
    return "needs a machine of its own" if "virtual" in why else "allow perf_event_open"
