"""The infer stage: bytes of a slot in, bytes of a slot out, by the avatar's integer network or a part of it.

Rule: sessions and bindings are all made in `bind`, a frame allocates nothing, and with nobody in view nothing is run.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from trilane.arrays import U8
from trilane.avatars.integer_network import NetworkFile
from trilane.avatars.network_split import NetworkPart
from trilane.errors import BadInputError
from trilane.pipeline.stage import UnitContext
from trilane.shapes import Shape
from trilane.stages.avatar_assets import network_of
from trilane.stages.config import RunConfig
from trilane.stages.dsp.parts import parts_for, views
from trilane.stages.dsp.runtime import Binding, RuntimeOptions, Session, load_runtime, resolve
from trilane.transport.packets import Packet

Key = tuple[Shape, int, int]


@dataclass(frozen=True)
class BoundPart:
    """A part on a pair of slots. `passed`: (from, to) tensors that a later part reads as this one was given them."""

    binding: Binding
    passed: Sequence[tuple[U8, U8]]

    def run(self) -> None:
        for source, target in self.passed:
            np.copyto(target, source)
        self.binding.run()


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
        self._bindings: dict[Key, BoundPart] = {}
        self._inputs: Sequence[Packet] = ()
        self._outputs: Sequence[Packet] = ()
        self.startup: dict[str, float] = {}

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Compile every shape, bind every pair of slots, run each shape once."""
        begin = time.monotonic_ns()
        self._inputs, self._outputs = inputs, outputs
        for shape in self._shapes:
            part = parts_for(self._config, self._network, shape)[self._part]
            session = self._module.load(part, self._options)
            for (i, source), (o, target) in product(enumerate(inputs), enumerate(outputs)):
                self._bindings[shape, i, o] = _bound(session, part, source.payload, target.payload)
        compiled = time.monotonic_ns()
        for shape in self._shapes:
            self._bindings[shape, 0, 0].run()
        self.startup = {"sessions": len(self._shapes), "load_ms": (compiled - begin) / 1e6}
        self.startup["warm_up_ms"] = (time.monotonic_ns() - compiled) / 1e6

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """Infer the tensor unless nobody is in view; then the picture is transparent. Figures: `inferred`, 0 or 1."""
        assert slot_in is not None and slot_out is not None
        pose = self._inputs[slot_in].header
        if not pose["avatars"]["visible"].any():
            self._outputs[slot_out].payload[:] = 0
            return {"inferred": 0}
        height, width = pose["tensor_shape"].tolist()
        self._binding((height, width), slot_in, slot_out, frame).run()
        return {"inferred": 1}

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
    return InferStage(config, network_of(unit.assets), settings["part"])


def _bound(session: Session, part: NetworkPart, source: U8, target: U8) -> BoundPart:
    given, handed_on = views(source, part.crossing_in), views(target, part.crossing_out)
    binding = session.bind([given[name] for name in part.inputs], [handed_on[name] for name in part.outputs])
    return BoundPart(binding, [(given[name], handed_on[name]) for name in handed_on if name not in part.outputs])
