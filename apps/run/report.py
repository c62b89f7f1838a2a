"""report.json as typed records: one model writes the file and reads it.

Rule: fields stand in the order of the file's keys. No speed is reported without the machine it was measured on and the
image error of the avatar it was measured with.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError
from pydantic_core import from_json

from trilane.arrays import Shape
from trilane.errors import BadInputError
from trilane.files import require_file
from trilane.pipeline.run_metrics import (
    Caps,
    PolicyMetrics,
    Record,
    RunMetrics,
    Temperature,
)

SCHEMA = 1
MAX_REPORT_BYTES = 64 << 20
EXPECTED = "a run folder or its report.json"


class Cpu(Record):
    """The processor.

    `model`: its name. `architecture`: such as x86_64.
    `flags`: instruction sets that decide how fast networks run.
    `cores`: number of cores of the machine. `cores_allowed`: numbers of the cores that the run might use.
    """

    model: str
    architecture: str
    flags: tuple[str, ...]
    cores: int
    cores_allowed: tuple[int, ...]


class GlDriver(Record):
    """The OpenGL driver. `hardware`: false when the CPU draws; `limits`: OpenGL's constants by their names."""

    vendor: str
    renderer: str
    version: str
    hardware: bool
    limits: dict[str, int | tuple[int, ...]]


class MachineFacts(Record):
    """The machine that was measured.

    `system`: operating system and kernel.
    `python`, `trilane`: versions; null for a Trilane that was never installed.
    `hardware_counters`: what was counted during each job, or `absent` and why; null in reports of an older Trilane.
    `memory_bytes`: physical memory.
    `gl`: OpenGL driver, null when there is none.
    `packages`: version of each installed package that Trilane uses.
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


class PaceComparison(Record):
    """A run at the pace of a chip, compared with the same run in virtual time.

    `profile`: hardware profile of the chip. `performance_profile`: performance profile of the chip.
    `slow_motion`: factor by which the run is slower than the chip.
    `stage_ms`: time for which a job of each stage was held.
    `host_slower`: by stage, number of jobs that took the host longer. `late_frames`: numbers of the frames of such
    jobs.
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
    """The file video.mp4. `frames`: number of frames in it; `seconds`: end of the last one."""

    frames: int
    seconds: float


class FrameErrors(Record):
    """The error of frames of this run `against` other pictures, in the region that holds the avatars.

    `psnr_db`, `mae` (steps of 1/255), `ssim`, `flip`: means over the frames; `ssim` null where the picture is too
    small.
    `worst_psnr_db`: PSNR of the worst frame; `p1_psnr_db`: 1st percentile, null in reports of an older Trilane.
    `iou`: mean overlap of the pixels that differ from the background.
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
    """The error of frames of this run against the truth where it is known, else against the float path.

    `frames`: number of frames that were compared; `numbers`: their numbers. `float_path`: error against the float path;
    null where the other figures say it already.
    """

    frames: int
    numbers: tuple[int, ...]
    float_path: FrameErrors | None = None


class Made(Record):
    """How a report came about.

    `at`: time at which the command began, UTC, ISO 8601.
    `command`: command line, word by word.
    `trilane`: version; null for a Trilane that was never installed.
    `revision`: git's revision of the checkout that Trilane ran from, null without one.
    `modified`: whether files of that checkout differed from it; null without one.
    """

    at: str
    command: tuple[str, ...]
    trilane: str | None
    revision: str | None
    modified: bool | None


class UnitPlace(Record):
    """The `cores` of a unit, and its `threads`: one for each core, or one that the kernel runs on any of them."""

    cores: tuple[int, ...]
    threads: int


class OtherPlacement(Record):
    """A placement that was not chosen. `units`: place of each unit; `predicted_ms`: predicted frame time."""

    units: dict[str, UnitPlace]
    predicted_ms: float


class TriedPlacementFacts(Record):
    """A placement that real frames went through. `units`: place of each unit; `frame_ms`: measured frame time."""

    units: dict[str, UnitPlace]
    frame_ms: float


class UnitTime(Record):
    """The measured time of a unit for one frame with `threads` threads, in ms.

    `ms`: duration of its jobs, without the time in which it had no core.
    `core_ms`: CPU time of each thread.
    """

    unit: str
    threads: int
    ms: float
    core_ms: float


class PlacementFacts(Record):
    """Why the units have the cores that they have (`trilane.stages.placing`).

    `how`: tried, measured, asked or rule. `why`: the reason in words.
    `units`: place of each unit.
    `measured_at`: time of the measurement, UTC; absent, as all fields below, when nothing was measured.
    `predicted_ms`: predicted frame time under the run's policy.
    `rule_ms`, `rule`: predicted frame time and places by the rule for any run.
    `alternatives`: next best placements, the shortest frame time first.
    `times`: medians of distinct frames, one job at a time; a row for each unit and number of threads.
    `tried`: placements that real frames went through before this run or an earlier one; absent when none was.
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
    tried: tuple[TriedPlacementFacts, ...] = ()


