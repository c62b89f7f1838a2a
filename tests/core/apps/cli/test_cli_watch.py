"""`trilane watch`: what it shows of a run that is over, goes on, was killed or has nothing to show, and how it ends."""

from __future__ import annotations

import io
import json
import os
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from support.run_folders import locked
from support.run_report import make_metrics, make_report
from support.told_journal import told_journal
from trilane.apps.cli import watch as cli_watch
from trilane.apps.cli.watch import line, screen
from trilane.apps.run.report import Report
from trilane.apps.run.verdict_facts import verdict_of
from trilane.apps.watch.followed_run import RunState
from trilane.apps.watch.live_figures import LiveFigures, RunLook
from trilane.pipeline.journal import NAME, Counted, Ended, JournalWriter, Record, Stepped
from trilane.scheduler.events import JobDone, Start, UnitDied

Command = Callable[..., tuple[str, str]]
Check = Callable[[str, str], None]
MS = 1_000_000
BEGUN, RECORDS = told_journal()
#: Unit v dies in its second frame, and the run ends.
END: tuple[Record, ...] = (
    Stepped(1070 * MS, (UnitDied("v"),), (Start("v"),)),
    Counted(1070 * MS, {"died:v": 1}, {}),
    Ended(1090 * MS, make_metrics(bound=None)),
)
FIGURES = LiveFigures(BEGUN)
for record in (*RECORDS, *END):
    FIGURES.add(record)


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def written(folder: str, *records: Record) -> None:
    Path(folder).mkdir(parents=True)
    with JournalWriter(Path(folder) / NAME) as journal:
        for record in records:
            journal.add(record)


def test_a_finished_run_is_a_line_where_stdout_is_no_terminal(command: Command, check_printed: Check) -> None:
    written("runs/walk", BEGUN, *RECORDS, *END)
    check_printed("top-lines", command("watch")[0])


def test_the_screen(check_printed: Check) -> None:
    console = Console(file=io.StringIO(), width=120)
    console.print(screen(RunLook("walk", RunState.FINISHED, FIGURES.now()), 120))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert text.count("█") == round(20 * 40 / 90) + round(20 * 20 / 90)  # of 20, by the busy shares of u and v
    check_printed("top-screen", text)


def test_the_verdict_stands_first_and_in_the_line() -> None:
    """The bound of the verdict is that of the line: dsp, with 82 % of the path."""
    report = Report.model_validate(make_report())
    figures = replace(FIGURES.now(), bound=report.bound, verdict=verdict_of(report, "runs/walk"))
    for state in (RunState.GOES_ON, RunState.KILLED):
        console, look = Console(file=io.StringIO(), width=120), RunLook("walk", state, figures)
        console.print(screen(look, 120))
        shown = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
        assert shown[1].startswith("PASS  50 fps, at 30 fps 0 of 2 frames late")
        assert shown[3].startswith("BOUND dsp: infer 8.8 of 20.0 ms on the critical path (82 %)")
        assert "; PASS; " in line(look) and "; bound dsp 82%; " in line(look)
    assert "bound" not in line(RunLook("walk", RunState.KILLED, FIGURES.now()))


