"""`trilane report`: runs, predictions and sweeps in one page, with what each speed costs in image error.

Rule: this module reads options and writes files; the rows come from `trilane.apps.compare`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.commands import Commands, JsonOption
from trilane.apps.cli.console import print_json, stderr_console, stdout_console
from trilane.errors import BadInputError

if TYPE_CHECKING:
    from trilane.apps.compare.overview import Entry

app = Commands()

EPILOG = """\b
Examples:
  trilane report runs
  trilane report runs/a runs/b --out a-and-b.html
  trilane report sweeps/sizes --csv sizes.csv --parquet sizes.parquet
  trilane report runs prediction.json --json
"""
SHOWN = (
    *("name", "verdict", "bound", "trust", "other_programs", "frame_ms", "low_ms", "high_ms"),
    *("psnr_db", "worst_psnr_db", "p1_psnr_db", "on_frontier", "error_source"),
)

PlacesArgument = Annotated[
    list[Path],
    typer.Argument(metavar="DIR...", help="Run folders, sweeps' folders, folders of these, saved predictions."),
]
OutOption = Annotated[Path, typer.Option(help="The page to write.")]
TitleOption = Annotated[str, typer.Option(help="Heading of the page.")]
CsvOption = Annotated[Path | None, typer.Option("--csv", help="Write the table as CSV too.")]
ParquetOption = Annotated[Path | None, typer.Option("--parquet", help="Write the table as Parquet too (extra table).")]


@app.command(epilog=EPILOG)
def report(
    places: PlacesArgument,
    out: OutOption = Path("report.html"),
    title: TitleOption = "Runs and trials",
    csv: CsvOption = None,
    parquet: ParquetOption = None,
    json: JsonOption = False,
) -> None:
    """Write one page of many runs, predictions and trials, with the frontier of frame time against error.

    The page is one self-contained file. It has a table to sort and filter, pictures to lay over each other, the
    machines, and the command of each entry. An error comes from the run itself (`run --check`), else from its avatar's
    validation; the table names the source.
    """
    from trilane.apps.compare.overview import read_entries, table_rows, write_csv, write_parquet
    from trilane.apps.compare.overview_page import page
    from trilane.writing import require_writable, write_bytes

    targets = [target for target in (out, csv, parquet) if target is not None]
    if len(set(targets)) < len(targets):
        raise BadInputError("options", f"{targets[-1]} twice", "a file of its own for each")
    entries = read_entries(places)
    for target in targets:
        require_writable(target)
    if csv is not None:
        write_csv(csv, entries)
    if parquet is not None:
        write_parquet(parquet, entries)
    with stderr_console().status("the page"):
        write_bytes(out, page(title, entries).encode(), "choose another --out")
    rows = table_rows(entries)
    if json:
        print_json({"schema": 1, "entries": rows, "files": [str(target) for target in targets]})
    else:
        _print(entries, rows)
    stderr_console().print("written: " + ", ".join(map(str, targets)), soft_wrap=True, markup=False)


def _print(entries: list[Entry], rows: list[dict[str, Any]]) -> None:
    from rich.table import Table
    from rich.text import Text

    from trilane.apps.compare.overview import told_choices

    times, errors = ("frame, ms", "from, ms", "to, ms"), ("PSNR, dB", "worst", "1st pct.")
    table = Table(
        "entry", "verdict", "bound", "trust", "others", *times, *errors, "frontier", "where the error comes from"
    )
    for row in rows:
        share = row["other_programs"]
        shown = row | {"other_programs": None if share is None else f"{100 * share:.1f} %"}
        table.add_row(*(Text(_shown(shown[key])) for key in SHOWN))
    stdout_console().print(table)
    for sentence in told_choices(entries):
        stdout_console().print(sentence, soft_wrap=True, markup=False)
    for entry in entries:
        if entry.failure:
            stdout_console().print(f"{entry.name}: {entry.failure}", soft_wrap=True, markup=False)


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else ""
    return f"{value:.2f}" if isinstance(value, float) else "" if value is None else str(value)
