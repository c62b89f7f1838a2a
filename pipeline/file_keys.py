"""The keys of a pipeline file, each as one field: its type, its range and its meaning.

Rule: this module checks one value at a time; `pipeline_file.py` checks values that must fit together. The tables of
docs/pipeline-file.md come from the descriptions here. A pipeline file may come from a stranger. Therefore this module
opens no file that it names, and imports no module that it names.
"""

from __future__ import annotations

import math
import posixpath
import re
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from hashlib import blake2b
from typing import Annotated, Any, ClassVar, Final, Literal, Self

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from trilane.errors import did_you_mean
from trilane.options import one_of
from trilane.pipeline.description import FACTORY, LETTERS, LONGEST_NAME
from trilane.scheduler.policy import MOST_FRAMES, PACED_WORDS, POLICIES, POLICY_WORDS
from trilane.transport.slots import EDGE_WORDS, edge_rule
from trilane.unexpected_value import UnexpectedValue
from trilane.units import RUNTIME_WORDS, RUNTIMES, UNITS

MOST_STAGES: Final = 64
MOST_SAMPLES: Final = 1_000_000
MOST_PORT_BYTES: Final = 256 << 20
LONGEST_SIDE: Final = 16_384  # longest side of a picture, in pixels
LONGEST_MS: Final = 3.6e6  # longest time of a job, an hour
ONE_TIME: Final = "mean with or without sd, exponential, samples, or from with or without name"
MOST_SDS: Final = 1000  # largest standard deviation of a time, as a multiple of its mean
NAME: Final = f"^{LETTERS}{{1,{LONGEST_NAME}}}$"
#: The expected form of a text, by its pattern; for messages.
FORMS: Final = {
    NAME: f"at most {LONGEST_NAME} letters from a to z or A to Z, digits, _ and -",
    FACTORY: "MODULE:FACTORY, such as crop:best",
}
#: NumPy's name of each number type that a port may have.
TYPES: Final = {
    "u8": "uint8",
    "i8": "int8",
    "u16": "uint16",
    "i16": "int16",
    "i32": "int32",
    "i64": "int64",
    "f16": "float16",
    "f32": "float32",
    "f64": "float64",
    "bool": "bool",
}


def shown(value: object) -> str:
    """Return a text of at most 80 characters that stands for a wrong value in a message."""
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, list):
        return "a list"
    text = repr(value) if not isinstance(value, bool) else str(value).lower()
    return text if len(text) < 80 else f"{text[:77]}..."


def is_number(value: object) -> bool:
    """Return whether a value of the file is a number; true and false do not count as numbers."""
    return isinstance(value, int | float) and not isinstance(value, bool)


class Keys(BaseModel):
    """Base of all tables: unknown keys and values of another type are errors, and values never change."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    @classmethod
    def known(cls) -> list[str]:
        """Return the names of the table's keys in a file."""
        return [field.alias or name for name, field in cls.model_fields.items()]


def _rule(text: str | None) -> str | None:
    if text is not None:
        edge_rule(text)
    return text


def _as_tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


