"""`trilane check`: a pipeline file as text, JSON or a drawing. `trilane init`: a first pipeline file for networks.

Rule: this module shows the results of `trilane.apps.check`. It computes nothing and imports no code of the file.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trilane.apps.cli.commands import Commands, JsonOption
from trilane.apps.cli.console import print_json, stdout_console, without_controls

if TYPE_CHECKING:
    from rich.table import Table

    from trilane.apps.check.checked import CheckedFile
    from trilane.pipeline.file_keys import PortInput

app = Commands()

EPILOG = """\b
Examples:
  trilane check street.toml
  trilane check street.toml --svg street.svg
  trilane check street.toml --json
  trilane check default --profile snapdragon-888

\b
Exit codes:
  0 the file is right, 2 it is not, or no such file
"""

FileArgument = Annotated[
    str, typer.Argument(help="Pipeline file (.toml, docs/pipeline-file.md), or a scene: a name or a file.")
]
ProfileOption = Annotated[
    str | None, typer.Option("--profile", help="For a scene: chip whose times the stages have, such as snapdragon-888.")
]
SvgOption = Annotated[Path | None, typer.Option("--svg", help="Draw the graph here (.svg).")]


@app.command(epilog=EPILOG)
def check(file: FileArgument, svg: SvgOption = None, profile: ProfileOption = None, json: JsonOption = False) -> None:
    """Check a pipeline file and print its graph, its shortest period, what determines the period, and its memory.

    For a scene, the command prints the pipeline file of its run. Nothing runs, and no Python of the file is imported.
    """
    from trilane.apps.check.checked import check_file, check_scene, draw_graph, is_scene
    from trilane.errors import BadInputError
    from trilane.pipeline.pipeline_file import read_pipeline
    from trilane.writing import require_writable, write_bytes

    if svg is not None:
        if svg.suffix.lower() != ".svg":
            raise BadInputError("--svg", f"'{svg}'", "a name that ends in .svg")
        require_writable(svg)
    text = ""
    if is_scene(file):
        checked, text = check_scene(file, profile)
    elif profile is None:
        checked = check_file(read_pipeline(Path(file)))
    else:
        remedy = f"`trilane predict {file} --profile {profile}` prices its stages"
        raise BadInputError("--profile", f"{profile} beside a pipeline file", "a scene", remedy)
    if svg is not None:
        write_bytes(svg, draw_graph(checked).encode())
    if json:
        print_json(checked.as_json())
        return
    if text:
        print(text, end="")
        return
    console = stdout_console()
    console.print(_head(checked), soft_wrap=True)
    console.print(_stages(checked))
    if checked.memory:
        console.print(_streams(checked))
    for line in _tail(checked):
        console.print(line, soft_wrap=True)


def _head(checked: CheckedFile) -> str:
    run = checked.file.run
    source = "a source that is always ready"
    if run.fps is not None:
        source = f"{run.fps:g} fps"
    elif run.arrivals is not None:
        source = f"arrivals at {run.arrivals.poisson:g} a second"
    count = f"{len(checked.file.stages)} stages on {len(checked.file.units)} units"
    return f"{without_controls(checked.name)}: {count}, {source}, {run.policy}"


def _stages(checked: CheckedFile) -> Table:
    """Return a table with a row for each stage, grouped by unit."""
    from rich.table import Table

    from trilane.apps.check.checked import what

    table = Table("unit", "stage", "what", "reads", "time, ms", "from")
    for unit in checked.file.units:
        hardware = checked.file.hardware(unit)
        title = unit if hardware in (None, unit) else f"{unit} ({hardware})"
        for name, stage in checked.file.stages.items():
            if stage.unit != unit:
                continue
            every = f", every {stage.every}" if stage.every > 1 else ""
            kind = " ".join(filter(None, (stage.kind, without_controls(what(stage)))))
            reads = ", ".join(map(_input, stage.inputs)) or "-"
            price = checked.prices.get(name)
            time, source = ("?", "-") if price is None else (f"{price.time.mean_ms:.4g}", price.source or "-")
            table.add_row(title, name, kind + every, reads, time, source)
            title = ""
    return table


def _input(each: PortInput) -> str:
    from trilane.apps.check.checked import source

    port = f"{each.port}: " if each.port else ""
    age = f" to {each.max_age_ms:g} ms" if each.max_age_ms else ""
    name: str = without_controls(f"{port}{source(each)}")
    return name + (f" (latest{age})" if each.latest else "")


def _streams(checked: CheckedFile) -> Table:
    from rich.table import Table

    from trilane.transport.slots import edge_rule

    table = Table("stream", "readers", "rule", "slots", "ports", "memory")
    for name, rule in checked.rules.items():
        ports = ", ".join(
            f"{port}: {kind}" if port else str(kind) for port, kind in checked.types.get(name, {}).items()
        )
        size, slots = checked.memory[name], str(edge_rule(rule).slots)
        memory = "?" if size is None else f"{size / 1e6:.3g} MB"
        readers = ", ".join(checked.file.readers[name])
        table.add_row(name, readers, rule, slots, without_controls(ports), memory)
    return table


def _tail(checked: CheckedFile) -> list[str]:
    file, period, bound = checked.file, checked.period_ms, checked.bound
    lines = []
    if bound is None or period is None:
        unknown = ", ".join(name for name in file.stages if name not in checked.prices)
        lines.append(f"period    unknown, as no time is known of {unknown}; `trilane predict` prices networks")
    else:
        rate = f" ({1e3 / period:.4g} a second)" if period else ""
        limit = f", by {bound.limit.replace('_', ' ')}: {' -> '.join(bound.stages)}" if bound.stages else ""
        lines.append(f"period    {period:.6g} ms or more{rate}{limit}")
    unknown = ", ".join(name for name, size in checked.memory.items() if size is None)
    more = f", and what is unknown of {unknown}" if unknown else ""
    lines.append(f"memory    {sum(filter(None, checked.memory.values())) / 1e6:.3g} MB of slots{more}")
    if file.bypass is not None:
        begin, way = file.bypass
        share = "frames that need nothing there" if way.taken is None else f"{float(way.taken):.1%} of the frames"
        lines.append(f"bypass    {begin} -> {way.to}, past {', '.join(checked.past)}: {share}")
    lines.append(f"latency   to the end of {file.latency_to}")
    if checked.imports:
        lines.append(f"imports   {', '.join(checked.imports)}, by `trilane run` alone")
    return lines


INIT_EPILOG = """\b
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
InitUnitOption = Annotated[str, typer.Option("--unit", help="Unit of the networks: cpu, gpu or dsp.")]
ShapeOption = Annotated[
    list[str] | None,
    typer.Option("--input-shape", help="Sizes that a network does not fix: NAME=1x3x224x224."),
]


@app.command(epilog=INIT_EPILOG)
def init(
    networks: NetworkArgument,
    video: VideoOption,
    out: OutOption,
    unit: InitUnitOption = "dsp",
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
    console.print(write_new_file(out, networks, video, unit, shapes), soft_wrap=True, end="")
    console.print(f"\nwritten: {out}; next: trilane check {out}, trilane run {out}", soft_wrap=True)
