"""The run folder, the trace, the report and the table of a run, made from a run written by hand."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import Trace, TrackEvent

from trilane.apps.cli.run_table import run_table
from trilane.apps.report import Report, read_report, write_report
from trilane.apps.report_sources import NO_FIGURES_UNDER, sources_of
from trilane.apps.run_folder import RunFolder, default_place
from trilane.apps.trace import write_trace
from trilane.errors import BadInputError
from trilane.figure_sources import COMPARED, COMPUTED, MEASURED, NO_FIGURES
from trilane.scheduler.ledger import JobRecord

SHOWN = {
    "source": "from the avatar's validation of 2026-01-02",
    "runtime": "ort",
    "size": "256",
    "psnr_db_by_band": {"face": 31.25},
    "body_psnr_db": 28.75,
    "iou": 0.9812,
    "samples": 96,
    "by_seed": {"1": {}, "2": {}},
    "worst": {"psnr_db": 21.5},
}
TIMES = {"mean": 20.0, "p50": 20.0, "p90": 21.0, "p95": 22.0, "p99": 23.0, "max": 24.0}
SHARE = {
    "busy": 0.5,
    "idle": {"starved": 0.25, "blocked": 0.15, "throttled": 0.0, "preempted": 0.02, "overhead": 0.08},
    "jobs": 3,
    "restarts": 0,
    "pid": 7,
    "cores": [2, 3],
    "threads": 2,
    "spin": True,
}
MACHINE = {
    "system": "Linux",
    "python": "3.11",
    "trilane": None,
    "scheduler_core": "interpreted",
    "cpu": {
        "model": "a processor",
        "architecture": "x86_64",
        "flags": ["avx2"],
        "cores": 4,
        "cores_allowed": [0, 1, 2, 3],
    },
    "memory_bytes": 1 << 34,
    "gl": None,
    "packages": {"numpy": "2.0"},
}
JOBS = (
    JobRecord("pose", "cpu", 0, 1_000, 1_500, 2_000, 3_000),
    JobRecord("raster", "gpu", 0, 3_000, 3_500, 4_000, 9_000),
    JobRecord("pose", "cpu", 1, 3_000, 3_000, 4_000, 5_000),
)


def make_report(**changes: Any) -> dict[str, Any]:
    """What a run writes, with `changes`."""
    counts = {"requested": 3, "presented": 3, "lost": 0, "lost_by_cause": {}, "dropped": {"raster->infer:stale": 1}}
    run = {
        "frames": counts,
        "frame_time_ms": {**TIMES, "ema20_min": 19.0, "ema20_max": 21.0, "jitter": 0.5},
        "latency_ms": TIMES,
        "fps": 50.0,
        "deadline_misses": 0,
        "stages": {"infer": {"unit": "dsp", "service_ms": TIMES, "wait_ms": TIMES}},
        "units": {"dsp": SHARE},
        "core_shares": [{"cores": [2, 3], "units": ["cpu", "gpu"], "cpu": 0.8, "busy": 0.75}],
        "efficiency": 0.91,
    }
    config = {
        "policy": "pipelined",
        "runtime": "ort",
        "units": {"dsp": {"cores": [2, 3], "threads": 2, "spin": True}},
        "scene": {"name": "test", "size": "256", "output": {"width": 640, "height": 480}},
    }
    return {
        "schema": 1,
        "clock": "host",
        "machine": MACHINE,
        "config": config,
        "plan": {"tensor_shapes": [[256, 256]]},
        "caps": {"how": "none"},
        **run,
        "duration_s": 1.0,
        "xrbench": {"real_time": None, "qoe": 1.0, "energy": None},
        "isolated_ms": {},
        "policy": "pipelined",
        "edge": "double",
        "idle_cores": "wait awake",
        "temperature_c": {"sensor": None},
        "pids": {"dsp": 7},
        "startup_ms": {"dsp": 1.0},
        "figures": {"infer": {"a_ms": 1.0}},
        "messages": [],
        "interrupted": False,
        "failure": None,
        "baseline": {"policy": "sequential", **run, "efficiency": None},
        "accuracy": {"someone": SHOWN},
        "sources": {},
        "video": None,
        "checksum": None,
        **changes,
    }


def test_a_folder_has_its_name_once_it_is_complete(tmp_path: Path) -> None:
    target = tmp_path / "a" / "run"
    with RunFolder(target) as folder:
        (folder.work / "report.json").write_text("{}")
        assert not target.exists()
        assert folder.work.name.endswith(f"{os.getpid()}.partial")
        assert folder.complete() == target
    assert [path.name for path in target.iterdir()] == ["report.json"]
    assert [path.name for path in target.parent.iterdir()] == ["run"]


def test_a_folder_that_was_not_completed_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), RunFolder(tmp_path / "a" / "b" / "run") as folder:
        (folder.work / "half").write_text("half")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_exists_is_refused_and_kept(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine").write_text("mine")
    with pytest.raises(BadInputError, match="a name that is free"), RunFolder(tmp_path / "run"):
        pass
    assert (tmp_path / "run" / "mine").read_text() == "mine"


def test_a_place_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("a file")
    with pytest.raises(BadInputError, match="choose another --out"), RunFolder(tmp_path / "file" / "run"):
        pass


def test_a_name_taken_in_the_meantime_loses_nothing(tmp_path: Path) -> None:
    target = tmp_path / "run"
    with pytest.raises(BadInputError, match="the run is in"), RunFolder(target) as folder:
        (folder.work / "report.json").write_text("{}")
        target.mkdir()
        (target / "other").write_text("other")
        folder.complete()
    assert (folder.work / "report.json").exists()
    assert (target / "other").exists()


def test_the_default_place_is_free_and_named_after_the_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first = default_place("../my scene")
    assert first.parent == Path("runs")
    assert first.name.endswith("Z----my-scene")


def test_the_trace_has_a_track_per_unit_and_a_flow_per_frame(tmp_path: Path) -> None:
    write_trace(JOBS, ("cpu", "gpu", "dsp"), tmp_path / "trace.pftrace")
    trace = Trace()
    trace.ParseFromString((tmp_path / "trace.pftrace").read_bytes())
    tracks = {p.track_descriptor.uuid: p.track_descriptor.name for p in trace.packet if p.HasField("track_descriptor")}
    assert sorted(tracks.values()) == ["cpu", "gpu", "trilane"]
    begins = [p for p in trace.packet if p.track_event.type == TrackEvent.TYPE_SLICE_BEGIN]
    ends = [p for p in trace.packet if p.track_event.type == TrackEvent.TYPE_SLICE_END]
    found = {
        (p.track_event.name, tracks[p.track_event.track_uuid], p.timestamp, tuple(p.track_event.flow_ids))
        for p in begins
    }
    assert found == {("pose", "cpu", 2_000, (1,)), ("raster", "gpu", 4_000, (1,)), ("pose", "cpu", 4_000, (2,))}
    assert sorted(p.timestamp for p in ends) == [3_000, 5_000, 9_000]


def test_tracks_are_in_the_order_of_the_units_of_the_graph(tmp_path: Path) -> None:
    jobs = [JOBS[0]._replace(unit="npu"), JOBS[1]]
    write_trace(jobs, ("npu", "isp", "gpu"), tmp_path / "trace.pftrace")
    trace = Trace()
    trace.ParseFromString((tmp_path / "trace.pftrace").read_bytes())
    tracks = [p.track_descriptor for p in trace.packet if p.HasField("track_descriptor")]
    assert [(track.name, track.sibling_order_rank) for track in tracks[1:]] == [("npu", 0), ("gpu", 2)]


def test_a_report_is_read_back_from_its_folder(tmp_path: Path) -> None:
    write_report(Report.model_validate(make_report()), tmp_path / "report.json")
    report = read_report(tmp_path)
    assert report.frames.presented == 3
    assert report.stages["infer"].unit == "dsp"
    assert report.units["dsp"].idle.blocked == 0.15


def test_the_file_has_the_keys_that_were_set_in_the_order_of_the_model(tmp_path: Path) -> None:
    """A `pace`, a `bottleneck` that were never set are absent; whatever order they came in, the file's is one."""
    document = make_report()
    write_report(Report.model_validate(document), tmp_path / "report.json")
    written = json.loads((tmp_path / "report.json").read_text())
    assert written == document
    keys = [field.alias or name for name, field in Report.model_fields.items()]
    assert list(written) == [key for key in keys if key in document]
    assert keys[:7] == ["schema", "clock", "machine", "config", "plan", "caps", "frames"]


