"""The blocks `busy`, a load that is made up, and `discard`, which takes frames and does nothing with them."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from numpy.typing import NDArray

from trilane.pipeline.file_keys import BypassKeys
from trilane.pipeline.stage import Arrays, PortedStage, Skip, UnitContext
from trilane.units import NS_PER_MS


class Busy(PortedStage):
    """Works for a stated time of its core, and writes zeros; it sends as many frames to a bypass as the file says."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(settings)
        said = self.settings.keys.get("bypass")
        self._way = None if said is None else BypassKeys.model_validate(said)

    def work(self, frame: int, arrays: Sequence[NDArray[Any] | None], outputs: Arrays) -> Mapping[str, float]:  # noqa: ARG002
        # CPU time, because a stage that lost its core to another has its work still before it.
        end_ns = time.thread_time_ns() + round(self.settings.keys["load_ms"] * NS_PER_MS)
        while time.thread_time_ns() < end_ns:
            pass
        return Skip() if self._way is not None and self._way.takes(frame) else {}


class Discard(PortedStage):
    """Takes frames and does nothing with them."""

    def work(self, frame: int, arrays: Sequence[NDArray[Any] | None], outputs: Arrays) -> Mapping[str, float]:  # noqa: ARG002
        return {}


def build(settings: Mapping[str, Any], unit: UnitContext) -> PortedStage:  # noqa: ARG001 - a factory's signature
    """Build the block that the keys name."""
    return {"busy": Busy, "discard": Discard}[settings["keys"]["block"]](settings)
