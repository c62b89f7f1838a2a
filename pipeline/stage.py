"""The interface of a stage to the process that runs it, and the base class of stages that get named arrays.

Rule: a stage sees only its slots, its settings and its unit.

The slots of a stage with ports contain named arrays, one for each port. Rule: an array is a view of the slot's memory,
never a copy. Each array begins on its own cache line. The types of all ports are known before a slot is made, so that a
stage and its readers use the same offsets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import U8
from trilane.pipeline.description import Model, UnitSettings
from trilane.pipeline.file_keys import TYPES, PortType, port_type
from trilane.pipeline.memory import Assets
from trilane.transport.packets import Packet

T = TypeVar("T")


class Skip(dict[str, float]):
    """The metrics that `Stage.run` returns for a frame that takes the pipeline's bypass.

    Only the stage at which `Pipeline.bypass` begins may return a `Skip`.
    """


class Stage(Protocol):
    """One stage inside a unit's process, made by a `StageFactory`.

    The stage at the end of `Pipeline.bypass` takes frames from two edges. Its `inputs` are the slots of its own input
    edge, followed by the slots of the edge on which the bypass begins.
    """

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Keep every slot of the stage's edges; called once, before the first job. Allocate memory here, never later.

        `inputs`, `outputs`: slots of the input edge and of the output edge; empty if there is no such edge.
        """

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """Do `frame` from `inputs[slot_in]` to `outputs[slot_out]`, and return metrics by name, often none.

        The first stage of a pipeline has no input, so `slot_in` is None; the last has no output, so `slot_out` is None.
        The header of the output slot already has the frame's number and sampling time. If the input edge has the same
        kind of header, the output's header already has all fields of the input's.
        """

    def close(self) -> None:
        """Release the stage's resources, and complete the files that the stage writes."""


class JoiningStage(Protocol):
    """A stage of a graph with several inputs, or with an input that takes the newest frame."""

    def bind(self, inputs: Sequence[Sequence[Packet]], outputs: Sequence[Packet]) -> None:
        """Keep every slot, as `Stage.bind`. `inputs`: slots of each input, in the order of the stage's inputs."""

    def run(self, frame: int, slots_in: tuple[int | None, ...], slot_out: int | None) -> Mapping[str, float]:
        """Do `frame`, as `Stage.run`.

        The header of the output slot already has the frame's number and the sampling time of the oldest input. Inputs
        that take the newest frame do not count for this time. The header has no other fields of the inputs.

        `slots_in`: slot of each input. None for an input that takes the newest frame, if it has no frame or only one
        that is too old.
        """

    def close(self) -> None:
        """Release the stage's resources, as `Stage.close`."""


class SteppedStage(Stage, Protocol):
    """The first stage of a pipeline with a ladder, whose frames may get less work (`works` of `run_pipeline`)."""

    def step_to(self, rung: int) -> None:
        """Give frames the work of `rung` from now on; called before `run` if the rung changes. The first rung is 0."""


class SkippingStage(Stage, Protocol):
    """The stage at which a pipeline's bypass begins. Its `run` may return a `Skip`."""

    def forget(self) -> None:
        """Forget what earlier frames brought to the end of the bypass; the next frame must not rely on these results.

        Called before `run` for the first frame. Called again after the unit at the bypass's end was restarted. Called
        too after a frame that did not skip was lost or dropped before the bypass's end.
        """


@dataclass(frozen=True)
class UnitContext:
    """The objects that the stages of one unit share in its process.

    `name`: name of the unit.
    `settings`: cores and threads of the unit.
    `assets`: arrays of the run that every stage may read; read-only.
    """

    name: str
    settings: UnitSettings
    assets: Assets
    _shared: dict[str, Any] = field(default_factory=dict)
    _devices: set[str] = field(default_factory=set)

    def shared(self, key: str, make: Callable[[], T]) -> T:
        """Return the process's only object with the name `key`; the first call makes the object with `make`.

        An example is the OpenGL context with which two stages draw.
        """
        if key not in self._shared:
            self._shared[key] = make()
        made: T = self._shared[key]
        return made

    def use_device(self, name: str) -> None:
        """Note that a device `name`, such as a graphics card, works for the unit besides the unit's cores.

        With a device, time in which the threads of a job sleep counts as busy, because the device works. Without a
        device, this time counts as idle.
        """
        self._devices.add(name)

    @property
    def has_device(self) -> bool:
        """Whether a stage called `use_device`."""
        return bool(self._devices)


class StageFactory(Protocol):
    """A function that builds a stage in the unit's process; `PipelineStage.factory` names it."""

    def __call__(self, settings: Mapping[str, Any], unit: UnitContext) -> Stage | JoiningStage:
        """Return the built stage. All slow work, and all work that may fail, belongs here.

        `settings`: `PipelineStage.settings`.
        `unit`: context of the unit that will run the stage.

        Raises BadInputError or MissingPartError.
        """


