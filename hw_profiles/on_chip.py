"""Which activations do not fit into the memory of the chip's tensor engine, and travel to and from the main memory.

Rule: a pure function of the layers and of the room. A layer's result stays on the chip until its last reader; where
there is no room, that goes out which is read last (Belady, 1966: no rule moves less), in part if a part is enough. A
concatenation moves nothing: its readers read its parts.
"""

from __future__ import annotations

from collections import defaultdict
from functools import lru_cache

from trilane.hw_profiles.engine_layers import Layers


@lru_cache(maxsize=512)
def spilled(network: Layers, room: int) -> tuple[int, ...]:
    """Elements that each layer reads from or sends to the main memory where `room` elements fit on the chip.

    The network's input comes from the main memory, and its results go there.
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
        """The tensors behind `names`, each once: a concatenation stands for its parts."""
        return tuple(dict.fromkeys(part for name in names for part in self._parts.get(name, (name,))))

    def _next(self, name: str, index: int) -> int:
        """The next layer after `index` that reads the tensor, or one past the last."""
        return next((reader for reader in self._readers[name] if reader > index), len(self._layers))

    def run(self, index: int) -> int:
        """Run the layer `index`; return what it moves."""
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
        """Put the result of the layer `index` on the chip; return what has to go out for want of room."""
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
