"""Options and arguments that several commands share, and the words that explain them.

Rule: an option that two commands have stands here, so that it is spelt and explained alike in both.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trilane.units import PerformanceProfile

ENCODER_HELP = "resnet18, mobilenetv2, mobilenetv3 or efficientnet-lite0."
NORM_HELP = "batch, instance or group."
POLICY_HELP = "sequential, pipelined, latest or deadline."
RUNTIME_HELP = "auto, ort, openvino, qnn or cuda; auto is the fastest that is installed."
SIZE_HELP = "Tensor size in pixels: HEIGHTxWIDTH, or a side S for areas up to SxS."
WIDTH_HELP = "Width of the network: 64 is full, every channel count scales with it."

JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout and nothing else there.")]
OutFileOption = Annotated[Path, typer.Option("--out", help="File to write.")]

PortOption = Annotated[
    int | None, typer.Option(min=1024, max=65535, help="Port of this machine to listen on; a free one if none.")
]

# A scene and what it is run with.
SceneArgument = Annotated[str, typer.Argument(help="A scene file (TOML), or the name of one that comes with Trilane.")]
AVATARS = "`default`, `hiker`, or the folder of an avatar."
SceneAvatarOption = Annotated[str | None, typer.Option("--avatar", help=AVATARS)]
SceneSizeOption = Annotated[
    str | None, typer.Option("--size", help=f"{SIZE_HELP} auto: planned, as the network paints best.")
]
MotionOption = Annotated[str | None, typer.Option(help="Motion: .bvh, .npz, .npy, .pkl, or builtin:NAME.")]
CameraOption = Annotated[str | None, typer.Option(help="ARKit log, TUM, transforms.json, or builtin:NAME.")]
FpsOption = Annotated[float | None, typer.Option(help="Frames a second of the scene's time, and of the video.")]
OutputOption = Annotated[str | None, typer.Option(help="Size of the picture in pixels: WIDTHxHEIGHT.")]
SkinningOption = Annotated[
    str, typer.Option(help="Which unit poses the vertices: cpu, gpu; auto: cpu when OpenGL is software.")
]
CoresOption = Annotated[
    list[str] | None,
    typer.Option(
        help="UNIT=LIST: the unit's cores, such as dsp=0,1; once for each. Else they follow from measured times."
    ),
]
PerformanceProfileOption = typer.Option(help="Which power and speed the units ask for, by SNPE's names.")
PerformanceProfileChoice = Annotated[PerformanceProfile, PerformanceProfileOption]

# An avatar and its network.
AvatarArgument = Annotated[str, typer.Argument(help=AVATARS)]
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
PROFILE_HELP = "Hardware profile: a name or a TOML file."
ProfileOption = Annotated[str, typer.Option("--profile", help=PROFILE_HELP)]
