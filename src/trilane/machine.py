"""Asks the machine for its facts: cores, processor, caches, counters, memory, packages, programs, folders, the date.

Only this module asks the machine, so a test can put another machine in place of `here`. Ruff refuses the calls below in
every other file (`banned-api` in pyproject.toml). There are two exceptions: `trilane.stages.gpu.opengl` asks OpenGL,
and code that measures reads clocks, because a clock is read in every job.

This module also decides whether a failure comes from a **lack of memory**. Rule: evidence is a limit below the
memory of a run, or a process that the kernel has ended for this reason. The memory of a run was measured
(docs/limits.md); a larger scene, avatar or background takes more.

This module also asks the kernel to **wake a thread soon** after a message for it has come; a refusal changes only the
speed. Linux makes a woken thread wait until the time slice of the running thread ends, about 3 ms. A thread that has
asked for a shorter slice need not wait (EEVDF since Linux 6.12; older kernels ignore the request). With another busy
process on the same core, the request lowered the 99th percentile of the wake-up from 3.4 ms to 0.2 ms. The request
matters most for ZeroMQ's I/O threads, which carry messages. A unit that has sent a message begins its next job at once.
Without the request, an I/O thread on the unit's core waits for the end of the job's slice: 1.6 ms with two units.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import importlib.util
import os
import platform
import resource
import shutil
import struct
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any, Final

import psutil

from trilane.errors import TrilaneError, reason

#: Number of the system call perf_event_open, by architecture.
PERF_EVENT_OPEN: Final = {"x86_64": 298, "aarch64": 241, "riscv64": 241}
#: Suffixes of sizes in the kernel's files.
KERNEL_UNITS: Final = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30}
_LIBC: Final = ctypes.CDLL(None, use_errno=True)
_LIBC.syscall.restype = ctypes.c_long


class Machine:
    """This machine. `root`: folder with the kernel's folders `proc` and `sys`; a test gives another folder."""

    def __init__(self, root: Path = Path("/")) -> None:
        self.proc = root / "proc"
        self.sys = root / "sys"

    def cores(self) -> tuple[int, ...]:
        """Return the numbers of the cores that this process may use, ascending."""
        return tuple(sorted(os.sched_getaffinity(0)))

    def core_count(self) -> int:
        """Return the number of the machine's cores, at least 1."""
        return os.cpu_count() or 1

    def architecture(self) -> str:
        """Return the kernel's name of the architecture, such as `x86_64` or `aarch64`."""
        return platform.machine()

    def cpu_fields(self) -> dict[str, str]:
        """Return the fields of the first core in /proc/cpuinfo, by name; empty if that file cannot be read."""
        try:
            text = (self.proc / "cpuinfo").read_text(encoding="utf-8", errors="replace")
        except OSError:
            return {}
        pairs = (line.partition(":") for line in text.split("\n\n")[0].splitlines())
        return {key.strip(): value.strip() for key, _, value in pairs}

    def cpu_flags(self) -> frozenset[str]:
        """Return the instruction sets of the first core, as the kernel names them."""
        fields = self.cpu_fields()  # x86 calls the field `flags`, ARM `Features`
        return frozenset((fields.get("flags") or fields.get("Features") or "").split())

    def cpu_model(self) -> str:
        """Return the processor's name; if it is not known, the architecture."""
        return self.cpu_fields().get("model name") or platform.processor() or self.architecture()

    def clock_ghz(self) -> float:
        """Return the highest clock of the cores in GHz, or else the present clock; 0 if both are unknown."""
        frequency = psutil.cpu_freq()
        return (frequency.max or frequency.current) / 1e3 if frequency else 0.0

    def core_clock_ghz(self, cores: Iterable[int]) -> float | None:
        """Return the present clock of the fastest of `cores` in GHz; None if the kernel does not show it."""
        folder = self.sys / "devices/system/cpu"
        texts = [_text_of(folder / f"cpu{core}/cpufreq/scaling_cur_freq") for core in cores]
        return max((int(text) / 1e6 for text in texts if text.isdecimal()), default=None)

    def throttles(self, cores: Iterable[int]) -> int | None:
        """Return how often heat has slowed `cores` since the system's start; None if the kernel does not count it."""
        folder = self.sys / "devices/system/cpu"
        texts = [_text_of(folder / f"cpu{core}/thermal_throttle/core_throttle_count") for core in cores]
        counts = [int(text) for text in texts if text.isdecimal()]
        return sum(counts) if counts else None

    def sensor_c(self) -> float | None:
        """Return the temperature of the hottest sensor in degrees Celsius; None on a machine without sensors."""
        by_chip: dict[str, list[Any]] = getattr(psutil, "sensors_temperatures", dict)()
        values = [sensor.current for sensors in by_chip.values() for sensor in sensors]
        return max(values) if values else None

    def memory_bytes(self) -> int:
        """Return the size of the physical memory in bytes."""
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")

    def free_bytes(self) -> int:
        """Return the memory in bytes that programs can still have without swapping."""
        return int(psutil.virtual_memory().available)

    def memory_limit_bytes(self) -> int | None:
        """Return the lowest memory limit, in bytes, of this process's control group and its parents.

        Return None if no limit is below the physical memory.
        """
        limits = [int(text) for file in self._limit_files() if (text := _text_of(file)).isdecimal()]
        return min((limit for limit in limits if limit < self.memory_bytes()), default=None)

    def _limit_files(self) -> Iterator[Path]:
        """Yield the files with the memory limits of this process's control groups, of version 2 and version 1."""
        for line in _text_of(self.proc / "self/cgroup").splitlines():
            _, kind, path = line.split(":", 2)
            if kind in ("", "memory"):
                group = PurePosixPath(path.lstrip("/"))
                name = "memory.limit_in_bytes" if kind else "memory.max"
                yield from (self.sys / "fs/cgroup" / kind / part / name for part in (group, *group.parents))

    def oom_kills(self) -> int:
        """Return the number of processes that the kernel has ended so far because memory ran out; 0 if unknown."""
        lines = (line.split() for line in _text_of(self.proc / "vmstat").splitlines())
        return next((int(words[1]) for words in lines if words[0] == "oom_kill"), 0)

    def open_counter(self, attributes: bytes, flags: int) -> int:
        """Return the descriptor of a counter of events of this thread (perf_event_open(2)). Raises OSError if refused.

        `attributes`: bytes of a `perf_event_attr`, which names the event. `flags`: flags of the system call.
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
        """Return up to `size` bytes of present values of the counter `file` (from `open_counter`). Raises OSError."""
        return os.read(file, size)

    def system(self) -> str:
        """Return a text with names and versions of the kernel and the C library."""
        return platform.platform()

    def python(self) -> str:
        """Return the version of this Python."""
        return platform.python_version()

    def host_name(self) -> str:
        """Return the machine's name in its network."""
        return platform.node()

    def program(self, name: str, first: Path | None = None) -> str | None:
        """Return the path of the program `name`; None if it is not installed.

        `first`: folder to search before the folders of PATH.
        """
        path = os.environ.get("PATH", os.defpath)
        return shutil.which(name, path=path if first is None else f"{first}{os.pathsep}{path}")

    def package_file(self, name: str) -> Path | None:
        """Return the file of the module or package `name`, without importing it; None if it is not installed."""
        found = importlib.util.find_spec(name)
        return None if found is None else Path(found.origin or "")

    def has_package(self, name: str) -> bool:
        """Return whether a module or package is installed, without importing it."""
        return self.package_file(name) is not None

    def cache_home(self) -> Path:
        """Return the folder of this user's caches, which may not exist.

        Raises RuntimeError for a user without a home.
        """
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")

    def now(self) -> datetime:
        """Return the date and time in UTC."""
        return datetime.now(UTC)


