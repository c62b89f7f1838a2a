"""Sweeps of real processes: alone or packed, interrupted, killed and taken up again, with none left behind.

`support.sweep_trial`, which says when it began and ended, is tried in place of Trilane.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from trilane import machine
from trilane.apps.sweep.definition import Trial, TrialClock
from trilane.apps.sweep.engines import TrialPlace, at_once, run_here
from trilane.apps.sweep.store import TRIALS, Store, TrialRecord, read_trials, run_sweep

FAKE = "support.sweep_trial"
#: `trilane` that tries the module in place of Trilane.
#: SIGINT is heard even where the tests run in a background in which it is ignored.
PROGRAM = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    f"import trilane.apps.sweep.engines as p; p.PROGRAM = {FAKE!r}; from trilane.apps.cli.main import entry; entry()"
)
LIMIT_S = 60.0
COUNT = 4
SWEEP = ["sweep", "run", *(word for n in range(1, COUNT + 1) for word in ("--frames", str(n)))]

pytestmark = pytest.mark.usefixtures("no_new_process")


@pytest.fixture(autouse=True)
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the trials say when they began and ended."""
    file = tmp_path / "log"
    monkeypatch.setenv("SWEEP_TRIAL_LOG", str(file))
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    return file


def swept(folder: Path, trials: list[Trial]) -> dict[str, TrialRecord]:
    """The records after a sweep of `trials`."""
    with Store(folder, trials, {}, resume=False) as store:
        place = TrialPlace(store.folder, program=FAKE)
        run_sweep(trials, store, lambda left: run_here(left, place), lambda _record: None)
    return read_trials(folder)


def numbered(command: str, count: int) -> list[Trial]:
    return [Trial((command,), {"n": n}, ("--n", str(n))) for n in range(count)]


