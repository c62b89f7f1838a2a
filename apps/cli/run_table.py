"""The table that `trilane run` ends with.

Rule: every figure is one of report.json's, and its source stands below the table; a figure that was not measured is a
dash.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from trilane.figure_sources import COMPUTED, MEASURED, NO_FIGURES

if TYPE_CHECKING:
    from rich.table import Table

    from trilane.apps.report import Baseline, PaceComparison, Report
    from trilane.pipeline.run_metrics import Caps, StageTimes, Temperature, UnitShares

DASH = "–"
IDLE = ("starved", "blocked", "throttled", "overhead")
UNSAID = "the report does not say where they come from"
STATISTICS = ("mean", "p50", "p90", "p95", "p99", "max")

#: Name of a row, what it measures, and a cell for each run.
Rows = Iterator[tuple[str, str, list[str]]]


def run_table(report: Report) -> Table:
    """Rows of stages, units, times and rates; a column for the run and one for its baseline."""
    from rich.table import Table

    runs: list[Report | Baseline] = [report, report.baseline] if report.baseline else [report]
    table = Table(title=_title(report), title_justify="left", caption=_caption(report), caption_justify="left")
    table.add_column("")
    table.add_column("")
    for run in runs:
        table.add_column(f"{run.policy}, {run.frames.presented} frames", justify="right")
    for section in (_stage_rows, _unit_rows, _time_rows, _rate_rows):
        for name, measure, cells in section(runs):
            table.add_row(name, measure, *cells)
        table.add_section()
    return table


def _title(report: Report) -> str:
    scene = report.config["scene"]
    return f"Scene {scene['name']}: {scene['output']['width']}x{scene['output']['height']}, tensor size {scene['size']}"


def _caption(report: Report) -> str:
    cpu, gl = report.machine.cpu, report.machine.gl
    cores = ", ".join(f"{unit} {','.join(map(str, shares.cores))}" for unit, shares in report.units.items())
    lines = [
        f"stages, units, times, rates: {MEASURED}",
        f"{cpu.model} ({' '.join(cpu.flags)}); cores: {cores}; idle cores {report.idle_cores}",
        f"network on {report.config['runtime']}; OpenGL on {gl.renderer if gl else DASH}",
    ]
    if report.pace:
        lines.append(_pace(report.pace))
    if report.caps.performance_profile:
        lines.append(_caps(report.caps, report.temperature_c))
    lines += [_accuracy(name, facts) for name, facts in report.accuracy.items()]
    return escape("\n".join(lines))


def _pace(pace: PaceComparison) -> str:
    slower = ", ".join(f"{stage} {count}" for stage, count in pace.host_slower.items()) or "none"
    slow_motion = f", {pace.slow_motion:g} times slower" if pace.slow_motion != 1 else ""
    return (
        f"held to {pace.profile}{slow_motion}: {_number(pace.measured_ms, 2)} ms a frame ({MEASURED}), in virtual time "
        f"{_number(pace.virtual_ms, 2)} ms ({COMPUTED}), ratio {_number(pace.ratio, 3)}; jobs too slow here: {slower}"
    )


def _caps(caps: Caps, temperature: Temperature) -> str:
    duties = ", ".join(f"{unit} {cap.duty_mean:.0%}" for unit, cap in caps.units.items())
    return (
        f"capped as {caps.performance_profile}: duty cycles {duties}; throttled "
        f"{caps.throttled_share:.0%} of the time; {temperature.kind}: at most "
        f"{_number(temperature.junction_max)} C ({COMPUTED})"
    )


def _accuracy(name: str, facts: Mapping[str, Any]) -> str:
    """The error of an avatar's pictures, and where its figures come from; else why there are none.

    A report that an older Trilane wrote does not say where its figures come from, so they are not shown.
    """
    source = facts.get("source", NO_FIGURES)
    if source == NO_FIGURES:
        return f"avatar {name}: {NO_FIGURES} of accuracy: {facts.get('why', UNSAID)}"
    bands = ", ".join(f"{band} {value:.1f}" for band, value in facts["psnr_db_by_band"].items())
    body = f"; of the body alone {facts['body_psnr_db']:.1f}" if "body_psnr_db" in facts else ""
    return (
        f"avatar {name}: PSNR on held-out views, dB: {bands}{body}{_worst(facts)}; mask IoU {facts['iou']:.3f} "
        f"({source}, on {facts['runtime']} at tensor size {facts['size']})"
    )


def _worst(facts: Mapping[str, Any]) -> str:
    if "worst" not in facts:
        return ""
    return f"; worst of {facts['samples']} views (seeds {', '.join(facts['by_seed'])}) {facts['worst']['psnr_db']:.1f}"


def _stage_rows(runs: Sequence[Report | Baseline]) -> Rows:
    for stage, times in runs[0].stages.items():
        cells = [_service_and_wait(run.stages.get(stage)) for run in runs]
        yield f"{stage} ({times.unit})", "service + wait, ms", cells


def _service_and_wait(times: StageTimes | None) -> str:
    return f"{_number(times.service_ms.mean)} + {_number(times.wait_ms.mean)}" if times else DASH


def _unit_rows(runs: Sequence[Report | Baseline]) -> Rows:
    for unit in runs[0].units:
        yield unit, "busy / " + " ".join(IDLE) + ", %", [_shares(run.units.get(unit)) for run in runs]


def _shares(unit: UnitShares | None) -> str:
    if unit is None:
        return DASH
    return f"{100 * unit.busy:.0f} / " + " ".join(f"{100 * getattr(unit.idle, cause):.0f}" for cause in IDLE)


def _time_rows(runs: Sequence[Report | Baseline]) -> Rows:
    for key, name in (("frame_time_ms", "frame time"), ("latency_ms", "latency")):
        for statistic in STATISTICS:
            cells = [_number(_of_several(run, getattr(getattr(run, key), statistic))) for run in runs]
            yield name if statistic == "mean" else "", f"{statistic}, ms", cells


def _of_several(run: Report | Baseline, value: float) -> float | None:
    """A time between frames, or a latency, needs two frames to be a statistic."""
    return value if run.frames.presented > 1 else None


def _rate_rows(runs: Sequence[Report | Baseline]) -> Rows:
    yield "rate", "frames per second", [_number(_of_several(run, run.fps)) for run in runs]
    yield "efficiency", "slowest unit isolated / frame time", [_number(run.efficiency, 2) for run in runs]
    yield "frames", "lost + dropped", [f"{run.frames.lost} + {sum(run.frames.dropped.values())}" for run in runs]


def _number(value: float | None, digits: int = 1) -> str:
    return DASH if value is None else f"{value:.{digits}f}"
