"""`bench scheduler`: whole documents on a clock that is told, and its ways of running the same model."""

from __future__ import annotations

import gc
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.bench import scheduler
from trilane.bench.scheduler import LEAN, NO_REPORT, RECORDED, SIMPY, TRILANE
from trilane.errors import BadInputError, TrilaneError
from trilane.hw_profiles.application import application_graph

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


@pytest.mark.parametrize("has_simpy", [True, False])
def test_a_document_of_two_rounds(has_simpy: bool, rounds: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """A minute in a hundred is 36 frames: 36 releases and as many jobs of each of the five stages. Medians of 1 and 2
    times the seconds are 1.5 times, the ratios those of either round."""

    def absent() -> Any:
        raise ModuleNotFoundError("simpy")

    if has_simpy:
        pytest.importorskip("simpy")
    else:
        monkeypatch.setattr(scheduler, "_models", absent)
    result = scheduler.measure(minutes=0.01, rounds=2, seeds=3)
    ways = [TRILANE, NO_REPORT, RECORDED, *[SIMPY, LEAN] * has_simpy]
    assert rounds == [*ways, *ways[1:], TRILANE]
    if has_simpy:
        assert result["rows"][3].pop("processed") > 216, "SimPy takes several events to a job"
    else:
        said = result.pop("absent")["simpy"]
        assert said.startswith("not installed: ") and "peers" in said
    assert result == {
        "rows": [
            {
                **{"way": way, "frames": 36, "events": 216, "events_per_s": 216 / (1.5 * SECONDS[way])},
                **{"seconds": 1.5 * SECONDS[way], "seconds_low": SECONDS[way], "seconds_high": 2 * SECONDS[way]},
                **({} if way == SIMPY else {"processed": 216}),
            }
            for way in ways
        ],
        "over_trilane": {way: dict.fromkeys(("median", "low", "high"), SECONDS[way]) for way in ways[1:]},
        **{"over_simpy": 4.0 if has_simpy else None, "over_simpy_lean": 2.0 if has_simpy else None},
        **{"agree": 36 if has_simpy else None, "same_traces": 2, "different_traces": 2},
        "config": {"minutes": 0.01, "fps": 60, "rounds": 2, "seeds": 3, "repeats": 10},
    }


@pytest.mark.parametrize("bad", [{"minutes": 0.0}, {"rounds": 0}, {"seeds": 0}])
def test_numbers_that_are_not_positive_are_refused(bad: dict[str, Any]) -> None:
    asked = {"minutes": 1.0, "rounds": 1, "seeds": 1} | bad
    words = f"found minutes {asked['minutes']:g}, rounds {asked['rounds']}, seeds {asked['seeds']}, expected positive"
    with pytest.raises(BadInputError, match=words):
        scheduler.measure(**asked)  # type: ignore[arg-type]


def test_ways_that_disagree_end_the_bench(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduler, "_timed", lambda run: (1.0, run()))

    def ways(**answers: int) -> dict[str, Any]:
        return {name: lambda answer=answer: [answer] for name, answer in answers.items()}

    with pytest.raises(TrilaneError, match=r"^b, c and trilane present frames at different times$"):
        scheduler._cpu_seconds(ways(trilane=1, b=2, c=3, d=1), 1)
    assert list(scheduler._cpu_seconds(ways(trilane=1, d=1), 2)) == ["trilane", "d"]


def test_a_run_is_timed_without_garbage_collection(monkeypatch: pytest.MonkeyPatch) -> None:
    looks = iter([3.0, 5.5])
    monkeypatch.setattr(scheduler, "time", SimpleNamespace(process_time=lambda: next(looks)))
    assert scheduler._timed(lambda: [gc.isenabled()]) == (2.5, [False]) and gc.isenabled()  # type: ignore[list-item]


def test_service_times_come_from_a_table_of_the_seed(held: Held) -> None:
    """From half of the stage's mean to one and a half, the same for the same seed."""
    service = scheduler._service(3, 50)
    for name, ms in scheduler.SERVICE_MS.items():
        times = [service(name, "any", frame, 0) for frame in range(50)]
        assert all(0.5 * ms * 1e6 <= time <= 1.5 * ms * 1e6 for time in times)
        held(name, times)


def test_trilanes_variants_present_the_same_frames() -> None:
    """At 60 frames a second, five stages of 2 ms: each frame is there 10 ms after its release."""
    variants = scheduler._trilane_variants(application_graph(), lambda *_: 2_000_000, 5)
    assert [*variants] == [TRILANE, NO_REPORT, RECORDED]
    for run in variants.values():
        assert run() == [10_000_000 + n * 16_666_667 for n in range(5)]


def test_a_seeds_traces_are_the_same_and_others_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduler, "REPEATS", 2)
    one, other = scheduler._traces(4), scheduler._traces(5)
    assert len({*one}) == len({*other}) == 1 and one != other


def test_a_recording_is_played_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A folder stands for its events.jsonl."""
    differences = ["step 2: other", "step 3: other"]
    steps = {tmp_path / "events.jsonl": [1, 2, 3], tmp_path / "x.jsonl": [1, 2]}
    monkeypatch.setattr(scheduler, "read", lambda path: SimpleNamespace(steps=steps[path]))
    monkeypatch.setattr(scheduler, "replay", lambda recording: iter(differences[: len(recording.steps) - 1]))
    assert scheduler._replayed(str(tmp_path)) == {"replay": {"steps": 3, "different": 2, "first": "step 2: other"}}
    differences.clear()
    assert scheduler._replayed(str(tmp_path / "x.jsonl")) == {"replay": {"steps": 2, "different": 0, "first": ""}}
