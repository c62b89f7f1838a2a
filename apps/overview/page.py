"""The overview as one HTML file that asks nothing of any other place.

Rule: all text is escaped; the one script is of this folder and named by its digest in the page's policy.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from importlib.resources import files
from typing import Any

from trilane.apps.overview.entry import Entry
from trilane.apps.overview.frontier import frontier
from trilane.apps.overview.pictures import MOST, still
from trilane.apps.overview.scatter import Dot, marker_name, scatter
from trilane.apps.overview.table_rows import columns, table_rows

UNITS = {"frame_ms": "frame, ms", "low_ms": "from, ms", "high_ms": "to, ms", "latency_ms": "latency, ms"}
UNITS |= {"psnr_db": "PSNR, dB", "worst_psnr_db": "worst frame, dB", "p1_psnr_db": "1st percentile, dB"}
UNITS |= {"frames_per_s": "frames/s", "on_frontier": "frontier"}
NO_ERROR = "No entry has both a speed and a known error. `trilane run --check N` measures the error of a run."
LONG = 40  # letters of a cell that is given room
MEANING = (
    "Frame time is the mean between presented frames, from and to its interval: of a run 95 %, by the scatter of its "
    "own frames; of a prediction 80 %, by the model. PSNR is the error of the picture, larger is better, a mean "
    "over frames, beside the worst one and the 1st percentile, which tell what the mean hides. The frontier "
    "holds what nobody beats in both on the same clock and machine, with the same scene and the same kind of error. An "
    "entry without a known error is in the table and on no frontier."
)


def page(title: str, entries: Sequence[Entry]) -> str:
    """A whole HTML document of at least one entry."""
    script = (files("trilane.apps.overview") / "page.js").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    style = (files("trilane.apps.overview") / "page.css").read_text(encoding="utf-8")
    body = "\n".join(_sections(title, entries))
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{escape(policy)}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title><style>{style}</style></head>\n"
        f"<body><h1>{escape(title)}</h1>\n{body}\n<script>{script}</script></body></html>\n"
    )


def _sections(title: str, entries: Sequence[Entry]) -> Iterator[str]:
    yield f'<p class="note">{escape(MEANING)}</p>'
    yield f"<h2>Frame time against error</h2>{_drawing(entries)}"
    yield f"<h2>All {len(entries)} entries</h2>{_table(title, entries)}"
    yield from _stills(entries)
    yield f"<h2>Machines</h2>{_machines(entries)}"


def _drawing(entries: Sequence[Entry]) -> str:
    drawable = [entry for entry in entries if entry.frame_ms is not None and entry.psnr_db is not None]
    groups = list(dict.fromkeys(entry.group for entry in drawable))
    dots = [
        Dot(entry.name, entry.frame_ms, entry.low_ms, entry.high_ms, entry.psnr_db, on, groups.index(entry.group))
        for entry, on in zip(entries, frontier(entries), strict=True)
        if entry.frame_ms is not None and entry.psnr_db is not None
    ]
    left_out = len(entries) - len(dots)
    note = f"{left_out} of {len(entries)} have no speed or no known error and are not drawn. " if left_out else ""
    words = "Filled: on the frontier. A marker's shape is what it is compared with: "
    legend = "; ".join(f"{marker_name(number)}: {_told(group)}" for number, group in enumerate(groups))
    drawn = scatter(dots, "frame time, ms", "PSNR, dB")
    if not drawn:
        return f"<p>{escape(NO_ERROR)}</p>"
    return f'<div class="wide">{drawn}</div><p class="note">{escape(note + words + legend)}.</p>'


def _told(group: tuple[str, ...]) -> str:
    clock, *rest = group
    return ", ".join(filter(None, [f"{clock} clock", *rest]))


def _table(title: str, entries: Sequence[Entry]) -> str:
    names = columns(entries)
    head = "".join(
        f'<th scope="col"><button type="button">{escape(UNITS.get(name, name))}</button></th>' for name in names
    )
    rows = "\n".join(
        f"<tr{' class=on' if row['on_frontier'] else ''}>{''.join(_cell(name, row[name]) for name in names)}</tr>"
        for row in table_rows(entries)
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
    if isinstance(value, float):
        return f'<td class="number" data-value="{value!r}">{value:.2f}</td>'
    text = "" if value is None else escape(str(value))
    if name == "command":
        return f'<td class="long"><code>{text}</code></td>'
    return f'<td class="long">{text}</td>' if len(text) > LONG else f"<td>{text}</td>"


def _stills(entries: Sequence[Entry]) -> Iterator[str]:
    """The pictures, and two of them over each other."""
    filmed = [entry for entry in entries if entry.video is not None]
    pictures = [(entry, still(entry.video)) for entry in filmed[:MOST] if entry.video is not None]
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
    if len(filmed) > MOST:
        yield f'<p class="note">The first {MOST} of {len(filmed)} videos.</p>'


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
