"""report.json as typed records: the same classes write the file and read it.

Rule: fields stand in the order of the file's keys. A report states the speed of a run together with its machine and the
image error of its avatars.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, ValidationError, field_validator, model_validator
from pydantic_core import from_json

from trilane.arrays import Shape
from trilane.errors import BadInputError
from trilane.files import require_file
from trilane.pipeline.description import Model
from trilane.pipeline.run_metrics import Caps, PolicyMetrics, Record, RunMetrics, Temperature
from trilane.units import NO_FIGURES, TARGET_FPS

SCHEMA = 1
MAX_REPORT_BYTES = 64 << 20
REPORT_FILE = "report.json"
EXPECTED = f"a run folder or its {REPORT_FILE}"


class Cpu(Record):
    """The processor.

    `model`: name of the processor. `architecture`: instruction set architecture, such as x86_64.
    `flags`: flags of present instruction sets that matter for the speed of networks.
    `cores`: number of cores of the machine. `cores_allowed`: numbers of the cores that the run could use.
    """

    model: str
    architecture: str
    flags: tuple[str, ...]
    cores: int
    cores_allowed: tuple[int, ...]


class GlDriver(Record):
    """The OpenGL driver.

    `vendor`, `renderer`, `version`: texts by which the driver names itself.
    `hardware`: whether a GPU draws; false for a driver that draws on the CPU.
    `limits`: values of OpenGL's limits, by the name of the constant.
    """

    vendor: str
    renderer: str
    version: str
    hardware: bool
    limits: dict[str, int | tuple[int, ...]]


class MachineFacts(Record):
    """The machine that was measured.

    `system`: operating system and kernel.
    `python`, `trilane`: versions of Python and Trilane; `trilane` is null if Trilane is not installed as a package.
    `cpu`: processor.
    `hardware_counters`: hardware counters that were read for each job, or `absent` and the reason; null in older
    reports.
    `memory_bytes`: size of the physical memory.
    `gl`: OpenGL driver; null for a machine without such a driver.
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
    """The tensor shapes that a run may use. `tensor_shapes`: (height, width) of each shape, in pixels."""

    tensor_shapes: tuple[Shape, ...]


class PaceComparison(Record):
    """A run at the pace of a chip, compared with the same run in virtual time.

    `profile`: hardware profile of the chip. `performance_profile`: performance profile of the chip.
    `slow_motion`: factor by which the run is slower than the chip.
    `stage_ms`: time in ms to which a job was stretched, by stage.
    `host_slower`: number of jobs that took longer on this machine than `stage_ms`, by stage.
    `late_frames`: numbers of the frames of these jobs.
    `virtual_ms`: median frame time in virtual time; null if fewer than two frames are presented.
    `measured_ms`: median frame time of the run, without late frames and frames near them; null if no frame is left.
    `compared_share`: share of the frames that `measured_ms` counts.
    `ratio`: `measured_ms` / `virtual_ms`; null if either is null.
    """

    profile: str
    performance_profile: str
    slow_motion: float
    stage_ms: dict[str, float]
    host_slower: dict[str, int]
    late_frames: tuple[int, ...]
    virtual_ms: float | None
    measured_ms: float | None
    compared_share: float
    ratio: float | None


class Video(Record):
    """The file video.mp4. `frames`: number of its frames. `seconds`: time at which the last frame ends."""

    frames: int
    seconds: float


