"""`trilane trace` and `--trace` write traces that hold the run; what cannot be traced is said in one sentence."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from support.run_folders import locked
from support.trace_reading import read_trace
from trilane.apps.explain.trace import write_predicted
from trilane.hw_profiles.application import application_graph
from trilane.pipeline.journal import NAME, JournalWriter, journal_of
from trilane.scheduler.events import Settings
from trilane.scheduler.virtual import Simulation, simulate

Command = Callable[..., tuple[str, str]]
FRAMES = 8


def a_run() -> Simulation:
    return simulate(application_graph(), Settings(FRAMES), lambda *_: 2_000_000, keep=True)


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the run `walk` below runs/."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "runs" / "walk"
    folder.mkdir(parents=True)
    done = a_run()
    assert done.recording is not None
    with JournalWriter(folder / NAME) as journal:
        for record in journal_of(done.recording, done.jobs, {"clock": "host"}, done.report):
            journal.add(record)
    return folder


def test_a_trace_is_made_again_from_the_journal(runs: Path, command: Command) -> None:
    (runs / "trace.pftrace").write_bytes(b"old")
    out, err = command("trace", runs)
    assert (out, err) == ("", f"trace: {runs}/trace.pftrace\n")
    trace = read_trace((runs / "trace.pftrace").read_bytes())
    assert len(trace.of("host clock/cpu/present")) == FRAMES
    assert sorted(path.name for path in runs.iterdir()) == [NAME, "trace.pftrace"]


def test_chrome_json_goes_where_it_is_asked_to(runs: Path, command: Command) -> None:
    command("trace", "walk", "--chrome-json")
    command("trace", runs / NAME, "--chrome-json", "--out", "mine.json")
    text = Path("mine.json").read_text()
    assert (runs / "trace.json").read_text() == text
    slices = [event for event in json.loads(text)["traceEvents"] if event["ph"] == "X" and event["name"] == "infer"]
    assert [one["dur"] for one in slices] == [2000.0] * FRAMES


def test_a_run_that_goes_on_has_a_trace_so_far(runs: Path, command: Command) -> None:
    going = runs.rename(runs.with_name("walk.5.partial"))
    with locked(going):
        _, err = command("trace", "walk", code=2)
    found = "found a run that goes on, expected --out FILE for its trace so far; its folder is its own"
    assert err == f"error: runs/{going.name}: {found}\n"
    command("trace", "walk", "--out", "so-far.pftrace")
    assert read_trace(Path("so-far.pftrace").read_bytes()).of("cpu/present")
    assert [path.name for path in going.iterdir()] == [NAME]


def test_what_cannot_be_traced_or_written(runs: Path, command: Command) -> None:
    _, err = command("trace", "wlak", code=2)
    assert err.startswith("error: wlak: found no such run, expected a run folder with a journal")
    _, err = command("trace", runs, "--out", "no/folder/x", code=2)
    assert err.startswith("error: no/folder/x: found no such file or directory")
    (runs / NAME).write_bytes(b"\xc1")
    _, err = command("trace", runs, code=2)
    assert "expected the journal of a run" in err
    assert [path.name for path in runs.iterdir()] == [NAME]


def test_a_journal_without_a_record_leaves_the_old_trace(runs: Path, command: Command) -> None:
    (runs / "trace.pftrace").write_bytes(b"old")
    (runs / NAME).write_bytes((runs / NAME).read_bytes()[:10])
    _, err = command("trace", runs, code=2)
    assert "a journal without a record" in err
    assert (runs / "trace.pftrace").read_bytes() == b"old"


@pytest.mark.parametrize("name", ["trace", "watch", "explain"])
def test_a_pipe_in_the_place_of_a_journal_is_called_so(runs: Path, name: str, command: Command) -> None:
    (runs / NAME).unlink()
    os.mkfifo(runs / NAME)
    assert "found a device, a pipe or a socket" in command(name, runs, code=2)[1]


def test_the_trace_of_a_prediction(tmp_path: Path, command: Command) -> None:
    """The simulated run of which the answer's shares of time are: those of the slices are the same."""
    file = tmp_path / "p.pftrace"
    words = ("--policy", "pipelined", "--edge", "double", "--encoder", "mobilenetv2", "--size", "128")
    out, _ = command("predict", *words, "--trace", file, "--json")
    answer, trace = json.loads(out), read_trace(file.read_bytes())
    (run,) = trace.of("virtual clock/run")
    assert run.notes["config"]["encoder"] == "mobilenetv2"
    assert run.notes["machine"]["profile"] == "snapdragon-888"
    begin_ns, end_ns = run.begin_ns, run.end_ns
    for unit, row in answer["units"].items():
        busy_ns = sum(one.end_ns - one.begin_ns for one in trace.of(f"virtual clock/{unit}") if one.flows)
        assert busy_ns / (end_ns - begin_ns) == pytest.approx(row["busy"], abs=1e-9)
    for stage, row in answer["stages"].items():
        jobs = trace.of(f"{row['unit']}/{stage}")
        assert {one.end_ns - one.begin_ns for one in jobs} == {round(row["service_ms"]["mean"] * 1e6)}


def test_pipelines_beside_each_other_are_groups(tmp_path: Path) -> None:
    write_predicted({"one": a_run(), "two": a_run()}, {"machine": {"profile": "mine"}}, tmp_path / "both")
    trace = read_trace((tmp_path / "both").read_bytes())
    assert len(trace.of("one, virtual clock/dsp/infer")) == len(trace.of("two, virtual clock/dsp/infer")) == FRAMES
    assert [one.notes["machine"] for one in trace.of("clock/run")] == [{"profile": "mine"}] * 2
