"""report.json: what every run says of itself.

Rule: one model writes the file and reads it, and its fields stand in the order of the file's keys. No speed is reported
without the machine it was measured on and the image error of the avatar it was measured with.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError
from pydantic_core import from_json

from trilane.apps.report_sources import sources_of
from trilane.errors import BadInputError
from trilane.files import require_file
from trilane.machine import here
from trilane.pipeline.result import RunResult
from trilane.pipeline.run_metrics import (
    Bound,
    Caps,
    CoreShare,
    FrameCounts,
    FrameTimes,
    MovedInAll,
    Record,
    RunMetrics,
    StageTimes,
    Temperature,
    TimeSummary,
    UnitShares,
)
from trilane.shapes import Shape
from trilane.stages.config import RunConfig

SCHEMA = 1
MAX_REPORT_BYTES = 64 << 20
NO_CAP = "none: every unit works as much as its cores and threads allow"
EXPECTED = "a run folder or its report.json"


class Cpu(Record):
    """The processor.

    `model`: its name.
    `architecture`: such as x86_64.
    `flags`: of its instructions those that decide how fast networks run.
    `cores`: that the machine has.
    `cores_allowed`: numbers of those that the run might use.
    """

    model: str
    architecture: str
    flags: tuple[str, ...]
    cores: int
    cores_allowed: tuple[int, ...]


class GlDriver(Record):
    """The OpenGL driver. `hardware`: false when the CPU draws; `limits`: OpenGL's constants of that name."""

    vendor: str
    renderer: str
    version: str
    hardware: bool
    limits: dict[str, int | tuple[int, ...]]


class Machine(Record):
    """The machine that was measured.

    `system`: operating system and kernel.
    `python`, `trilane`: versions; null for a Trilane that was never installed.
    `cpu`: the processor.
    `hardware_counters`: what was counted of each job, or `absent` and why; null in reports of before it was said.
    `memory_bytes`: physical memory.
    `gl`: the OpenGL driver, null when there is none.
    `packages`: version of each that is installed and that Trilane uses.
    """

    system: str
    python: str
    trilane: str | None
    cpu: Cpu
    hardware_counters: str | None = None
    memory_bytes: int
    gl: GlDriver | None
    packages: dict[str, str]


class WorkPlan(Record):
    """What the scene's size allows. `tensor_shapes`: (height, width) in pixels of the tensors that may be drawn."""

    tensor_shapes: tuple[Shape, ...]


class Baseline(Record):
    """The same scene under another policy; the keys mean what they mean in the report. `policy`: which one."""

    policy: str
    frames: FrameCounts
    frame_time_ms: FrameTimes
    latency_ms: TimeSummary
    fps: float
    fps_low: float | None = None
    fps_high: float | None = None
    deadline_misses: int
    stages: dict[str, StageTimes]
    bytes: MovedInAll | None = None
    units: dict[str, UnitShares]
    efficiency: float | None = None
    core_efficiency: float | None = None
    machine_efficiency: float | None = None
    bottleneck: str | None = None
    bound: Bound | None = None
    core_shares: tuple[CoreShare, ...] = ()


class PaceComparison(Record):
    """A run at the pace of a chip, beside the same run in virtual time.

    `profile`: hardware profile of the chip.
    `performance_profile`: under which the chip runs.
    `slow_motion`: how many times slower than the chip.
    `stage_ms`: how long a job of each stage was held.
    `host_slower`: of each stage, jobs that the host did not do in that time.
    `late_frames`: numbers of the frames that such jobs belong to.
    `virtual_ms`: median frame time in virtual time.
    `measured_ms`: median frame time here, over frames with no late one near; null when there is none.
    `compared_share`: share of the frames that were compared.
    `ratio`: measured over virtual; null when no frame was compared.
    """

    profile: str
    performance_profile: str
    slow_motion: float
    stage_ms: dict[str, float]
    host_slower: dict[str, int]
    late_frames: tuple[int, ...]
    virtual_ms: float
    measured_ms: float | None
    compared_share: float
    ratio: float | None


class Video(Record):
    """video.mp4. `frames`: in it; `seconds`: until the end of the last one."""

    frames: int
    seconds: float


class FrameErrors(Record):
    """Frames of the run itself `against` something, where the avatars are.

    `psnr_db`, `mae` (steps of 1/255), `ssim`, `flip`: means over them; `ssim` null where the picture is too small.
    `worst_psnr_db`: of one frame; `p1_psnr_db`: 1st percentile, null in reports of an older Trilane.
    `iou`: mean, of where both pictures differ from the background.
    """

    against: str
    psnr_db: float
    worst_psnr_db: float
    p1_psnr_db: float | None = None
    mae: float
    ssim: float | None
    flip: float
    iou: float


