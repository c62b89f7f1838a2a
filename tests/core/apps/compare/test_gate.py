"""`trilane compare` as a gate: what keeps a limit, what breaks it, and what cannot be told.

Runs are simulated as in test_compared_pairs.py. Other figures are made by hand.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import count
from math import inf, log, sqrt
from pathlib import Path
from random import Random
from typing import Any

import pytest

from support.compared_runs import STAGES, on_a_machine, simulated, write_run
from support.run_report import make_report
from trilane.apps.cli.compare import annotation, summary
from trilane.apps.compare.comparison import compare
from trilane.apps.compare.difference import Difference
from trilane.apps.compare.gate import METRICS, GatedPair, LimitOutcome, Weighed, judge, read_gate, runs_needed, whole
from trilane.apps.compare.rows import FRAME_TIME, MS, Figure
from trilane.apps.compare.run_frames import frames_of
from trilane.apps.compare.sides import ComparedRun, RunKind, Side, compared_run
from trilane.errors import BadInputError
from trilane.pipeline.journal import Worked, journal_of
from trilane.scheduler.events import Settings, chain
from trilane.scheduler.stats import student_quantile
from trilane.scheduler.virtual import simulate

Command = Callable[..., tuple[str, str]]
QUIET = 0.004


def run(
    seed: int,
    factors: Mapping[str, float] | None = None,
    *,
    counted: bool = True,
    others: float = 0.0,
    **changes: Any,
) -> ComparedRun:
    simulation, records = on_a_machine(seed, factors=factors, others=others)
    if not counted:
        records = [each._replace(figures={}) if isinstance(each, Worked) else each for each in records]
    facts = {"clock": "host", "other_programs": others or QUIET, "baseline": None, **changes}
    return compared_run(f"run {seed}", RunKind.RUN, make_report(**{**simulation.report, **facts}), frames_of(records))


def outcome(base: ComparedRun, other: ComparedRun, *limits: str) -> LimitOutcome:
    return whole(judge([*map(read_gate, limits)], [pair(base, other)]))


def pair(base: ComparedRun, other: ComparedRun) -> GatedPair:
    found = compare(Side(base.name, (base,)), Side(other.name, (other,)))
    return GatedPair(other.name, found.base, found.other, found.rows, found.changes)


def reason(base: ComparedRun, other: ComparedRun, limit: str) -> str:
    return judge([read_gate(limit)], [pair(base, other)])[0].said


def test_with_instructions_a_gate_tells_3_percent_of_one_stage_from_none() -> None:
    assert outcome(run(1), run(2), "slower=2%") is LimitOutcome.KEPT
    assert outcome(run(1), run(2, {"raster": 1.03}), "slower=2%") is LimitOutcome.BROKEN
    assert outcome(run(1), run(2, {"raster": 1.03}), "slower=5%") is LimitOutcome.KEPT
    assert outcome(run(1), run(2, {"raster": 0.9}), "slower=2%") is LimitOutcome.KEPT


def test_without_instructions_one_run_of_each_kind_cannot_tell_and_says_how_many_would() -> None:
    said = reason(run(1, counted=False), run(2, counted=False), "slower=5%")
    assert said.startswith("slower=5%: cannot tell: ") and "runs of each side would be needed (A1,A2,A3)" in said
    assert outcome(run(1, counted=False), run(2, counted=False), "slower=100%") is LimitOutcome.KEPT


@pytest.mark.parametrize("others", [(0.0, 0.0), (0.1, 0.1), (0.5, 0.5), (0.0, 0.1)])
@pytest.mark.parametrize("stage", ["infer", "present"])
def test_a_stage_that_takes_twice_as_long_breaks_it_whatever_else_runs(stage: str, others: tuple[float, float]) -> None:
    base, other = run(1, counted=False, others=others[0]), run(2, {stage: 2.0}, counted=False, others=others[1])
    assert outcome(base, other, "slower=5%") is LimitOutcome.BROKEN


def test_a_frame_time_that_doubles_without_more_instructions_never_passes() -> None:
    """Each job waits as long as it works: the program is the same by its instructions alone."""
    base, other = run(1), run(2)
    assert other.frames is not None and base.frames is not None
    kept = {key: each for key, each in run(2, dict.fromkeys(STAGES, 2.0)).frames.series.items()}  # type: ignore[union-attr]
    counted = {key: each for key, each in other.frames.series.items() if key.measure == "instructions"}
    waits = replace(other, name="waits", frames=replace(other.frames, series={**kept, **counted}))
    said = reason(base, waits, "slower=5%")
    assert said.startswith("slower=5%: broken: ") and "frame time +" in said


def test_other_programs_share_is_taken_out_of_the_frame_time_in_one_direction() -> None:
    """They had half of the cores of one run. Frames of twice the time may be theirs; of the same time they are not."""
    quiet, loaded = run(1, counted=False), run(2, counted=False, others=0.5)
    said = reason(quiet, loaded, "frame-time=5%")
    assert said.startswith("frame-time=5%: cannot tell: frame time +")
    assert "with other programs' share taken out" in said and "UNSURE: other programs took 50 % of its cores" in said
    weighed = judge([read_gate("frame-time=5%")], [pair(quiet, loaded)])[0].figures[0]
    assert weighed.most - weighed.least == pytest.approx(log(2 / (1 / (1 - QUIET))), abs=1e-6)
    assert weighed.most == pytest.approx(weighed.row.effect)  # nothing of it may be theirs
    back = judge([read_gate("frame-time=5%")], [pair(loaded, run(3, counted=False))])[0].figures[0]
    assert back.least == pytest.approx(back.row.effect) and back.most > back.least + 0.6  # the base was held up


@pytest.mark.parametrize(
    "facts",
    [
        {"other_programs": 0.06},
        {"other_programs": None},
        {"processor": {"throttles": 1}},
        {"temperature_c": {"sensor": 95.0}},
    ],
)
@pytest.mark.parametrize("place", [0, 1])
def test_a_run_that_was_disturbed_never_passes(facts: dict[str, Any], place: int) -> None:
    sides = [run(1), run(2)]
    assert outcome(*sides, "slower=5%") is LimitOutcome.KEPT
    sides[place] = run(place + 1, **facts)
    said = reason(*sides, "slower=5%")
    assert said.startswith(f"slower=5%: cannot tell: run {place + 1} is UNSURE: ") and said.endswith("; repeat it")
    assert outcome(*sides, "instructions=5%") is LimitOutcome.KEPT  # other programs do not change them


def test_a_setting_that_changed_leaves_the_times_to_decide() -> None:
    """Instructions of another number of frames, or of another runtime, do not stand for the whole program."""
    config = {**make_report()["config"], "runtime": "openvino"}
    assert outcome(run(1), run(2, config=config), "slower=5%") is LimitOutcome.UNKNOWN


def checked(psnr: float, worst: float, numbers: tuple[int, ...] = (1, 2)) -> dict[str, Any]:
    return {"check": {"against": "the truth", "frames": 2, "numbers": numbers, "psnr_db": psnr, "worst_psnr_db": worst}}


def test_the_error_of_the_frames_has_a_limit_in_decibels() -> None:
    base, other = run(1, **checked(35.0, 30.0)), run(2, **checked(34.6, 30.5))
    assert outcome(base, other, "psnr=0.5dB") is LimitOutcome.KEPT
    assert outcome(base, other, "psnr=0.3dB") is LimitOutcome.BROKEN
    assert outcome(base, other, "worst-psnr=0.1dB", "psnr=0.5dB") is LimitOutcome.KEPT
    assert outcome(other, base, "psnr=0.1dB") is LimitOutcome.KEPT
    assert outcome(base, run(3), "psnr=0.5dB") is LimitOutcome.UNKNOWN
    assert outcome(base, run(3, **checked(35.0, 30.0, (1, 3))), "psnr=0.5dB") is LimitOutcome.UNKNOWN
    assert "--check" in reason(base, run(3), "psnr=0.5dB")
    sides = [Side(name, tuple(run(seed, **checked(db, 30.0)) for seed, db in enumerate(values, 1)))
             for name, values in (("a", (35.0, 35.1, 35.2)), ("b", (34.0, 34.1, 34.2)))]  # fmt: skip
    found = compare(sides[0], sides[1])
    several = judge([read_gate("psnr=0.5dB")], [GatedPair("b", *sides, found.rows, found.changes)])[0]
    assert several.outcome is LimitOutcome.BROKEN
    row = several.figures[0].row
    assert (row.change, row.deviation, row.freedom) == (pytest.approx(-1), pytest.approx(0.1 * sqrt(2 / 3)), 4)


def test_the_number_of_runs_is_the_least_whose_interval_would_tell() -> None:
    """5 % by 2 %, deviation 6 % between single runs: tried one by one with Student's t."""
    figure = Figure(FRAME_TIME, "", "", "mean", MS)
    row = Difference(10, 10, 0, -0.1, 0.1, 0.9, True, 0.06, 5)
    limit = log(1.05)
    each = Weighed(figure, row, log(1.02), log(1.02), limit, 0.4)

    def tells(runs: float) -> bool:
        return log(1.02) + student_quantile(5 + 2 * (runs - 1)) * 0.06 * sqrt(1 / runs) <= limit

    runs = runs_needed(each, (1, 1), tests=10)
    assert runs is not None and tells(runs) and not tells(runs - 1)
    assert 15 < runs < 30
    assert runs_needed(each._replace(least=limit, most=limit), (1, 1), 10) not in (None, inf)  # then it surely differs
    assert runs_needed(each._replace(least=log(1.0001), most=log(1.0499)), (1, 1), 1) == inf
    assert runs_needed(each._replace(least=-0.5, most=0.2), (1, 1), 1) is None  # a known cause may explain it


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("slower", "expected slower= and a number with %, such as slower=5%"),
        ("slower=5", "slower=5%"),
        ("psnr=5%", "expected psnr= and a number with dB"),
        ("slower=-5%", "slower=5%"),
        ("slower=nan%", "slower=5%"),
        ("slowr=5%", "did you mean 'slower'?"),
        ("", "expected METRIC=LIMIT with one of slower, frame-time"),
    ],
)
def test_a_limit_that_is_none_is_refused(text: str, wrong: str) -> None:
    with pytest.raises(BadInputError) as raised:
        read_gate(text)
    assert wrong in str(raised.value)


