"""How a run is placed: what is kept, tried and said, and when real frames are asked; what takes time is a double."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest

from trilane.bench.placement import rank_correlation
from trilane.machine import Machine
from trilane.pipeline import surroundings
from trilane.pipeline.rehearsal import Rehearsed
from trilane.pipeline.surroundings import OtherPrograms, busy_s
from trilane.pipeline.trial import Round
from trilane.scheduler.placement import Ranked, Rules
from trilane.scheduler.places import Core, Place, Work
from trilane.stages import placing
from trilane.stages.placing import TriedPlacement, choice

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


STEP_S = 1 / os.sysconf("SC_CLK_TCK")
PLACES = [{"cpu": Place((0,), 1), "dsp": Place(cores, 1)} for cores in ((1,), (0,), (0, 1))]
CANDIDATES = [Ranked(place, 1000 + n) for n, place in enumerate(PLACES)]


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """Other programs have `shares` of the cores, one look after the other; the rounds are `frame_ns`. What was said."""

    def made(shares: list[float], *frame_ns: tuple[float, ...]) -> list[str]:
        left, said = list(shares), list[str]()
        monkeypatch.setattr(placing, "OtherPrograms", lambda _: SimpleNamespace(share=lambda: left.pop(0)))
        monkeypatch.setattr(placing.time, "sleep", lambda seconds: said.append(f"looks for {seconds} s"))

        def tried(
            _checked: Any, placements: Any, rounds: int, _starter: Any, limit_s: float, least: int
        ) -> list[Round]:
            assert (placements, rounds, limit_s, least) == (PLACES, 6, 5.0, 3)
            return [Round(each, left.pop(0)) for each in frame_ns]

        monkeypatch.setattr(placing, "tried", tried)
        return said

    return made


def test_frames_decide_on_a_quiet_machine(machine: Callable[..., list[str]]) -> None:
    said = machine([0.02, 0.05, 0.3, 0.0], (9e6, 6e6, 8e6), (30e6, 20e6, 10e6), (9e6, 7e6, 8e6))
    found = choice(ANY, (0, 1), CANDIDATES, ANY, said.append)
    assert found == TriedPlacement(1, "the fastest of 3 that were tried", (9.0, 7.0, 8.0))
    assert said[0] == "looks for 0.25 s"
    assert said[1:] == ["trying 3 placements with frames of the scene (once for this avatar, scene and machine) ..."]


def test_what_is_shown_is_what_decides(machine: Callable[..., list[str]]) -> None:
    """The second is a tenth faster in two rounds of three; the medians of its times alone, 12 and 14, say otherwise.

    Medians of the rounds: 10, 30, 14. Times over them: 1, 1, 6/7; 0.9, 0.9, 1; 2, 2, 2.
    """
    machine([0.0] * 5, (10e6, 9e6, 20e6), (30e6, 27e6, 60e6), (12e6, 14e6, 28e6))
    found = choice(ANY, (0, 1), CANDIDATES, ANY)
    assert found.best == 1
    assert found.frame_ms == pytest.approx((14.0, 12.6, 28.0))


@pytest.mark.parametrize(
    ("shares", "why"),
    [
        ([0.45], "not tried while other programs have 45% of the cores"),
        ([0.0, 0.2, 0.0, 0.3], "not tried while other programs have 20% of the cores"),
    ],
)
def test_on_a_busy_machine_the_prediction_decides_and_nothing_is_kept(
    machine: Callable[..., list[str]], shares: list[float], why: str
) -> None:
    said = machine(shares, (9e6, 6e6, 8e6), (9e6, 6e6, 8e6), (9e6, 6e6, 8e6))
    stored: list[Any] = []

    def kept(make: Callable[[], Any]) -> Any:
        stored.append(make())
        return stored[-1]

    assert choice(ANY, (0, 1), CANDIDATES, ANY, said.append, kept) == TriedPlacement(
        0, f"the least predicted frame time; {why}"
    )
    assert (stored, len(said)) == ([], 2 if len(shares) > 1 else 1)


def test_what_was_found_before_is_taken_as_it_is(machine: Callable[..., list[str]]) -> None:
    machine([])
    found = choice(ANY, (0, 1), CANDIDATES, ANY, kept=lambda _: {"frame_ns": np.array([[3e6, 2e6, 1e6]])})
    assert (found.best, found.frame_ms) == (2, (3.0, 2.0, 1.0))
    assert choice(ANY, (0, 1), CANDIDATES[:1], ANY) == TriedPlacement(0, "the least predicted frame time")


def stat(*cores: tuple[int, ...]) -> str:
    rows = [f"cpu{number} {' '.join(map(str, fields))}" for number, fields in enumerate(cores)]
    return "\n".join(["cpu 9 9 9 9 9 9 9 9 9 9", *rows, "intr 5 cpu0", ""])


def test_what_cores_did_since_the_system_began() -> None:
    """user, nice, system, irq, softirq and steal; not idle, iowait, and what guests had of user and nice."""
    text = stat((1, 2, 4, 1000, 1000, 8, 16, 32, 1, 1), (100, 0, 0, 0, 0, 0, 0, 0, 0, 0))
    assert busy_s(text, [0]) == pytest.approx(63 * STEP_S)
    assert busy_s(text, [1, 0]) == pytest.approx(163 * STEP_S)
    assert busy_s(stat(*[(0,) * 10] * 10, (7, *(0,) * 9)), [1]) == 0  # cpu10 is not cpu1


def test_the_share_of_others_is_what_is_not_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In 2 s two cores were busy for 1.5 s, of which this process had 0.3 s and a unit 0.2 s: 1 s of 4 are others'."""
    file, now = tmp_path / "proc/stat", [10.0]
    file.parent.mkdir()
    monkeypatch.setattr("trilane.machine.here", Machine(tmp_path))
    used = {os.getpid(): 1.0, 77: 5.0}

    class Process:
        def __init__(self, pid: int) -> None:
            self._pid = pid

        def cpu_times(self) -> SimpleNamespace:
            return SimpleNamespace(user=used[self._pid] - 0.1, system=0.1)

    monkeypatch.setattr(surroundings, "psutil", SimpleNamespace(Process=Process))
    monkeypatch.setattr(surroundings, "time", SimpleNamespace(monotonic=lambda: now[0]))
    idle = (0,) * 9
    file.write_text(stat((round(8 / STEP_S), *idle), (0, *idle)))
    others = OtherPrograms((0, 1), [77])
    file.write_text(stat((round(9 / STEP_S), *idle), (round(0.5 / STEP_S), *idle)))
    used.update({os.getpid(): 1.3, 77: 5.2})
    now[0] = 12.0
    assert others.share() == pytest.approx(0.25)
    used[77] = 9.0
    assert others.share() == 0
    used[77] = -9.0
    assert others.share() == 1


