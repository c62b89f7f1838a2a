"""`bench placement` and `bench planner`: what they say of runs whose times are told, worked out by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.bench import placement, planner
from trilane.bench.lib.cast import Box
from trilane.errors import BadInputError
from trilane.pipeline.rehearsal import Rehearsed, Round
from trilane.scheduler.placement import CpuCore, Place, Ranked, UnitWork
from trilane.stages.placing import TriedPlacement

HERE = {"cpu": Place((0,), 1), "gpu": Place((1,), 1)}
A, B, C, RULE = ({**HERE, "dsp": dsp} for dsp in (Place((0,), 1), Place((1,), 1), Place((0, 1), 1), Place((0, 1), 2)))
NAMES = {"A": "dsp 0", "B": "dsp 1", "C": "dsp 0,1 (1 thread)", "RULE": "dsp 0,1 (2 threads)"}


def name_of(where: Any) -> str:
    return {str(each["dsp"]): name for each, name in zip((A, B, C, RULE), NAMES, strict=True)}[str(where["dsp"])]


#: Of each placement the times in the round in which all are tried, then in the further ones, in ms.
TOLD = {"A": [10.0, 10.0, 14.0], "B": [13.0, 8.0, 20.0], "C": [12.0, 12.0, 12.0], "RULE": [20.0, 30.0, 21.0]}
#: Of each whole run: frame time in ms, core efficiency, efficiency.
RUNS = {"A": [(11.0, None, 0.4), (13.0, 0.1, 0.6)], "RULE": [(25.0, 0.2, 0.5), (27.0, 0.4, 0.5)]}


@pytest.fixture
def trial(monkeypatch: pytest.MonkeyPatch) -> Any:
    """What was tried and run, by name, in `asked`."""
    asked: list[Any] = []
    others = iter([0.9, 0.1, 0.3])

    def tried(_checked: Any, placements: Any, rounds: int, _starter: Any) -> list[Round]:
        names = [name_of(where) for where in placements]
        first = 0 if not asked else 1
        asked.append((names, rounds))
        return [
            Round(tuple(1e6 * TOLD[name][first + number] for name in names), next(others)) for number in range(rounds)
        ]

    def run(_self: Any, where: Any) -> Any:
        asked.append(name_of(where))
        frame_ms, machine_efficiency, efficiency = RUNS[name_of(where)][asked.count(name_of(where)) - 1]
        mean = SimpleNamespace(mean=frame_ms)
        return SimpleNamespace(frame_time_ms=mean, machine_efficiency=machine_efficiency, efficiency=efficiency)

    found = [Ranked(each, ms * 1_000_000) for each, ms in ((A, 9), (B, 10), (C, 11))]
    monkeypatch.setattr(placement, "rule_placement", lambda cores: RULE if cores == (0, 1) else {})
    monkeypatch.setattr(
        placement, "measured_times", lambda *_: Rehearsed({"cpu": {1: UnitWork(2_000_000, 1_500_000)}}, {})
    )
    monkeypatch.setattr(placement, "ranked", lambda *_: list(found))
    monkeypatch.setattr(placement, "frame_ns", lambda *_: 15_000_000)
    monkeypatch.setattr(placement, "worth_trying", lambda ranking, rule: [ranking[1], ranking[0], rule])
    monkeypatch.setattr(placement, "choice", lambda _checked, cores, *_: TriedPlacement(1, f"told of {cores}"))
    monkeypatch.setattr(placement, "tried", tried)
    monkeypatch.setattr(placement, "time", SimpleNamespace(monotonic=iter([5.0, 7.5]).__next__))
    monkeypatch.setattr(placement._Trial, "_run", run)
    made = placement._Trial(None, [CpuCore(0, 0), CpuCore(1, 1)], None)  # type: ignore[arg-type]
    return SimpleNamespace(made=made, asked=asked)


def test_the_chosen_placement_is_set_against_the_best_other_and_the_rules(trial: Any) -> None:
    """Tried: A 10, B 13, C 12, the rule's 20. A and the rule's are always in, and one more, the fastest of the others:
    C, 12 and 12 in two rounds; A 10 and 14, so 10/12 and 14/12 of the best other; the rule's 30 and 21: 3 and 1.5.
    Predicted 9, 10, 11 and 15: ranks 1 2 3 4 beside 1 3 2 4."""
    trial.made.run(1, 1, 2, 2)
    assert trial.asked == [(["A", "B", "C", "RULE"], 1), (["A", "RULE", "C"], 2), "A", "RULE", "A", "RULE"]
    keys = ("predicted_ms", "tried_ms", "frame_ms", "is_chosen", "is_rule")
    assert [tuple(row[key] for key in keys) for row in trial.made.rows()] == [
        (9.0, 10.0, 12.0, True, False),
        (10.0, 13.0, None, False, False),
        (11.0, 12.0, 12.0, False, False),
        (15.0, 20.0, 25.5, False, True),
    ]
    assert [row["placement"] for row in trial.made.rows()] == [f"cpu 0, gpu 1, {dsp}" for dsp in NAMES.values()]
    assert trial.made.summary() == {
        "chosen": "cpu 0, gpu 1, dsp 0",
        "how": "told of [0, 1]",
        "best": "cpu 0, gpu 1, dsp 0",  # as fast as C, and chosen
        "rule": "cpu 0, gpu 1, dsp 0,1 (2 threads)",
        "chosen_over_best": pytest.approx(1.0),
        "low": pytest.approx(10 / 12),
        "high": pytest.approx(14 / 12),
        "rule_over_chosen": pytest.approx(2.25),
        "rule_low": 1.5,
        "rule_high": 3.0,
        "rank_correlation": pytest.approx(1 - 6 * 2 / (4 * 15)),
        "predicted_over_tried": pytest.approx((10 / 13 + 9 / 10) / 2),
        "predicted_least": 15 / 20,
        "predicted_largest": pytest.approx(11 / 12),
        "others": pytest.approx(0.2),
        "run_ms": 12.0,
        "rule_run_ms": 26.0,
        "machine_efficiency": pytest.approx(0.05),  # nothing, and 0.1
        "efficiency": pytest.approx(0.5),
        "rule_machine_efficiency": pytest.approx(0.3),
        "took_s": 2.5,
    }
    assert trial.made.times() == [{"unit": "cpu", "threads": 1, "ms": 2.0, "core_ms": 1.5}]


def test_the_best_of_the_further_rounds_may_be_another(trial: Any) -> None:
    """With two finalists B is in: 8 and 20, a median of 14, so C is the best of all and the rival."""
    trial.made.run(1, 2, 2, 1)
    assert trial.asked[1] == (["A", "RULE", "C", "B"], 2)
    trial.made._further[0][0] = 16.0
    found = trial.made.summary()
    assert (found["best"], found["chosen_over_best"]) == ("cpu 0, gpu 1, dsp 0,1 (1 thread)", pytest.approx(15 / 12))


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"cores": (3,)}, r"--cores: found \[3\], expected numbers from 1 to the 2 that this process may use"),
        ({"cores": (1, -1)}, r"--cores: found \[1, -1\], "),
        ({"frames": 19}, "bench placement: found --frames 19, --rounds 6, --finalists 3, --further 24, --runs 4"),
        ({"rounds": 0}, "bench placement: found --frames 96, --rounds 0, "),
        ({"finalists": 0}, "bench placement: found --frames 96, --rounds 6, --finalists 0"),
        ({"further": 0}, "bench placement: found --frames 96, --rounds 6, --finalists 3, --further 0"),
        ({"runs": 0}, "bench placement: found .* --runs 0, expected at least 20, and 1 of each other"),
    ],
)
def test_what_cannot_be_placed_is_refused(asked: dict[str, Any], words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(placement, "usable_cores", lambda: (0, 1))
    with pytest.raises(BadInputError, match=f"^{words}"):
        placement.measure(**asked)


class Told:
    """Frames of one grey each, in tensors that are told."""

    def __init__(self, values: list[int], tensors: str = "aaaaaa") -> None:
        self.values, self.tensors, self.tensor = values, tensors, ""

    def frame(self, number: int) -> Any:
        self.tensor = self.tensors[number]
        return np.full((4, 6, 3), self.values[number], np.uint8)

    def background(self, number: int) -> Any:
        return np.full((4, 6, 3), number, np.uint8)


class Truth:
    """Grey 100 in each frame, whose number its background tells; nobody is seen in frame 2."""

    def frame(self, number: int, background: Any) -> Any:
        assert background[0, 0, 0] == number != 2
        return np.full((4, 6, 3), 100, np.uint8)

    def boxes(self, number: int) -> list[Box]:
        return [] if number == 2 else [Box(1, 1, 3, 4)]


def test_every_frame_is_compared_and_the_worst_ones_are_named() -> None:
    """A step of 51, a fifth, has 13.98 dB, one of 25.5 would have 6 more. The tensor changes in frames 1 and 5; that of
    frame 3 is another than that of frame 1, but nobody was seen between.
    """
    chains = {"fixed": Told([100, 100, 0, 151, 100, 100]), "planned": Told([100, 151, 0, 100, 100, 202], "abcaac")}
    truth: Any = Truth()
    found = planner.by_frame(range(6), chains, Told([0] * 6), truth.frame, truth)  # type: ignore[arg-type]
    fifth, two = -20 * np.log10(0.2), -20 * np.log10(0.4)
    assert found is not None
    assert {plan: row["worst_frame"] for plan, row in found.items()} == {"fixed": 3, "planned": 5}
    assert found["fixed"]["psnr_db"] == pytest.approx((4 * 100 + fifth) / 5)
    assert found["fixed"]["worst_psnr_db"] == pytest.approx(fifth) and "changes" not in found["fixed"]
    assert found["planned"]["psnr_db"] == pytest.approx((3 * 100 + fifth + two) / 5)
    assert found["planned"]["worst_psnr_db"] == found["planned"]["worst_change_db"] == pytest.approx(two)
    assert found["planned"]["changes"] == 2
    assert planner.by_frame([2], chains, Told([0] * 6), truth.frame, truth) is None  # type: ignore[arg-type]


def test_ranks_that_agree_and_ranks_that_do_not() -> None:
    """By hand: 1 - 6 sum(d^2) / (n (n^2 - 1)) without equal values."""
    assert placement.rank_correlation([1, 5, 9, 700], [2, 3, 4, 5]) == pytest.approx(1)
    assert placement.rank_correlation([1, 2, 3], [9, 8, 7]) == pytest.approx(-1)
    assert placement.rank_correlation([1, 2, 3, 4, 5], [2, 1, 4, 3, 5]) == pytest.approx(1 - 6 * 4 / (5 * 24))
    # ranks 1, 2.5, 2.5, 4 and 1, 2, 3, 4: covariance 2.25 + 0 + 0 + 2.25 = 4.5, spreads 4.5 and 5
    assert placement.rank_correlation([1, 2, 2, 3], [1, 2, 3, 4]) == pytest.approx(4.5 / (4.5 * 5) ** 0.5)
    assert placement.rank_correlation([1, 1], [1, 2]) is None
    with pytest.raises(ValueError, match="argument 2"):
        placement.rank_correlation([1, 2], [1])
