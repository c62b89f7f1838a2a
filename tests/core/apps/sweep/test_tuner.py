"""What a search finds in functions whose best is known, and what it keeps, refuses and says."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("optuna")

from trilane.apps.cli.tune import _called, _goals, _space
from trilane.apps.sweep.definition import Definition, Options, SweepKind, Trial
from trilane.apps.sweep.engines import run_inside
from trilane.apps.sweep.store import Store, TrialRecord, planned, run_sweep, whole_lines
from trilane.apps.sweep.tuner import Aim, Answer, Do, Keep, Search, Space, answer, figures_of, keep_of, tune
from trilane.errors import BadInputError, MissingPartError

#: 6 x 5 x 2 x 5 = 300 configurations.
AXES: dict[str, list[Any]] = {
    "x": list(range(6)),
    "y": ["10", "20", "30", "40", "50"],
    "flag": ["on", "off"],
    "word": ["d", "b", "a", "e", "c"],
}
SEEDS = range(10)


def typed(options: Options) -> list[str]:
    return [f"--{name}={value}" for name, value in options.items()]


def space(axes: Mapping[str, Sequence[Any]] = AXES, command: str = "predict") -> Space:
    return Space(Definition((command,), {"fixed": 1}, axes), typed)


def bowl(options: Options) -> dict[str, Any]:
    """Frame time 7 at x = 4, y = 20, off, a, and more elsewhere. Power falls with x: 6, 5, 4, 3, 2, 1 W."""
    words = "abcde".index(str(options["word"]))
    x, y = int(str(options["x"])), float(str(options["y"]))
    frame = 7 + (x - 4) ** 2 + (y - 20) ** 2 / 100 + 3 * (options["flag"] == "on") + 2 * words
    return {"frame_time_ms": {"mean": frame}, "power_w": 6.0 - x, "fps": 1e3 / frame}


def done(trial: Trial, result: Mapping[str, Any] | None) -> TrialRecord:
    status = "failed" if result is None else "done"
    told = {"exit_code": 0 if result else 2, "error": None if result else "error: no", "seconds": 0.1}
    return planned(trial).model_copy(update={"status": status, "result": result, **told})


def doing(function: Any) -> tuple[Do, list[Trial]]:
    """A `Do` of a function of the options, and the trials that it did."""
    asked: list[Trial] = []

    def do(trials: Sequence[Trial]) -> dict[str, TrialRecord]:
        asked.extend(trials)
        return {trial.id: done(trial, function(trial.options)) for trial in trials}

    return do, asked


def found(aim: Aim, seed: int, function: Any = bowl, budget: int = 60) -> Answer:
    search = Search(space(), aim, seed)
    return answer(search, tune(search, doing(function)[0], budget))


@pytest.mark.parametrize(
    ("keeps", "best"),
    [
        ((), 7.0),
        (("power>=4",), 11.0),  # x <= 2: 7 + 4
        (("power>4W",), 16.0),  # x <= 1: 7 + 9
        (("frame>7.5", "power<1.5"), 8.0),  # x = 5: 7 + 1
    ],
)
def test_the_best_of_300_is_found_in_60_trials(keeps: tuple[str, ...], best: float) -> None:
    answers = [found(Aim(("frame",), tuple(map(keep_of, keeps))), seed) for seed in SEEDS]
    near = [each.best is not None and each.best.metrics["frame"] <= 1.02 * best for each in answers]
    assert sum(near) >= 9
    assert all(len(each.trials) == len({row.record.id for row in each.trials}) == 60 for each in answers)
    assert min(each.best.metrics["frame"] for each in answers if each.best) == best


@pytest.fixture(scope="module", params=["snapdragon-888", "snapdragon-8-gen-3"])
def swept(request: pytest.FixtureRequest) -> tuple[Space, dict[str, TrialRecord]]:
    """The example of the page: all 300 predictions of a chip."""
    example = Path(__file__).parents[4] / "docs/examples/chip-tune.toml"
    _, _, whole = _space([str(example)], [], request.param)
    records = {}
    for trial in whole.trials:
        code, out, messages = _called([*trial.command, *trial.words, "--json"])
        assert code == 0, messages
        records[trial.id] = done(trial, json.loads(out))
    return whole, records


@pytest.mark.slow
@pytest.mark.parametrize(("goal", "keeps"), [("latency", ("power<2.5W", "fps>=30")), ("energy", ("fps>=30",))])
def test_a_search_comes_within_2_percent_of_a_sweep_of_a_chip(
    goal: str, keeps: tuple[str, ...], swept: tuple[Space, dict[str, TrialRecord]]
) -> None:
    """Of 300 predicted configurations 60 are tried: in 9 of 10 seeds the best of the sweep is met."""
    whole, records = swept
    assert len(records) == 300
    aim = Aim((goal,), tuple(map(keep_of, keeps)))
    figures = [figures_of(record, aim.names) for record in records.values()]
    best = min(aim.costs(each, aim.goals)[0] for each in figures if aim.has_all(each) and aim.keeps_all(each))
    near = []
    for seed in SEEDS:
        search = Search(whole, aim, seed)
        tried = tune(search, lambda trials: {trial.id: records[trial.id] for trial in trials}, 60)
        assert len(tried) == 60
        told = answer(search, tried).best
        near.append(told is not None and aim.costs(told.metrics, aim.goals)[0] <= best + 0.02 * abs(best))
    assert sum(near) >= 9


def test_a_search_is_better_than_drawing_by_chance() -> None:
    """By chance 60 of 300 have the best with a probability of 0.2, so in 10 draws 2 on average."""
    bests = [found(Aim(("frame",)), seed).best for seed in SEEDS]
    assert sum(best is not None and best.metrics["frame"] == 7 for best in bests) >= 8


def test_the_same_seed_tries_the_same_and_another_one_others() -> None:
    orders = [[row.record.id for row in found(Aim(("fps",)), seed, budget=25).trials] for seed in (3, 3, 4)]
    assert orders[0] == orders[1] != orders[2]


def test_a_limit_that_nothing_keeps_gives_the_nearest() -> None:
    told = found(Aim(("frame",), (keep_of("power<0.5"),)), 0)
    assert told.best is None and told.nearest is not None
    assert told.nearest.metrics["power"] == 1.0
    assert told.nearest.misses == ("power<0.5",)
    assert not any(row.keeps for row in told.frontier)


def test_the_frontier_by_hand_and_what_was_not_tried() -> None:
    small = space({"x": [0, 1, 2, 3], "never": ["a", "b"]})
    frames = {0: (10.0, 1.0), 1: (8.0, 2.0), 2: (9.0, 3.0), 3: (8.0, 2.0)}  # 2 is beaten by 1; 1 and 3 are equal

    def function(options: Options) -> dict[str, Any]:
        frame, power = frames[int(str(options["x"]))]
        return {"frame_time_ms": {"mean": frame}, "power_w": power}

    search = Search(small, Aim(("frame",)), 0)
    records = {
        trial.id: done(trial, function(trial.options)) for trial in small.trials if trial.options["never"] == "a"
    }
    told = answer(search, records).as_json()
    assert [row["options"]["x"] for row in told["frontier"]] == [1, 3, 0]
    assert told["best"]["options"] == {"fixed": 1, "x": 1, "never": "a"}
    assert told["best"]["command"] == ["trilane", "predict", "--fixed=1", "--x=1", "--never=a"]
    assert told["weighed"] == ["frame", "power"]
    assert told["not_tried"] == {"count": 4, "of": 8, "values": {"never": ["b"]}}


def test_two_goals_have_a_frontier_of_both() -> None:
    told = found(Aim(("frame", "power")), 1)
    pairs = [(row.metrics["frame"], row.metrics["power"]) for row in told.frontier]
    assert pairs == sorted(pairs) and [power for _, power in pairs] == sorted((p for _, p in pairs), reverse=True)
    assert pairs[-1][1] == 1.0


def test_failed_trials_are_kept_and_the_search_goes_on(tmp_path: Path) -> None:
    """Every trial with the word a fails, so the best has b: 7 + 2. A second search does nothing again."""
    whole, calls = space(), []

    def call(words: list[str]) -> tuple[int, str, str]:
        calls.append(words)
        options = dict(word.lstrip("-").split("=") for word in words[1:-1])
        return (2, "", "error: no a\n") if options["word"] == "a" else (0, json.dumps(bowl(options)), "")

    def search() -> Answer:
        found = Search(whole, Aim(("frame",)), 5)

        def do(trials: Sequence[Trial]) -> Mapping[str, TrialRecord]:
            run_sweep(trials, store, lambda left: run_inside(left, call), lambda _record: None)
            return {trial.id: store.done[trial.id] for trial in trials}

        with Store(tmp_path / "s", whole.trials, {}, resume=bool(calls)) as store:
            tune(found, do, 40)
            return answer(found, store.done)

    begun = time.monotonic()
    told = search()
    most_s = time.monotonic() - begun
    failed = [row for row in told.as_json()["trials"] if row["status"] == "failed"]
    assert failed and all((row["exit_code"], row["error"], row["keeps"]) == (2, "error: no a", None) for row in failed)
    assert told.best is not None and told.best.record.options["word"] != "a"
    assert told.best.metrics["frame"] == min(row.metrics["frame"] for row in told.trials if row.metrics)
    records, _ = whole_lines((tmp_path / "s" / "trials.jsonl").read_bytes(), "")
    assert len(records) == len(calls) == 40
    assert sum(record.seconds or 0.0 for record in records) <= most_s + 40 * 0.0005  # each is rounded to a millisecond
    assert sum(record.status == "failed" for record in records) == len(failed)
    assert search() == told
    assert len(calls) == 40


def test_a_grid_that_is_smaller_than_the_budget_is_tried_whole() -> None:
    small = space({"x": [0, 1], "y": ["10"], "flag": ["on", "off"], "word": ["a"]})
    search = Search(small, Aim(("fps",)), 0)
    do, asked = doing(bowl)
    tune(search, do, 60, together=3)
    assert sorted(trial.id for trial in asked) == sorted(trial.id for trial in small.trials)


def test_a_short_run_ends_a_trial_below_the_median() -> None:
    def function(options: Options) -> dict[str, Any]:
        return bowl(options) | {"frames": options.get("frames")}

    search = Search(space(command="run"), Aim(("frame",)), 0)
    do, asked = doing(function)
    told = answer(search, tune(search, do, 40, short=5))
    short = [trial for trial in asked if trial.options.get("frames") == 5]
    whole = [trial for trial in asked if "frames" not in trial.options]
    assert (len(short), len(told.trials)) == (40, 40)
    assert not {trial.id for trial in short} & {trial.id for trial in search.space.trials}
    pruned = [row.record for row in told.trials if row.record.status == "pruned"]
    assert len(pruned) == 40 - len(whole) >= 5
    kept = [bowl(trial.options)["frame_time_ms"]["mean"] for trial in whole]
    dropped = [bowl(row.options)["frame_time_ms"]["mean"] for row in pruned]
    assert sum(kept) / len(kept) < sum(dropped) / len(dropped)
    assert told.best is not None and told.best.metrics["frame"] == min(kept)


def test_a_figure_that_no_result_has_ends_the_search_early() -> None:
    do, asked = doing(bowl)
    with pytest.raises(BadInputError, match=r"psnr, which no predict has.*fps, frame, power.*--check 4"):
        tune(Search(space(), Aim(("fps",), (keep_of("psnr>=33"),)), 0), do, 60)
    assert len(asked) == 3


@pytest.mark.parametrize(
    ("text", "keep"),
    [
        ("psnr>=33", Keep("psnr", ">=", 33.0)),
        (" power < 3 w ", Keep("power", "<", 3.0)),
        ("latency<=1.5e1ms", Keep("latency", "<=", 15.0)),
        ("units.dsp.busy>0.5", Keep("units.dsp.busy", ">", 0.5)),
    ],
)
def test_limits_as_they_are_typed(text: str, keep: Keep) -> None:
    assert keep_of(text) == keep


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("psnr", "a figure, a sign and a number"),
        ("psnr=33", "a figure, a sign and a number"),
        ("psnr>=3.3.3", "a figure, a sign and a number"),
        ("latency<1e999", "a figure, a sign and a number"),
        ("powr<3", "did you mean 'power'"),
        ("power<3ms", "W, the unit of power"),
        ("units.dsp.busy<90s", "no unit"),
    ],
)
def test_limits_that_are_none(text: str, message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        keep_of(text)


def test_a_limit_at_its_edge() -> None:
    assert keep_of("power<3").miss(3.0) > 0 >= keep_of("power<=3").miss(3.0)
    assert keep_of("fps>30").miss(30.0) > 0 >= keep_of("fps>=30").miss(30.0)
    assert keep_of("power<3").miss(4.5) == pytest.approx(0.5)
    assert keep_of("fps>=30").miss(15.0) == pytest.approx(0.5)


def test_figures_are_finite_numbers_of_a_trial_that_is_done() -> None:
    trial = space().trials[0]
    result = {
        "fps": math.nan,
        "power_w": True,
        "latency_ms": {"mean": 3},
        "check": {"psnr_db": 40.5},
        "units": {"a": 1},
    }
    assert figures_of(done(trial, result), ["units.a", "units"]) == {"latency": 3.0, "psnr": 40.5, "units.a": 1.0}
    assert figures_of(done(trial, result).model_copy(update={"status": "failed"})) == {}
    assert figures_of(done(trial, {"pipelines": [{"fps": 30.0}, {"fps": 10.0}]})) == {"fps": 30.0}
    assert figures_of(done(trial, {"pipelines": [5], "fps": 10**400})) == {}


def test_a_latency_of_0_is_no_figure() -> None:
    """A prediction under `deadline` in which no frame is in time has the latency 0, which would win each search."""
    result = {"latency_ms": {"mean": 0}, "fps": 14.9}
    assert figures_of(done(space().trials[0], result)) == {"fps": 14.9}


def test_numbers_that_rise_are_ordered_and_places_find_trials() -> None:
    several = space({"a": ["64", "128"], "b": [2, 1], "c": ["x", "y"], "d": [True, False], "e": [1]})
    assert several.ordered == {"a"}
    assert all(several.at(several.places(number)) is trial for number, trial in enumerate(several.trials))
    near, far = dict.fromkeys(AXES, 0), {"x": 3, "y": 1, "flag": 1, "word": 4}
    assert space().steps(near, far) == 3 + 1 + 1 + 1  # x and y are ordered; words are not


@pytest.mark.parametrize("kind", [{"kind": SweepKind.RANDOM, "count": 3}, {"kind": SweepKind.LIST}, {"repeats": 2}])
def test_what_is_no_grid(kind: dict[str, Any]) -> None:
    with pytest.raises(BadInputError, match="a grid without repeats"):
        Space(Definition(("run",), {}, {"x": [1, 2], "y": [1, 2]}, **kind), typed)


def test_without_a_choice_there_is_nothing_to_tune() -> None:
    with pytest.raises(BadInputError, match="two or more"):
        space({"x": [1]})


def test_without_optuna_the_install_line_comes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(MissingPartError, match="tune"):
        Search(space(), Aim(), 0)
    assert MissingPartError.exit_code == 3


def test_words_of_the_command_line() -> None:
    assert _goals(["latency,power", "run"]) == (("latency", "power"), ["run"])
    assert _goals(["a.toml", "--x"]) == (("fps",), ["a.toml", "--x"])
    with pytest.raises(BadInputError, match="did you mean 'latency'"):
        _goals(["latncy"])
    name, definition, several = _space(["predict", "--edge", "double"], ["size=128,256"], "sa8295p")
    assert (name, definition.options["profile"], definition.options["edge"]) == ("predict", "sa8295p", "double")
    assert [trial.options["size"] for trial in several.trials] == ["128", "256"]


@pytest.mark.parametrize(
    ("words", "axes", "chip", "message"),
    [
        (["run"], ["size=128,256"], "sa8295p", "predict without it"),
        (["predict", "--profile", "a", "--profile", "b"], [], "sa8295p", "an axis profile"),
        ([], ["size"], None, "an option and its values"),
        ([], ["size=128", "size=256"], None, "each axis once"),
        ([], ["sice=128,256"], None, "did you mean 'size'"),
        (["predict", "--size", "128"], ["size=128,256"], None, "a fixed option too"),
    ],
)
def test_words_that_do_not_fit(words: list[str], axes: list[str], chip: str | None, message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        _space(words, axes, chip)


def test_a_command_in_this_process_ends_as_in_its_own() -> None:
    code, out, messages = _called(["predict", "--size", "128", "--json"])
    assert (code, messages) == (0, "")
    assert json.loads(out)["config"]["size"] == "128x128"
    code, out, messages = _called(["predict", "--size", "127", "--json"])
    assert (code, out) == (2, "")
    assert messages.splitlines()[-1].startswith("error: ") and "127" in messages


def test_an_interrupted_prediction_ends_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("trilane.apps.cli.predict.application_of", interrupted)
    with pytest.raises(KeyboardInterrupt):
        _called(["predict", "--size", "128", "--json"])


def test_an_unknown_chip_is_refused_before_a_trial() -> None:
    with pytest.raises(BadInputError, match="nosuchchip"):
        _space([], ["size=128,192"], "nosuchchip")
