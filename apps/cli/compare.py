"""`trilane compare`: runs, reports and predictions beside each other, and a verdict with its uncertainty.

Rule: this module reads options and shows; every figure comes from `trilane.apps.compare`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trilane.apps.cli.commands import Commands, JsonOption
from trilane.apps.cli.console import print_json, stderr_console, stdout_console
from trilane.errors import BadInputError

if TYPE_CHECKING:
    from trilane.apps.compare.comparison import Comparison
    from trilane.apps.compare.difference import Finding

app = Commands()

EPILOG = """\b
Examples:
  trilane compare runs/before runs/after
  trilane compare runs/a1,runs/a2,runs/a3 runs/b1,runs/b2,runs/b3
  trilane compare runs/base runs/one runs/two --all
  trilane compare before.json after.json --json
  trilane compare runs/before runs/after --html difference.html
  trilane compare runs/main runs/branch --fail-if-slower 5%
  trilane compare sweeps/main sweeps/branch
"""
SLOWER, CANNOT_TELL = 1, 3
MORE = "more runs of each kind (A1,A2,A3), longer ones, or a machine without other programs tell more"

BaseArgument = Annotated[
    str, typer.Argument(metavar="BASE", help="A run folder, its report.json, a prediction, or a sweep's folder.")
]
OthersArgument = Annotated[
    list[str], typer.Argument(metavar="OTHER", help="Runs to compare with the base. Runs of one kind: A1,A2,A3.")
]
HtmlOption = Annotated[Path | None, typer.Option("--html", help="Write a page that needs nothing else here.")]
AllOption = Annotated[bool, typer.Option("--all", help="Show every figure, not only those that differ.")]
SlowerOption = Annotated[
    str | None,
    typer.Option(
        "--fail-if-slower",
        help="Exit with 1 if frames certainly take longer by more than this, such as 5%; with 3 if uncertain.",
    ),
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

    Every figure of OTHER is shown beside that of BASE with a 95 % interval. The exit code is 0 even if the runs differ
    or the difference is uncertain. With --fail-if-slower it is 1 if frames certainly take longer by more than that, and
    3 if this is uncertain. Two sweeps are compared by trials of equal configuration. docs/compare.md explains the
    method.
    """
    limit = _share(fail_if_slower)
    if _are_sweeps([base, *others]):
        _compare_sweeps(base, others, html, show_all, limit, json)
        return
    from trilane.apps.cli.compare_table import comparison_lines
    from trilane.apps.compare.comparison import compare as compared
    from trilane.apps.compare.comparison import document
    from trilane.apps.compare.sides import read_side

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
    _leave(limit, [comparison.slower_than(limit) for comparison in comparisons] if limit is not None else [])


def _leave(limit: float | None, outcomes: Sequence[Finding]) -> None:
    """Leave with the exit code that --fail-if-slower asks for."""
    from trilane.apps.compare.difference import Finding

    if Finding.DIFFERS in outcomes:
        raise typer.Exit(SLOWER)
    if limit is not None and Finding.UNKNOWN in outcomes:
        text = f"cannot tell whether frames take longer by more than {100 * limit:g} %; {MORE}"
        stderr_console().print(text, soft_wrap=True, markup=False)
        raise typer.Exit(CANNOT_TELL)


def _are_sweeps(names: list[str]) -> bool:
    """Say whether all names are sweeps. Raises BadInputError for sweeps beside something else."""
    from trilane.apps.compare.compared_sweeps import is_sweep

    sweeps = [name for name in names if is_sweep(name)]
    if sweeps and len(sweeps) < len(names):
        other = next(name for name in names if name not in sweeps)
        raise BadInputError(other, f"no sweep, beside {sweeps[0]}, which is one", "two sweeps, or runs alone")
    return bool(sweeps)


def _compare_sweeps(
    base: str, others: list[str], html: Path | None, show_all: bool, limit: float | None, json: bool
) -> None:
    from trilane.apps.cli.compare_table import sweep_lines
    from trilane.apps.compare.compared_sweeps import compare_sweeps

    if len(others) > 1:
        raise BadInputError("compare", f"{1 + len(others)} sweeps", "two")
    if html is not None:
        remedy = f"`trilane report {base} {others[0]}` draws both on one page"
        raise BadInputError("options", "--html with sweeps", "runs", remedy)
    comparison = compare_sweeps(base, others[0])
    if json:
        print_json(comparison.as_json())
    else:
        for part in sweep_lines(comparison, show_all):
            stdout_console().print(part, soft_wrap=isinstance(part, str), markup=False)
    _leave(limit, comparison.slower_than(limit) if limit is not None else [])


def _share(text: str | None) -> float | None:
    """Return 0.05 for `5%` and for `5 %`."""
    if text is None:
        return None
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*%", text)
    if found is None:
        raise BadInputError("--fail-if-slower", repr(text), "a percentage such as 5%")
    return float(found[1]) / 100


def _write_page(path: Path, comparisons: list[Comparison]) -> None:
    from trilane.apps.compare.page import page
    from trilane.writing import write_bytes

    write_bytes(path, page(comparisons).encode(), "choose another --html")
    stderr_console().print(f"page: {path}", soft_wrap=True, markup=False)
