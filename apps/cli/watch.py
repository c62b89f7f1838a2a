"""`trilane watch`, `trilane show` and `trilane trace`: views of one run, during it or after it.

Rule: this file reads options and shows results. Figures come from `trilane.apps.watch`, the page from
`trilane.apps.dashboard`, the trace from `trilane.apps.explain.trace`. On a terminal, `trilane watch` redraws a screen.
Without a terminal, it prints lines. Speed is shown with the avatars' image error and the sources of the figures.
"""

from __future__ import annotations

import json as json_text
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import closing
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.commands import Commands, NewestRunArgument, PortOption
from trilane.apps.cli.console import print_json, say, spinner, stdout_console, verdict_text
from trilane.apps.cli.run import DASH, TOO_FEW, accuracy_line, too_few_note
from trilane.errors import BadInputError, MissingPartError
from trilane.scheduler.stats import NEEDED, PERCENTILES

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table

    from trilane.apps.watch.figures import MomentFigures, Moved, UnitFigures
    from trilane.apps.watch.live_figures import RunLook

app = Commands()
EPILOG_WATCH = """\b
Examples:
  trilane watch
  trilane watch runs/walk
  trilane watch walk --wait
  trilane watch --json --interval 5 >> figures.jsonl
  trilane watch runs/walk --once --json
  trilane watch runs/walk --openmetrics
"""
OnceOption = Annotated[bool, typer.Option("--once", help="Print the figures once, even if the run goes on.")]
LooksOption = Annotated[
    bool, typer.Option("--json", help="Print one line of JSON for each update; with --once, one document.")
]
OpenMetricsOption = Annotated[
    bool, typer.Option("--openmetrics", help="Print the figures once, in the form of the dashboard's `/metrics`.")
]
WaitOption = Annotated[bool, typer.Option("--wait", help="Wait for a run that has not begun.")]
IntervalOption = Annotated[float, typer.Option(min=0.1, max=3600, help="Seconds between two updates.")]
EPILOG_SHOW = """\b
Examples:
  trilane show
  trilane show runs/20261122T101500Z-default
  trilane show runs/walk --port 8080
"""
EPILOG_TRACE = """\b
Examples:
  trilane trace
  trilane trace runs/20261122T101500Z-default
  trilane trace walk --chrome-json --out walk.json
"""
ChromeOption = Annotated[bool, typer.Option("--chrome-json", help="Chrome's JSON instead of Perfetto's packets.")]
OutOption = Annotated[Path | None, typer.Option("--out", help="File to write; trace.pftrace or trace.json in RUN.")]


@app.command(epilog=EPILOG_WATCH)
def watch(
    run: NewestRunArgument = None,
    once: OnceOption = False,
    json: LooksOption = False,
    openmetrics: OpenMetricsOption = False,
    wait: WaitOption = False,
    interval: IntervalOption = 1.0,
) -> None:
    """Show a run's figures: busy units, frame time, latency, queues, drops, heat and error.

    The command ends with the run, or with Ctrl-C. For a finished run, the last figures are shown. If stdout is no
    terminal, each update is a line.
    """
    from trilane.apps.watch.followed_run import follow
    from trilane.apps.watch.live_figures import looks

    if json and openmetrics:
        raise BadInputError("options", "--json and --openmetrics", "one of them")
    followed = follow(run, wait=wait)
    with closing(looks(followed, partial(time.sleep, interval))) as seen:
        with spinner("reading the journal"):
            first = next(seen)
        if openmetrics:
            _print_openmetrics(first)
        elif once and json:
            print_json(first.as_json())
        elif json:
            _print_lines(first, seen)
        else:
            _show(first, iter(()) if once else seen)


def _print_openmetrics(look: RunLook) -> None:
    try:
        from trilane.apps.watch.metrics import openmetrics
    except ModuleNotFoundError as error:
        raise MissingPartError(f"--openmetrics needs {error.name}", extra="dashboard") from None
    sys.stdout.write(openmetrics(look.figures).decode())


def _print_lines(first: RunLook, rest: Iterator[RunLook]) -> None:
    for look in chain([first], rest):
        sys.stdout.write(json_text.dumps(look.as_json(), allow_nan=False) + "\n")
        sys.stdout.flush()


