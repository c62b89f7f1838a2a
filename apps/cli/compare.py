"""`trilane compare`: runs, reports and predictions beside each other, and a verdict with its uncertainty.

Rule: this module reads options and shows; every figure comes from `trilane.apps.comparison`.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trilane.apps.cli.commands import Commands
from trilane.apps.cli.console import print_json, stderr_console, stdout_console
from trilane.apps.cli.options import JsonOption
from trilane.errors import BadInputError

if TYPE_CHECKING:
    from trilane.apps.comparison.compared import Comparison

app = Commands()

EPILOG = """\b
Examples:
  trilane compare runs/before runs/after
  trilane compare runs/a1,runs/a2,runs/a3 runs/b1,runs/b2,runs/b3
  trilane compare runs/base runs/one runs/two --all
  trilane compare before.json after.json --json
  trilane compare runs/before runs/after --html difference.html
  trilane compare runs/main runs/branch --fail-if-slower 5%
"""
SLOWER = 1

BaseArgument = Annotated[str, typer.Argument(metavar="BASE", help="A run folder, its report.json, or a prediction.")]
OthersArgument = Annotated[
    list[str], typer.Argument(metavar="OTHER", help="What is compared with it. Runs of one kind: A1,A2,A3.")
]
HtmlOption = Annotated[Path | None, typer.Option("--html", help="Write a page that needs nothing else here.")]
AllOption = Annotated[bool, typer.Option("--all", help="Show every figure, not only those that differ.")]
SlowerOption = Annotated[
    str | None,
    typer.Option("--fail-if-slower", help="Exit with 1 where frames surely take longer by more than so much, as 5%."),
]


@app.command(epilog=EPILOG)
def compare(
    base: BaseArgument,
    others: OthersArgument,
    html: HtmlOption = None,
    show_all: AllOption = False,
    fail_if_slower: SlowerOption = None,
    json: JsonOption = False,
) -> None:
    """Say what differs between runs, by how much, how sure that is, and the likely cause.

    Every figure of OTHER stands beside that of BASE with a 95 % interval. Exit code 0 also when they differ.
    docs/compare.md says how it is told.
    """
    limit = _share(fail_if_slower)
    from trilane.apps.cli.compare_table import comparison_lines
    from trilane.apps.comparison.compared import compare as compared
    from trilane.apps.comparison.compared import document
    from trilane.apps.comparison.sides import read_side

    comparisons = compared(read_side(base), [read_side(other) for other in others])
    if html is not None:
        _write_page(html, comparisons)
    if json:
        print_json(document(comparisons))
    else:
        console = stdout_console()
        for comparison in comparisons:
            for part in comparison_lines(comparison, show_all):
                console.print(part, soft_wrap=isinstance(part, str), markup=False)
    if limit is not None and any(comparison.slower > limit for comparison in comparisons):
        raise typer.Exit(SLOWER)


def _share(text: str | None) -> float | None:
    """0.05 for `5%` and for `5 %`."""
    if text is None:
        return None
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*%", text)
    if found is None:
        raise BadInputError("--fail-if-slower", repr(text), "a percentage such as 5%")
    return float(found[1]) / 100


def _write_page(path: Path, comparisons: list[Comparison]) -> None:
    from trilane.apps.comparison.page import page
    from trilane.writing import write_bytes

    write_bytes(path, page(comparisons).encode(), "choose another --html")
    stderr_console().print(f"page: {path}", soft_wrap=True, markup=False)
