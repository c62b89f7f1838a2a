"""The composited frames of a run, made by the run's own stages, one after the other in this process.

Rule: the pipeline's factories build the stages, and the stages are bound as in a unit's process. Therefore a frame has
the same bytes as in a run. Frames may be made in any order, because no frame reuses an earlier frame's picture. A frame
without a visible avatar takes the pipeline's bypass, as in a run.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import U8
from trilane.pipeline.description import Pipeline
from trilane.pipeline.memory import Assets
from trilane.pipeline.stage import Skip, UnitContext
from trilane.pipeline.unit_loop import BoundStage, factory_named
from trilane.scene.planner import FrameWork
from trilane.stages.avatar_assets import networks_of
from trilane.stages.avatar_pipeline import avatar_pipeline
from trilane.stages.config import PAINTED_CHANNELS, network_parts
from trilane.stages.configure import Checked
from trilane.stages.cpu.pose import PoseStage
from trilane.stages.gpu.opengl import CONTEXT, open_context
from trilane.transport.packets import Packet, SlotLayout, view_packet
from trilane.units import MAX_CHANNELS

Units = Mapping[str, UnitContext]
RASTER = 1


def units_of(pipeline: Pipeline, assets: Assets) -> Units:
    """Return the context of each unit of `pipeline`, by unit.

    The stages of a unit share its context, which contains, for example, the OpenGL context. All chains in one process
    must share these contexts, because a process has one OpenGL context. `assets`: arrays that the stages may read.
    """
    return {name: UnitContext(name, settings, assets) for name, settings in pipeline.units.items()}


class StageChain:
    """All stages of a pipeline except the last, with one slot for each edge.

    `made`: stages in their order. `packets`: slot of each edge, in the order of the stages that write.
    """

    def __init__(self, pipeline: Pipeline, units: Units) -> None:
        """Build and bind the stages. Raises the errors of the stages' factories.

        `pipeline`: pipeline with these stages. `units`: contexts of its units, from `units_of`.
        """
        layouts = [SlotLayout(edge.header, edge.payload_bytes) for edge in pipeline.edges]
        self.packets = [view_packet(memoryview(bytearray(layout.slot_bytes)), layout) for layout in layouts]
        named = dict(zip(pipeline.edge_names, self.packets, strict=True))
        begin, end = pipeline.bypass or (None, None)
        self._end = [stage.name for stage in pipeline.stages].index(end) if end is not None else 0
        self._stages = []
        self.made = []
        for stage, output in zip(pipeline.stages, self.packets, strict=False):  # the last stage has no output
            unit = units[stage.unit]
            inputs = [named[edge] for edge in pipeline.edges_into(stage.name)]
            made = factory_named(stage.factory)(stage.settings, unit)
            self.made.append(made)
            self._stages.append(BoundStage(stage.name, made, inputs, [output], 0, unit, stage.name == begin))

    def run(self, frame: int, last: int | None = None) -> Packet:
        """Run frame number `frame` from the first stage to stage number `last`, and return the last stage's output.

        If the frame takes the bypass past stage `last`, the output of the stage where the bypass begins is returned.
        `last`: number of the stage, from 0; None for the last stage of the chain.
        """
        self._next, self._slot_in = 0, -1
        return self.go_on(frame, last)

    def go_on(self, frame: int, last: int | None = None) -> Packet:
        """Go on after a `run` of the same frame, and return the output as `run` does. `frame`, `last`: see `run`."""
        last = len(self._stages) - 1 if last is None else last
        while self._next <= last:
            number = self._next
            metrics = self._stages[number].run(frame, self._slot_in, 0, 0, fresh=True)
            # Each edge has one slot, so at the bypass's end, slot 1 is the output of the stage where it begins.
            self._next, self._slot_in = (self._end, 1) if isinstance(metrics, Skip) else (number + 1, 0)
            self._handed = self.packets[number]
        return self._handed


class AvatarFrames:
    """Makes the frames of the scene in `checked`, as a run presents them.

    `units`: contexts of the pipeline's units, by unit.
    """

    def __init__(self, checked: Checked, units: Units | None = None) -> None:
        """Build the stages.

        `checked`: configuration of a run.
        `units`: contexts of another object in this process, which this object then shares; None for new contexts.
        Raises BadInputError if a file cannot be read, MissingPartError if a library is not installed.
        """
        pipeline = avatar_pipeline(checked.config, checked.assets)
        self.units = units_of(pipeline, checked.assets) if units is None else units
        self._chain = StageChain(pipeline, self.units)
        self._composite = len(pipeline.stages) - 2
        self._channels = [network.channels for network in networks_of(checked.assets)]
        self._buckets = checked.config.buckets
        self._shape = (checked.config.scene.output.height, checked.config.scene.output.width, 3)

    def frame(self, number: int) -> U8:
        """Return frame `number` as the stage composite makes it: a picture (h,w,3) uint8 sRGB."""
        return self._picture(self._chain.run(number))

    @property
    def gl(self) -> Any:
        """The OpenGL context that the stages draw with."""
        return self.units["gpu"].shared(CONTEXT, open_context)

    def background(self, number: int) -> U8:
        """Return frame `number` without its avatars, but with their shadows: a picture (h,w,3) uint8 sRGB."""
        self._chain.run(number, self._composite - 1).payload[:] = 0
        return self._picture(self._chain.go_on(number))

    def tensor_of(self, number: int, network: int = 0) -> U8:
        """Return the tensor (h,w,C) uint8 of a frame, as the stage raster draws it.

        `number`: number of the frame, which must show an avatar. `network`: number of the network that reads the
        tensor.
        """
        payload = self._chain.run(number, RASTER).payload
        (height, width), channels = self.posed["tensor_shape"].tolist(), self._channels[network]
        own = network_parts(payload, len(self._channels), self._buckets, MAX_CHANNELS)[network]
        tensor: U8 = own[: height * width * channels].reshape(height, width, channels).copy()
        return tensor

    def composited(self, number: int, painted: Mapping[int, U8]) -> U8:
        """Return frame `number`, (h,w,3) uint8 sRGB, with given pictures in place of the networks' pictures.

        `painted`: pictures (h,w,4) uint8 to composite, by the number of the network. A network without a picture in
        `painted` keeps its own picture.
        """
        payload = self._chain.run(number, self._composite - 1).payload
        parts = network_parts(payload, len(self._channels), self._buckets, PAINTED_CHANNELS)
        for network, picture in painted.items():
            parts[network][: picture.size] = picture.reshape(-1)
        return self._picture(self._chain.go_on(number))

    @property
    def levels(self) -> Mapping[int, int]:
        """The detail of each visible avatar in the latest frame, as an index into `DETAILS`, by the avatar's number."""
        pose = cast(PoseStage, self._chain.made[0])
        return {index: seen.level for index, seen in pose.plan.seen.items()}

    @property
    def posed(self) -> NDArray[np.void]:
        """The header that the stage pose wrote for the latest frame (`pose_dtype` of `stages/config.py`)."""
        return self._chain.packets[0].header

    @property
    def tensor(self) -> str:
        """The size of the latest frame's tensor, such as `256x192` (height x width); `none` if it needed no tensor."""
        height, width = self.posed["tensor_shape"].tolist()
        return f"{height}x{width}" if int(self.posed["work"]) == FrameWork.FULL else "none"

    def _picture(self, packet: Packet) -> U8:
        height, width, channels = self._shape
        picture: U8 = packet.payload[: height * width * channels].reshape(self._shape).copy()
        return picture