class Check(FrameErrors):
    """Frames of the run itself against the truth where it is known, else against the float path.

    `frames`: how many were compared; `numbers`: which. `float_path`: the same frames against the float path; null where
    the first figures are that already.
    """

    frames: int
    numbers: tuple[int, ...]
    float_path: FrameErrors | None = None


class Made(Record):
    """How a report came about.

    `at`: when the command began, UTC as in ISO 8601.
    `command`: the command line, word by word.
    `trilane`: its version; null for a Trilane that was never installed.
    `revision`: git's of the checkout that Trilane ran from, null when it is none.
    `modified`: whether files of that checkout differed from it; null without one.
    """

    at: str
    command: tuple[str, ...]
    trilane: str | None
    revision: str | None
    modified: bool | None


class UnitPlace(Record):
    """`cores` of a unit and `threads`: as many, or one that the kernel runs on any of them."""

    cores: tuple[int, ...]
    threads: int


class OtherPlacement(Record):
    """A placement that was not chosen. `units`: place of each; `predicted_ms`: time of a frame."""

    units: dict[str, UnitPlace]
    predicted_ms: float


class TriedPlacement(Record):
    """A placement that real frames went through. `units`: place of each; `frame_ms`: time of a frame."""

    units: dict[str, UnitPlace]
    frame_ms: float


class UnitTime(Record):
    """What a unit was measured to need for a frame with so many `threads`, in ms.

    `ms`: how long its jobs took, without the time in which it had no core.
    `core_ms`: CPU time for each thread.
    """

    unit: str
    threads: int
    ms: float
    core_ms: float


class PlacementFacts(Record):
    """Why the units have the cores that they have (`trilane.stages.placing`).

    `how`: tried, measured, asked or rule.
    `why`: in words.
    `units`: place of each.
    `measured_at`: when the times were measured, UTC; absent, as all below, when nothing was.
    `predicted_ms`: time of a frame of the policy of the run.
    `rule_ms`, `rule`: of the placement for any run.
    `alternatives`: the next best, the shortest frame time first.
    `times`: medians of distinct frames, one job at a time; a row for each unit and number of threads.
    `tried`: what real frames went through before the run, or before an earlier one; absent when none was.
    """

    how: Literal["tried", "measured", "asked", "rule"]
    why: str
    units: dict[str, UnitPlace]
    measured_at: str = ""
    predicted_ms: float | None = None
    rule_ms: float | None = None
    rule: dict[str, UnitPlace] = Field(default={})
    alternatives: tuple[OtherPlacement, ...] = ()
    times: tuple[UnitTime, ...] = ()
    tried: tuple[TriedPlacement, ...] = ()


class TensorSize(Record):
    """Of one size of a planned tensor.

    `work`: share of the pixels that the network was trained for.
    `most_pixels`: of an avatar.
    `frames`: presented ones that were given it.
    `psnr_loss_db`: what it costs, by the avatars' validation; null where an avatar has no figures by size.
    """

    work: float
    most_pixels: int
    frames: int
    psnr_loss_db: float | None


class Resolution(Record):
    """How the tensor was stepped down so that frames were in time.

    `sizes`: the largest first.
    `switches`: how often a presented frame had another size than the one before.
    `loss_source`: where the losses come from, or why there are none.
    """

    sizes: tuple[TensorSize, ...]
    switches: int
    loss_source: str


OptionValue = str | int | float | bool | tuple[str, ...] | None


class Preamble(Record):
    """The keys that a report begins with.

    `schema_`: `schema` in the file, 1.
    `clock`: of the times.
    `machine`: that the run was measured on.
    `config`: the RunConfig as JSON without its folder, and `policy` and `edge`.
    `plan`: what followed from it.
    `caps`: what held the units.
    """

    schema_: Literal[1] = Field(alias="schema")
    clock: Literal["host", "virtual"]
    machine: Machine
    config: dict[str, Any]
    plan: WorkPlan
    caps: Caps