def test_limits_are_read() -> None:
    assert read_gate(" slower = 5.5 %") == ("slower", pytest.approx(0.055), "slower=5.5%")
    assert read_gate("psnr=0.5 dB") == ("psnr", 0.5, "psnr=0.5dB")


Made = dict[str, Path]


@pytest.fixture
def made(tmp_path: Path) -> Made:
    """Runs on the host without counters: two of one kind, and one that takes twice as long."""
    facts = {"clock": "host", "other_programs": QUIET}
    slow = dict.fromkeys(STAGES, 2.0)
    return {
        name: write_run(tmp_path / name, simulated(seed, frames=80, factors=factors), **facts)
        for name, seed, factors in (("a", 1, None), ("b", 2, None), ("slow", 3, slow))
    }


def test_the_exit_codes_and_what_is_said(made: Made, command: Command) -> None:
    """One run of each kind: 5 % is less than it can tell; twice as long is surely slower, but not by 1000 %."""
    for other, limit, code in (("b", "5%", 4), ("b", "100%", 0), ("slow", "5%", 1), ("slow", "1000%", 0)):
        for words in (("--fail-if", f"slower={limit}"), ("--fail-if-slower", limit)):
            said = " ".join(command("compare", made["a"], made[other], *words, code=code)[1].split())
            assert ("runs of each side would be needed" in said) == (code == 4)
    twice = ("--fail-if", "slower=5%", "--fail-if", "latency=10%")
    found = json.loads(command("compare", made["a"], made["slow"], *twice, "--json", code=1)[0])
    assert [(each["limit"], each["outcome"]) for each in found["gates"]] == [
        ("slower=5%", "broken"), ("latency=10%", "broken"),
    ]  # fmt: skip
    assert found["outcome"] == "broken" and found["gates"][0]["figures"][0]["measure"] == "frame time"
    assert "gates" not in json.loads(command("compare", made["a"], made["slow"], "--json")[0])
    assert "--fail-if: found slower twice" in command(
        "compare", made["a"], made["b"], "--fail-if", "slower=5%", "--fail-if-slower", "3%", code=2
    )[1]  # fmt: skip
    assert "--github without a limit" in command("compare", made["a"], made["b"], "--github", code=2)[1]


