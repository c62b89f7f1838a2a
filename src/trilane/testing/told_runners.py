"""Stands for `trilane.bench.lib.interleaved_processes.runners`. Rule: times are those that were told; asks are kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any


class ToldRunners:
    """`ms(name, turn)`: what the runs of a turn take, turns from 0. `variants`: of each call. `asked`: (name, what)."""

    def __init__(self, ms: Callable[[str, int], list[float]]) -> None:
        self._ms = ms
        self.variants: list[dict[str, Any]] = []
        self.asked: list[tuple[str, float]] = []

    @contextmanager
    def __call__(self, variants: Mapping[str, Any]) -> Iterator[dict[str, ToldRunner]]:
        self.variants.append(dict(variants))
        yield {name: ToldRunner(self, name, 100.0 * len(self.variants) + place) for place, name in enumerate(variants)}

    def answer(self, name: str, what: float) -> list[float]:
        self.asked.append((name, what))
        return self._ms(name, sum(one == name for one, _ in self.asked) - 1)


class ToldRunner:
    """`startup_ms`: 100 for each call of `runners` so far, and the place in it."""

    def __init__(self, told: ToldRunners, name: str, startup_ms: float) -> None:
        self._told, self._name, self.startup_ms = told, name, startup_ms

    def run(self, count: int) -> list[float]:
        return self._told.answer(self._name, count)

    def run_for(self, seconds: float) -> list[float]:
        return self._told.answer(self._name, seconds)
