"""Stands for a configuration and for the result of a run. Rule: every number has a value of its own, told here."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from trilane.scheduler.ledger import JobRecord
from trilane.stages.run_options import RunOptions


class ToldConfig:
    """Stands for what was configured: `changed` keeps what is laid over it."""

    runtime = "told"

    def __init__(self, request: RunOptions, **values: Any) -> None:
        self.request, self.values = request, values
        self.accuracy = {request.avatar: f"accuracy of {request.avatar}"}
        self.assets = f"assets of {request.avatar}"
        self.config = self

    def changed(self, **values: Any) -> ToldConfig:
        return ToldConfig(self.request, **{**self.values, **values})


def _times(mean: float) -> SimpleNamespace:
    return SimpleNamespace(mean=mean)


def result_of(policy: str, frame_ms: float, **changes: Any) -> SimpleNamespace:
    """A run of `pose` (2 ms) and `present` (3 ms) on the unit `host`, and `raster` (10 ms).

    The unit of `raster` is the slowest and the busiest, and is not the last by its name.
    """
    stage = {"pose": ("host", 2.0), "raster": ("gpu", 10.0), "present": ("host", 3.0)}
    report = SimpleNamespace(
        policy=policy,
        fps=1000 / frame_ms,
        efficiency=0.75,
        frame_time_ms=_times(frame_ms),
        stages={name: SimpleNamespace(unit=unit, service_ms=_times(mean)) for name, (unit, mean) in stage.items()},
        units={"host": SimpleNamespace(busy=0.3, restarts=5), "gpu": SimpleNamespace(busy=0.6, restarts=2)},
    )
    jobs = [("gpu", 0, 0, 0, 10), ("gpu", 14, 17, 20, 50), ("host", 0, 0, 30, 40)]
    told = {
        "report": report,
        "jobs": [JobRecord("raster", unit, 0, *instants) for unit, *instants in jobs],
        "dropped": {"a": 2, "b": 3},
        "lost": {"c": 1, "d": 6},
        "presented": 20,
        "interrupted": False,
        "failure": None,
    }
    return SimpleNamespace(**told | changes)
