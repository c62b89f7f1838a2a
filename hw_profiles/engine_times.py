"""The time that a tensor engine takes for each layer of a network, from shared terms and six numbers of the chip.

    cost of a term    amount * factor / rate             factor: shared by all chips; rate: the chip's, one of six
    time of a layer   (a^4 + m^4 + s^4)^(1/4) + w + o    arithmetic, activations moved, spill; weights, fixed

Products, movement and spill go on at once, so the slowest decides, with a smooth transition where two are alike (as in
the roofline of Williams, Waterman and Patterson, 2009). Spill is what does not fit on the chip. The tensor that is read
last goes out first (Belady, 1966: no rule moves less). No measured time is looked up anywhere.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from trilane.arrays import F64
from trilane.hw_profiles.operators import INDEX, NAMES, RATES, TERMS, Layers
from trilane.hw_profiles.schema import Engine

#: Which power joins what goes on at once: 1 would be one after the other, infinity the slowest alone.
JOINED = 4.0
#: What decides an operator's time.
Bound = Literal["arithmetic", "activation traffic", "spill", "weight traffic", "fixed"]
BOUNDS: tuple[Bound, ...] = ("arithmetic", "activation traffic", "spill", "weight traffic", "fixed")
#: Terms of each rate, as a mask (rates, terms).
OF_RATE = np.array([[TERMS[name] == rate for name in NAMES] for rate in RATES])
#: Terms that belong to the job and to no layer.
OF_JOB = np.array([name in ("input", "output", "job") for name in NAMES])


@dataclass(frozen=True)
class EngineNumbers:
    """An engine as plain numbers.

    `seconds`: seconds of one unit of each term (terms,). `room`: elements that fit on the chip.
    """

    seconds: F64
    room: int


@dataclass(frozen=True)
class EngineTime:
    """Seconds of a job.

    `layers`: by layer and bound (layers, 5). `job`: what belongs to no layer. `shares`: by term (terms,), how the whole
    grows with each term; a term that another one hides has a small share.
    """

    layers: F64
    job: float
    shares: F64

    @property
    def total(self) -> float:
        return float(self.layers.sum()) + self.job


def numbers_of(engine: Engine, clock_fraction: float = 1.0, memory_fraction: float = 1.0) -> EngineNumbers:
    """Return the numbers of an engine.

    `engine`: tensor engine of a profile.
    `clock_fraction`: fraction of its highest clock, above 0 to 1; it slows everything that happens on the engine.
    `memory_fraction`: share of the memory's bandwidth that is left for it.
    """
    # Only spill and weights cross the main memory; all other work slows down with the engine's clock.
    slower = {"spill": memory_fraction, "weight": memory_fraction}
    per_unit = {rate: engine.seconds_per_unit(rate) / slower.get(rate, clock_fraction) for rate in RATES}
    seconds = [per_unit[TERMS[name]] * engine.factor(name) for name in NAMES]
    return EngineNumbers(np.array(seconds), int(engine.on_chip_mb.or_else(4.0) * 2**20 / engine.element_bytes))


def amounts(network: Layers, room: int) -> F64:
    """Return the amount of each term (layers + 1, terms): a row for each layer, with its spill, and one for the job."""
    table = np.vstack([network.table, np.zeros(len(NAMES))])
    table[:-1, INDEX["spill"]] = spilled(network, room)
    for name, amount in (("input", network.input), ("output", network.output), ("job", 1)):
        table[-1, INDEX[name]] = amount
    return table


def engine_time(network: Layers, engine: EngineNumbers, batch: int = 1) -> EngineTime:
    """Return the time of one job of `batch` frames. Weights and fixed costs count once per job.

    `network`: layers of the network.
    `engine`: numbers of the engine.
    """
    once = OF_RATE[3:].any(axis=0)  # weights, and the fixed costs of operators and job
    costs = amounts(network, engine.room) * engine.seconds * np.where(once, 1, batch)
    joined, slopes = join(costs[:-1])
    shares = np.vstack([costs[:-1] * slopes, costs[-1:]]).sum(axis=0)
    return EngineTime(joined, float(costs[-1].sum()), shares / max(shares.sum(), 1e-30))


def join(costs: F64) -> tuple[F64, F64]:
    """Join the costs of each layer.

    Return seconds by layer and bound (layers, 5), and how a layer's time grows with each cost (layers, terms). Parts
    that go on at once divide the time by their shares in the sum of powers.
    `costs`: seconds by layer and term (layers, terms).
    """
    by_rate = costs @ OF_RATE.T
    at_once = by_rate[:, :3]
    # Relative to the largest, so that the powers neither overflow nor vanish.
    largest = np.maximum(at_once.max(axis=1, keepdims=True), 1e-30)
    powers = (at_once / largest) ** JOINED
    whole = largest * powers.sum(axis=1, keepdims=True) ** (1 / JOINED)
    divided = whole * powers / np.maximum(powers.sum(axis=1, keepdims=True), 1e-30)
    slopes = (at_once / np.maximum(whole, 1e-30)) ** (JOINED - 1)
    by_bound = np.column_stack([divided, by_rate[:, 3], by_rate[:, 4] + by_rate[:, 5]])
    return by_bound, np.column_stack([slopes, np.ones((len(costs), 3))]) @ OF_RATE


@lru_cache(maxsize=512)
def spilled(network: Layers, room: int) -> tuple[int, ...]:
    """Return elements that each layer reads from or sends to the main memory when `room` elements fit on the chip.

    The network's input comes from the main memory, and its results go there. A layer's result stays on the chip until
    its last reader. Where room is short, the tensor that is read last goes out, in part if a part is enough. A
    concatenation moves nothing: its readers read its parts.
    """
    chip = _Chip(network, room)
    return tuple(chip.run(index) for index in range(len(network.layers)))


class _Chip:
    """What lies on the chip: elements of each tensor, and when each will be read."""

    def __init__(self, network: Layers, room: int) -> None:
        self._layers, self._sizes, self._room = network.layers, network.sizes, room
        self._parts: dict[str, tuple[str, ...]] = {}
        self._readers: dict[str, list[int]] = defaultdict(list)
        self._held: dict[str, int] = {}
        for index, layer in enumerate(network.layers):
            if layer.kind == "Concat":
                self._parts[layer.writes] = self._read(layer.reads)
                continue
            for name in self._read(layer.reads):
                self._readers[name].append(index)

    def _read(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the tensors behind `names`, each once; a concatenation stands for its parts."""
        return tuple(dict.fromkeys(part for name in names for part in self._parts.get(name, (name,))))

    def _next(self, name: str, index: int) -> int:
        """Return the next layer after `index` that reads the tensor, or one past the last."""
        return next((reader for reader in self._readers[name] if reader > index), len(self._layers))

    def run(self, index: int) -> int:
        """Run the layer `index` and return the elements that it moves."""
        layer = self._layers[index]
        if layer.kind == "Concat":
            return 0
        moved = 0
        for name in self._read(layer.reads):
            moved += self._sizes[name] - self._held.get(name, 0)
            if self._next(name, index) == len(self._layers):
                self._held.pop(name, None)
        return moved + sum(self._keep(name, index) for name in (layer.writes, *layer.more))

    def _keep(self, name: str, index: int) -> int:
        """Put the result of the layer `index` on the chip; return the elements that must go out for want of room."""
        size, soon, gone = self._sizes[name], self._next(name, index), 0
        if soon == len(self._layers):
            return size
        free = self._room - sum(self._held.values())
        for other in sorted(self._held, key=lambda held: -self._next(held, index)):
            if free >= size or self._next(other, index) <= soon:
                break
            part = min(self._held[other], size - free)
            self._held[other] -= part
            free, gone = free + part, gone + part
        self._held[name] = max(0, min(size, free))
        return gone + size - self._held[name]