EdgeRule = Annotated[str, AfterValidator(_rule)]
Rate = Annotated[float, Field(ge=0.001, le=1e6, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Ms = Annotated[float, Field(ge=0, le=LONGEST_MS, allow_inf_nan=False)]


class Arrivals(Keys):
    """When frames arrive. `poisson`: mean rate of arrivals that are independent of each other, in frames a second."""

    poisson: Rate = Field(description="Mean rate in frames a second; arrivals are independent of each other.")


class RunKeys(Keys):
    """The table [run]."""

    fps: Rate | None = Field(default=None, description="Frames a second that the source gives, under every policy.")
    arrivals: Arrivals | None = Field(
        default=None, description="`{ poisson = RATE }` instead of fps: frames come at random moments, for queues."
    )
    policy: Annotated[str, one_of(*POLICIES)] = Field(
        default="pipelined",
        description=f"{POLICY_WORDS}; {PACED_WORDS} need fps or arrivals. If absent, pipelined.",
    )
    edge: EdgeRule | None = Field(
        default=None,
        description=f"Rule of each stream that [edges] does not name: {EDGE_WORDS}. "
        "If absent: double, and fifo:N where branches meet.",
    )
    in_flight: int = Field(
        default=0, ge=0, le=1000, description="Largest number of frames in the pipeline at once; 0: no limit."
    )
    in_queue: int = Field(
        default=0,
        ge=0,
        le=MOST_FRAMES,
        description="How many frames may wait before the first stage, besides the one that its unit holds ready; "
        "further frames are turned away. 0: no limit.",
    )
    latency_to: str = Field(
        default="", description="Stage at whose end the latency ends; if absent, the last stage that no stage reads."
    )
    frames: int | None = Field(default=None, ge=1, le=MOST_FRAMES, description="Frames of a run.")


class UnitKeys(Keys):
    """A unit in the table [units]."""

    hardware: Annotated[str, one_of(*UNITS)] | None = Field(
        default=None, description="Unit of the hardware profile: cpu, gpu or dsp; if absent, the one of the same name."
    )
    cores: Annotated[tuple[Annotated[int, Field(ge=0, le=4095)], ...], BeforeValidator(_as_tuple)] | None = Field(
        default=None, min_length=1, description="Cores of this machine that the unit may use, such as [0, 1]."
    )
    threads: int | None = Field(default=None, ge=1, le=4096, description="Number of threads that the unit may use.")


@dataclass(frozen=True)
class PortType:
    """The type of the data at a port. `dtype`: key of TYPES. `shape`: sizes of the axes."""

    dtype: str
    shape: tuple[int, ...]

    @property
    def payload_bytes(self) -> int:
        return math.prod(self.shape) * (1 if self.dtype == "bool" else int(self.dtype[1:]) // 8)

    def __str__(self) -> str:
        return " ".join([self.dtype, "x".join(map(str, self.shape))]).strip()


def port_type(text: object) -> PortType:
    """Return the type that a text such as `u8 256x256x3` states. Raises UnexpectedValue for another text."""
    expected = f"a type and sizes, such as 'u8 256x256x3', of at most {MOST_PORT_BYTES >> 20} MiB"
    found = re.fullmatch(r"(\w+) (\d{1,9}(?:x\d{1,9}){0,7})", text) if isinstance(text, str) else None
    if found is None:
        raise UnexpectedValue(shown(text), expected)
    if found[1] not in TYPES:
        raise UnexpectedValue(f"type {found[1]!r}", f"one of {', '.join(TYPES)}", did_you_mean(found[1], TYPES))
    port = PortType(found[1], tuple(map(int, found[2].split("x"))))
    if not 0 < port.payload_bytes <= MOST_PORT_BYTES:
        raise UnexpectedValue(f"{text!r}, {port.payload_bytes} bytes", expected, "write smaller parts, or fewer")
    return port


def _ports(value: object) -> object:
    """Return the type of each port in a value of the key `out`, by name; a single port has an empty name."""
    if not isinstance(value, dict):
        return {"": port_type(value)}
    if not value:
        raise UnexpectedValue("an empty table", "a port, such as { boxes = 'f32 32x5' }")
    for name in value:
        if not re.fullmatch(NAME, name):
            raise UnexpectedValue(f"port {name!r}", FORMS[NAME])
    return {name: port_type(each) for name, each in value.items()}


@dataclass(frozen=True)
class PortInput:
    """The input of one port of a stage.

    `port`: name of the reading port; empty if the reading stage has one port.
    `stage`: name of the stage that is read.
    `from_port`: port of `stage` that is read; empty if `stage` has one port.
    `latest`: whether the port takes the newest frame instead of the frame of the other inputs.
    `max_age_ms`: longest age in ms at which the newest frame is taken; an older frame counts as absent. 0: any age.
    """

    port: str
    stage: str
    from_port: str = ""
    latest: bool = False
    max_age_ms: float = 0.0


class InputKeys(Keys):
    """An input that is written as a table."""

    source: str = Field(alias="from", description="Stage, or stage.port, that the input reads.")
    sync: Literal["frame", "latest"] = Field(
        default="frame",
        description="frame: the same frame as the other inputs; latest: the newest frame that there is. "
        "If absent, frame.",
    )
    max_age_ms: float | None = Field(
        default=None,
        gt=0,
        le=LONGEST_MS,
        allow_inf_nan=False,
        description="If the newest frame is older than this, there is no frame; only with sync = 'latest'.",
    )

    @model_validator(mode="after")
    def _age_of_latest(self) -> Self:
        if self.max_age_ms is not None and self.sync != "latest":
            raise UnexpectedValue("max_age_ms beside sync = 'frame'", "sync = 'latest'", "add it, or leave the age out")
        return self


def read_input(port: str, value: object) -> PortInput:
    """Return one input from its value in the file.

    `port`: name of the reading port; empty if the stage has one port.
    `value`: a text, or a table with the keys of InputKeys.

    Raises UnexpectedValue or pydantic's ValidationError.
    """
    if not isinstance(value, dict | str):
        expected = "a stage, stage.port, or a table { from, sync, max_age_ms }"
        raise UnexpectedValue(shown(value), expected, 'such as in = "camera"')
    keys = InputKeys.model_validate({"from": value} if isinstance(value, str) else value)
    stage, dot, from_port = keys.source.partition(".")
    if not stage or (dot and not from_port):
        raise UnexpectedValue(repr(keys.source), "a stage, or stage.port", "write both names, or the stage alone")
    return PortInput(port, stage, from_port, keys.sync == "latest", keys.max_age_ms or 0.0)


def _inside(text: str) -> str:
    """Return the path `text`. Raise UnexpectedValue if it leads out of the folder of the pipeline file."""
    normal = posixpath.normpath(text)
    if not text or "\0" in text or "\\" in text or normal in (".", "..") or normal.startswith(("/", "../")):
        remedy = "copy the file there, or put a link to it there"
        raise UnexpectedValue(repr(text), "a path inside the folder of the pipeline file", remedy)
    return text


def _mp4(text: str) -> str:
    """Return `text`, which must end with .mp4. With another name, a run could replace code or a network."""
    if not text.endswith(".mp4"):
        raise UnexpectedValue(repr(text), "a video to write, such as out.mp4", "let the name end with .mp4")
    return text


InsidePath = Annotated[str, Field(max_length=1000), AfterValidator(_inside)]


class StageTime(Keys):
    """The time of one job of a stage, in ms: one of `mean`, `exponential`, `samples` and `source`.

    `sd` belongs to `mean`, and `name` to `source`. `pipeline_file.py` replaces `source` by the times in the file.
    """

    mean: Ms | None = Field(default=None, description="Mean time, ms.")
    sd: Ms = Field(default=0.0, description="Standard deviation, ms, with the key mean; times are lognormal.")
    exponential: Ms | None = Field(default=None, description="Mean of exponential times, ms.")
    samples: Annotated[tuple[Ms, ...], BeforeValidator(_as_tuple)] = Field(
        default=(), description="Measured times, ms; each frame draws one of them."
    )
    source: InsidePath | None = Field(
        default=None, alias="from", description="File of another tool with the times, in this folder."
    )
    name: str | None = Field(
        default=None,
        min_length=1,
        max_length=300,
        description="Name of the measurement in the file, as `trilane times` shows it; if absent, the only run.",
    )

    @model_validator(mode="before")
    @classmethod
    def _as_table(cls, value: Any) -> Any:
        if is_number(value):
            return {"mean": value}
        if not isinstance(value, dict):
            raise UnexpectedValue(shown(value), f"a time in ms, or a table of {ONE_TIME}")
        samples = value.get("samples", ())
        if isinstance(samples, list) and not 1 <= len(samples) <= MOST_SAMPLES:
            raise UnexpectedValue(f"{len(samples)} samples", f"1 to {MOST_SAMPLES}")
        return value

    @model_validator(mode="after")
    def _one_of_four(self) -> Self:
        given = [self.mean is not None, self.exponential is not None, bool(self.samples), self.source is not None]
        if sum(given) != 1 or (self.sd and self.mean is None) or (self.name and self.source is None):
            fields = type(self).model_fields.items()
            found = ", ".join(field.alias or name for name, field in fields if name in self.model_fields_set)
            raise UnexpectedValue(found or "no key", ONE_TIME)
        if self.sd and not self.mean:
            raise UnexpectedValue("sd beside mean = 0", "a mean above 0")
        if self.mean is not None and self.sd > MOST_SDS * self.mean:
            found = f"sd = {self.sd:g} beside mean = {self.mean:g}"
            raise UnexpectedValue(found, f"at most {MOST_SDS:,} times the mean")
        return self

    @property
    def mean_ms(self) -> float:
        """The mean of the times in ms."""
        if self.samples:
            return math.fsum(self.samples) / len(self.samples)
        return (self.mean if self.exponential is None else self.exponential) or 0.0

    def times(self, factor: float) -> StageTime:
        """Return times that are `factor` times as long."""
        if self.samples:
            return StageTime(samples=tuple(each * factor for each in self.samples))
        if self.exponential is not None:
            return StageTime(exponential=self.exponential * factor)
        return StageTime(mean=self.mean_ms * factor, sd=self.sd * factor)

    @property
    def varies(self) -> bool:
        """Whether the jobs may have different times."""
        return bool(self.sd or self.exponential or len(set(self.samples)) > 1)


def _pattern(text: str | None) -> str | None:
    if text is not None and not re.fullmatch(rf"[01]{{1,{MOST_SAMPLES}}}", text):
        raise UnexpectedValue(shown(text), "a text of 0 and 1, such as '0011'")
    return text


class BypassKeys(Keys):
    """The table `bypass` of a stage: a frame for which the next stages have no work skips them, up to stage `to`."""

    to: str = Field(
        pattern=NAME, description="Stage to which such a frame goes, two places or more behind in the row of stages."
    )
    share: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Share of the frames that go this way, at random, in a prediction and after `busy`.",
    )
    pattern: Annotated[str | None, AfterValidator(_pattern)] = Field(
        default=None,
        description="In place of share: 1 for each frame that goes this way, 0 for each other, from the first frame "
        "on; '0011' starts over after four.",
    )

    @model_validator(mode="before")
    @classmethod
    def _as_table(cls, value: Any) -> Any:
        if not isinstance(value, dict | str):
            raise UnexpectedValue(shown(value), "a stage, or a table { to, share } or { to, pattern }")
        return {"to": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        if self.share is not None and self.pattern is not None:
            raise UnexpectedValue("share and pattern", "one of them")
        return self

    @property
    def taken(self) -> Fraction | None:
        """The share of the frames that take the bypass, 0 to 1; None if the file does not state it."""
        if self.pattern is not None:
            return Fraction(self.pattern.count("1"), len(self.pattern))
        return None if self.share is None else Fraction(str(self.share))

    def takes(self, frame: int, seed: int = 0) -> bool:
        """Return whether frame number `frame` takes the bypass. `seed`: seed of the random choice by `share`."""
        if self.pattern is not None:
            return self.pattern[frame % len(self.pattern)] == "1"
        drawn = blake2b(f"{seed} {frame}".encode(), digest_size=8).digest()
        return int.from_bytes(drawn) < (self.share or 0.0) * (1 << 64)


def _size(text: object) -> object:
    """Return (width, height) in pixels from a text such as `640x480`; another value stays as it is."""
    if not isinstance(text, str):
        return text
    found = re.fullmatch(r"(\d{1,9})x(\d{1,9})", text)
    if found is None:
        raise UnexpectedValue(repr(text), "WIDTHxHEIGHT in pixels, such as 640x480")
    sides = int(found[1]), int(found[2])
    if not 1 <= min(sides) <= max(sides) <= LONGEST_SIDE:
        raise UnexpectedValue(repr(text), f"sides of 1 to {LONGEST_SIDE} pixels")
    return sides


Size = Annotated[tuple[int, int], BeforeValidator(_size)]
SIZE_HELP = "Width and height in pixels, such as '640x480'"


def _sizes(value: object) -> object:
    """Return the sizes of the axes, as a tuple, from a text such as `1x3x224x224`."""
    found = re.fullmatch(r"\d{1,7}(x\d{1,7}){0,7}", value) if isinstance(value, str) else None
    if found is None or 0 in (sizes := tuple(map(int, found[0].split("x")))):
        raise UnexpectedValue(shown(value), "sizes, such as '1x3x224x224'")
    return sizes


class StageKeys(Keys):
    """The keys that every stage may have.

    `kind`: key that says what kind of stage it is.
    `in_ports`: ports that it can read, and whether it needs each; None if the file does not say so.
    `out_ports`: names of the ports that it writes; None if the file does not say so.
    """

    kind: ClassVar[str]
    in_ports: ClassVar[Mapping[str, bool] | None] = None

    unit: str = Field(pattern=NAME, description="Unit that runs the stage; a name of your choice.")
    inputs: tuple[PortInput, ...] = Field(
        default=(), alias="in", description="Inputs of the stage: a stage, stage.port, or a table of ports."
    )
    every: int = Field(
        default=1, ge=1, le=1000, description="3: the stage takes the first frame, the fourth, and so on."
    )
    out: Annotated[dict[str, PortType] | None, BeforeValidator(_ports)] = Field(
        default=None,
        description="Output of the stage: a type and sizes, such as 'u8 256x256x3', or a table of ports.",
    )
    bypass: BypassKeys | None = Field(
        default=None,
        description="Way of a frame for which the stages behind have nothing to do: a stage, or a table of to and "
        "share or pattern.",
    )
    stateful: bool = Field(
        default=False, description="Whether the stage remembers frames; if so, it gets the frames in order."
    )
    scale: dict[str, Annotated[float, Field(gt=0, le=1e4, allow_inf_nan=False)]] = Field(
        default={}, description="How many times longer a job takes on a chip than here: { snapdragon-888 = 2.1 }."
    )
    time_ms: StageTime | None = Field(
        default=None,
        description="Time of a job in ms: a number, or a table of mean and sd, exponential, samples, or from and name.",
    )

    @property
    def named_kind(self) -> str:
        """The kind as `trilane check` shows it; for a block, the block's name."""
        return self.kind

    @property
    def own_time(self) -> StageTime | None:
        """The time of a job that the file states; None if it states none."""
        return self.time_ms

    @property
    def out_ports(self) -> tuple[str, ...] | None:
        return None if self.out is None else tuple(self.out)


class TimedStage(StageKeys):
    """A stage that has a set time and nothing to run."""

    kind = "time_ms"


class OnnxStage(StageKeys):
    """A network."""

    kind = "onnx"
    onnx: InsidePath = Field(description="ONNX file of the network, in this folder.")
    precision: Annotated[str, one_of("int8", "fp16", "fp32")] | None = Field(
        default=None, description="int8, fp16 or fp32 on a chip; if absent, the network and its unit decide."
    )
    runtime: Annotated[str, one_of(*RUNTIMES)] = Field(
        default="ort", description=f"Runtime of the network on this machine: {RUNTIME_WORDS}; if absent, ort."
    )
    shapes: dict[str, Annotated[tuple[int, ...], BeforeValidator(_sizes)]] = Field(
        default={}, description="Sizes of inputs that the file leaves open: `{ image = '1x3x224x224' }`."
    )


class PythonStage(StageKeys):
    """Own code."""

    kind = "python"
    python: str = Field(pattern=FACTORY, description="`module:factory`, a module in this folder or an installed one.")
    settings: dict[str, Any] = Field(default={}, description="Argument with which the factory is called.")


class BlockStage(StageKeys):
    """A built-in block."""

    kind = "block"
    writes_one: ClassVar[bool] = False  # whether it writes a picture or a tensor, on a port without a name
    block: str = Field(description="Built-in stage: video, prepare, overlay, encode, discard or busy.")

    @property
    def named_kind(self) -> str:
        return self.block

    @property
    def out_ports(self) -> tuple[str, ...] | None:
        return ("",) if self.writes_one and self.out is None else super().out_ports


class VideoBlock(BlockStage):
    """Reads a video, a camera or a folder of pictures."""

    writes_one = True
    in_ports = {}
    path: InsidePath = Field(description="A video, a folder of pictures, or the number of a camera.")
    size: Size = Field(description=f"{SIZE_HELP}; pictures are scaled to this size.")

    @property
    def is_camera(self) -> bool:
        return self.path.isdecimal()


class PrepareBlock(BlockStage):
    """Turns a picture into the input that a network expects."""

    writes_one = True
    in_ports = {"": True}
    like: str = Field(pattern=NAME, description="Stage of the network for whose input the picture is prepared.")
    port: str = Field(default="", description="Input of that network, if it has several.")
    fit: Literal["stretch", "letterbox", "crop"] = Field(
        default="stretch",
        description="How a picture gets another shape: stretch, letterbox or crop; if absent, stretch.",
    )
    layout: Literal["nchw", "nhwc"] | None = Field(
        default=None, description="nchw or nhwc; if absent, the layout of the network's input."
    )
    mean: Annotated[tuple[Finite, ...], BeforeValidator(_as_tuple)] | None = Field(
        default=None, description="Mean of each channel, which is subtracted; values are from 0 to 1."
    )
    sd: Annotated[tuple[Annotated[Finite, Field(gt=0)], ...], BeforeValidator(_as_tuple)] | None = Field(
        default=None, description="Standard deviation of each channel, by which the channel is divided."
    )
    step: float | None = Field(
        default=None, gt=0, allow_inf_nan=False, description="Step of quantised numbers (their scale)."
    )
    zero_point: int | None = Field(default=None, description="Quantised number that stands for 0.")


class OverlayBlock(BlockStage):
    """Draws the outputs of networks on a picture."""

    writes_one = True
    in_ports = {"frame": True, "mask": False, "depth": False, "boxes": False}
    alpha: float = Field(default=0.5, ge=0, le=1, description="Opacity of the drawing, 0 to 1; if absent, 0.5.")


class EncodeBlock(BlockStage):
    """Writes a video."""

    in_ports = {"": True}
    path: Annotated[InsidePath, AfterValidator(_mp4)] = Field(description="Video to write, such as out.mp4.")


class DiscardBlock(BlockStage):
    """Takes frames and does nothing with them, which takes no time."""

    @property
    def own_time(self) -> StageTime | None:
        return self.time_ms or StageTime(mean=0.0)


class BusyBlock(BlockStage):
    """An artificial load."""

    load_ms: Ms = Field(description="How long a job works, ms.")

    @property
    def own_time(self) -> StageTime | None:
        return self.time_ms or StageTime(mean=self.load_ms)


BLOCKS: Final[dict[str, type[BlockStage]]] = {
    "video": VideoBlock,
    "prepare": PrepareBlock,
    "overlay": OverlayBlock,
    "encode": EncodeBlock,
    "discard": DiscardBlock,
    "busy": BusyBlock,
}
#: Blocks that write no stream.
ENDS: Final = frozenset(["encode", "discard"])
KINDS: Final[dict[str, type[StageKeys]]] = {
    each.kind: each for each in (OnnxStage, PythonStage, BlockStage, TimedStage)
}
