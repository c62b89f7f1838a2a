"""The run folder and the report of a run, made from a run written by hand."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from support.run_report import SHARE, SHOWN, make_report
from trilane import machine
from trilane.apps.run import report as report_module
from trilane.apps.run.report import Report, read_report, write_report
from trilane.apps.run.report_facts import sources_of
from trilane.apps.run.run_folder import RunFolder, default_place
from trilane.errors import BadInputError, TrilaneError, UnwrittenError
from trilane.units import COMPARED, COMPUTED, MEASURED
from trilane.writing import WRITABLE, write_atomically

#: Keys of a report whose numbers are no figures, but settings, identifiers or facts about the machine.
NO_FIGURES_UNDER = ("schema", "machine", "config", "options", "plan", "pids")


def test_a_folder_has_its_name_once_it_is_complete(tmp_path: Path) -> None:
    target = tmp_path / "a" / "run"
    with RunFolder(target) as folder:
        (folder.work / "report.json").write_text("{}")
        assert not target.exists()
        assert folder.work.name.endswith(f"{os.getpid()}.partial")
        assert folder.complete() == target
    assert [path.name for path in target.iterdir()] == ["report.json"]
    assert [path.name for path in target.parent.iterdir()] == ["run"]


OTHER_RUN = """
import sys
from pathlib import Path
from trilane.apps.run.run_folder import RunFolder
with RunFolder(Path(sys.argv[1])):
    print("begun", flush=True)
    sys.stdin.read()
"""


def test_a_second_run_with_one_name_is_refused_before_it_begins(tmp_path: Path) -> None:
    """But not one of another name beside it, and none when the first has been killed, whose folder stays."""
    command = [sys.executable, "-c", OTHER_RUN, str(tmp_path / "run [1]")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None and other.stdout.readline() == b"begun\n"
        with pytest.raises(BadInputError) as refused, RunFolder(tmp_path / "run [1]"):
            pass
        found = f"found a run that goes on, in run [1].{other.pid}.partial, expected a name that is free"
        assert str(refused.value) == f"{tmp_path / 'run [1]'}: {found}; choose another --out"
        assert [path.name for path in tmp_path.iterdir()] == [f"run [1].{other.pid}.partial"]
        with RunFolder(tmp_path / "run") as folder:
            folder.complete()
        other.kill()
    with RunFolder(tmp_path / "run [1]") as folder:
        folder.complete()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["run", "run [1]", f"run [1].{other.pid}.partial"]


def test_a_killed_run_of_the_same_number_loses_nothing(tmp_path: Path) -> None:
    """In a container, each run may have the same process number."""
    left = tmp_path / f"run.{os.getpid()}.partial"
    left.mkdir()
    (left / "journal.msgpack").write_text("mine")
    with RunFolder(tmp_path / "run") as folder:
        assert folder.work.name == f"run.{os.getpid() + 1}.partial"
    with RunFolder(tmp_path / "run") as folder:
        folder.complete()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", left.name]
    assert (left / "journal.msgpack").read_text() == "mine"


def test_a_folder_that_another_made_stays_when_the_entry_fails(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    folder.work.mkdir()
    with pytest.raises(BadInputError, match="file exists"), folder:
        pass
    assert [*tmp_path.iterdir()] == [folder.work]


def test_a_disk_without_room_leaves_no_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    before = len(list(Path("/proc/self/fd").iterdir()))
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(BadInputError, match="no space left on device"), RunFolder(tmp_path / "run"):
        pass
    assert len(list(Path("/proc/self/fd").iterdir())) == before
    assert [*tmp_path.iterdir()] == []


def test_a_folder_that_was_not_completed_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), RunFolder(tmp_path / "a" / "b" / "run") as folder:
        (folder.work / "half").write_text("half")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_second_run_of_the_same_second_has_a_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(machine.here, "now", lambda: datetime(2026, 11, 22, 3, 4, 5, tzinfo=UTC))
    for name in ("20261122T030405Z-a_b-1", "20261122T030405Z-a_b-1-2", "20261122T030405Z-a_b-1-3"):
        assert default_place("a_b-1") == Path("runs") / name
        (Path("runs") / f"{name}.17.partial").mkdir(parents=True)  # one goes on
        if not name.endswith("2"):
            (Path("runs") / name).mkdir()


def refusal(target: Path) -> str:
    with pytest.raises(BadInputError) as refused, RunFolder(target):
        pass
    return str(refused.value)


def test_refusals_word_by_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Relative names are made absolute; what was made on the way is removed again."""
    monkeypatch.chdir(tmp_path)
    Path("taken").mkdir()
    Path("taken", "mine").write_text("mine")
    Path("file").touch()
    taken = f"{tmp_path}/taken: found a file or folder, expected a name that is free; choose another --out"
    assert refusal(Path("taken")) == taken
    below = f"{tmp_path}/file/run: found not a directory, expected {WRITABLE}; choose another --out"
    assert refusal(Path("file/run")) == below
    too_long = refusal(Path("new/folder") / ("a" * 250))
    assert too_long.endswith(f"found file name too long, expected {WRITABLE}; choose another --out")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "mine", "taken"]


