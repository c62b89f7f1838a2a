"""The options of a run. Each option is one field, with its help text, default, range, unit and words.

The command line, `trilane.run`, sweeps, the dashboard's controls and the report read their options from these fields.
Rule: no other list of the options exists. The fields are plain data; `configure` looks whether files exist.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Final

from pydantic import AfterValidator, BeforeValidator, Field

from trilane.errors import BadInputError, did_you_mean
from trilane.options import NOTHING, Finite, Name, OnePath, Option, Options, Text, Texts, texts_of
from trilane.scheduler.policy import POLICIES
from trilane.transport.slots import DEFAULT_EDGE, EDGE_WORDS, EDGES, RULES, edge_rule
from trilane.unexpected_value import UnexpectedValue
from trilane.units import AVATARS_HELP, CALIBRATION_METHODS, CHANNELS, PERFORMANCE_PROFILES, ROOM, RUNTIME_WORDS, either

PROFILE_HELP: Final = "Hardware profile: a name or a TOML file."
RUNTIME_HELP: Final = f"auto, {RUNTIME_WORDS}; auto is the fastest installed one."
SIZE_HELP: Final = "Tensor size in pixels: HEIGHTxWIDTH, or a side S for areas up to SxS."
CHANNELS_HELP: Final = f"Channels of the neural texture: {either(CHANNELS)}."
WIDTH_HELP: Final = "Width of the network: 64 is full; all channel counts scale with it."

#: Word for the calibration that the avatar's own network file has.
AS_IT_IS: Final = "as-it-is"
#: Number of views on which a network is calibrated if none is given.
VIEWS: Final = 5
MOST_VIEWS: Final = 1000


def calibration_of(text: str) -> tuple[str, int] | None:
    """Return (method, number of views) of `text`, METHOD or METHOD:VIEWS; None for `AS_IT_IS`.

    Raises UnexpectedValue for any other text.
    """
    method, colon, views = text.partition(":")
    if text == AS_IT_IS:
        return None
    if method not in CALIBRATION_METHODS:
        known = (AS_IT_IS, *CALIBRATION_METHODS)
        raise UnexpectedValue(repr(text), f"one of {', '.join(known)}", did_you_mean(method, known))
    if colon and not (views.isdecimal() and len(views) < 5 and 1 <= int(views) <= MOST_VIEWS):
        raise UnexpectedValue(repr(text), f"{method} or {method}:VIEWS, VIEWS from 1 to {MOST_VIEWS}")
    return method, int(views) if colon else VIEWS


def _cores(value: object) -> object:
    """Return `value` of the option `cores` as texts. Programs may give a mapping such as {"dsp": [0, 1]} instead."""
    if not isinstance(value, Mapping):
        return texts_of(value)
    return tuple(f"{unit}={','.join(map(str, own))}" for unit, own in value.items())


def _known_channels(channels: int | None) -> int | None:
    if channels is not None and channels not in CHANNELS:
        raise UnexpectedValue(repr(channels), either(CHANNELS))
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


class RunOptions(Options):
    """The options of `trilane run`, in the order of its help; None leaves what the scene or the avatar says."""

    scene: Annotated[Name, Option(is_argument=True)] = Field(
        default="default",
        description="A scene file (TOML), the name of a bundled one, or a pipeline file.",
    )
    changes: Annotated[Texts, Option("--set")] = Field(
        default=(),
        description="Change a key of a pipeline file: stages.seg.unit=dsp. Separate several keys by commas. "
        "May be given again.",
    )
    motion: Name | None = Field(default=None, description="Motion: .bvh, .npz, .npy, .pkl, or builtin:NAME.")
    camera: Name | None = Field(default=None, description="Camera: ARKit log, TUM, transforms.json, or builtin:NAME.")
    background: Name | None = Field(
        default=None, description=f"Background: {ROOM}, or a video, image folder or picture."
    )
    avatar: Annotated[Name | None, Option(offered=())] = Field(default=None, description=AVATARS_HELP)
    width: int | None = Field(
        default=None, ge=1, le=256, description=f"{WIDTH_HELP} A width other than the avatar's is untrained."
    )
    channels: Annotated[int | None, AfterValidator(_known_channels)] = Field(
        default=None, description=f"{CHANNELS_HELP} A number other than the avatar's is untrained."
    )
    calibration: Annotated[str | None, AfterValidator(_known_calibration)] = Field(
        default=None,
        description=f"Quantise the avatar's network again: {either(CALIBRATION_METHODS)}, or METHOD:VIEWS "
        f"({VIEWS} views if not given).",
    )
    frames: Annotated[int | None, Option(unit="frames")] = Field(
        default=None, description="Number of frames; the scene's number if not given."
    )
    fps: Finite | None = Field(default=None, description="Frames a second of the scene's time, and of the video.")
    picture: str | None = Field(default=None, description="Size of the picture in pixels: WIDTHxHEIGHT.")
    size: Annotated[Text | None, Option(offered=("auto", "96", "128", "192", "256", "384", "512"))] = Field(
        default=None, description=f"{SIZE_HELP} auto: the size at which the pictures are best."
    )
    allow_empty: Annotated[bool, Option("--allow-empty")] = Field(
        default=False,
        description="Run even if a recorded camera shows the whole person in less than half of the frames.",
    )
    hud: bool | None = Field(default=None, description="Write frame number, rate and latency on the picture.")
    policy: Annotated[str, Option(words=tuple(POLICIES), offered=tuple(POLICIES))] = Field(
        default="pipelined",
        description="; ".join(f"{name}: {policy.meaning}" for name, policy in POLICIES.items()) + ".",
    )
    edge: Annotated[str, AfterValidator(_known_edge), Option(offered=EDGES)] = Field(
        default=DEFAULT_EDGE,
        description=f"Buffers between stages: {EDGE_WORDS} (docs/policies-and-edges.md).",
    )
    runtime: Annotated[str, Option(offered=())] = Field(
        default="auto", description=f"Runtime of the network: {RUNTIME_HELP}"
    )
    skinning: str = Field(
        default="auto", description="Unit that poses the vertices: cpu, gpu or auto; auto is cpu if OpenGL is software."
    )
    split: Texts = Field(
        default=(),
        description="TENSOR=UNIT: cut the network at TENSOR and run the rest on UNIT. `trilane avatar split` lists "
        "the tensors.",
    )
    cores: Annotated[tuple[str, ...], BeforeValidator(_cores)] = Field(
        default=(),
        description="UNIT=LIST: the unit's cores, such as dsp=0,1; once for each unit. Without this option, "
        "measured times decide which cores each unit gets.",
    )
    profile: Name | None = Field(default=None, description=f"{PROFILE_HELP} Only with --pace.")
    pace: Annotated[bool, Option("--pace")] = Field(
        default=False, description="After its work, each job waits until its modelled time has passed."
    )
    slow_motion: Finite = Field(default=1.0, description="With --pace: how many times slower than the chip the run is.")
    latch_ms: Annotated[Finite, Option("--latch", unit="milliseconds")] = Field(
        default=0.0,
        ge=0,
        le=1000,
        description="Sample poses late: a pose is ready this many ms before the raster; 0: sample at once.",
    )
    performance_profile: Annotated[
        str | None,
        Option(words=PERFORMANCE_PROFILES, offered=(NOTHING, *PERFORMANCE_PROFILES)),
    ] = Field(default=None, description="Power mode of the units, which sets their speed. The names are SNPE's.")
    baseline_frames: Annotated[int, Option("--baseline", unit="frames")] = Field(
        default=60, ge=0, description="Number of frames of a further run, `sequential`, for comparison; 0: no such run."
    )
    check: Annotated[int, Option(unit="frames")] = Field(
        default=0,
        ge=0,
        le=1000,
        description="Number of frames to compare with the truth or the float path after the run; 0: none.",
    )
    out: OnePath | None = Field(default=None, description="Run folder to write; runs/TIME-SCENE if not given.")
    video: bool = Field(default=True, description="Encode the frames as a video; switch this off for long runs.")

    @property
    def remakes_avatar(self) -> bool:
        """Whether the run's avatar has another network or texture than the avatar in the scene's files."""
        return any(value not in (None, AS_IT_IS) for value in (self.width, self.channels, self.calibration))

    def check_together(self) -> None:
        """Raise BadInputError if a scene does not take an option, or if options need or exclude each other."""
        if self.changes:
            raise BadInputError("options", "--set without a pipeline file", "a .toml file with [stages] before it")
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
