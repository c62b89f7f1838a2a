"""Which journal is meant by a name, and what is said of a run that goes on, is complete, was killed or is gone."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from support.run_folders import locked
from trilane.apps.run.run_folder import RunFolder
from trilane.apps.watch import followed_run
from trilane.apps.watch.followed_run import RunState, follow
from trilane.errors import BadInputError
from trilane.pipeline.journal import NAME, SCHEMA, Begun, JournalWriter, Said
from trilane.scheduler.events import Settings, chain

BEGUN = Begun(SCHEMA, chain((("a", "u"), ("b", "v")), "double", "b"), Settings(3), {"clock": "host"})
NOBODY = 999_999_999  # above the largest number that Linux gives a process


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def made(folder: Path, at_s: int = 0) -> Path:
    folder.mkdir(parents=True)
    with JournalWriter(folder / NAME) as journal:
        journal.add(BEGUN)
    if at_s:
        os.utime(folder / NAME, (at_s, at_s))
    return folder


@pytest.mark.parametrize(
    "given",
    ["runs/walk", "walk", f"runs/walk/{NAME}", f"runs/walk.{os.getpid()}.partial"],
    ids=["place", "name", "journal", "partial folder"],
)
def test_a_name_a_folder_and_a_journal_mean_the_run_that_goes_on(given: str) -> None:
    folder = made(Path(f"runs/walk.{os.getpid()}.partial"))
    run = follow(Path(given) if NAME not in given else folder / NAME)
    assert run.state is RunState.KILLED  # the number alone may be another process's
    with locked(folder):
        assert (run.name, run.folder, run.state) == ("walk", folder, RunState.GOES_ON)
    assert list(run.new()) == [BEGUN]
    assert list(run.new()) == []


def test_the_complete_one_comes_before_those_of_its_name_that_were_killed() -> None:
    made(Path(f"runs/walk.{NOBODY}.partial"), at_s=2_000_000_000)
    run = follow(made(Path("runs/walk"), at_s=1_000_000_000))
    assert (run.name, run.state) == ("walk", RunState.FINISHED)


def test_of_several_partial_ones_the_last_written_is_meant_and_no_other_run() -> None:
    made(Path("runs/walk.12.partial"), at_s=1_000_000_000)
    newer = made(Path(f"runs/walk.{NOBODY}.partial"), at_s=1_500_000_000)
    made(Path("runs/walk-past.13.partial"), at_s=2_000_000_000)
    run = follow(Path("runs/walk"))
    assert (run.folder, run.state) == (newer, RunState.KILLED)


def test_without_a_name_the_newest_is_meant() -> None:
    made(Path("runs/new"), at_s=1_500_000_000)
    made(Path("runs/old"), at_s=1_000_000_000)
    Path("runs/empty").mkdir()
    assert follow(None).name == "new"


def test_a_run_is_followed_while_it_gets_its_name() -> None:
    with RunFolder(Path("runs/walk")) as folder, JournalWriter(folder.work / NAME) as journal:
        journal.add(BEGUN)
        journal.flush()
        run = follow(Path("walk"))
        assert list(run.new()) == [BEGUN]
        journal.add(Said(5, "half"))
        journal.flush()
        folder.complete()
        assert list(run.new()) == [Said(5, "half")]
        journal.add(Said(6, "whole"))
    assert list(run.new()) == [Said(6, "whole")]
    assert (run.state, run.folder) == (RunState.FINISHED, Path("runs/walk"))


def test_a_run_that_gets_its_name_while_its_lock_is_looked_at_was_not_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    def moved(folder: Path) -> bool:
        folder.rename("runs/walk")
        return False

    monkeypatch.setattr(followed_run, "is_locked", moved)
    assert follow(made(Path("runs/walk.5.partial"))).state is RunState.FINISHED


def test_a_run_that_removes_its_folder_says_nothing_more() -> None:
    with RunFolder(Path("runs/walk")) as folder:
        made(folder.work / "x")
        (folder.work / "x" / NAME).rename(folder.work / NAME)
        run = follow(Path("walk"))
    assert (list(run.new()), run.state) == ([], RunState.REMOVED)


def test_silence_counts_after_a_second_and_while_the_run_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [10**9]
    monkeypatch.setattr(followed_run.time, "monotonic_ns", lambda: now[0])
    with locked(made(Path("runs/walk.5.partial"))) as folder:
        run = follow(folder)
        now[0] += 3 * 10**9
        assert run.silent_ns == 3 * 10**9
        assert len(list(run.new())) == 1
        now[0] += 10**9
        assert run.silent_ns == 0
        now[0] += 1
        assert run.silent_ns == 10**9 + 1
        folder.rename("runs/walk")
        assert run.silent_ns == 0


@pytest.mark.parametrize("given", ["runs/walk", "walk", f"runs/walk/{NAME}"])
def test_one_that_has_not_begun_is_waited_for(given: str) -> None:
    """What a killed run of that name left is not taken for it, unless its folder is named."""
    left = made(Path("runs/walk.4.partial"))
    steps: Iterator[object] = iter((None, made))
    waited: list[float] = []
    with ExitStack() as run:

        def sleep(seconds: float) -> None:
            waited.append(seconds)
            if next(steps) is made:
                run.enter_context(locked(made(Path("runs/walk.5.partial"))))

        assert follow(Path(given), wait=True, sleep=sleep).folder == Path("runs/walk.5.partial")
    assert len(waited) == 2
    for named in (left, left / NAME):
        assert follow(named, wait=True).folder == left


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (None, "runs: found no run with a journal, expected a run folder with a journal; start one"),
        ("wolk", "wolk: found no such run, expected a run folder with a journal; did you mean 'walk'?"),
        ("elsewhere/walk", "elsewhere/walk: found no such run"),
        (f"elsewhere/walk/{NAME}", f"elsewhere/walk/{NAME}: found no such run"),
        ("runs/wolk", "runs/wolk: found no such run, .*; did you mean 'runs/walk'?"),
        ("runs/x", r"runs/x: found no such run, expected a run folder with a journal; runs/ has old, walk$"),
        ("dangl", "dangl: found no such run, expected a run folder with a journal$"),
        ("mines", "mines: found no such run, .*; did you mean 'mine'?"),
        ("runs/old", r"runs/old: found no journal\.msgpack, .*; an older Trilane wrote it; run the scene again"),
        ("file", "file: found no such folder"),
        ("dangling", r"dangling: found journal\.msgpack, a link to a file that is not there, expected a run folder"),
    ],
)
def test_what_is_no_run_is_refused(given: str | None, said: str) -> None:
    Path("runs/walk.7.partial").mkdir(parents=True)
    Path("runs/old").mkdir()
    Path("runs/old/report.json").touch()
    Path("file").touch()
    Path("mine").mkdir()
    (Path("mine") / NAME).touch()
    Path("dangling").mkdir()
    (Path("dangling") / NAME).symlink_to("nothing")
    with pytest.raises(BadInputError, match=said):
        follow(None if given is None else Path(given))
