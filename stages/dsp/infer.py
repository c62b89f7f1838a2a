"""The infer stage: tensor bytes of a slot in, picture bytes of a slot out, by the avatar's integer network.

Rule: sessions and bindings are all made in `bind`; a frame allocates nothing, and an avatar not in view costs nothing.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_file import RGBA, NetworkFile
from trilane.avatars.reshape import reshaped
from trilane.errors import BadInputError
from trilane.scene.schema import RunConfig, Shape
from trilane.stages.contracts import Packet
from trilane.stages.dsp.runtime import Binding, RuntimeOptions, Session, load_runtime, resolve

Key = tuple[Shape, int, int, int]


class InferStage:
    """`trilane.stages.contracts.Stage`. Avatar i of a frame of shape H x W: H·W·C_i bytes in, H·W·4 bytes out.

    Both payloads hold the avatars one after another, each as large as the frame's tensor shape says.
    `runtime`: the name of the runtime that runs. Raises BadInputError, MissingPartError when made or bound.
    """

    def __init__(self, config: RunConfig) -> None:
        self.runtime = resolve(config.runtime)
        self._module = load_runtime(self.runtime)
        settings = config.units["dsp"]
        self._options = RuntimeOptions(settings.threads, settings.spin)
        self._shapes = config.buckets
        self._networks = [load_bundle(folder).read_network() for folder in config.avatar_dirs]
        self._bindings: dict[Key, Binding] = {}
        self._inputs: Sequence[Packet] = ()
        self._outputs: Sequence[Packet] = ()
        self.startup: dict[str, float] = {}

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Compile every shape of every avatar, bind every pair of slots, run each network once."""
        begin = time.monotonic_ns()
        self._inputs, self._outputs = inputs, outputs
        sessions: dict[tuple[str, Shape], Session] = {}
        for shape, avatar in product(self._shapes, range(len(self._networks))):
            network = self._networks[avatar]
            key = (network.digest, shape)
            if key not in sessions:
                sessions[key] = self._module.load(reshaped(network, *shape), self._options)
            self._bind_slots(sessions[key], shape, avatar)
        compiled = time.monotonic_ns()
        for (_, _, slot_in, slot_out), binding in self._bindings.items():
            if slot_in == slot_out == 0:
                binding.run()
        self.startup = {"sessions": len(sessions), "load_ms": (compiled - begin) / 1e6}
        self.startup["warm_up_ms"] = (time.monotonic_ns() - compiled) / 1e6

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """Infer the visible avatars; the picture of one that is not is transparent. Figures: avatars `inferred`."""
        assert slot_in is not None and slot_out is not None
        pose, output = self._inputs[slot_in].pose, self._outputs[slot_out]
        height, width = pose["tensor_shape"].tolist()
        visible = [
            i for i in range(min(len(self._networks), int(pose["avatar_count"]))) if pose["avatars"]["visible"][i]
        ]
        if len(visible) < len(self._networks):
            output.payload[:] = 0
        for avatar in visible:
            self._binding((height, width), avatar, slot_in, slot_out, frame).run()
        return {"inferred": len(visible)}

    def close(self) -> None:
        """Drop sessions and bindings, which hold views of the slots."""
        self._bindings.clear()
        self._inputs = self._outputs = ()

    def _bind_slots(self, session: Session, shape: Shape, avatar: int) -> None:
        before = self._networks[:avatar]
        for (i, source), (o, target) in product(enumerate(self._inputs), enumerate(self._outputs)):
            tensor = _tensor(source, shape, before, self._networks[avatar].channels)
            self._bindings[shape, avatar, i, o] = session.bind(tensor, _picture(target, shape, avatar))

    def _binding(self, shape: Shape, avatar: int, slot_in: int, slot_out: int, frame: int) -> Binding:
        try:
            return self._bindings[shape, avatar, slot_in, slot_out]
        except KeyError:
            known = ", ".join(f"{h}x{w}" for h, w in self._shapes)
            raise BadInputError(f"frame {frame}", f"tensor shape {shape[0]}x{shape[1]}", f"one of {known}") from None


def _tensor(packet: Packet, shape: Shape, before: Sequence[NetworkFile], channels: int) -> NDArray[np.uint8]:
    pixels = shape[0] * shape[1]
    start = pixels * sum(network.channels for network in before)
    return _part(packet.payload, start, (1, *shape, channels))


def _picture(packet: Packet, shape: Shape, avatar: int) -> NDArray[np.uint8]:
    return _part(packet.payload, shape[0] * shape[1] * RGBA * avatar, (1, *shape, RGBA))


def _part(payload: NDArray[np.uint8], start: int, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """A view. Raises ValueError when the slot is too small for it."""
    size = int(np.prod(shape))
    if start + size > payload.size:
        raise ValueError(f"a slot of {payload.size} bytes, {start + size} needed")
    return payload[start : start + size].reshape(shape)
