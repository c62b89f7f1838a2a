"""`trilane run`: runs a scene or a pipeline file, and shows the verdict or a table.

Rule: this file reads options and shows results; `trilane.apps.run.asked_run` does the work. Every figure of the table
comes from report.json, and the source of the figures stands below the table. An unknown figure is a dash. A percentile
of too few frames is marked.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trilane.apps.cli.commands import Commands, JsonOption, PortOption, with_options
from trilane.apps.cli.console import print_json, print_verdict, say, shown_messages, stderr_console, stdout_console
from trilane.errors import BadInputError
from trilane.scheduler.stats import CONFIDENCE_TEXT, NEEDED, PERCENTILES
from trilane.stages.run_options import RunOptions
from trilane.units import COMPUTED, MEASURED, NO_FIGURES

if TYPE_CHECKING:
    from rich.progress import TaskID
    from rich.table import Table

    from trilane.apps.run.report import Check, FrameErrors, Made, PaceComparison, Report
    from trilane.apps.run.run_job import Hooks, RunOutcome
    from trilane.pipeline.run_metrics import (
        Caps,
        FrameCounts,
        MovedBytes,
        PathShare,
        PolicyMetrics,
        StageTimes,
        Temperature,
        TimeSummary,
        UnitShares,
    )

    Rows = Iterator[tuple[str, str, list[str]]]

app = Commands()

EPILOG = """\b
Examples:
  trilane run
  trilane run --frames 60 --size 192 --out /tmp/run
  trilane run --motion walk.bvh --camera arkit.txt --frames 200 --json
  trilane run --latch 3
  trilane run --no-video --baseline 0 --frames 1000000
  trilane run walk-past --policy latest --edge triple --fps 24 --picture 1280x720
  trilane run --cores cpu=1 --cores gpu=0 --cores dsp=0,1
  trilane run --split /Concat_4_output_0_QuantizeLinear_Output=cpu
  trilane run --performance-profile sustained_high_performance
  trilane run --check 4
  trilane run --calibration entropy:10 --check 4
  trilane run --width 8 --channels 8
  trilane run --dashboard
  trilane run --profile snapdragon-888 --pace --slow-motion 24 --frames 60
  trilane run myscene.toml --background street.mp4 --policy sequential
  trilane run street.toml --frames 300 --set stages.detector.runtime=openvino
"""

TableOption = Annotated[
    bool, typer.Option("--table", help="Print the table of all figures below the verdict (docs/report.md).")
]
DashboardOption = Annotated[
    bool, typer.Option("--dashboard", help="Show the run in a browser; without --frames it runs until Ctrl-C.")
]


@contextmanager
def _hooks() -> Iterator[Hooks]:
    """Yield the run's callbacks, which show messages and progress on stderr. Progress is shown only on a terminal."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from trilane.apps.run.run_job import Hooks

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=stderr_console(), disable=not sys.stderr.isatty())
    tasks: dict[str, TaskID] = {}
    starting = bar.add_task("starting the units", total=None)

    def progress(what: str, presented: int, requested: int) -> None:
        if what not in tasks:
            bar.update(starting, visible=False)
            tasks[what] = bar.add_task(what, total=requested)
        bar.update(tasks[what], completed=presented)

    with bar:
        yield Hooks(progress, lambda text: bar.console.print(text, soft_wrap=True))


