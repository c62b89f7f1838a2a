"""Commands of `trilane avatar` that make network files: `network`, `split`, `export`, `quantise`, `calibrations`.

Rule: this file only reads options and shows results. `trilane.avatars`, `trilane.training` and `trilane.stages.dsp` do
the work.
"""

from __future__ import annotations

import json as json_text
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.commands import (
    METHOD_HELP,
    AvatarArgument,
    ChannelsOption,
    EncoderOption,
    FixedSizeOption,
    FloatNetworkArgument,
    FramesFileOption,
    JsonOption,
    NormOption,
    OutFileOption,
    WidthOption,
)
from trilane.apps.cli.console import (
    print_facts,
    print_json,
    print_line,
    spinner,
    stderr_console,
    stdout_console,
    stdout_kept,
)
from trilane.errors import BadInputError, MissingPartError
from trilane.units import CALIBRATION_METHOD, CALIBRATION_METHODS, MEASURED

if TYPE_CHECKING:
    import onnx

    from trilane.arrays import Shape
    from trilane.avatars.network_file import NetworkFile

EPILOG_NETWORK = """\b
Examples:
  trilane avatar network --encoder mobilenetv2 --norm batch --width 64 --size 512x512 --out network.onnx
"""
EPILOG_SPLIT = """\b
Examples:
  trilane avatar split default
  trilane avatar split default --at /Concat_4_output_0_QuantizeLinear_Output --out parts
"""
EPILOG_EXPORT = "\b\nExamples:\n  trilane avatar export default --qnn --soc sm8350 --out avatar_ctx.onnx"
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
#: Number of held-out views of an avatar on which calibrations are compared.
HELD_OUT = 24
EITHER = "a float network and its --frames, or --avatar alone"


def network(
    out: OutFileOption,
    encoder: EncoderOption = "resnet18",
    norm: NormOption = "batch",
    width: WidthOption = 64,
    size: FixedSizeOption = "512x512",
    channels: ChannelsOption = 16,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Seed of the random weights.")] = 0,
    json: JsonOption = False,
) -> None:
    """Export an untrained float network: ONNX, static shape, input `tensor`, output `rgba`."""
    from trilane.arrays import shape_buckets
    from trilane.hw_profiles.network_work import graph_facts
    from trilane.unexpected_value import UnexpectedValue
    from trilane.writing import write_bytes

    try:
        shape = shape_buckets(_both_sides(size))[0]
    except UnexpectedValue as error:
        raise BadInputError.at("--size", error) from error
    model, parameters = _untrained(encoder, norm, width, channels, shape, seed)
    write_bytes(out, model.SerializeToString())
    settings = {"encoder": encoder, "norm": norm, "width": width, "channels": channels, "size": list(shape)}
    facts = {"file": str(out), **settings, "parameters": parameters, "gmac": graph_facts(model)["gmac"]}
    print_facts(facts, json)


def split(
    name: AvatarArgument,
    at: Annotated[
        list[str] | None, typer.Option(help="Quantised tensor to cut at, once for each cut; if none, all are listed.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder to write part-1.onnx, part-2.onnx, ... to.")] = None,
    size: FixedSizeOption = "256",
    json: JsonOption = False,
) -> None:
    """Cut an avatar's network into parts.

    In sequence, the parts give the same bytes as the whole network.
    `trilane run --split TENSOR=UNIT` runs the parts as stages of their own.
    """
    from trilane.avatars.bundle import load_bundle
    from trilane.avatars.network_file import reshaped

    if bool(at) != (out is not None):
        raise BadInputError("options", "--at without --out" if at else "--out without --at", "both, or neither")
    shape = _shape(_both_sides(size))
    whole = reshaped(load_bundle(name).read_network(), *shape)
    if at and out is not None:
        print_facts({"parts": [str(file) for file in _write_parts(whole, at, out)], "at": list(at)}, json)
    else:
        _list_cuts(whole, json)


