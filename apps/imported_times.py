"""Makes the results of `trilane times`: a document, a CSV, a pipeline file with a measured time, or a row for a fit.

    reads = [read_measurements(path) for path in paths]
    document(reads)
    stage_text(Path("street.toml"), "seg", read, "RPC (execute) time")

Rule: no file is written here. A function that returns the text of a file first runs the checks of that file's reader.
"""

from __future__ import annotations

import csv
import io
import os
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from trilane.errors import BadInputError, MissingPartError, did_you_mean
from trilane.files import read_text
from trilane.hw_profiles.calibrate import fit_row
from trilane.pipeline.measurements.measurement import Measurement, Measurements
from trilane.pipeline.measurements.read_file import OWN_COLUMNS, chosen
from trilane.pipeline.pipeline_file import checked_tables, tables_of, time_of

#: Largest number of samples that a pipeline file gets.
MOST_WRITTEN: Final = 10_000
#: Columns of the rows for `trilane profiles fit`.
FIT_COLUMNS: Final = ("network", "ms", "unit", "precision", "runtime", "source")
#: Column of a fit's row -> option of `trilane times` that sets this column.
OPTION_OF: Final = {"unit": "--hardware", "precision": "--precision", "runtime": "--runtime"}
#: Word for the hardware in another tool's file -> unit of a hardware profile.
UNIT_OF_WORD: Final = {
    "CPU": "cpu", "XNNPACK": "cpu", "GPU": "gpu", "NPU": "dsp", "HTP": "dsp", "DSP": "dsp", "HEXAGON": "dsp",
}  # fmt: skip


def document(reads: Sequence[Measurements]) -> dict[str, Any]:
    """Return the document of `trilane times --json`: the files, their measurements and the refused rows.

    The document has the keys `files`, `measurements` and `refused`; each value is a list of mappings.
    """
    return {
        "files": [
            {
                "file": str(read.path),
                "tool": read.tool,
                "says": read.says,
                "refused": read.refused_count,
                "skipped": dict(read.skipped),
            }
            for read in reads
        ],
        "measurements": [each.document() | {"file": str(read.path)} for read in reads for each in read.measurements],
        "refused": [each._asdict() | {"file": str(read.path)} for read in reads for each in read.refused],
    }


