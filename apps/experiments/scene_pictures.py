"""The frames of a scene, made in this process: pictures, times, references, and differences between runtimes.

Rule: the run's own stages draw tensors and make pictures, one after the other. If the scene has a ground truth (the
clothed bodies), it is the reference. If the scene has none, the plan `full` is the reference. A result names its
reference.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from trilane import machine
from trilane.apps.experiments.picture_errors import LEAST_MS_SSIM_PX
from trilane.arrays import U8, Shape
from trilane.avatars.network_file import NetworkFile, reshaped
from trilane.bench.lib.cast import Box, Cast
from trilane.bench.lib.full_picture import FullPictures
from trilane.bench.lib.stage_chain import StageChain, units_of
from trilane.errors import BadInputError
from trilane.pipeline.job_times import CoreMeter, preempted_ns
from trilane.pipeline.stage import UnitContext
from trilane.stages.avatar_assets import networks_of
from trilane.stages.avatar_pipeline import avatar_pipeline, edge_bytes
from trilane.stages.config import network_parts, pose_dtype
from trilane.stages.configure import Checked
from trilane.stages.cpu.pose import build as build_pose
from trilane.stages.dsp.runtime import Binding, RuntimeOptions, load_runtime
from trilane.stages.gpu.opengl import CONTEXT, open_context
from trilane.stages.gpu.raster import build as build_raster
from trilane.transport.packets import Packet, SlotLayout, view_packet
from trilane.units import MAX_CHANNELS, MEASURED

MAX_FRAMES = 10_000
TRUTH = "ground truth: the clothed body that the avatar was trained on"
FULL = "the plan full: float64 body, supersampled raster, FP32 network"
MS = 1e-6  # a nanosecond in milliseconds
#: Function of a frame's number and background (h,w,3) uint8 that returns the reference picture (h,w,3) uint8.
Wanted = Callable[[int, U8], U8]


class ScenePictures:
    """Makes the frames of the scene in `checked`.

    `gpu`: GPU unit with the OpenGL context to use; None for a new unit. `output`: (height, width) of the picture.
    """

    def __init__(self, checked: Checked, gpu: UnitContext | None = None) -> None:
        """Build the stages.

        Raises BadInputError for a stage that cannot be built, MissingPartError if a library that a stage needs is
        missing.
        """
        pipeline, output = avatar_pipeline(checked.config, checked.assets), checked.config.scene.output
        units = units_of(pipeline, checked.assets)
        self.gpu = units["gpu"] if gpu is None else replace(gpu, assets=checked.assets)
        self._chain = StageChain(pipeline, {**units, "gpu": self.gpu})
        self._names = [stage.name for stage in pipeline.stages[:-1]]
        self.output: Shape = (output.height, output.width)

    @property
    def gl(self) -> Any:
        """The OpenGL context that the stages draw with."""
        return self.gpu.shared(CONTEXT, open_context)

    def frame(self, number: int) -> tuple[U8, Mapping[str, float]]:
        """Return (picture, times) of frame `number`: (h,w,3) uint8 sRGB, and the time in ms by stage.

        The stage present does not run. A skipped stage takes almost no time. The time in which a thread was ready but
        had no core does not count.
        """
        cores, times = len(machine.here.cores()), {}
        with closing(CoreMeter()) as meter:
            begun = time.perf_counter_ns()
            packet = self._chain.run(number, 0)
            for place, name in enumerate(self._names):
                packet = self._chain.go_on(number, place)
                ended = time.perf_counter_ns()
                wall_ns, begun = ended - begun, ended
                times[name] = (wall_ns - preempted_ns(wall_ns, meter.cpu_ns(), meter.delay_ns(), cores)) * MS
        return self._picture(packet), times

    def background(self, number: int) -> U8:
        """Return frame `number` without its avatars, but with their shadows, (h,w,3) uint8 sRGB."""
        self._chain.run(number, len(self._names) - 2).payload[:] = 0
        return self._picture(self._chain.go_on(number))

    def _picture(self, packet: Packet) -> U8:
        height, width = self.output
        picture: U8 = packet.payload[: height * width * 3].reshape(height, width, 3).copy()
        return picture


def wanted_pictures(cast: Cast, ctx: Any) -> tuple[Wanted, str]:
    """Return (function that makes reference pictures of `cast`, name of the reference).

    `ctx`: OpenGL context in use.
    """
    from trilane.bench.lib.full_picture import true_pictures

    true = true_pictures(cast, ctx)
    return (FullPictures(cast).frame, FULL) if true is None else (true.frame, TRUTH)


def spread(total: int, frames: int) -> list[int]:
    """Return the numbers of at most `frames` of `total` frames, evenly spread; the first number is 0.

    Raises BadInputError if `frames` is not 1 to `MAX_FRAMES`.
    """
    if not 1 <= frames <= MAX_FRAMES:
        raise BadInputError("--frames", str(frames), f"1 to {MAX_FRAMES}")
    count = min(frames, total)
    return [index * total // count for index in range(count)]


def around(boxes: Sequence[Box], output: Shape) -> tuple[slice, slice]:
    """Return the result of `region` as (rows, columns), two slices. Parameters: see `region`."""
    box = region(boxes, output)
    return slice(box.top, box.bottom), slice(box.left, box.right)


def region(boxes: Sequence[Box], output: Shape) -> Box:
    """Return the rectangle of a picture that holds all `boxes`, in pixels.

    If the picture has room, each side of the rectangle is at least as long as MS-SSIM needs. `boxes`: at least one box
    in the picture. `output`: (height, width) of the picture.
    """
    top, left = min(box.top for box in boxes), min(box.left for box in boxes)
    bottom, right = max(box.bottom for box in boxes), max(box.right for box in boxes)
    rows, columns = _with_room(top, bottom, output[0]), _with_room(left, right, output[1])
    return Box(rows[0], columns[0], rows[1], columns[1])


def _with_room(first: int, last: int, side: int) -> tuple[int, int]:
    length = min(max(last - first, LEAST_MS_SSIM_PX), side)
    begin = min(max((first + last - length) // 2, 0), side - length)
    return begin, begin + length


#: Bounds on the mean and the largest difference of two runtimes' pictures, in steps of 1/255.
MEAN_BOUND, LARGEST_BOUND = 0.5, 4


def runtime_differences(checked: Checked, runtimes: Sequence[str], frames: int) -> dict[str, Any]:
    """Return the differences between the pictures of each pair of runtimes, which get the same input bytes.

    `checked`: the scene and its avatars. `runtimes`: names of two or more runtimes. `frames`: number of frames, evenly
    spread over the scene.

    Keys:
    `rows`: a row for each pair of runtimes.
    `sources`: source of the rows.
    `bounds`: bounds on `mean` and `largest`.
    `frames`: numbers of the frames that show an avatar.
    `runtimes`: version of each runtime, by name.

    Keys of a row:
    `first` and `second`: names of the runtimes.
    `mean` and `largest`: differences in steps of 1/255, over all channels and frames.
    `worst_frame`: number of the frame with the largest mean.

    Raises BadInputError for a number of frames out of range, fewer than two runtimes, a runtime given twice, or nobody
    in view. Raises MissingPartError for a runtime that is not installed, or without OpenGL.
    """
    wanted = spread(checked.config.scene.frames, frames)
    if len(set(runtimes)) < 2 or len(set(runtimes)) < len(runtimes):
        raise BadInputError("--runtime", ", ".join(runtimes) or "none", "two or more different runtimes")
    sessions = [_Sessions(network, runtimes) for network in networks_of(checked.assets)]
    pairs = list(combinations(runtimes, 2))
    steps_of: dict[tuple[str, str], list[tuple[float, int, int]]] = {pair: [] for pair in pairs}
    numbers: list[int] = []
    for frame, network, tensor in _tensors(checked, wanted):
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
    """Return the row of `runtime_differences` for a pair of runtimes.

    `pair`: names of the two runtimes. `steps`: for each tensor, (mean difference, largest difference, number of the
    frame).
    """
    return {
        "first": pair[0],
        "second": pair[1],
        "mean": float(np.mean([mean for mean, _, _ in steps])),
        "largest": max(largest for _, largest, _ in steps),
        "worst_frame": max(steps)[2],
    }


class _Sessions:
    """Runs `network` on several runtimes. A session is kept for each runtime and tensor shape."""

    def __init__(self, network: NetworkFile, runtimes: Sequence[str]) -> None:
        self._network = network
        self._runtimes = {name: load_runtime(name) for name in runtimes}
        self._bound: dict[tuple[str, Shape], tuple[U8, U8, Binding]] = {}

    def picture(self, runtime: str, tensor: U8) -> U8:
        """Return the picture (h,w,4) uint8 that the network paints on `runtime` from `tensor` (h,w,C) uint8."""
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


def _tensors(checked: Checked, frames: Sequence[int]) -> Iterator[tuple[int, int, U8]]:
    """Yield (frame number, network number, tensor) for each network that paints an avatar in one of `frames`.

    A tensor is (h,w,C) uint8, and valid until a tensor of the next frame is yielded.
    """
    painter = DrawnTensors(checked)
    for frame in frames:
        for network, tensor in painter.tensors(frame).items():
            yield frame, network, tensor


class DrawnTensors:
    """Draws the tensors of the scene in `checked` with a run's pose and raster stages."""

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
        """Return the tensors (h,w,C) uint8 of frame number `frame`, by the number of the network.

        A network that paints nobody in the frame has no tensor. The tensors are valid until the next call.
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
