"""`trilane check`: a pipeline file as text, JSON or a drawing. `trilane init`: a first pipeline file for networks.

Rule: this module shows the results of `trilane.apps.check`. It computes nothing and imports no code of the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.commands import Commands, JsonOption
from trilane.apps.cli.console import print_json, stdout_console, without_controls

if TYPE_CHECKING:
    from rich.table import Table

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
    from trilane.apps.check.checked import draw_graph
    from trilane.errors import BadInputError
    from trilane.writing import require_writable, write_bytes

    if svg is not None:
        if svg.suffix.lower() != ".svg":
            raise BadInputError("--svg", f"'{svg}'", "a name that ends in .svg")
        require_writable(svg)
    document, text = _checked(file, profile)
    if svg is not None:
        write_bytes(svg, draw_graph(document).encode())
    if json:
        print_json(document)
        return
    if text:
        print(text, end="")
        return
    console = stdout_console()
    console.print(_head(document), soft_wrap=True, markup=False)
    console.print(_stages(document))
    if document["streams"]:
        console.print(_streams(document))
    for line in _tail(document):
        console.print(line, soft_wrap=True, markup=False)


def _checked(file: str, profile: str | None) -> tuple[dict[str, Any], str]:
    """Return the document for `--json`, and the text of a pipeline file that describes the pipeline of a scene.

    If `file` is a pipeline file, this text is empty. `file`: pipeline file, or name or file of a scene.
    `profile`: chip whose times the stages of a scene get; None for stages without times.

    Raises BadInputError for a faulty file, and for a `profile` with a pipeline file. Raises MissingPartError for a
    scene whose run needs a part that is not installed.
    """
    from trilane.apps.check.checked import check_file, check_scene, is_scene
    from trilane.errors import BadInputError

    if is_scene(file):
        return check_scene(file, profile)
    if profile is not None:
        remedy = f"`trilane predict {file} --profile {profile}` prices its stages"
        raise BadInputError("--profile", f"{profile} beside a pipeline file", "a scene", remedy)
    return check_file(Path(file)), ""


def _head(document: Mapping[str, Any]) -> str:
    run = document["run"]
    source = "a source that is always ready"
    if "fps" in run:
        source = f"{run['fps']:g} fps"
    elif "arrivals" in run:
        source = f"arrivals at {run['arrivals']['poisson']:g} a second"
    count = f"{len(document['stages'])} stages on {len(document['units'])} units"
    return f"{without_controls(document['file'])}: {count}, {source}, {run['policy']}"


def _stages(document: Mapping[str, Any]) -> Table:
    """Return a table with a row for each stage, grouped by unit. `document`: result of `check_file`."""
    from rich.markup import escape
    from rich.table import Table

    table = Table("unit", "stage", "what", "reads", "time, ms", "from")
    for unit, facts in document["units"].items():
        title = unit if facts["hardware"] in (None, unit) else f"{unit} ({facts['hardware']})"
        for stage in document["stages"]:
            if stage["unit"] != unit:
                continue
            every = f", every {stage['every']}" if stage["every"] > 1 else ""
            what = escape(" ".join(filter(None, (stage["kind"], without_controls(stage["what"])))))
            reads = escape(", ".join(map(_input, stage["in"]))) or "-"
            time = "?" if stage["time_ms"] is None else f"{stage['time_ms']:.4g}"
            table.add_row(title, stage["name"], what + every, reads, time, stage["time_from"] or "-")
            title = ""
    return table


def _input(each: Mapping[str, Any]) -> str:
    port = f"{each['port']}: " if each["port"] else ""
    age = f" to {each['max_age_ms']:g} ms" if each.get("max_age_ms") else ""
    name: str = without_controls(f"{port}{each['from']}")
    return name + (f" (latest{age})" if each["sync"] == "latest" else "")


def _streams(document: Mapping[str, Any]) -> Table:
    from rich.markup import escape
    from rich.table import Table

    table = Table("stream", "readers", "rule", "slots", "ports", "memory")
    for stream in document["streams"]:
        ports = ", ".join(f"{name}: {kind}" if name else kind for name, kind in stream["ports"].items())
        memory = "?" if stream["memory_bytes"] is None else f"{stream['memory_bytes'] / 1e6:.3g} MB"
        readers = ", ".join(stream["to"])
        table.add_row(
            stream["from"], readers, stream["rule"], str(stream["slots"]), escape(without_controls(ports)), memory
        )
    return table


def _tail(document: Mapping[str, Any]) -> list[str]:
    unknown = [stage["name"] for stage in document["stages"] if stage["time_ms"] is None]
    lines = []
    if document["period_ms"] is None:
        lines.append(
            f"period    unknown, as no time is known of {', '.join(unknown)}; `trilane predict` prices networks"
        )
    else:
        period = document["period_ms"]
        rate = f" ({1e3 / period:.4g} a second)" if period else ""
        limit = f", by {document['limit'].replace('_', ' ')}: {' -> '.join(document['cycle'])}"
        lines.append(f"period    {period:.6g} ms or more{rate}{limit if document['cycle'] else ''}")
    more = f", and what is unknown of {', '.join(document['memory_unknown'])}" if document["memory_unknown"] else ""
    lines.append(f"memory    {document['memory_bytes'] / 1e6:.3g} MB of slots{more}")
    for route in document["routes"]:
        share = "frames that need nothing there" if route["share"] is None else f"{route['share']:.1%} of the frames"
        lines.append(f"bypass    {route['from']} -> {route['to']}, past {', '.join(route['past'])}: {share}")
    lines.append(f"latency   to the end of {document['latency_to']}")
    if document["imports"]:
        lines.append(f"imports   {', '.join(document['imports'])}, by `trilane run` alone")
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
    console.print(write_new_file(out, networks, video, unit, shapes), markup=False, soft_wrap=True, end="")
    console.print(f"\nwritten: {out}; next: trilane check {out}, trilane run {out}", markup=False, soft_wrap=True)
