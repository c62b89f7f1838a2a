"""What `trilane compare` says of runs whose difference is known, and what it refuses."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from math import log
from pathlib import Path
from typing import Any

import pytest

from support.compared_runs import simulated, write_run
from support.run_folders import locked
from support.run_report import make_report
from trilane.apps.compare import run_frames
from trilane.apps.compare.comparison import NO_DIFFERENCE, TOO_FEW, Comparison, compare, document, signed
from trilane.apps.compare.difference import Chance, Difference, Finding
from trilane.apps.compare.gate import GatedPair, LimitOutcome, judge, read_gate, whole
from trilane.apps.compare.pages import comparison_page
from trilane.apps.compare.rows import SHARE, Figure, noise_between, remarks
from trilane.apps.compare.run_frames import Key, frames_of
from trilane.apps.compare.sides import Change, ComparedRun, RunKind, Side, changes, compared_run, read_side, read_told
from trilane.errors import BadInputError
from trilane.pipeline.journal import NAME, JournalWriter, Worked, journal_of
from trilane.scheduler.virtual import Simulation

Make = Callable[..., Path]
Command = Callable[..., tuple[str, str]]


def told(run: Simulation, name: str = "run", **changes: Any) -> ComparedRun:
    assert run.recording is not None
    frames = frames_of(journal_of(run.recording, run.jobs, {}, run.report))
    report = make_report(**{**run.report, "policy": run.recording.settings.policy, **changes})
    return compared_run(name, RunKind.RUN, report, frames)


def reported(name: str = "run", **changes: Any) -> ComparedRun:
    """A run that has only its report."""
    return compared_run(name, RunKind.REPORT, make_report(**changes))


def pair(base: ComparedRun, other: ComparedRun) -> Comparison:
    return compare(Side(base.name, (base,)), Side(other.name, (other,)))


@pytest.fixture
def make(tmp_path: Path) -> Make:
    def write(name: str, seed: int = 1, *, policy: str = "pipelined", factors: Any = None, **changes: Any) -> Path:
        return write_run(tmp_path / name, simulated(seed, policy=policy, frames=80, factors=factors), **changes)

    return write


def test_series_of_frames_are_those_of_the_report() -> None:
    """Means of the series, computed from the journal, beside the ledger's own."""
    run = simulated(7, frames=60)
    mine = told(run)
    assert mine.frames is not None
    series, report = mine.frames.series, run.report
    assert series[Key("frame time")].values.mean() == pytest.approx(report["frame_time_ms"]["mean"], rel=1e-6)
    assert series[Key("latency")].values.mean() == pytest.approx(report["latency_ms"]["mean"], rel=1e-6)
    for stage, row in report["stages"].items():
        assert series[Key("service", stage)].values.mean() == pytest.approx(row["service_ms"]["mean"], rel=1e-6)
        assert series[Key("wait", stage)].values.mean() == pytest.approx(row["wait_ms"]["mean"], abs=1e-6)
    for unit, row in report["units"].items():
        found = {key.cause or "busy": each for key, each in series.items() if key.of == unit}
        ms = {state: float(each.values.sum()) for state, each in found.items()}
        assert sum(ms.values()) == pytest.approx(series[Key("frame time")].values.sum(), rel=1e-9)
        assert ms["busy"] / sum(ms.values()) == pytest.approx(row["busy"], abs=0.02)
        assert ms["starved"] / sum(ms.values()) == pytest.approx(row["idle"]["starved"], abs=0.02)


def test_of_a_long_run_the_last_frames_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    run = simulated(3, frames=120)
    whole = told(run).frames
    monkeypatch.setattr(run_frames, "MOST_FRAMES", 20)
    monkeypatch.setattr(run_frames, "IN_FLIGHT", 10)
    last = told(run).frames
    assert whole is not None and last is not None and whole.series.keys() == last.series.keys()
    for key, series in last.series.items():
        assert 20 <= len(series.values) < 70
        assert series.frames[-20:].tolist() == whole.series[key].frames[-20:].tolist()
        assert series.values[-20:] == pytest.approx(whole.series[key].values[-20:], abs=1e-9)


