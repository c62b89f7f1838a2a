"""The overview and the comparison, each as one self-contained HTML file that loads nothing. All text is escaped.

The overview has a drawing, the table, and stills of the videos. The drawing shows the table's numbers. A video that
cannot be read gives no still. No two things differ by colour alone. The page has one script, a file of this folder. The
page's policy allows only this script, by its digest.

The comparison runs no script. Each change is also drawn: a dot with its 95 % interval, on one scale for figures of the
same kind.
"""

from __future__ import annotations

import base64
import hashlib
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from importlib.resources import files
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import av

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
from trilane.apps.compare.frontier import SAME_DB, frontier, knees
from trilane.apps.compare.overview import Entry, table_rows, told_choices
from trilane.apps.compare.rows import Figure
from trilane.hw_profiles.schema import SHARE_TEXT
from trilane.scheduler.stats import CONFIDENCE_TEXT
from trilane.stages.gpu.video_reader import open_video

UNITS = {"frame_ms": "frame, ms", "low_ms": "from, ms", "high_ms": "to, ms", "latency_ms": "latency, ms"}
UNITS |= {"psnr_db": "PSNR, dB", "worst_psnr_db": "worst frame, dB", "p1_psnr_db": "1st percentile, dB"}
UNITS |= {"frames_per_s": "frames/s", "on_frontier": "frontier", "other_programs": "other programs"}
NO_ERROR = "No entry has both a speed and a known error. `trilane run --check N` measures the error of a run."
LONG = 40  # letters; the style cuts a longer cell, which is shown in full when a person points at it
SHARES = ("other_programs",)
LETTER, BESIDE = 7, 12  # width of a name's letter, and distance of a name from its dot, pixels
MEANING = (
    f"Frame time is the mean between presented frames, from and to its interval: of a run {CONFIDENCE_TEXT}, by the "
    f"scatter of its own frames; of a prediction {SHARE_TEXT}, by the model. PSNR says how near the picture is to "
    "the truth; larger is better. It is a mean over frames; the worst frame and the 1st percentile beside it tell what "
    "the mean hides. "
    "The frontier holds what nobody beats in both on the same clock and machine, with the same scene and the same kind "
    f"of error. Pictures within {SAME_DB} dB count as equal, and so do times whose intervals meet. An entry without a "
    "known error is in the table and on no frontier. After the knee more time buys little picture. The verdict says "
    "whether an entry holds its rate, the bound what limits it; UNSURE is a run beside other programs, on a hot or "
    "changing processor, or a prediction whose interval holds the rate."
)
WIDTH, HEIGHT = 720, 400
LEFT, RIGHT, TOP, BOTTOM = 64, 16, 16, 48
TICKS = 5
MOST_STILLS = 24
STILL_QUALITY = 85
STILL_WIDTH = 640
BAR_WIDTH, BAR_HEIGHT, BAR_MARGIN = 160, 18, 6  # of the drawing of a change, pixels


def overview_page(title: str, entries: Sequence[Entry]) -> str:
    """Return the HTML document of an overview of `entries`, one or more. `title`: title of the page."""
    script = _beside("overview_page.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    body = "\n".join(_sections(title, entries)) + f"\n<script>{script}</script>"
    return _document(title, "overview_page.css", policy, body)


def _document(title: str, style: str, policy: str, body: str) -> str:
    """Return an HTML document.

    `title`: title of the page.
    `style`: name of the file beside this module that has the page's own styles.
    `policy`: content security policy: what the page may load and run.
    `body`: HTML after the heading.
    """
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{escape(policy)}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title><style>{_beside('page.css')}{_beside(style)}</style></head>\n"
        f"<body><h1>{escape(title)}</h1>\n{body}</body></html>\n"
    )


def _beside(name: str) -> str:
    return (files("trilane.apps.compare") / name).read_text(encoding="utf-8")


def _sections(title: str, entries: Sequence[Entry]) -> Iterator[str]:
    yield from (f'<p class="verdict">{escape(sentence)}</p>' for sentence in told_choices(entries))
    yield f"<h2>Frame time against picture quality: up and left is better</h2>{_drawing(entries)}"
    yield f"<h2>All {len(entries)} entries</h2>{_table(title, entries)}"
    yield f'<p class="note">{escape(MEANING)}</p>'
    yield from _stills(entries)
    yield f"<h2>Machines</h2>{_machines(entries)}"


