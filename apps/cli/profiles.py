"""`trilane profiles`: list, show, check and fit hardware profiles.

Rule: this module reads options and shows results; every figure comes from `trilane.hw_profiles`.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterable
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.commands import Commands, JsonOption
from trilane.apps.cli.console import print_json, print_line, stderr_console, stdout_console, without_controls
from trilane.errors import BadInputError
from trilane.files import read_text
from trilane.hw_profiles.schema import SHARE_TEXT
from trilane.writing import WRITABLE, write_bytes

if TYPE_CHECKING:
    from trilane.hw_profiles.calibrate import Calibrated, CheckedRow
    from trilane.hw_profiles.fit import ProfileFit

app = Commands(no_args_is_help=True, help="Hardware profiles.")

NOT_KNOWN = (
    "A roofline knows how much work there is and how fast the chip can do it. It does not know which kernel the "
    "runtime picks, how tensors fall into caches and tiles, or how warm the device was: on the GPU, rows of one "
    "network stray by a fifth from any smooth law, and a number that one row alone determines is as good as that row."
)


@app.command("list", epilog="\b\nExamples:\n  trilane profiles list\n  trilane profiles list --json")
def list_profiles(json: JsonOption = False) -> None:
    """List the bundled profiles."""
    from rich.table import Table

    from trilane.hw_profiles.profile_files import load_profile, profile_names

    known = [(name, load_profile(name)) for name in profile_names()]
    rows = [
        {"name": n, "title": p.title, "units": {u: x.title for u, x in p.units.items()}}
        for n, p in known
        if not p.template
    ]
    if json:
        print_json({"profiles": rows})
        return
    table = Table("profile", "chip", "gpu", "dsp")
    for row in rows:
        units: Any = row["units"]
        table.add_row(str(row["name"]), str(row["title"]), units["gpu"], units["dsp"])
    stdout_console().print(table)


@app.command(epilog="\b\nExamples:\n  trilane profiles show snapdragon-888\n  trilane profiles show mine.toml --json")
def show(
    name: Annotated[str, typer.Argument(help="A profile's name or a TOML file.")],
    json: JsonOption = False,
) -> None:
    """Show every number of a profile with its kind and source."""
    from rich.table import Table

    from trilane.hw_profiles.profile_files import load_profile

    profile = load_profile(name)
    if json:
        print_json(profile.model_dump(mode="json"))
        return
    table = Table("key", "value", "± %", "kind", "source", title=profile.title)
    for key, number in _quantities(profile.model_dump(), ""):
        value = "unknown" if number["value"] is None else f"{number['value']:g}"
        spread = "" if number["spread"] is None else f"{100 * number['spread']:.0f}"
        table.add_row(key, value, spread, number["kind"], number["source"])
    stdout_console().print(table)


def _quantities(data: Any, key: str) -> list[tuple[str, dict[str, Any]]]:
    if not isinstance(data, dict):
        return []
    if "kind" in data and "source" in data:
        return [(key, data)]
    return [number for name, value in data.items() for number in _quantities(value, f"{key}.{name}".lstrip("."))]


@app.command(epilog="\b\nExamples:\n  trilane profiles check\n  trilane profiles check mine.toml")
def check(
    names: Annotated[
        list[str] | None, typer.Argument(help="Profiles or TOML files; all bundled ones if not given.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Check profiles: their keys and ranges, and published latencies that they should reproduce."""
    from rich.table import Table

    from trilane.hw_profiles.fit_engines import check_published
    from trilane.hw_profiles.profile_files import load_profile, profile_names

    profiles = {name: load_profile(name) for name in names or profile_names()}
    latencies = [row for profile in profiles.values() for row in check_published(profile.name, profile)]
    if json:
        print_json({"valid": list(profiles), "published": [{**row._asdict(), "error": row.error} for row in latencies]})
        return
    console = stdout_console()
    console.print(f"{len(profiles)} valid: {', '.join(profiles)}")
    if not latencies:
        return
    table = Table("profile", "network", "runtime", "published, ms", "predicted, ms", "error", "")
    for row in latencies:
        note = "" if row.independent else "among the rows of the fit"
        figures = (f"{row.published_ms:g}", f"{row.predicted_ms:.2f}", f"{100 * row.error:+z.0f} %")
        table.add_row(row.profile, row.network, row.runtime, *figures, note)
    console.print(table)