def test_runs_of_one_kind_do_not_differ() -> None:
    runs = [told(simulated(seed, frames=80), f"run {seed}") for seed in range(20)]
    said = [pair(*both).verdict for both in zip(runs[::2], runs[1::2], strict=True)]
    assert said.count(NO_DIFFERENCE) >= 9


@pytest.mark.parametrize("stage", ["infer", "pose"])
def test_a_stage_that_takes_5_percent_longer_is_named_and_no_other(stage: str) -> None:
    """`infer` is the slowest, so frames take longer too; for `pose` they do not."""
    found = pair(told(simulated(1)), told(simulated(2, factors={stage: 1.05})))
    named = {figure.of for figure in found.differing if figure.measure == "work"}
    assert named == {stage}
    assert f"{stage} takes " in found.verdict and " longer (" in found.verdict
    figure = Figure("work", stage, "", "typical", "ms")
    row = found.rows[figure]
    assert row.low is not None and row.high is not None and row.low < 0.05 < row.high
    assert found.outcome(figure) is Finding.DIFFERS
    assert found.verdict.startswith("frame time +") == (stage == "infer")


@pytest.mark.parametrize("others", [(0.0, 0.0), (0.85, 0.85), (0.8, 0.82)])
def test_a_frame_time_that_doubles_is_named_whatever_else_runs(others: tuple[float, float]) -> None:
    """All stages take twice as long, on a machine that is as busy in both runs, or nearly so."""
    twice = dict.fromkeys(("pose", "raster", "infer", "composite", "present"), 2.0)
    base, other = (
        told(simulated(seed, factors=factors), clock="host", other_programs=share)
        for seed, factors, share in ((1, None, others[0]), (2, twice, others[1]))
    )
    found = pair(base, other)
    assert re.match(r"frame time \+(9\d|10\d) % \(", found.verdict)
    judged = judge([read_gate("frame-time=5%")], [GatedPair("b", found.base, found.other, found.rows, found.changes)])
    assert whole(judged) is LimitOutcome.BROKEN


def test_what_other_programs_may_have_done_to_the_frame_time_is_not_the_programs() -> None:
    """They left 0.9 of the cores, then 0.4: frames take up to 2.25 times as long. Twice as long may be that."""
    base, other = (
        told(simulated(seed, factors={"infer": factor}), clock="host", other_programs=share)
        for seed, factor, share in ((1, 1.0, 0.1), (2, 1.0, 0.6))
    )
    found = pair(base, other)
    row = found.rows[Figure("frame time", "", "", "mean", "ms")]
    assert row.explained == pytest.approx(log(0.9 / 0.4))
    assert row.high is not None and row.high > 1.25
    assert found.verdict.startswith("cannot tell: frame time")


def test_sequential_beside_pipelined_names_the_starved_dsp() -> None:
    config = {**make_report()["config"], "policy": "sequential", "shapes": [[1, 2]]}
    found = pair(told(simulated(1)), told(simulated(2, policy="sequential"), config=config))
    assert found.verdict.startswith("frame time +1")
    assert "unit dsp (infer) is starved 5" in found.verdict
    assert found.verdict.endswith(": one frame at a time under sequential")
    assert "takes" not in found.verdict
    named = re.findall(r"(\d+) % of the time, was (\d+) %", found.verdict)
    assert len(named) >= 2 and all(int(now) > int(before) for now, before in named)
    back = pair(found.other.runs[0], found.base.runs[0])
    fewer = re.findall(r"(\d+) % of the time, was (\d+) %", back.verdict)
    assert fewer and all(int(now) < int(before) for now, before in fewer)
    assert back.verdict.startswith("frame time -5") and "several frames at a time" in back.verdict


def test_a_short_run_is_too_short_to_tell() -> None:
    found = pair(told(simulated(1, frames=20)), told(simulated(2, frames=20)))
    assert found.verdict == TOO_FEW
    assert any("20 frames; to tell what differs, more than 50 are needed" in note for note in found.notes)


