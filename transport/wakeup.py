"""How soon a process that a message wakes gets its core. Rule: it asks the kernel, and is none the worse when refused.

Linux lets a woken task wait until the running one's time slice ends, about 3 ms, unless its own slice is shorter
(EEVDF since Linux 6.12; older kernels ignore the wish). Here, with another process busy on the same core, the 99th
percentile of the wake-up went from 3.4 ms to 0.2 ms.

It matters most for ZeroMQ's I/O threads. A unit that says `Done` begins its next job the moment after, and the thread
that should carry the message waited on the same core until that job's slice was over: 1.6 ms from raster to infer.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import struct
from collections.abc import Iterator
from pathlib import Path

from trilane.errors import reason

SHORTEST_NS = 100_000
UNIT_NS = 1_000_000  # a unit that a job wakes goes before other programs, and lets the scheduler go before itself
DEFAULT = 0
#: <asm/unistd.h>
SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
#: struct sched_attr of <linux/sched/types.h>: size, policy, flags, nice, priority, runtime, deadline, period.
SCHED_ATTR = "=IIQiIQQQ"
SCHED_OTHER = 0
#: Linux's "PM QoS": while it is open, no core sleeps so deeply that waking takes longer than the written int, in us.
LATENCY_FILE = Path("/dev/cpu_dma_latency")
AWAKE = "wait awake"


def use_slice(slice_ns: int) -> bool:
    """Ask for a slice of `slice_ns` for this thread and the processes it starts; whether the kernel took the wish."""
    number = SCHED_SETATTR.get(platform.machine())
    if number is None or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return False
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    wish = struct.pack(SCHED_ATTR, struct.calcsize(SCHED_ATTR), SCHED_OTHER, 0, nice, 0, slice_ns, 0, 0)
    return bool(ctypes.CDLL(None).syscall(number, 0, wish, 0) == 0)


@contextlib.contextmanager
def awake(wanted: bool = True) -> Iterator[str]:
    """While entered, cores without work stay awake, on the whole machine. Yields AWAKE, or that they sleep, and why.

    A core that sleeps takes 50 us and more to hear of a message; one that waits awake takes power. For root alone,
    unless the machine's owner says otherwise; the kernel forgets it with the process.
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