@pytest.mark.parametrize(("other", "code"), [("b", 4), ("slow", 1), ("a2", 0)])
@pytest.mark.parametrize("words", [(), ("--json",), ("--all",)])
def test_a_reader_who_leaves_changes_no_exit_code(
    made: Made, other: str, code: int, words: tuple[str, ...], tmp_path: Path
) -> None:
    """`trilane compare ... | head -1`: the pipe is closed before the first word."""
    limit = "5%" if code else "100%"
    reading, writing = os.pipe()
    os.close(reading)
    arguments = ("compare", made["a"], made.get(other, made["b"]), "--fail-if", f"slower={limit}", *words)
    with os.fdopen(writing, "wb") as stdout:
        ended = subprocess.run(
            [sys.executable, "-m", "trilane", *map(str, arguments)],
            stdout=stdout, stderr=subprocess.PIPE, text=True, check=False, cwd=tmp_path,
        )  # fmt: skip
    assert ended.returncode == code, ended.stderr
    assert "Traceback" not in ended.stderr and "Broken pipe" not in ended.stderr


def test_github_gets_annotations_and_a_summary(
    made: Made, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "summary.md"
    file.write_text("before\n", encoding="utf-8")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(file))
    limits = ("--fail-if", "slower=5%", "--fail-if", "psnr=1dB")
    out, err = command("compare", made["a"], made["slow"], *limits, "--github", "--json", code=1)
    assert json.loads(out)["outcome"] == "broken"
    assert "\n::error title=slower=5%25 broken::" in f"\n{err}"
    assert "\n::warning title=psnr=1dB cannot tell::" in f"\n{err}"
    said = file.read_text(encoding="utf-8")
    assert said.startswith("before\n### Trilane: ") and said.count("\n| ") == 3
    command("compare", made["a"], made["b"], *limits, "--github", code=4)
    assert file.read_text(encoding="utf-8").count("### Trilane") == 2
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(tmp_path))
    assert "GITHUB_STEP_SUMMARY" in command("compare", made["a"], made["b"], *limits, "--github", code=2)[1]


