"""The table that `trilane run` ends with.

Rule: every figure is one of report.json's; a figure that was not measured is a dash.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from trilane.units import UNITS

if TYPE_CHECKING:
    from rich.table import Table

DASH = "–"
IDLE = ("starved", "blocked", "throttled", "overhead")
PERCENTILES = ("mean", "p50", "p90", "p95", "p99", "max")

Run = Mapping[str, Any]


def run_table(report: Run) -> Table:
    """Rows of stages, units, times and rates; a column for the run and one for its baseline."""
    from rich.table import Table

    runs = [report] + ([report["baseline"]] if report.get("baseline") else [])
    names = [str(report["config"]["policy"])] + [str(run["policy"]) for run in runs[1:]]
    table = Table(title=_title(report), title_justify="left", caption=_caption(report), caption_justify="left")
    table.add_column("")
    table.add_column("")
    for name, run in zip(names, runs, strict=True):
        table.add_column(f"{name}, {run['frames']['presented']} frames", justify="right")
    for section in (_stage_rows, _unit_rows, _time_rows, _rate_rows):
        for what, measure, cells in section(runs):
            table.add_row(what, measure, *cells)
        table.add_section()
    return table


def _title(report: Run) -> str:
    scene = report["config"]["scene"]
    return f"Scene {scene['name']}: {scene['output']['width']}x{scene['output']['height']}, tensor size {scene['size']}"


def _caption(report: Run) -> str:
    cpu, gl = report["machine"]["cpu"], report["machine"].get("gl")
    cores = ", ".join(f"{unit} {_cores(report, unit)}" for unit in UNITS if unit in report["config"]["units"])
    lines = [
        f"{cpu['model']} ({' '.join(cpu['flags'])}); cores: {cores}; idle cores {report['idle_cores']}",
        f"network on {report['config']['runtime']}; OpenGL on {gl['renderer'] if gl else DASH}",
    ]
    if "pace" in report:
        lines.append(_pace(report["pace"]))
    if "performance_profile" in report["caps"]:
        lines.append(_caps(report["caps"], report["temperature_c"]))
    lines += [_accuracy(name, facts) for name, facts in report.get("accuracy", {}).items()]
    return "\n".join(lines)


def _pace(pace: Mapping[str, Any]) -> str:
    slower = ", ".join(f"{stage} {count}" for stage, count in pace["host_slower"].items()) or "none"
    held = f"held to {pace['profile']}, {pace['slow_motion']:g} times slower" if pace["slow_motion"] != 1 else ""
    return (
        f"{held or 'held to ' + pace['profile']}: {_number(pace['measured_ms'], 2)} ms a frame, in virtual time "
        f"{_number(pace['virtual_ms'], 2)} ms (ratio {_number(pace['ratio'], 3)}); jobs too slow here: {slower}"
    )


def _caps(caps: Mapping[str, Any], temperature: Mapping[str, Any]) -> str:
    duties = ", ".join(f"{unit} {row['duty_mean']:.0%}" for unit, row in caps["units"].items())
    return (
        f"capped as {caps['performance_profile']}: duty cycles {duties}; throttled "
        f"{caps['throttled_share']:.0%} of the time; {temperature['kind']}: at most "
        f"{_number(temperature['junction_max'])} C"
    )


def _accuracy(name: str, facts: Mapping[str, Any]) -> str:
    bands = facts.get("psnr_db_by_band")
    psnr = ", ".join(f"{band} {value:.1f} dB" for band, value in bands.items()) if bands else DASH
    iou = f"{facts['iou']:.3f}" if "iou" in facts else DASH
    return f"avatar {name}: PSNR on held-out views {psnr}; mask IoU {iou}"


def _cores(report: Run, unit: str) -> str:
    return ",".join(str(core) for core in report["config"]["units"][unit]["cores"])


Rows = Iterator[tuple[str, str, list[str]]]


def _stage_rows(runs: list[Run]) -> Rows:
    for stage in runs[0]["stages"]:
        unit = runs[0]["stages"][stage]["unit"]
        cells = [_service_and_wait(run["stages"].get(stage)) for run in runs]
        yield f"{stage} ({unit})", "service + wait, ms", cells


def _service_and_wait(times: Mapping[str, Any] | None) -> str:
    if times is None:
        return DASH
    return f"{_number(times['service_ms'].get('mean'))} + {_number(times['wait_ms'].get('mean'))}"


def _unit_rows(runs: list[Run]) -> Rows:
    for unit in (name for name in UNITS if name in runs[0]["units"]):
        yield unit, "busy / " + " ".join(IDLE) + ", %", [_shares(run["units"].get(unit)) for run in runs]


def _shares(share: Mapping[str, Any] | None) -> str:
    if share is None:
        return DASH
    return f"{share['busy']:.0%} / ".replace("%", "") + " ".join(f"{100 * share['idle'][cause]:.0f}" for cause in IDLE)


def _time_rows(runs: list[Run]) -> Rows:
    for key, name in (("frame_time_ms", "frame time"), ("latency_ms", "latency")):
        for measure in PERCENTILES:
            yield (
                name if measure == "mean" else "",
                f"{measure}, ms",
                [_number(_of_several(run, run[key].get(measure))) for run in runs],
            )


def _of_several(run: Run, value: float | None) -> float | None:
    """A time between frames, or a latency, needs two frames to be a statistic."""
    return value if run["frames"]["presented"] > 1 else None


def _rate_rows(runs: list[Run]) -> Rows:
    yield "rate", "frames per second", [_number(_of_several(run, run["fps"])) for run in runs]
    yield "efficiency", "slowest unit alone / frame time", [_number(run["efficiency"], 2) for run in runs]
    yield (
        "frames",
        "lost + dropped",
        [f"{run['frames']['lost']} + {sum(run['frames']['dropped'].values())}" for run in runs],
    )


def _number(value: float | None, digits: int = 1) -> str:
    return DASH if value is None else f"{value:.{digits}f}"
