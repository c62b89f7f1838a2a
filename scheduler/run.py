"""Run the pipeline on this machine. Rule: whatever happens, the units' processes are gone when this returns."""

from __future__ import annotations

from collections.abc import Callable

from trilane.scene.schema import RunConfig
from trilane.scheduler.result import RunResult


def run_pipeline(
    config: RunConfig,
    *,
    policy: str = "pipelined",
    edge: str = "double",
    frames: int | None = None,
    pace_fps: float | None = None,
    isolate_frames: int = 8,
    on_progress: Callable[[int, int], None] | None = None,
    on_message: Callable[[str], None] | None = None,
) -> RunResult:
    """Run `frames` frames (the scene's count when None) through the three units and report.

    `policy`: sequential, pipelined, latest, deadline. `edge`: single, double, triple, fifo:N, orphan[:N].
    `pace_fps`: frames are released at that rate; None releases them as fast as they are taken (`latest` and
    `deadline` are always paced, by the scene's fps when None). `isolate_frames`: frames measured with the other
    units quiet before the run, which efficiency needs; 0 leaves both out. `on_progress(presented, requested)` and
    `on_message(text)` are called from this thread. SIGINT or SIGTERM ends the run cleanly with its result marked
    `interrupted`; a second one ends the units at once.

    Raises BadInputError, MissingPartError or another TrilaneError when a unit cannot start; a failure after that
    is `RunResult.failure`.
    """
    raise NotImplementedError("being written")