LINE = 64  # bytes of a cache line, and of the widest vector register
Arrays = Mapping[str, NDArray[Any]]
#: The types of the ports of a stream, such as `u8 256x256x3`, by the port's name; a single port may have an empty name.
Ports = Mapping[str, str]


def payload_bytes(ports: Mapping[str, PortType]) -> int:
    """Return the size in bytes of a payload with these ports, each filled up to whole cache lines."""
    return sum(-(-port.payload_bytes // LINE) * LINE for port in ports.values())


def views(payload: U8, ports: Mapping[str, PortType]) -> dict[str, NDArray[Any]]:
    """Return an array for each port, a view of the payload, by the port's name. Raises ValueError for a short payload.

    `payload`: (bytes,) uint8, payload of a slot.
    """
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
    """The input of one port of a stage.

    `name`: name of the reading port.
    `stream`: index, among the stage's inputs, of the stream that is read.
    `port`: name of the port that is read in this stream.
    """

    name: str
    stream: int
    port: str


class PassedPorts(Model):
    """The slots of frames that come to the stage by a bypass.

    `behind`: number of the first such slot, which is the number of slots of the stage's own input edge.
    `ports`: types of the ports in the slots of the bypass.
    """

    behind: int
    ports: Ports


class PortedSettings(Model):
    """The settings of every stage with ports.

    `where`: file and key of the stage, for errors.
    `folder`: folder of the pipeline file.
    `run_folder`: run folder, for files that the stage writes.
    `joins`: whether the stage is a `trilane.pipeline.stage.JoiningStage`.
    `reads`: inputs of the stage's ports, in the order of the file.
    `streams`: types of the ports of each stream that the stage reads.
    `writes`: types of the ports that the stage writes; empty if the file states no ports and no stage reads this one.
    `keys`: keys of the file that only this kind of stage has, with their values.
    `bypass`: slots of the bypass that ends at the stage; None without one.
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
    """A port through which a stage reads: its name and its type."""

    name: str
    type: PortType


class PortedStage:
    """A `Stage` or `JoiningStage` that gets arrays. A subclass implements `work`.

    `settings`: settings of the stage.
    `reads`: ports through which the stage reads.
    `writes`: types of the ports that the stage writes, by name.
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
        """The earliest sampling time of the inputs that `run` got, in ns of CLOCK_MONOTONIC; 0 if it got none."""
        taken = [of[slot] for of, slot in zip(self._headers, self._slots, strict=True) if slot is not None]
        return min((int(header["t_sampled_ns"]) for header in taken), default=0)

    def bind(self, inputs: Sequence[Any], outputs: Sequence[Packet]) -> None:
        """Make the arrays of all slots, and then call `ready`. `inputs`, `outputs`: slots, as for `Stage.bind`."""
        streams: Sequence[Sequence[Packet]] = inputs if self.settings.joins else [inputs] if inputs else []
        self._inputs = [
            [self._views(place, packet, ports) for place, packet in enumerate(packets)]
            for packets, ports in zip(streams, self._streams, strict=True)
        ]
        self._outputs = [views(packet.payload, self.writes) for packet in outputs]
        self._headers = [[packet.header for packet in packets] for packets in streams]
        self.ready()

    def _views(self, place: int, packet: Packet, ports: Mapping[str, PortType]) -> Mapping[str, NDArray[Any] | None]:
        """Return the read-only arrays of a slot, by port. `place`: number of the slot.

        A slot that comes by a bypass may lack a port, or have it with another type. Such a port gets None.
        """
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
        """Prepare for the first frame; called once, after the arrays of all slots are made."""

    def work(self, frame: int, arrays: Sequence[NDArray[Any] | None], outputs: Arrays) -> Mapping[str, float]:
        """Do a frame, and return metrics by name; a `Skip` sends the frame over the bypass that begins at the stage.

        `arrays`: read-only array of each of `reads`. It is None for an input with `latest` that has no frame, or only
        one that is too old. It is also None if the frame took a bypass that lacks the port.
        `outputs`: arrays to fill, by the names in `writes`; empty if no stage reads this one.
        """
        raise NotImplementedError

    def forget(self) -> None:
        """Forget earlier frames, so that the next frame does not take the bypass (`SkippingStage.forget`)."""

    def close(self) -> None:
        """Release the stage's resources."""


def _types(ports: Ports) -> dict[str, PortType]:
    return {name: port_type(text) for name, text in ports.items()}


def _read_only(arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    for array in arrays.values():
        array.flags.writeable = False
    return arrays