@pytest.mark.parametrize("change", [{"speed": 1.0}, {"caps": {"how": "none", "cap": 1}}])
def test_an_unknown_key_is_never_written(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="Extra inputs are not permitted"):
        Report.model_validate(make_report(**change))


def test_a_report_of_a_newer_schema_is_refused_as_such(tmp_path: Path) -> None:
    (tmp_path / "report.json").write_text(json.dumps({"schema": 2, "everything": "else"}))
    with pytest.raises(BadInputError, match="schema: found 2, expected 1; a newer Trilane"):
        read_report(tmp_path)


@pytest.mark.parametrize("text", ["", "[]", "{", "null"])
def test_a_file_that_is_no_report_is_a_bad_input(text: str, tmp_path: Path) -> None:
    (tmp_path / "report.json").write_text(text)
    with pytest.raises(BadInputError, match=r"report\.json: the document"):
        read_report(tmp_path)


@pytest.mark.parametrize(
    ("change", "named"),
    [({"fps": "fast"}, "fps"), ({"clock": "sun"}, "clock"), ({"units": {"dsp": {"busy": 1}}}, "units.dsp.idle")],
)
def test_a_damaged_report_is_named_with_its_key(tmp_path: Path, change: dict[str, Any], named: str) -> None:
    (tmp_path / "report.json").write_text(json.dumps(make_report(**change)))
    with pytest.raises(BadInputError, match=f"report.json: {named}"):
        read_report(tmp_path)


