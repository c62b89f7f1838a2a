"""A run or a prediction as a small table of HTML, as a notebook shows it by itself.

Rule: every value is escaped; a speed stands beside the machine and the avatar's error, or the word that there is none.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from html import escape
from typing import TYPE_CHECKING, Any

from trilane.figure_sources import COMPUTED, MEASURED, NO_FIGURES

if TYPE_CHECKING:
    from trilane.apps.report import Report
    from trilane.pipeline.run_metrics import PathShare

#: Name of a row, its value, and where that comes from.
Row = tuple[str, str, str]
TOO_SHORT = "too short to tell"


def table(title: str, rows: Iterable[Row]) -> str:
    """A caption and a row for each figure."""
    body = "".join(
        f"<tr><th style='text-align:left'>{escape(name)}</th><td style='text-align:left'>{escape(value)}</td>"
        f"<td style='text-align:left'><small>{escape(source)}</small></td></tr>"
        for name, value, source in rows
    )
    caption = f"<caption style='text-align:left'><b>{escape(title)}</b></caption>"
    return f"<table>{caption}<tbody>{body}</tbody></table>"


def run_html(report: Report, folder: str) -> str:
    """The figures of a run that people ask for first."""
    return table(f"Run {folder}", _run_rows(report))


def _run_rows(report: Report) -> Iterable[Row]:
    measured = MEASURED if report.clock == "host" else COMPUTED
    times, latency, frames = report.frame_time_ms, report.latency_ms, report.frames
    if report.failure:
        yield "failed", report.failure, ""
    if frames.presented > 1:
        yield "frame time", f"{times.mean:.2f} ms ({_between(times.mean_low, times.mean_high)})", measured
        yield "rate", f"{report.fps:.1f} frames a second ({_between(report.fps_low, report.fps_high)})", measured
    for name, facts in report.accuracy.items():
        yield (f"error of {name}", *_error(facts))
    yield "latency", f"p50 {latency.p50:.1f} ms, p95 {latency.p95:.1f} ms", measured
    counts = f"{frames.presented} presented, {frames.lost} lost, {sum(frames.dropped.values())} dropped"
    yield "frames", counts + (f", {frames.not_begun} not begun" if frames.not_begun else ""), measured
    if report.bound is not None:
        yield "bound", ", ".join(_of_path(part) for part in (report.bound.unit, report.bound.stage) if part), measured
    for unit, shares in report.units.items():
        idle = ", ".join(f"{cause} {share:.0%}" for cause, share in shares.idle if share)
        yield unit, f"busy {shares.busy:.0%}; {idle}", measured
    scene = report.config["scene"]
    yield "scene", f"{scene['name']}, tensor size {scene['size']}, {report.policy}, {report.edge}", ""
    yield "machine", report.machine.cpu.model, ""


def _between(low: float | None, high: float | None) -> str:
    return TOO_SHORT if low is None or high is None else f"95 %: {low:.2f} to {high:.2f}"


def _of_path(part: PathShare) -> str:
    return f"{part.names} {part.share:.0%} of the path"


def _error(facts: Mapping[str, Any]) -> tuple[str, str]:
    """PSNR by band, and where it comes from; else why there is none."""
    if "psnr_db_by_band" not in facts:
        return NO_FIGURES, str(facts.get("why", ""))
    bands = ", ".join(f"{band} {value:.1f}" for band, value in facts["psnr_db_by_band"].items())
    return f"PSNR {bands} dB", str(facts.get("source", ""))


def prediction_html(title: str, rows: Mapping[str, str]) -> str:
    """The figures of a prediction; all are computed."""
    return table(title, ((name, value, COMPUTED) for name, value in rows.items()))
