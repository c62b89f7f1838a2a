"""The table of a run: every line of it, from reports that were written by hand."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import pytest

from support.run_report import SHARE, SHOWN, TIMES, make_report
from trilane.apps.cli.run import run_table
from trilane.apps.run.report import Report
from trilane.units import NO_FIGURES


def table_text(report: dict[str, Any]) -> str:
    """The table as it is printed, each line without its frames and double spaces."""
    from rich.console import Console

    console = Console(width=400, markup=False, record=True, file=io.StringIO())
    console.print(run_table(Report.model_validate(report)))
    return "\n".join(" ".join(line.replace("│", " ").split()) for line in console.export_text().splitlines())


@pytest.mark.parametrize(
    ("samples", "marked"), [(None, ()), (28, ("p90", "p95", "p99")), (58, ("p95", "p99")), (298, ("p99",)), (299, ())]
)
def test_a_percentile_of_too_few_frames_is_marked(samples: int | None, marked: tuple[str, ...]) -> None:
    report = make_report()
    report["latency_ms"] = {**TIMES, "samples": samples}
    text = table_text(report | {"baseline": None})
    rows = text[text.index("latency mean") :].splitlines()[1:6]
    assert {row.split(",")[0] for row in rows if row.endswith("*")} == set(marked)
    assert ("* of too few frames: p90 needs 29, p95 needs 59, p99 needs 299" in text) == bool(marked)


def test_bytes_stand_by_stage_and_in_all_beside_the_least() -> None:
    """0.5 + 0.25 + 1 + 0.75 MB of one stage, nothing of another; a third does not count, nor did the baseline."""
    moved = {"read": 5e5, "written": 2.5e5, "uploaded": 1e6, "read_back": 7.5e5, "least": 1e6, "ratio": 2.5}
    nothing = dict.fromkeys(moved, 0.0) | {"ratio": None}
    made = make_report(bytes=moved | {"gb_per_second": 0.125})
    row = made["stages"]["infer"]
    made["stages"] = {"raster": row | {"bytes": moved}, "infer": row | {"bytes": nothing}, "other": row}
    text = table_text(made)
    assert "moved a frame raster infer, MB 2.50 0.00 – –\nall, MB (times the least); GB/s 2.50 (2.50); 0.12 –\n" in text
    assert "moved" not in table_text(make_report())


def test_mean_and_rate_stand_with_their_interval_or_as_too_short() -> None:
    known = make_report(fps_low=48.0, fps_high=52.25)
    known["frame_time_ms"] = {**known["frame_time_ms"], "mean_low": 19.14, "mean_high": 20.83}
    text = table_text(known | {"baseline": None})
    assert "frame time mean, ms 20.0 (19.1 to 20.8)" in text
    assert "rate frames per second 50.0 (48.0 to 52.2)" in text
    short = table_text(make_report(baseline=None))
    assert "frame time mean, ms 20.0 (too short to tell)" in short
    assert "rate frames per second 50.0 (too short to tell)" in short


def test_a_cap_is_said_once_and_apart_from_what_heat_did() -> None:
    """63 % of the time throttled by the duty that was asked for, none of it for heat: no line says throttled 0 %."""
    cap = {"corner": "svs2", "duty": 0.37, "duty_mean": 0.37}
    caps = {"how": "x", "performance_profile": "low_power_saver", "units": {"dsp": cap}, "throttled_share": 0.0}
    idle = {"starved": 0.07, "blocked": 0.0, "throttled": 0.63, "preempted": 0.0, "overhead": 0.0}
    share = {**SHARE, "busy": 0.3, "idle": idle}
    text = table_text(make_report(caps=caps, units={"dsp": share}, baseline=None)).replace("\n", " ")
    assert "30 / 7 0 63 0 0" in text
    assert "duty cycles dsp 37%, which is the most that units may work; lowered further for heat 0% of the time" in text
    assert text.count("throttled") == 1  # the column


def test_the_error_of_the_run_itself_stands_beside_its_speed() -> None:
    errors = {"psnr_db": 31.26, "worst_psnr_db": 28.0, "mae": 1.756, "ssim": None, "flip": 0.04, "iou": 0.9}
    path = {**errors, "against": "the float path", "psnr_db": 40.5}
    check = {**errors, "against": "the truth", "p1_psnr_db": 28.07, "frames": 3, "numbers": (1, 2, 3)}
    text = table_text(make_report(check={**check, "float_path": path})).replace("\n", " ")
    rest = "worst 28.0; MAE 1.76 of 255; FLIP 0.040; IoU of all but background 0.900 (measured in this run)"
    first = f"of this run, 3 frames against the truth: PSNR mean 31.3 dB, 1st percentile 28.1, {rest}"
    second = f"of this run, 3 frames against the float path: PSNR mean 40.5 dB, 1st percentile –, {rest}"
    assert f"{first} {second}" in text
    assert "against the float path" not in table_text(make_report(check=check))


NO_ONES = {"source": NO_FIGURES, "changed": ["texture"], "why": "changed since the validation: [red]the texture[/red]"}


@pytest.mark.parametrize(
    ("facts", "why"),
    [
        (NO_ONES, NO_ONES["why"]),
        (
            {key: value for key, value in SHOWN.items() if key != "source"},
            "the report does not say where they come from",
        ),
        ({}, "the report does not say where they come from"),
    ],
)
def test_the_table_says_why_there_are_no_figures_and_shows_none(facts: dict[str, Any], why: str) -> None:
    text = " ".join(table_text(make_report(accuracy={"someone": facts})).split())
    assert f"avatar someone: no figures of accuracy: {why}" in text
    assert "31.2" not in text and "0.981" not in text


MADE = {
    "at": "2026-11-22T01:00:00+00:00",
    "command": ["trilane"],
    "trilane": "0.1.0",
    "revision": None,
    "modified": None,
}
CAP = {"corner": "svs", "duty": 0.5, "duty_mean": 0.45}
PACE = {
    "profile": "snapdragon-888",
    "performance_profile": "burst",
    "slow_motion": 4.0,
    "stage_ms": {"infer": 12.0},
    "host_slower": {"infer": 2, "pose": 1},
    "late_frames": [3],
    "virtual_ms": 21.5,
    "measured_ms": 21.75,
    "compared_share": 0.5,
    "ratio": 1.0116,
}


def least() -> dict[str, Any]:
    """One frame without a baseline, of which nothing more is known than of any."""
    unmeasured = dict.fromkeys(("efficiency", "core_efficiency", "machine_efficiency", "bottleneck", "bound"))
    report = make_report(baseline=None, accuracy={}, core_shares=[], deadline_misses=4, **unmeasured)
    counts = {"requested": 7, "presented": 1, "lost": 2, "lost_by_cause": {"died:gpu": 2}, "dropped": {}}
    report["frames"] = {**counts, "not_begun": 4}
    idle = {**SHARE["idle"], "preempted": None}
    report["units"] = {"dsp": {**SHARE, "idle": idle}, "cpu": {**SHARE, "cores": [0]}}
    made = {**MADE, "trilane": None, "revision": "0123456789abcdef", "modified": False}
    pace = {**PACE, "slow_motion": 1.0, "host_slower": {}, "measured_ms": None, "ratio": None}
    gl = {"vendor": "v", "renderer": "a [driver]", "version": "4", "hardware": True, "limits": {}}
    return report | {"made": made, "pace": pace, "machine": {**report["machine"], "gl": gl}}


def most() -> dict[str, Any]:
    """A report that has everything there is to say; its baseline has other figures, one stage, unit and core less."""

    def times(base: float) -> dict[str, float]:
        return {name: base + place for place, name in enumerate(("mean", "p50", "p90", "p95", "p99", "max"))}

    def run(base: float, names: tuple[str, ...], lost: int, dropped: dict[str, int]) -> dict[str, Any]:
        units = dict(zip(("cpu", "gpu", "dsp"), names, strict=False))
        return {
            "frames": {
                "requested": 400,
                "presented": 300 + lost,
                "lost": lost,
                "lost_by_cause": {},
                "dropped": dropped,
            },
            "frame_time_ms": {**times(base), "samples": 299, "ema20_min": 1.0, "ema20_max": 2.0, "jitter": 0.5}
            | {"mean_low": base - 0.25, "mean_high": base + 0.25},
            "latency_ms": {**times(base + 30), "samples": 300},
            "fps": 1000 / base,
            "fps_low": 10.0 + lost,
            "fps_high": 20.0 + lost,
            "deadline_misses": 10 + lost,
            "stages": {
                name: {"unit": unit, "service_ms": times(base + 40 + len(name)), "wait_ms": times(base + 50)}
                for unit, name in units.items()
            },
            "units": {unit: {**SHARE, "busy": base / 100, "cores": [0, len(unit)]} for unit in units},
            "core_shares": [
                {"cores": list(range(cores + 1)), "units": list(units)[: cores + 1], "cpu": base / 50, "busy": 0.75}
                for cores in range(len(names) - 1)
            ],
            "efficiency": base / 20,
        }

    first = run(11.25, ("pose", "raster", "infer"), 3, {"pose->raster:stale": 4, "raster->infer:late": 5})
    second = run(17.5, ("pose", "raster"), 0, {})
    caps = {"units": {"dsp": CAP, "gpu": {**CAP, "duty_mean": 0.5}}, "throttled_share": 0.25}
    temperature = {"sensor": None, "kind": "modelled", "device_end": 30.0, "device_max": 31.0, "junction_max": 44.5}
    others = {name: SHOWN | {"source": NO_FIGURES, "why": f"the {name} was changed"} for name in ("body", "texture")}
    return make_report(
        **first,
        policy="latest",
        baseline={"policy": "sequential", **second},
        made=MADE,
        caps={"how": "x", "performance_profile": "balanced", **caps},
        pace=PACE,
        temperature_c=temperature,
        accuracy={"someone": SHOWN, **others},
    )


@pytest.mark.parametrize(("name", "make"), [("", most), ("-least", least)])
def test_the_whole_table_is_as_it_was(
    name: str, make: Callable[[], dict[str, Any]], check_printed: Callable[[str, str], None]
) -> None:
    """Every line, in printed/run-table*.txt."""
    check_printed(f"run-table{name}", table_text(make()))


def test_frames_that_took_the_bypass_are_said_for_a_scene_with_reasons_and_for_a_file_without() -> None:
    """A file's stages have any names; those of a scene have a `composite`, which says why 3 of 4 frames were spared."""
    scene = make_report(baseline=None)
    scene["frames"] = {**scene["frames"], "requested": 4, "presented": 4, "dropped": {}, "not_begun": 0, "skipped": 3}
    scene["stages"]["composite"] = {**scene["stages"]["infer"], "jobs": 4}
    scene["figures"] = {"composite": {"reused": 0.5, "nobody": 0.25}}
    text = table_text(scene)
    assert "skipped raster and infer: 3 of 4 frames (reused 2, nobody on the screen 1)" in text
    file = make_report(baseline=None, frames=scene["frames"])
    file["config"] = {**file["config"], "pipeline": {"file": "street.toml"}}
    assert "took the bypass: 3 of 4 frames" in table_text(file)
