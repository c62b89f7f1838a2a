"""The pictures of a scene's frames by one configuration, the time of each stage, and the reference pictures.

Rule: the run's own stages make the pictures in this process, one after the other. Their reference is the ground truth
(the clothed body) if the scene has one, else the plan `full`; a caller that compares names it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

from trilane import machine
from trilane.apps.experiments.picture_errors import LEAST_MS_SSIM_PX
from trilane.arrays import U8, Shape
from trilane.bench.lib.cast import Box, Cast
from trilane.bench.lib.full_picture import FullPictures
from trilane.bench.lib.stage_chain import StageChain, units_of
from trilane.errors import BadInputError
from trilane.pipeline.job_times import CoreMeter, preempted_ns
from trilane.pipeline.stage import UnitContext
from trilane.stages.avatar_pipeline import avatar_pipeline
from trilane.stages.configure import Checked
from trilane.stages.gpu.opengl import CONTEXT, open_context
from trilane.transport.packets import Packet

MAX_FRAMES = 10_000
TRUTH = "ground truth: the clothed body that the avatar was trained on"
FULL = "the plan full: float64 body, supersampled raster, FP32 network"
MS = 1e-6  # milliseconds of a nanosecond
#: Gives frame `number` over its background, both (h,w,3) uint8.
Wanted = Callable[[int, U8], U8]


class ScenePictures:
    """The frames of the scene in `checked`. `gpu`: OpenGL context that all pictures in this process share."""

    def __init__(self, checked: Checked, gpu: UnitContext | None = None) -> None:
        """Raise BadInputError, MissingPartError."""
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
        """Return frame `number`, (h,w,3) uint8 sRGB, and milliseconds by stage; stages that it skips take none.

        Time in which a thread that was ready had no core does not count.
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
        """Return the background under the frame's avatars, with their shadows, (h,w,3) uint8."""
        self._chain.run(number, len(self._names) - 2).payload[:] = 0
        return self._picture(self._chain.go_on(number))

    def _picture(self, packet: Packet) -> U8:
        height, width = self.output
        picture: U8 = packet.payload[: height * width * 3].reshape(height, width, 3).copy()
        return picture


def wanted_pictures(cast: Cast, ctx: Any) -> tuple[Wanted, str]:
    """Return the reference pictures of `cast`, and the name of the reference. `ctx`: OpenGL context in use."""
    from trilane.bench.lib.full_picture import true_pictures

    true = true_pictures(cast, ctx)
    return (FullPictures(cast).frame, FULL) if true is None else (true.frame, TRUTH)


def spread(total: int, frames: int) -> list[int]:
    """Return the numbers of at most `frames` of `total` frames, evenly spread. Raises BadInputError."""
    if not 1 <= frames <= MAX_FRAMES:
        raise BadInputError("--frames", str(frames), f"1 to {MAX_FRAMES}")
    count = min(frames, total)
    return [index * total // count for index in range(count)]


def around(boxes: Sequence[Box], output: Shape) -> tuple[slice, slice]:
    """Return rows and columns of the `region` of a picture of `output` that holds all `boxes`, at least one."""
    box = region(boxes, output)
    return slice(box.top, box.bottom), slice(box.left, box.right)


def region(boxes: Sequence[Box], output: Shape) -> Box:
    """Return the smallest rectangle of a picture of `output` that holds `boxes`, with room for MS-SSIM if it fits."""
    top, left = min(box.top for box in boxes), min(box.left for box in boxes)
    bottom, right = max(box.bottom for box in boxes), max(box.right for box in boxes)
    rows, columns = _with_room(top, bottom, output[0]), _with_room(left, right, output[1])
    return Box(rows[0], columns[0], rows[1], columns[1])


def _with_room(first: int, last: int, side: int) -> tuple[int, int]:
    length = min(max(last - first, LEAST_MS_SSIM_PX), side)
    begin = min(max((first + last - length) // 2, 0), side - length)
    return begin, begin + length