class FrameErrors(Record):
    """The image error of a run's frames against reference pictures, in the region that contains the avatars.

    `against`: reference pictures, in words.
    `psnr_db`, `mae` (steps of 1/255), `ssim`, `flip`: means over the frames; `ssim` is null if the region is too small.
    `worst_psnr_db`: PSNR of the worst frame. `p1_psnr_db`: 1st percentile of the PSNR; null in older reports.
    `iou`: mean IoU (intersection over union) of the pixels that differ from the background.
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
    """The image error of a run's frames against the truth, or against the float path if the truth is unknown.

    `frames`: number of compared frames. `numbers`: numbers of these frames.
    `float_path`: image error against the float path; null if the other figures are already against the float path.
    """

    frames: int
    numbers: tuple[int, ...]
    float_path: FrameErrors | None = None


class Made(Record):
    """The command that made a report, and the version of Trilane that the command ran.

    `at`: time just before the run, UTC, ISO 8601.
    `command`: words of the command line.
    `trilane`: version of Trilane; null if Trilane is not installed as a package.
    `revision`: revision of the git checkout that Trilane ran from; null outside of a checkout.
    `modified`: whether tracked files of that checkout were modified; null outside of a checkout.
    """

    at: str
    command: tuple[str, ...]
    trilane: str | None
    revision: str | None
    modified: bool | None


class UnitPlace(Record):
    """The cores and threads of a unit.

    `cores`: numbers of the unit's cores.
    `threads`: number of the unit's threads: one for each core, or a single thread that may run on any of the cores.
    """

    cores: tuple[int, ...]
    threads: int


class OtherPlacement(Record):
    """A placement that was not chosen.

    `units`: place of each unit, by name. `predicted_ms`: predicted frame time, ms.
    """

    units: dict[str, UnitPlace]
    predicted_ms: float


class TriedPlacementFacts(Record):
    """A placement that was tried with real frames.

    `units`: place of each unit, by name. `frame_ms`: measured frame time, ms.
    """

    units: dict[str, UnitPlace]
    frame_ms: float


class UnitTime(Record):
    """The measured time of a unit for one frame.

    `unit`: name of the unit. `threads`: number of the unit's threads in this measurement.
    `ms`: time of the unit's jobs for a frame, without the time in which the unit had no core.
    `core_ms`: CPU time of the jobs, divided by `threads`, ms; at most `ms`.
    """

    unit: str
    threads: int
    ms: float
    core_ms: float


class PlacementFacts(Record):
    """The placement of the units, and how it was chosen (`trilane.stages.placing`).

    `how`: what decided: `tried` (a trial with real frames), `measured` (predictions from measured times), `asked` (the
    user) or `rule` (the rule that needs no measurement).
    `why`: reason in words.
    `units`: place of each unit, by name.
    `measured_at`: time of the measurement, UTC. This field and all fields below are absent if nothing was measured.
    `predicted_ms`: predicted frame time under the run's policy.
    `rule`, `rule_ms`: placement by the rule that needs no measurement, and its predicted frame time.
    `alternatives`: next best placements, the shortest predicted frame time first.
    `times`: a row for each unit and number of threads; medians over distinct frames, with one job at a time.
    `tried`: placements that were tried with real frames, before this run or an earlier run; absent without a trial.
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

    `work`: number of the tensor's pixels, divided by the number that the network was trained for.
    `most_pixels`: largest number of pixels for one avatar.
    `frames`: number of presented frames with this size.
    `psnr_loss_db`: largest loss of PSNR among the avatars, from their validation; null if an avatar has no figures for
    this size.
    """

    work: float
    most_pixels: int
    frames: int
    psnr_loss_db: float | None


class Resolution(Record):
    """The sizes of the planned tensor, which gets smaller if frames would be late.

    `sizes`: sizes of the tensor, the largest first.
    `switches`: number of presented frames whose size differs from the previous frame's.
    `loss_source`: source of the losses, or why there are none.
    """

    sizes: tuple[TensorSize, ...]
    switches: int
    loss_source: str


class VerdictBound(Record):
    """The bound of the frame time.

    `unit`: unit that bounds the frame time, or another cause, such as `other programs`.
    `share`: share of this unit in the critical path.
    `stages`: name of the stage that bounds, followed by the unit's other stages with a noticeable share of the path.
    """

    unit: str
    stages: tuple[str, ...]
    share: float


class VerdictFacts(Record):
    """The verdict of the run (`trilane.apps.run.verdict`).

    `passed`: whether the run passes; `pass` in the file. `target_fps`: rate that the run must hold, in frames a second.
    `bound`: bound of the frame time; null if unknown. `trusted`: whether the times can be trusted.
    `why`: reasons in one line.
    """

    passed: bool = Field(alias="pass")
    target_fps: float
    bound: VerdictBound | None
    trusted: bool
    why: str


OptionValue = str | int | float | bool | tuple[str, ...] | None


class _Part(Model, extra="allow", strict=True, allow_inf_nan=False):
    """Base class of the parts of a report that are checked, but stay as they are in the file."""


class _Avatar(_Part):
    bundle: str


class _Output(_Part):
    width: int = Field(default=1, ge=1)
    height: int = Field(default=1, ge=1)


class _Scene(_Part):
    """The keys of a scene that a verdict and the dashboard read."""

    name: str
    fps: float = Field(default=TARGET_FPS, gt=0)
    output: _Output | None = None
    avatars: list[_Avatar] = Field(default=[])


class _WorstView(_Part):
    psnr_db: float | None = None


class _Accuracy(_Part):
    """The keys of an avatar's accuracy that a verdict reads."""

    source: str = NO_FIGURES
    psnr_db: float | None = None
    psnr_db_by_band: dict[str, float] = Field(default={})
    worst: _WorstView | None = None

    @model_validator(mode="after")
    def _has_a_figure(self) -> Self:
        if self.source != NO_FIGURES and self.psnr_db is None and not self.psnr_db_by_band:
            raise ValueError(f"no psnr_db and no psnr_db_by_band, although its source is {self.source!r}")
        return self


class _WrongPartError(ValueError):
    """A wrong value inside a part. `key`: path to the value. `found`: sentence part."""

    def __init__(self, key: tuple[str | int, ...], found: str) -> None:
        super().__init__(f"{'.'.join(map(str, key))}: {found}")
        self.key, self.found = key, found


