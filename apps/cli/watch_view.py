"""Shows one moment of a run in `trilane watch`: a screen for a terminal, a line for anything else.

Rule: every figure is a field of `MomentFigures`. Each speed is shown with the error of the avatar's pictures, and the
sources of the figures stand below.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from trilane.apps.cli.console import verdict_text
from trilane.apps.cli.run_table import DASH, NEEDED, TOO_FEW, accuracy_line
from trilane.apps.watch.figures import MomentFigures, Moved, UnitFigures
from trilane.apps.watch.followed_run import RunState
from trilane.apps.watch.live_figures import LEAST, RunLook

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table

BAR = 20
FULL, EMPTY = "█", "░"
NO_ERROR = "the run says nothing of its avatars' error"
FEW = f"{TOO_FEW} of too few frames: " + ", ".join(f"{name} needs {count}" for name, count in NEEDED.items())
#: What became of a run that went on when it was looked at first.
ENDINGS = {
    RunState.FINISHED: "finished",
    RunState.KILLED: "killed: its process is gone, and the last line is as far as its journal goes",
    RunState.REMOVED: "removed: it ended before any frame, and its folder is gone",
}
NO_VERDICT = "no verdict: fewer than two frames were presented"
PERCENTILES = ("p50", "p90", "p95", "p99")
MIB = 1 << 20


def screen(look: RunLook, width: int) -> Group:
    """Return everything, for a terminal of `width` columns."""
    from rich.console import Group
    from rich.text import Text

    figures = look.figures
    lines = [f"note at {note.t_ms / 1000:.1f} s: {note.text}" for note in figures.notes]
    below = "\n".join([*lines, *errors(figures), _sources(figures), FEW.strip()])
    verdict = verdict_text(figures.verdict["lines"], width) if figures.verdict else Text(NO_VERDICT)
    return Group(
        Text(_title(look)),
        verdict,
        _units(figures),
        _times(figures),
        _stages(figures),
        Text(_frames(figures)),
        Text(below),
    )


def line(look: RunLook) -> str:
    """Return the most important figures in one line."""
    figures = look.figures
    busy = ", ".join(f"{name} {unit.window.busy:.0%}" for name, unit in figures.units.items())
    waiting = ", ".join(f"{name} {stage.waiting}" for name, stage in figures.stages.items() if stage.waiting)
    heat = ", ".join(f"{place} {value:.1f} C" for place, value in figures.temperature_c.items())
    frames = figures.frames
    parts = (
        f"{figures.t_ms / 1000:.1f} s",
        _passed(figures),
        _rate(figures),
        f"frame {_three(figures.frame_time_ms)}",
        f"latency {_three(figures.latency_ms)}",
        f"busy {busy}",
        _short_bound(figures),
        f"waiting {waiting or 'none'}",
        f"presented {frames.presented}, lost {sum(frames.lost.values())}, dropped {dropped(figures)}",
        heat,
        _short_error(figures),
    )
    return "; ".join(part for part in parts if part)


def _passed(figures: MomentFigures) -> str:
    return "" if figures.verdict is None else str(figures.verdict["lines"][0][0])


def heading(look: RunLook) -> str:
    """Return the heading above the lines."""
    of_fps = "between the first frame and the last" if look.state is RunState.FINISHED else "of the last 5 s"
    how = f"fps {of_fps}, p50 / p95 / p99 of the last 5 s;{FEW}"
    return "\n".join([f"run {look.name}: {look.state}; {how}", *errors(look.figures), _sources(look.figures)])


def ending(look: RunLook) -> str:
    """Say that a run that went on has another state."""
    return f"run {look.name}: {ENDINGS[look.state]}"


def errors(figures: MomentFigures) -> list[str]:
    """Return a line for each avatar: how wrong its pictures are, or why that is not known."""
    return [accuracy_line(name, facts) for name, facts in figures.accuracy.items()] or [NO_ERROR]


def dropped(figures: MomentFigures) -> int:
    """Return the number of frames dropped on all edges."""
    return sum(drop.frames for drop in figures.frames.dropped)


def _title(look: RunLook) -> str:
    figures = look.figures
    over = "over" if figures.is_over else f"for {figures.run_s:.1f} s"
    rate = f"{_rate(figures)} between the first frame and the last"
    if look.state is not RunState.FINISHED:
        of_run = _number(figures.run_fps)
        rate = f"{_rate(figures)} in the last {figures.window_s:.1f} s, {of_run} between the first and the last"
    return f"run {look.name}: {look.state}, {over}; {rate}"


def _rate(figures: MomentFigures) -> str:
    return f"{_number(figures.fps)} fps"


def _number(value: float | None) -> str:
    return DASH if value is None else f"{value:.1f}"


def _units(figures: MomentFigures) -> Table:
    table = _table("unit", "busy", "%", "run %", "idle, %", "does")
    for name, unit in figures.units.items():
        filled = round(BAR * unit.window.busy)
        bar = FULL * filled + EMPTY * (BAR - filled)
        does = _doing(unit, figures.state)
        _add_row(table, name, bar, _percent(unit.window.busy), _percent(unit.run.busy), _idle(unit), does)
    return table


def _table(*names: str) -> Table:
    from rich.table import Table

    return Table(*names, box=None, pad_edge=False)


def _add_row(table: Table, *cells: str) -> None:
    """Add a row whose cells are no markup: a pipeline gives its stages and units any names."""
    from rich.text import Text

    table.add_row(*map(Text, cells))


def _idle(unit: UnitFigures) -> str:
    causes = sorted(unit.window.idle.items(), key=lambda one: -one[1])
    return ", ".join(f"{cause} {_percent(share)}" for cause, share in causes if round(100 * share)) or "none"


def _doing(unit: UnitFigures, state: str) -> str:
    restarts = f", restarts: {unit.restarts}" if unit.restarts else ""
    if state != RunState.GOES_ON:
        return f"{state}{restarts}"
    if not unit.is_up:
        return f"down{restarts}"
    return (f"{unit.stage} of frame {unit.frame}" if unit.stage else "nothing") + restarts


def _times(figures: MomentFigures) -> Table:
    table = _table("of the last 5 s, ms", "mean", *PERCENTILES, "max", "samples")
    for name, times in (("frame time", figures.frame_time_ms), ("latency", figures.latency_ms)):
        values = [_time(times, key) for key in ("mean", *PERCENTILES, "max")]
        _add_row(table, name, *values, f"{times['samples']:.0f}")
    return table


def _three(times: Mapping[str, float]) -> str:
    return " / ".join(_time(times, key) for key in ("p50", "p95", "p99")) + " ms"


def _time(times: Mapping[str, float], key: str) -> str:
    """Return a dash without samples; a percentile of too few says so."""
    if not times["samples"]:
        return DASH
    return f"{times[key]:.1f}{TOO_FEW if times['samples'] < NEEDED.get(key, 0) else ''}"


def _stages(figures: MomentFigures) -> Table:
    table = _table("stage", "unit", "waiting", "ms", "MiB a job", "least")
    for name, stage in figures.stages.items():
        moved, least = _moved(stage.bytes)
        _add_row(table, name, stage.unit, str(stage.waiting), f"{stage.service_ms:.1f}", moved, least)
    return table


def _moved(kinds: Mapping[str, Moved]) -> tuple[str, str]:
    """Return the MiB that a job moved, by kind and in all, and the least possible; dashes if the stage counts none."""
    shown = {kind: moved.per_job / MIB for kind, moved in kinds.items() if kind != LEAST and moved.total}
    least = f"{kinds[LEAST].per_job / MIB:.2f}" if LEAST in kinds else "–"
    if not shown:
        return "–", least
    return f"{sum(shown.values()):.2f} ({', '.join(f'{kind} {value:.2f}' for kind, value in shown.items())})", least


def _frames(figures: MomentFigures) -> str:
    frames = figures.frames
    lost = _listed((cause, count) for cause, count in frames.lost.items())
    left_out = _listed((f"{drop.edge} {drop.cause}", drop.frames) for drop in frames.dropped)
    lines = [
        f"frames: {frames.presented} of {frames.requested} presented, {frames.skipped} of them skipped stages, "
        f"{frames.in_flight} in flight, {frames.not_begun} not begun",
        f"lost: {lost}; dropped: {left_out}",
    ]
    if figures.temperature_c:
        heat = _listed((place, f"{value:.1f}") for place, value in figures.temperature_c.items())
        lines.append(f"temperature, C: {heat}")
    if figures.duty:
        lines.append(f"duty: {_listed((unit, f'{share:.0%}') for unit, share in figures.duty.items())}")
    if figures.memory_bytes:
        memory = _listed((name, f"{value / MIB:.0f}") for name, value in figures.memory_bytes.items())
        lines.append(f"memory, MiB: {memory}")
    return "\n".join(lines)


def _listed(pairs: Iterator[tuple[str, Any]]) -> str:
    return ", ".join(f"{name} {value}" for name, value in pairs) or "none"


def _percent(share: float) -> str:
    return f"{100 * share:.0f}"


def _short_bound(figures: MomentFigures) -> str:
    """Return the unit with what slowing it costs, or with its share of the critical path; empty if unknown."""
    unit = (figures.bound or {}).get("unit")
    if not unit:
        return ""
    cost = unit.get("cost")
    return f"bound {unit['name']} " + (f"{unit['share']:.0%}" if cost is None else f"+{cost:.0%}")


def _short_error(figures: MomentFigures) -> str:
    """Return the PSNR of each avatar in the band of zoom in which it is worst."""
    known = {
        name: min(facts["psnr_db_by_band"].values())
        for name, facts in figures.accuracy.items()
        if facts.get("psnr_db_by_band")
    }
    return ", ".join(f"{name} at worst {value:.1f} dB" for name, value in known.items()) or "error not known"


def _sources(figures: MomentFigures) -> str:
    """Name the sources of the figures; temperatures have one only in a run that has temperatures."""
    said = [f"figures: {figures.sources['fps']}"]
    for place in figures.temperature_c:
        source = figures.sources.get(f"temperature_c.{place}", figures.sources["temperature_c"])
        said.append(f"temperature of {place}: {source}")
    if figures.duty:
        said.append(f"duty: {figures.sources['duty']}")
    return "; ".join(said)
