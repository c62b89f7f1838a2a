"""`trilane avatar`: look into bundles, export networks, quantise them, compile them for a Snapdragon.

Rule: this file talks to the person; the work is done in `trilane.avatars` and `trilane.stages.dsp`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.console import JsonOption, print_json, stderr_console, stdout_console
from trilane.errors import BadInputError, MissingPartError

if TYPE_CHECKING:
    import onnx

app = typer.Typer(
    rich_markup_mode=None,
    add_completion=False,
    no_args_is_help=True,
    help="Look into avatars, export and quantise their networks.",
)

EPILOG_INSPECT = "\b\nExamples:\n  trilane avatar inspect default\n  trilane avatar inspect my-avatar --json"
EPILOG_NETWORK = """\b
Examples:
  trilane avatar network --encoder mobilenetv2 --norm batch --width 64 --size 512x512 --out network.onnx
"""
EPILOG_QUANTIZE = """\b
Examples:
  trilane avatar quantize float.onnx --frames frames.npy --out network.onnx
  trilane avatar quantize float.onnx --frames frames.npy --method entropy --count 20 --report report.json --out q.onnx
"""
EPILOG_CALIBRATIONS = "\b\nExamples:\n  trilane avatar calibrations float.onnx --frames frames.npy --method minmax"
EPILOG_SPLIT = """\b
Examples:
  trilane avatar split default
  trilane avatar split default --at /Concat_4_output_0_QuantizeLinear_Output --out parts
"""
EPILOG_EXPORT = "\b\nExamples:\n  trilane avatar export default --qnn --soc sm8350 --out avatar_ctx.onnx"
MAX_FRAMES = 1000

OutOption = Annotated[Path, typer.Option("--out", help="File to write.")]


@app.command(epilog=EPILOG_INSPECT)
def inspect(
    name: Annotated[str, typer.Argument(help="`default` or a bundle's folder.")], json: JsonOption = False
) -> None:
    """Say what a bundle holds and how good it is, after every check that a run makes."""
    from trilane.apps.avatar_facts import bundle_facts
    from trilane.avatars.bundle import load_bundle

    _show(bundle_facts(load_bundle(name)), json)


@app.command(epilog=EPILOG_NETWORK)
def network(
    out: OutOption,
    encoder: Annotated[
        str, typer.Option(help="resnet18, mobilenetv2, mobilenetv3 or efficientnet-lite0.")
    ] = "resnet18",
    norm: Annotated[str, typer.Option(help="batch, instance or group.")] = "batch",
    width: Annotated[int, typer.Option(help="64 is full width.")] = 64,
    size: Annotated[str, typer.Option(help="HEIGHTxWIDTH, multiples of 32.")] = "512x512",
    channels: Annotated[int, typer.Option(help="Channels of the neural texture.")] = 16,
    seed: Annotated[int, typer.Option(help="Of the random weights.")] = 0,
    json: JsonOption = False,
) -> None:
    """Export an untrained float network: ONNX, static shape, input `tensor`, output `rgba`."""
    from trilane.apps.avatar_facts import graph_facts
    from trilane.shapes import shape_buckets

    try:
        height, width_px = shape_buckets(size if "x" in size else f"{size}x{size}")[0]
    except ValueError as error:
        raise BadInputError.about("--size", error) from error
    model, parameters = _untrained(encoder, norm, width, channels, (height, width_px), seed)
    _write(model, out)
    settings = {"encoder": encoder, "norm": norm, "width": width, "channels": channels, "size": [height, width_px]}
    facts = {"file": str(out), **settings, "parameters": parameters, "gmac": graph_facts(model)["gmac"]}
    _show(facts, json)


@app.command(epilog=EPILOG_QUANTIZE)
def quantize(
    source: Annotated[Path, typer.Argument(help="Float network (.onnx) with the input N x C x H x W.")],
    frames: Annotated[Path, typer.Option(help="Real inputs: .npy (N, H, W, C) float.")],
    out: OutOption,
    method: Annotated[str, typer.Option(help="minmax, percentile or entropy.")] = "minmax",
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
    from trilane.training.quantising.cross_layer_equalisation import equalised
    from trilane.training.quantising.layer_noise import layer_report
    from trilane.training.quantising.quantise import quantise

    if out.resolve() == source.resolve():
        raise BadInputError("--out", str(out), "another file than the float network")
    model = parse_network(source)
    data = _frames(frames)
    calibration = data[:count]
    with _spinner(f"quantising on {len(calibration)} frames"):
        result = quantise(
            equalised(model) if equalise else model, calibration, method, not full_range, keep_float or []
        )
    facts = {"file": str(out), **network_facts(result.network), "quantisation": {**result.facts, "equalised": equalise}}
    if report is not None:
        with _spinner("measuring every layer"):
            facts["layers"] = layer_report(model, result, data[-1])
        _write_text(report, facts["layers"])
    _write(result.network.model, out)
    _show(facts, json)


@app.command(epilog=EPILOG_CALIBRATIONS)
def calibrations(
    source: Annotated[Path, typer.Argument(help="Float network (.onnx) with the input N x C x H x W.")],
    frames: Annotated[Path, typer.Option(help="Real inputs: .npy (N, H, W, C) float; the last 5 are judged.")],
    method: Annotated[
        list[str] | None, typer.Option(help="minmax, percentile or entropy; repeat it. All if none.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Compare numbers of calibration frames and methods by the error of the picture."""
    from rich.progress import track
    from rich.table import Table

    from trilane.avatars.network_file import parse_network
    from trilane.training.quantising.calibration import METHODS
    from trilane.training.quantising.calibration_table import COUNTS, calibration_table

    methods = method or list(METHODS)
    console = stderr_console()
    found = calibration_table(parse_network(source), _frames(frames), methods)
    steps = len(methods) * len(COUNTS)
    rows = list(track(found, "quantising", steps, console=console, disable=not console.is_terminal))
    if json:
        print_json({"rows": rows})
        return
    table = Table("method", "frames", "PSNR to float, dB", "mean, of 255", "largest")
    for row in rows:
        figures = (f"{row['psnr_db']:.2f}", f"{row['mean']:.2f}", f"{row['largest']:.0f}")
        table.add_row(row["method"], str(row["count"]), *figures)
    stdout_console().print(table)


