"""Commands of `trilane avatar` that make network files: `network`, `split`, `export`.

Rule: this file talks to the person; the work is done in `trilane.avatars`, `trilane.training` and `trilane.stages.dsp`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trilane.apps.cli.console import print_facts, print_json, spinner, stdout_console, stdout_kept
from trilane.apps.cli.options import (
    AvatarArgument,
    ChannelsOption,
    EncoderOption,
    FixedSizeOption,
    JsonOption,
    NormOption,
    OutFileOption,
    WidthOption,
)
from trilane.errors import BadInputError, MissingPartError

if TYPE_CHECKING:
    import onnx

    from trilane.avatars.network_file import NetworkFile
    from trilane.shapes import Shape

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


def network(
    out: OutFileOption,
    encoder: EncoderOption = "resnet18",
    norm: NormOption = "batch",
    width: WidthOption = 64,
    size: FixedSizeOption = "512x512",
    channels: ChannelsOption = 16,
    seed: Annotated[int, typer.Option(help="Seed of the random weights.")] = 0,
    json: JsonOption = False,
) -> None:
    """Export an untrained float network: ONNX, static shape, input `tensor`, output `rgba`."""
    from trilane.hw_profiles.network_work import graph_facts
    from trilane.shapes import shape_buckets
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
        list[str] | None, typer.Option(help="Quantised tensor to cut at, once for each cut; all are listed if none.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder to write part-1.onnx, part-2.onnx, ... to.")] = None,
    size: FixedSizeOption = "256",
    json: JsonOption = False,
) -> None:
    """Cut an avatar's network; the parts one after the other give the same bytes.

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
    qnn: Annotated[bool, typer.Option("--qnn", help="As an HTP context binary, the only format there is.")] = False,
    soc: Annotated[str, typer.Option(help="Qualcomm's name of the chip.")] = "sm8350",
    size: Annotated[
        str | None, typer.Option(help="HEIGHTxWIDTH of the tensor; the avatar's own when not given.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Compile an avatar's network for a Snapdragon, without one."""
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
    """`S` as `SxS`."""
    return size if "x" in size else f"{size}x{size}"


def _shape(size: str) -> Shape:
    """(height, width) of `--size`. Raises BadInputError."""
    from trilane.shapes import parse_shape
    from trilane.unexpected_value import UnexpectedValue

    try:
        return parse_shape(size)
    except UnexpectedValue as error:
        raise BadInputError.at("--size", error) from error


def _untrained(
    encoder: str, norm: str, width: int, channels: int, shape: Shape, seed: int
) -> tuple[onnx.ModelProto, int]:
    """A network with random weights, and how many it has."""
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
    """The files of the parts, written to `folder`."""
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
