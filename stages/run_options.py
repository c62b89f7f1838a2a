"""The options of a run, each as one field: its help text, default, range, unit and words.

The command line, `trilane.run`, sweeps, the dashboard's controls and the report read their options from the fields.
Rule: no other list of the options exists. A field is plain data; `configure` finds out whether a file exists.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from types import NoneType, UnionType
from typing import Annotated, Any, Final, Self, Union, get_args, get_origin

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from trilane.errors import BadInputError, did_you_mean
from trilane.scheduler.policy import POLICIES
from trilane.transport.slots import RULES, edge_rule
from trilane.unexpected_value import UnexpectedValue, unexpected_in
from trilane.units import PERFORMANCE_PROFILES

AVATARS_HELP: Final = "`default`, `hiker`, or the folder of an avatar."
PROFILE_HELP: Final = "Hardware profile: a name or a TOML file."
RUNTIME_HELP: Final = "auto, ort, openvino, qnn or cuda; auto is the fastest that is installed."
SIZE_HELP: Final = "Tensor size in pixels: HEIGHTxWIDTH, or a side S for areas up to SxS."
WIDTH_HELP: Final = "Width of the network: 64 is full, every channel count scales with it."

#: Word for None on the dashboard.
NOTHING: Final = "none"
#: Word for the calibration of the network in the avatar's own file.
AS_IT_IS: Final = "as-it-is"
#: Methods of `trilane.training.quantising.calibration`, repeated here because that module takes long to import.
METHODS: Final = ("minmax", "percentile", "entropy")
#: Calibration method of an untrained network that none was asked for, and number of views where none is given.
METHOD, VIEWS = "minmax", 5
MOST_VIEWS: Final = 1000
#: Numbers of channels that the packed pass draws (`stages/gpu/packed_pass.py`).
CHANNELS: Final = (4, 8, 12, 16)


@dataclass(frozen=True)
class Option:
    """Facts about an option that its field's type does not state.

    `spelling`: option on the command line where it is not the field's name, such as `--latch`.
    `is_argument`: whether the command line takes it without a name.
    `unit`: unit of a number, as a plural noun.
    `words`: all words that it may be; any text where empty.
    `offered`: words that the dashboard's control offers beside what it finds here; None where the dashboard has no
    control.
    """

    spelling: str = ""
    is_argument: bool = False
    unit: str = ""
    words: tuple[str, ...] = ()
    offered: tuple[str, ...] | None = None


def option_of(field: FieldInfo) -> Option:
    """Return the field's `Option`; an empty one where it has none."""
    return next((each for each in field.metadata if isinstance(each, Option)), Option())


def kind_of(field: FieldInfo) -> Any:
    """Return the field's type without None, limits and elements: str, int, float, bool, Path or tuple."""
    kind: Any = field.annotation
    while get_origin(kind) in (Annotated, Union, UnionType):
        kind = next(each for each in get_args(kind) if each is not NoneType)
    return get_origin(kind) or kind


def limits_of(field: FieldInfo) -> tuple[float | None, float | None]:
    """Return the least and the largest number that the field may be; None where there is no limit."""
    least, most = (
        next((getattr(one, key) for one in field.metadata if hasattr(one, key)), None) for key in ("ge", "le")
    )
    return least, most


def calibration_of(text: str) -> tuple[str, int] | None:
    """Parse `text`, METHOD or METHOD:VIEWS, into method and number of views; None for `AS_IT_IS`.

    Raises UnexpectedValue.
    """
    method, colon, views = text.partition(":")
    if text == AS_IT_IS:
        return None
    if method not in METHODS:
        known = (AS_IT_IS, *METHODS)
        raise UnexpectedValue(repr(text), f"one of {', '.join(known)}", did_you_mean(method, known))
    if colon and not (views.isdecimal() and len(views) < 5 and 1 <= int(views) <= MOST_VIEWS):
        raise UnexpectedValue(repr(text), f"{method} or {method}:VIEWS, VIEWS from 1 to {MOST_VIEWS}")
    return method, int(views) if colon else VIEWS


def _text(value: object) -> object:
    """Turn paths and whole numbers (sizes), which programs may give, into text."""
    return str(value) if isinstance(value, PurePath) or type(value) is int else value


def _texts(value: object) -> object:
    return tuple(value) if isinstance(value, Sequence) and not isinstance(value, str) else value


def _cores(value: object) -> object:
    """Accept {"dsp": [0, 1]}, which programs give."""
    if not isinstance(value, Mapping):
        return _texts(value)
    return tuple(f"{unit}={','.join(map(str, own))}" for unit, own in value.items())