@app.command(epilog=EPILOG_SPLIT)
def split(
    name: Annotated[str, typer.Argument(help="`default` or a bundle's folder.")],
    at: Annotated[
        list[str] | None, typer.Option(help="Quantised tensor to cut at, once for each cut; all are listed if none.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder to write part-1.onnx, part-2.onnx, ... to.")] = None,
    size: Annotated[str, typer.Option(help="Tensor: one side, or HEIGHTxWIDTH.")] = "256",
    json: JsonOption = False,
) -> None:
    """Cut an avatar's network; the parts one after the other give the same bytes.

    `trilane run --split TENSOR=UNIT` runs the parts as stages of their own.
    """
    from rich.table import Table

    from trilane.avatars.bundle import load_bundle
    from trilane.avatars.network_reshape import reshaped
    from trilane.avatars.network_split import cuts
    from trilane.avatars.network_split import split as cut_at
    from trilane.shapes import parse_shape

    if bool(at) != (out is not None):
        raise BadInputError("options", "--at without --out" if at else "--out without --at", "both, or neither")
    try:
        height, width = parse_shape(size if "x" in size else f"{size}x{size}")
    except ValueError as error:
        raise BadInputError.about("--size", error) from error
    whole = reshaped(load_bundle(name).read_network(), height, width)
    if at and out is not None:
        parts = cut_at(whole, at)
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadInputError(out, (error.strerror or str(error)).lower(), "a folder that can be written") from None
        files = [out / f"part-{number}.onnx" for number in range(1, len(parts) + 1)]
        for part, file in zip(parts, files, strict=True):
            _write(part.model, file)
        _show({"parts": [str(file) for file in files], "at": list(at)}, json)
        return
    rows = [{"at": cut.at, "tensors": len(cut.crossing), "bytes": cut.bytes} for cut in cuts(whole)]
    if json:
        print_json({"cuts": rows})
        return
    table = Table("cut at", "tensors that cross", "bytes")
    for row in rows:
        table.add_row(*map(str, row.values()))
    stdout_console().print(table)


