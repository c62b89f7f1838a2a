"""The pose stage without a way past the others: every frame is a full one. Rule: what it makes is the pose stage's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from trilane.pipeline.stage import UnitContext
from trilane.scene.planner import FrameWork
from trilane.stages.cpu import pose
from trilane.transport.packets import Packet


class FullFrames:
    """Forgets before each frame, and calls work full where nobody is seen."""

    def __init__(self, stage: pose.PoseStage) -> None:
        self._stage = stage
        self._outputs: Sequence[Packet] = ()

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        self._outputs = outputs
        self._stage.bind(inputs, outputs)

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        self._stage.forget()
        metrics = dict(self._stage.run(frame, slot_in, slot_out))
        if slot_out is not None:
            header = self._outputs[slot_out].header
            header["work"], header["picture"] = FrameWork.FULL, frame
        return metrics

    def close(self) -> None:
        self._stage.close()


def build(settings: Mapping[str, Any], unit: UnitContext) -> FullFrames:
    """The pose stage of the configuration in `settings`, without skips."""
    return FullFrames(pose.build(settings, unit))