def _drawing(entries: Sequence[Entry]) -> str:
    drawable = [entry for entry in entries if entry.frame_ms is not None and entry.psnr_db is not None]
    groups = list(dict.fromkeys(entry.group for entry in drawable))
    at_knees = set(knees(entries).values())
    dots = [
        Dot(
            *(entry.name, entry.frame_ms, entry.low_ms, entry.high_ms, entry.psnr_db, on, groups.index(entry.group)),
            number in at_knees,
        )
        for number, (entry, on) in enumerate(zip(entries, frontier(entries), strict=True))
        if entry.frame_ms is not None and entry.psnr_db is not None
    ]
    left_out = len(entries) - len(dots)
    note = f"{left_out} of {len(entries)} have no speed or no known error and are not drawn. " if left_out else ""
    words = "Filled: no other entry beats it. Ring: the knee. Only entries with one marker are compared: "
    legend = "; ".join(f"{marker_name(number)}: {_told(group)}" for number, group in enumerate(groups))
    drawn = scatter(dots, "frame time, ms", "PSNR, dB")
    if not drawn:
        return f"<p>{escape(NO_ERROR)}</p>"
    return f'<div class="wide">{drawn}</div><p class="note">{escape(note + words + legend)}.</p>'


def _told(group: tuple[str, ...]) -> str:
    clock, *rest = group
    return ", ".join(filter(None, [f"{clock} clock", *rest]))


def _table(title: str, entries: Sequence[Entry]) -> str:
    found = table_rows(entries)
    names = list(found[0])
    head = "".join(
        f'<th scope="col"><button type="button">{escape(UNITS.get(name, name))}</button></th>' for name in names
    )
    rows = "\n".join(
        f"<tr{' class=on' if row['on_frontier'] else ''}>{''.join(_cell(name, row[name]) for name in names)}</tr>"
        for row in found
    )
    return (
        '<p><label>Filter <input id="filter" type="search" placeholder="words, all of which a row has"></label> '
        '<label><input id="only" type="checkbox"> frontier only</label> <span id="count" role="status"></span></p>'
        f'<div class="wide"><table class="entries"><caption>{escape(title)}; click a heading to sort</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>\n{rows}\n</tbody></table></div>"
    )


def _cell(name: str, value: Any) -> str:
    if isinstance(value, bool):
        return f"<td>{'yes' if value else ''}</td>"
    if isinstance(value, float) and name in SHARES:
        return f'<td class="number" data-value="{value!r}">{100 * value:.1f} %</td>'
    if isinstance(value, float):
        return f'<td class="number" data-value="{value!r}">{value:.2f}</td>'
    text = "" if value is None else escape(str(value))
    shown = f"<code>{text}</code>" if name == "command" else text
    return f'<td title="{text}">{shown}</td>' if len(text) > LONG else f"<td>{shown}</td>"


def _stills(entries: Sequence[Entry]) -> Iterator[str]:
    """Yield the section of stills: two stills side by side, which the reader selects, then all stills.

    Nothing is yielded if no entry has a readable video.
    """
    filmed = [entry for entry in entries if entry.video is not None]
    pictures = [(entry, still(entry.video)) for entry in filmed[:MOST_STILLS] if entry.video is not None]
    found = [(entry, base64.b64encode(data).decode()) for entry, data in pictures if data is not None]
    if not found:
        return
    yield "<h2>Pictures</h2>"
    if len(found) > 1:
        yield _pair([entry.name for entry, _ in found])
    figures = "".join(
        f'<figure class="still"><img src="data:image/jpeg;base64,{data}" alt="middle frame of {escape(entry.name)}">'
        f"<figcaption>{escape(entry.name)}: {escape(_caption(entry))}</figcaption></figure>"
        for entry, data in found
    )
    yield f'<div class="stills">{figures}</div>'
    if len(filmed) > MOST_STILLS:
        yield f'<p class="note">The first {MOST_STILLS} of {len(filmed)} videos.</p>'


def _pair(names: Sequence[str]) -> str:
    options = [f'<option value="{n}">{escape(name)}</option>' for n, name in enumerate(names)]
    second = [option.replace(" value", " selected value", 1) if n == 1 else option for n, option in enumerate(options)]
    return (
        f'<p><label>Left <select class="picture">{"".join(options)}</select></label> '
        f'<label>Right <select class="picture">{"".join(second)}</select></label></p>'
        '<div class="pair"><img alt=""><img alt=""></div>'
        '<label>Divide <input id="divide" type="range" min="0" max="100" value="50"></label>'
    )


