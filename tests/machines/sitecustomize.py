"""Another machine in place of `trilane.machine.here`, in every Python process of a row of tests/machines.toml.

Python imports this file when it starts, units and commands included, because the row puts its folder on PYTHONPATH.
TRILANE_TEST_MACHINE says what the machine has, as JSON:

counters: `present`; `unreadable`: they open, and each reading after the first raises ECHILD, which a kernel did when a
    thread had ended; `refused`: nothing may be counted, as in many containers.
flags: of the processor that it lacks.
packages: that it lacks.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import struct
import sys
import time
from collections.abc import Iterator
from importlib.machinery import PathFinder
from importlib.metadata import Distribution, DistributionFinder
from typing import Any

ASKED = json.loads(os.environ.get("TRILANE_TEST_MACHINE", "{}"))
HARDWARE = 0  # linux/perf_event.h: the type of the processor's own events


class Hiding(PathFinder):
    """Finds every package but those that the machine lacks, and says of none of these that it is installed."""

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: Any = None) -> Any:
        if name.partition(".")[0] in ASKED["packages"]:
            return None
        return super().find_spec(name, path, target)

    @staticmethod
    def find_distributions(context: Any = DistributionFinder.Context()) -> Iterator[Distribution]:  # noqa: B008
        return (each for each in PathFinder.find_distributions(context) if each.name not in ASKED["packages"])


def other_machine(real: type) -> Any:
    """A machine like this one, but as it was asked for; `real`: the class of this one."""

    class Other(real):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            self._opened: dict[int, list[int]] = {}

        def cpu_fields(self) -> dict[str, str]:
            lacks = ASKED.get("flags", ())
            return {
                key: " ".join(word for word in value.split() if word not in lacks)
                if key in ("flags", "Features")
                else value
                for key, value in super().cpu_fields().items()
            }

        def open_counter(self, attributes: bytes, flags: int) -> int:
            how, (kind,) = ASKED.get("counters"), struct.unpack_from("=I", attributes)
            if how == "refused":
                raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))
            if how is None or kind != HARDWARE:
                file: int = super().open_counter(attributes, flags)
                self._opened.pop(file, None)  # the number of one that was closed
                return file
            file = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
            self._opened[file] = [time.monotonic_ns(), 0]
            return file

        def read_counter(self, file: int, size: int) -> bytes:
            """CPU time of the process in ns stands for every event."""
            if file not in self._opened:
                return bytes(super().read_counter(file, size))
            began_ns, readings = self._opened[file]
            if readings and ASKED["counters"] == "unreadable":
                raise ChildProcessError(errno.ECHILD, os.strerror(errno.ECHILD))
            self._opened[file][1] += 1
            there_ns = time.monotonic_ns() - began_ns
            return struct.pack("=QQQ", time.process_time_ns(), there_ns, there_ns)[:size]

    return Other()


if ASKED.get("packages"):
    sys.meta_path[sys.meta_path.index(PathFinder)] = Hiding
if ASKED:
    with contextlib.suppress(ModuleNotFoundError):  # a process that has nothing to do with Trilane
        from trilane import machine

        machine.here = other_machine(machine.Machine)
