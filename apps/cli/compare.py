"""`trilane compare`: runs, reports and predictions beside each other, a verdict with its uncertainty, and a gate.

Rule: this module reads options and shows; every figure comes from `trilane.apps.compare`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.commands import Commands, JsonOption
from trilane.apps.cli.console import print_json, print_kept, stderr_console, without_controls
from trilane.errors import BadInputError

if TYPE_CHECKING:
    from rich.table import Table

    from trilane.apps.compare.comparison import Comparison
    from trilane.apps.compare.gate import Gate, Judged

app = Commands()

EPILOG = """\b
Examples:
  trilane compare runs/before runs/after
  trilane compare runs/a1,runs/a2,runs/a3 runs/b1,runs/b2,runs/b3
  trilane compare runs/base runs/one runs/two --all
  trilane compare before.json after.json --json
  trilane compare runs/before runs/after --html difference.html
  trilane compare runs/main runs/branch --fail-if slower=5% --fail-if psnr=0.5dB
  trilane compare runs/main runs/branch --fail-if slower=5% --github
  trilane compare sweeps/main sweeps/branch

\b
Limits of --fail-if: slower, frame-time, frame-time-p99, latency, latency-p99,
  instructions, cpu and lost in %, psnr and worst-psnr in dB

\b
Exit codes with --fail-if:
  0 no limit is broken, 1 one surely is, 4 it cannot be told;
  without it 0; 2 wrong usage or bad input
"""
BROKEN, CANNOT_TELL = 1, 4

BaseArgument = Annotated[
    str,
    typer.Argument(
        metavar="BASE", help="A run folder, its report.json, a prediction, imported times, or a sweep's folder."
    ),
]
OthersArgument = Annotated[
    list[str], typer.Argument(metavar="OTHER", help="Runs to compare with the base. Runs of one kind: A1,A2,A3.")
]
HtmlOption = Annotated[Path | None, typer.Option("--html", help="File for a page of HTML that needs no other file.")]
AllOption = Annotated[bool, typer.Option("--all", help="Show every figure, not only those that differ.")]
FailIfOption = Annotated[
    list[str] | None,
    typer.Option(
        "--fail-if",
        help="Limit, such as slower=5%. Exit code 1: surely broken; 4: undecided. May be given again.",
    ),
]
SlowerOption = Annotated[
    str | None,
    typer.Option("--fail-if-slower", help="The old name of --fail-if slower=LIMIT; the next version removes it."),
]
GithubOption = Annotated[
    bool,
    typer.Option("--github", help="Write annotations for GitHub, and a summary to the file of GITHUB_STEP_SUMMARY."),
]


@app.command(epilog=EPILOG)
def compare(
    base: BaseArgument,
    others: OthersArgument,
    html: HtmlOption = None,
    show_all: AllOption = False,
    fail_if: FailIfOption = None,
    fail_if_slower: SlowerOption = None,
    github: GithubOption = False,
    json: JsonOption = False,
) -> None:
    """Say what differs between runs, by how much, how sure that is, and the likely cause.

    Each figure of OTHER stands beside the figure of BASE, with a 95 % interval. With --fail-if the command is a gate.
    Exit code 0 means no worse, 1 worse, and 4 undecided. With 4, the output says how many runs are needed.
    A disturbed run never passes. In two sweeps, trials of equal configuration are compared.
    docs/compare.md explains the method.
    """
    gates = _gates(fail_if or [], fail_if_slower)
    if github and not gates:
        raise BadInputError("options", "--github without a limit", "--fail-if too, such as --fail-if slower=5%")
    if _are_sweeps([base, *others]):
        shown, document, judged = _of_sweeps(base, others, html, show_all, gates)
    else:
        shown, document, judged = _of_runs(base, others, html, show_all, gates)
    if github:
        from trilane.apps.cli.github import write_to_github

        write_to_github(judged, document["verdict"])
    _say(judged)
    if json:
        with suppress(BrokenPipeError):  # the gate has the exit code
            print_json(document)
    else:
        print_kept(shown)
    _leave(judged)


_Answer = tuple[Iterator["str | Table"], dict[str, Any], list["Judged"]]


def _of_runs(base: str, others: list[str], html: Path | None, show_all: bool, gates: Sequence[Gate]) -> _Answer:
    from trilane.apps.cli.compare_table import comparison_lines
    from trilane.apps.compare.comparison import compare as compared
    from trilane.apps.compare.comparison import document
    from trilane.apps.compare.gate import Pair, as_json, judge
    from trilane.apps.compare.sides import read_side

    comparisons = compared(read_side(base), [read_side(other) for other in others])
    if html is not None:
        _write_page(html, comparisons)
    judged = judge(
        gates, [Pair(each.other.name, each.base, each.other, each.rows, each.changes) for each in comparisons]
    )
    shown = (part for comparison in comparisons for part in comparison_lines(comparison, show_all))
    return shown, {**document(comparisons), **(as_json(judged) if gates else {})}, judged


def _of_sweeps(base: str, others: list[str], html: Path | None, show_all: bool, gates: Sequence[Gate]) -> _Answer:
    from trilane.apps.cli.compare_table import sweep_lines
    from trilane.apps.compare.compared_sweeps import compare_sweeps
    from trilane.apps.compare.gate import as_json, judge

    if len(others) > 1:
        raise BadInputError("compare", f"{1 + len(others)} sweeps", "two")
    if html is not None:
        remedy = f"`trilane report {base} {others[0]}` draws both on one page"
        raise BadInputError("options", "--html with sweeps", "runs", remedy)
    comparison = compare_sweeps(base, others[0])
    judged = judge(gates, [pair.sides for pair in comparison.pairs])
    shown = sweep_lines(comparison, show_all)
    return shown, {**comparison.as_json(), **(as_json(judged) if gates else {})}, judged


def _gates(asked: Sequence[str], slower: str | None) -> list[Gate]:
    from trilane.apps.compare.gate import read_gate

    old = [] if slower is None else [read_gate(f"slower={slower}", "--fail-if-slower")]
    found = [*map(read_gate, asked), *old]
    names = [gate.name for gate in found]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise BadInputError("--fail-if", f"{twice} twice", "each metric once")
    return found


def _say(judged: Sequence[Judged]) -> None:
    """Say what each limit came to."""
    several = len({each.name for each in judged}) > 1
    for each in judged:
        said = without_controls(f"{each.name}: {each.said}" if several else each.said)
        stderr_console().print(said, soft_wrap=True, markup=False)


def _leave(judged: Sequence[Judged]) -> None:
    """Leave with the exit code of the gate."""
    from trilane.apps.compare.gate import Outcome, whole

    codes = {Outcome.KEPT: 0, Outcome.BROKEN: BROKEN, Outcome.UNKNOWN: CANNOT_TELL}
    if code := codes[whole(judged)]:
        raise typer.Exit(code)


def _are_sweeps(names: list[str]) -> bool:
    """Say whether all names are sweeps. Raises BadInputError for sweeps beside something else."""
    from trilane.apps.compare.compared_sweeps import is_sweep

    sweeps = [name for name in names if is_sweep(name)]
    if sweeps and len(sweeps) < len(names):
        other = next(name for name in names if name not in sweeps)
        raise BadInputError(other, f"no sweep, beside {sweeps[0]}, which is one", "two sweeps, or runs alone")
    return bool(sweeps)


def _write_page(path: Path, comparisons: list[Comparison]) -> None:
    from trilane.apps.compare.page import page
    from trilane.writing import write_bytes

    write_bytes(path, page(comparisons).encode(), "choose another --html")
    stderr_console().print(f"page: {path}", soft_wrap=True, markup=False)