def test_several_runs_a_side_stand_for_it() -> None:
    sides = [
        Side(
            name,
            tuple(
                told(simulated(seed, frames=100, factors={"infer": factor}), f"{name}{seed}")
                for seed in range(start, start + 3)
            ),
        )
        for name, start, factor in (("a", 1, 1.0), ("b", 4, 1.0), ("c", 7, 1.05))
    ]
    alike, longer = (compare(sides[0], side) for side in sides[1:])
    assert alike.verdict == NO_DIFFERENCE
    assert "infer takes " in longer.verdict
    one = pair(sides[0].runs[0], sides[2].runs[0])
    figure = Figure("work", "infer", "", "typical", "ms")
    of_one, of_three = one.rows[figure].deviation, longer.rows[figure].deviation
    assert of_one is not None and of_three is not None and of_three < of_one
    said = document([alike, longer])
    assert said["verdict"].startswith("b: no difference; c: frame time +")
    assert [entry["run"] for entry in said["comparisons"]] == ["b", "c"]


def test_what_explains_a_change_is_what_differed_between_the_runs() -> None:
    """By the table. Others left 0.9 and 0.976 of the cores; the mean of both bases' shares counts for two runs."""
    base = reported("a", clock="host", other_programs=0.1)
    config = {**make_report()["config"], "pace_ns": {"infer": 5}}
    other = reported("b", clock="host", other_programs=0.024, config=config)
    noise = noise_between([base], [other], {"infer": 0.1})
    assert noise.of_time() == (0.03, 0.0, 5, pytest.approx(log(0.976 / 0.9)))
    assert noise.of_time("p90").relative == pytest.approx(0.045)
    assert noise.of_work("infer", "typical") == (0.042, 0.0, 5, pytest.approx(0.3 * 0.076))
    assert noise.of_share() == (0.0, 0.015, 5, pytest.approx(0.5 * 0.076))
    assert noise.of_count() == (0.001, 0.0, 5, 0.0)
    assert noise.of_wait("p90") == (pytest.approx(1.5 * (0.03 + log(0.976 / 0.9))), 0.05, 5, 0.0)
    assert noise_between([base, other], [other], {}).others[1] == pytest.approx(0.3 * 0.038)
    assert noise.held == frozenset()
    held = noise_between([other], [other], {"infer": 0.1})
    assert held.of_work("infer", "typical") == (0.002, 0.0, 5, 0.0)
    full = reported(clock="host", other_programs=1.0)
    assert noise_between([base], [full], {}).others[0] == pytest.approx(log(0.9 / 0.01))
    virtual = reported("d", clock="virtual")
    noise = noise_between([virtual], [virtual], {"infer": 0.1})
    assert {noise.of_time(), noise.of_work("infer", "typical"), noise.of_share(), noise.of_count()} == {Chance()}
    said = remarks([base, other, reported("c"), virtual])
    assert [text[:2] for text in said] == ["a:", "c:"]
    assert "had 10 % of its cores, by which frames may take up to 11 % longer" in said[0]


def test_a_core_on_which_every_stage_is_slower_is_slower_itself() -> None:
    """One stage of two by 20 % says nothing of the core; both by 20 % and 30 % say 20 %, on one machine alone."""
    stages = {
        name: {**make_report()["stages"]["infer"], "unit": unit}
        for name, unit in (("pose", "cpu"), ("present", "cpu"), ("infer", "dsp"))
    }
    share = make_report()["units"]["dsp"]
    units = {"cpu": {**share, "cores": [0]}, "dsp": {**share, "cores": [1]}}
    report = reported(stages=stages, units=units, other_programs=0.0)

    def slower(other: ComparedRun, **effects: float) -> dict[str, float]:
        noise = noise_between([report], [other], effects)
        return {stage: noise.of_work(stage, "typical").explained for stage in effects}

    assert slower(report, pose=0.2, present=0.3, infer=0.5) == {"pose": 0.2, "present": 0.2, "infer": 0.0}
    assert set(slower(report, pose=0.2, present=-0.3, infer=0.5).values()) == {0.0}
    machine = {**make_report()["machine"], "system": "another"}
    elsewhere = reported(stages=stages, units=units, other_programs=0.0, machine=machine)
    assert set(slower(elsewhere, pose=0.2, present=0.3).values()) == {0.0}