def notes(log: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []


def spans(log: Path) -> list[tuple[float, float]]:
    """Begin and end of each trial that ended, by begin."""
    begins = {note["pid"]: note["at"] for note in notes(log) if note["what"] == "begin"}
    return sorted((begins[note["pid"]], note["at"]) for note in notes(log) if note["what"] == "end")


def test_trials_of_the_host_clock_one_after_the_other_with_their_folders(tmp_path: Path, log: Path) -> None:
    trials = numbered("run", 2)
    (tmp_path / "s" / f"{trials[1].id}.17.partial").mkdir(parents=True)  # of a trial that was killed
    records = swept(tmp_path / "s", trials)
    (_, first_end), (second_begin, _) = spans(log)
    assert first_end <= second_begin
    assert at_once(TrialClock.HOST) == 1
    for trial in trials:
        record = records[trial.id]
        assert record.result == {"schema": 1, "words": ["run", *trial.words, "--json"], "threads": "7"}
        assert record.command == ("trilane", "run", *trial.words, "--json")
        assert (record.status, record.clock, record.folder) == ("done", "host", trial.id)
        assert record.host is not None and record.host["cpu"]["cores_allowed"] == list(machine.here.cores())
        assert (tmp_path / "s" / trial.id / "report.json").is_file()
    assert not list((tmp_path / "s").glob("*.partial"))


def test_virtual_trials_are_packed(tmp_path: Path, log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine.here, "cores", lambda: (0, 1))
    monkeypatch.setenv("SWEEP_TRIAL_TOGETHER", "2")
    records = swept(tmp_path / "s", numbered("predict", 2))
    assert {(record.clock, record.folder) for record in records.values()} == {("virtual", None)}
    (_, first_end), (second_begin, _) = spans(log)
    assert second_begin < first_end


def test_failed_trials_are_kept_and_not_repeated_and_lost_ones_are(tmp_path: Path, log: Path) -> None:
    failing = Trial(("run",), {"n": 1}, ("--code", "3"))
    killed = Trial(("run",), {"n": 2}, ("--die-once", str(tmp_path / "mark")))
    records = swept(tmp_path / "s", [failing, killed])
    failed = records[failing.id]
    assert (failed.status, failed.exit_code, failed.error, failed.tries) == ("failed", 3, "error: as it was asked", 1)
    assert (records[killed.id].status, records[killed.id].tries) == ("done", 2)
    assert Counter(note["what"] for note in notes(log)) == {"begin": 3, "end": 2}


@pytest.mark.parametrize(
    ("shares", "kept", "calls"),
    [
        ("0.02", 0.02, 1),
        ("0.3,0.04", 0.04, 2),
        ("0.3,0.1,0.2", 0.1, 3),
        ("0.1,0.3,0.2", 0.1, 3),
        ("0.3,0.2,0.01", 0.01, 3),
    ],
)
def test_a_disturbed_run_is_done_again_and_the_least_disturbed_is_kept(
    tmp_path: Path, log: Path, shares: str, kept: float, calls: int
) -> None:
    trial = Trial(("run",), {"n": 1}, ("--others", shares))
    (tmp_path / "s" / f"{trial.id}.kept" / "of").mkdir(parents=True)  # of a sweep that was killed during a repeat
    record = swept(tmp_path / "s", [trial])[trial.id]
    assert record.result is not None
    assert (record.result["other_programs"], record.repeated, record.tries) == (kept, calls - 1, 1)
    assert record.unsure == (() if kept <= 0.05 else ("other programs took 10 % of its cores",))
    assert (tmp_path / "s" / trial.id / "report.json").read_text() == str(kept)
    assert sorted(path.name for path in (tmp_path / "s").iterdir() if path.is_dir()) == [trial.id]
    assert sum(note["what"] == "begin" for note in notes(log)) == calls


@pytest.fixture
def sweep(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts the command line, with words besides those of SWEEP; ends it after the test."""
    started = []

    def start(*words: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", PROGRAM, *SWEEP, "--out", str(tmp_path / "s"), *words]
        pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        started.append(subprocess.Popen(command, **pipes))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def until_some_are_done(folder: Path, process: subprocess.Popen[str], count: int) -> list[psutil.Process]:
    """Wait for `count` lines and a trial that goes on. Returns: its processes."""
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        lines = (folder / TRIALS).read_bytes().count(b"\n") if (folder / TRIALS).exists() else 0
        going = psutil.Process(process.pid).children(recursive=True)
        if lines >= count and going:
            return going
        time.sleep(0.02)
    raise AssertionError(process.communicate())


def each_done_once(folder: Path, log: Path) -> None:
    """No trial of the sweep is lost or has two lines, and each went to its end once.

    But for the one that was at its end when the sweep was ended, before its line was written: it is done again.
    """
    lines = [json.loads(line) for line in (folder / TRIALS).read_text().splitlines()]
    assert sorted(line["options"]["frames"] for line in lines) == list(range(1, COUNT + 1))
    assert {line["status"] for line in lines} == {"done"}
    ends = Counter(tuple(note["words"]) for note in notes(log) if note["what"] == "end")
    assert sorted(ends.values()) in ([1] * COUNT, [*[1] * (COUNT - 1), 2])


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_sweep_that_is_ended_half_way_goes_on(
    sweep: Any, tmp_path: Path, log: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    monkeypatch.setenv("SWEEP_TRIAL_WAIT", "0.3")
    first = sweep()
    going = until_some_are_done(tmp_path / "s", first, 1)
    first.send_signal(number)
    _, said = first.communicate(timeout=LIMIT_S)
    if number == signal.SIGINT:
        assert first.returncode == 130
        assert "trials are done; --resume goes on" in said
        assert not any(process.is_running() for process in going)
    assert not psutil.wait_procs(going, timeout=LIMIT_S)[1]
    monkeypatch.setenv("SWEEP_TRIAL_WAIT", "0")
    refused = sweep()
    assert "--resume goes on with it" in refused.communicate(timeout=LIMIT_S)[1]
    assert refused.returncode == 2
    second = sweep("--resume", "--json")
    out, said = second.communicate(timeout=LIMIT_S)
    assert second.returncode == 0, said
    counts = json.loads(out)["counts"]
    assert (counts["trials"], counts["done"]) == (COUNT, COUNT)
    assert 1 <= counts["skipped"] < COUNT
    each_done_once(tmp_path / "s", log)
