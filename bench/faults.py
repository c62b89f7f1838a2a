"""What does a run lose when its units are killed or stopped, and how soon is it back to its pace?

Rule: real processes get real signals at random moments; what is left afterwards is looked for, not assumed.
"""

from __future__ import annotations

import contextlib
import random
import signal
import tempfile
import threading
import time
from dataclasses import dataclass, field
from itertools import pairwise, product
from pathlib import Path
from statistics import median
from typing import Any

import psutil

from trilane.errors import BadInputError
from trilane.pipeline.description import Pipeline
from trilane.pipeline.fork_server import process_name
from trilane.pipeline.result import RunResult
from trilane.pipeline.run import run_pipeline
from trilane.pipeline.shared_assets import Assets
from trilane.scheduler.events import UnitDied, UnitReady
from trilane.stages.avatar_pipeline import avatar_pipeline
from trilane.stages.configure import configure
from trilane.stages.run_options import RunOptions
from trilane.units import UNITS

FAULTS = ("kill", "stop")
SHM = Path("/dev/shm")  # noqa: S108 - looked at, not written to
#: A run is back to its pace with the first of so many frames whose mean distance is at most so many periods.
PACE_FRAMES, PACE_PERIODS = 5, 1.2
SPACE = 0.7  # share of the mean time between two signals in which no other is sent
WAIT_S = 0.02


def measure(
    unit: tuple[str, ...] = UNITS,
    fault: tuple[str, ...] = ("kill",),
    times: int = 20,
    seconds: float = 60.0,
    fps: float = 15.0,
    stop_s: float = 5.0,
    hang_s: float = 10.0,
    avatar: str = "default",
    size: str = "256x256",
    runtime: str = "auto",
    seed: int = 1,
) -> dict[str, Any]:
    """A run for each unit and fault: `kill` (SIGKILL, `times` in a run) or `stop` (SIGSTOP once, for `stop_s` seconds).

    Rows: `signals` sent; `ended`: all frames, or why it failed; frames `requested`, `presented`, `lost`, `dropped` and
    `uncounted` (none of these three); `lost_per_death`; `restarts`; `ready_ms`: from a unit's death until it is ready
    again, model load and context included, median; `back_ms`, `back_max_ms`: from a signal until the run is back to its
    pace, median and longest; `not_back`: signals after which the next signal came before the run was back to its pace;
    `left`: processes and names of Trilane's in /dev/shm afterwards.

    Raises BadInputError, MissingPartError.
    """
    _check(unit, fault, times, seconds, fps, stop_s, hang_s)
    frames = round(seconds * fps)
    checked = configure(RunOptions(size=size, avatar=avatar, frames=frames, runtime=runtime), Path.cwd())
    rows = []
    for name, kind in product(unit, fault):
        signals = Signals(name, _moments(kind, times, seconds, stop_s, seed))
        with tempfile.TemporaryDirectory(prefix="trilane-bench-") as folder:
            pipeline = avatar_pipeline(checked.changed(out_dir=Path(folder)).config, checked.assets)
            row = run_under(signals, pipeline, frames, fps, hang_s, checked.assets)
        rows.append({"unit": name, "fault": kind, **row})
    return {
        "rows": rows,
        "accuracy": dict(checked.accuracy),
        "config": {"seconds": seconds, "fps": fps, "size": size, "runtime": checked.config.runtime, "seed": seed},
    }


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
    `sent_ns`: when each was sent, without those that let a stopped process go on.
    `begun`, `over`: set by the run with its first frame and at its end.
    """

    unit: str
    moments: list[tuple[float, signal.Signals]]
    sent_ns: list[int] = field(default_factory=list)
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
                        self.sent_ns.append(time.monotonic_ns())

    def _process(self) -> psutil.Process | None:
        """The unit's process, once there is one."""
        while not self.over.is_set():
            with contextlib.suppress(psutil.Error, LookupError):
                return unit_process(self.unit)
            self.over.wait(WAIT_S)
        return None

    def __hash__(self) -> int:
        return id(self)