def test_only_the_keys_that_differ_are_named() -> None:
    base = make_report(made={"at": "1", "command": ["a"], "trilane": None, "revision": "x", "modified": False})
    other = make_report(made={"at": "2", "command": ["b"], "trilane": None, "revision": "y", "modified": False})
    other["config"] = {**base["config"], "policy": "latest", "pace_ns": {"infer": 5}, "shapes": [[1, 2]]}
    other["policy"] = "latest"
    other["stages"] = {"infer": {**base["stages"]["infer"], "unit": "gpu"}}

    def changed(first: dict[str, Any], second: dict[str, Any]) -> list[Change]:
        return changes(*(compared_run("run", RunKind.REPORT, each) for each in (first, second)))

    assert changed(base, other) == [
        Change("policy", "pipelined", "latest"),
        Change("config.pace_ns.infer", None, 5),
        Change("config.shapes", None, [[1, 2]]),
        Change("stages.infer.unit", "dsp", "gpu"),
        Change("made.revision", "x", "y"),
    ]
    assert changed(base, base) == []
    prediction = {**base, "config": {**base["config"], "edge": "double"}}
    del prediction["policy"], prediction["edge"]
    assert changed(base, prediction) == []


def test_bytes_that_a_stage_moves_are_named() -> None:
    def moved(run: Simulation, ratio: float) -> ComparedRun:
        assert run.recording is not None
        records = [
            record._replace(figures={"bytes_read": 1000.0 * ratio, "visible": record.job.frame * ratio})
            if isinstance(record, Worked) and record.job.stage == "raster"
            else record
            for record in journal_of(run.recording, run.jobs, {}, run.report)
        ]
        return compared_run("run", RunKind.RUN, make_report(**run.report), frames_of(records))

    run = simulated(1, frames=60)
    assert pair(moved(run, 1.0), moved(run, 1.5)).verdict == "raster bytes read +50 %"
    assert pair(moved(run, 1.0), moved(run, 1.0)).verdict == NO_DIFFERENCE


def test_work_is_without_the_time_in_which_another_thread_had_the_core() -> None:
    run = simulated(1, frames=60)
    assert run.recording is not None
    records = [
        record._replace(job=record.job._replace(preempted_ns=1_500_000)) if isinstance(record, Worked) else record
        for record in journal_of(run.recording, run.jobs, {}, run.report)
    ]
    frames = frames_of(records)
    assert frames is not None
    for stage in ("infer", "pose"):
        service, work = (frames.series[Key(measure, stage)].values for measure in ("service", "work"))
        assert service - work == pytest.approx(1.5)