def _show(first: RunLook, rest: Iterator[RunLook]) -> None:
    """Show successive figures of a run, on a redrawn screen, or line by line if stdout is no terminal.

    `first`: first figures. `rest`: later figures, which arrive while the run goes on.
    """
    from rich.live import Live

    console = stdout_console()
    if not console.is_terminal:
        sys.stdout.write(heading(first) + "\n")
        written = ""
        for look in chain([first], rest):
            if (said := line(look)) != written:
                sys.stdout.write(said + "\n")
            if look.state is not first.state:
                sys.stdout.write(ending(look) + "\n")
            sys.stdout.flush()
            written = said
        return
    with Live(screen(first, console.width), console=console, auto_refresh=False) as live:
        for look in rest:
            live.update(screen(look, console.width), refresh=True)


@app.command(epilog=EPILOG_SHOW)
def show(run: NewestRunArgument = None, port: PortOption = None) -> None:
    """Show a finished run in a browser: its pictures, timeline and figures at any moment.

    The page is served at the printed address, to this machine only, until the command is interrupted. For a live run,
    use `trilane run --dashboard`.
    """
    import asyncio

    from trilane.apps.dashboard.access import listen, require_server
    from trilane.apps.watch.followed_run import RunState, follow

    followed = follow(run)
    if followed.state is RunState.GOES_ON:
        remedy = "`trilane watch` shows it; start it with `trilane run --dashboard` to see it in a browser"
        raise BadInputError(followed.folder, "a run that goes on", "one that is over", remedy)
    require_server()
    from trilane.apps.dashboard.app import DashboardApp, server
    from trilane.apps.dashboard.finished_view import FinishedView

    with closing(FinishedView(followed.folder)) as view, closing(listen(port)) as place:
        answers = DashboardApp(view, place.port, place.token)
        say(f"dashboard: {place.url}")
        asyncio.run(server(answers).serve(sockets=[place.listener]))


@app.command(epilog=EPILOG_TRACE)
def trace(run: NewestRunArgument = None, chrome_json: ChromeOption = False, out: OutOption = None) -> None:
    """Write the timeline of a run, from its journal, for ui.perfetto.dev or chrome://tracing.

    docs/explain.md says what every track is.
    """
    from trilane.apps.explain.trace import CHROME_NAME, NAME, write_run
    from trilane.apps.watch.followed_run import RunState, follow

    followed = follow(run)
    if out is None and followed.state is RunState.GOES_ON:
        raise BadInputError(
            followed.folder, "a run that goes on", "--out FILE for its trace so far", "its folder is its own"
        )
    target = out or followed.folder / (CHROME_NAME if chrome_json else NAME)
    with spinner("writing the trace"):
        write_run(followed.whole(), target, chrome=chrome_json)
    say(f"trace: {target}")


BAR = 20
FULL, EMPTY = "█", "░"
NO_ERROR = "the run says nothing of its avatars' error"
#: New state of a run that went on before -> sentence about its end.
ENDINGS = {
    "finished": "finished",
    "killed": "killed: its process is gone, and the last line is as far as its journal goes",
    "removed": "removed: it ended before any frame, and its folder is gone",
}
NO_VERDICT = "no verdict: fewer than two frames were presented"
IN_LINES = ("p50", "p95", "p99")
MIB, MB = 1 << 20, 1_000_000


def screen(look: RunLook, width: int) -> Group:
    """Return all texts and tables that show the figures of a run on a terminal of `width` columns."""
    from rich.console import Group
    from rich.text import Text

    figures = look.figures
    lines = [f"note at {note.t_ms / 1000:.1f} s: {note.text}" for note in figures.notes]
    below = "\n".join([*lines, *errors(figures), _sources(figures), too_few_note().strip()])
    verdict = verdict_text(figures.verdict.lines(), width) if figures.verdict else Text(NO_VERDICT)
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
    """Return the most important figures of a run in one line."""
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
    return "" if figures.verdict is None else figures.verdict.lines()[0][0]


def heading(look: RunLook) -> str:
    """Return the heading above the lines of `line`, as a text of several lines.

    The heading states the run's name and state, how the figures are computed, and each avatar's image error.
    """
    from trilane.apps.watch.followed_run import RunState
    from trilane.apps.watch.live_figures import WINDOW

    of_fps = "between the first frame and the last" if look.state is RunState.FINISHED else f"of the {WINDOW}"
    how = f"fps {of_fps}, {' / '.join(IN_LINES)} of the {WINDOW};{too_few_note()}"
    return "\n".join([f"run {look.name}: {look.state}; {how}", *errors(look.figures), _sources(look.figures)])


def ending(look: RunLook) -> str:
    """Return a sentence that says how a run has ended. `look`: look at the run after its end."""
    return f"run {look.name}: {ENDINGS[look.state]}"


def errors(figures: MomentFigures) -> list[str]:
    """Return a line for each avatar: its image error, or the reason why this error is unknown."""
    return [accuracy_line(name, facts) for name, facts in figures.accuracy.items()] or [NO_ERROR]