def test_a_name_taken_in_the_meantime_loses_nothing(tmp_path: Path) -> None:
    with pytest.raises(BadInputError) as refused, RunFolder(tmp_path / "run") as folder:
        (folder.work / "report.json").write_text("{}")
        (tmp_path / "run" / "other").mkdir(parents=True)
        folder.complete()
    assert (folder.work / "report.json").exists()
    said = f"found directory not empty, expected a name that is free; the run is in {folder.work}"
    assert str(refused.value) == f"{tmp_path}/run: {said}"


FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(
    ("failure", "named"),
    [
        (UnwrittenError("/a/journal", FULL), "/a/journal"),
        (OSError(errno.ENOSPC, "No space left on device", "/a/file"), "/a/file"),
        (FULL, "WORK"),
        ("report", "WORK/report.json"),
    ],
)
def test_a_full_disk_leaves_what_was_written_and_says_where(failure: Any, named: str, tmp_path: Path) -> None:
    with pytest.raises(TrilaneError) as refused, RunFolder(tmp_path / "run") as folder:
        (folder.work / "half").write_text("half")
        if failure == "report":
            with write_atomically(folder.work / "report.json"):
                raise FULL
        raise failure
    work = folder.work
    said = f"no space left on device; free space there or choose another --out; what was written stays in {work}"
    assert str(refused.value) == f"{named.replace('WORK', str(work))}: {said}"
    assert (refused.value.exit_code, (work / "half").read_text()) == (1, "half")


def test_a_full_disk_that_took_nothing_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(TrilaneError, match=r"; nothing was written$"), RunFolder(tmp_path / "a" / "run") as folder:
        (folder.work / "journal").touch()
        raise FULL
    assert list(tmp_path.iterdir()) == []


def test_an_error_about_something_else_stays_itself(tmp_path: Path) -> None:
    with pytest.raises(BrokenPipeError), RunFolder(tmp_path / "run") as folder:
        (folder.work / "half").write_text("half")
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")
    assert list(tmp_path.iterdir()) == []


def test_a_parent_that_others_use_by_then_stays(tmp_path: Path) -> None:
    with pytest.raises(KeyError), RunFolder(tmp_path / "a" / "b" / "run"):
        (tmp_path / "a" / "other").touch()
        raise KeyError
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == ["a", "a/other"]


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


def test_frames_that_do_not_add_up_are_refused_and_those_of_an_older_report_are_read(tmp_path: Path) -> None:
    frames = make_report()["frames"]
    said = "5 frames were requested, but 3 presented, 0 lost, 1 dropped and 0 not begun"
    with pytest.raises(ValueError, match=said):
        Report.model_validate(make_report(frames={**frames, "not_begun": 0}))
    del frames["not_begun"]
    (tmp_path / "report.json").write_text(json.dumps(make_report(frames=frames)))
    report = read_report(tmp_path)
    assert report.frames.not_begun is None
    assert report.as_json()["frames"] == frames


def test_a_report_of_a_newer_schema_is_refused_as_such(tmp_path: Path) -> None:
    (tmp_path / "report.json").write_text(json.dumps({"schema": 2, "everything": "else"}))
    with pytest.raises(BadInputError, match="schema: found 2, expected 1; a newer Trilane"):
        read_report(tmp_path)


def test_what_is_no_report_is_named_word_by_word(tmp_path: Path) -> None:
    def said(text: str) -> str:
        (tmp_path / "report.json").write_text(text)
        with pytest.raises(BadInputError) as refused:
            read_report(tmp_path)
        return str(refused.value).removeprefix(f"{tmp_path}/report.json: ")

    expected = "expected a run folder or its report.json"
    assert said("null") == f"the document: found input should be a valid dictionary or instance of report, {expected}"
    damaged = make_report(units={"dsp": {**SHARE, "idle": {}}})
    assert said(json.dumps(damaged)) == f"units.dsp.idle.starved: found field required, {expected}"
    assert said("{").startswith("the document: found EOF while parsing") and said("{").endswith(expected)
    newer = "expected 1; a newer Trilane wrote it: update this one"
    assert said('{"schema": 7}') == f"schema: found 7, {newer}"
    assert said('{"schema": "7"}') == f"schema: found input should be 1, {expected}"
    assert not said(json.dumps(make_report(schema=0))).endswith(newer)


