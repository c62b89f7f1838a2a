"""`trilane inspect`: what a file is, and what to do if it is not usable. `trilane times`: measurements of other tools.

Rule: this module shows and writes results of `trilane.apps.inspect` and `trilane.apps.imported_times`. It computes only
the bars of distributions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.commands import Commands, JsonOption
from trilane.apps.cli.console import note, print_json, print_line, say, spinner, stdout_console, without_controls
from trilane.errors import BadInputError

if TYPE_CHECKING:
    from rich.table import Table

    from trilane.apps.inspect.inspection import Inspection
    from trilane.pipeline.measurements.measurement import Measurement, Measurements

app = Commands()

EPILOG = """\b
Examples:
  trilane inspect walk.bvh
  trilane inspect walk.bvh --out sheet.png
  trilane inspect transforms.json --json

\b
Exit codes:
  0 usable, 2 not usable or no such file
"""
UNUSABLE = 2
MOST_JOINTS = 60

FileArgument = Annotated[
    Path, typer.Argument(help="A motion, camera, picture, video, body, avatar, network, scene, trace or run.")
]
SheetOption = Annotated[Path | None, typer.Option("--out", help="Draw a contact sheet here (.png).")]


@app.command(epilog=EPILOG)
def inspect(file: FileArgument, out: SheetOption = None, json: JsonOption = False) -> None:
    """Say what a file or folder is: format, axes, unit, rate, length, joints; and what to do if it is not usable.

    Nothing is run. The sheet shows a skeleton or the path of a camera from three sides, or pictures.
    """
    from trilane.apps.inspect.inspect_file import inspect_file
    from trilane.writing import require_writable

    if out is not None:
        if out.suffix.lower() != ".png":
            raise BadInputError("--out", f"'{out}'", "a name that ends in .png")
        require_writable(out)
    with spinner("reading"):
        found = inspect_file(file)
        sheet = _draw(found, out)
    if json:
        print_json(found.document(file, sheet))
    else:
        for line in lines(found, file, sheet):
            print_line(without_controls(line))
    if out is not None and sheet is None:
        say(f"no sheet: nothing to draw of {found.what}")
    if not found.usable:
        raise typer.Exit(UNUSABLE)


def _draw(found: Inspection, out: Path | None) -> Path | None:
    """Write the contact sheet to `out` and return `out`; None if `out` is None, or if the file has no sheet."""
    from trilane.writing import write_atomically

    if out is None or found.draw is None:
        return None
    picture = found.draw()
    with write_atomically(out) as draft:
        picture.save(draft, format="PNG")
    return out


def lines(found: Inspection, file: Path, sheet: Path | None) -> Iterator[str]:
    """Yield the lines that `trilane inspect` prints without `--json`.

    `file`: inspected file. `sheet`: contact sheet that was written; None if no sheet was written.
    """
    detected, length = found.detected, found.length
    rate = f" at {length.rate_hz:.4g}/s" if length and length.rate_hz else ""
    pairs = [name if name == theirs else f"{name} = {theirs}" for name, theirs in detected.joints.items()]
    facts: dict[str, Any] = without_controls(found.facts)
    yield f"{file}: {found.what}"
    rows = {
        "not usable": found.problem,
        "format": _because(detected.format, detected.reason),
        "axes": detected.axes,
        "unit": detected.unit,
        "rate": detected.rate,
        "lens": detected.lens,
        "length": f"{length.samples} samples{rate}, {length.seconds:.2f} s" if length else "",
        "joints mapped": _listed(pairs),
        "joints of the file without a partner": _listed(detected.unmapped),
        "body joints that the file does not have": _listed(found.missing),
        **{key.replace("_", " "): "" if value is None else str(value) for key, value in facts.items()},
    }
    for key, value in rows.items():
        if value:
            yield f"  {key}: {value}"
    for said in found.notes:
        yield f"  note: {said}"
    if sheet:
        yield f"  sheet: {sheet}"
    if found.advice:
        yield f"  {'what to do' if found.problem else 'use'}: {found.advice}"


def _because(what: str, why: str) -> str:
    return f"{what}, detected by {why}" if what and why else what


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST_JOINTS} more" if len(names) > MOST_JOINTS else ""
    return f"{len(names)}: {', '.join(names[:MOST_JOINTS])}{more}" if names else ""


EPILOG_TIMES = """\b
Examples:
  trilane times profile.csv
  trilane times onnxruntime_profile.json --name model_run --stage street.toml:segmenter
  trilane times benchmark.txt --rows chip.csv --network seg.onnx --hardware dsp --precision int8
  trilane times trace.pftrace --csv samples.csv

