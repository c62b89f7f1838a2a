"""Frame time against error as a drawing: a dot for each entry, its interval as a line, the frontier as steps.

Rule: a picture of numbers that stand in the table beside it; colour is never all that tells two things apart.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from html import escape
from typing import NamedTuple

WIDTH, HEIGHT = 720, 400
LEFT, RIGHT, TOP, BOTTOM = 64, 16, 16, 48
TICKS = 5


class Dot(NamedTuple):
    """`x`, with its interval `low` to `high`, and `y`; `on`: on the frontier; `group`: number of its marker."""

    label: str
    x: float
    low: float | None
    high: float | None
    y: float
    on: bool
    group: int


#: Name -> marker. A group beyond the last one begins again.
MARKERS = {
    "circle": '<circle class="g0" cx="{x}" cy="{y}" r="5"/>',
    "square": '<rect class="g1" x="{x0}" y="{y0}" width="9" height="9"/>',
    "triangle": '<path class="g2" d="M{x} {y0} l6 10 h-12 z"/>',
    "diamond": '<path class="g3" d="M{x} {y0} l5 5 l-5 5 l-5 -5 z"/>',
    "triangle on its tip": '<path class="g4" d="M{x} {y0} m-6 0 h12 l-6 10 z"/>',
    "hexagon": '<path class="g5" d="M{x} {y0} m-3 0 h6 l3 5 l-3 5 h-6 l-3 -5 z"/>',
    "plus": '<path class="g6" d="M{x} {y0} m-2 0 h4 v3 h3 v4 h-3 v3 h-4 v-3 h-3 v-4 h3 z"/>',
    "bar": '<path class="g7" d="M{x} {y0} m-2 0 h4 v10 h-4 z"/>',
}


def marker_name(group: int) -> str:
    return list(MARKERS)[group % len(MARKERS)]


def scatter(dots: Sequence[Dot], x_title: str, y_title: str) -> str:
    """An SVG drawing; empty without dots."""
    if not dots:
        return ""
    xs = [value for dot in dots for value in (dot.x, dot.low, dot.high) if value is not None]
    across, up = _Axis(min(xs), max(xs), LEFT, WIDTH - RIGHT), _Axis(*_reach(dots), HEIGHT - BOTTOM, TOP)
    parts = [*_grid(across, up), *_steps(dots, across, up), *(_dot(dot, across, up) for dot in dots)]
    turned = f"translate(14 {(TOP + HEIGHT - BOTTOM) / 2}) rotate(-90)"
    titles = (
        f'<text class="title" x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 8}">{escape(x_title)}</text>'
        f'<text class="title" transform="{turned}">{escape(y_title)}</text>'
    )
    return (
        f'<svg class="scatter" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        f'aria-label="{escape(y_title)} against {escape(x_title)}">{"".join(parts)}{titles}</svg>'
    )


class _Axis:
    """From values to pixels, with a margin of a twentieth, and round numbers between."""

    def __init__(self, low: float, high: float, first: float, last: float) -> None:
        margin = (high - low) / 20 or max(abs(high) / 20, 0.5)
        self._low, self._high = low - margin, high + margin
        self._first, self._last = first, last

    def place(self, value: float) -> float:
        share = (value - self._low) / (self._high - self._low)
        return round(self._first + share * (self._last - self._first), 1)

    def ticks(self) -> list[float]:
        step = 10.0 ** math.floor(math.log10((self._high - self._low) / TICKS))
        step *= next(factor for factor in (1, 2, 5, 10) if (self._high - self._low) / (factor * step) <= TICKS)
        first = math.ceil(self._low / step)
        return [number * step for number in range(first, math.floor(self._high / step) + 1)]


def _reach(dots: Sequence[Dot]) -> tuple[float, float]:
    return min(dot.y for dot in dots), max(dot.y for dot in dots)


def _grid(across: _Axis, up: _Axis) -> Iterator[str]:
    for value in across.ticks():
        x = across.place(value)
        yield f'<line class="grid" x1="{x}" x2="{x}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>'
        yield f'<text class="tick" x="{x}" y="{HEIGHT - BOTTOM + 18}">{value:g}</text>'
    for value in up.ticks():
        y = up.place(value)
        yield f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y}" y2="{y}"/>'
        yield f'<text class="tick left" x="{LEFT - 8}" y="{y + 4}">{value:g}</text>'


def _steps(dots: Sequence[Dot], across: _Axis, up: _Axis) -> Iterator[str]:
    """The frontier of each group: what is reached at each frame time."""
    for group in sorted({dot.group for dot in dots}):
        edge = sorted((dot.x, dot.y) for dot in dots if dot.on and dot.group == group)
        if len(edge) > 1:
            path = f"M{across.place(edge[0][0])} {up.place(edge[0][1])}"
            path += "".join(f" H{across.place(x)} V{up.place(y)}" for x, y in edge[1:])
            yield f'<path class="frontier g{group % len(MARKERS)}" d="{path}"/>'


def _dot(dot: Dot, across: _Axis, up: _Axis) -> str:
    x, y = across.place(dot.x), up.place(dot.y)
    interval = (
        f'<line class="interval" x1="{across.place(dot.low)}" x2="{across.place(dot.high)}" y1="{y}" y2="{y}"/>'
        if dot.low is not None and dot.high is not None
        else ""
    )
    marker = MARKERS[marker_name(dot.group)].format(x=x, y=y, x0=x - 4.5, y0=y - 5)
    title = f"<title>{escape(dot.label)}: {dot.x:.2f} ms, {dot.y:.2f} dB</title>"
    return f'<g class="{"on" if dot.on else "off"}" tabindex="0">{title}{interval}{marker}</g>'