def run_under(
    signals: Signals, pipeline: Pipeline, frames: int, fps: float, hang_s: float, assets: Assets | None = None
) -> dict[str, Any]:
    """The row of one run under `signals`.

    `pipeline`, `assets`: what is run, and the arrays that its stages may read.
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
            assets=assets,
            hang_ns=round(hang_s * 1e9),
            on_progress=lambda *_: signals.begun.set(),
        )
    finally:
        signals.begun.set()
        signals.over.set()
        signals.join()
    left = len(set(psutil.Process().children(recursive=True)) - children) + len(_names() - names)
    return _row(result, signals, round(1e9 / fps)) | {"left": left}


def _row(result: RunResult, signals: Signals, period_ns: int) -> dict[str, Any]:
    lost, dropped = sum(result.lost.values()), sum(result.dropped.values())
    back = back_to_pace_ms(signals.sent_ns, presented_ns(result), period_ns)
    ready = ready_ms(result, signals.unit)
    return {
        "signals": len(signals.sent_ns),
        "ended": "failed: " + result.failure.message if result.failure else "all frames",
        "requested": result.requested,
        "presented": result.presented,
        "lost": lost,
        "dropped": dropped,
        "uncounted": result.requested - result.presented - lost - dropped,
        "lost_per_death": lost / (deaths(result) or 1),
        "restarts": result.report.units[signals.unit].restarts,
        "ready_ms": median(ready) if ready else None,
        "back_ms": median(back) if back else None,
        "back_max_ms": max(back) if back else None,
        "not_back": len(signals.sent_ns) - len(back),
    }


def presented_ns(result: RunResult) -> list[int]:
    """When each frame was presented, in order."""
    return sorted(job.end_ns for job in result.jobs if job.stage == "present")


def back_to_pace_ms(sent_ns: list[int], presented: list[int], period_ns: int) -> list[float]:
    """Milliseconds from each signal until the run was back to its pace; none where the next signal came before.

    `sent_ns`: when the signals were sent.
    `presented`: when each frame was presented, in order, ns.
    `period_ns`: of the run's pace.
    """
    times = []
    for at_ns, next_ns in pairwise([*sent_ns, presented[-1] + 1 if presented else 0]):
        after = [end_ns for end_ns in presented if at_ns < end_ns < next_ns]
        spans = zip(after, after[PACE_FRAMES - 1 :], strict=False)
        limit = PACE_PERIODS * period_ns * (PACE_FRAMES - 1)
        first = next((begin for begin, end in spans if end - begin <= limit), None)
        if first is not None:
            times.append((first - at_ns) / 1e6)
    return times


def ready_ms(result: RunResult, unit: str) -> list[float]:
    """Milliseconds from each death of `unit` until it was ready again, back-off included."""
    times, died_ns = [], None
    for now_ns, events, _ in result.recording.steps:
        for event in events:
            if isinstance(event, UnitDied) and event.unit == unit:
                died_ns = now_ns
            elif isinstance(event, UnitReady) and event.unit == unit and died_ns is not None:
                times.append((now_ns - died_ns) / 1e6)
                died_ns = None
    return times


def deaths(result: RunResult) -> int:
    """How often the process of any unit ended during the run."""
    return sum(isinstance(event, UnitDied) for _, events, _ in result.recording.steps for event in events)


def _moments(fault: str, times: int, seconds: float, stop_s: float, seed: int) -> list[tuple[float, signal.Signals]]:
    """(seconds, signal) of each."""
    draw = random.Random(seed)
    if fault == "stop":
        at_s = seconds * draw.uniform(0.1, 0.3)
        return [(at_s, signal.SIGSTOP), (at_s + stop_s, signal.SIGCONT)]
    mean_s = seconds / (times + 1)
    free_s = (1 - SPACE) * mean_s
    return [((number + 1) * mean_s + draw.uniform(-free_s, free_s) / 2, signal.SIGKILL) for number in range(times)]


def _names() -> set[str]:
    """What Trilane has in /dev/shm; other programs come and go there."""
    return {path.name for path in SHM.glob("*trilane*")}


def _check(
    units: tuple[str, ...],
    faults: tuple[str, ...],
    times: int,
    seconds: float,
    fps: float,
    stop_s: float,
    hang_s: float,
) -> None:
    tests: tuple[tuple[str, str, bool, str], ...] = (
        ("--unit", ", ".join(units), set(units) <= set(UNITS), f"of {', '.join(UNITS)}"),
        ("--fault", ", ".join(faults), set(faults) <= set(FAULTS), f"of {', '.join(FAULTS)}"),
        ("--times", str(times), 1 <= times <= 1000, "1 to 1000"),
        ("--seconds", str(seconds), 1 <= seconds <= 3600, "1 to 3600"),
        ("--fps", str(fps), 1 <= fps <= 1000, "1 to 1000"),
        ("--hang-s", str(hang_s), 0.1 <= hang_s <= 600, "0.1 to 600"),
    )
    if "stop" in faults:
        tests += (("--stop-s", str(stop_s), 0 < stop_s < 0.7 * seconds, f"more than 0, less than {0.7 * seconds:g}"),)
    for option, value, passed, expected in tests:
        if not passed:
            raise BadInputError(option, value, expected)
