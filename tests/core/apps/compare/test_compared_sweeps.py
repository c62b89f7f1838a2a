"""What `trilane compare` says of two sweeps, of trials whose difference is known."""

from __future__ import annotations

import json
from collections.abc import Callable
from math import log
from pathlib import Path
from typing import Any

import pytest

from support.compared_runs import simulated, write_run
from trilane.apps.cli.compare import sweep_lines
from trilane.apps.compare.compared_sweeps import SweepComparison, compare_sweeps
from trilane.apps.compare.difference import Finding
from trilane.apps.compare.gate import LimitOutcome, judge, read_gate
from trilane.errors import BadInputError

SweepOf = Callable[..., Path]
#: Of a trial: how much longer its network takes.
SAME = {"infer": 1.0}


@pytest.fixture
def sweep(tmp_path: Path) -> SweepOf:
    """Writes a sweep of `run`: trials by size, each with the factors of its stages, or None where it failed.

    Without `folders` only its results are there.
    """

    def write(name: str, trials: dict[int, Any], seed: int = 1, *, folders: bool = True, repeats: int = 1) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        lines = []
        for size, factors in trials.items():
            for repeat in range(1, repeats + 1):
                own = f"{size:08x}{repeat:08x}"
                record = {"id": own, "command": ["trilane", "run", "--size", str(size), "--json"], "repeat": repeat}
                record |= {"options": {"size": size, "edge": "double"}, "folder": None, "result": None}
                record |= {"status": "failed" if factors is None else "done"}
                if factors is not None:
                    place = write_run(folder / own, simulated(seed + repeat, frames=80, factors=factors))
                    result = json.loads((place / "report.json").read_text())
                    record |= {"folder": own if folders else None, "result": result}
                lines.append(json.dumps(record))
        (folder / "trials.jsonl").write_text("".join(f"{line}\n" for line in lines))
        return folder

    return write


def compared(base: Path, other: Path) -> SweepComparison:
    return compare_sweeps(str(base), str(other))


def test_trials_of_equal_configuration_are_paired(sweep: SweepOf) -> None:
    """64 takes as long, 96 a fifth longer; 128 failed, 160 and 192 are in one sweep alone."""
    base = sweep("base", {64: SAME, 96: SAME, 128: SAME, 160: SAME})
    other = sweep("other", {192: SAME, 128: None, 96: {"infer": 1.2}, 64: SAME})
    found = compared(base, other)
    assert [pair.options["size"] for pair in found.pairs] == [64, 96]
    assert [pair.differs for pair in found.pairs] == [False, True]
    ratio = found.pairs[1].frame_time.other / found.pairs[1].frame_time.base
    assert ratio == pytest.approx(1.2, abs=0.01) and found.pairs[0].frame_time.change == 0
    assert log(1 + found.over_all.change) == pytest.approx(log(1 + found.pairs[1].frame_time.change) / 2)
    left = {reason: [int(name[:8], 16) for name in names] for reason, names in found.left_out.items()}
    assert left == {"not_done": [128], "base_alone": [160], "other_alone": [192]}
    assert found.verdict.startswith("frame time differs in 1 of 2 trials, 1 of them slower; over all +9.")
    judged = [judge([read_gate(f"slower={limit}%")], [pair.sides for pair in found.pairs]) for limit in (15, 25)]
    assert [[each.outcome for each in one] for one in judged] == [
        [LimitOutcome.KEPT, LimitOutcome.BROKEN],
        [LimitOutcome.KEPT] * 2,
    ]
    assert compared(base, base).verdict.startswith("no difference in any of 4 trials; over all +0.0 %")


def told_bound(name: str) -> dict[str, Any]:
    share = {"name": name, "share": 0.6, "share_low": 0.5, "share_high": 0.7, "rivals": []}
    return {"bottleneck": name, "bound": {"unit": share, "stage": {**share, "name": "infer"}}}


def test_the_bound_of_either_sweep_is_named_and_in_how_many_trials_it_changed(sweep: SweepOf) -> None:
    """Of three trials the bound stays in one, changes in one, and is not known of one in the other sweep."""
    base, other = (sweep(name, {64: SAME, 96: SAME, 128: SAME}, folders=False) for name in ("base", "other"))
    bounded = {base: ["dsp", "dsp", "gpu"], other: ["dsp", "gpu", ""]}
    for folder, names in bounded.items():
        records = [json.loads(line) for line in (folder / "trials.jsonl").read_text().splitlines()]
        for record, name in zip(records, names, strict=True):
            record["result"] |= told_bound(name) if name else {"bottleneck": None, "bound": None}
        (folder / "trials.jsonl").write_text("".join(f"{json.dumps(record)}\n" for record in records))
    found = compared(base, other)
    assert [pair.bounds.outcome for pair in found.pairs] == [Finding.SAME, Finding.DIFFERS, Finding.UNKNOWN]
    assert found.bound == (
        "bound: dsp in 1 of 3 runs, gpu in 1 of 3 runs, not known in 1 of 3 runs; was dsp in 2 of 3 runs, gpu in 1 of "
        "3 runs; changed in 1 of 3 trials, of 1 it cannot be told"
    )
    assert found.bound in list(sweep_lines(found, show_all=False))
    trials = found.as_json()["trials"]
    assert [trial["bound"]["outcome"] for trial in trials] == ["no difference", "differs", "cannot tell"]
    assert trials[1]["bound"]["other"][0]["unit"]["name"] == "gpu"


