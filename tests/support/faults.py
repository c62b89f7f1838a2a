"""Real signals at told moments for the processes of a run's units, and what the run lost and left behind."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from trilane.pipeline.description import Pipeline
from trilane.pipeline.fork_server import process_name
from trilane.pipeline.run import run_pipeline
from trilane.scheduler.events import UnitDied

SHM = Path("/dev/shm")  # noqa: S108 - looked at, not written to
WAIT_S = 0.02


def unit_process(unit: str) -> psutil.Process:
    """The process of `unit` in the run that this process has under way. Raises LookupError when there is none."""
    for process in psutil.Process().children(recursive=True):
        if process.name() == process_name(unit):
            return process
    raise LookupError(unit)


@dataclass
class Signals(threading.Thread):
    """Sends signals to the process of one unit while a run goes on.

    `unit`: its name.
    `moments`: (seconds from the first presented frame, signal).
    `sent`: how many were sent, without those that let a stopped process go on.
    `begun`, `over`: set by the run with its first frame and at its end.
    """

    unit: str
    moments: list[tuple[float, signal.Signals]]
    sent: int = 0
    begun: threading.Event = field(default_factory=threading.Event)
    over: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        super().__init__(name="signals", daemon=True)

    def run(self) -> None:
        self.begun.wait()
        start = time.monotonic()
        for at_s, number in self.moments:
            if self.over.wait(max(0.0, start + at_s - time.monotonic())):
                return
            process = self._process()
            if process is not None:
                with contextlib.suppress(psutil.NoSuchProcess):
                    process.send_signal(number)
                    if number != signal.SIGCONT:
                        self.sent += 1

    def _process(self) -> psutil.Process | None:
        """The unit's process, once there is one."""
        while not self.over.is_set():
            with contextlib.suppress(psutil.Error, LookupError):
                return unit_process(self.unit)
            self.over.wait(WAIT_S)
        return None

    def __hash__(self) -> int:
        return id(self)


def run_under(signals: Signals, pipeline: Pipeline, frames: int, fps: float, hang_s: float) -> dict[str, Any]:
    """What one run under `signals` lost, and how many processes and names in /dev/shm it left behind.

    `frames`: that are requested.
    `fps`: at which they are released.
    `hang_s`: after which a unit without a heartbeat is restarted.
    """
    names = _names()
    children = set(psutil.Process().children(recursive=True))
    signals.start()
    try:
        result = run_pipeline(
            pipeline,
            frames,
            pace_fps=fps,
            hang_ns=round(hang_s * 1e9),
            on_progress=lambda *_: signals.begun.set(),
        )
    finally:
        signals.begun.set()
        signals.over.set()
        signals.join()
    left = len(set(psutil.Process().children(recursive=True)) - children) + len(_names() - names)
    lost, dropped = sum(result.lost.values()), sum(result.dropped.values())
    died = sum(isinstance(event, UnitDied) for _, events, _ in result.recording.steps for event in events)
    return {
        "signals": signals.sent,
        "ended": "failed: " + result.failure.message if result.failure else "all frames",
        "presented": result.presented,
        "dropped": dropped,
        "uncounted": result.requested - result.presented - lost - dropped,
        "lost_per_death": lost / (died or 1),
        "restarts": result.report.units[signals.unit].restarts,
        "left": left,
    }


def _names() -> set[str]:
    """What Trilane has in /dev/shm; other programs come and go there."""
    return {path.name for path in SHM.glob("*trilane*")}
