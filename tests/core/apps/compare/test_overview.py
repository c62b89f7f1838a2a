"""The overview of many runs: its frontier is the non-dominated set, its rows are what the documents say."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import pytest

from trilane.apps.compare.overview import (
    Entry,
    entry_of,
    frontier,
    read_entries,
    table_rows,
    varied,
    write_csv,
    write_parquet,
)
from trilane.apps.compare.pages import Dot, overview_page, scatter
from trilane.errors import BadInputError

CPU = {"cpu": {"model": "<Chip>", "cores_allowed": [0, 1]}, "gl": {"renderer": "soft"}}
REPORT: dict[str, Any] = {
    "clock": "host",
    "machine": CPU,
    "made": {"command": ["trilane", "run"]},
    "config": {"policy": "pipelined", "scene": {"size": "256", "fps": 30.0}, "units": {"cpu": {}}, "cuts": []},
    "frame_time_ms": {"mean": 20.0, "mean_low": 19.0, "mean_high": 21.5},
    "latency_ms": {"mean": 60.0},
    "fps": 50.0,
    "accuracy": {"a": {"psnr_db": 31.0, "source": "from A"}, "b": {"psnr_db": 30.0, "source": "from B"}},
}


def test_a_report_becomes_a_row() -> None:
    entry = entry_of("r", REPORT)
    assert (entry.frame_ms, entry.low_ms, entry.high_ms, entry.frames_per_s, entry.latency_ms) == (20, 19, 21.5, 50, 60)
    assert (entry.psnr_db, entry.error_source) == (30.0, "from B")
    assert entry.settings == {"policy": "pipelined", "scene.size": "256", "scene.fps": "30"}
    assert entry.machine == "<Chip>, 2 cores, soft"
    assert (entry.command, entry.speed_source) == (("trilane", "run"), "measured in this run")
    assert (entry.interval, entry.error_of) == (
        "95 %, scatter of the run's frames",
        "errors of the avatars' validations",
    )


CHECK = {"psnr_db": 28.5, "frames": 4, "against": "the truth: the clothed body"}


def test_errors_against_the_truth_and_against_the_float_path_are_not_compared() -> None:
    groups = [
        entry_of("r", {**REPORT, "check": {**CHECK, "against": against}}).group
        for against in ("the truth: x", "the truth: y", "the float path: z")
    ]
    assert groups[0] == groups[1] != groups[2]


@pytest.mark.parametrize(
    ("change", "psnr_db", "source"),
    [
        ({"check": CHECK}, 28.5, "measured in this run, 4 frames against the truth"),
        ({"accuracy": {}}, None, "no figures"),
        ({"accuracy": {"a": {"psnr_db": 31.0}, "b": {"why": "changed"}}}, None, "no figures: changed"),
    ],
)
def test_an_error_says_where_it_comes_from(change: dict[str, Any], psnr_db: float | None, source: str) -> None:
    entry = entry_of("r", REPORT | change)
    assert (entry.psnr_db, entry.error_source) == (psnr_db, source)


def test_a_prediction_is_computed() -> None:
    document = {
        "clock": "virtual",
        "machine": {"title": "A phone"},
        "frame_time_ms": {"mean": 9.0, "low": 8, "high": 11},
    }
    entry = entry_of("p", document)
    assert (entry.machine, entry.low_ms, entry.high_ms, entry.speed_source) == ("A phone", 8.0, 11.0, "computed")
    assert entry.interval == "80 %, of the model"


def test_the_worst_frame_stands_beside_the_mean_and_is_the_runs_own() -> None:
    check = {"psnr_db": 38.5, "worst_psnr_db": 24.0, "p1_psnr_db": 26.5, "frames": 8}
    entry = entry_of("r", REPORT | {"check": check})
    assert (entry.psnr_db, entry.worst_psnr_db, entry.p1_psnr_db) == (38.5, 24.0, 26.5)
    (row,) = table_rows([entry])
    assert (row["worst_psnr_db"], row["p1_psnr_db"]) == (24.0, 26.5)
    without = entry_of("r", REPORT)
    assert without.psnr_db == 30.0 and (without.worst_psnr_db, without.p1_psnr_db) == (None, None)


SCENE = {
    "name": "far",
    "output": {"width": 640, "height": 480},
    "camera": {"source": "builtin:orbit"},
    "avatars": [{"motion": "walk.bvh", "bundle": "a"}],
    "background": "room",
    "size": "256",
}


def test_what_is_shown_says_nothing_of_what_it_costs() -> None:
    first = entry_of("1", REPORT | {"config": {"scene": SCENE}})
    assert first.shows == "far, 640x480, builtin:orbit, walk.bvh, room"
    cheaper = SCENE | {"size": "128", "avatars": [{"motion": "walk.bvh", "bundle": "b"}]}
    assert entry_of("2", REPORT | {"config": {"scene": cheaper}}).group == first.group


@pytest.mark.parametrize(
    "change",
    [
        {"config": {"scene": SCENE | {"name": "near"}}},
        {"config": {"scene": SCENE | {"camera": {"source": "phone.txt"}}}},
        {"config": {"scene": SCENE | {"output": {"width": 1280, "height": 720}}}},
        {"config": {"scene": SCENE | {"frames": 60}}},
        {"config": {"scene": SCENE | {"fps": 15.0}}},
        {"config": {"scene": SCENE | {"avatars": [{"motion": "walk.bvh", "start_s": 2.0}]}}},
        {"config": {"scene": SCENE | {"avatars": [{"motion": "walk.bvh", "position": [1.0, 0.0, 0.0]}]}}},
        {"config": {"scene": SCENE | {"camera": {"source": "builtin:orbit", "fov_y_deg": 20.0}}}},
        {"check": {"psnr_db": 39.0, "frames": 4}},
        {"machine": {"title": "Another"}},
        {"clock": "virtual"},
    ],
    ids=["scene", "camera", "picture", "frames", "rate", "part", "place", "lens", "kind of error", "machine", "clock"],
)
def test_errors_and_times_of_different_kinds_are_not_compared(change: dict[str, Any]) -> None:
    """The other entry is quicker and has fewer errors, but of something else: both stay on their frontiers."""
    slow = entry_of("slow", REPORT | {"config": {"scene": SCENE}})
    other = REPORT | {"config": {"scene": SCENE}, "frame_time_ms": {"mean": 2.0}}
    quick = other | {"accuracy": {"a": {"psnr_db": 50.0, "source": "from A"}}}
    assert frontier([slow, entry_of("quick", quick)]) == [False, True]
    assert frontier([slow, entry_of("else", quick | change)]) == [True, True]


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, 10**400, True, "12", None])
def test_what_is_no_number_is_no_figure(number: Any) -> None:
    document = REPORT | {"frame_time_ms": {"mean": number, "mean_low": number, "mean_high": 1.0}, "fps": number}
    entry = entry_of("r", document | {"check": {"psnr_db": number, "frames": 2}})
    assert (entry.frame_ms, entry.low_ms, entry.high_ms, entry.frames_per_s, entry.psnr_db) == (None,) * 4 + (30.0,)
    assert (entry.speed_source, entry.interval) == ("", "")
    overview_page("t", [entry])


def test_half_a_surrogate_pair_is_written_as_a_question_mark(tmp_path: Path) -> None:
    """As of a file's name that is no UTF-8."""
    entry = entry_of("r", REPORT | {"made": {"command": ["trilane", "\udcff.toml"]}, "failure": "\ud800"})
    assert (entry.command, entry.failure) == (("trilane", "?.toml"), "?")
    overview_page("t", [entry]).encode()
    write_csv(tmp_path / "t.csv", [entry])


