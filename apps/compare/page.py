"""The comparison as one HTML file. Rule: the file loads nothing, runs no script, and all its text is escaped.

Each change is also drawn: a dot with its 95 % interval, on one scale for figures of the same kind.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from html import escape
from typing import Final

from trilane.apps.compare.comparison import (
    METHOD,
    Comparison,
    bounds_text,
    change_of,
    interval_of,
    name_of,
    setting,
    value_of,
)
from trilane.apps.compare.difference import Difference
from trilane.apps.compare.rows import Figure

STYLE: Final = """
:root { color-scheme: light dark;
  --ink: #1b1f24; --paper: #ffffff; --faint: #5c6670; --line: #d5dae0; --mark: #0a58ca; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e8ebee; --paper: #14171a; --faint: #a3adb7; --line: #363d45; --mark: #7ab4ff; }
}
body { margin: 0 auto; padding: 1rem; max-width: 72rem; color: var(--ink); background: var(--paper);
  font: 16px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.4rem; } h2 { font-size: 1.1rem; overflow-wrap: anywhere; }
.verdict { border-left: 4px solid var(--mark); padding: .25rem 0 .25rem .8rem; font-size: 1.1rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; margin: 1rem 0; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: var(--faint); }
th, td { text-align: left; padding: .25rem .6rem; border-bottom: 1px solid var(--line); white-space: nowrap; }
td.number { text-align: right; } td.long { white-space: normal; overflow-wrap: anywhere; }
tr.differs td, tr.differs th { font-weight: 600; } tr.same td, tr.same th { color: var(--faint); font-weight: 400; }
svg { display: block; width: 160px; height: 18px; }
svg line { stroke: var(--line); } svg .interval { stroke: var(--faint); stroke-width: 2; }
svg circle { fill: var(--faint); }
tr.differs .interval { stroke: var(--mark); } tr.differs circle { fill: var(--mark); }
p.note { color: var(--faint); }
"""
POLICY: Final = "default-src 'none'; style-src 'unsafe-inline'"
WIDTH, HEIGHT, MARGIN = 160, 18, 6


def page(comparisons: Sequence[Comparison]) -> str:
    """Return an HTML document. `comparisons`: one or more, with the same base."""
    base = escape(comparisons[0].base.name)
    body = "\n".join(part for comparison in comparisons for part in _section(comparison))
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{escape(POLICY)}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>Compared with {base}</title><style>{STYLE}</style></head>\n"
        f'<body><h1>Compared with {base}</h1>\n{body}\n<p class="note">{escape(METHOD)}</p></body></html>\n'
    )


def _section(comparison: Comparison) -> Iterator[str]:
    yield f"<h2>{escape(comparison.other.name)}</h2>"
    yield f'<p class="verdict">{escape(comparison.verdict)}</p>'
    if said := bounds_text(comparison.bounds):
        yield f"<p>{escape(said)}</p>"
    if comparison.changes:
        rows = (
            _row("", _head(change.key), _long(setting(change.base)), _long(setting(change.other)))
            for change in comparison.changes
        )
        yield _table("What changed in configuration and machine", ("key", "base", "other"), rows)
    scales = _scales(comparison)
    titles = ("figure", "statistic", "base", "other", "change", "95 % interval", "outcome", "drawn")
    figures = sorted(comparison.rows, key=lambda figure: figure not in comparison.differing)
    rows = (_figure(figure, comparison, scales) for figure in figures)
    yield _table("Figures; those that differ stand first", titles, rows)
    for note in comparison.notes:
        yield f'<p class="note">{escape(note)}</p>'


def _table(caption: str, titles: Sequence[str], rows: Iterable[str]) -> str:
    head = "".join(f'<th scope="col">{escape(title)}</th>' for title in titles)
    body = "\n".join(rows)
    return (
        f'<div class="wide"><table><caption>{escape(caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>"
    )


def _row(kind: str, *cells: str) -> str:
    return f'<tr class="{kind}">{"".join(cells)}</tr>'


def _head(text: str) -> str:
    return f'<th scope="row">{escape(text)}</th>'


def _long(text: str) -> str:
    return f'<td class="long">{escape(text)}</td>'


def _number(text: str) -> str:
    return f'<td class="number">{escape(text)}</td>'


def _figure(figure: Figure, comparison: Comparison, scales: dict[tuple[bool, str], float]) -> str:
    row, unit = comparison.rows[figure], figure.unit
    cells = (value_of(row.base, unit), value_of(row.other, unit), change_of(row, unit), interval_of(row, unit))
    drawn = _drawing(row, scales[_scale_of(row, unit)])
    kind = "differs" if figure in comparison.differing else "same"
    texts = (f"<td>{escape(text)}</td>" for text in (figure.statistic, comparison.outcome(figure)))
    return _row(kind, _head(name_of(figure)), next(texts), *map(_number, cells), *texts, drawn)


def _scale_of(row: Difference, unit: str) -> tuple[bool, str]:
    return row.is_ratio, "" if row.is_ratio else unit


def _scales(comparison: Comparison) -> dict[tuple[bool, str], float]:
    """Return, by kind of change (`_scale_of`), the largest change to draw.

    Every change fits in, and so do the intervals of figures that differ. Other intervals may be cut.
    """
    scales: dict[tuple[bool, str], float] = {}
    for figure, row in comparison.rows.items():
        reach = max(map(abs, (row.change, row.low or 0.0, row.high or 0.0))) if figure in comparison.differing else 0.0
        kind = _scale_of(row, figure.unit)
        scales[kind] = max(scales.get(kind, 0.0), reach, abs(row.change))
    return scales


def _drawing(row: Difference, scale: float) -> str:
    """Return a table cell with a drawing: a dot at the change, a line for its interval, and a line at no change.

    `scale`: change at the right edge.
    """

    def place(value: float) -> float:
        share = min(max(value / scale, -1.0), 1.0) if scale else 0.0
        return round(WIDTH / 2 + share * (WIDTH / 2 - MARGIN), 1)

    middle = HEIGHT / 2
    interval = (
        f'<line class="interval" x1="{place(row.low)}" x2="{place(row.high)}" y1="{middle}" y2="{middle}"/>'
        if row.low is not None and row.high is not None
        else ""
    )
    return (
        f'<td><svg viewBox="0 0 {WIDTH} {HEIGHT}" aria-hidden="true"><line x1="{WIDTH / 2}" x2="{WIDTH / 2}" y1="0" '
        f'y2="{HEIGHT}"/>{interval}<circle cx="{place(row.change)}" cy="{middle}" r="3.5"/></svg></td>'
    )
