"""The real raster stage, whose OpenGL context is taken away once in a run, before a frame.

Rule: only the first process of a run loses its context; a file in the run's folder remembers it.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from trilane.pipeline.stage import Stage, UnitContext
from trilane.stages.gpu import raster
from trilane.stages.gpu.opengl import LIBRARY
from trilane.transport.packets import Packet

FACTORY = "trilane.testing.lost_context:build"
BAD_FRAME = 3
MARK = "lost-context"


def lose_context() -> None:
    """Leave the calling thread without a context, as a driver does that was reset."""
    egl = ctypes.CDLL(LIBRARY)
    egl.eglGetCurrentDisplay.restype = ctypes.c_void_p
    egl.eglMakeCurrent.argtypes = (ctypes.c_void_p,) * 4
    if not egl.eglMakeCurrent(egl.eglGetCurrentDisplay(), None, None, None):
        raise OSError("eglMakeCurrent did not let go of the context")


class LosingStage:
    """`stage`, which loses its context before frame `BAD_FRAME` unless the file `mark` is there."""

    def __init__(self, stage: Stage, mark: Path) -> None:
        self._stage, self._mark = stage, mark

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        self._stage.bind(inputs, outputs)

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        if frame >= BAD_FRAME and not self._mark.exists():
            self._mark.touch()
            lose_context()
        return self._stage.run(frame, slot_in, slot_out)

    def close(self) -> None:
        self._stage.close()


def build(settings: Mapping[str, Any], unit: UnitContext) -> LosingStage:
    """The raster stage of `settings`; the mark is put into the folder `settings["config"]["out_dir"]`."""
    return LosingStage(raster.build(settings, unit), Path(settings["config"]["out_dir"]) / MARK)