def test_a_command_can_be_typed_again() -> None:
    document = REPORT | {"made": {"command": ["trilane", "run", "my scene's.toml"]}}
    assert table_rows([entry_of("r", document)])[0]["command"] == """trilane run 'my scene'"'"'s.toml'"""


def test_only_what_differs_is_a_column() -> None:
    one, two = entry_of("1", REPORT), entry_of("2", REPORT | {"config": {"policy": "latest", "encoder": "resnet18"}})
    assert varied([one, two]) == ["policy"]
    assert list(table_rows([one, two])[0])[:2] == ["name", "policy"]
    assert [row["policy"] for row in table_rows([one, two])] == ["pipelined", "latest"]


OPTIONS = {"size": "128", "scene": "far.toml"}


def _sweep(folder: Path) -> Path:
    folder.mkdir()
    trial = {"id": "ab", "command": ["trilane", "run"], "options": OPTIONS, "status": "done", "result": REPORT}
    lost = {"id": "cd", "status": "failed", "exit_code": 3, "options": {"size": "64"}, "folder": "../../etc"}
    lost["error"] = "error: no such scene"
    lines = [json.dumps(trial), json.dumps(lost), '{"id": "torn']
    (folder / "trials.jsonl").write_text("\n".join(lines))
    return folder


def test_folders_of_runs_and_sweeps_are_read(tmp_path: Path) -> None:
    run = tmp_path / "runs" / "one"
    run.mkdir(parents=True)
    (run / "report.json").write_text(json.dumps(REPORT))
    (tmp_path / "runs" / "two.7.partial").mkdir()
    entries = read_entries([tmp_path / "runs", _sweep(tmp_path / "sweep"), run / "report.json"])
    assert [entry.name for entry in entries] == ["one", "128, far.toml", "64", "report"]
    assert (entries[1].settings["size"], entries[1].frame_ms) == ("128", 20.0)
    assert (entries[1].settings["scene"], entries[1].settings["scene.size"]) == ("far.toml", "256")
    assert (entries[2].failure, entries[2].frame_ms, entries[2].video) == (
        "failed, exit code 3: error: no such scene",
        None,
        None,
    )