def test_a_missing_report_is_a_bad_input(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="no such file"):
        read_report(tmp_path / "nothing")


def test_a_report_never_holds_nan(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        write_report(Report.model_validate(make_report(fps=float("nan"))), tmp_path / "report.json")


def table_text(report: dict[str, Any]) -> str:
    """The table as it is printed, each line without its frames and double spaces."""
    from rich.console import Console

    console = Console(width=400, record=True, file=io.StringIO())
    console.print(run_table(Report.model_validate(report)))
    return "\n".join(" ".join(line.replace("│", " ").split()) for line in console.export_text().splitlines())


def test_the_table_shows_both_policies_and_dashes_what_was_not_measured() -> None:
    text = table_text(make_report())
    for expected in (
        "pipelined, 3 frames",
        "sequential, 3 frames",
        "20.0 + 20.0",
        "50 / 25 15 0 2 8",
        "CPU time of cpu, gpu, %",
        "0.91",
        "stages, units, times, rates: measured in this run",
        "PSNR on held-out views, dB: face 31.2; of the body alone 28.8; worst of 96 views (seeds 1, 2) 21.5; mask IoU",
        "0.981 (from the avatar's validation of 2026-01-02, on ort at tensor size 256)",
    ):
        assert expected in " ".join(text.split())
    efficiency = next(line for line in text.splitlines() if "efficiency" in line)
    assert "–" in efficiency


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


def test_the_table_says_when_and_by_what_it_was_made() -> None:
    made = {
        "at": "2026-11-22T01:00:00+00:00",
        "command": ["trilane", "run"],
        "trilane": "0.1.0",
        "revision": "0123456789abcdef",
        "modified": True,
    }
    assert "2026-11-22T01:00:00+00:00: trilane 0.1.0 at 0123456789, modified" in table_text(make_report(made=made))
    elsewhere = {**made, "revision": None, "modified": None}
    assert "2026-11-22T01:00:00+00:00: trilane 0.1.0\n" in table_text(make_report(made=elsewhere))


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


def figures_in(value: Any, above: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The keys to every number in a document."""
    if isinstance(value, dict):
        for key, below in value.items():
            yield from figures_in(below, (*above, key))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield above


def test_every_figure_of_a_report_has_a_source() -> None:
    paced = {"virtual_ms": 1.0, "ratio": 1.0, "measured_ms": 1.0}
    document = make_report(video={"frames": 3, "seconds": 0.1}, pace=paced, temperature_c={"sensor": 50.0})
    sources = sources_of(document)
    for path in figures_in(document):
        if path[0] not in NO_FIGURES_UNDER:
            assert any(".".join(path[:count]) in sources for count in range(1, len(path) + 1)), path
    assert set(sources.values()) == {MEASURED, COMPUTED, COMPARED, SHOWN["source"]}
    assert sources["accuracy.someone"] == SHOWN["source"]
    assert sources["fps"] == sources["stages"] == sources["temperature_c.sensor"] == MEASURED
    assert sources["temperature_c"] == sources["caps"] == sources["pace"] == COMPUTED


def test_what_a_report_has_not_has_no_source() -> None:
    assert not {"pace", "pace.ratio", "video"} & set(sources_of(make_report()))


def test_the_whole_table_is_as_it_was() -> None:
    """Every line of a report that has everything, in printed/run-table.txt; TRILANE_WRITE_PRINTED=1 writes it anew."""
    made = {
        "at": "2026-11-22T01:00:00+00:00",
        "command": ["trilane"],
        "trilane": "0.1.0",
        "revision": None,
        "modified": None,
    }
    cap = {"corner": "svs", "duty": 0.5, "duty_mean": 0.45}
    caps = {"how": "x", "performance_profile": "balanced", "units": {"dsp": cap}, "throttled_share": 0.25}
    pace = {
        "profile": "snapdragon-888",
        "performance_profile": "burst",
        "slow_motion": 4.0,
        "stage_ms": {"infer": 12.0},
        "host_slower": {"infer": 2},
        "late_frames": [3],
        "virtual_ms": 21.5,
        "measured_ms": 21.75,
        "compared_share": 0.5,
        "ratio": 1.0116,
    }
    temperature = {"sensor": None, "kind": "modelled", "device_end": 30.0, "device_max": 31.0, "junction_max": 44.5}
    report = make_report(
        made=made, caps=caps, pace=pace, temperature_c=temperature, fps_low=48.0, fps_high=52.0, core_efficiency=0.93
    )
    text = table_text(report).splitlines()
    file = Path(__file__).with_name("printed") / "run-table.txt"
    if "TRILANE_WRITE_PRINTED" in os.environ:
        file.write_text("\n".join(text) + "\n", encoding="utf-8")
    assert text == file.read_text(encoding="utf-8").splitlines()
