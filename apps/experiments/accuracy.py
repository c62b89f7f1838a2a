"""How far apart are the runtimes on the frames of a scene?

Rule: every runtime gets the same bytes, drawn by the pipeline's own pose and raster stages. The largest difference of a
byte is shown beside the mean.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from trilane.arrays import U8, Shape
from trilane.avatars.network_file import NetworkFile, reshaped
from trilane.errors import BadInputError
from trilane.pipeline.stage import UnitContext
from trilane.stages.avatar_assets import networks_of
from trilane.stages.avatar_pipeline import edge_bytes
from trilane.stages.config import MAX_CHANNELS, network_parts, pose_dtype
from trilane.stages.configure import Checked
from trilane.stages.cpu.pose import build as build_pose
from trilane.stages.dsp.runtime import Binding, RuntimeOptions, load_runtime
from trilane.stages.gpu.raster import build as build_raster
from trilane.transport.packets import Packet, SlotLayout, view_packet
from trilane.units import MEASURED

#: Bounds on the difference of any two runtimes, of 255.
MEAN_BOUND, LARGEST_BOUND = 0.5, 4
MAX_FRAMES = 10_000


def runtime_differences(checked: Checked, runtimes: Sequence[str], frames: int) -> dict[str, Any]:
    """Return how far apart the pictures of each pair of runtimes are.

    `checked`: the scene and its avatars. `runtimes`: names of two or more runtimes. `frames`: number of frames, evenly
    spread over the scene.
    Keys: `rows`, one per pair: `first`, `second`, `mean`, `largest` (of 255, over all channels and frames),
    `worst_frame`; `sources`; `bounds`; `frames` (numbers of those that show an avatar); `runtimes` (name to version).
    Raises BadInputError and MissingPartError.
    """
    if not 1 <= frames <= MAX_FRAMES:
        raise BadInputError("--frames", str(frames), f"1 to {MAX_FRAMES}")
    if len(set(runtimes)) < 2 or len(set(runtimes)) < len(runtimes):
        raise BadInputError("--runtime", ", ".join(runtimes) or "none", "two or more different runtimes")
    sessions = [_Sessions(network, runtimes) for network in networks_of(checked.assets)]
    pairs = list(combinations(runtimes, 2))
    steps_of: dict[tuple[str, str], list[tuple[float, int, int]]] = {pair: [] for pair in pairs}
    numbers: list[int] = []
    for frame, network, tensor in _tensors(checked, frames):
        numbers += [frame] if frame not in numbers[-1:] else []
        pictures = {name: sessions[network].picture(name, tensor).astype(np.int16) for name in runtimes}
        for pair in pairs:
            steps = np.abs(pictures[pair[0]] - pictures[pair[1]])
            steps_of[pair].append((float(steps.mean()), int(steps.max()), frame))
    if not numbers:
        found = "nobody in view in any of the frames"
        raise BadInputError(f"scene {checked.config.scene.name}", found, "an avatar in the picture")
    return {
        "rows": [_row(pair, steps) for pair, steps in steps_of.items()],
        "sources": {"rows": MEASURED},
        "bounds": {"mean": MEAN_BOUND, "largest": LARGEST_BOUND},
        "frames": numbers,
        "runtimes": {name: load_runtime(name).version() for name in runtimes},
    }


def _row(pair: tuple[str, str], steps: list[tuple[float, int, int]]) -> dict[str, Any]:
    """Return the row of a pair. `steps`: (mean, largest, number) of each frame."""
    return {
        "first": pair[0],
        "second": pair[1],
        "mean": float(np.mean([mean for mean, _, _ in steps])),
        "largest": max(largest for _, largest, _ in steps),
        "worst_frame": max(steps)[2],
    }


class _Sessions:
    """A network on each runtime, by tensor shape."""

    def __init__(self, network: NetworkFile, runtimes: Sequence[str]) -> None:
        self._network = network
        self._runtimes = {name: load_runtime(name) for name in runtimes}
        self._bound: dict[tuple[str, Shape], tuple[U8, U8, Binding]] = {}

    def picture(self, runtime: str, tensor: U8) -> U8:
        """Return the picture (h,w,4) that `runtime` makes of `tensor` (h,w,C)."""
        shape = (int(tensor.shape[0]), int(tensor.shape[1]))
        if (runtime, shape) not in self._bound:
            slots = np.empty((1, *tensor.shape), np.uint8), np.empty((1, *shape, 4), np.uint8)
            session = self._runtimes[runtime].load(reshaped(self._network, *shape), RuntimeOptions(threads=1))
            self._bound[runtime, shape] = (*slots, session.bind(slots[:1], slots[1:]))
        slot_in, slot_out, binding = self._bound[runtime, shape]
        slot_in[0] = tensor
        binding.run()
        picture: U8 = slot_out[0].copy()
        return picture


def _tensors(checked: Checked, frames: int) -> Iterator[tuple[int, int, U8]]:
    """Yield frame, network and tensor (h,w,C) of the frames, evenly spread over the scene, that show an avatar.

    A frame has a tensor for each network that paints somebody in it.
    """
    total, painter = checked.config.scene.frames, DrawnTensors(checked)
    count = min(frames, total)
    for frame in (index * total // count for index in range(count)):
        for network, tensor in painter.tensors(frame).items():
            yield frame, network, tensor


class DrawnTensors:
    """The pose and raster stages of the scene in `checked`, as in a run, and the slots between them."""

    def __init__(self, checked: Checked) -> None:
        config, assets = checked.config, checked.assets
        sizes, avatars = edge_bytes(config, assets), len(config.avatar_dirs)
        self._posed = _packet(avatars, sizes["pose->raster"])
        self._drawn = _packet(avatars, sizes["raster->infer"])
        settings = {"config": config.model_dump(mode="json")}
        self._pose = build_pose(settings, UnitContext("cpu", config.units["cpu"], assets))
        self._raster = build_raster(settings, UnitContext("gpu", config.units["gpu"], assets))
        self._pose.bind([], [self._posed])
        self._raster.bind([self._posed], [self._drawn])
        self._channels = [network.channels for network in networks_of(assets)]
        self._config = config

    def tensors(self, frame: int) -> dict[int, U8]:
        """Return the tensors (h, w, C) of a frame, valid until the next call, by the number of the network.

        A network that paints nobody in the frame has none.
        """
        self._pose.run(frame, None, 0)
        self._raster.run(frame, 0, 0)
        height, width = self._posed.header["tensor_shape"].tolist()
        parts = network_parts(self._drawn.payload, len(self._channels), self._config.buckets, MAX_CHANNELS)
        seen = [int(avatar["avatar"]) for avatar in self._posed.header["avatars"] if avatar["visible"]]
        used = [(network, self._channels[network]) for network in self._config.networks_of(seen)]
        return {
            network: parts[network][: height * width * channels].reshape(height, width, channels)
            for network, channels in used
        }


def _packet(avatars: int, payload: int) -> Packet:
    layout = SlotLayout(pose_dtype(avatars), payload)
    return view_packet(memoryview(bytearray(layout.slot_bytes)), layout)
