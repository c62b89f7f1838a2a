"""The infer stage: bytes of a slot in, bytes of a slot out, by the avatar's integer network or a part of it.

Rule: sessions and bindings are all made in `bind`, a frame allocates nothing, and with nobody in view nothing is run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from trilane import machine
from trilane.arrays import U8
from trilane.avatars.network_file import NetworkFile
from trilane.avatars.network_split import NetworkPart
from trilane.errors import BadInputError
from trilane.pipeline.moved_bytes import ByteCounter
from trilane.pipeline.stage import UnitContext
from trilane.shapes import Shape
from trilane.stages.avatar_assets import network_of
from trilane.stages.config import RunConfig
from trilane.stages.dsp.parts import constant_bytes, parts_for, views
from trilane.stages.dsp.runtime import (
    Binding,
    RuntimeOptions,
    Session,
    copies_slots,
    has_device,
    load_runtime,
    resolve,
)
from trilane.stages.last_level_cache import moved_of_kept
from trilane.transport.packets import Packet

Key = tuple[Shape, int, int]
#: Runtimes that may compile several networks at the same time.
LOAD_AT_ONCE = ("openvino", "ort")


@dataclass(frozen=True)
class BoundPart:
    """A part on a pair of slots. `passed`: (from, to) tensors that a later part reads as this one was given them.

    `in_bytes`, `out_bytes`: of what the network reads, its weights included where they come from memory, and writes.
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
    """`trilane.pipeline.stage.Stage`. One inference a frame; a whole network turns H·W·C bytes into H·W·4.

    `network`: of all avatars, which share the tensor, each in its `tensor_rect`.
    `part`: which one of the parts that the configuration's cuts make.
    Raises BadInputError, MissingPartError when made or bound.
    """

    def __init__(self, config: RunConfig, network: NetworkFile, part: int = 0) -> None:
        self.runtime = resolve(config.runtime)
        self._module = load_runtime(self.runtime)
        self._config, self._part = config, part
        settings = config.units[config.infer_units[part]]
        self._options = RuntimeOptions(settings.threads, settings.spin)
        self._shapes = config.buckets
        self._network = network
        self._moved = ByteCounter()
        self._copies = copies_slots(self.runtime)
        self._bindings: dict[Key, BoundPart] = {}
        self._inputs: Sequence[Packet] = ()
        self._outputs: Sequence[Packet] = ()

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Compile every shape, bind every pair of slots, run each shape once: as many at a time as there are cores."""
        self._inputs, self._outputs = inputs, outputs
        at_once = len(machine.here.cores()) if self.runtime in LOAD_AT_ONCE else 1
        with ThreadPoolExecutor(at_once) as pool:
            for shape, bindings in zip(self._shapes, pool.map(self._prepare, self._shapes), strict=True):
                self._bindings |= {(shape, *pair): binding for pair, binding in bindings.items()}

    def _prepare(self, shape: Shape) -> dict[tuple[int, int], BoundPart]:
        """The part for tensors of `shape` on each pair of slots."""
        part = parts_for(self._config, self._network, shape)[self._part]
        session = self._module.load(part, self._options)
        pairs = product(enumerate(self._inputs), enumerate(self._outputs))
        weights = 0 if has_device(self.runtime) else moved_of_kept(constant_bytes(part.model))
        bindings = {
            (i, o): _bound(session, part, source.payload, target.payload, weights) for (i, source), (o, target) in pairs
        }
        bindings[0, 0].run(ByteCounter())
        return bindings

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """Infer the tensor unless nobody is in view; then the picture is transparent.

        Figures: `inferred`, 0 or 1, and the bytes moved. The least: what the network is given and what it gives, and
        its weights where they do not fit into the last-level cache.
        """
        assert slot_in is not None and slot_out is not None
        pose, picture, moved = self._inputs[slot_in].header, self._outputs[slot_out].payload, self._moved
        moved.start(pose.nbytes)
        if not pose["avatars"]["visible"].any():
            picture[:] = 0
            moved.written += picture.nbytes
            return {"inferred": 0, **moved.figures()}
        height, width = pose["tensor_shape"].tolist()
        bound = self._binding((height, width), slot_in, slot_out, frame)
        bound.run(moved)
        if self._copies:
            moved.uploaded, moved.read_back = bound.in_bytes, bound.out_bytes
        return {"inferred": 1, **moved.figures()}

    @property
    def sessions(self) -> int:
        """How many compiled networks are ready: one for each shape."""
        return len({shape for shape, _, _ in self._bindings})

    def close(self) -> None:
        """Drop sessions and bindings, which hold views of the slots."""
        self._bindings.clear()
        self._inputs = self._outputs = ()

    def _binding(self, shape: Shape, slot_in: int, slot_out: int, frame: int) -> BoundPart:
        try:
            return self._bindings[shape, slot_in, slot_out]
        except KeyError:
            known = ", ".join(f"{h}x{w}" for h, w in self._shapes)
            raise BadInputError(f"frame {frame}", f"tensor shape {shape[0]}x{shape[1]}", f"one of {known}") from None


def build(settings: Mapping[str, Any], unit: UnitContext) -> InferStage:
    """The stage that runs part `settings["part"]` of the network. Raises BadInputError, MissingPartError."""
    config = RunConfig.model_validate(settings["config"])
    if has_device(config.runtime):
        unit.use_device(config.runtime)
    return InferStage(config, network_of(unit.assets), settings["part"])


def _bound(session: Session, part: NetworkPart, source: U8, target: U8, weights: int) -> BoundPart:
    """`weights`: bytes of the network's own that each run reads from memory."""
    given, handed_on = views(source, part.crossing_in), views(target, part.crossing_out)
    inputs, outputs = [given[name] for name in part.inputs], [handed_on[name] for name in part.outputs]
    passed = [(given[name], handed_on[name]) for name in handed_on if name not in part.outputs]
    in_bytes, out_bytes = (sum(tensor.nbytes for tensor in tensors) for tensors in (inputs, outputs))
    return BoundPart(session.bind(inputs, outputs), passed, weights + in_bytes, out_bytes)