def test_a_stage_that_only_waits_longer_for_its_core_takes_no_longer() -> None:
    """Of infer's jobs, which last three times as long, two thirds are another thread's: frames are what differs."""
    run = simulated(2, factors={"infer": 3.0})
    assert run.recording is not None
    records = [
        record._replace(job=record.job._replace(preempted_ns=(record.job.end_ns - record.job.begin_ns) * 2 // 3))
        if isinstance(record, Worked) and record.job.stage == "infer"
        else record
        for record in journal_of(run.recording, run.jobs, {}, run.report)
    ]
    waits = compared_run("waits", RunKind.RUN, make_report(**run.report), frames_of(records))
    found = pair(told(simulated(1)), waits)
    assert found.verdict.startswith("frame time +2") and "unit dsp (infer) has no core" in found.verdict
    assert "takes" not in found.verdict
    assert Figure("service", "infer", "", "mean", "ms") in found.differing


def test_drops_and_errors_are_named() -> None:
    run = simulated(1)
    counts = {
        "requested": 200,
        "presented": 150,
        "lost": 0,
        "lost_by_cause": {},
        "dropped": {"raster->infer:stale": 50},
    }
    error = {"someone": {"source": "x", "psnr_db_by_band": {"face": 29.5}, "iou": 0.9}}
    better = {"someone": {"source": "x", "psnr_db_by_band": {"face": 31.25}, "iou": 0.9}}
    found = pair(told(run, accuracy=better), told(run, frames=counts, accuracy=error))
    assert found.verdict == (
        "dropped (raster->infer:stale) 25.0 % of the frames, was 0.0 %; "
        "error of someone psnr_db_by_band face 29.5 dB, was 31.25"
    )


def test_a_number_of_400_digits_is_no_error() -> None:
    run = simulated(1)
    base, other = (told(run, accuracy={"someone": {"psnr_db": db, "iou": 0.9}}) for db in (10**400, 30.0))
    assert "someone psnr_db" not in pair(base, other).verdict


def test_a_report_without_a_journal_has_summaries(make: Make) -> None:
    base, other = make("a"), make("b", policy="sequential", seed=2)
    (base / NAME).unlink()
    found = compare(read_side(str(base)), read_side(str(other / "report.json")))
    assert "frame time +" in found.verdict and "is starved" in found.verdict
    assert sum("only summaries are compared" in note for note in found.notes) == 2
    assert found.rows[Figure("frame time", "", "", "p99", "ms")].probability is None


def test_imported_wall_times_alone_are_compared_by_the_frame_time(tmp_path: Path) -> None:
    sides = []
    for mean_ms in (10.0, 10.2):
        path = tmp_path / f"{mean_ms}.json"
        row = {"name": "frame", "kind": "wall", "count": 1000, "mean_ms": mean_ms, "sd_ms": 0.01}
        path.write_text(json.dumps({"measurements": [row]}), encoding="utf-8")
        sides.append(read_side(str(path)))
    assert compare(*sides).verdict.startswith("cannot tell: frame time +2 % (")


def test_the_interval_of_a_share_is_in_points_as_the_share_is() -> None:
    row = Difference(0.10, 0.14, 0.04, 0.0204, 0.0596, 0.01, is_ratio=False)
    assert signed(row, SHARE) == "+4 points (2.04 to 5.96)"


def test_predictions_of_one_chip_share_the_models_error(tmp_path: Path) -> None:
    def prediction(name: str, mean: float, chip: str) -> ComparedRun:
        times = {"mean": mean, "p50": mean, "p90": mean, "p99": mean, "low": mean * 0.9, "high": mean * 1.1}
        idle = {"starved": 0.5, "blocked": 0.0, "throttled": 0.0, "preempted": 0.0, "overhead": 0.0}
        answer = {
            "clock": "virtual", "machine": {"profile": chip}, "config": {"policy": "x"}, "network": {},
            "expected_error": 0.1, "frame_time_ms": times, "latency_ms": {"mean": 30.0},
            "stages": {"infer": {"unit": "dsp", "service_ms": {"mean": 10.0}}},
            "units": {"dsp": {"busy": 0.5, "idle": idle}},
        }  # fmt: skip
        path = tmp_path / name
        path.write_text(json.dumps(answer), encoding="utf-8")
        return read_told(str(path))

    with pytest.raises(BadInputError, match=r"frame_time_ms: found its mean is 0 ms, and a frame takes more than 0"):
        prediction("none", 0.0, "one")
    base = prediction("a", 20.0, "one")
    assert pair(base, prediction("b", 20.5, "one")).verdict == "frame time +2.5 %"
    assert pair(base, prediction("d", 400.0, "one")).verdict == "frame time +1900 %"
    assert pair(base, prediction("c", 20.5, "two")).verdict.startswith("cannot tell: frame time +2.5 %")
    assert "computed by a model" in pair(base, base).notes[0]


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (None, "no such file"),
        ("[1]", "a JSON list"),
        ("{", "EOF"),
        ('{"schema": 99}', "schema: found 99"),
        ('{"networks": []}', "bare networks"),
        ("{}", "field required"),
    ],
)
def test_what_is_no_run_is_refused_by_name(tmp_path: Path, content: str | None, found: str) -> None:
    path = tmp_path / "thing.json"
    if content is not None:
        path.write_text(content, encoding="utf-8")
    with pytest.raises(BadInputError, match=found) as error:
        read_side(str(path))
    assert "thing.json" in str(error.value)