SCENE = make_report()["config"]["scene"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"config": {}}, "config.scene: found no table of keys and values"),
        ({"config": {"scene": {}}}, "config.scene.name: found field required"),
        ({"config": {"scene": {**SCENE, "avatars": [{}]}}}, "config.scene.avatars.0.bundle: found field required"),
        ({"config": {"scene": {**SCENE, "fps": "30"}}}, "config.scene.fps: found input should be a valid number"),
        ({"config": {"scene": {**SCENE, "output": 5}}}, "config.scene.output: found input should be"),
        (
            {"config": {"scene": {**SCENE, "output": {"width": "x"}}}},
            "config.scene.output.width: found input should be",
        ),
        ({"accuracy": {"Hiker": {"source": "validation"}}}, "accuracy.Hiker: found no psnr_db and no psnr_db_by_band"),
        (
            {"accuracy": {"Hiker": {"psnr_db_by_band": {"far": "30"}}}},
            "accuracy.Hiker.psnr_db_by_band.far: found input",
        ),
        ({"accuracy": {"Hiker": {"psnr_db": 10**400}}}, "accuracy.Hiker.psnr_db: found input should be a"),
    ],
)
def test_what_is_read_of_a_scene_and_of_an_accuracy_is_checked(
    tmp_path: Path, change: dict[str, Any], said: str
) -> None:
    (tmp_path / "report.json").write_text(json.dumps(make_report(**change)))
    with pytest.raises(BadInputError) as refused:
        read_report(tmp_path)
    assert said in str(refused.value)


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "any.json"
    write_report(Report.model_validate(make_report()), file)
    size = file.stat().st_size
    monkeypatch.setattr(report_module, "MAX_REPORT_BYTES", size)
    assert read_report(file).fps == 50.0
    monkeypatch.setattr(report_module, "MAX_REPORT_BYTES", size - 1)
    with pytest.raises(BadInputError) as refused:
        read_report(file)
    assert str(refused.value) == f"{file}: found {size} bytes, expected a report of at most {size - 1}"


def test_a_report_that_could_not_be_read_back_is_never_written(tmp_path: Path) -> None:
    wrong = Report.model_validate(make_report()).model_copy(update={"fps": "fast"})
    with pytest.warns(UserWarning, match="fast"), pytest.raises(ValueError, match="fps"):
        write_report(wrong, tmp_path / "report.json")
    assert list(tmp_path.iterdir()) == []


def test_a_report_never_holds_nan(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        write_report(Report.model_validate(make_report(fps=float("nan"))), tmp_path / "report.json")


def figures_in(value: Any, above: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The keys to every number in a document."""
    if isinstance(value, dict):
        for key, below in value.items():
            yield from figures_in(below, (*above, key))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield above


def test_every_figure_of_a_report_has_a_source() -> None:
    times = {"stage_ms": {"infer": 1.0}, "virtual_ms": 1.0, "ratio": 1.0, "measured_ms": 1.0, "compared_share": 1.0}
    chip = {"profile": "chip", "performance_profile": "burst", "slow_motion": 1.0}
    paced = {**chip, **times, "host_slower": {}, "late_frames": []}
    document = make_report(video={"frames": 3, "seconds": 0.1}, pace=paced, temperature_c={"sensor": 50.0})
    sources = sources_of(Report.model_validate(document))
    for path in figures_in(document):
        if path[0] not in NO_FIGURES_UNDER:
            assert any(".".join(path[:count]) in sources for count in range(1, len(path) + 1)), path
    assert set(sources.values()) == {MEASURED, COMPUTED, COMPARED, SHOWN["source"]}
    assert sources["accuracy.someone"] == SHOWN["source"]
    assert sources["fps"] == sources["stages"] == sources["temperature_c.sensor"] == MEASURED
    assert sources["temperature_c"] == sources["caps"] == sources["pace"] == COMPUTED


def test_a_report_with_the_isolated_times_of_an_older_trilane_is_read(tmp_path: Path) -> None:
    (tmp_path / "report.json").write_text(json.dumps(make_report(isolated_ms={"infer": 4.0})), encoding="utf-8")
    assert read_report(tmp_path) == Report.model_validate(make_report())