def _folder(value: object) -> object:
    """Refuse an empty name, which Path would turn into the working directory."""
    if isinstance(value, str) and not value.strip():
        raise UnexpectedValue(repr(value), "the name of a folder")
    return Path(value) if isinstance(value, str) else value


def _known_channels(channels: int | None) -> int | None:
    if channels is not None and channels not in CHANNELS:
        raise UnexpectedValue(repr(channels), "4, 8, 12 or 16")
    return channels


def _known_calibration(text: str | None) -> str | None:
    if text is not None:
        calibration_of(text)
    return text


def _known_edge(text: str) -> str:
    try:
        edge_rule(text)
    except UnexpectedValue as error:
        name = text.partition(":")[0]
        remedy = "" if name in RULES else did_you_mean(name, RULES)
        raise UnexpectedValue(repr(text), error.expected, remedy) from None
    return text


def _one_of(*words: str) -> AfterValidator:
    def known(word: str | None) -> str | None:
        if word is not None and word not in words:
            raise UnexpectedValue(repr(word), f"one of {', '.join(words)}", did_you_mean(word, words))
        return word

    return AfterValidator(known)


Text = Annotated[str, BeforeValidator(_text)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class RunOptions(BaseModel):
    """The options of `trilane run`, in the order of its help; None leaves what the scene or the avatar says."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    scene: Annotated[Text, Option(is_argument=True)] = Field(
        default="default", description="A scene file (TOML), or the name of one that comes with Trilane."
    )
    motion: Text | None = Field(default=None, description="Motion: .bvh, .npz, .npy, .pkl, or builtin:NAME.")
    camera: Text | None = Field(default=None, description="ARKit log, TUM, transforms.json, or builtin:NAME.")
    background: Text | None = Field(default=None, description="room, or a video, image folder or picture.")
    avatar: Annotated[Text | None, Option(offered=())] = Field(default=None, description=AVATARS_HELP)
    width: int | None = Field(
        default=None, ge=1, le=256, description=f"{WIDTH_HELP} Of another width than the avatar's it is untrained."
    )
    channels: Annotated[int | None, AfterValidator(_known_channels)] = Field(
        default=None,
        description="Of the neural texture: 4, 8, 12, 16; of others than the avatar's: untrained.",
    )
    calibration: Annotated[str | None, AfterValidator(_known_calibration)] = Field(
        default=None,
        description="Quantise the avatar's network again: minmax, percentile or entropy, or METHOD:VIEWS; "
        "5 views if none.",
    )
    frames: Annotated[int | None, Option(unit="frames")] = Field(
        default=None, description="How many frames to present."
    )
    fps: Finite | None = Field(default=None, description="Frames a second of the scene's time, and of the video.")
    output: str | None = Field(default=None, description="Size of the picture in pixels: WIDTHxHEIGHT.")
    size: Annotated[Text | None, Option(offered=("auto", "96", "128", "192", "256", "384", "512"))] = Field(
        default=None, description=f"{SIZE_HELP} auto: planned, as the network paints best."
    )
    hud: bool | None = Field(default=None, description="Write frame, rate and age on the picture.")
    policy: Annotated[str, _one_of(*POLICIES), Option(words=tuple(POLICIES), offered=tuple(POLICIES))] = Field(
        default="pipelined",
        description="pipelined: highest rate; sequential: one frame at a time; latest: newest pose wins; "
        "deadline: frames that would be late are dropped.",
    )
    edge: Annotated[
        str, AfterValidator(_known_edge), Option(offered=("single", "double", "triple", "fifo:4", "orphan"))
    ] = Field(
        default="double",
        description="Buffers between stages: single, double, triple, fifo:N, orphan or orphan:N "
        "(docs/policies-and-edges.md).",
    )
    runtime: Annotated[str, Option(offered=())] = Field(
        default="auto", description=f"What runs the network: {RUNTIME_HELP}"
    )
    skinning: str = Field(
        default="auto", description="Which unit poses the vertices: cpu, gpu; auto: cpu when OpenGL is software."
    )
    split: Annotated[tuple[str, ...], BeforeValidator(_texts)] = Field(
        default=(),
        description="TENSOR=UNIT: cut the network there, the rest runs on UNIT. `trilane avatar split` lists.",
    )
    cores: Annotated[tuple[str, ...], BeforeValidator(_cores)] = Field(
        default=(),
        description="UNIT=LIST: the unit's cores, such as dsp=0,1; once for each. Else they follow from measured "
        "times.",
    )
    profile: Text | None = Field(default=None, description=f"{PROFILE_HELP} With --pace.")
    pace: Annotated[bool, Option("--pace")] = Field(
        default=False, description="Hold each job until its modelled time has passed."
    )
    slow_motion: Finite = Field(default=1.0, description="With --pace: times slower than the chip.")
    latch_ms: Annotated[Finite, Option("--latch", unit="milliseconds")] = Field(
        default=0.0,
        ge=0,
        le=1000,
        description="Sample poses late: ready so many ms before the raster; 0: at once.",
    )
    performance_profile: Annotated[
        str | None,
        _one_of(*PERFORMANCE_PROFILES),
        Option(words=PERFORMANCE_PROFILES, offered=(NOTHING, *PERFORMANCE_PROFILES)),
    ] = Field(default=None, description="Which power and speed the units ask for, by SNPE's names.")
    baseline_frames: Annotated[int, Option("--baseline", unit="frames")] = Field(
        default=60, ge=0, description="Frames of the `sequential` run of the same scene that follows; 0: none."
    )
    check: Annotated[int, Option(unit="frames")] = Field(
        default=0,
        ge=0,
        le=1000,
        description="Frames to compare with the truth or the float path when the run is over; 0: none.",
    )
    out: Annotated[Path | None, BeforeValidator(_folder)] = Field(
        default=None, description="Run folder to write; runs/TIME-SCENE if none."
    )
    video: bool = Field(default=True, description="Encode the frames; not for runs that last.")

    @classmethod
    def checked(cls, values: Mapping[str, Any], *, as_typed: bool = False) -> Self:
        """Check `values`, by the fields' names. Raises BadInputError for the first that its field does not allow.

        `as_typed`: whether the error names the option of the command line in place of the field.
        """
        try:
            return cls(**values)
        except ValidationError as error:
            first = error.errors()[0]
        name = str(first["loc"][0])
        field, where = cls.model_fields[name], cls.spelling(name) if as_typed else name
        unexpected = unexpected_in(first) or UnexpectedValue(repr(first["input"]), _expected(field))
        raise BadInputError.at(where, unexpected)

    @classmethod
    def spelling(cls, name: str) -> str:
        """Return the option of field `name` on the command line."""
        return option_of(cls.model_fields[name]).spelling or f"--{name.replace('_', '-')}"

    def changed(self, **values: Any) -> Self:
        """Return the same options with other `values`. Raises BadInputError as `checked`."""
        return self.checked({**dict(self), **values})

    def as_json(self) -> dict[str, Any]:
        """Return every option by its field's name, as the report has it."""
        return {name: _as_json(value) for name, value in self}

    @property
    def remakes_avatar(self) -> bool:
        """Return whether the run's avatar differs from that of the scene's files in its network or its texture."""
        return any(value not in (None, AS_IT_IS) for value in (self.width, self.channels, self.calibration))

    def check_together(self) -> None:
        """Raise BadInputError for options of a chip's pace that lack another, or exclude another."""
        if (self.profile is not None) != self.pace:
            found = "--profile without --pace" if self.profile is not None else "--pace without --profile"
            remedy = "give both; `trilane predict --profile` answers without running"
            raise BadInputError("options", found, "both or neither", remedy)
        if not self.pace:
            if self.slow_motion != 1.0:
                raise BadInputError("options", "--slow-motion without --pace", "--pace and --profile with it")
            return
        if self.split:
            remedy = "a chip's pace is that of a whole network"
            raise BadInputError("options", "--split with --pace", "one of them", remedy)
        if self.performance_profile is not None:
            found = "--performance-profile with --pace"
            raise BadInputError("options", found, "one of them", "a pace is capped already")


def _as_json(value: object) -> object:
    if isinstance(value, tuple):
        return list(value)
    return str(value) if isinstance(value, PurePath) else value


def _expected(field: FieldInfo) -> str:
    """Say what a field's value must be, from its type, range and unit."""
    kind, unit = kind_of(field), option_of(field).unit
    if kind not in (int, float):
        return {str: "text", bool: "true or false", tuple: "a list of texts", Path: "a path"}[kind]
    noun = unit or "a number"
    if kind is int:
        noun = f"a whole number of {unit}" if unit else "a whole number"
    least, most = limits_of(field)
    comma = "," if unit else ""
    if least is None:
        return noun
    return f"{noun}{comma} {least} or more" if most is None else f"{noun}{comma} from {least} to {most}"