@app.command(epilog=EPILOG)
@with_options(RunOptions)
def run(
    options: RunOptions,
    *,
    dashboard: DashboardOption = False,
    port: PortOption = None,
    table: TableOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run a scene or a pipeline file, write a run folder and print a verdict.

    The verdict says whether the run holds its rate, what bounds it, and whether the machine was quiet.
    The folder holds report.json, video.mp4, contact.png, trace.pftrace (open it at ui.perfetto.dev), events.jsonl and
    journal.msgpack. The journal is written while the run goes on.
    docs/report.md explains every key, the policies and the edges.
    """
    from trilane.apps.run.asked_run import run_asked

    if port is not None and not dashboard:
        raise BadInputError("options", "--port without --dashboard", "both or neither")
    if options.check and dashboard:
        raise BadInputError(
            "options", "--check with --dashboard", "one of them", "a run that is steered has no reference"
        )
    command = ("trilane", *sys.argv[1:])
    outcome = _run_live(options, command, port) if dashboard else run_asked(options, _hooks, command)
    _print_outcome(outcome, as_json, table)
    raise typer.Exit(outcome.exit_code)


def _run_live(options: RunOptions, command: tuple[str, ...], port: int | None) -> RunOutcome:
    from trilane.apps.dashboard.access import require_server

    require_server()
    from trilane.apps.dashboard.live_run import run_file_live, run_live
    from trilane.pipeline.pipeline_file import is_pipeline_file

    run = run_file_live if is_pipeline_file(Path(options.scene)) else run_live
    return run(options, _hooks, command, port, say)


def _print_outcome(outcome: RunOutcome, as_json: bool, with_table: bool) -> None:
    """Print the report as JSON, or its verdict, on stdout. Print folder, messages and cause of a failure on stderr.

    `outcome`: end of the run, with its report. `as_json`: whether to print JSON. `with_table`: whether to print the
    table of all figures below the verdict.
    """
    from trilane.apps.run.verdict_facts import verdict_of

    report = outcome.report
    if as_json:
        print_json(report.as_json())
    else:
        print_verdict(verdict_of(report, str(outcome.folder)).lines())
        if with_table:
            stdout_console().print(run_table(report))
    say(f"run folder: {outcome.folder}")
    for message in shown_messages(report.messages, report.failure):
        say(f"in the run: {message}")
    if report.failure:
        say(f"the run failed: {report.failure}")


DASH = "–"
UNSAID = "the report does not say where they come from"
STATISTICS = ("mean", *PERCENTILES, "max")
TOO_SHORT = "too short to tell"
TOO_FEW = " *"


def too_few_note() -> str:
    """Return the explanation of the mark TOO_FEW: how many samples each percentile needs."""
    return f"{TOO_FEW} of too few frames: " + ", ".join(f"{name} needs {count}" for name, count in NEEDED.items())


def run_table(report: Report) -> Table:
    """Return a table of stages, units, times and rates. The columns are the run and, if measured, its baseline."""
    from rich.table import Table

    runs: list[PolicyMetrics] = [report, report.baseline] if report.baseline else [report]
    table = Table(title=_title(report), title_justify="left", caption=_caption(report), caption_justify="left")
    table.add_column("")
    table.add_column("")
    for run in runs:
        table.add_column(f"{run.policy}, {run.frames.presented} frames", justify="right")
    for section in (_stage_rows, _byte_rows, _unit_rows, _core_rows, _time_rows, _rate_rows):
        for name, measure, cells in section(runs):
            table.add_row(name, measure, *cells)
        table.add_section()
    return table


def _title(report: Report) -> str:
    scene = report.config["scene"]
    if "pipeline" in report.config:
        return f"Pipeline {scene['name']}: {len(report.stages)} stages"
    return f"Scene {scene['name']}: {scene['output']['width']}x{scene['output']['height']}, tensor size {scene['size']}"


def _caption(report: Report) -> str:
    cpu, gl = report.machine.cpu, report.machine.gl
    cores = ", ".join(f"{unit} {','.join(map(str, shares.cores))}" for unit, shares in report.units.items())
    lines = [
        f"stages, units, times, rates: {MEASURED}",
        f"{cpu.model} ({' '.join(cpu.flags)}); cores: {cores}; idle cores {report.idle_cores}",
    ]
    if "runtime" in report.config:
        lines.append(f"network on {report.config['runtime']}; OpenGL on {gl.renderer if gl else DASH}")
    if report.made:
        lines.insert(0, _made(report.made))
    if report.frames.skipped:
        lines.append(_skipped(report))
    lines.append(
        f"in brackets: {CONFIDENCE_TEXT} interval, by the scatter of this run's frames; two runs may differ by more"
    )
    runs: list[PolicyMetrics] = [report, report.baseline] if report.baseline else [report]
    summaries = [times for run in runs for times in (run.frame_time_ms, run.latency_ms)]
    if any(_too_few(times, name) for times in summaries for name in NEEDED):
        lines.append(too_few_note().strip())
    if report.pace:
        lines.append(_pace(report.pace))
    if report.caps.performance_profile:
        lines.append(_caps(report.caps, report.temperature_c))
    if report.check:
        lines += _check(report.check)
    lines += [accuracy_line(name, facts) for name, facts in report.accuracy.items()]
    return "\n".join(lines)


def _made(made: Made) -> str:
    revision = f" at {made.revision[:10]}{', modified' if made.modified else ''}" if made.revision else ""
    return f"{made.at}: trilane {made.trilane or DASH}{revision}"


def _pace(pace: PaceComparison) -> str:
    slower = ", ".join(f"{stage} {count}" for stage, count in pace.host_slower.items()) or "none"
    slow_motion = f", {pace.slow_motion:g} times slower" if pace.slow_motion != 1 else ""
    return (
        f"held to {pace.profile}{slow_motion}: {_number(pace.measured_ms, 2)} ms a frame ({MEASURED}), in virtual time "
        f"{_number(pace.virtual_ms, 2)} ms ({COMPUTED}), ratio {_number(pace.ratio, 3)}; jobs too slow here: {slower}"
    )


def _check(check: Check) -> list[str]:
    """Return a line with the image errors against the truth or, if the truth is unknown, against the float path.

    If `check` compared with both, a second line has the errors against the float path.
    """
    errors = [check, *([check.float_path] if check.float_path else [])]
    return [f"of this run, {check.frames} frames against {_errors(each)} ({MEASURED})" for each in errors]


def _errors(found: FrameErrors) -> str:
    return (
        f"{found.against}: PSNR mean {found.psnr_db:.1f} dB, 1st percentile {_number(found.p1_psnr_db, 1)}, worst "
        f"{found.worst_psnr_db:.1f}; MAE {found.mae:.2f} of 255; FLIP {found.flip:.3f}; IoU of all but background "
        f"{found.iou:.3f}"
    )


def _caps(caps: Caps, temperature: Temperature) -> str:
    duties = ", ".join(f"{unit} {cap.duty_mean:.0%}" for unit, cap in caps.units.items())
    return (
        f"capped as {caps.performance_profile}: duty cycles {duties}, which is the most that units may work; lowered "
        f"further for heat {caps.throttled_share:.0%} of the time; {temperature.kind}: at most "
        f"{_number(temperature.junction_max)} C ({COMPUTED})"
    )


def accuracy_line(name: str, facts: Mapping[str, Any]) -> str:
    """Return a line with the image error of an avatar and the error's source, or the reason why the error is unknown.

    Older reports do not state the source of the error, which then counts as unknown. `name`: name of the avatar.
    `facts`: value for this avatar in the report's `accuracy`.
    """
    source = facts.get("source", NO_FIGURES)
    if source == NO_FIGURES:
        return f"avatar {name}: {NO_FIGURES} of accuracy: {facts.get('why', UNSAID)}"
    bands = ", ".join(f"{band} {value:.1f}" for band, value in facts.get("psnr_db_by_band", {}).items())
    body = f"; of the body alone {facts['body_psnr_db']:.1f}" if "body_psnr_db" in facts else ""
    inside = (
        f"; {facts['see_through']:.1%} of the inside lets more than a tenth through" if "see_through" in facts else ""
    )
    mask = f"; mask IoU {facts['iou']:.3f}" if "iou" in facts else ""
    place = f", on {facts['runtime']} at tensor size {facts['size']}" if {"runtime", "size"} <= {*facts} else ""
    return (
        f"avatar {name}: PSNR on held-out views before random backgrounds, dB: {bands or facts['psnr_db']}"
        f"{body}{_worst(facts)}{inside}{mask} ({source}{place})"
    )


def _worst(facts: Mapping[str, Any]) -> str:
    if not {"worst", "samples", "by_seed"} <= {*facts}:
        return ""
    return f"; worst of {facts['samples']} views (seeds {', '.join(facts['by_seed'])}) {facts['worst']['psnr_db']:.1f}"


def _stage_rows(runs: Sequence[PolicyMetrics]) -> Rows:
    for stage, times in runs[0].stages.items():
        cells = [_service_and_wait(run.stages.get(stage)) for run in runs]
        yield f"{stage} ({times.unit})", "service + wait, ms", cells


def _service_and_wait(times: StageTimes | None) -> str:
    return f"{_number(times.service_ms.mean)} + {_number(times.wait_ms.mean)}" if times else DASH


def _byte_rows(runs: Sequence[PolicyMetrics]) -> Rows:
    """Yield two rows: the MB that each stage moves for a frame, and the MB that all stages move for a frame.

    The second row also has the ratio to the least bytes, and the rate in GB/s. Yields nothing if no run counts bytes.
    """
    if not any(run.bytes for run in runs):
        return
    counting = [stage for stage, times in runs[0].stages.items() if times.bytes]
    rows = [" ".join(_megabytes(_bytes_of(run, stage)) for stage in counting) for run in runs]
    yield "moved a frame", f"{' '.join(counting)}, MB", rows
    yield "", "all, MB (times the least); GB/s", [_all_moved(run) for run in runs]


def _bytes_of(run: PolicyMetrics, stage: str) -> MovedBytes | None:
    return run.stages[stage].bytes if stage in run.stages else None


def _all_moved(run: PolicyMetrics) -> str:
    if run.bytes is None:
        return DASH
    return f"{_megabytes(run.bytes)} ({_number(run.bytes.ratio, 2)}); {_number(run.bytes.gb_per_second, 2)}"


def _megabytes(moved: MovedBytes | None) -> str:
    return DASH if moved is None else f"{moved.all / 1e6:.2f}"


def _unit_rows(runs: Sequence[PolicyMetrics]) -> Rows:
    for unit in runs[0].units:
        known = runs[0].units[unit].idle
        causes = [cause for cause in type(known).model_fields if cause != "join" or cause in known.model_fields_set]
        yield unit, "busy / " + " ".join(causes) + ", %", [_shares(run.units.get(unit), causes) for run in runs]


def _shares(unit: UnitShares | None, causes: Iterable[str]) -> str:
    if unit is None:
        return DASH
    return f"{_percent(unit.busy)} / " + " ".join(_percent(getattr(unit.idle, cause)) for cause in causes)


def _core_rows(runs: Sequence[PolicyMetrics]) -> Rows:
    """Yield a row for each set of cores: the CPU time of its units, in % of the time that the cores had.

    Yields nothing for an older report, which does not have these shares.
    """
    for index, first in enumerate(runs[0].core_shares):
        shares = [run.core_shares[index] if index < len(run.core_shares) else None for run in runs]
        name = f"core{'s' if len(first.cores) > 1 else ''} {','.join(map(str, first.cores))}"
        cells = [_percent(share.cpu if share else None) for share in shares]
        yield name, f"CPU time of {', '.join(first.units)}, %", cells


def _percent(share: float | None) -> str:
    return DASH if share is None else f"{100 * share:.0f}"


def _time_rows(runs: Sequence[PolicyMetrics]) -> Rows:
    for key, name in (("frame_time_ms", "frame time"), ("latency_ms", "latency")):
        for statistic in STATISTICS:
            cells = [_time(run, getattr(run, key), statistic) for run in runs]
            yield name if statistic == "mean" else "", f"{statistic}, ms", cells


def _time(run: PolicyMetrics, times: TimeSummary, statistic: str) -> str:
    value = _number(_of_several(run, getattr(times, statistic)))
    if statistic == "mean" and times is run.frame_time_ms:
        return f"{value} ({_between(run.frame_time_ms.mean_low, run.frame_time_ms.mean_high)})"
    return value + (TOO_FEW if _too_few(times, statistic) else "")


def _too_few(times: TimeSummary, statistic: str) -> bool:
    """Return whether `statistic` is a percentile of too few samples. False for older reports, which count no samples.

    `times`: summary that has the statistic. `statistic`: name of the statistic, such as `p99`.
    """
    return times.samples is not None and times.samples < NEEDED.get(statistic, 0)


def _between(low: float | None, high: float | None) -> str:
    """Return the bounds of a 95 % interval as a text; TOO_SHORT if a bound is None, because the run was too short."""
    return TOO_SHORT if low is None or high is None else f"{_number(low)} to {_number(high)}"


def _skipped(report: Report) -> str:
    """Return a line that counts the presented frames that skipped stages; for a scene, also for each reason."""
    frames = report.frames
    if "pipeline" in report.config:
        return f"took the bypass: {frames.skipped} of {frames.presented} frames"
    composite, means = report.stages["composite"], report.stage_metrics.get("composite", {})
    why = {"reused": "reused", "nobody on the screen": "nobody", "without their picture": "stale"}
    counts = {said: round(means.get(key, 0.0) * composite.jobs) for said, key in why.items()}
    parts = ", ".join(f"{said} {count}" for said, count in counts.items() if count)
    return f"skipped raster and infer: {frames.skipped} of {frames.presented} frames ({parts})"


def _of_several(run: PolicyMetrics, value: float | None) -> float | None:
    """Return `value`, a statistic of `run`, or None if the run presented fewer than two frames."""
    return value if run.frames.presented > 1 else None


def _rate_rows(runs: Sequence[PolicyMetrics]) -> Rows:
    rates = [f"{_number(_of_several(run, run.fps))} ({_between(run.fps_low, run.fps_high)})" for run in runs]
    yield "rate", "frames per second", rates
    yield "efficiency", "slowest unit's work / frame time", [_number(run.efficiency, 2) for run in runs]
    yield "", "busiest core's work / frame time", [_number(run.core_efficiency, 2) for run in runs]
    yield "", "all work / time of all cores", [_number(run.machine_efficiency, 2) for run in runs]
    units, stages = ([getattr(run.bound, kind, None) for run in runs] for kind in ("unit", "stage"))
    is_slowed = any(part is not None and part.cost is not None for part in units)
    what = "% longer if 20 % slower" if is_slowed else f"% of the path ({CONFIDENCE_TEXT} interval)"
    yield "bound", f"unit, {what}", [_bounds(part, is_slowed=is_slowed) for part in units]
    yield "", f"stage, {what}", [_bounds(part, is_slowed=is_slowed) for part in stages]
    yield "frames", "lost + dropped + not begun", [_left_out(run.frames) for run in runs]
    yield "", "deadline misses", [str(run.deadline_misses) for run in runs]


def _left_out(frames: FrameCounts) -> str:
    not_begun = DASH if frames.not_begun is None else frames.not_begun
    return f"{frames.lost} + {sum(frames.dropped.values())} + {not_begun}"


def _bounds(part: PathShare | None, *, is_slowed: bool) -> str:
    """Return a text with the name of `part`, and what its slowing costs or, if unknown, its share of the critical path.

    `part`: unit or stage that bounds a run; None gives a dash. `is_slowed`: whether the row shows costs; a share is
    then marked as a share of the path.
    """
    if part is None:
        return DASH
    if part.cost is None:
        value, low, high = part.share, part.share_low, part.share_high
    else:
        value, low, high = part.cost, part.cost_low, part.cost_high
    between = "" if low is None or high is None else f" ({_percent(low)} to {_percent(high)})"
    of_path = " of the path" if is_slowed and part.cost is None else ""
    return f"{part.names if between else part.name} {_percent(value)}{between}{of_path}"


def _number(value: float | None, digits: int = 1) -> str:
    return DASH if value is None else f"{value:.{digits}f}"