@app.command(
    epilog="\b\nExamples:\n  trilane profiles fit --from ../shared/data/snapdragon888_measured.csv\n"
    "  trilane profiles fit --from rows.csv --profile mine.toml --name mine-fitted --write mine-fitted.toml\n"
    "  trilane profiles fit --from times.csv --profile snapdragon-8-gen-2 --name my-chip --write my-chip.toml"
)
def fit(
    source: Annotated[Path, typer.Option("--from", help="CSV of measured rows (docs/predict.md).")],
    profile: Annotated[
        str | None, typer.Option(help="Profile whose numbers are the priors; if not given, one of the 888.")
    ] = None,
    name: Annotated[
        str | None,
        typer.Option(help="Name of the fitted profile. If not given, the name of the written file, or snapdragon-888."),
    ] = None,
    write: Annotated[Path | None, typer.Option(help="Write the fitted profile here.")] = None,
    networks: Annotated[Path | None, typer.Option(help="Folder of the networks; if none, the CSV's folder.")] = None,
    json: JsonOption = False,
) -> None:
    """Fit a profile to measured rows; print how well it predicts left-out rows.

    A CSV with the columns `network, ms` fits the numbers of a chip's profile. To predict a row, the fit leaves out all
    rows of the same network. A CSV of the reference networks fits the efficiencies of the units. To predict a
    measurement, the fit leaves out only this measurement.
    """
    from trilane.hw_profiles.calibrate import calibrate, is_own_table, read_own_rows
    from trilane.hw_profiles.fit import as_toml, fit_profile

    own = is_own_table(source)
    stem = "calibrated" if write is None else re.sub(r"[^\w.-]", "-", write.stem)[:64]
    usual = ("snapdragon-888", stem) if own else ("snapdragon-888-facts", "snapdragon-888")
    base, named = (other if asked is None else asked for asked, other in zip((profile, name), usual, strict=True))
    if not re.fullmatch(r"[\w.-]{1,64}", named):
        raise BadInputError("--name", repr(named), "letters, digits, dots, hyphens and underscores")
    if write is not None and not write.absolute().parent.is_dir():
        raise BadInputError(write, "no such folder", WRITABLE)
    with stderr_console().status(f"fitting, each {'network' if own else 'measurement'} left out in turn"):
        result = calibrate(base, read_own_rows(source, networks or source.parent)) if own else fit_profile(base, source)
    if json:
        print_json(_document(result))
    else:
        _show(result)
    if write is None:
        return
    head = {"extends": _beside(base, write), "name": named, "title": _title(result, named)}
    count = _counted(result)
    write_bytes(write, as_toml(result.numbers, head, f"trilane profiles fit --from {source}", count).encode())
    if not json:
        for line in (f"written: {write}", *_next_command(result, write, networks or source.parent)):
            print_line(without_controls(line))


def _next_command(result: ProfileFit | Calibrated, profile: Path, networks: Path) -> list[str]:
    """Return a list with one line: the command that predicts the network of the first measured row.

    The list is empty if the rows are of the reference networks. `result`: result of the fit. `profile`: file of the
    fitted profile. `networks`: folder of the networks.
    """
    from trilane.hw_profiles.calibrate import network_file
    from trilane.hw_profiles.fit import ProfileFit

    if isinstance(result, ProfileFit):
        return []
    row = result.rows[0].row
    words = ["--network", str(network_file(row.place, row.network, networks)), "--profile", str(profile)]
    words += ["--precision", {"int8": "w8a8", "fp16": "float"}.get(row.precision, row.precision)]
    words += [] if row.runtime == "tflite" else ["--runtime", row.runtime]
    words += [] if row.unit == "dsp" else ["--unit", row.unit]
    return [f"predict: trilane predict {shlex.join(words)}"]


def _beside(base: str, write: Path) -> str:
    """Return the value of `extends` for the profile `base`: a name, or a path relative to the folder of `write`."""
    return os.path.relpath(base, write.absolute().parent) if base.endswith(".toml") else base


def _title(result: ProfileFit | Calibrated, named: str) -> str:
    from trilane.hw_profiles.fit import ProfileFit

    title: str = result.data["title"]
    fitted = isinstance(result, ProfileFit)
    return title.removesuffix(", before the fit") if fitted else f"{named}: own measurements, from {title}"


def _counted(result: ProfileFit | Calibrated) -> str:
    from trilane.hw_profiles.fit import ProfileFit

    if not isinstance(result, ProfileFit):
        return f"{len(result.rows)} own measurements"
    return f"{result.free_count} numbers from {len(result.residuals)} measurements"


@app.command(
    "fit-chips",
    epilog="\b\nExamples:\n  trilane profiles fit-chips ../shared/data/chips\n"
    "  trilane profiles fit-chips ../shared/data/chips --write hw_profiles --table docs/predict.md",
)
def fit_chips(
    folder: Annotated[Path, typer.Argument(help="Folder with chip_rows.csv, networks.csv and networks/.")],
    write: Annotated[Path | None, typer.Option(help="Folder of profiles, which receive the numbers.")] = None,
    table: Annotated[Path | None, typer.Option(help="Markdown file in which the table of errors is renewed.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Picture to write: predicted times over published times.")] = None,
) -> None:
    """Fit tensor engines to published latencies: shared terms, six numbers a chip, and how far off both are."""
    from trilane.hw_profiles.engine_study import as_markdown, plot_errors, profile_texts, study_engines, with_table

    with stderr_console().status("fitting, a fifth of the networks left out in turn"):
        study = study_engines(folder)
    texts = profile_texts(study, write, f"profiles fit-chips {folder}") if write is not None else {}
    if table is not None:
        texts[table] = with_table(read_text(table, "a file in Markdown"), as_markdown(study), table)
    for path, text in texts.items():
        write_bytes(path, text.encode())
    if plot is not None:
        plot_errors(study, plot)
    stdout_console().print(as_markdown(study))