def export(
    name: AvatarArgument,
    out: OutFileOption,
    qnn: Annotated[
        bool,
        typer.Option("--qnn", help="Write an HTP context binary; there is no other format, so the option is required."),
    ] = False,
    soc: Annotated[str, typer.Option(help="Qualcomm's name of the chip.")] = "sm8350",
    size: Annotated[
        str | None, typer.Option(help="HEIGHTxWIDTH of the tensor; if not given, the avatar's own size.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Compile an avatar's network for a Snapdragon."""
    from trilane.avatars.bundle import load_bundle
    from trilane.avatars.network_file import reshaped
    from trilane.stages.dsp.runtime import resolve

    if not qnn:
        raise BadInputError("avatar export", "no format", "--qnn")
    resolve("qnn")
    from trilane.stages.dsp.qnn import version, write_context

    whole = load_bundle(name).read_network()
    chosen = reshaped(whole, *_shape(size)) if size else whole
    with spinner(f"compiling for {soc}"), stdout_kept():
        write_context(chosen, soc, out)
    print_facts({"file": str(out), "bytes": out.stat().st_size, "soc": soc, "compiler": version()}, json)


def _both_sides(size: str) -> str:
    """Return `size` as HEIGHTxWIDTH: a single side `S` becomes `SxS`, and a size with both sides stays as it is."""
    return size if "x" in size else f"{size}x{size}"


def _shape(size: str) -> Shape:
    """Return (height, width) from the value HEIGHTxWIDTH of `--size`. Raises BadInputError for any other text."""
    from trilane.arrays import parse_shape
    from trilane.unexpected_value import UnexpectedValue

    try:
        return parse_shape(size)
    except UnexpectedValue as error:
        raise BadInputError.at("--size", error) from error


def _untrained(
    encoder: str, norm: str, width: int, channels: int, shape: Shape, seed: int
) -> tuple[onnx.ModelProto, int]:
    """Return a float network with random weights, and the number of its parameters.

    `encoder`, `norm`, `width`, `channels`: as the options of these names. `shape`: (height, width) of the input.
    `seed`: seed of the weights. Raises MissingPartError if PyTorch is missing, and BadInputError for a wrong option.
    """
    try:
        import torch
    except ModuleNotFoundError as error:
        raise MissingPartError("exporting a network needs PyTorch", extra="train") from error

    from trilane.training.network import UNet, export_onnx

    torch.manual_seed(seed)
    unet = UNet(encoder, norm, width, channels)
    with spinner("exporting"):
        return export_onnx(unet, *shape), sum(p.numel() for p in unet.parameters())


def _write_parts(whole: NetworkFile, at: list[str], folder: Path) -> list[Path]:
    """Cut the network `whole` at the tensors `at`, write the parts to `folder`, and return their files.

    The files are in the order in which the parts run. Raises BadInputError for a wrong tensor or `folder`.
    """
    from trilane.avatars.network_split import split as cut_at
    from trilane.writing import write_bytes

    parts = cut_at(whole, at)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInputError.of_os_error(folder, error, "a folder that can be written") from None
    files = [folder / f"part-{number}.onnx" for number in range(1, len(parts) + 1)]
    for part, file in zip(parts, files, strict=True):
        write_bytes(file, part.model.SerializeToString())
    return files


def _list_cuts(whole: NetworkFile, json: bool) -> None:
    from rich.table import Table

    from trilane.avatars.network_split import cuts

    rows = [{"at": cut.at, "tensors": len(cut.crossing), "bytes": cut.bytes} for cut in cuts(whole)]
    if json:
        print_json({"cuts": rows})
        return
    table = Table("cut at", "tensors that cross", "bytes")
    for row in rows:
        table.add_row(*map(str, row.values()))
    stdout_console().print(table)


def quantise(
    source: FloatNetworkArgument,
    frames: FramesFileOption,
    out: OutFileOption,
    method: Annotated[str, typer.Option(help=METHOD_HELP)] = CALIBRATION_METHOD,
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
    """Quantise a float network, calibrated on real frames; input and output are bytes."""
    from trilane.apps.avatar_files import network_facts
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
        Path | None, typer.Option(help="Real inputs: .npy (N, H, W, C) of floats; the last 5 are for the comparison.")
    ] = None,
    avatar: Annotated[
        str | None,
        typer.Option(
            help="Use the avatar's float network, on views drawn as in training; 24 more views are for the comparison."
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

    from trilane.training.quantising.quantise import COUNTS, calibration_table, recommendation

    methods = method or CALIBRATION_METHODS
    console = stderr_console()
    if plot is not None:
        from trilane.hw_profiles.governor import figure_for
        from trilane.writing import require_writable

        figure_for(plot, (1, 1))  # raises errors about the drawing before the long work
        require_writable(plot)
    model, inputs, held_out = _material(source, frames, avatar)
    table_rows = calibration_table(model, inputs, methods, held_out=held_out)
    steps = len(methods) * len(COUNTS)
    rows = list(track(table_rows, "quantising", steps, console=console, disable=not console.is_terminal))
    line = recommendation(rows)
    if plot is not None:
        from trilane.training.quantising.quantise import plot_calibrations

        plot_calibrations(rows, line, plot)
    if json:
        print_json({"rows": rows, "recommendation": line, "sources": {"rows": MEASURED}})
        return
    table = Table("method", "frames", "PSNR to float, dB", "mean, of 255", "largest", caption=MEASURED)
    for row in rows:
        figures = (f"{row['psnr_db']:.2f}", f"{row['mean']:.2f}", f"{row['largest']:.0f}")
        table.add_row(row["method"], str(row["count"]), *figures)
    stdout_console().print(table)
    print_line(f"recommended: {line}")


def _material(source: Path | None, frames: Path | None, avatar: str | None) -> tuple[Any, list[Any], int]:
    """Return a float network, a list of its inputs (H, W, C) float32, and the number of held-out inputs.

    The held-out inputs are the last of the list. `source`: file of the network. `frames`: file of the inputs.
    `avatar`: avatar whose float network is used, on views drawn as in training. Either `avatar` or both files are
    given; the others are None.

    Raises BadInputError for any other choice and for a bad file, and MissingPartError if a part for drawing is missing.
    """
    from trilane.avatars.network_file import parse_network
    from trilane.training.quantising.quantise import COUNTS, EVALUATED

    if avatar is not None and source is None and frames is None:
        from trilane.apps.avatar_files import drawn_material

        with spinner(f"drawing {max(COUNTS)} views of the training's kind"):
            return *drawn_material(avatar, max(COUNTS), HELD_OUT), HELD_OUT
    if avatar is not None or source is None or frames is None:
        raise BadInputError("avatar calibrations", "some of a network, --frames and --avatar", EITHER)
    return parse_network(source), _frames(frames), EVALUATED


def _write_layers(path: Path, model: Any, result: Any, frame: Any) -> Any:
    """Compare each layer of a quantised network with the float network, write a row for each layer, return the rows.

    `path`: JSON file to write. `model`: float network. `result`: quantised network, as `quantise_on` returns it.
    `frame`: input (H, W, C) for both networks.
    """
    from trilane.training.quantising.noise_model import layer_report
    from trilane.writing import write_bytes

    with spinner("measuring every layer"):
        layers = layer_report(model, result, frame)
    write_bytes(path, (json_text.dumps({"layers": layers}, indent=1) + "\n").encode())
    return layers


def _frames(path: Path) -> list[Any]:
    """Return the first `MAX_FRAMES` frames of a .npy file, each an array (H, W, C) float32.

    Raises BadInputError unless the file has floats of the shape (N, H, W, C).
    """
    import numpy as np

    from trilane.files import read_npy

    array = read_npy(path, "frames (N, H, W, C)")
    if array.ndim != 4 or array.dtype.kind != "f" or not len(array):
        raise BadInputError(path, f"{array.dtype} of shape {array.shape}", "floats (N, H, W, C), N at least 1")
    return [np.asarray(frame, np.float32) for frame in array[:MAX_FRAMES]]
