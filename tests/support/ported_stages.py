"""A stage with ports in this process: its slots, its settings, and one call of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.pipeline.description import UnitSettings
from trilane.pipeline.file_keys import port_type
from trilane.pipeline.stage import PortedStage, UnitContext, payload_bytes, views
from trilane.transport.packets import Packet, SlotLayout, header_dtype, view_packet

UNIT = UnitContext("cpu", UnitSettings(cores=(0,), threads=1), {})


class Ported:
    """A stage on one slot for each input and one for its output.

    `reads`: type of each port that it reads, each of a stream of its own. `writes`: types of those that it writes.
    """

    def __init__(
        self,
        build: Callable[[Mapping[str, Any], UnitContext], PortedStage],
        reads: Mapping[str, str],
        writes: Mapping[str, str],
        folder: Path,
        **keys: Any,
    ) -> None:
        settings = {
            "where": "file.toml: stages.tried",
            "folder": str(folder),
            "run_folder": str(folder),
            "joins": len(reads) != 1,
            "reads": [{"name": name, "stream": place, "port": ""} for place, name in enumerate(reads)],
            "streams": [{"": kind} for kind in reads.values()],
            "writes": dict(writes),
            "keys": keys,
        }
        self.stage = build(settings, UNIT)
        self._reads = [_slot({"": kind}) for kind in reads.values()]
        self._arrays = [
            views(p.payload, {"": port_type(k)})[""] for p, k in zip(self._reads, reads.values(), strict=True)
        ]
        output = _slot(writes)
        self.written = views(output.payload, {name: port_type(kind) for name, kind in writes.items()})
        inputs: list[Any] = [[packet] for packet in self._reads]
        self.stage.bind(inputs[0] if len(inputs) == 1 else inputs, [output] if writes else [])

    def __call__(self, *arrays: NDArray[Any] | None, frame: int = 0) -> NDArray[Any]:
        """Do a frame, and return what the first output port holds."""
        for own, given in zip(self._arrays, arrays, strict=True):
            if given is not None:
                own[...] = given
        slots = tuple(None if array is None else 0 for array in arrays)
        self.stage.run(frame, slots[0] if len(slots) == 1 else slots, 0 if self.written else None)
        return next(iter(self.written.values())).copy() if self.written else np.empty(0)


def _slot(ports: Mapping[str, str]) -> Packet:
    layout = SlotLayout(header_dtype(), payload_bytes({name: port_type(kind) for name, kind in ports.items()}))
    return view_packet(memoryview(bytearray(layout.slot_bytes)), layout)
