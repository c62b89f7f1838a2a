"""Commands of `trilane avatar` that quantise networks: `quantise`, `calibrations`.

Rule: this file talks to the person; the work is done in `trilane.training.quantising`.
"""

from __future__ import annotations

import json as json_text
from pathlib import Path
from typing import Annotated, Any

import typer

from trilane.apps.cli.console import print_facts, print_json, spinner, stderr_console, stdout_console
from trilane.apps.cli.options import METHOD_HELP, FloatNetworkArgument, FramesFileOption, JsonOption, OutFileOption
from trilane.errors import BadInputError
from trilane.figure_sources import MEASURED

EPILOG_QUANTISE = """\b
Examples:
  trilane avatar quantise float.onnx --frames frames.npy --out network.onnx
  trilane avatar quantise float.onnx --frames frames.npy --method entropy --count 20 --report report.json --out q.onnx
"""
EPILOG_CALIBRATIONS = """\b
Examples:
  trilane avatar calibrations float.onnx --frames frames.npy --method minmax
  trilane avatar calibrations --avatar default --plot calibrations.png
"""
MAX_FRAMES = 1000
#: Views of an avatar that a calibration is looked at on.
HELD_OUT = 24
EITHER = "a float network and its --frames, or --avatar alone"


def quantise(
    source: FloatNetworkArgument,
    frames: FramesFileOption,
    out: OutFileOption,
    method: Annotated[str, typer.Option(help=METHOD_HELP)] = "minmax",
    count: Annotated[int, typer.Option(min=1, max=MAX_FRAMES, help="Frames to calibrate on.")] = 20,
    full_range: Annotated[
        bool, typer.Option("--full-range", help="8-bit weights: only for CPUs with VNNI, and for DSPs.")
    ] = False,
    equalise: Annotated[bool, typer.Option("--equalise", help="Equalise channel ranges across layers first.")] = False,
    keep_float: Annotated[
        list[str] | None, typer.Option(help="Name of a layer that stays in float; repeat it.")
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Write the error of every layer, worst first, as JSON.")] = None,
    json: JsonOption = False,
) -> None:
    """Quantise a float network to bytes in, bytes out, calibrated on real frames."""
    from trilane.apps.avatar_facts import network_facts
    from trilane.avatars.network_file import parse_network
    from trilane.training.quantising.quantise import equalised
    from trilane.training.quantising.quantise import quantise as quantise_on
    from trilane.writing import write_bytes

    if out.resolve() == source.resolve():
        raise BadInputError("--out", str(out), "another file than the float network")
    model, data = parse_network(source), _frames(frames)
    with spinner(f"quantising on {min(count, len(data))} frames"):
        plain = equalised(model) if equalise else model
        result = quantise_on(plain, data[:count], method, not full_range, keep_float or [])
    facts = {"file": str(out), **network_facts(result.network), "quantisation": {**result.facts, "equalised": equalise}}
    if report is not None:
        facts["layers"] = _write_layers(report, model, result, data[-1])
    write_bytes(out, result.network.model.SerializeToString())
    print_facts(facts, json)


def calibrations(
    source: Annotated[
        Path | None, typer.Argument(help="Float network (.onnx) with the input N x C x H x W; with --frames.")
    ] = None,
    frames: Annotated[
        Path | None, typer.Option(help="Real inputs: .npy (N, H, W, C) of floats; pictures of the last 5 are compared.")
    ] = None,
    avatar: Annotated[
        str | None,
        typer.Option(
            help="Instead: the avatar's float network, on views drawn as the training's; 24 others are compared."
        ),
    ] = None,
    method: Annotated[list[str] | None, typer.Option(help=f"{METHOD_HELP} Repeat it; all if none.")] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Draw the table into a file: .png, .svg or .pdf. Needs the extra `plot`.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Compare numbers of calibration frames and methods by the error of the picture."""
    from rich.progress import track
    from rich.table import Table

    from trilane.training.quantising.calibration import METHODS
    from trilane.training.quantising.calibration_table import COUNTS, calibration_table, recommendation

    methods = method or list(METHODS)
    console = stderr_console()
    if plot is not None:
        from trilane.hw_profiles.plot import figure_for
        from trilane.writing import require_writable

        figure_for(plot, (1, 1))  # that it can be drawn and written is found out before the work
        require_writable(plot)
    model, inputs, held_out = _material(source, frames, avatar)
    table_rows = calibration_table(model, inputs, methods, held_out=held_out)
    steps = len(methods) * len(COUNTS)
    rows = list(track(table_rows, "quantising", steps, console=console, disable=not console.is_terminal))
    line = recommendation(rows)
    if plot is not None:
        from trilane.training.quantising.calibration_table import plot_calibrations

        plot_calibrations(rows, line, plot)
    if json:
        print_json({"rows": rows, "recommendation": line, "sources": {"rows": MEASURED}})
        return
    table = Table("method", "frames", "PSNR to float, dB", "mean, of 255", "largest", caption=MEASURED)
    for row in rows:
        figures = (f"{row['psnr_db']:.2f}", f"{row['mean']:.2f}", f"{row['largest']:.0f}")
        table.add_row(row["method"], str(row["count"]), *figures)
    stdout_console().print(table)
    stdout_console().print(f"recommended: {line}", soft_wrap=True)


def _material(source: Path | None, frames: Path | None, avatar: str | None) -> tuple[Any, list[Any], int]:
    """A float network, its inputs, and how many of them are held out. Raises BadInputError, MissingPartError."""
    from trilane.avatars.network_file import parse_network
    from trilane.training.quantising.calibration_table import COUNTS, EVALUATED

    if avatar is not None and source is None and frames is None:
        from trilane.apps.experiments.calibrated_network import drawn_material

        with spinner(f"drawing {max(COUNTS)} views of the training's kind"):
            return *drawn_material(avatar, max(COUNTS), HELD_OUT), HELD_OUT
    if avatar is not None or source is None or frames is None:
        raise BadInputError("avatar calibrations", "some of a network, --frames and --avatar", EITHER)
    return parse_network(source), _frames(frames), EVALUATED


def _write_layers(path: Path, model: Any, result: Any, frame: Any) -> Any:
    """The error of every layer on `frame`, also written to `path`."""
    from trilane.training.quantising.noise_model import layer_report
    from trilane.writing import write_bytes

    with spinner("measuring every layer"):
        layers = layer_report(model, result, frame)
    write_bytes(path, (json_text.dumps({"layers": layers}, indent=1) + "\n").encode())
    return layers


def _frames(path: Path) -> list[Any]:
    """Frames (H,W,C) float32 of a .npy file, at most `MAX_FRAMES`. Raises BadInputError."""
    import numpy as np

    from trilane.files import read_npy

    array = read_npy(path, "frames (N, H, W, C)")
    if array.ndim != 4 or array.dtype.kind != "f" or not len(array):
        raise BadInputError(path, f"{array.dtype} of shape {array.shape}", "floats (N, H, W, C), N at least 1")
    return [np.asarray(frame, np.float32) for frame in array[:MAX_FRAMES]]
