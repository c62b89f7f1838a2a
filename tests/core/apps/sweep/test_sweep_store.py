"""A sweep's folder: lines that are whole, torn or wrong, whose trials are there, and who may write."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilane.apps.sweep import store as module
from trilane.apps.sweep.definition import Trial
from trilane.apps.sweep.engines import ended_as
from trilane.apps.sweep.store import (
    SWEEP,
    TRIALS,
    Store,
    TrialRecord,
    latest,
    planned,
    read_trials,
    run_sweep,
    whole_lines,
)
from trilane.errors import BadInputError

TRIALS_3 = [Trial(("predict",), {"size": size}, ("--size", size)) for size in ("1", "2", "3")]
FIRST, SECOND, THIRD = TRIALS_3


def record(trial: Trial, status: str = "done") -> TrialRecord:
    return planned(trial).model_copy(update={"status": status, "exit_code": 0, "seconds": 1.0})


def line(of: TrialRecord) -> bytes:
    return json.dumps(of.as_json()).encode() + b"\n"


def opened(folder: Path, trials: list[Trial] = TRIALS_3, *, resume: bool = False) -> Store:
    return Store(folder, trials, {"made": "by a test"}, resume=resume)


@settings(max_examples=50)
@given(st.lists(st.dictionaries(st.text(), st.text() | st.floats(allow_nan=False) | st.none()), max_size=4), st.data())
def test_a_file_cut_anywhere_has_the_lines_before_the_cut(contents: list[dict[str, Any]], data: Any) -> None:
    records = [{**each, "id": str(place), "status": "done"} for place, each in enumerate(contents)]
    lines = [json.dumps(each).encode() + b"\n" for each in records]
    whole = b"".join(lines)
    cut = data.draw(st.integers(0, len(whole)))
    ends = [sum(map(len, lines[:count])) for count in range(len(lines) + 1)]
    before = max(count for count, end in enumerate(ends) if end <= cut)
    found, size = whole_lines(whole[:cut], "x")
    assert ([each.id for each in found], size) == ([each["id"] for each in records[:before]], ends[before])


def test_a_wrong_last_line_is_torn_and_a_wrong_one_before_it_is_named() -> None:
    good = line(record(FIRST))
    assert whole_lines(good + b"\0\0\0\n", "x") == ([record(FIRST)], len(good))
    for wrong in (b"\0\n", b"[1]\n", b'{"id": "a"}\n', b'{"id": "a", "status": "done", "options": 5}\n', b"\n"):
        with pytest.raises(BadInputError, match=r"trials.jsonl, line 2: found no trial.*done again"):
            whole_lines(good + wrong + good, "trials.jsonl")


@pytest.mark.parametrize(
    "wrong",
    [{"repeat": True}, {"exit_code": "5"}, {"unsure": None}, {"seconds": float("nan")}, {"result": [[]] * 3}],
    ids=str,
)
def test_a_last_line_with_a_wrong_value_is_named_and_not_cut_off(wrong: dict[str, Any]) -> None:
    bad = json.dumps({"id": "a", "status": "done", **wrong}).encode() + b"\n"
    with pytest.raises(BadInputError, match=r"trials.jsonl, line 2: found no trial"):
        whole_lines(line(record(FIRST)) + bad, "trials.jsonl")


def test_a_short_line_has_the_words_and_options_of_its_trial(tmp_path: Path) -> None:
    with opened(tmp_path / "s"):
        pass
    (tmp_path / "s" / "trials.jsonl").write_text(json.dumps({"id": FIRST.id, "status": "done"}) + "\n")
    with opened(tmp_path / "s", resume=True) as store:
        (first, *_) = store.summary(set()).trials
    assert (first.status, first.command, first.options) == ("done", planned(FIRST).command, FIRST.options)


def test_the_last_word_on_a_trial_counts() -> None:
    assert latest([record(FIRST, "lost"), record(SECOND), record(FIRST)]) == {
        FIRST.id: record(FIRST),
        SECOND.id: record(SECOND),
    }


def test_a_torn_line_is_cut_off_and_its_trial_done_again(tmp_path: Path) -> None:
    with opened(tmp_path / "s") as store:
        store.add(record(FIRST))
        store.add(record(SECOND))
    file = tmp_path / "s" / TRIALS
    file.write_bytes(file.read_bytes()[:-7])
    with opened(tmp_path / "s", resume=True) as store:
        assert list(store.done) == [FIRST.id]
        store.add(record(THIRD))
    assert [json.loads(line)["id"] for line in file.read_text().splitlines()] == [FIRST.id, THIRD.id]
    assert list(read_trials(tmp_path / "s")) == [FIRST.id, THIRD.id]


def test_trials_that_are_too_large_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with opened(tmp_path / "s") as store:
        store.add(record(FIRST))
    size = (tmp_path / "s" / TRIALS).stat().st_size
    monkeypatch.setattr(module, "MAX_TRIALS_BYTES", size)
    assert list(read_trials(tmp_path / "s")) == [FIRST.id]
    monkeypatch.setattr(module, "MAX_TRIALS_BYTES", size - 1)
    with pytest.raises(BadInputError, match=f"found {size} bytes, expected at most {size - 1}"):
        read_trials(tmp_path / "s")
    with pytest.raises(BadInputError, match=f"found {size} bytes"), opened(tmp_path / "s", resume=True):
        pytest.fail("a file that is too large was read")


def test_what_a_folder_is_taken_up_for(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "s"
    with pytest.raises(BadInputError, match="no sweep, expected one to go on with"):
        opened(folder, resume=True).__enter__()
    assert not folder.exists()
    with opened(folder) as store:
        store.add(record(FIRST))
    described = json.loads((folder / SWEEP).read_text())
    assert (described["made"], [each["id"] for each in described["trials"]]) == (
        "by a test",
        [trial.id for trial in TRIALS_3],
    )
    with pytest.raises(BadInputError, match=r"1 of 3 trials done.*--resume goes on"):
        opened(folder).__enter__()
    for resume in (True, False):
        with pytest.raises(BadInputError, match="a sweep of 3 trials; 2 of them are among these 2"):
            opened(folder, TRIALS_3[:2], resume=resume).__enter__()
    with opened(folder, resume=True) as store:
        store.add(record(SECOND, "failed"))
        store.add(record(THIRD))
    with opened(folder) as store:
        assert len(store.done) == 3


def test_one_process_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LOCK_S", 0.0)
    with opened(tmp_path), pytest.raises(BadInputError, match="a sweep that goes on"):
        opened(tmp_path, resume=True).__enter__()
    with opened(tmp_path):
        pass


def test_only_lost_trials_are_tried_again(tmp_path: Path) -> None:
    asked: list[list[Trial]] = []

    def engine(trials: Any) -> Any:
        asked.append(list(trials))
        for trial in trials:
            status = {FIRST.id: "lost", SECOND.id: "failed"}.get(trial.id, "lost" if len(asked) == 1 else "done")
            yield record(trial, status)

    told: list[Any] = []
    with opened(tmp_path) as store:
        run_sweep(TRIALS_3, store, engine, told.append)
        assert asked == [TRIALS_3, [FIRST, THIRD], [FIRST]]
        assert {name: (each.status, each.tries) for name, each in store.done.items()} == {
            SECOND.id: ("failed", 1),
            THIRD.id: ("done", 2),
            FIRST.id: ("lost", 3),
        }
        assert len(told) == 3
        run_sweep(TRIALS_3, store, engine, told.append)
        assert asked[3:] == [[FIRST]] * 3  # asked for once more, what was lost is tried again; the failed one is not
        found = store.summary({THIRD.id})
    assert found.counts == {"trials": 3, "done": 1, "failed": 1, "lost": 1, "planned": 0, "skipped": 1}


@pytest.mark.parametrize(
    ("code", "out", "status", "error"),
    [
        (0, '{"a": 1}', "done", None),
        (0, "text", "failed", "exit code 0, but no JSON document on stdout"),
        (0, "[1]", "failed", "exit code 0, but no JSON document on stdout"),
        (1, '{"a": 1}', "failed", "the last line"),
        (2, "", "failed", "the last line"),
        (-11, "", "failed", "the last line"),
        (-9, '{"a": 1}', "lost", "the last line"),
        (-15, "", "lost", "the last line"),
        (130, '{"a": 1}', "lost", "the last line"),
    ],
)
def test_how_a_process_ended(code: int, out: str, status: str, error: str | None) -> None:
    result = {"a": 1} if out.startswith("{") and status != "lost" else None
    found = ended_as(FIRST, code, out, "first\n  the last line \n\n")
    assert (found.status, found.exit_code, found.error, found.result) == (status, code, error, result)


def test_a_process_without_a_word() -> None:
    assert ended_as(FIRST, -11, "", "").error == "exit code -11, no message"


def test_a_sweep_of_a_file_with_other_contents_is_another_sweep(tmp_path: Path) -> None:
    chip = tmp_path / "chip.toml"
    chip.write_text("a = 1", encoding="utf-8")
    trials = [Trial(("predict",), {"profile": str(chip), "size": ["1", "2"]}, ())]
    for _ in range(2):  # again as it is: it is complete
        with opened(tmp_path / "s", trials) as store:
            store.add(record(trials[0]))
    chip.write_text("a = 2", encoding="utf-8")
    with pytest.raises(BadInputError, match=r"read .*chip.toml with other contents.*choose another --out"):
        opened(tmp_path / "s", trials).__enter__()


@pytest.mark.parametrize("text", ["x" * 300, "a\0b"])
def test_a_value_that_cannot_be_a_path_is_no_file(text: str) -> None:
    assert module.input_digests([Trial(("run",), {"scene": text}, ())]) == {}
