"""The DSP unit: it owns the infer stage, or the parts of it that were not given to another unit."""

from __future__ import annotations

from trilane.pipeline.stage import Stage
from trilane.stages.config import RunConfig
from trilane.stages.dsp.infer import infer_stages


def build(config: RunConfig) -> dict[str, Stage]:
    """The unit's stages by name. Raises BadInputError, MissingPartError."""
    return {**infer_stages(config, "dsp")}