def test_a_terminal_is_drawn_anew(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    written("runs/walk", BEGUN, *RECORDS, *END)
    console = Console(file=io.StringIO(), force_terminal=True, width=120)
    monkeypatch.setattr(cli_watch, "stdout_console", lambda: console)
    assert command("watch", "walk")[0] == ""
    assert "run walk: finished, over" in console.file.getvalue()  # type: ignore[attr-defined]


def test_once_as_json_is_one_document(command: Command) -> None:
    written("runs/walk", BEGUN, *RECORDS, *END)
    document = json.loads(command("watch", "runs/walk", "--once", "--json")[0])
    assert (document.pop("run"), document["state"]) == ("walk", "finished")
    assert document == json.loads(json.dumps(FIGURES.now().as_json()))


def test_a_run_that_goes_on_is_looked_at_until_it_ends(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Path(f"runs/walk.{os.getpid()}.partial")
    folder.mkdir(parents=True)
    slept: list[float] = []
    with JournalWriter(folder / NAME) as journal, locked(folder):
        journal.add(BEGUN)
        journal.flush()
        parts = iter((RECORDS, END, ()))

        def sleep(seconds: float) -> None:
            slept.append(seconds)
            if not (part := next(parts)):
                folder.rename("runs/walk")
            for record in part:
                journal.add(record)
            journal.flush()

        monkeypatch.setattr(time, "sleep", sleep)
        out, _ = command("watch", "--json", "--interval", "0.5")
    looks = [json.loads(line) for line in out.splitlines()]
    assert [(look["state"], look["frames"]["presented"], look["is_over"]) for look in looks] == [
        ("goes on", 0, False),
        ("goes on", 1, False),
        ("goes on", 1, True),
        ("finished", 1, True),
    ]
    assert slept == [0.5, 0.5, 0.5]


def test_a_run_that_was_killed_is_shown_as_it_was(command: Command) -> None:
    written("runs/walk.999999999.partial", BEGUN, *RECORDS)
    assert command("watch", "walk")[0].startswith("run walk: killed; fps of the last 5 s, ")


def test_a_run_that_is_killed_while_it_is_looked_at_says_so_and_ends(
    command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Path("runs/walk.5.partial")
    written(str(folder), BEGUN, *RECORDS)
    with ExitStack() as run:
        run.enter_context(locked(folder))
        monkeypatch.setattr(time, "sleep", lambda _: run.close())
        lines = command("watch", "walk")[0].splitlines()
    assert lines[0].startswith("run walk: goes on; ")
    killed = "run walk: killed: its process is gone, and the last line is as far as its journal goes"
    assert lines[-1] == killed
    assert len(lines) == 5  # the heading's three, one look, the end


def test_a_finished_run_has_the_rate_of_its_report(command: Command) -> None:
    """Two frames, 20 ms apart, in a run of 90 ms: 50 a second, and not the 22 of its whole length."""
    second = Stepped(1080 * MS, (JobDone("v", 3, 1050 * MS, 1060 * MS, 0),), ())
    written("runs/walk", BEGUN, *RECORDS, second, Ended(1090 * MS, make_metrics()))
    out = command("watch", "walk")[0]
    assert "finished; fps between the first frame and the last, p50" in out
    assert "; 50.0 fps; " in out
    document = json.loads(command("watch", "walk", "--once", "--json")[0])
    assert (document["fps"], document["run_fps"]) == (50, 50)


def test_openmetrics(command: Command) -> None:
    pytest.importorskip("prometheus_client")
    written("runs/walk", BEGUN, *RECORDS, *END)
    out, _ = command("watch", "walk", "--openmetrics")
    assert 'trilane_frames_lost_total{cause="died:v"} 1.0\n' in out
    assert out.endswith("# EOF\n")


def test_openmetrics_without_its_library(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    written("runs/walk", BEGUN)
    monkeypatch.setitem(__import__("sys").modules, "trilane.apps.watch.metrics", None)
    _, err = command("watch", "walk", "--openmetrics", code=3)
    assert "[dashboard]" in err


def test_an_interrupt_ends_it_without_a_word(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    written("runs/walk.5.partial", BEGUN)

    def interrupt(_: float) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(time, "sleep", interrupt)
    with locked(Path("runs/walk.5.partial")):
        out, err = command("watch", "walk", code=130)
    assert len(out.splitlines()) == 4  # three of the heading, and one look
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["walk", "--json", "--openmetrics"], "options: found --json and --openmetrics, expected one of them"),
        (["empty"], "runs/empty: found a journal without a record, expected a run folder with a journal"),
        (["cut"], "the journal, last record: frames: found field required, expected the figures of a run"),
        (["wolk"], "wolk: found no such run"),
        (["--interval", "0"], "--interval"),
    ],
)
def test_what_cannot_be_shown_is_refused(command: Command, arguments: list[str], said: str) -> None:
    written("runs/empty")
    written("runs/cut", BEGUN, Ended(1090 * MS, {}))
    assert said in " ".join(command("watch", *arguments, code=2)[1].split())


def test_a_run_that_is_none_is_told_before_a_missing_package(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trilane.apps.dashboard.access.require_server", pytest.fail)
    assert "wolk: found no such run" in command("show", "wolk", code=2)[1]
