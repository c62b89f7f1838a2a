"""The block `encode`: writes pictures to a video.

The pictures go into a segment below the run's folder, which a killed unit leaves whole up to its last frames. After the
run the segments are joined to the video. Where somebody watches the run, the newest picture goes to the window too.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.pipeline.stage import Arrays, PortedStage, UnitContext
from trilane.stages.cpu.present import Segment
from trilane.transport.live_window import LiveWindow


class Encode(PortedStage):
    """Encodes one picture a frame.

    Keys: `fps`, `segments`: name of the folder of segments below the run's folder, `window`: path of the window for the
    newest picture; empty for none. Sides are cut to even numbers, as the video's colours need it.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(settings)
        height, width, self._channels = self.reads[0].type.shape
        self._height, self._width = max(height // 2 * 2, 2), max(width // 2 * 2, 2)
        folder = self.settings.run_folder / self.settings.keys["segments"]
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{time.monotonic_ns():020d}-{os.getpid()}.mp4"
        self._fps = self.settings.keys["fps"]
        self._segment: Segment | None = Segment(path, self._fps, self._height, self._width)
        window = self.settings.keys.get("window")
        self._window = LiveWindow.opened(Path(window), self._height, self._width) if window else None

    def work(self, frame: int, arrays: Sequence[NDArray[Any] | None], outputs: Arrays) -> Mapping[str, float]:  # noqa: ARG002
        if arrays[0] is None or self._segment is None:
            return {}
        picture = arrays[0][: self._height, : self._width, :3]
        picture = np.ascontiguousarray(picture if self._channels > 1 else np.repeat(picture, 3, axis=2))
        if self._window is not None and self._window.is_looked_at:
            self._window.show(frame, frame / self._fps, self.sampled_ns, picture)
        self._segment.moved.start()
        self._segment.digest(frame, picture)
        self._segment.add(frame, picture)
        return {}

    def close(self) -> None:
        if self._segment is not None:
            self._segment.close()
            self._segment = None


def build(settings: Mapping[str, Any], unit: UnitContext) -> Encode:  # noqa: ARG001 - a factory's signature
    """Build the block."""
    return Encode(settings)