@app.command(epilog=EPILOG_EXPORT)
def export(
    name: Annotated[str, typer.Argument(help="`default` or a bundle's folder.")],
    out: OutOption,
    qnn: Annotated[bool, typer.Option("--qnn", help="As an HTP context binary, the only format there is.")] = False,
    soc: Annotated[str, typer.Option(help="Qualcomm's name of the chip.")] = "sm8350",
    size: Annotated[
        str | None, typer.Option(help="HEIGHTxWIDTH of the tensor; the bundle's own when not given.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Compile an avatar's network for a Snapdragon, without one."""
    from trilane.avatars.bundle import load_bundle
    from trilane.avatars.network_reshape import reshaped
    from trilane.shapes import parse_shape
    from trilane.stages.dsp.runtime import resolve

    if not qnn:
        raise BadInputError("avatar export", "no format", "--qnn")
    resolve("qnn")
    from trilane.stages.dsp.qnn import version, write_context

    whole = load_bundle(name).read_network()
    try:
        chosen = reshaped(whole, *parse_shape(size)) if size else whole
    except ValueError as error:
        raise BadInputError.about("--size", error) from error
    with _spinner(f"compiling for {soc}"):
        write_context(chosen, soc, out)
    _show({"file": str(out), "bytes": out.stat().st_size, "soc": soc, "compiler": version()}, json)


def _untrained(
    encoder: str, norm: str, width: int, channels: int, shape: tuple[int, int], seed: int
) -> tuple[onnx.ModelProto, int]:
    try:
        import torch
    except ModuleNotFoundError as error:
        raise MissingPartError("exporting a network needs PyTorch", "pip install 'trilane[train]'") from error

    from trilane.training.network import UNet
    from trilane.training.onnx_export import export_onnx

    torch.manual_seed(seed)
    unet = UNet(encoder, norm, width, channels)
    with _spinner("exporting"):
        return export_onnx(unet, *shape), sum(p.numel() for p in unet.parameters())


def _frames(path: Path) -> list[Any]:
    import numpy as np

    from trilane.files import read_npy

    array = read_npy(path, "frames (N, H, W, C)")
    if array.ndim != 4 or array.dtype.kind != "f" or not len(array):
        raise BadInputError(path, f"{array.dtype} of shape {array.shape}", "floats (N, H, W, C), N at least 1")
    return [np.asarray(frame, np.float32) for frame in array[:MAX_FRAMES]]


def _write(model: onnx.ModelProto, path: Path) -> None:
    _replace(path, model.SerializeToString())


def _write_text(path: Path, layers: Any) -> None:
    import json

    _replace(path, (json.dumps({"layers": layers}, indent=1) + "\n").encode())


def _replace(path: Path, content: bytes) -> None:
    """Write under a temporary name beside `path`, then rename: a killed command leaves no half file."""
    draft = path.with_name(f".{path.name}-{os.getpid()}")
    try:
        draft.write_bytes(content)
        draft.replace(path)
    except OSError as error:
        draft.unlink(missing_ok=True)
        raise BadInputError(path, error.strerror or str(error), "a file that can be written") from error


@contextmanager
def _spinner(text: str) -> Iterator[None]:
    console = stderr_console()
    if not console.is_terminal:
        yield
        return
    with console.status(text):
        yield


def _show(facts: Mapping[str, Any], json: bool) -> None:
    if json:
        print_json(facts)
        return
    from rich.table import Table

    table = Table(show_header=False, box=None)
    for key, value in _flat(facts):
        table.add_row(key, f"{value:.4g}" if isinstance(value, float) else str(value))
    stdout_console().print(table)


def _flat(facts: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in facts.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for entry in value:
                yield str(entry.get("name")), {k: v for k, v in entry.items() if k != "name"}
        else:
            yield prefix + key, value
