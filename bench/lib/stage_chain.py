"""The composited frames of a run, made by its own stages, one after the other in this process.

Rule: the stages are built by the pipeline's factories and bound as a unit's process binds them, so a frame has the
bytes that a run presents.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import U8
from trilane.pipeline.bound_stage import BoundStage
from trilane.pipeline.description import Pipeline
from trilane.pipeline.shared_assets import Assets
from trilane.pipeline.stage import UnitContext
from trilane.pipeline.unit_loop import factory_named
from trilane.stages.avatar_pipeline import avatar_pipeline
from trilane.stages.configure import Checked
from trilane.stages.gpu.opengl_context import CONTEXT, open_context
from trilane.transport.packets import Packet, SlotLayout, view_packet

Units = Mapping[str, UnitContext]


def units_of(pipeline: Pipeline, assets: Assets) -> Units:
    """What the stages of each unit share. Chains that draw in one process must share them too: one OpenGL context."""
    return {name: UnitContext(name, settings, assets) for name, settings in pipeline.units.items()}


class StageChain:
    """All stages of a pipeline but the last, on one slot an edge."""

    def __init__(self, pipeline: Pipeline, units: Units) -> None:
        """Build and bind the stages. Raises what their factories raise."""
        self._packets = [_packet(SlotLayout(edge.header, edge.payload_bytes)) for edge in pipeline.edges]
        self._stages = []
        for number, stage in enumerate(pipeline.stages[:-1]):
            unit = units[stage.unit]
            inputs, outputs = self._packets[max(number - 1, 0) : number], self._packets[number : number + 1]
            made = factory_named(stage.factory)(stage.settings, unit)
            self._stages.append(BoundStage(stage.name, made, inputs, outputs, 0, unit))

    def run(self, frame: int, first: int = 0, last: int | None = None) -> Packet:
        """Do frame `frame` from stage number `first` on; what stage number `last`, or the last one, handed on."""
        last = len(self._stages) - 1 if last is None else last
        for number in range(first, last + 1):
            self._stages[number].run(frame, 0 if number else -1, 0, 0)
        return self._packets[last]


class AvatarFrames:
    """The frames of a scene, as a run presents them."""

    def __init__(self, checked: Checked, units: Units | None = None) -> None:
        """`units`: of other frames that are made in this process. Raises BadInputError, MissingPartError."""
        pipeline = avatar_pipeline(checked.config, checked.assets)
        self.units = units_of(pipeline, checked.assets) if units is None else units
        self._chain = StageChain(pipeline, self.units)
        self._composite = len(pipeline.stages) - 2
        self._shape = (checked.config.scene.output.height, checked.config.scene.output.width, 3)

    def frame(self, number: int) -> U8:
        """(h,w,3) uint8, sRGB: frame `number`, composited."""
        return self._picture(self._chain.run(number))

    @property
    def gl(self) -> Any:
        """The OpenGL context that the stages draw with."""
        return self.units["gpu"].shared(CONTEXT, open_context)

    def background(self, number: int) -> U8:
        """(h,w,3) uint8: the same with everything that is under the avatars, their shadows too, but without them."""
        self._chain.run(number, last=self._composite - 2)
        picture = self._chain.run(number, self._composite - 1, self._composite - 1)
        picture.payload[:] = 0
        return self._picture(self._chain.run(number, self._composite))

    def posed(self, number: int) -> NDArray[np.void]:
        """What the pose stage says of frame `number`, the shape of its tensor too: a header as in `stages/packets.py`.

        It is overwritten by the next frame.
        """
        return self._chain.run(number, last=0).header

    def _picture(self, packet: Packet) -> U8:
        height, width, channels = self._shape
        picture: U8 = packet.payload[: height * width * channels].reshape(self._shape).copy()
        return picture


def _packet(layout: SlotLayout) -> Packet:
    return view_packet(memoryview(bytearray(layout.slot_bytes)), layout)