def _document(result: ProfileFit | Calibrated) -> dict[str, Any]:
    from trilane.hw_profiles.fit import ProfileFit

    return _fit_document(result) if isinstance(result, ProfileFit) else _calibrated_document(result)


def _show(result: ProfileFit | Calibrated) -> None:
    from trilane.hw_profiles.fit import ProfileFit

    if isinstance(result, ProfileFit):
        _show_fit(result)
    else:
        _show_calibrated(result)


def _calibrated_document(result: Calibrated) -> dict[str, Any]:
    return {
        "measurements": len(result.rows),
        "median_error_before": _median_error(each.error_before for each in result.rows),
        "median_error_left_out": _median_error(each.error_after for each in result.rows),
        "notes": result.notes,
        "numbers": {key: {"value": v, "spread": s} for key, (v, s) in result.numbers.items()},
        "rows": [
            {
                "row": each.row.place,
                "network": each.row.network,
                "unit": each.row.unit,
                "measured_ms": each.row.ms,
                "before": _with_interval(each.before_ms, each.before),
                "left_out": _with_interval(each.after_ms, each.after),
            }
            for each in result.rows
        ],
    }


def _median_error(errors: Iterable[float]) -> float:
    return median(map(abs, errors))


def _with_interval(ms: float, around: Any) -> dict[str, float]:
    return {"ms": ms, "low_ms": around.low_ms, "high_ms": around.high_ms}


def _show_calibrated(result: Calibrated) -> None:
    from rich.table import Table

    console = stdout_console()
    title = f"each row predicted from the rows of other networks; {SHARE_TEXT} intervals"
    table = Table("network", "unit", "measured, ms", "before, ms", "error", "left out, ms", "error", title=title)
    for each in result.rows:
        table.add_row(*_cells(each))
    console.print(table)
    before, after = (_median_error(getattr(row, key) for row in result.rows) for key in ("error_before", "error_after"))
    console.print(f"median error: {100 * before:.0f} % before, {100 * after:.0f} % on rows left out")
    for text in result.notes:
        print_line(without_controls(f"note: {text}"))
    numbers = Table("number", "value", "± %")
    for key, (value, spread) in result.numbers.items():
        numbers.add_row(key, f"{value:.4g}", f"{100 * spread:.0f}")
    console.print(numbers)


def _cells(each: CheckedRow) -> tuple[str, ...]:
    predictions = (
        cell
        for ms, around, error in (
            (each.before_ms, each.before, each.error_before),
            (each.after_ms, each.after, each.error_after),
        )
        for cell in (f"{ms:.3g} ({around.low_ms:.3g}-{around.high_ms:.3g})", f"{100 * error:+z.0f} %")
    )
    return (without_controls(each.row.network), each.row.unit, f"{each.row.ms:.4g}", *predictions)


def _fit_document(result: ProfileFit) -> dict[str, Any]:
    return {
        "free_numbers": result.free_count,
        "measurements": len(result.residuals),
        "medians": {
            c: {"error": result.median_error(c), "left_out_error": result.median_error(c, left_out=True)}
            for c in result.columns
        },
        "numbers": {key: {"value": v, "spread": s} for key, (v, s) in result.numbers.items()},
        "residuals": [
            {
                "row": r.row.place,
                "column": r.column,
                "measured_ms": r.measured_ms,
                "fitted_ms": r.fitted_ms,
                "error": r.error,
                "left_out_error": r.left_out_error,
            }
            for r in result.residuals
        ],
        "note": NOT_KNOWN,
    }


def _show_fit(result: ProfileFit) -> None:
    from rich.table import Table

    console = stdout_console()
    table = Table("network", "measured", "ms", "fitted, ms", "error", "left out")
    for r in result.residuals:
        s = r.row.spec
        network = f"{s.encoder} {s.norm} {s.height} {s.channels} {s.layout}"
        errors = (f"{100 * r.error:+z.1f} %", f"{100 * r.left_out_error:+z.1f} %")
        table.add_row(network, r.column, f"{r.measured_ms:.1f}", f"{r.fitted_ms:.1f}", *errors)
    console.print(table)
    medians = Table("median of absolute errors", "fitted", "left out")
    for column in result.columns:
        both = (result.median_error(column), result.median_error(column, left_out=True))
        medians.add_row(column, *(f"{100 * value:.1f} %" for value in both))
    console.print(medians)
    numbers = Table("number", "value", "± %")
    for key, (value, spread) in result.numbers.items():
        numbers.add_row(key, f"{value:.4g}", f"{100 * spread:.0f}")
    console.print(numbers)
    console.print(f"{result.free_count} free numbers, {len(result.residuals)} measurements. {NOT_KNOWN}")
