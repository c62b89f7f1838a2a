"""A stage that spends what it is told. Rule: CPU time is spent on a core, sleep is slept; nothing else takes time."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from trilane.pipeline.stage import UnitContext
from trilane.transport.packets import Packet

FACTORY = "support.cpu_load:build"
BLOCK = bytes(1 << 16)  # hashed in some 50 us, without the interpreter's lock


class CpuLoad:
    """`trilane.pipeline.stage.Stage`. In each job `threads` threads compute for `cpu_ms` each, then one sleeps."""

    def __init__(self, cpu_ms: float, sleep_ms: float, threads: int) -> None:
        self._cpu_ns, self._sleep_s = round(cpu_ms * 1e6), sleep_ms / 1e3
        self._others = ThreadPoolExecutor(threads - 1) if threads > 1 else None
        self._threads = threads

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Nothing is passed on but headers."""

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:  # noqa: ARG002
        others = [self._others.submit(compute, self._cpu_ns) for _ in range(self._threads - 1)] if self._others else []
        compute(self._cpu_ns)
        for other in others:
            other.result()
        if self._sleep_s:
            time.sleep(self._sleep_s)
        return {}

    def close(self) -> None:
        if self._others is not None:
            self._others.shutdown()


def compute(cpu_ns: int) -> None:
    """Until the calling thread has had so much CPU time."""
    end_ns = time.thread_time_ns() + cpu_ns
    while time.thread_time_ns() < end_ns:
        hashlib.sha256(BLOCK)


def build(settings: Mapping[str, Any], unit: UnitContext) -> CpuLoad:
    """The stage of `settings`: `cpu_ms`, `sleep_ms`, and whether its unit has a `device`, that works asleep."""
    if settings["device"]:
        unit.use_device("none: the sleep stands for its work")
    return CpuLoad(settings["cpu_ms"], settings["sleep_ms"], unit.settings.threads)
