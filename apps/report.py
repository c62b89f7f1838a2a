"""report.json: what every run says of itself, on either clock.

Rule: the keys are those of the project's report schema; more may be added, none is renamed, and no speed is
reported without the machine it was measured on and the image error of the avatar it was measured with.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from trilane.errors import BadInputError
from trilane.hw_profiles.host import sensor_c
from trilane.pipeline.result import RunResult
from trilane.stages.config import RunConfig

MAX_REPORT_BYTES = 64 << 20
NO_CAP = "none: every unit works as much as its cores and threads allow"
#: What a comparison under another policy keeps of that run's report.
BASELINE_KEYS = ("frames", "frame_time_ms", "latency_ms", "fps", "deadline_misses", "stages", "units", "efficiency")


class Part(BaseModel):
    """A part of a report: the keys below, and whatever was added."""

    model_config = ConfigDict(extra="allow", frozen=True)


class Frames(Part):
    requested: int
    presented: int
    lost: int
    dropped: dict[str, int]


class StageTimes(Part):
    """Statistics of a stage: `service_ms` of its jobs, `wait_ms` between a job's input and its begin."""

    unit: str
    service_ms: dict[str, float]
    wait_ms: dict[str, float]


class Idle(Part):
    starved: float
    blocked: float
    throttled: float
    overhead: float


class UnitShare(Part):
    """Shares of the run's time; `busy` and the four parts of `idle` sum to 1."""

    busy: float
    idle: Idle


class Report(Part):
    """The whole document. `clock`: measured on this machine, or computed from a hardware profile."""

    schema_: int = Field(alias="schema")
    clock: Literal["host", "virtual"]
    machine: dict[str, Any]
    config: dict[str, Any]
    plan: dict[str, Any]
    frames: Frames
    frame_time_ms: dict[str, float]
    latency_ms: dict[str, float]
    fps: float
    deadline_misses: int
    stages: dict[str, StageTimes]
    units: dict[str, UnitShare]
    efficiency: float | None
    temperature_c: dict[str, Any]
    caps: dict[str, Any]


def build_report(
    result: RunResult, config: RunConfig, *, policy: str, machine: dict[str, Any], baseline: RunResult | None
) -> dict[str, Any]:
    """The report of a run on the host clock; the caller adds what its own parts say (`accuracy`, `plan`, files)."""
    report = {
        "schema": 1,
        "clock": "host",
        "machine": machine,
        "config": {**config.model_dump(mode="json", exclude={"out_dir"}), "policy": policy},
        "plan": {"tensor_shapes": [list(shape) for shape in config.buckets]},
        "caps": {"how": NO_CAP},
        **result.report,
        "temperature_c": {**result.report.get("temperature_c", {}), "sensor": sensor_c()},
        "pids": dict(result.pids),
        "startup_ms": dict(result.startup_ms),
        "figures": {stage: dict(figures) for stage, figures in result.figures.items()},
        "messages": list(result.messages),
        "interrupted": result.interrupted,
        "failure": None if result.failure is None else result.failure.message,
        "baseline": None,
    }
    if baseline is not None:
        report["baseline"] = {"policy": "sequential", **{key: baseline.report.get(key) for key in BASELINE_KEYS}}
    return report


def write_report(report: dict[str, Any], target: Path) -> None:
    """Write `report` as JSON. Raises ValueError for a NaN or an infinity."""
    target.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_report(path: Path) -> Report:
    """The report in `path`, a file or a run folder. Raises BadInputError naming the first key that is wrong."""
    file = path / "report.json" if path.is_dir() else path
    expected = "a run folder or its report.json"
    try:
        if file.stat().st_size > MAX_REPORT_BYTES:
            raise BadInputError(file, f"{file.stat().st_size} bytes", f"a report of at most {MAX_REPORT_BYTES}")
        return Report.model_validate_json(file.read_bytes())
    except OSError as error:
        raise BadInputError.of_os_error(file, error, expected) from None
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "the document"
        raise BadInputError(f"{file}: {key}", first["msg"].lower(), expected) from None
