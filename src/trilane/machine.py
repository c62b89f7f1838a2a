"""What Trilane asks of the machine: cores, processor, caches, counters, memory, packages, programs, folders, the date.

It is asked here and nowhere else, so a test can put another machine in place of `here`. Ruff refuses the calls below in
every other file (`banned-api` in pyproject.toml). Two things are asked elsewhere, each in one place: OpenGL by
`trilane.stages.gpu.opengl`, and clocks by whoever measures, because a clock is read in every job.
"""

from __future__ import annotations

import ctypes
import errno
import importlib.util
import os
import platform
import shutil
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import psutil

#: Number of the system call perf_event_open, by architecture.
PERF_EVENT_OPEN: Final = {"x86_64": 298, "aarch64": 241, "riscv64": 241}
#: Suffixes of sizes in the kernel's files.
KERNEL_UNITS: Final = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30}
_LIBC: Final = ctypes.CDLL(None, use_errno=True)
_LIBC.syscall.restype = ctypes.c_long


class Machine:
    """The machine below `root`, the folder that holds the kernel's folders `proc` and `sys`."""

    def __init__(self, root: Path = Path("/")) -> None:
        self.proc = root / "proc"
        self.sys = root / "sys"

    def cores(self) -> tuple[int, ...]:
        """Numbers of the cores that this process may use, ascending."""
        return tuple(sorted(os.sched_getaffinity(0)))

    def core_count(self) -> int:
        """How many cores the machine has, at least 1."""
        return os.cpu_count() or 1

    def architecture(self) -> str:
        """The kernel's name of it, such as `x86_64` and `aarch64`."""
        return platform.machine()

    def cpu_fields(self) -> dict[str, str]:
        """Fields of the first core in /proc/cpuinfo; empty where that cannot be read."""
        try:
            text = (self.proc / "cpuinfo").read_text(encoding="utf-8", errors="replace")
        except OSError:
            return {}
        pairs = (line.partition(":") for line in text.split("\n\n")[0].splitlines())
        return {key.strip(): value.strip() for key, _, value in pairs}

    def cpu_flags(self) -> frozenset[str]:
        """Instruction sets of the first core by the kernel's names; x86 calls the field `flags`, ARM `Features`."""
        fields = self.cpu_fields()
        return frozenset((fields.get("flags") or fields.get("Features") or "").split())

    def cpu_model(self) -> str:
        """The processor's name, at least its architecture."""
        return self.cpu_fields().get("model name") or platform.processor() or self.architecture()

    def clock_ghz(self) -> float:
        """Highest clock of the cores, else the present one; 0 where the kernel tells none."""
        frequency = psutil.cpu_freq()
        return (frequency.max or frequency.current) / 1e3 if frequency else 0.0

    def sensor_c(self) -> float | None:
        """Temperature of the hottest sensor in degrees Celsius; None on a machine that shows none."""
        by_chip: dict[str, list[Any]] = getattr(psutil, "sensors_temperatures", dict)()
        values = [sensor.current for sensors in by_chip.values() for sensor in sensors]
        return max(values) if values else None

    def memory_bytes(self) -> int:
        """Physical memory in bytes."""
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")

    def free_bytes(self) -> int:
        """Memory in bytes that programs can still have without swapping."""
        return int(psutil.virtual_memory().available)

    def open_counter(self, attributes: bytes, flags: int) -> int:
        """A descriptor of an event that is counted for this thread: perf_event_open(2). Raises OSError.

        `attributes`: a `perf_event_attr`; `flags`: of the system call.
        """
        number = PERF_EVENT_OPEN.get(self.architecture())
        if number is None:
            raise OSError(errno.ENOSYS, f"no number of perf_event_open is known for {self.architecture()}")
        words = (ctypes.c_long(number), ctypes.c_char_p(attributes), *map(ctypes.c_int, (0, -1, -1)))
        file: int = _LIBC.syscall(*words, ctypes.c_ulong(flags))
        if file < 0:
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code))
        return file

    def read_counter(self, file: int, size: int) -> bytes:
        """What the kernel says of an opened counter. Raises OSError."""
        return os.read(file, size)

    def system(self) -> str:
        """Kernel, its version and the C library's."""
        return platform.platform()

    def python(self) -> str:
        """The version of this Python."""
        return platform.python_version()

    def host_name(self) -> str:
        """The machine's name in its network."""
        return platform.node()

    def program(self, name: str, first: Path | None = None) -> str | None:
        """The path of a program in the folder `first` or on PATH; None where there is none."""
        path = os.environ.get("PATH", os.defpath)
        return shutil.which(name, path=path if first is None else f"{first}{os.pathsep}{path}")

    def package_file(self, name: str) -> Path | None:
        """The file that a module or package begins with, which is not imported; None where it is not installed."""
        found = importlib.util.find_spec(name)
        return None if found is None else Path(found.origin or "")

    def has_package(self, name: str) -> bool:
        """Whether a module or package is installed; it is not imported."""
        return self.package_file(name) is not None

    def cache_home(self) -> Path:
        """The folder of this user's caches, which need not exist. Raises RuntimeError for a user without a home."""
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")

    def now(self) -> datetime:
        """Date and time in UTC."""
        return datetime.now(UTC)


#: The machine that this process runs on.
here = Machine()


def last_level_bytes(cores: Iterable[int]) -> int:
    """Size of the largest last-level cache of `cores` by the kernel; 0 where it tells none, so that nothing fits.

    On a virtual machine it may be the whole host's.
    """
    folder = here.sys / "devices/system/cpu"
    return max((_cache_bytes(folder / f"cpu{core}" / "cache") for core in cores), default=0)


def moved_of_kept(kept_bytes: int) -> int:
    """The part of `kept_bytes` that each frame reads again from memory: all that do not fit into the cache, or none.

    `kept_bytes`: what a stage keeps from frame to frame, such as a network's weights.
    """
    return 0 if kept_bytes <= last_level_bytes(here.cores()) else kept_bytes


def _cache_bytes(caches: Path) -> int:
    try:
        levels = {int((index / "level").read_text()): index for index in caches.glob("index[0-9]*")}
        return _bytes((levels[max(levels)] / "size").read_text().strip()) if levels else 0
    except (OSError, ValueError):
        return 0


def _bytes(text: str) -> int:
    """The bytes of a size as the kernel writes it, such as 307200K."""
    return int(text[:-1]) * KERNEL_UNITS[text[-1]] if text[-1:] in KERNEL_UNITS else int(text)
