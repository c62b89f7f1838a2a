"""`bench scheduler`: whole documents on a clock that is told, and its ways of running the same model."""

from __future__ import annotations

import gc
import hashlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.bench import scheduler
from trilane.bench.scheduler import LEAN, NO_REPORT, RECORDED, SIMPY, TRILANE
from trilane.errors import BadInputError, TrilaneError
from trilane.hw_profiles.application import application_graph
from trilane.scheduler.events import Settings

Held = Callable[[str, Any], None]
#: CPU seconds of each way's runs in the first round; twice that in the second.
SECONDS = {TRILANE: 1.0, NO_REPORT: 0.5, RECORDED: 1.5, SIMPY: 4.0, LEAN: 2.0}


@pytest.fixture
def rounds(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The ways in the order in which they ran: `_timed` answers what is told."""
    ran: list[str] = []
    names: dict[Any, str] = {}
    cpu_seconds = scheduler._cpu_seconds

    def named(ways: dict[str, Any], count: int) -> dict[str, list[float]]:
        names.update({run: way for way, run in ways.items()})
        return cpu_seconds(ways, count)

    def timed(run: Any) -> tuple[float, list[int]]:
        ran.append(names[run])
        return SECONDS[ran[-1]] * ran.count(ran[-1]), run()

    monkeypatch.setattr(scheduler, "_cpu_seconds", named)
    monkeypatch.setattr(scheduler, "_timed", timed)
    monkeypatch.setattr(scheduler, "_traces", lambda seed: ["a", "a"] if seed < 2 else ["b", "c"])
    return ran


def test_a_document_of_two_rounds(rounds: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """A minute in a hundred is 36 frames: 36 releases and as many jobs of each of the five stages. Medians of 1 and 2
    times the seconds are 1.5 times, the ratios those of either round."""
    pytest.importorskip("simpy")
    drawn: list[Any] = []
    service = scheduler._service
    monkeypatch.setattr(scheduler, "_service", lambda *asked: drawn.append(asked) or service(*asked))
    result = scheduler.measure(minutes=0.01, rounds=2, seeds=3)
    assert drawn == [(0, 36)]
    ways = [TRILANE, NO_REPORT, RECORDED, SIMPY, LEAN]
    assert rounds == [*ways, *ways[1:], TRILANE]
    processed = result["rows"][3].pop("processed")
    assert processed > 216, "SimPy takes several events to a job"
    assert result == {
        "rows": [
            {
                "way": way,
                "frames": 36,
                "events": 216,
                "seconds": 1.5 * SECONDS[way],
                "seconds_low": SECONDS[way],
                "seconds_high": 2 * SECONDS[way],
                "events_per_s": 216 / (1.5 * SECONDS[way]),
                **({} if way == SIMPY else {"processed": 216}),
            }
            for way in ways
        ],
        "over_trilane": {way: dict.fromkeys(("median", "low", "high"), SECONDS[way]) for way in ways[1:]},
        "over_simpy": 4.0,
        "over_simpy_lean": 2.0,
        "agree": 36,
        "same_traces": 2,
        "different_traces": 2,
        "config": {"minutes": 0.01, "fps": 60, "rounds": 2, "seeds": 3, "repeats": 10},
    }


def test_without_simpy(rounds: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def absent() -> Any:
        raise ModuleNotFoundError("simpy")

    monkeypatch.setattr(scheduler, "_models", absent)
    result = scheduler.measure(minutes=0.0001, rounds=1, seeds=1)
    assert rounds == [TRILANE, NO_REPORT, RECORDED]
    assert [row["frames"] for row in result["rows"]] == [2, 2, 2], "two at least"
    assert result["agree"] is result["over_simpy"] is result["over_simpy_lean"] is None
    assert list(result["absent"]) == ["simpy"] and "peers" in result["absent"]["simpy"]
    assert result["absent"]["simpy"].startswith("not installed: ")
    for bad in ({"minutes": 0.0}, {"rounds": 0}, {"seeds": 0}):
        asked = {"minutes": 1.0, "rounds": 1, "seeds": 1} | bad
        words = (
            f"found minutes {asked['minutes']:g}, rounds {asked['rounds']}, seeds {asked['seeds']}, expected positive"
        )
        with pytest.raises(BadInputError, match=words):
            scheduler.measure(**asked)  # type: ignore[arg-type]


def test_ways_that_disagree_end_the_bench(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduler, "_timed", lambda run: (1.0, run()))

    def ways(**answers: int) -> dict[str, Any]:
        return {name: lambda answer=answer: [answer] for name, answer in answers.items()}

    with pytest.raises(TrilaneError, match=r"^b, c and trilane present frames at different times$"):
        scheduler._cpu_seconds(ways(trilane=1, b=2, c=3, d=1), 1)
    assert list(scheduler._cpu_seconds(ways(trilane=1, d=1), 2)) == ["trilane", "d"]


@pytest.mark.parametrize("collects", [True, False])
def test_garbage_is_collected_before_a_run_and_not_in_it(monkeypatch: pytest.MonkeyPatch, collects: bool) -> None:
    done: list[Any] = []
    looks = iter([3.0, 5.5])
    told = SimpleNamespace(
        isenabled=lambda: collects,
        collect=lambda: done.append("collect"),
        disable=lambda: done.append("off"),
        enable=lambda: done.append("on"),
    )
    monkeypatch.setattr(scheduler, "gc", told)
    monkeypatch.setattr(scheduler, "time", SimpleNamespace(process_time=lambda: done.append("look") or next(looks)))
    assert scheduler._timed(lambda: done.append("run") or [7]) == (2.5, [7])
    assert done == ["collect", "off", "look", "run", "look", *["on"] * collects]
    assert gc.isenabled()


def test_service_times_come_from_a_table_of_the_seed(held: Held) -> None:
    """From half of the stage's mean to one and a half, the same for the same seed."""
    service = scheduler._service(3, 50)
    for name, ms in scheduler.SERVICE_MS.items():
        times = [service(name, "any", frame, 0) for frame in range(50)]
        assert all(0.5 * ms * 1e6 <= time <= 1.5 * ms * 1e6 for time in times)
        held(name, times)


def test_our_ways_run_the_same_model(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 60 frames a second, one with its report and one with its recording."""
    drivers: list[Any] = []
    reports: list[Any] = []

    class Kept:
        """A driver that runs nothing and notes what it is asked."""

        def __init__(self, _graph: Any, settings: Settings, _service: Any, *, keep: bool) -> None:
            drivers.append((settings, keep))
            ledger = SimpleNamespace(presented_ns=[])
            self.core = SimpleNamespace(report=lambda **asked: reports.append(asked), ledger=ledger)

        def run(self) -> None:
            return None

    monkeypatch.setattr(scheduler, "VirtualDriver", Kept)
    ways = scheduler._trilane_ways(application_graph(), scheduler._service(0, 5), 5)
    for run in ways.values():
        assert run() == []
    settings = Settings(5, "pipelined", period_ns=16_666_667)
    assert drivers == [(settings, False), (settings, False), (settings, True)]
    assert [*ways] == [TRILANE, NO_REPORT, RECORDED] and len(reports) == 2
    assert reports[0] == {"clock": "virtual"}


def test_a_seeds_traces_are_digests_of_steps_and_report(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def simulate(graph: Any, settings: Settings, service: Any, **options: Any) -> Any:
        asked.append((graph, settings, service("pose", "cpu", 0, 0), options))
        return SimpleNamespace(recording=SimpleNamespace(steps=[len(asked) // 2]), report={"fps": 1})

    monkeypatch.setattr(scheduler, "simulate", simulate)
    monkeypatch.setattr(scheduler, "REPEATS", 3)
    digests = [hashlib.sha256(repr(([step], {"fps": 1})).encode()).hexdigest() for step in (0, 1, 1)]
    assert scheduler._traces(4) == digests
    settings = Settings(300, "deadline", period_ns=16_666_667, deadline_ns=50_000_001)
    options = {"restart_ns": 50_000_000, "faults": [(1_028_000_000, "dsp")], "keep": True}
    first = scheduler._service(4, 300)("pose", "cpu", 0, 0)
    assert asked == [(application_graph(), settings, first, options)] * 3


def test_a_recording_is_played_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    looked: list[Path] = []
    monkeypatch.setattr(scheduler, "read", lambda path: looked.append(path) or SimpleNamespace(steps=[1, 2, 3]))
    monkeypatch.setattr(scheduler, "replay", lambda _: iter(["step 2: other", "step 3: other"]))
    found = {"replay": {"steps": 3, "different": 2, "first": "step 2: other"}}
    assert scheduler._replayed(str(tmp_path)) == found
    assert scheduler._replayed(str(tmp_path / "x.jsonl")) == found
    assert looked == [tmp_path / "events.jsonl", tmp_path / "x.jsonl"]
    monkeypatch.setattr(scheduler, "replay", lambda _: iter([]))
    assert scheduler._replayed("x")["replay"] == {"steps": 3, "different": 0, "first": ""}
