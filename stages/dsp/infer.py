"""The infer stage: tensor bytes of a slot in, picture bytes of a slot out, by the avatar's integer network.

Rule: sessions and bindings are all made in `bind`, a frame allocates nothing, and with nobody in view nothing is run.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_file import RGBA, NetworkFile
from trilane.avatars.reshape import reshaped
from trilane.errors import BadInputError
from trilane.scene.schema import RunConfig, Shape
from trilane.stages.contracts import Packet
from trilane.stages.dsp.runtime import Binding, RuntimeOptions, load_runtime, resolve

Key = tuple[Shape, int, int]


class InferStage:
    """`trilane.stages.contracts.Stage`. One inference a frame: H·W·C bytes in, H·W·4 bytes out.

    Several avatars share the tensor, each in its `tensor_rect`, so they must share one network.
    `runtime`: the name of the runtime that runs. Raises BadInputError, MissingPartError when made or bound.
    """

    def __init__(self, config: RunConfig) -> None:
        self.runtime = resolve(config.runtime)
        self._module = load_runtime(self.runtime)
        settings = config.units["dsp"]
        self._options = RuntimeOptions(settings.threads, settings.spin)
        self._shapes = config.buckets
        self._network = _shared_network(config.avatar_dirs)
        self._bindings: dict[Key, Binding] = {}
        self._inputs: Sequence[Packet] = ()
        self._outputs: Sequence[Packet] = ()
        self.startup: dict[str, float] = {}

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Compile every shape, bind every pair of slots, run each shape once."""
        begin = time.monotonic_ns()
        self._inputs, self._outputs = inputs, outputs
        for shape in self._shapes:
            session = self._module.load(reshaped(self._network, *shape), self._options)
            for (i, source), (o, target) in product(enumerate(inputs), enumerate(outputs)):
                tensor = _view(source.payload, (1, *shape, self._network.channels))
                self._bindings[shape, i, o] = session.bind(tensor, _view(target.payload, (1, *shape, RGBA)))
        compiled = time.monotonic_ns()
        for shape in self._shapes:
            self._bindings[shape, 0, 0].run()
        self.startup = {"sessions": len(self._shapes), "load_ms": (compiled - begin) / 1e6}
        self.startup["warm_up_ms"] = (time.monotonic_ns() - compiled) / 1e6

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """Infer the tensor unless nobody is in view; then the picture is transparent. Figures: `inferred`, 0 or 1."""
        assert slot_in is not None and slot_out is not None
        pose = self._inputs[slot_in].pose
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

    def _binding(self, shape: Shape, slot_in: int, slot_out: int, frame: int) -> Binding:
        try:
            return self._bindings[shape, slot_in, slot_out]
        except KeyError:
            known = ", ".join(f"{h}x{w}" for h, w in self._shapes)
            raise BadInputError(f"frame {frame}", f"tensor shape {shape[0]}x{shape[1]}", f"one of {known}") from None


def _shared_network(folders: Sequence[Path]) -> NetworkFile:
    bundles = [load_bundle(folder) for folder in folders]
    first, *others = [bundle.read_network() for bundle in bundles]
    for bundle, network in zip(bundles[1:], others, strict=True):
        if network.digest != first.digest:
            found = "another network than the scene's first avatar has"
            raise BadInputError(bundle.network_path, found, "one network for all avatars, as they share a tensor")
    return first


def _view(payload: NDArray[np.uint8], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """The first bytes of a slot as an array. Raises ValueError when the slot is too small."""
    size = math.prod(shape)
    if size > payload.size:
        raise ValueError(f"a slot of {payload.size} bytes, {size} needed")
    return payload[:size].reshape(shape)
