"""`trilane init`: a first pipeline file that runs networks on a video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trilane.apps.cli.commands import Commands
from trilane.apps.cli.console import stdout_console

app = Commands()

EPILOG = """\b
Examples:
  trilane init detector.onnx --video street.mp4 --out street.toml
  trilane init detector.onnx segmenter.onnx --video street.mp4 --out street.toml

\b
Exit codes:
  0 the file is written, 2 a file that is wrong, lies elsewhere or exists
"""

NetworkArgument = Annotated[list[Path], typer.Argument(help="ONNX files that take pictures.")]
VideoOption = Annotated[Path, typer.Option("--video", help="Video that the networks look at.")]
OutOption = Annotated[Path, typer.Option("--out", help="Pipeline file to write, in a folder above the others.")]
UnitOption = Annotated[str, typer.Option("--unit", help="Unit of the networks: cpu, gpu or dsp.")]
ShapeOption = Annotated[
    list[str] | None,
    typer.Option("--input-shape", help="Sizes that a network does not fix: NAME=1x3x224x224."),
]


@app.command(epilog=EPILOG)
def init(
    networks: NetworkArgument,
    video: VideoOption,
    out: OutOption,
    unit: UnitOption = "dsp",
    input_shape: ShapeOption = None,
) -> None:
    """Write a pipeline file that runs networks on a video, ready for `trilane check`, `predict` and `run`.

    Each network looks at every frame on a branch of its own. Sizes and rate are read from the files.
    """
    from trilane.apps.check.new_file import write_new_file
    from trilane.apps.predict.predict_options import shape_of
    from trilane.errors import BadInputError
    from trilane.unexpected_value import UnexpectedValue

    try:
        shapes = dict(map(shape_of, input_shape or ()))
    except UnexpectedValue as error:
        raise BadInputError.at("--input-shape", error) from None
    console = stdout_console()
    console.print(write_new_file(out, networks, video, unit, shapes), markup=False, soft_wrap=True, end="")
    console.print(f"\nwritten: {out}; next: trilane check {out}, trilane run {out}", markup=False, soft_wrap=True)