def test_a_journal_that_is_cut_off_is_compared_until_there_or_refused(make: Make) -> None:
    base, other = make("a"), make("b", seed=2)
    whole = (other / NAME).read_bytes()
    (other / NAME).write_bytes(whole[: len(whole) * 3 // 4])
    found = compare(read_side(str(base)), read_side(str(other)))
    assert any("its journal ends before the run did" in note for note in found.notes)
    (other / NAME).write_bytes(whole[:2000])
    with pytest.raises(BadInputError, match=r"b/journal\.msgpack: found fewer than two presented frames"):
        read_side(str(other))


def test_the_page_asks_for_nothing_and_escapes_what_it_is_given() -> None:
    name = "<script>alert(1)</script>&'"
    base = told(simulated(1), name)
    other = told(simulated(2, policy="sequential"), 'x" onload="y', idle_cores="<b>")
    found = pair(base, other)
    text = comparison_page([found])
    assert "<script" not in text and "<b>" not in text and 'x" onload' not in text
    assert "&lt;script&gt;" in text and "default-src &#x27;none&#x27;" in text
    assert not any(word in text for word in ("http:", "https:", "src=", "url(", "@import"))
    assert text.count("<svg") == len(found.rows)
    outcomes = [found.outcome(figure) for figure in found.rows]
    assert all(text.count(f"<td>{each}</td>") == outcomes.count(each) for each in Finding)
    assert "prefers-color-scheme: dark" in text


def test_the_command(make: Make, tmp_path: Path, command: Command) -> None:
    base, other = make("a"), make("b", seed=2, policy="sequential")
    text, _ = command("compare", base, other, "--html", tmp_path / "page.html")
    assert "verdict: frame time +" in text and "sequential" in text and "more figures do not differ" in text
    assert (tmp_path / "page.html").read_text(encoding="utf-8").startswith("<!doctype html>")
    said = json.loads(command("compare", base, other, "--json", "--fail-if-slower", "5%", code=1)[0])
    assert said["changes"] == [{"run": str(other), "key": "policy", "base": "pipelined", "other": "sequential"}]
    a2, b2 = (make(name, seed) for seed, name in enumerate(("a2", "b2"), 3))
    text, _ = command("compare", f"{base},{a2}", f"{other},{b2}", "--fail-if", "slower=500 %")
    assert "a side with several runs shows the arithmetic mean" in " ".join(text.split())
    assert "verdict: frame time +" in command("compare", f"{base},{a2}", other)[0]
    many = make("c", config={**make_report()["config"], **dict.fromkeys("abcdefghijklmnop", 1)})
    text, _ = command("compare", base, many)
    assert "verdict: no difference" in text and "4 more settings changed: --all shows them" in text
    for words, wrong in (
        ((f"{base},{base}", f"{other},{b2}"), "twice"),
        ((f"{base},", other), "found an empty name"),
        ((base, other, "--fail-if-slower", "much"), "expected slower= and a number with %"),
        ((base, tmp_path / "nothing"), "nothing"),
    ):
        assert wrong in " ".join(command("compare", *words, code=2)[1].split())


@pytest.mark.parametrize("text", ["", " ", ",", "a,,b", "a, ,b", ",a"])
def test_an_empty_name_is_refused_and_not_the_working_directory(text: str) -> None:
    with pytest.raises(BadInputError, match="an empty name"):
        read_side(text)


def test_of_a_thousand_files_that_are_not_there_one_is_named() -> None:
    with pytest.raises(BadInputError, match="no such file"):
        read_side(",".join(f"none{place}" for place in range(1000)))


def test_a_side_of_several_runs_shows_what_its_reports_say() -> None:
    runs = [told(simulated(seed, frames=60, factors={"infer": seed / 2.0}), f"r{seed}") for seed in range(1, 5)]
    ab, cd = Side("a,b", tuple(runs[:2])), Side("c,d", tuple(runs[2:]))
    there, back = compare(ab, cd).rows, compare(cd, ab).rows
    figure = Figure("frame time", "", "", "mean", "ms")
    means = [run.figures.frame_time_ms["mean"] or 0.0 for run in runs]
    assert there[figure].base == pytest.approx((means[0] + means[1]) / 2, rel=1e-6)
    assert there[figure].other == pytest.approx((means[2] + means[3]) / 2, rel=1e-6)
    assert all((row.base, row.other) == pytest.approx((back[key].other, back[key].base)) for key, row in there.items())
    assert there[figure].change == pytest.approx((means[2] / means[0] * means[3] / means[1]) ** 0.5 - 1, rel=1e-6)


def killed(folder: Path, run: Simulation, facts: dict[str, Any], *, keep: float = 1.0) -> Path:
    """A folder with a journal alone, without its last record where `keep`, a share of it, is less than 1."""
    folder.mkdir(parents=True)
    assert run.recording is not None
    with JournalWriter(folder / NAME) as journal:
        for record in journal_of(run.recording, run.jobs, facts, run.report):
            journal.add(record)
    whole = (folder / NAME).read_bytes()
    (folder / NAME).write_bytes(whole[: int(len(whole) * keep)])
    return folder


NOBODY = 999_999_999  # no process has this number


def test_a_run_that_was_killed_is_compared_by_its_journal(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    report = make_report()
    facts = {name: report[name] for name in ("config", "machine")} | {"clock": "virtual"}
    config = {**report["config"], "pace_ns": {"pose": 7}}
    base = make("base", clock="virtual", machine=report["machine"], config=report["config"], idle_cores="wait awake")
    slow = simulated(2, frames=120, factors={"infer": 1.05})
    folder = killed(tmp_path / "runs" / f"gone.{NOBODY}.partial", slow, {**facts, "config": config}, keep=0.8)
    for name in (str(folder), "gone", "runs/gone", str(folder / NAME)):
        other = read_side(name)
        found = compare(read_side(str(base)), other)
        assert [change.key for change in found.changes] == ["config.pace_ns.pose"]
        assert "infer takes " in found.verdict
        assert any("it did not end by itself and has no report" in note for note in found.notes)
    frames, bound = other.runs[0].figures.frames, other.runs[0].figures.bound
    assert frames is not None and 60 < frames.presented == frames.requested < 120
    assert bound is not None and bound.stage is not None and (bound.unit.name, bound.stage.name) == ("dsp", "infer")
    live = killed(tmp_path / "runs" / "live.5.partial", slow, facts, keep=0.8)
    with locked(live):
        assert "it still goes on" in read_side(str(live)).runs[0].remark
    done = read_side(str(killed(tmp_path / "done", slow, facts))).runs[0]
    assert done.remark == "it has no report: compared by its journal"
    assert done.figures.frame_time_ms["mean"] == pytest.approx(slow.report["frame_time_ms"]["mean"])
    (base / NAME).unlink()
    assert "only summaries" in compare(read_side(str(base)), read_side("gone")).notes[0]


def test_what_a_journal_says_of_a_run_is_what_its_report_says(tmp_path: Path) -> None:
    """All but the last record, beside the figures that the last one holds; shares up to what is before frame 1."""
    run = simulated(5, frames=80, policy="latest", period_ms=5)
    read = read_side(str(killed(tmp_path / "a", run, {"clock": "virtual"}, keep=0.999))).runs[0]
    assert read.frames is not None and not read.frames.is_whole
    mine, report = read.figures, run.report
    assert read.settings["policy"] == "latest"
    for key in ("frame_time_ms", "latency_ms"):
        assert getattr(mine, key)["mean"] == pytest.approx(report[key]["mean"], rel=0.02)
    for stage, row in report["stages"].items():
        assert mine.stages[stage].unit == row["unit"]
        assert mine.stages[stage].service_ms["mean"] == pytest.approx(row["service_ms"]["mean"], rel=0.02)
    for unit, row in report["units"].items():
        assert mine.units[unit].busy == pytest.approx(row["busy"], abs=0.03)
    assert mine.frames is not None
    assert sum(mine.frames.dropped.values()) == pytest.approx(sum(report["frames"]["dropped"].values()), abs=3)
    broken = killed(tmp_path / "b", run, {"config": [1]})
    with pytest.raises(BadInputError, match=r"config: found \[1\], expected names and their values"):
        read_side(str(broken))
    with pytest.raises(BadInputError, match="a configuration of another form"):
        read_side(str(killed(tmp_path / "c", run, {"config": {"units": []}})))


@pytest.mark.parametrize("name", ["report.json", NAME])
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_no_pipe_and_no_device_is_read(make: Make, name: str, kind: str) -> None:
    folder = make("a")
    (folder / name).unlink()
    if kind == "pipe":
        os.mkfifo(folder / name)
    else:
        (folder / name).symlink_to("/dev/zero")
    for given in (folder, folder / name) if name == "report.json" else (folder,):
        with pytest.raises(BadInputError, match="a device, a pipe or a socket"):
            read_side(str(given))
