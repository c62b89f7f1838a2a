"""What somebody takes away from a run that goes on, and what its report and its last sentence then say."""

from __future__ import annotations

import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from support.doubles import pipeline_of_doubles
from trilane.apps.cli.main import describe
from trilane.apps.run import run_folder
from trilane.apps.run.report import read_report
from trilane.apps.run.run_job import Hooks, Prepared, RunOutcome, run_to_folder
from trilane.errors import BadInputError, TrilaneError, UnwrittenError
from trilane.hw_profiles.host import host_units
from trilane.pipeline.memory import Assets
from trilane.pipeline.result import RunResult
from trilane.pipeline.run import run_pipeline
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scene.schema import OutputSpec, Scene
from trilane.stages.config import RunConfig
from trilane.stages.configure import Checked
from trilane.stages.machine_facts import machine_facts
from trilane.stages.run_options import RunOptions

FRAMES = 5000
pytestmark = pytest.mark.usefixtures("no_new_process")


@pytest.fixture
def run(starter: UnitStarter, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., RunOutcome]:
    """Run mock units to tmp_path/a/run; `at(work)` is called once, when frames were presented.

    Further keywords are what stages say of their jobs.
    """
    said: dict[str, Mapping[str, float]] = {}

    def run_doubles(config: RunConfig, assets: Assets, frames: int | None, edge: str, **options: Any) -> RunResult:
        pipeline = pipeline_of_doubles().with_rule(edge)
        count, fps = frames or config.scene.frames, config.scene.fps
        result = run_pipeline(pipeline, count, fps=fps, assets=assets, **{**options, "starter": starter})
        return replace(result, metrics={**result.metrics, **said})

    monkeypatch.setattr("trilane.apps.run.run_job.run_avatar", run_doubles)

    def run(at: Callable[[Path], None], frames: int = FRAMES, **stages: Mapping[str, float]) -> RunOutcome:
        waiting = [at]
        said.update(stages)

        def progress(_what: str, presented: int, _requested: int) -> None:
            if presented and waiting:
                waiting.pop()(next((tmp_path / "a").glob("run.*.partial")))

        scene = Scene(frames=frames, output=OutputSpec(width=64, height=64))
        config = RunConfig(scene=scene, out_dir=tmp_path, avatar_dirs=(), units=host_units())
        prepared = Prepared(RunOptions(baseline_frames=0), Checked(config, assets={}, notes=(), accuracy={}))
        hooks = Hooks(progress, lambda _text: None)
        return run_to_folder(prepared, tmp_path / "a" / "run", hooks, machine=machine_facts())

    return run


@contextmanager
def file_limit(bytes_: int) -> Iterator[None]:
    """No file of this process may be longer: what stands for a disk that takes no more."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (bytes_, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_run_whose_folder_is_removed_ends_and_says_so(run: Callable[..., RunOutcome], tmp_path: Path) -> None:
    with pytest.raises(TrilaneError) as raised:
        run(shutil.rmtree)
    assert not isinstance(raised.value, BadInputError) and raised.value.exit_code == 1
    said = str(raised.value)
    assert said.startswith(f"{tmp_path}/a/run.") and said.endswith(": it was moved or removed while the run went on")
    assert list(tmp_path.rglob("*")) == []


def test_a_run_whose_journal_is_removed_says_so(run: Callable[..., RunOutcome], tmp_path: Path) -> None:
    """The journal cannot be read back, so there is no report; the sentence names the file."""
    with pytest.raises(TrilaneError, match=r"journal\.msgpack: it was removed while it was written; nothing") as raised:
        run(lambda work: (work / "journal.msgpack").unlink())
    assert raised.value.exit_code == 1
    assert list(tmp_path.rglob("*")) == []


def test_a_run_whose_segments_are_removed_fails_and_keeps_its_report(
    run: Callable[..., RunOutcome], tmp_path: Path
) -> None:
    """Doubles write none, so a run that says it has encoded its frames has lost them."""
    outcome = run(lambda _work: None, frames=30, present={"encode_ms": 1.0})
    said = f"{tmp_path}/a/run/segments: files were removed from it during the run"
    assert (outcome.exit_code, outcome.report.failure) == (1, said)
    names = {path.name for path in outcome.folder.iterdir()}
    assert names == {"report.json", "journal.msgpack", "events.jsonl", "trace.pftrace"}
    assert read_report(outcome.folder).frames.presented == 30


def test_a_disk_that_fills_keeps_the_report(
    run: Callable[..., RunOutcome], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Journal, trace and recording would each be some MB long; the report has a third of what the journal may."""
    monkeypatch.setattr(run_folder, "RESERVED_BYTES", 50_000)
    with file_limit(150_000):
        outcome = run(lambda _work: None)
    why = "file too large: no file may have more than 150000 bytes (ulimit -f); ulimit -f unlimited"
    said = f"{tmp_path}/a/run/journal.msgpack: {why}"  # the folder has its name by then
    assert (outcome.exit_code, outcome.report.failure) == (1, said)
    frames = read_report(tmp_path / "a" / "run").frames
    assert frames.presented > 20
    assert frames.presented + frames.lost + (frames.not_begun or 0) == FRAMES
    names = {path.name for path in outcome.folder.iterdir()}
    assert names <= {"report.json", "journal.msgpack", "events.jsonl", "trace.pftrace"}


def test_a_run_takes_the_space_of_its_report_before_it_begins(run: Callable[..., RunOutcome], tmp_path: Path) -> None:
    """A limit of the process is no bad input."""
    said = r"run: file too large: no file may have more than 150000 bytes \(ulimit -f\); ulimit -f unlimited$"
    with file_limit(150_000), pytest.raises(UnwrittenError, match=said) as raised:
        run(lambda _work: pytest.fail("it began"))
    assert raised.value.exit_code == 1
    assert list(tmp_path.rglob("*")) == []


def test_a_command_in_a_folder_that_was_removed_says_so(tmp_path: Path) -> None:
    """Other files that are missing keep their own sentence."""
    code = "import os, shutil; shutil.rmtree(os.getcwd()); from trilane.apps.cli.main import entry; entry()"
    for words in (("run", "--frames", "3"), ("plan", "default")):
        folder = tmp_path / words[0]
        folder.mkdir()
        done = subprocess.run(
            [sys.executable, "-c", code, *words], cwd=folder, capture_output=True, text=True, timeout=120, check=False
        )
        assert done.returncode == 1
        assert done.stderr == "error: the working directory was removed; change to another one\n"
    assert describe(FileNotFoundError(2, "No such file or directory")) == ("the system: no such file or directory", 1)