def test_no_name_is_a_command_to_github_or_a_cell_of_its_own() -> None:
    named = judge([read_gate("slower=5%")], [pair(run(1), run(2, {"infer": 2.0}))])[0]
    bad = named._replace(name="a%0A::error::x\n::stop-commands::t|<b>")
    assert annotation(bad).count("\n") == 0 and "a%250A::error" in annotation(bad)
    lines = summary([bad], "x | <y>").splitlines()
    assert lines[:3] == ["### Trilane: broken", "", "x \\| \\<y\\>"]
    assert lines[6].startswith("| a%0A::error::x ::stop-commands::t\\|\\<b\\> | slower=5% | broken | ")


def prediction(ms: float, infer_ms: float) -> dict[str, Any]:
    times = {"mean": ms, "low": 0.9 * ms, "high": 1.1 * ms}
    return {
        "schema": 1, "clock": "virtual", "machine": {"chip": "x"}, "config": {"policy": "pipelined"},
        "expected_error": {}, "network": {}, "frame_time_ms": times, "latency_ms": {"mean": 2 * ms},
        "stages": {"infer": {"unit": "dsp", "service_ms": {"mean": infer_ms}}},
        "units": {"dsp": {"busy": 0.9, "idle": {}}},
    }  # fmt: skip


def times(infer_ms: float, **changes: Any) -> dict[str, Any]:
    samples = [infer_ms * (1 + 0.01 * (-1) ** number) for number in range(20)]
    row = {"name": "infer", "kind": "run", "unit": "dsp", "count": 20, "mean_ms": infer_ms, "samples_ms": samples}
    return {"schema": 1, "measurements": [row | changes]}