def samples_csv(reads: Sequence[Measurements]) -> str:
    """Return a CSV with a row for each sample of each measurement. `trilane times` can read this CSV.

    The columns are `OWN_COLUMNS`; the column `sample` counts the samples of a measurement from 0.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(OWN_COLUMNS)
    for read in reads:
        for each in read.measurements:
            writer.writerows([each.name, each.kind, each.unit, n, ms] for n, ms in enumerate(each.samples_ms))
    return text.getvalue()


def one_of(reads: Sequence[Measurements], name: str) -> tuple[Measurements, Measurement]:
    """Return the file that has the measurement `name`, and this measurement.

    `reads`: files to search.
    `name`: name of the measurement; empty for the only run of the only file.
    Raises BadInputError if no file or several files have the measurement, or if the measurement cannot be a service
    time. For an empty name, raises BadInputError for several files or several runs.
    """
    holding = [read for read in reads if any(each.name == name for each in read.measurements)] if name else reads
    if not holding:
        known = [each.name for read in reads for each in read.measurements]
        shown = ", ".join(map(repr, known[:8])) + (" …" if len(known) > 8 else "")
        raise BadInputError("--name", f"the unknown measurement {name!r}", f"one of {shown}", did_you_mean(name, known))
    if len(holding) > 1:
        raise BadInputError("FILE", f"{len(holding)} files with such a time", "one", "give the one that is meant")
    return holding[0], chosen(holding[0], name, "--name")


def stage_text(path: Path, stage: str, read: Measurements, measurement: Measurement) -> str:
    """Return the text of the pipeline file `path`, with `measurement` as the `time_ms` of the stage `stage`.

    All else in the file stays, including comments. The stage may have no time in the old file, because only the new
    text is checked.
    `read`: measurements of the file that contains `measurement`.
    Raises BadInputError for an unknown stage, too many samples or a wrong pipeline file, MissingPartError without
    tomlkit.
    """
    try:
        import tomlkit
    except ImportError:
        raise MissingPartError("writing into a pipeline file needs tomlkit", extra="edit") from None
    before = tables_of(path)
    stages = before.get("stages")
    if not isinstance(stages, dict) or not all(isinstance(each, dict) for each in stages.values()):
        checked_tables(before, path)  # its error names the fault
    elif stage not in stages:
        expected = f"one of {', '.join(stages)}"
        raise BadInputError(f"{path}: stages", f"no stage {stage!r}", expected, did_you_mean(stage, stages))
    tables = tomlkit.parse(read_text(path, "a pipeline file"))
    tables["stages"][stage]["time_ms"] = _as_toml(path, read, measurement)
    text: str = tomlkit.dumps(tables)
    checked_tables(tomllib.loads(text), path)
    return text


def _as_toml(path: Path, read: Measurements, measurement: Measurement) -> Any:
    """Return `measurement` as an inline table for `time_ms`. Raises BadInputError for too many samples.

    If the measured file is in the folder of the pipeline file `path` or below, the table names the measured file.
    Otherwise, the table contains the samples or, without samples, the mean and a known standard deviation.
    """
    import tomlkit

    inside = Path(os.path.relpath(read.path.absolute(), path.absolute().parent))
    time, table = time_of(measurement), tomlkit.inline_table()
    values: Mapping[str, object]
    if inside.parts[0] != os.pardir:
        values = {"from": inside.as_posix(), "name": measurement.name}
    elif len(time.samples) > MOST_WRITTEN:
        remedy = f"put {read.path.name} beside {path.name}: the file then names it"
        raise BadInputError(read.path, f"{len(time.samples)} samples", f"at most {MOST_WRITTEN} to write out", remedy)
    elif time.samples:
        values = {"samples": [_rounded(ms) for ms in time.samples]}
    else:
        values = {"mean": _rounded(time.mean_ms)} | ({"sd": _rounded(time.sd)} if time.sd else {})
    table.update(values)
    return table


def _rounded(ms: float) -> float:
    """Return `ms` rounded to six significant digits, because no measurement is more exact."""
    return float(f"{ms:.6g}")


def with_row(
    path: Path, read: Measurements, measurement: Measurement, network: str | None, asked: Mapping[str, str | None]
) -> tuple[str, list[str]]:
    """Return the text of the CSV table `path` with one more row, and lines for people about the new row.

    The row contains the measurement's median in ms, or its mean if the median is unknown. The lines state the values,
    and whether each value comes from the measured file or is assumed. The file `path` need not exist.
    `read`: measurements of the file that contains `measurement`.
    `network`: path of the network, relative to the folder of the table.
    `asked`: value for each column in OPTION_OF. For None, the column `unit` gets the unit that the measured file names.
    Without such a unit, and in other columns, None means the fit's default.
    Raises BadInputError for the time of a layer, for a table with other columns, for a missing network and for an
    unknown value.
    """
    if measurement.kind == "layer":
        runs = [repr(each.name) for each in read.measurements if each.kind == "run"]
        remedy = f"--name is one of {', '.join(runs)}" if runs else f"{read.path.name} has no run"
        raise BadInputError("--name", f"{measurement.name!r}, {measurement.what}", "the time of a whole run", remedy)
    told = {"unit": _unit_told(read, measurement)}
    row = fit_row(path, network, **{column: word or told.get(column) for column, word in asked.items()})
    before = read_text(path, "a table of rows for the fit") if path.exists() else ",".join(FIT_COLUMNS) + "\n"
    header = next(csv.reader(before.splitlines()[:1]))
    if tuple(header) != FIT_COLUMNS:
        raise BadInputError(path, f"the columns {', '.join(header)}", ", ".join(FIT_COLUMNS))
    text = io.StringIO()
    ms = _rounded(time_of(measurement).mean_ms if measurement.p50_ms is None else measurement.p50_ms)
    source = f"{read.path.name}: {measurement.name}"
    csv.writer(text, lineterminator="\n").writerow([row.network, ms, *row[1:], source])
    words = row._asdict()
    lines = [f"row: {row.network}, {ms:g} ms, " + ", ".join(f"{column} {words[column]}" for column in OPTION_OF)]
    silent = [column for column, word in asked.items() if not word]
    lines += [f"{read.path.name} says: {column} {words[column]}" for column in silent if told.get(column)]
    assumed = [f"{column} ({OPTION_OF[column]})" for column in silent if not told.get(column)]
    lines += [f"assumed, as {read.path.name} does not say it: {', '.join(assumed)}"] if assumed else []
    return before.rstrip("\n") + "\n" + text.getvalue(), lines


def _unit_told(read: Measurements, measurement: Measurement) -> str | None:
    """Return the unit of a hardware profile on which `measurement` ran, as the measured file names it.

    If the measurement itself names no hardware, the hardware of all layers in the file decides. None is returned if the
    file does not name exactly one unit.
    """
    layers = [each.hardware for each in read.measurements if each.kind == "layer"]
    named = [measurement.hardware] if measurement.hardware else layers
    units = [{unit for word, unit in UNIT_OF_WORD.items() if word in each.upper()} for each in named]
    return units[0].pop() if units and len(units[0]) == 1 and all(each == units[0] for each in units) else None
