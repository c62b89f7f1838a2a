"""How a run is placed when everything that takes time is told: what is kept, what is tried, and what is said."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.pipeline.rehearsal import Rehearsed
from trilane.scheduler.placement import Ranked
from trilane.scheduler.placement_model import Rules
from trilane.scheduler.places import Core, Place, Work
from trilane.stages import placing
from trilane.stages.placing import TriedPlacement

ANY: Any = None
CORES = (Core(0, 0), Core(1, 1))
ON = {"cpu": Place((0,), 1), "gpu": Place((1,), 1)}
RULE, A, B = ({**ON, "dsp": dsp} for dsp in (Place((0, 1), 2), Place((0,), 1), Place((1,), 1)))
TIMES = {
    "cpu": {1: Work(2_000_000, 1_500_000, 2)},
    "gpu": {1: Work(3_000_000, 3_000_000, 2)},
    "dsp": {1: Work(8_000_000, 7_000_000), 2: Work(4_000_000, 3_500_000)},
}
TOOK_NS = {"pose": [1_000_000, 1_200_000], "infer": [8_000_000, 8_400_000]}


@dataclass(frozen=True)
class Asked:
    """What `placed` needs of a checked run."""

    config: Any
    asked_cores: Any
    notes: tuple[str, ...] = ("first",)
    placement: Any = None


class Config(SimpleNamespace):
    def model_copy(self, update: dict[str, Any]) -> Config:
        return Config(**{**vars(self), **update})


def asked(frames: int = 100, **cores: tuple[int, ...]) -> Any:
    return Asked(Config(pace_ns={}, scene=SimpleNamespace(frames=frames)), cores)


class Told:
    """In place of what measures and keeps; `asked`: of what."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, answer: TriedPlacement) -> None:
        self.asked: list[Any] = []
        self.answer, self.kept = answer, dict[str, Any]()
        found = [Ranked(A, 9_000_000), Ranked(B, 10_000_000), Ranked(RULE, 15_000_000)]
        monkeypatch.setattr(placing, "usable_cores", lambda: (0, 1))
        monkeypatch.setattr(placing, "host_cores", lambda numbers: tuple(CORES[number] for number in numbers))
        monkeypatch.setattr(placing, "rule_placement", lambda cores, own: RULE if cores == (0, 1) else own)
        monkeypatch.setattr(placing, "measured_times", self.measured)
        monkeypatch.setattr(placing, "cached_arrays", self.cached)
        monkeypatch.setattr(placing, "choice", self.choose)
        monkeypatch.setattr(placing, "ranked", lambda *what: self.asked.append(("ranked", *what)) or found)
        monkeypatch.setattr(placing, "frame_ns", lambda *_: 15_000_000)
        monkeypatch.setattr(placing, "chosen", lambda found, _rule: found[1])
        monkeypatch.setattr(placing, "worth_trying", lambda found, rule: [found[1], rule, found[0]])
        monkeypatch.setattr(placing, "_made_from", lambda _checked, cores, _rule: ["made", str(len(cores))])
        monkeypatch.setattr(placing, "time", SimpleNamespace(time=lambda: 86400.5, **vars(TIME)))

    def measured(self, *what: Any) -> Any:
        self.asked.append(("measured", *what[1:]))
        return Rehearsed(TIMES, TOOK_NS)

    def cached(self, name: str, key: Any, make: Any) -> Any:
        self.asked.append((name, list(key)))
        if name not in self.kept:
            self.kept[name] = make()
        return self.kept[name]

    def choose(self, _checked: Any, cores: Any, candidates: Any, starter: Any, _say: Any, kept: Any) -> TriedPlacement:
        self.asked.append(("choice", cores, [each.placement for each in candidates], starter))
        kept(lambda: {"frame_ns": np.ones(1)})
        return self.answer


TIME = SimpleNamespace(strftime=placing.time.strftime, gmtime=placing.time.gmtime)
KEY = ["made", "2", "a driver"]
NOON = "1970-01-02T00:00:00Z"