\b
Exit codes:
  0 done, 2 a file of no known tool or without a usable time
"""
BARS, WIDTH = " ▁▂▃▄▅▆▇█", 16
MOST_ROWS = 40

FilesArgument = Annotated[
    list[Path], typer.Argument(help="Files of other tools. The kind of each file is recognised by its content.")
]
NameOption = Annotated[str, typer.Option(help="Measurement for --stage or --rows; if not given, the only run.")]
StageOption = Annotated[str | None, typer.Option(help="Write the measurement as the time of a stage, FILE.toml:STAGE.")]
RowsOption = Annotated[
    Path | None, typer.Option(help="Add the measurement to this table for `trilane profiles fit` (.csv).")
]
NetworkOption = Annotated[str | None, typer.Option(help="Measured network: its path from the folder of the table.")]
HardwareOption = Annotated[
    str | None, typer.Option(help="Unit that ran the network: cpu, gpu or dsp; if not given, as the file says, or dsp.")
]
PrecisionOption = Annotated[
    str | None, typer.Option(help="Precision of the network: int8 (if not given), fp16 or fp32.")
]
RuntimeOption = Annotated[
    str | None, typer.Option(help="Runtime of a tensor engine: tflite (if not given) or qnn_dlc.")
]
CsvOption = Annotated[Path | None, typer.Option("--csv", help="File for every single time (.csv).")]


@app.command(epilog=EPILOG_TIMES)
def times(
    files: FilesArgument,
    name: NameOption = "",
    stage: StageOption = None,
    rows: RowsOption = None,
    network: NetworkOption = None,
    hardware: HardwareOption = None,
    precision: PrecisionOption = None,
    runtime: RuntimeOption = None,
    samples: CsvOption = None,
    json: JsonOption = False,
) -> None:
    """Read measurements of other tools, say what each time contains, and refuse rows that cannot be right. The formats:

    QNN profiles, QHAS, ONNX Runtime, benchmark_model, LoadGen and MLPerf's app, TensorRT, AI Hub, ExecuTorch, Perfetto.
    """
    from trilane.apps.imported_times import document, one_of, samples_csv, stage_text, with_row
    from trilane.pipeline.measurements.read_file import read_measurements
    from trilane.writing import write_bytes

    reads = [read_measurements(path) for path in files]
    _check_results([*files, *([_stage_of(stage)[0]] if stage else []), rows, samples])
    written: dict[Path, str] = {}
    row_says: list[str] = []
    if stage is not None:
        path, name_of_stage = _stage_of(stage)
        written[path] = stage_text(path, name_of_stage, *one_of(reads, name))
    if rows is not None:
        asked = {"unit": hardware, "precision": precision, "runtime": runtime}
        written[rows], row_says = with_row(rows, *one_of(reads, name), network, asked)
    if samples is not None:
        written[samples] = samples_csv(reads)
    for path, text in written.items():
        write_bytes(path, text.encode())
    if json:
        print_json(document(reads))
        for line in row_says:
            note(line)
        return
    for read in reads:
        _show(read)
    for path in written:
        print_line(f"written: {without_controls(str(path))}")
    for line in row_says:
        print_line(without_controls(line))


def _check_results(paths: Sequence[Path | None]) -> None:
    """Raise BadInputError if two of `paths`, files to read and files to write, are the same file."""
    known: set[Path] = set()
    for path in filter(None, paths):
        if path.resolve() in known:
            raise BadInputError(path, "the same file twice", "a file for each result", "choose another name")
        known.add(path.resolve())


def _stage_of(text: str) -> tuple[Path, str]:
    path, colon, stage = text.rpartition(":")
    if not colon or not path or not stage:
        raise BadInputError("--stage", repr(text), "FILE.toml:STAGE, such as street.toml:segmenter")
    return Path(path), stage


def _show(read: Measurements) -> None:
    console = stdout_console()
    name = without_controls(str(read.path))
    print_line(f"{name}: {read.tool}: {read.says}")
    for kind in ("run", "wall", "layer"):
        of_kind = [each for each in read.measurements if each.kind == kind]
        if kind == "layer":
            of_kind.sort(key=lambda each: -(each.share or 0) or -(each.mean_ms or 0))
        if of_kind:
            console.print(_table(kind, of_kind[:MOST_ROWS]))
        if len(of_kind) > MOST_ROWS:
            console.print(f"and {len(of_kind) - MOST_ROWS} more; --json has all")
    hints = [f"{each.name}: {each.hint}" for each in read.measurements if each.hint]
    skipped = [f"left aside: {reason} ({count})" for reason, count in read.skipped.items()]
    refused = [f"refused: {each.row}: {each.reason}" for each in read.refused[:MOST_ROWS]]
    if read.refused_count > len(refused):
        refused.append(f"refused: {read.refused_count - len(refused)} more")
    for line in (*hints, *skipped, *refused):
        print_line(without_controls(line))


def _table(kind: str, measurements: Sequence[Measurement]) -> Table:
    """Return a table with a row for each of the `measurements`, without empty columns.

    `kind`: kind of all these measurements: run, wall or layer. It is the title of the first column.
    """
    from rich.table import Table

    cells = [_cells(each) for each in measurements]
    columns = [name for name in cells[0] if any(row[name] for row in cells)]
    table = Table(kind)
    for name in columns:
        table.add_column(name, no_wrap=name != "what")
    for each, row in zip(measurements, cells, strict=True):
        label = without_controls(each.name if len(each.name) <= 60 else f"{each.name[:40]}…{each.name[-19:]}")
        table.add_row(label, *(row[name] for name in columns))
    return table


def _cells(each: Measurement) -> dict[str, str]:
    return {
        "count": "" if each.count is None else str(each.count),
        "mean, ms": _figure(each.mean_ms),
        "sd": _figure(each.sd_ms),
        "p50": _figure(each.p50_ms),
        "p95": _figure(each.p95_ms),
        "share": "" if each.share is None else f"{100 * each.share:.1f} %",
        "distribution, ms": _distribution(each),
        "on": without_controls(each.hardware),
        "what": without_controls(each.what),
    }


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _distribution(measurement: Measurement) -> str:
    """Return a text that shows the distribution of a measurement from its minimum to its maximum.

    The text is a histogram of the samples. Without samples, the text is a line with marks at p50 and p95. The text is
    empty if minimum or maximum is unknown, or if both are equal.
    """
    low, high = measurement.min_ms, measurement.max_ms
    if low is None or high is None or high <= low:
        return ""
    if measurement.samples_ms:
        counts = [0] * WIDTH
        for ms in measurement.samples_ms:
            counts[min(int((ms - low) / (high - low) * WIDTH), WIDTH - 1)] += 1
        most = max(counts)
        drawn = "".join(BARS[-(-count * (len(BARS) - 1) // most)] for count in counts)
    else:
        marks = {each: "|" for each in (measurement.p50_ms, measurement.p95_ms) if each is not None}
        places = {min(int((at - low) / (high - low) * WIDTH), WIDTH - 1): mark for at, mark in marks.items()}
        drawn = "".join(places.get(place, "-") for place in range(WIDTH))
    return f"{low:.3g} {drawn} {high:.3g}"