class Report(RunMetrics, Preamble):
    """The whole document: the keys of `Preamble`, those of `RunMetrics` that it has not, and these.

    `made`: when, by which command line and which Trilane; null where it was run by a program.
    `options`: every option of the run by its name, as it was asked for; empty where another Trilane left them out.
    `pids`: process of each unit at the end.
    `startup_ms`: until each unit was ready.
    `stage_metrics`: `figures` in the file: mean of each metric that a stage gave with its jobs.
    `messages`: to a person, of what went wrong on the way.
    `interrupted`: whether a signal ended the run.
    `failure`: why it ended early, null when it did not.
    `baseline`: the `sequential` run of the same scene, null when there was none.
    `placement`: why the units have the cores that they have; absent for a run by a program.
    `resolution`: of a run whose frames had to be in time and whose tensor was planned; absent for others.
    `pace`: of a run at a chip's pace.
    `accuracy`: of each avatar, what `trilane.avatars.validation.accuracy_of` says: its figures, or why there are none.
    `check`: frames of the run itself against the truth or the float path; absent where none was asked for.
    `sources`: key, dotted where it is inside another, to where the figures below it come from; the longest key decides.
    `notes`: the format that each opened file was read as, and what was chosen for the run.
    `video`: null when no frame was recorded.
    `checksum`: SHA-256 over the presented pictures, null when none was recorded.
    """

    caps: Caps
    temperature_c: Temperature
    made: Made | None = None
    options: dict[str, OptionValue] = Field(default={})
    pids: dict[str, int]
    startup_ms: dict[str, float]
    stage_metrics: dict[str, dict[str, float]] = Field(alias="figures")
    messages: tuple[str, ...]
    interrupted: bool
    failure: str | None
    baseline: Baseline | None
    placement: PlacementFacts | None = None
    resolution: Resolution | None = None
    pace: PaceComparison | None = None
    accuracy: dict[str, dict[str, Any]] = Field(default={})
    check: Check | None = None
    sources: dict[str, str] = Field(default={})
    notes: tuple[str, ...] = ()
    video: Video | None
    checksum: str | None


def build_report(
    result: RunResult,
    config: RunConfig,
    *,
    machine: Mapping[str, Any],
    baseline: RunResult | None,
    facts: Mapping[str, Any],
) -> Report:
    """The report of a run on the host clock. Raises ValueError naming a wrong or unknown key.

    `result`: of the run.
    `config`: that it ran.
    `machine`: what `machine_facts` said.
    `baseline`: of the same scene under another policy, None without one.
    `facts`: what others know of the run: `video`, `checksum`, and any of `made`, `options`, `placement`, `resolution`,
    `pace`, `accuracy`, `check`, `notes`.
    """
    metrics = result.report
    sensor = {"sensor": here.sensor_c()}
    document = {
        **metrics.as_json(),
        "schema": SCHEMA,
        "machine": machine,
        "config": config_facts(config, metrics.policy, metrics.edge),
        "plan": {"tensor_shapes": config.buckets},
        "caps": metrics.caps.as_json() if metrics.caps else {"how": NO_CAP},
        "temperature_c": (metrics.temperature_c.as_json() if metrics.temperature_c else {}) | sensor,
        "pids": result.pids,
        "startup_ms": result.startup_ms,
        "figures": result.metrics,
        "messages": result.messages,
        "interrupted": result.interrupted,
        "failure": result.failure and result.failure.message,
        "baseline": baseline and _compared(baseline.report),
        **facts,
    }
    return Report.model_validate(document | {"sources": sources_of(document)})


def config_facts(config: RunConfig, policy: str, edge: str) -> dict[str, Any]:
    """`config` of the report."""
    return {**config.model_dump(mode="json", exclude={"out_dir", "window", "kept"}), "policy": policy, "edge": edge}


def _compared(metrics: RunMetrics) -> Baseline:
    return Baseline.model_validate({key: getattr(metrics, key) for key in Baseline.model_fields})


def write_report(report: Report, target: Path) -> None:
    """Write `report` as JSON. Raises ValueError for a report that could not be read back, a NaN or an infinity."""
    document = report.as_json()
    Report.model_validate(document)
    target.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_report(path: Path) -> Report:
    """The report in `path`, a file or a run folder. Raises BadInputError naming the first key that is wrong.

    A report of a newer schema is refused as such.
    """
    file = path / "report.json" if path.is_dir() else path
    try:
        if (size := require_file(file, EXPECTED)) > MAX_REPORT_BYTES:
            raise BadInputError(file, f"{size} bytes", f"a report of at most {MAX_REPORT_BYTES}")
        document = from_json(file.read_bytes())
        _refuse_newer(file, document)
        return Report.model_validate(document)
    except OSError as error:
        raise BadInputError.of_os_error(file, error, EXPECTED) from None
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "the document"
        raise BadInputError(f"{file}: {key}", first["msg"].lower(), EXPECTED) from None
    except ValueError as error:
        raise BadInputError(f"{file}: the document", str(error), EXPECTED) from None


def _refuse_newer(file: Path, document: Any) -> None:
    schema = document.get("schema") if isinstance(document, dict) else None
    if isinstance(schema, int) and schema > SCHEMA:
        raise BadInputError(f"{file}: schema", str(schema), f"{SCHEMA}", "a newer Trilane wrote it: update this one")
