"""`trilane compare`: differences between runs, a verdict and a gate. `trilane report`: many runs on one page.

Rule: this module reads options and shows results; every figure comes from `trilane.apps.compare`. The verdict comes
first, followed by its evidence and the uncertain figures.

With `--github`, a gate writes annotations for GitHub and a summary in Markdown. Their formats are described at
docs.github.com, in "Workflow commands for GitHub Actions" and "Adding a job summary". Texts from files are escaped in
annotations and summary, so that no text acts as a command or as Markdown. Annotations go to stderr, which GitHub reads
too. Therefore stdout has one document with `--json`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from trilane.apps.cli.commands import Commands, JsonOption
from trilane.apps.cli.console import (
    print_json,
    print_kept,
    print_line,
    say,
    stderr_console,
    stdout_console,
    without_controls,
)
from trilane.errors import BadInputError
from trilane.scheduler.stats import CONFIDENCE_TEXT

if TYPE_CHECKING:
    from rich.table import Table

    from trilane.apps.compare.compared_sweeps import SweepComparison, TrialPair
    from trilane.apps.compare.comparison import Comparison
    from trilane.apps.compare.gate import Gate, JudgedLimit
    from trilane.apps.compare.overview import Entry
    from trilane.apps.compare.rows import Figure
    from trilane.apps.compare.sides import Change

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
        write_to_github(judged, document["verdict"])
    _say(judged)
    if json:
        with suppress(BrokenPipeError):  # the exit code must say the gate's outcome even if nobody reads the document
            print_json(document)
    else:
        print_kept(shown)
    _leave(judged)


_Answer = tuple[Iterator["str | Table"], dict[str, Any], list["JudgedLimit"]]


def _of_runs(base: str, others: list[str], html: Path | None, show_all: bool, gates: Sequence[Gate]) -> _Answer:
    from trilane.apps.compare.comparison import compare as compared
    from trilane.apps.compare.comparison import document
    from trilane.apps.compare.gate import GatedPair, as_json, judge
    from trilane.apps.compare.sides import read_side

    first, sides = read_side(base), [read_side(other) for other in others]
    comparisons = [compared(first, side) for side in sides]
    if html is not None:
        from trilane.apps.compare.pages import comparison_page
        from trilane.writing import write_bytes

        write_bytes(html, comparison_page(comparisons).encode(), "choose another --html")
        say(f"page: {html}")
    judged = judge(
        gates, [GatedPair(each.other.name, each.base, each.other, each.rows, each.changes) for each in comparisons]
    )
    shown = (part for comparison in comparisons for part in comparison_lines(comparison, show_all))
    return shown, {**document(comparisons), **(as_json(judged) if gates else {})}, judged


def _of_sweeps(base: str, others: list[str], html: Path | None, show_all: bool, gates: Sequence[Gate]) -> _Answer:
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


def _say(judged: Sequence[JudgedLimit]) -> None:
    """Print a line for each limit on stderr: its outcome and the reason. With several runs, the line names the run."""
    several = len({each.name for each in judged}) > 1
    for each in judged:
        say(without_controls(f"{each.name}: {each.said}" if several else each.said))


def _leave(judged: Sequence[JudgedLimit]) -> None:
    """Raise typer.Exit with BROKEN if a limit is broken, or with CANNOT_TELL if a limit is undecided."""
    from trilane.apps.compare.gate import LimitOutcome, whole

    codes = {LimitOutcome.KEPT: 0, LimitOutcome.BROKEN: BROKEN, LimitOutcome.UNKNOWN: CANNOT_TELL}
    if code := codes[whole(judged)]:
        raise typer.Exit(code)


def _are_sweeps(names: list[str]) -> bool:
    """Return whether all `names` are folders of sweeps. Raises BadInputError if only some of them are."""
    from trilane.apps.compare.compared_sweeps import is_sweep

    sweeps = [name for name in names if is_sweep(name)]
    if sweeps and len(sweeps) < len(names):
        other = next(name for name in names if name not in sweeps)
        raise BadInputError(other, f"no sweep, beside {sweeps[0]}, which is one", "two sweeps, or runs alone")
    return bool(sweeps)


#: Measures whose statistics in ALWAYS_STATISTICS are shown even if they do not differ.
ALWAYS = ("frame time", "latency", "instructions", "time of an instruction", "work", "busy")
ALWAYS_STATISTICS = ("mean", "typical", "share")
MOST_CHANGES = 12


def comparison_lines(comparison: Comparison, show_all: bool) -> Iterator[str | Table]:
    """Yield the texts and tables that show `comparison`. `show_all`: whether to show figures that do not differ."""
    from trilane.apps.compare.comparison import METHOD, bounds_text

    yield f"{comparison.other.name} beside {comparison.base.name}"
    yield f"verdict: {comparison.verdict}"
    yield from comparison.unsure
    if said := bounds_text(comparison.bounds):
        yield said
    most = len(comparison.changes) if show_all else MOST_CHANGES
    if comparison.changes:
        yield _change_table(comparison.changes[:most])
    if len(comparison.changes) > most:
        yield f"{len(comparison.changes) - most} more settings changed: --all shows them"
    shown = [figure for figure in comparison.rows if show_all or _is_shown(figure, comparison)]
    yield _figure_table(comparison, shown)
    yield from _left_out(comparison, shown)
    yield from comparison.notes
    yield METHOD


#: Reason for which a configuration of a sweep is not compared -> its text.
LEFT_OUT = {
    "not_done": "not done in both",
    "base_alone": "in the base alone",
    "other_alone": "in the other alone",
}


def sweep_lines(comparison: SweepComparison, show_all: bool) -> Iterator[str | Table]:
    """Yield the texts and tables that show `comparison`, the comparison of two sweeps.

    `show_all`: whether to show all pairs of trials. If False, only pairs that surely differ are shown.
    """
    from trilane.apps.compare.compared_sweeps import METHOD

    yield f"{comparison.other} beside {comparison.base}: {len(comparison.pairs)} trials of equal configuration"
    yield f"verdict: {comparison.verdict}"
    if said := comparison.bound:
        yield said
    if comparison.changes:
        yield _change_table(comparison.changes[:MOST_CHANGES])
    shown = [pair for pair in comparison.pairs if show_all or pair.differs]
    if shown:
        yield _trial_table(shown)
    if left := len(comparison.pairs) - len(shown):
        more = "trial does" if left == 1 else "trials do"
        yield f"{left} more {more} not differ, or it cannot be told: --all shows them"
    for reason, names in comparison.left_out.items():
        if names:
            yield f"{LEFT_OUT[reason]}: {len(names)} ({', '.join(names[:4])}{', ...' * (len(names) > 4)})"
    yield from comparison.notes
    yield METHOD


def _trial_table(pairs: Sequence[TrialPair]) -> Table:
    """Return a table with a row for each pair of trials of equal configuration.

    The columns are the options that vary, both mean frame times in ms, their change, the 95 % interval of the change,
    and the outcome.
    """
    from trilane.apps.compare.comparison import change_of, interval_of, setting
    from trilane.apps.compare.rows import MS

    names = [
        name
        for name in dict.fromkeys(name for pair in pairs for name in pair.options)
        if len({str(pair.options.get(name)) for pair in pairs}) > 1
    ] or ["trial"]
    rows = []
    for pair in pairs:
        row = pair.frame_time
        values = [setting(pair.options.get(name, pair.sides.name)) for name in names]
        figures = (f"{row.base:.4g}", f"{row.other:.4g}", change_of(row, MS), interval_of(row, MS))
        rows.append((*values, *figures, str(pair.outcome)))
    return _table((*names, "base, ms", "other, ms", "change", f"{CONFIDENCE_TEXT} interval", "outcome"), rows)


def _table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    from rich.table import Table

    table = Table(*titles)
    for row in rows:
        table.add_row(*row)
    return table


def _left_out(comparison: Comparison, shown: Sequence[Figure]) -> Iterator[str]:
    """Yield sentences that count the figures left out of the table: figures without difference, and undecided figures.

    `comparison`: comparison of two runs. `shown`: figures in the table.
    """
    from trilane.apps.compare.difference import Finding

    left = [comparison.outcome(figure) for figure in comparison.rows if figure not in shown]
    unknown = left.count(Finding.UNKNOWN)
    if alike := len(left) - unknown:
        yield f"{alike} more {'figure does' if alike == 1 else 'figures do'} not differ: --all shows them"
    if unknown:
        yield f"of {unknown} more {'figure' if unknown == 1 else 'figures'} it cannot be told: --all shows them"


def _is_shown(figure: Figure, comparison: Comparison) -> bool:
    return figure in comparison.differing or (figure.measure in ALWAYS and figure.statistic in ALWAYS_STATISTICS)


def _change_table(changes: Sequence[Change]) -> Table:
    from trilane.apps.compare.comparison import setting

    rows = ((change.key, setting(change.base), setting(change.other)) for change in changes)
    return _table(("changed", "base", "other"), rows)


def _figure_table(comparison: Comparison, figures: list[Figure]) -> Table:
    from trilane.apps.compare.comparison import change_of, interval_of, name_of, value_of

    rows = []
    for figure in figures:
        row, unit = comparison.rows[figure], figure.unit
        values = (value_of(row.base, unit), value_of(row.other, unit), change_of(row, unit), interval_of(row, unit))
        rows.append((name_of(figure), figure.statistic, *values, str(comparison.outcome(figure))))
    return _table(("figure", "statistic", "base", "other", "change", f"{CONFIDENCE_TEXT} interval", "outcome"), rows)


SUMMARY: Final = "GITHUB_STEP_SUMMARY"
#: Largest summary of a step that GitHub accepts.
MAX_SUMMARY_BYTES: Final = 1 << 20
#: Outcome of a limit -> level of its annotation.
LEVELS: Final = {"kept": "notice", "broken": "error", "cannot tell": "warning"}


def write_to_github(judged: Sequence[JudgedLimit], verdict: str) -> None:
    """Write an annotation for each limit of a gate to stderr, and append a summary to a file that GitHub reads.

    The environment variable GITHUB_STEP_SUMMARY names this file. Without the variable, no summary is written.
    `judged`: limits with their outcomes. `verdict`: verdict of the comparison, in words.

    Raises BadInputError if the file cannot be written.
    """
    for each in judged:
        stderr_console().file.write(annotation(each) + "\n")
    if not (name := os.environ.get(SUMMARY)):
        return
    try:
        with Path(name).open("a", encoding="utf-8") as file:
            file.write(summary(judged, verdict))
    except OSError as error:
        from trilane.writing import WRITABLE

        raise BadInputError.of_os_error(f"{SUMMARY}={name}", error, WRITABLE) from None


def annotation(judged: JudgedLimit) -> str:
    """Return GitHub's command for an annotation, such as `::error title=slower=5%25 broken::infer takes longer`."""
    title = f"{judged.gate.text} {judged.outcome}"
    in_title = _escaped(title).replace(":", "%3A").replace(",", "%2C")
    return f"::{LEVELS[judged.outcome]} title={in_title}::{_escaped(f'{judged.name}: {judged.reason}')}"


