"""Options and arguments that several commands share, and the words that explain them.

Rule: an option of a run is a field of `RunOptions`; another one that two commands have stands here. Each is spelt and
explained alike in all commands.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from trilane.stages.run_options import (
    AVATARS_HELP,
    PROFILE_HELP,
    WIDTH_HELP,
    RunOptions,
    kind_of,
    limits_of,
    option_of,
)
from trilane.units import PerformanceProfile

ENCODER_HELP = "resnet18, mobilenetv2, mobilenetv3 or efficientnet-lite0."
NORM_HELP = "batch, instance or group."
POLICY_HELP = "sequential, pipelined, latest or deadline."

JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout and nothing else there.")]
OutFileOption = Annotated[Path, typer.Option("--out", help="File to write.")]

PortOption = Annotated[
    int | None, typer.Option(min=1024, max=65535, help="Port of this machine to listen on; a free one if none.")
]


def run_parameter(name: str) -> Any:
    """Field `name` of `RunOptions` as Typer describes an option or argument; its value is checked by the field."""
    field = RunOptions.model_fields[name]
    option = option_of(field)

    def checked(value: Any) -> Any:
        if value is not None:
            RunOptions.checked({name: value}, as_typed=True)
        return value

    least, most = limits_of(field)
    settings: dict[str, Any] = {"help": field.description, "callback": checked, "min": least, "max": most}
    if option.is_argument:
        return typer.Argument(**settings)
    is_pair = kind_of(field) is bool and not option.spelling  # which Typer spells --NAME/--no-NAME
    return typer.Option(*() if is_pair else (RunOptions.spelling(name),), **settings)


def with_run_options(command: Callable[..., None]) -> Callable[..., None]:
    """`command`, whose first parameter is a `RunOptions`, with an option for every field in place of it.

    Typer reads the options of a command from its signature, which is put together here.
    """

    def called(**values: Any) -> None:
        given = {name: values.pop(name) for name in RunOptions.model_fields}
        asked = {name: value for name, value in given.items() if value is not None}
        command(RunOptions.checked(asked, as_typed=True), **values)

    _, *own = inspect.signature(command, eval_str=True).parameters.values()
    called.__signature__ = inspect.Signature([*map(_parameter, RunOptions.model_fields), *own])  # type: ignore[attr-defined]
    called.__name__, called.__doc__ = command.__name__, command.__doc__
    return called


def _parameter(name: str) -> inspect.Parameter:
    field = RunOptions.model_fields[name]
    words, kind = option_of(field).words, kind_of(field)
    typed: Any = Literal[words] if words else list[str] if kind is tuple else kind
    default = None if field.default == () else field.default
    annotation: Any = Annotated[typed if default is not None else typed | None, run_parameter(name)]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


# Options of a run that other commands have too.
SceneArgument = Annotated[str, run_parameter("scene")]
SceneAvatarOption = Annotated[str | None, run_parameter("avatar")]
SceneSizeOption = Annotated[str | None, run_parameter("size")]
MotionOption = Annotated[str | None, run_parameter("motion")]
CameraOption = Annotated[str | None, run_parameter("camera")]
FpsOption = Annotated[float | None, run_parameter("fps")]
OutputOption = Annotated[str | None, run_parameter("output")]
SkinningOption = Annotated[str, run_parameter("skinning")]
CoresOption = Annotated[list[str] | None, run_parameter("cores")]
PerformanceProfileOption = typer.Option(help=RunOptions.model_fields["performance_profile"].description)
PerformanceProfileChoice = Annotated[PerformanceProfile, PerformanceProfileOption]

# An avatar and its network.
AvatarArgument = Annotated[str, typer.Argument(help=AVATARS_HELP)]
EncoderOption = Annotated[str, typer.Option(help=ENCODER_HELP)]
NormOption = Annotated[str, typer.Option(help=NORM_HELP)]
WidthOption = Annotated[int, typer.Option(help=WIDTH_HELP)]
FixedSizeOption = Annotated[str, typer.Option("--size", help="Tensor size in pixels: one side, or HEIGHTxWIDTH.")]
ChannelsOption = Annotated[int, typer.Option(help="Channels of the neural texture, 1 to 16.")]
FloatNetworkArgument = Annotated[Path, typer.Argument(help="Float network (.onnx) with the input N x C x H x W.")]
FramesFileOption = Annotated[Path, typer.Option("--frames", help="Real inputs: .npy (N, H, W, C) of floats.")]
METHOD_HELP = "minmax, percentile or entropy."

# A body.
BODY_HELP = "Body file in the SMPL-X layout (.npz)."
BodyFileArgument = Annotated[Path, typer.Argument(help=BODY_HELP)]
BodyFileOption = Annotated[Path, typer.Option(help=BODY_HELP)]

# A hardware profile.
ProfileOption = Annotated[str, typer.Option("--profile", help=PROFILE_HELP)]