class TensorSize(Record):
    """One size of a planned tensor.

    `work`: share of the pixels that the network was trained for.
    `most_pixels`: most pixels for one avatar.
    `frames`: number of presented frames of this size.
    `psnr_loss_db`: loss of PSNR by the avatars' validation; null where an avatar has no figures by size.
    """

    work: float
    most_pixels: int
    frames: int
    psnr_loss_db: float | None


class Resolution(Record):
    """How the tensor was stepped down so that frames were in time.

    `sizes`: sizes of the tensor, the largest first.
    `switches`: number of presented frames of another size than the frame before.
    `loss_source`: source of the losses, or why there are none.
    """

    sizes: tuple[TensorSize, ...]
    switches: int
    loss_source: str


class VerdictBound(Record):
    """What bounds the frame time. `unit`: the report's `bottleneck`. `stages`: the stage that bounds, then the unit's
    others with a noticeable part of the critical path. `share`: the unit's share of that path.
    """

    unit: str
    stages: tuple[str, ...]
    share: float


class VerdictFacts(Record):
    """Whether the run holds its rate (`trilane.apps.run.verdict`).

    `passed`: `pass` in the file. `target_fps`: rate that it has to hold, in frames a second.
    `bound`: null without a path. `trusted`: whether its machine let it be measured. `why`: the reasons in one line.
    """

    passed: bool = Field(alias="pass")
    target_fps: float
    bound: VerdictBound | None
    trusted: bool
    why: str


OptionValue = str | int | float | bool | tuple[str, ...] | None


class Preamble(Record):
    """The keys that a report begins with.

    `schema_`: `schema` in the file, 1.
    `clock`: clock of all times.
    `machine`: machine that the run was measured on.
    `config`: the RunConfig as JSON without its folder, with `policy` and `edge`.
    `plan`: sizes that follow from the scene; absent for a pipeline file.
    `caps`: limits on the work of the units.
    """

    schema_: Literal[1] = Field(alias="schema")
    clock: Literal["host", "virtual"]
    machine: MachineFacts
    config: dict[str, Any]
    plan: WorkPlan | None = None
    caps: Caps


class Report(RunMetrics, Preamble):
    """The whole document: the keys of `Preamble`, the other keys of `RunMetrics`, and these.

    `verdict`: whether the run holds its rate, what bounds it, and whether it can be trusted; absent in older reports.
    `made`: time, command line and Trilane of the run; null where a program ran it.
    `options`: every option of the run by its name, as it was asked for; empty where another Trilane left them out.
    `pids`: process of each unit at the end.
    `startup_ms`: time until each unit was ready.
    `stage_metrics`: `figures` in the file: mean of each metric that a stage gave with its jobs.
    `messages`: sentences to a person on what went wrong on the way.
    `interrupted`: whether a signal ended the run.
    `failure`: reason for an early end, else null.
    `baseline`: metrics of a `sequential` run of the same scene, null without one.
    `placement`: reason for the cores of the units; absent for a run by a program.
    `resolution`: sizes of a planned tensor, where frames had to be in time; else absent.
    `pace`: comparison with virtual time of a run at a chip's pace.
    `accuracy`: by avatar, what `trilane.avatars.validation.accuracy_of` says: its figures, or why there are none.
    `check`: error of frames of this run; absent where none was asked for.
    `sources`: key, dotted where it is inside another, to the source of the figures below it; the longest key decides.
    `notes`: format that each opened file was read as, and what was chosen for the run.
    `video`: null when no frame was recorded.
    `checksum`: SHA-256 over the presented pictures, null when none was recorded.
    """

    caps: Caps
    temperature_c: Temperature
    verdict: VerdictFacts | None = None
    made: Made | None = None
    options: dict[str, OptionValue] = Field(default={})
    pids: dict[str, int]
    startup_ms: dict[str, float]
    stage_metrics: dict[str, dict[str, float]] = Field(alias="figures")
    messages: tuple[str, ...]
    interrupted: bool
    failure: str | None
    baseline: PolicyMetrics | None
    placement: PlacementFacts | None = None
    resolution: Resolution | None = None
    pace: PaceComparison | None = None
    accuracy: dict[str, dict[str, Any]] = Field(default={})
    check: Check | None = None
    sources: dict[str, str] = Field(default={})
    notes: tuple[str, ...] = ()
    video: Video | None
    checksum: str | None


def write_report(report: Report, target: Path) -> None:
    """Write `report` as JSON. Raises ValueError for a NaN, an infinity, or a report that could not be read back."""
    document = report.as_json()
    Report.model_validate(document)
    target.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_report(path: Path) -> Report:
    """Read the report in `path`, a file or a run folder. Raises BadInputError naming the first key that is wrong.

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