def test_repeats_of_a_configuration_stand_for_it_together(sweep: SweepOf) -> None:
    base, other = sweep("base", {64: SAME}, repeats=3), sweep("other", {64: {"infer": 1.1}}, seed=9, repeats=2)
    (pair,) = compared(base, other).pairs
    assert (pair.runs, pair.differs) == (2, True)
    (again,) = compared(base, sweep("quicker", {64: {"infer": 0.9}}, repeats=3)).pairs
    assert again.runs == 3 and again.frame_time.high is not None and again.frame_time.high < 0


def test_of_runs_that_are_too_short_it_cannot_be_told(tmp_path: Path) -> None:
    report = json.loads((write_run(tmp_path / "run", simulated(1, frames=20)) / "report.json").read_text())
    record = {"id": "run", "status": "done", "command": ["trilane", "run"], "options": {}, "folder": "run"}
    (tmp_path / "trials.jsonl").write_text(json.dumps({**record, "result": report}) + "\n")
    found = compared(tmp_path, tmp_path)
    assert found.verdict.startswith("it cannot be told whether any of 1 trial differs; over all +0.0 % (")
    assert found.notes[-1].startswith("20 frames at the least")


@pytest.mark.parametrize("folder", ["..", "x" * 300])
def test_a_trial_names_no_folder_above_its_sweep(tmp_path: Path, folder: str) -> None:
    sweep = write_run(tmp_path / "run", simulated(1, frames=20)) / "sweep"
    sweep.mkdir()
    record = {"id": "run", "status": "done", "command": ["trilane", "run"], "folder": folder, "result": {}}
    (sweep / "trials.jsonl").write_text(json.dumps(record) + "\n")
    with pytest.raises(BadInputError, match="no run"):
        compared(sweep, sweep)


def test_without_run_folders_the_results_are_compared(sweep: SweepOf) -> None:
    base, other = sweep("base", {64: SAME}), sweep("other", {64: {"infer": 1.5}}, folders=False)
    (pair,) = compared(base, other).pairs
    assert pair.frame_time.change == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize(
    ("record", "said"),
    [
        (
            {"status": "done", "command": ["trilane", "bench", "raster"], "options": {}, "result": {"rows": []}},
            "no run",
        ),
        ({"status": "done", "options": {}}, "without a command"),
        ({"status": "lost", "command": ["trilane", "run"], "options": {}}, "no trial that .* has too, done in both"),
    ],
)
def test_sweeps_without_runs_are_refused(tmp_path: Path, record: dict[str, Any], said: str) -> None:
    (tmp_path / "trials.jsonl").write_text(json.dumps({"id": "0", **record}) + "\n")
    with pytest.raises(BadInputError, match=said):
        compared(tmp_path, tmp_path)


def test_the_command_line(sweep: SweepOf, command: Any) -> None:
    base, other = sweep("base", {64: SAME, 96: SAME}), sweep("other", {64: SAME, 96: {"infer": 1.2}, 128: SAME})
    out, _ = command("compare", base, other)
    table = [line for line in out.splitlines() if "\u2502" in line]
    assert len(table) == 1 and "differs" in table[0]
    assert "1 more trial does not differ" in out and "in the other alone: 1 (" in out
    assert len([line for line in command("compare", base, other, "--all")[0].splitlines() if "\u2502" in line]) == 2
    found = json.loads(command("compare", base, other, "--json")[0])
    assert [trial["differs"] for trial in found["trials"]] == [False, True]
    assert found["verdict"] == compared(base, other).verdict
    command("compare", base, other, "--fail-if-slower", "5%", code=1)
    command("compare", base, other, "--fail-if-slower", "30%")
    run = base / f"{64:08x}{1:08x}"
    for words, said in (
        ((base, other, base), "3 sweeps"),
        ((base, run), "no sweep, beside"),
        ((base, other, "--html", "page.html"), "--html with sweeps"),
    ):
        assert said in command("compare", *words, code=2)[1]