@pytest.mark.parametrize(
    ("content", "found"), [("{", "column"), ("[1]", "a list"), ("[" * 100_000, "recursion"), ("", "empty")]
)
def test_what_is_no_document_is_named(tmp_path: Path, content: str, found: str) -> None:
    (tmp_path / "report.json").write_text(content)
    with pytest.raises(BadInputError, match=rf"report\.json.*{found}"):
        read_entries([tmp_path])


@pytest.mark.parametrize("folder", ["x" * 300, "a\0b", ".."])
def test_a_trial_whose_folder_cannot_be_has_no_video(tmp_path: Path, folder: str) -> None:
    (tmp_path / "video.mp4").touch()
    sweep = _sweep(tmp_path / "sweep")
    trial = {"id": "ab", "status": "done", "result": REPORT, "folder": folder}
    (sweep / "trials.jsonl").write_text(json.dumps(trial) + "\n")
    (entry,) = read_entries([sweep])
    assert (entry.video, entry.frame_ms) == (None, 20.0)


def test_one_damaged_run_of_many_is_a_row(tmp_path: Path) -> None:
    for name, text in {"bad": "{", "good": json.dumps(REPORT)}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "report.json").write_text(text)
    (_sweep(tmp_path / "torn") / "trials.jsonl").write_text("x\n{}\n")
    bad, good, torn = read_entries([tmp_path])
    assert (good.name, good.frame_ms, good.failure) == ("good", 20.0, "")
    assert (bad.frame_ms, torn.frame_ms) == (None, None)
    assert bad.failure.startswith(f"cannot be read: {tmp_path / 'bad' / 'report.json'}: ")
    assert "line 1: found no trial" in torn.failure
    with pytest.raises(BadInputError, match="bad"):
        read_entries([tmp_path / "bad", tmp_path / "good"])


def test_entries_of_one_name_are_told_apart(tmp_path: Path) -> None:
    for name in ("left", "right"):
        _sweep(tmp_path / name)
    other = _sweep(tmp_path / "other")
    (other / "trials.jsonl").write_text('{"id": "ef", "status": "done"}\n')
    names = [f"{sweep}/{name}" for sweep in ("left", "right") for name in ("128, far.toml", "64")]
    assert [entry.name for entry in read_entries([tmp_path])] == [*names[:2], "ef", *names[2:]]


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ([{"size": 256, "check": 2}, {"size": 384, "check": 2}], ["256", "384"]),
        ([{"size": 256, "runtime": "ort"}, {"size": 384, "runtime": "ort"}], ["256", "384"]),
        ([{"size": 256, "edge": "double"}, {"size": 384, "edge": "single"}], ["256, double", "384, single"]),
        (
            [{"size": 256, "channels": 8}, {"size": 384, "channels": 16}],
            ["size 256, channels 8", "size 384, channels 16"],
        ),
        ([{"hud": True}, {"hud": False}], ["hud", "no hud"]),
        ([{"size": 256}, {}], ["256", "1"]),
        ([{"size": 256}], ["0"]),
        ([{"size": 256}, {"size": 256}, {"size": 384}], ["256, repeat 1", "256, repeat 2", "384"]),
    ],
)
def test_trials_are_named_by_what_differs(tmp_path: Path, options: list[dict[str, Any]], names: list[str]) -> None:
    trials = [
        {"id": str(number), "status": "done", "options": each, "repeat": 1 + (number == 1)}
        for number, each in enumerate(options)
    ]
    (tmp_path / "trials.jsonl").write_text("".join(f"{json.dumps(trial)}\n" for trial in trials))
    entries = read_entries([tmp_path])
    assert [entry.name for entry in entries] == names
    assert [entry.trial for entry in entries] == [trial["id"] for trial in trials]