#: The machine that this process runs on.
here = Machine()


def last_level_bytes(cores: Iterable[int]) -> int:
    """Return the size in bytes of the largest last-level cache of `cores`; 0 if the kernel states none.

    The kernel of a virtual machine may state the cache of the whole host.
    """
    folder = here.sys / "devices/system/cpu"
    return max((_cache_bytes(folder / f"cpu{core}" / "cache") for core in cores), default=0)


def moved_of_kept(kept_bytes: int) -> int:
    """Return how many of the `kept_bytes` a stage reads from memory again in each frame.

    If the kept bytes exceed the last-level cache, all of them are read again, else none.

    `kept_bytes`: number of bytes that the stage keeps between frames, such as a network's weights.
    """
    return 0 if kept_bytes <= last_level_bytes(here.cores()) else kept_bytes


def _text_of(file: Path) -> str:
    """Return the text of a file of the kernel, without white space at its ends; "" if the file cannot be read."""
    try:
        return file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def _cache_bytes(caches: Path) -> int:
    try:
        levels = {int((index / "level").read_text()): index for index in caches.glob("index[0-9]*")}
        return _bytes((levels[max(levels)] / "size").read_text().strip()) if levels else 0
    except (OSError, ValueError):
        return 0


def _bytes(text: str) -> int:
    """Return the number of bytes in a size that the kernel wrote, such as 307200K."""
    return int(text[:-1]) * KERNEL_UNITS[text[-1]] if text[-1:] in KERNEL_UNITS else int(text)