def _caption(entry: Entry) -> str:
    speed = "no speed" if entry.frame_ms is None else f"{entry.frame_ms:.1f} ms a frame, {entry.speed_source}"
    error = entry.error_source if entry.psnr_db is None else f"{entry.psnr_db:.1f} dB, {entry.error_source}"
    return f"{speed}; {error}"


def _machines(entries: Sequence[Entry]) -> str:
    facts = {entry.machine: entry.facts for entry in entries}
    parts: Iterable[str] = (
        f"<details><summary>{escape(name)}</summary>{_facts(machine)}</details>" for name, machine in facts.items()
    )
    return "".join(parts)


def _facts(machine: Any) -> str:
    rows = "".join(f"<tr><th>{escape(key)}</th><td>{escape(str(value))}</td></tr>" for key, value in machine.items())
    return f'<div class="wide"><table>{rows}</table></div>'


class Dot(NamedTuple):
    """A dot at the frame time `x` and the PSNR `y`.

    `label`: name of the entry.
    `x`: frame time, ms. `low`, `high`: ends of its interval, None if they are unknown. `y`: PSNR, dB.
    `on`: whether the dot is on the frontier.
    `group`: number of its group, which decides the marker.
    `is_knee`: whether the dot is the knee of its group.
    """

    label: str
    x: float
    low: float | None
    high: float | None
    y: float
    on: bool
    group: int
    is_knee: bool = False


#: Name -> SVG of a marker. The group after the last marker gets the first marker again.
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
    """Return an SVG drawing of `dots`, with intervals as lines and frontiers as steps; "" without dots.

    `x_title`, `y_title`: titles of the axes.
    """
    if not dots:
        return ""
    xs = [value for dot in dots for value in (dot.x, dot.low, dot.high) if value is not None]
    ys = [dot.y for dot in dots]
    across, up = _Axis(min(xs), max(xs), LEFT, WIDTH - RIGHT), _Axis(min(ys), max(ys), HEIGHT - BOTTOM, TOP)
    parts = [
        *_grid(across, up),
        *_steps(dots, across, up),
        *(_dot(dot, across, up) for dot in dots),
        *_names(dots, across, up),
    ]
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
    """An axis of a drawing. It maps values to pixels, with a margin of 1/20 of the range on both sides.

    `low`, `high`: range of the values.
    `first`, `last`: pixels of the axis's ends.
    """

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
    """Yield the frontier of each group as an SVG path with steps: the best PSNR up to each frame time.

    `dots`: dots of all groups.
    `across`, `up`: axes of the frame time and of the PSNR.
    """
    for group in sorted({dot.group for dot in dots}):
        points = sorted((dot.x, dot.y) for dot in dots if dot.on and dot.group == group)
        bests = accumulate((y for _, y in points), max)
        edge = [(x, best) for (x, _), best in zip(points, bests, strict=True)]
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
    ring = f'<circle class="ring" cx="{x}" cy="{y}" r="10"/>' if dot.is_knee else ""
    return f'<g class="{"on" if dot.on else "off"}" tabindex="0">{title}{interval}{marker}{ring}</g>'


def _names(dots: Sequence[Dot], across: _Axis, up: _Axis) -> Iterator[str]:
    """Yield SVG texts with the names of knees, then of other dots on the frontier.

    A name that would overlap another name is left out.
    `dots`: dots of all groups.
    `across`, `up`: axes of the frame time and of the PSNR.
    """
    taken: list[tuple[float, float, float]] = []  # left, right, base line
    named = sorted((dot for dot in dots if dot.on or dot.is_knee), key=lambda dot: not dot.is_knee)
    for dot in named:
        x, y, wide = across.place(dot.x), up.place(dot.y), LETTER * len(dot.label)
        left = x + BESIDE if x < (LEFT + WIDTH - RIGHT) / 2 else x - BESIDE - wide
        for base in (y + 18, y - 9):
            if all(
                base > at + 14 or base < at - 14 or left > right or left + wide < begin for begin, right, at in taken
            ):
                taken.append((left, left + wide, base))
                yield f'<text class="name" x="{left:.0f}" y="{base}">{escape(dot.label)}</text>'
                break


