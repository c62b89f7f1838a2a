"""The DSP unit: it owns the infer stage."""

from __future__ import annotations

from trilane.scene.schema import RunConfig
from trilane.stages.contracts import Stage
from trilane.stages.dsp.infer import InferStage


def build(config: RunConfig) -> dict[str, Stage]:
    """The unit's stages by name. Raises BadInputError, MissingPartError."""
    return {"infer": InferStage(config)}