def test_what_is_measured_is_kept_and_the_best_of_those_tried_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    told = Told(monkeypatch, TriedPlacement(2, "the fastest of 3 that were tried", (8.0, 9.0, 7.0)))
    said: list[str] = []
    found = placing.placed(asked(), "pipelined", "starter", "a driver", said.append)  # type: ignore[arg-type]
    names = [placing.described(where) for where in (B, RULE, A)]
    assert told.asked == [
        ("placement-3", KEY),
        ("measured", CORES, RULE, "starter"),
        ("ranked", list(CORES), TIMES, Rules("cpu", False), {}),
        ("choice", [0, 1], [B, RULE, A], "starter"),
        ("placement-trial-2", [*KEY, NOON, *names]),
    ]
    assert said == [placing.MEASURING]
    facts: Any = found.placement
    assert (facts["how"], facts["why"], facts["measured_at"]) == ("tried", "the fastest of 3 that were tried", NOON)
    assert facts["units"] == placing.unit_rows(A)
    assert facts["tried"] == [
        {"units": placing.unit_rows(where), "frame_ms": ms} for where, ms in ((B, 8.0), (RULE, 9.0), (A, 7.0))
    ]
    assert [(row["unit"], row["threads"], row["ms"]) for row in facts["times"]] == [
        ("cpu", 1, 2.0),
        ("gpu", 1, 3.0),
        ("dsp", 1, 8.0),
        ("dsp", 2, 4.0),
    ]
    assert {unit: settings.cores for unit, settings in found.config.units.items()} == {
        unit: place.cores for unit, place in A.items()
    }
    rest = "; ".join(f"{name}: {ms}" for name, ms in ((names[0], "8.0"), (names[1], "9.0")))
    why = f"7.0 ms, the fastest of 3 that were tried; by times of {NOON}; {rest}"
    assert found.notes == ("first", f"placement: {names[2]} ({why})")


def test_one_frame_at_a_time_is_predicted_and_cores_that_are_asked_for_are_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing but the least prediction is a candidate; the frame time that is said is the predicted one."""
    told = Told(monkeypatch, TriedPlacement(0, "the least predicted frame time"))
    found = placing.placed(asked(gpu=(1,)), "sequential", ANY, "a driver")
    assert told.asked[2] == ("ranked", list(CORES), TIMES, Rules("cpu", True), {"gpu": Place((1,), 1)})
    assert told.asked[3] == ("choice", [0, 1], [B], None)
    facts: Any = found.placement
    assert (facts["how"], "tried" in facts, facts["predicted_ms"], facts["rule_ms"]) == ("measured", False, 10.0, 15.0)
    assert facts["why"] == "as asked, the others by their times; the least predicted frame time"


@pytest.mark.parametrize(
    ("run", "how", "why"),
    [
        (asked(cpu=(0,), gpu=(0,), dsp=(0, 1)), "asked", "as asked"),
        (asked(99), "rule", "fewer than 100 frames, too short to measure"),
        (replace(asked(), config=Config(pace_ns={"infer": 1})), "rule", "the units are held to the pace of a chip"),
    ],
)
def test_what_is_not_measured_is_placed_by_the_rule(run: Any, how: str, why: str, monkeypatch: Any) -> None:
    told = Told(monkeypatch, TriedPlacement(0, ""))
    found = placing.placed(run, "pipelined", ANY)
    assert told.asked == []
    assert found.placement == {"how": how, "why": why, "units": placing.unit_rows(RULE)}
    assert found.notes[-1] == f"placement: {placing.described(RULE)} ({why})"


def test_one_core_leaves_nothing_to_choose() -> None:
    assert placing._why_not(asked(), CORES[:1]) == "there is one core"
    assert placing._why_not(asked(), CORES) == ""


def test_a_prediction_has_the_times_that_a_run_is_placed_by(monkeypatch: pytest.MonkeyPatch) -> None:
    """Under the run's own key, so whoever comes second measures nothing; each stage has its times frame by frame."""
    told = Told(monkeypatch, TriedPlacement(0, ""))
    placing.placed(asked(), "sequential", ANY, "a driver")
    found, at = placing.rehearsed(asked(), ANY, "a driver")
    assert (found, at) == (Rehearsed(TIMES, TOOK_NS), NOON)
    assert [each for each in told.asked if each[0] == "placement-3"] == [("placement-3", KEY)] * 2
    assert [each[0] for each in told.asked].count("measured") == 1