def still(video: Path) -> bytes | None:
    """Return the last keyframe at or before the middle of `video` as a JPEG, at most `STILL_WIDTH` pixels wide.

    If the duration is unknown, the first frame is returned. If the video cannot be read, None is returned.
    """
    try:
        with open_video(video) as container:
            stream = container.streams.video[0]
            if stream.duration:
                container.seek(stream.duration // 2, stream=stream)
            frame = next(container.decode(stream))
            image = frame.to_image()
    except (av.error.FFmpegError, OSError, StopIteration, IndexError):
        return None
    if image.width > STILL_WIDTH:
        image = image.resize((STILL_WIDTH, round(image.height * STILL_WIDTH / image.width)))
    file = io.BytesIO()
    image.save(file, "JPEG", quality=STILL_QUALITY)
    return file.getvalue()


def comparison_page(comparisons: Sequence[Comparison]) -> str:
    """Return the HTML document of `comparisons`, one or more, with the same base."""
    title = f"Compared with {comparisons[0].base.name}"
    parts = "\n".join(part for comparison in comparisons for part in _section(comparison))
    body = f'{parts}\n<p class="note">{escape(METHOD)}</p>'
    return _document(title, "comparison_page.css", "default-src 'none'; style-src 'unsafe-inline'", body)


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
        yield _captioned("What changed in configuration and machine", ("key", "base", "other"), rows)
    scales = _scales(comparison)
    titles = ("figure", "statistic", "base", "other", "change", f"{CONFIDENCE_TEXT} interval", "outcome", "drawn")
    figures = sorted(comparison.rows, key=lambda figure: figure not in comparison.differing)
    rows = (_figure(figure, comparison, scales) for figure in figures)
    yield _captioned("Figures; those that differ stand first", titles, rows)
    for note in comparison.notes:
        yield f'<p class="note">{escape(note)}</p>'


def _captioned(caption: str, titles: Sequence[str], rows: Iterable[str]) -> str:
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
    drawn = _bar(row, scales[_scale_of(row, unit)])
    kind = "differs" if figure in comparison.differing else "same"
    texts = (f"<td>{escape(text)}</td>" for text in (figure.statistic, comparison.outcome(figure)))
    return _row(kind, _head(name_of(figure)), next(texts), *map(_number, cells), *texts, drawn)


def _scale_of(row: Difference, unit: str) -> tuple[bool, str]:
    return row.is_ratio, "" if row.is_ratio else unit


def _scales(comparison: Comparison) -> dict[tuple[bool, str], float]:
    """Return the change at the right edge of the drawing, for each kind of change (`_scale_of`).

    Every change and the intervals of figures that differ fit in. Other intervals may be cut.
    """
    scales: dict[tuple[bool, str], float] = {}
    for figure, row in comparison.rows.items():
        reach = max(map(abs, (row.change, row.low or 0.0, row.high or 0.0))) if figure in comparison.differing else 0.0
        kind = _scale_of(row, figure.unit)
        scales[kind] = max(scales.get(kind, 0.0), reach, abs(row.change))
    return scales


def _bar(row: Difference, scale: float) -> str:
    """Return a table cell with a drawing: a dot at the change, a line for its interval, and a line at no change.

    `row`: difference to draw.
    `scale`: change at the right edge.
    """

    def place(value: float) -> float:
        share = min(max(value / scale, -1.0), 1.0) if scale else 0.0
        return round(BAR_WIDTH / 2 + share * (BAR_WIDTH / 2 - BAR_MARGIN), 1)

    middle = BAR_HEIGHT / 2
    interval = (
        f'<line class="interval" x1="{place(row.low)}" x2="{place(row.high)}" y1="{middle}" y2="{middle}"/>'
        if row.low is not None and row.high is not None
        else ""
    )
    return (
        f'<td><svg viewBox="0 0 {BAR_WIDTH} {BAR_HEIGHT}" aria-hidden="true">'
        f'<line x1="{BAR_WIDTH / 2}" x2="{BAR_WIDTH / 2}" y1="0" y2="{BAR_HEIGHT}"/>'
        f'{interval}<circle cx="{place(row.change)}" cy="{middle}" r="3.5"/></svg></td>'
    )
