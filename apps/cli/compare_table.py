"""Prints a comparison for people. Rule: the verdict comes first, then its evidence, then the uncertain figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from rich.markup import escape

from trilane.apps.compare.compared_sweeps import METHOD as SWEEP_METHOD
from trilane.apps.compare.comparison import METHOD, bounds_text, change_of, interval_of, name_of, setting, value_of
from trilane.apps.compare.difference import Finding
from trilane.apps.compare.rows import MS

if TYPE_CHECKING:
    from rich.table import Table

    from trilane.apps.compare.compared_sweeps import SweepComparison, TrialPair
    from trilane.apps.compare.comparison import Comparison
    from trilane.apps.compare.rows import Figure
    from trilane.apps.compare.sides import Change

#: Measures of which one statistic is shown even where nothing differs.
ALWAYS = ("frame time", "latency", "instructions", "time of an instruction", "work", "busy")
ALWAYS_STATISTICS = ("mean", "typical", "share")
MOST_CHANGES = 12


def comparison_lines(comparison: Comparison, show_all: bool) -> Iterator[str | Table]:
    """Yield texts and tables of one comparison. `show_all`: also show figures that do not differ."""
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


#: Why a configuration of a sweep has no partner.
LEFT_OUT = {
    "not_done": "not done in both",
    "base_alone": "in the base alone",
    "other_alone": "in the other alone",
}


def sweep_lines(comparison: SweepComparison, show_all: bool) -> Iterator[str | Table]:
    """Yield texts and tables of two sweeps. `show_all`: also show trials that do not differ."""
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
    yield SWEEP_METHOD


def _trial_table(pairs: Sequence[TrialPair]) -> Table:
    """Return a table of the options that vary, the mean frame times, their change and its interval."""
    from rich.table import Table

    names = [
        name
        for name in dict.fromkeys(name for pair in pairs for name in pair.options)
        if len({str(pair.options.get(name)) for pair in pairs}) > 1
    ] or ["trial"]
    table = Table(*names, "base, ms", "other, ms", "change", "95 % interval", "outcome")
    for pair in pairs:
        row = pair.frame_time
        values = [setting(pair.options.get(name, pair.name)) for name in names]
        differs = str(pair.outcome)
        figures = (f"{row.base:.4g}", f"{row.other:.4g}", change_of(row, MS), interval_of(row, MS), differs)
        table.add_row(*(escape(text) for text in (*values, *figures)))
    return table


def _left_out(comparison: Comparison, shown: Sequence[Figure]) -> Iterator[str]:
    """Say how many figures the table leaves out: figures without a difference, then uncertain ones."""
    left = [comparison.outcome(figure) for figure in comparison.rows if figure not in shown]
    unknown = left.count(Finding.UNKNOWN)
    if alike := len(left) - unknown:
        yield f"{alike} more {'figure does' if alike == 1 else 'figures do'} not differ: --all shows them"
    if unknown:
        yield f"of {unknown} more {'figure' if unknown == 1 else 'figures'} it cannot be told: --all shows them"


def _is_shown(figure: Figure, comparison: Comparison) -> bool:
    return figure in comparison.differing or (figure.measure in ALWAYS and figure.statistic in ALWAYS_STATISTICS)


def _change_table(changes: Sequence[Change]) -> Table:
    from rich.table import Table

    table = Table("changed", "base", "other")
    for change in changes:
        table.add_row(*(escape(text) for text in (change.key, setting(change.base), setting(change.other))))
    return table


def _figure_table(comparison: Comparison, figures: list[Figure]) -> Table:
    from rich.table import Table

    table = Table("figure", "statistic", "base", "other", "change", "95 % interval", "outcome")
    for figure in figures:
        row, unit = comparison.rows[figure], figure.unit
        values = (value_of(row.base, unit), value_of(row.other, unit), change_of(row, unit), interval_of(row, unit))
        differs = str(comparison.outcome(figure))
        table.add_row(*(escape(text) for text in (name_of(figure), figure.statistic, *values, differs)))
    return table