def saved(folder: Path, name: str, document: Mapping[str, Any]) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(json.dumps(document), encoding="utf-8")
    return folder / name


def test_predictions_and_imported_times_are_sides(made: Made, tmp_path: Path, command: Command) -> None:
    """A model has no scatter, so 4 % is told; imports vary as runs do, so 5 % cannot be told and a doubling is."""
    one, four = (saved(tmp_path / f"p{ms}", "p.json", prediction(ms, 5.0)) for ms in (10.0, 10.4))
    command("compare", one, four, "--fail-if", "slower=3%", code=1)
    command("compare", one.parent, four.parent, "--fail-if", "slower=5%")
    first, same, slow = (saved(tmp_path, f"t{number}.json", times(ms)) for number, ms in enumerate((5.0, 5.0, 10.0)))
    command("compare", first, same, "--fail-if", "slower=5%", code=4)
    command("compare", first, same, "--fail-if", "slower=20%")
    stated = saved(tmp_path, "stated.json", times(10.0, mean_ms=None, p50_ms=10.0, sd_ms=0.1, samples_ms=[]))
    command("compare", first, stated, "--fail-if", "slower=5%", code=1)
    out, err = command("compare", first, slow, "--fail-if", "slower=5%", code=1)
    assert "infer takes 100 % longer" in out and "imported times" in " ".join(out.split()) and "service of infer" in err
    out, _ = command("compare", first, made["a"], "--fail-if", "slower=5%", code=1)  # infer takes 9 ms there
    assert re.search(r"infer takes [78]\d\.?\d? % longer", out)


@pytest.mark.parametrize(
    ("document", "wrong"),
    [
        (times(5.0, name="other"), "no time that"),
        (times(5.0, mean_ms=-1), "measurements.0.mean_ms"),
        (times(5.0, samples_ms=[1.0, float("nan")]), "measurements.0.samples_ms.1"),
        ({"measurements": []}, "measurements: found no time"),
        (times(5.0, mean_ms=None, samples_ms=[]), "measurements: found no time"),  # in cycles, say
        ({"measurements": [row | {"file": name} for name in "ab" for row in times(5.0)["measurements"]]}, "of 2 files"),
        ({"measurements": [*times(5.0)["measurements"]] * 2}, "'infer (run)' twice"),
        ({"measurements": [7]}, "measurements.0"),
    ],
)
def test_imported_times_that_cannot_be_compared_are_refused(
    document: dict[str, Any], wrong: str, tmp_path: Path, command: Command
) -> None:
    base = saved(tmp_path, "base.json", times(5.0))
    other = saved(tmp_path, "other.json", document)
    assert wrong in " ".join(command("compare", base, other, code=2)[1].split())


def test_a_folder_of_two_predictions_is_no_side(tmp_path: Path, command: Command) -> None:
    for name in ("a.json", "b.json"):
        saved(tmp_path / "both", name, prediction(10.0, 5.0))
    assert (
        "found 2 documents (a.json, b.json)"
        in command("compare", tmp_path / "both", tmp_path / "both/a.json", code=2)[1]
    )


def test_every_metric_is_in_the_help(command: Command) -> None:
    shown = " ".join(command("compare", "--help")[0].split())
    assert all(name in shown for name in METRICS)


LOADS = (0.0, 0.1, 0.5)
CHANGES = (1.0, 1.03, 1.05, 1.1, 2.0)


def pairs(load: float, change: float, number: int, *, counted: bool, runs: int = 1) -> Iterator[tuple[str, GatedPair]]:
    """Pairs of runs under load, the changed stage in turn, and the stage."""
    seeds = count(1 + 10_000 * LOADS.index(load) + 1000 * CHANGES.index(change))
    for place in range(number):
        stage = [*STAGES][place % len(STAGES)]
        made = [
            Side(name, tuple(run(next(seeds), factors, counted=counted, others=load) for _ in range(runs)))
            for name, factors in (("base", {}), ("other", {stage: change}))
        ]
        found = compare(made[0], made[1])
        yield stage, GatedPair("other", *made, found.rows, found.changes)