MIB: Final = 1 << 20
#: Address space of the largest process of a default run: unit dsp, with OpenVINO.
ADDRESS_BYTES: Final = 1700 * MIB
#: Address space that every process of a run needs. With less, no OpenGL driver loads. With less than half of this
#: size, NumPy ends the process.
LEAST_ADDRESS_BYTES: Final = 512 * MIB
#: Memory of the smallest run: tensors of 64x64, pictures of 160x120. With less, the kernel ends processes of the run.
LEAST_RUN_BYTES: Final = 255 * MIB
#: Memory of all processes of a default run, with shared pages counted once.
RUN_BYTES: Final = 600 * MIB
NEEDED: Final = f"a run takes {RUN_BYTES // MIB} MiB"

_KILLS = here.oom_kills()


def require_memory(part: int = 1) -> None:
    """Raise TrilaneError if a limit on memory is below 1 / `part` of what the smallest run needs."""
    if (limit := _address_limit()) < LEAST_ADDRESS_BYTES // part:
        found = f"found a limit of {limit // MIB} MiB of addresses (ulimit -v)"
        expected = f"expected at least {ADDRESS_BYTES // MIB} MiB for a run"
        raise TrilaneError(f"memory: {found}, {expected}: ulimit -v unlimited")
    group = here.memory_limit_bytes()
    if group is not None and group < LEAST_RUN_BYTES // part:
        found = f"found a limit of {group // MIB} MiB for the control group"
        raise TrilaneError(f"memory: {found}, expected at least {RUN_BYTES // MIB} MiB for a run")


def shortage() -> str:
    """Return the evidence that memory is short, as part of a sentence; "" without evidence.

    Call this only after a failure that a lack of memory may have caused. Limits that count as evidence here may still
    let a run of small tensors pass.
    """
    if (limit := _address_limit()) < ADDRESS_BYTES:
        needed = f"a run's largest process takes {ADDRESS_BYTES // MIB} MiB: ulimit -v unlimited"
        return f"each process may have {limit // MIB} MiB of addresses (ulimit -v), and {needed}"
    group = here.memory_limit_bytes()
    if group is not None and group < RUN_BYTES:
        return f"the control group may have {group // MIB} MiB of memory, and {NEEDED}"
    return ended_by_system()


def ended_by_system() -> str:
    """Return, as part of a sentence, that the kernel has ended a process because memory ran out; "" if it has not.

    Only time since the begin of this process counts.
    """
    if here.oom_kills() <= _KILLS:
        return ""
    free = f"{here.free_bytes() // MIB} MiB are free now"
    return f"the system has meanwhile ended a process because memory ran out, and {NEEDED}; {free}"


def _address_limit() -> float:
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return float("inf") if limit == resource.RLIM_INFINITY else limit


SHORTEST_SLICE_NS = 100_000
UNIT_SLICE_NS = 1_000_000  # shorter than the slice of other programs, longer than the scheduler's
USUAL_SLICE = 0
#: <asm/unistd.h>
SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
#: The struct sched_attr of <linux/sched/types.h>: size, policy, flags, nice, priority, runtime, deadline, period.
SCHED_ATTR = "=IIQiIQQQ"
SCHED_OTHER = 0
#: Linux's "PM QoS" file. The integer written to it is a time in us; while the file is open, no core sleeps so deeply
#: that waking it takes longer.
LATENCY_FILE = Path("/dev/cpu_dma_latency")
AWAKE = "wait awake"


def use_slice(slice_ns: int) -> bool:
    """Ask the kernel for a time slice of `slice_ns` for this thread, and for processes and threads that it starts.

    USUAL_SLICE stands for the kernel's own slice. Return whether the kernel accepted the request.
    """
    number = SCHED_SETATTR.get(here.architecture())
    if number is None or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return False
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    attributes = struct.pack(SCHED_ATTR, struct.calcsize(SCHED_ATTR), SCHED_OTHER, 0, nice, 0, slice_ns, 0, 0)
    return bool(ctypes.CDLL(None).syscall(number, 0, attributes, 0) == 0)


@contextlib.contextmanager
def awake(wanted: bool = True) -> Iterator[str]:
    """If `wanted`, keep idle cores of the whole machine awake inside the `with` block.

    Yield AWAKE; if cores may sleep, yield `sleep: ` and the reason. A sleeping core takes 50 us and more to react to a
    message; a core that is kept awake takes power. Usually only root may keep cores awake. When the process ends, the
    kernel lets cores sleep again.
    """
    if not wanted:
        yield "sleep: the performance profile asks for no haste"
        return
    with contextlib.ExitStack() as stack:
        try:
            file = os.open(LATENCY_FILE, os.O_WRONLY | os.O_CLOEXEC)
            stack.callback(os.close, file)
            os.write(file, struct.pack("=i", 0))
            idle_cores = AWAKE
        except OSError as error:
            idle_cores = f"sleep: {LATENCY_FILE}: {reason(error)}"
        yield idle_cores