def _escaped(text: str) -> str:
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def summary(judged: Sequence[JudgedLimit], verdict: str) -> str:
    """Return the summary in Markdown: outcome of the gate, verdict, and a table with a row for each limit.

    The last rows are left out if the summary would be longer than GitHub accepts.
    """
    from trilane.apps.compare.gate import whole

    rows = [
        f"| {_plain(each.name)} | {_plain(each.gate.text)} | {each.outcome} | {_plain(each.reason)} |\n"
        for each in judged
    ]
    text = f"### Trilane: {whole(judged)}\n\n{_plain(verdict)}\n\n| run | limit | outcome | why |\n|---|---|---|---|\n"
    for row in rows:
        if len((text + row).encode()) > MAX_SUMMARY_BYTES:
            break
        text += row
    return text + "\n"


def _plain(text: str) -> str:
    """Return `text` on one line, with Markdown's special characters escaped."""
    return re.sub(r"([\\`*_{}\[\]<>()#+!|~&])", r"\\\1", " ".join(text.split()))


EPILOG_REPORT = """\b
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


@app.command(epilog=EPILOG_REPORT)
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
    from trilane.apps.compare.pages import overview_page
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
        write_bytes(out, overview_page(title, entries).encode(), "choose another --out")
    rows = table_rows(entries)
    if json:
        print_json({"schema": 1, "entries": rows, "files": [str(target) for target in targets]})
    else:
        _print(entries, rows)
    say("written: " + ", ".join(map(str, targets)))


def _print(entries: list[Entry], rows: list[dict[str, Any]]) -> None:
    from trilane.apps.compare.overview import told_choices

    times, errors = ("frame, ms", "from, ms", "to, ms"), ("PSNR, dB", "worst", "1st pct.")
    titles = ("entry", "verdict", "bound", "trust", "others", *times, *errors, "frontier", "where the error comes from")
    cells = []
    for row in rows:
        share = row["other_programs"]
        shown = row | {"other_programs": None if share is None else f"{100 * share:.1f} %"}
        cells.append([_shown(shown[key]) for key in SHOWN])
    stdout_console().print(_table(titles, cells))
    for sentence in told_choices(entries):
        print_line(sentence)
    for entry in entries:
        if entry.failure:
            print_line(f"{entry.name}: {entry.failure}")


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else ""
    return f"{value:.2f}" if isinstance(value, float) else "" if value is None else str(value)