def tallied(load: float, change: float, number: int, limit: str, *, counted: bool) -> Counter[LimitOutcome]:
    gate = [read_gate(limit)]
    return Counter(whole(judge(gate, [each])) for _, each in pairs(load, change, number, counted=counted))


@pytest.mark.slow
@pytest.mark.parametrize("counted", [True, False])
@pytest.mark.parametrize("load", LOADS)
def test_how_often_the_gate_is_right(load: float, counted: bool) -> None:
    """20 pairs each; docs/decisions/comparing-runs.md has the table."""
    found = {change: tallied(load, change, 20, "slower=2%", counted=counted) for change in CHANGES}
    assert found[1.0][LimitOutcome.BROKEN] <= 1
    assert found[2.0][LimitOutcome.BROKEN] == 20
    assert not any(found[change][LimitOutcome.KEPT] for change in CHANGES[1:])
    if counted:
        assert found[1.05][LimitOutcome.BROKEN] >= 16
    if load > 0.05:
        assert not found[1.0][LimitOutcome.KEPT]


def test_runs_that_lost_nothing_keep_a_limit_of_losses() -> None:
    assert reason(run(1), run(2), "lost=1%") == "lost=1%: kept: no run lost or dropped a frame"
    frames = run(2).figures.frames
    assert frames is not None
    losing = {**frames.as_json(), "presented": frames.presented - 30, "dropped": {"raster->infer": 30}}
    assert outcome(run(1), run(2, frames=losing), "lost=1%") is LimitOutcome.BROKEN


def at_times(seed: int, slow: str = "", others: float = QUIET) -> ComparedRun:
    """A run of 400 frames whose jobs scatter by 5 %. A fifth of the jobs of `slow` takes six times as long."""
    draw = Random(seed)

    def service(stage: str, _unit: str, frame: int, _begin_ns: int) -> int:
        longer = 6.0 if stage == slow and frame % 5 == 0 else 1.0
        return round(longer * STAGES[stage][1] * 1e6 * draw.lognormvariate(0, 0.05))

    graph = chain([(stage, unit) for stage, (unit, _) in STAGES.items()], "double", "composite")
    done = simulate(graph, Settings(400), service, keep=True)
    assert done.recording is not None
    waited = [job._replace(cpu_ns=0) for job in done.jobs]  # nothing says that the long jobs computed
    records = [*journal_of(done.recording, waited, {"clock": "host"}, done.report)]
    facts = {"clock": "host", "other_programs": others, "baseline": None}
    return compared_run(f"run {seed}", RunKind.RUN, make_report(**{**done.report, **facts}), frames_of(records))


def test_beside_other_programs_few_long_jobs_are_neither_passed_nor_called_slower() -> None:
    assert outcome(at_times(1, others=0.5), at_times(2, "present", others=0.5), "slower=12%") is LimitOutcome.UNKNOWN


def of_four(name: str, first_seed: int, slow: str = "") -> Side:
    return Side(name, tuple(at_times(seed, slow) for seed in range(first_seed, first_seed + 4)))


@pytest.mark.parametrize("stage", ["pose", "present"])
def test_few_jobs_that_take_much_longer_are_not_passed_though_the_typical_job_is_as_before(stage: str) -> None:
    """The mean doubles while the middle half does not change, and neither stage bounds the frame time."""
    for other, expected in ((of_four("slow", 9, stage), LimitOutcome.BROKEN), (of_four("same", 20), LimitOutcome.KEPT)):
        found = compare(of_four("base", 0), other)
        pairs = [GatedPair(other.name, found.base, found.other, found.rows, found.changes)]
        judged = judge([read_gate("slower=12%")], pairs)[0]
        assert judged.outcome is expected
        assert (f"service of {stage}" in judged.said) == (expected is LimitOutcome.BROKEN)


def test_a_stage_that_one_side_lacks_is_not_passed() -> None:
    other = run(2)
    stages = {name: row for name, row in other.figures.stages.items() if name != "infer"}
    less = replace(other, figures=other.figures.model_copy(update={"stages": stages}))
    assert reason(run(1), less, "slower=100%") == "slower=100%: cannot tell: not on both sides: infer"
