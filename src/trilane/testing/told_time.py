"""Stands for a module's `time`. Rule: time passes by what is slept, and a microsecond with every look."""

from __future__ import annotations

BEGIN_NS = 5_000_000


class ToldTime:
    """`now_ns`: of the clock. `slept`: ns of each sleep."""

    def __init__(self) -> None:
        self.now_ns = BEGIN_NS
        self.slept: list[int] = []

    def monotonic_ns(self) -> int:
        self.now_ns += 1000
        return self.now_ns

    def monotonic(self) -> float:
        return self.monotonic_ns() / 1e9

    def sleep(self, seconds: float) -> None:
        self.slept.append(round(seconds * 1e9))
        self.now_ns += round(seconds * 1e9)