def test_a_folder_without_runs_is_refused(tmp_path: Path) -> None:
    for place in (tmp_path, tmp_path / "none"):
        with pytest.raises(BadInputError, match="a run folder"):
            read_entries([place])


def test_the_page_escapes_and_asks_nobody() -> None:
    document = REPORT | {"made": {"command": ["trilane", "<script>alert(1)</script>"]}}
    text = overview_page("<b>title</b>", [entry_of("<i>", document), entry_of("two", REPORT | {"accuracy": {}})])
    assert text.count("<script>") == 1
    assert "<b>title" not in text
    assert "<i>" not in text
    assert "http:" not in text.replace("http://www.w3.org", "")
    assert "https:" not in text
    assert "1 of 2 have no speed or no known error" in text
    assert text.count("prefers-color-scheme: dark") == 1


def test_the_page_names_the_knee_first() -> None:
    speeds = {"quick": (10.0, 30.0), "bend": (12.0, 36.0), "slow": (20.0, 36.25)}
    entries = [
        Entry(name, "host", "a machine", {}, frame_ms=ms, psnr_db=db, other_programs=0.0125)
        for name, (ms, db) in speeds.items()
    ]
    text = overview_page("t", entries)
    said = (
        "Knee: bend has 12.0 ms a frame and 36.0 dB. The best picture, slow, takes 8.0 ms more for 0.25 dB. "
        "The quickest, quick, saves 2.0 ms and loses 6.0 dB."
    )
    assert text.index(said) < text.index("<svg")
    assert text.count('class="ring"') == 1
    assert '<td class="number" data-value="0.0125">1.2 %</td>' in text
    no_knee = "No knee: the quickest, quick, has 10.0 ms a frame and 30.0 dB. The best picture, bend, takes 2.0 ms more"
    assert f"{no_knee} for 6.00 dB." in overview_page("t", entries[:2])
    worse = Entry("slow", "host", "a machine", {}, frame_ms=30.0, psnr_db=30.05)  # a difference that nobody sees
    best = "Best: quick has 10.0 ms a frame and 30.0 dB, the quickest and the best picture."
    assert best in overview_page("t", [entries[0], worse])
    assert "Best:" not in overview_page("t", entries[:1])


def test_names_of_a_drawing_meet_no_other_name() -> None:
    """Three dots at one place: there is room above and below."""
    drawn = scatter(
        [Dot(name, 10.0, None, None, 30.0, True, 0, name == "knee") for name in ("a", "b", "knee")], "x", "y"
    )
    assert [name in drawn for name in (">knee</text>", ">a</text>", ">b</text>")] == [True, True, False]


def test_a_dot_stands_where_its_numbers_say() -> None:
    """Two dots: the axes reach a twentieth beyond them, so they stand at 1/22 and 21/22 of 640 by 336 pixels."""
    drawn = scatter([Dot("a", 10.0, None, None, 30.0, True, 0), Dot("b", 20.0, 18.0, 20.0, 31.0, True, 0)], "x", "y")
    assert '<circle class="g0" cx="93.1" cy="336.7" r="5"/>' in drawn
    assert '<circle class="g0" cx="674.9" cy="31.3" r="5"/>' in drawn
    assert '<line class="interval" x1="558.5" x2="674.9"' in drawn
    assert '<path class="frontier g0" d="M93.1 336.7 H674.9 V31.3"/>' in drawn
    assert scatter([], "x", "y") == ""


def test_tables_have_the_same_rows(tmp_path: Path) -> None:
    entries: list[Entry] = read_entries([_sweep(tmp_path / "sweep")])
    write_csv(tmp_path / "t.csv", entries)
    with (tmp_path / "t.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == list(table_rows(entries)[0])
    assert [(row["name"], row["frame_ms"], row["on_frontier"]) for row in rows] == [
        ("128, far.toml", "20.0", "True"),
        ("64", "", "False"),
    ]
    parquet = pytest.importorskip("pyarrow.parquet")
    write_parquet(tmp_path / "t.parquet", entries)
    assert parquet.read_table(tmp_path / "t.parquet").to_pylist() == table_rows(entries)
