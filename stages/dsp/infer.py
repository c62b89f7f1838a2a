"""The infer stage: it runs the avatar's integer network, or a part of it, from the input slot to the output slot.

`bind` makes all sessions and bindings, so that a frame makes none. If nobody is in view, no network runs. The tensors
that cross a cut of the network lie one after the other in the slot, each on its own cache lines. All processes with the
same configuration use the same offsets.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from trilane import machine
from trilane.arrays import U8, Shape
from trilane.avatars.network_file import NetworkFile, constants_of, reshaped
from trilane.avatars.network_split import NetworkPart, Shapes, split
from trilane.cache import Arrays, cached_arrays
from trilane.errors import BadInputError
from trilane.machine import moved_of_kept
from trilane.pipeline.memory import ByteCounter
from trilane.pipeline.stage import UnitContext
from trilane.stages.avatar_assets import networks_of
from trilane.stages.config import PAINTED_CHANNELS, RunConfig, network_parts
from trilane.stages.dsp.runtime import Binding, RuntimeOptions, Session, copies_slots, has_device, load_runtime, resolve
from trilane.transport.packets import Packet
from trilane.units import MAX_CHANNELS

VERSION = "network parts 1"  # raise the number when the same network and cuts give other parts
SHAPES = ("inputs", "outputs", "crossing_in", "crossing_out")
LINE = 64  # bytes of a cache line, and of the widest vector register


def parts_for(config: RunConfig, network: NetworkFile, shape: Shape) -> list[NetworkPart]:
    """Return the parts of `network` for tensors of `shape`, by the cuts of `config`; one part without cuts.

    The result is cached, because reading it is faster than inferring every shape of the graph again.
    """
    cuts = [cut.at for cut in config.cuts]
    sources = (VERSION, onnx.__version__, network.digest, *map(str, shape), *cuts)
    stored = cached_arrays(VERSION, sources, lambda: _to_arrays(split(reshaped(network, *shape), cuts)))
    return _from_arrays(stored, network.where)


def _to_arrays(parts: Sequence[NetworkPart]) -> dict[str, NDArray[Any]]:
    """Return each part as arrays: the bytes of its model, and its shapes as JSON."""
    arrays: dict[str, NDArray[Any]] = {}
    for number, part in enumerate(parts):
        shapes = json.dumps({name: list(getattr(part, name).items()) for name in SHAPES})
        arrays[f"model{number}"] = np.frombuffer(part.model.SerializeToString(), np.uint8)
        arrays[f"shapes{number}"] = np.frombuffer(shapes.encode(), np.uint8)
    return arrays


def _from_arrays(arrays: Arrays, where: str) -> list[NetworkPart]:
    parts = []
    for number in range(len(arrays) // 2):
        model = onnx.load_from_string(arrays[f"model{number}"].tobytes())
        rows = json.loads(arrays[f"shapes{number}"].tobytes())
        shapes = {name: {tensor: tuple(shape) for tensor, shape in rows[name]} for name in SHAPES}
        parts.append(NetworkPart(where, model, **shapes))
    return parts


def crossing_bytes(config: RunConfig, network: NetworkFile) -> list[int]:
    """Return the most bytes that cross each cut, over all tensor shapes. Raises BadInputError for an unknown cut."""
    if not config.cuts:
        return []
    shapes = [[part.crossing_out for part in parts_for(config, network, shape)[:-1]] for shape in config.buckets]
    return [max(extent(crossing) for crossing in crossings) for crossings in zip(*shapes, strict=True)]


def constant_bytes(model: onnx.ModelProto) -> int:
    """Return the size in bytes of the constants of `model`: weights, biases, scales."""
    return sum(
        math.prod(tensor.dims) * onnx.helper.tensor_dtype_to_np_dtype(tensor.data_type).itemsize
        for tensor in constants_of(model).values()
    )


def extent(shapes: Shapes) -> int:
    """Return the size in bytes of a slot for tensors of `shapes`."""
    return sum(-(-math.prod(shape) // LINE) * LINE for shape in shapes.values())


def views(payload: U8, shapes: Shapes) -> dict[str, U8]:
    """Return views of the tensors of `shapes` in a slot, by name. Raises ValueError if the slot is too small."""
    found, start = {}, 0
    for name, shape in shapes.items():
        size = math.prod(shape)
        if start + size > payload.size:
            raise ValueError(f"a slot of {payload.size} bytes, {start + size} needed")
        found[name] = payload[start : start + size].reshape(shape)
        start += -(-size // LINE) * LINE
    return found


#: Number of the network, shape of its tensor, input slot, output slot.
Key = tuple[int, Shape, int, int]
#: Runtimes that may compile several networks at the same time.
LOAD_AT_ONCE = ("openvino", "ort")


@dataclass(frozen=True)
class BoundPart:
    """A part of the network, bound to an input slot and an output slot.

    `passed`: pairs (source, target) of tensors that are copied unchanged for a later part.
    `in_bytes`: number of bytes that the part reads, including its weights if they do not fit into the cache.
    `out_bytes`: number of bytes that the part writes.
    """

    binding: Binding
    passed: Sequence[tuple[U8, U8]]
    in_bytes: int
    out_bytes: int

    def run(self, moved: ByteCounter) -> None:
        for source, target in self.passed:
            np.copyto(target, source)
            moved.copied(source.nbytes)
        self.binding.run()
        moved.read += self.in_bytes
        moved.written += self.out_bytes
        moved.least += self.in_bytes + self.out_bytes


class InferStage:
    """A `trilane.pipeline.stage.Stage` that runs whole networks, or a part of a single network.

    A network turns H·W·C bytes into H·W·4. A frame has one inference for each network that paints somebody in view.
    Avatars with the same network share its tensor, each in its `tensor_rect`.

    `networks`: networks of the avatars, by number.
    `part`: index of the part to run, if the configuration cuts the only network.
    Its constructor and `bind` raise BadInputError and MissingPartError.
    """

    def __init__(self, config: RunConfig, networks: Sequence[NetworkFile], part: int = 0) -> None:
        self.runtime = resolve(config.runtime)
        self._module = load_runtime(self.runtime)
        self._config, self._part = config, part
        settings = config.units[config.infer_units[part]]
        self._options = RuntimeOptions(settings.threads, settings.spin)
        self._shapes = config.buckets
        self._networks = networks
        avatars = range(len(config.avatar_dirs))
        self._painters = np.array([config.network_of(number) for number in avatars])
        self._moved = ByteCounter()
        self._copies = copies_slots(self.runtime)
        self._bindings: dict[Key, BoundPart] = {}
        self._inputs: Sequence[Packet] = ()
        self._outputs: Sequence[Packet] = ()

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Compile each network for every shape, bind it to every pair of slots, and run each shape once.

        Runtimes in LOAD_AT_ONCE prepare as many shapes at a time as there are cores.
        """
        self._inputs, self._outputs = inputs, outputs
        at_once = len(machine.here.cores()) if self.runtime in LOAD_AT_ONCE else 1
        kinds = list(product(range(len(self._networks)), self._shapes))
        with ThreadPoolExecutor(at_once) as pool:
            for bindings in pool.map(lambda kind: self._prepare(*kind), kinds):
                self._bindings |= bindings

    def _prepare(self, number: int, shape: Shape) -> dict[Key, BoundPart]:
        """Return the bound part of network `number` for tensors of `shape`, by pair of slots."""
        part = parts_for(self._config, self._networks[number], shape)[self._part]
        session = self._module.load(part, self._options)
        sources = [self._own(packet, number, MAX_CHANNELS) for packet in self._inputs]
        targets = [self._own(packet, number, PAINTED_CHANNELS) for packet in self._outputs]
        weights = 0 if has_device(self.runtime) else moved_of_kept(constant_bytes(part.model))
        bindings = {
            (number, shape, i, o): _bound(session, part, source, target, weights)
            for (i, source), (o, target) in product(enumerate(sources), enumerate(targets))
        }
        # A session allocates memory in its first run, so that the runs of frames do not.
        bindings[number, shape, 0, 0].run(ByteCounter())
        return bindings

    def _own(self, packet: Packet, number: int, channels: int) -> U8:
        """Return the part of a slot that belongs to network `number`; the whole slot for an only network."""
        if len(self._networks) == 1:
            return packet.payload
        return network_parts(packet.payload, len(self._networks), self._shapes, channels)[number]

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """Run each network that paints somebody in view, and return metrics.

        With nobody in view, transparent pictures are written. The metrics are `inferred`, the number of inferences, and
        the bytes moved. The least bytes are the networks' inputs and outputs, and their weights if these do not fit
        into the last-level cache. Raises BadInputError for a tensor shape that `bind` did not prepare.
        """
        assert slot_in is not None and slot_out is not None
        pose, picture, moved = self._inputs[slot_in].header, self._outputs[slot_out].payload, self._moved
        moved.start(pose.nbytes)
        is_seen = pose["avatars"]["visible"] > 0
        if not is_seen.any():
            picture[:] = 0
            moved.written += picture.nbytes
            return {"inferred": 0, **moved.figures()}
        height, width = pose["tensor_shape"].tolist()
        numbers = np.unique(self._painters[is_seen]).tolist()
        for number in numbers:
            bound = self._bindings.get((number, (height, width), slot_in, slot_out))
            if bound is None:
                known = ", ".join(f"{h}x{w}" for h, w in self._shapes)
                raise BadInputError(f"frame {frame}", f"tensor shape {height}x{width}", f"one of {known}")
            bound.run(moved)
            if self._copies:
                moved.uploaded += bound.in_bytes
                moved.read_back += bound.out_bytes
        return {"inferred": len(numbers), **moved.figures()}

    @property
    def sessions(self) -> int:
        """The number of sessions: one for each network and shape."""
        return len({(number, shape) for number, shape, _, _ in self._bindings})

    def close(self) -> None:
        """Drop all sessions and bindings, because they have views of the slots."""
        self._bindings.clear()
        self._inputs = self._outputs = ()


def build(settings: Mapping[str, Any], unit: UnitContext) -> InferStage:
    """Build the stage that runs part `settings["part"]` of the network. Raises BadInputError, MissingPartError."""
    config = RunConfig.model_validate(settings["config"])
    if has_device(config.runtime):
        unit.use_device(config.runtime)
    return InferStage(config, networks_of(unit.assets), settings["part"])


def _bound(session: Session, part: NetworkPart, source: U8, target: U8, weights: int) -> BoundPart:
    given, handed_on = views(source, part.crossing_in), views(target, part.crossing_out)
    inputs, outputs = [given[name] for name in part.inputs], [handed_on[name] for name in part.outputs]
    passed = [(given[name], handed_on[name]) for name in handed_on if name not in part.outputs]
    in_bytes, out_bytes = (sum(tensor.nbytes for tensor in tensors) for tensors in (inputs, outputs))
    return BoundPart(session.bind(inputs, outputs), passed, weights + in_bytes, out_bytes)