def _refuse_other(part: type[_Part], key: str, value: Any) -> None:
    """Raise _WrongPartError if `value`, which stands at `key`, does not have the form of `part`."""
    if not isinstance(value, dict):
        raise _WrongPartError((key,), "no table of keys and values")
    try:
        part.model_validate(value)
    except ValidationError as error:
        first = error.errors()[0]
        raise _WrongPartError((key, *first["loc"]), _found(first)) from None


def _found(details: Mapping[str, Any]) -> str:
    """Return what is wrong with a value, in words. `details`: one of the `errors()` of a pydantic ValidationError."""
    cause = details.get("ctx", {}).get("error")
    return cause.found if isinstance(cause, _WrongPartError) else str(cause or details["msg"].lower())


class Preamble(Record):
    """The first keys of a report.

    `schema_`: version of the format, 1; `schema` in the file.
    `clock`: clock of all times.
    `machine`: machine on which the run was measured.
    `config`: RunConfig of a scene's run, without folders, or tables of a pipeline file; also `policy` and `edge`.
    `plan`: tensor shapes that follow from the scene; absent for a pipeline file.
    `caps`: limits on the work of the units.
    """

    schema_: Literal[1] = Field(alias="schema")
    clock: Literal["host", "virtual"]
    machine: MachineFacts
    config: dict[str, Any]
    plan: WorkPlan | None = None
    caps: Caps

    @field_validator("config")
    @classmethod
    def _has_what_is_read(cls, config: dict[str, Any]) -> dict[str, Any]:
        if "pipeline" not in config:
            _refuse_other(_Scene, "scene", config.get("scene"))
        return config


class Report(RunMetrics, Preamble):
    """The whole document: the keys of `Preamble`, the other keys of `RunMetrics`, and the following keys.

    `temperature_c`: temperatures in °C.
    `verdict`: whether the run holds its rate, what bounds it, and whether its times can be trusted; absent in older
    reports.
    `made`: time and command line of the run, and version of Trilane; null for a run without a command line.
    `options`: value of every option of the run, by name; empty in older reports.
    `pids`: process number of each unit at the end of the run, by unit.
    `startup_ms`: time until the unit was ready, by unit.
    `stage_metrics`: mean of each metric over a stage's jobs, by stage and metric; `figures` in the file.
    `messages`: sentences for a person about faults during the run.
    `interrupted`: whether a signal ended the run.
    `failure`: reason for an early end; null for a run that did not fail.
    `baseline`: metrics of a `sequential` run of the same scene; null without such a run.
    `placement`: cores of the units and the reason for them; absent if the units were not placed for this run.
    `resolution`: sizes of a planned tensor; absent if the run does not reduce the tensor to have frames in time.
    `pace`: comparison with virtual time; absent for a run that does not keep a chip's pace.
    `accuracy`: figures of each avatar's validation, or why there are none, by avatar; the result of
    `trilane.avatars.validation.accuracy_of`.
    `check`: image error of frames of this run; absent without a check.
    `sources`: source of figures, by dotted key. A key also covers all keys below it, unless a longer key matches.
    `notes`: format of each file that was read, and choices that were made for the run.
    `video`: facts about video.mp4; null if no frame was recorded.
    `checksum`: SHA-256 over the presented pictures' numbers and digests; null if some or all were not recorded.
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

    @field_validator("accuracy")
    @classmethod
    def _has_figures(cls, accuracy: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        for avatar, facts in accuracy.items():
            _refuse_other(_Accuracy, avatar, facts)
        return accuracy


def write_report(report: Report, target: Path) -> None:
    """Write `report` as JSON to the file `target`.

    Raises ValueError for a NaN, an infinity, or a report that could not be read back.
    """
    document = report.as_json()
    Report.model_validate(document)
    target.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_report(path: Path) -> Report:
    """Return the report at `path`, which is report.json or a run folder.

    Raises BadInputError for a file that cannot be read, that has a wrong key, or that a newer Trilane wrote.
    """
    file = path / REPORT_FILE if path.is_dir() else path
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
        cause = first.get("ctx", {}).get("error")
        inside = cause.key if isinstance(cause, _WrongPartError) else ()
        key = ".".join(map(str, (*first["loc"], *inside))) or "the document"
        raise BadInputError(f"{file}: {key}", _found(first), EXPECTED) from None
    except ValueError as error:
        raise BadInputError(f"{file}: the document", str(error), EXPECTED) from None


def _refuse_newer(file: Path, document: Any) -> None:
    schema = document.get("schema") if isinstance(document, dict) else None
    if isinstance(schema, int) and schema > SCHEMA:
        raise BadInputError(f"{file}: schema", str(schema), f"{SCHEMA}", "a newer Trilane wrote it: update this one")