def test_beside_units_that_live_others_have_a_share_and_beside_a_dead_one_nobody_knows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []

    class Others:
        def __init__(self, cores: Any, pids: Any) -> None:
            asked.append((cores, pids))
            if 13 in pids:
                raise psutil.NoSuchProcess(13)

        def share(self) -> float:
            if len(asked) > 1:
                raise psutil.NoSuchProcess(12)
            return 0.5

    monkeypatch.setattr(surroundings, "OtherPrograms", Others)
    share = surroundings.beside_units((0, 1), {"cpu": 11, "gpu": 12})
    assert asked == [((0, 1), [11, 12])]
    assert (share({"cpu": 11, "gpu": 12}), share({"cpu": 11, "gpu": 14})) == (0.5, None)
    assert surroundings.beside_units((0,), {"cpu": 13})({"cpu": 13}) is None
    assert share({"cpu": 11, "gpu": 12}) is None


def test_ranks_that_agree_and_ranks_that_do_not() -> None:
    """By hand: 1 - 6 sum(d^2) / (n (n^2 - 1)) without equal values."""
    assert rank_correlation([1, 5, 9, 700], [2, 3, 4, 5]) == pytest.approx(1)
    assert rank_correlation([1, 2, 3], [9, 8, 7]) == pytest.approx(-1)
    assert rank_correlation([1, 2, 3, 4, 5], [2, 1, 4, 3, 5]) == pytest.approx(1 - 6 * 4 / (5 * 24))
    # ranks 1, 2.5, 2.5, 4 and 1, 2, 3, 4: covariance 2.25 + 0 + 0 + 2.25 = 4.5, spreads 4.5 and 5
    assert rank_correlation([1, 2, 2, 3], [1, 2, 3, 4]) == pytest.approx(4.5 / (4.5 * 5) ** 0.5)
    assert rank_correlation([1, 1], [1, 2]) is None
    with pytest.raises(ValueError, match="argument 2"):
        rank_correlation([1, 2], [1])
