"""Stages whose slots hold named arrays: where each array lies in a slot, and the base class of such a stage.

Rule: an array is a view of the slot's memory, never a copy. Each begins on its own cache line. The types of all ports
are known before a slot is made, so that a stage and its readers find the same places.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import U8
from trilane.pipeline.description import Model
from trilane.pipeline.file_keys import TYPES, PortType, port_type
from trilane.transport.packets import Packet

LINE = 64  # bytes of a cache line, and of the widest vector register
Arrays = Mapping[str, NDArray[Any]]
#: The types of the ports of a stream, by name, as `u8 256x256x3`; the name of a lone port may be empty.
Ports = Mapping[str, str]


def payload_bytes(ports: Mapping[str, PortType]) -> int:
    """Return the bytes that the ports take up in a slot."""
    return sum(-(-port.payload_bytes // LINE) * LINE for port in ports.values())


def views(payload: U8, ports: Mapping[str, PortType]) -> dict[str, NDArray[Any]]:
    """Return the array of each port in a slot. Raises ValueError when the slot is too small."""
    found: dict[str, NDArray[Any]] = {}
    start = 0
    for name, port in ports.items():
        end = start + port.payload_bytes
        if end > payload.size:
            raise ValueError(f"a slot of {payload.size} bytes, {end} needed")
        found[name] = payload[start:end].view(TYPES[port.dtype]).reshape(port.shape)
        start += -(-port.payload_bytes // LINE) * LINE
    return found


class PortRead(Model):
    """What a port of a stage reads. `stream`: place of the stream among the stage's inputs; `port`: its port."""

    name: str
    stream: int
    port: str


class PassedPorts(Model):
    """The slots from which the stage takes frames that come by a bypass; they are counted after its own slots.

    `behind`: number of slots of the stage's own stream. `ports`: ports in the slots of the bypass.
    """

    behind: int
    ports: Ports


class PortedSettings(Model):
    """The settings of every stage with ports.

    `where`: file and key of the stage, for errors.
    `folder`: folder of the pipeline file.
    `run_folder`: folder of the run.
    `joins`: whether the stage is a `trilane.pipeline.stage.JoiningStage`.
    `reads`: ports of the stage, in the order of the file.
    `streams`: ports of each stream that it reads.
    `writes`: ports that it writes; empty where nobody reads it and the file says none.
    `keys`: the stage's keys that only its kind of stage has.
    `bypass`: ports of the bypass that ends at the stage; None without one.
    """

    where: str
    folder: Path
    run_folder: Path
    joins: bool
    reads: tuple[PortRead, ...]
    streams: tuple[Ports, ...]
    writes: Ports
    keys: dict[str, Any]
    bypass: PassedPorts | None = None


class Read(NamedTuple):
    """A port that a stage reads: its name, and its type."""

    name: str
    type: PortType


class PortedStage:
    """A `trilane.pipeline.stage.Stage` or `JoiningStage` that gets arrays. A subclass writes `work`.

    `reads`: ports that it reads. `writes`: types of the ports that it writes, by name.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self.settings = PortedSettings.model_validate(settings)
        self._streams = [_types(ports) for ports in self.settings.streams]
        self.reads = [Read(each.name, self._streams[each.stream][each.port]) for each in self.settings.reads]
        self.writes = _types(self.settings.writes)
        self._inputs: list[list[Mapping[str, NDArray[Any] | None]]] = []
        self._outputs: list[dict[str, NDArray[Any]]] = []
        self._headers: list[list[NDArray[np.void]]] = []
        self._slots: Sequence[int | None] = ()

    @property
    def sampled_ns(self) -> int:
        """The time on CLOCK_MONOTONIC at which the frame in work was sampled; 0 where no input says it."""
        taken = [of[slot] for of, slot in zip(self._headers, self._slots, strict=True) if slot is not None]
        return min((int(header["t_sampled_ns"]) for header in taken), default=0)

    def bind(self, inputs: Sequence[Any], outputs: Sequence[Packet]) -> None:
        """Make the views of all slots, then call `ready`."""
        streams: Sequence[Sequence[Packet]] = inputs if self.settings.joins else [inputs] if inputs else []
        self._inputs = [
            [self._views(place, packet, ports) for place, packet in enumerate(packets)]
            for packets, ports in zip(streams, self._streams, strict=True)
        ]
        self._outputs = [views(packet.payload, self.writes) for packet in outputs]
        self._headers = [[packet.header for packet in packets] for packets in streams]
        self.ready()

    def _views(self, place: int, packet: Packet, ports: Mapping[str, PortType]) -> Mapping[str, NDArray[Any] | None]:
        """Return the arrays of a slot; of one that comes by the bypass, those ports that its writer has too."""
        passed = self.settings.bypass
        if passed is None or place < passed.behind:
            return _read_only(views(packet.payload, ports))
        given = _types(passed.ports)
        arrays = _read_only(views(packet.payload, given))
        return {name: arrays[name] if given.get(name) == port else None for name, port in ports.items()}

    def run(self, frame: int, slot_in: Any, slot_out: int | None) -> Mapping[str, float]:
        slots: Sequence[int | None] = slot_in if self.settings.joins else () if slot_in is None else (slot_in,)
        self._slots = slots
        taken = [None if slot is None else of[slot] for of, slot in zip(self._inputs, slots, strict=True)]
        arrays = [None if (of := taken[each.stream]) is None else of[each.port] for each in self.settings.reads]
        return self.work(frame, arrays, {} if slot_out is None else self._outputs[slot_out])

    def ready(self) -> None:
        """Prepare what the first frame needs; called once, when the slots are there."""

    def work(self, frame: int, arrays: Sequence[NDArray[Any] | None], outputs: Arrays) -> Mapping[str, float]:
        """Do a frame, and return metrics.

        A `trilane.pipeline.stage.Skip` sends the frame to the bypass that begins at the stage.

        `arrays`: array of each of `reads`, read-only; None if there is no newest frame yet, or if the frame took a
        bypass that lacks the port.
        `outputs`: array of each of `writes`, to be filled; empty where nobody reads the stage.
        """
        raise NotImplementedError

    def forget(self) -> None:
        """Do not send the next frame to a bypass because of earlier frames."""

    def close(self) -> None:
        """Release what the stage holds."""


def _types(ports: Ports) -> dict[str, PortType]:
    return {name: port_type(text) for name, text in ports.items()}


def _read_only(arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    for array in arrays.values():
        array.flags.writeable = False
    return arrays
