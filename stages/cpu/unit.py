"""The CPU unit: it owns the first stage of a frame and the last."""

from __future__ import annotations

from trilane.pipeline.stage import Stage
from trilane.stages.config import RunConfig
from trilane.stages.cpu.pose import PoseStage
from trilane.stages.cpu.present import PresentStage


def build(config: RunConfig) -> dict[str, Stage]:
    """`pose` and `present`. Raises BadInputError."""
    return {"pose": PoseStage(config), "present": PresentStage(config)}
