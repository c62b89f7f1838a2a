"""How long a tensor engine takes for each layer of a network: shared terms, and six numbers of the chip.

Rule: a pure function of a network's layers and of an engine's numbers; no measured time is looked up anywhere.

    cost of a term    amount * factor / rate             factor: shared by all chips; rate: the chip's, one of six
    time of a layer   (a^4 + m^4 + s^4)^(1/4) + w + o    arithmetic, activations moved, spill; weights, fixed
    time of a job     sum over layers + input and output + fixed

Products, movement and spill go on at once, so that the slowest decides (as in the roofline of Williams, Waterman and
Patterson, 2009), smoothly where two are alike. Weights and fixed costs add to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from trilane.arrays import F64
from trilane.hw_profiles.engine_layers import INDEX, NAMES, RATES, TERMS, Layers
from trilane.hw_profiles.on_chip import spilled
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
    """An engine as plain numbers. `seconds`: of one unit of each term (terms,). `room`: elements that it holds."""

    seconds: F64
    room: int


@dataclass(frozen=True)
class EngineTime:
    """Seconds of a job. `layers`: by layer and bound (layers, 5). `job`: of no layer. `shares`: by term (terms,).

    `shares` say how the whole grows with each term: a term that another one hides has a small one.
    """

    layers: F64
    job: float
    shares: F64

    @property
    def total(self) -> float:
        return float(self.layers.sum()) + self.job


def numbers_of(engine: Engine, clock_fraction: float = 1.0, memory_fraction: float = 1.0) -> EngineNumbers:
    """The numbers of an engine.

    `engine`: of a profile.
    `clock_fraction`: of its highest clock; it slows everything that happens on the engine.
    `memory_fraction`: share of the memory's bandwidth that is left for it.
    """
    slower = {"spill": memory_fraction, "weight": memory_fraction}
    per_unit = {rate: engine.seconds_per_unit(rate) / slower.get(rate, clock_fraction) for rate in RATES}
    seconds = [per_unit[TERMS[name]] * engine.factor(name) for name in NAMES]
    return EngineNumbers(np.array(seconds), int(engine.on_chip_mb.or_else(4.0) * 2**20 / engine.element_bytes))


def amounts(network: Layers, room: int) -> F64:
    """Amounts of each term (layers + 1, terms): of each layer with its spill, and last those of the job."""
    table = np.vstack([network.table, np.zeros(len(NAMES))])
    table[:-1, INDEX["spill"]] = spilled(network, room)
    for name, amount in (("input", network.input), ("output", network.output), ("job", 1)):
        table[-1, INDEX[name]] = amount
    return table


def engine_time(network: Layers, engine: EngineNumbers, batch: int = 1) -> EngineTime:
    """Time of one job of `batch` frames. Weights and fixed costs count once per job.

    `network`: its layers.
    `engine`: its numbers.
    """
    once = OF_RATE[3:].any(axis=0)
    costs = amounts(network, engine.room) * engine.seconds * np.where(once, 1, batch)
    joined, slopes = join(costs[:-1])
    shares = np.vstack([costs[:-1] * slopes, costs[-1:]]).sum(axis=0)
    return EngineTime(joined, float(costs[-1].sum()), shares / max(shares.sum(), 1e-30))


def join(costs: F64) -> tuple[F64, F64]:
    """Seconds by layer and bound (layers, 5), and how a layer's time grows with each cost (layers, terms).

    `costs`: (layers, terms). What goes on at once is divided by its share in the sum of powers.
    """
    by_rate = costs @ OF_RATE.T
    at_once = by_rate[:, :3]
    largest = np.maximum(at_once.max(axis=1, keepdims=True), 1e-30)
    powers = (at_once / largest) ** JOINED
    whole = largest * powers.sum(axis=1, keepdims=True) ** (1 / JOINED)
    divided = whole * powers / np.maximum(powers.sum(axis=1, keepdims=True), 1e-30)
    slopes = (at_once / np.maximum(whole, 1e-30)) ** (JOINED - 1)
    by_bound = np.column_stack([divided, by_rate[:, 3], by_rate[:, 4] + by_rate[:, 5]])
    return by_bound, np.column_stack([slopes, np.ones((len(costs), 3))]) @ OF_RATE