def dropped(figures: MomentFigures) -> int:
    """Return the number of dropped frames: the sum over all edges and causes."""
    return sum(drop.frames for drop in figures.frames.dropped)


def _title(look: RunLook) -> str:
    from trilane.apps.watch.followed_run import RunState

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
        table.add_row(name, bar, _percent(unit.window.busy), _percent(unit.run.busy), _idle(unit), does)
    return table


def _table(*names: str) -> Table:
    from rich.table import Table

    return Table(*names, box=None, pad_edge=False)


def _idle(unit: UnitFigures) -> str:
    causes = sorted(unit.window.idle.items(), key=lambda one: -one[1])
    return ", ".join(f"{cause} {_percent(share)}" for cause, share in causes if round(100 * share)) or "none"


def _doing(unit: UnitFigures, state: str) -> str:
    from trilane.apps.watch.followed_run import RunState

    restarts = f", restarts: {unit.restarts}" if unit.restarts else ""
    if state != RunState.GOES_ON:
        return f"{state}{restarts}"
    if not unit.is_up:
        return f"down{restarts}"
    return (f"{unit.stage} of frame {unit.frame}" if unit.stage else "nothing") + restarts


def _times(figures: MomentFigures) -> Table:
    from trilane.apps.watch.live_figures import WINDOW

    table = _table(f"of the {WINDOW}, ms", "mean", *PERCENTILES, "max", "samples")
    for name, times in (("frame time", figures.frame_time_ms), ("latency", figures.latency_ms)):
        values = [_time(times, key) for key in ("mean", *PERCENTILES, "max")]
        table.add_row(name, *values, f"{times['samples']:.0f}")
    return table


def _three(times: Mapping[str, float]) -> str:
    return " / ".join(_time(times, key) for key in IN_LINES) + " ms"


def _time(times: Mapping[str, float], key: str) -> str:
    """Return a statistic in ms as a text. Without samples, the text is a dash. With too few samples, TOO_FEW follows.

    `times`: values in ms by the name of the statistic, and the number of `samples`. `key`: name, such as `p95`.
    """
    if not times["samples"]:
        return DASH
    return f"{times[key]:.1f}{TOO_FEW if times['samples'] < NEEDED.get(key, 0) else ''}"


def _stages(figures: MomentFigures) -> Table:
    table = _table("stage", "unit", "waiting", "ms", "MB a job", "least")
    for name, stage in figures.stages.items():
        moved, least = _moved(stage.bytes)
        table.add_row(name, stage.unit, str(stage.waiting), f"{stage.service_ms:.1f}", moved, least)
    return table


def _moved(kinds: Mapping[str, Moved]) -> tuple[str, str]:
    """Return two texts: the MB that a job moves, in all and by kind, and the least bytes of a job in MB.

    An unknown number is a dash. `kinds`: moved bytes of a stage, by kind; the least bytes have the key LEAST.
    """
    from trilane.apps.watch.live_figures import LEAST

    shown = {kind: moved.per_job / MB for kind, moved in kinds.items() if kind != LEAST and moved.total}
    least = f"{kinds[LEAST].per_job / MB:.2f}" if LEAST in kinds else DASH
    if not shown:
        return DASH, least
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
    """Return the unit that is the bound, and the cost of slowing this unit; "" if the bound is unknown.

    If the cost is unknown, the text has the unit's share of the critical path.
    """
    if figures.bound is None:
        return ""
    unit = figures.bound.unit
    return f"bound {unit.name} " + (f"{unit.share:.0%}" if unit.cost is None else f"+{unit.cost:.0%}")


def _short_error(figures: MomentFigures) -> str:
    """Return a text with each avatar's lowest PSNR over the bands of distances, in dB, from the avatar's validation.

    If no PSNR is known, the text says so.
    """
    known = {
        name: min(facts["psnr_db_by_band"].values())
        for name, facts in figures.accuracy.items()
        if facts.get("psnr_db_by_band")
    }
    return ", ".join(f"{name} at worst {value:.1f} dB" for name, value in known.items()) or "error not known"


def _sources(figures: MomentFigures) -> str:
    """Return a text with the source of the figures, and the sources of temperatures and duties if the run has any."""
    said = [f"figures: {figures.sources['fps']}"]
    for place in figures.temperature_c:
        source = figures.sources.get(f"temperature_c.{place}", figures.sources["temperature_c"])
        said.append(f"temperature of {place}: {source}")
    if figures.duty:
        said.append(f"duty: {figures.sources['duty']}")
    return "; ".join(said)
