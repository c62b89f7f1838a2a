"""How far are the runtimes from each other on the frames of a scene?

Rule: every runtime gets the same bytes, drawn by the pipeline's own pose and raster stages; nothing is averaged away:
the largest difference of any byte stands beside the mean.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from trilane.arrays import U8
from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_reshape import reshaped
from trilane.errors import BadInputError
from trilane.pipeline.run import MAX_CHANNELS
from trilane.shapes import Shape
from trilane.stages.config import RunConfig
from trilane.stages.cpu.pose import PoseStage
from trilane.stages.dsp.runtime import Binding, RuntimeOptions, load_runtime
from trilane.stages.gpu import unit as gpu
from trilane.stages.packets import pose_dtype, posed_vertices_bytes
from trilane.transport.packets import Packet, SlotLayout, view_packet

#: Of 255: bounds on the difference of any two runtimes.
MEAN_BOUND, LARGEST_BOUND = 0.5, 4
MAX_FRAMES = 10_000


def runtime_differences(config: RunConfig, runtimes: Sequence[str], frames: int) -> dict[str, Any]:
    """`frames` frames of the scene, evenly spread, through each of `runtimes`.

    Keys: `rows`, one per pair: `first`, `second`, `mean`, `largest` (of 255, over all channels and frames),
    `worst_frame`; `bounds`; `frames` (their numbers); `runtimes` (name to version). Raises BadInputError and
    MissingPartError.
    """
    if not 1 <= frames <= MAX_FRAMES:
        raise BadInputError("--frames", str(frames), f"1 to {MAX_FRAMES}")
    if len(set(runtimes)) < 2 or len(set(runtimes)) < len(runtimes):
        raise BadInputError("--runtime", ", ".join(runtimes) or "none", "two or more different runtimes")
    sessions = _Sessions(config, runtimes)
    pairs = list(combinations(runtimes, 2))
    seen: dict[tuple[str, str], list[tuple[float, int, int]]] = {pair: [] for pair in pairs}
    numbers = []
    for frame, tensor in _tensors(config, frames):
        numbers.append(frame)
        pictures = {name: sessions.picture(name, tensor).astype(np.int16) for name in runtimes}
        for pair in pairs:
            steps = np.abs(pictures[pair[0]] - pictures[pair[1]])
            seen[pair].append((float(steps.mean()), int(steps.max()), frame))
    return {
        "rows": [_row(pair, found) for pair, found in seen.items()],
        "bounds": {"mean": MEAN_BOUND, "largest": LARGEST_BOUND},
        "frames": numbers,
        "runtimes": {name: load_runtime(name).version() for name in runtimes},
    }


def _row(pair: tuple[str, str], found: list[tuple[float, int, int]]) -> dict[str, Any]:
    return {
        "first": pair[0],
        "second": pair[1],
        "mean": float(np.mean([mean for mean, _, _ in found])),
        "largest": max(largest for _, largest, _ in found),
        "worst_frame": max(found)[2],
    }


class _Sessions:
    """The network of the scene's first avatar on each runtime, by tensor shape."""

    def __init__(self, config: RunConfig, runtimes: Sequence[str]) -> None:
        self._network = load_bundle(config.avatar_dirs[0]).read_network()
        self._runtimes = {name: load_runtime(name) for name in runtimes}
        self._bound: dict[tuple[str, Shape], tuple[U8, U8, Binding]] = {}

    def picture(self, runtime: str, tensor: U8) -> U8:
        """(h,w,4) of `tensor` (h,w,C)."""
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


def _tensors(config: RunConfig, frames: int) -> Iterator[tuple[int, U8]]:
    """(number, tensor (h,w,C)) of frames that are evenly spread over the scene."""
    total = config.scene.frames
    count = min(frames, total)
    avatars = len(config.avatar_dirs)
    posed = _packet(avatars, posed_vertices_bytes(config.posed_vertices))
    drawn = _packet(avatars, config.max_tensor_pixels * MAX_CHANNELS)
    pose, raster = PoseStage(config), gpu.build(config)["raster"]
    pose.bind([], [posed])
    raster.bind([posed], [drawn])
    channels = load_bundle(config.avatar_dirs[0]).read_network().shape[3]
    for frame in (index * total // count for index in range(count)):
        pose.run(frame, None, 0)
        raster.run(frame, 0, 0)
        height, width = posed.header["tensor_shape"].tolist()
        yield frame, drawn.payload[: height * width * channels].reshape(height, width, channels)


def _packet(avatars: int, payload: int) -> Packet:
    layout = SlotLayout(pose_dtype(avatars), payload)
    return view_packet(memoryview(bytearray(layout.slot_bytes)), layout)
