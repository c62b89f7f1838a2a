"""`bench faults`: what it asks of runs, sends to units, and makes of results that are told."""

from __future__ import annotations

import re
import signal
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from trilane.bench import faults
from trilane.errors import BadInputError
from trilane.pipeline.result import Failure
from trilane.scheduler.events import UnitDied, UnitReady
from trilane.scheduler.ledger import JobRecord
from trilane.stages.run_options import RunOptions
from trilane.testing.told_results import ToldConfig, result_of

MS = 1_000_000


@pytest.fixture
def configured(monkeypatch: pytest.MonkeyPatch) -> list[RunOptions]:
    asked: list[RunOptions] = []
    monkeypatch.setattr(faults, "configure", lambda request, _: asked.append(request) or ToldConfig(request))
    return asked


def job(stage: str, end_ns: int) -> JobRecord:
    return JobRecord(stage, "cpu", 0, 0, 0, 0, end_ns)


def run_with_deaths(**changes: Any) -> SimpleNamespace:
    """The GPU unit dies at 5 and 100 ms and is ready at 2, 30 and 160; the DSP dies at 50 and is ready at 55."""
    died, ready = UnitDied("gpu"), UnitReady("gpu")
    steps = [
        (2, ready),
        (5, died),
        (30, ready),
        (50, UnitDied("dsp")),
        (55, UnitReady("dsp")),
        (100, died),
        (160, ready),
    ]
    told = {
        "recording": SimpleNamespace(steps=[(at * MS, (event,), ()) for at, event in steps]),
        "jobs": [*(job("present", (40 + 10 * n) * MS) for n in reversed(range(20))), job("pose", 900 * MS)],
        "requested": 50,
    }
    return result_of("pipelined", 10.0, **told | changes)


def test_the_row_of_a_run_under_signals_by_hand() -> None:
    """Frames are presented every 10 ms from 40 to 230: after the signal at 15 the pace is back at 40, after the one at
    101 at 110; the one at 229 has one frame after it."""
    signals = faults.Signals("gpu", [], sent_ns=[15 * MS, 101 * MS, 229 * MS])
    row = faults._row(run_with_deaths(), signals, 10 * MS)  # type: ignore[arg-type]
    assert row == {
        "signals": 3,
        "ended": "all frames",
        "requested": 50,
        "presented": 20,
        "lost": 7,
        "dropped": 5,
        "uncounted": 18,
        "lost_per_death": pytest.approx(7 / 3),
        "restarts": 2,
        "ready_ms": 42.5,
        "back_ms": 17.0,
        "back_max_ms": 25.0,
        "not_back": 1,
    }
    quiet = SimpleNamespace(steps=[])
    failed = run_with_deaths(failure=Failure("it broke"), recording=quiet, jobs=[])
    row = faults._row(failed, faults.Signals("host", []), 10 * MS)  # type: ignore[arg-type]
    assert (row["ended"], row["lost_per_death"], row["restarts"]) == ("failed: it broke", 7.0, 5)
    assert (row["ready_ms"], row["back_ms"], row["back_max_ms"], row["not_back"]) == (None, None, None, 0)


def test_faults_run_every_unit_under_every_fault(monkeypatch: pytest.MonkeyPatch, configured: list[RunOptions]) -> None:
    seen: list[Any] = []

    def run_under(signals: faults.Signals, *asked: Any) -> dict[str, Any]:
        seen.append((signals, asked))
        return {"left": len(seen)}

    monkeypatch.setattr(faults, "run_under", run_under)

    def avatar_pipeline(config: ToldConfig, assets: str) -> Any:
        folder = config.values["out_dir"]
        return folder.is_dir() and bool(re.fullmatch(r"trilane-bench-\w{8}", folder.name)), assets

    monkeypatch.setattr(faults, "avatar_pipeline", avatar_pipeline)
    result = faults.measure(
        unit=("gpu", "cpu"),
        fault=("stop", "kill"),
        times=3,
        seconds=20.0,
        fps=12.5,
        stop_s=2.0,
        hang_s=7.0,
        avatar="x",
        seed=4,
    )
    pairs = [(unit, fault) for unit in ("gpu", "cpu") for fault in ("stop", "kill")]
    assert result == {
        "rows": [{"unit": unit, "fault": fault, "left": n} for n, (unit, fault) in enumerate(pairs, start=1)],
        "accuracy": {"x": "accuracy of x"},
        "config": {"seconds": 20.0, "fps": 12.5, "size": "256x256", "runtime": "told", "seed": 4},
    }
    assert configured == [RunOptions(size="256x256", avatar="x", frames=250, runtime="auto")]
    assert [(signals.unit, signals.moments) for signals, _ in seen] == [
        (unit, faults._moments(fault, 3, 20.0, 2.0, 4)) for unit, fault in pairs
    ]
    assert [asked for _, asked in seen] == [((True, "assets of x"), 250, 12.5, 7.0, "assets of x")] * 4
    for option, bad in (
        ("unit", ("npu",)),
        ("fault", ("x",)),
        ("fps", 0.5),
        ("hang_s", 0.0),
        ("times", 0),
        ("seconds", 0.0),
    ):
        with pytest.raises(
            BadInputError, match=f"--{option.replace('_', '-')}: found .*, expected (of cpu|of kill|0.1 to|1 to)"
        ):
            faults.measure(**{option: bad})  # type: ignore[arg-type]
    with pytest.raises(BadInputError, match=r"--stop-s: found 14\.0, expected more than 0, less than 14"):
        faults.measure(fault=("stop",), stop_s=14.0, seconds=20.0)


def test_what_a_run_leaves_behind_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two processes and one name more than before, of which one process was there."""
    children = iter([{"a"}, {"a", "b", "c"}])
    names = iter([{"x", "y"}, {"y", "z"}])
    asked: list[Any] = []
    monkeypatch.setattr(
        faults.psutil,
        "Process",
        lambda: SimpleNamespace(children=lambda recursive: next(children) if recursive else ()),
    )
    monkeypatch.setattr(faults, "_names", lambda: next(names))
    signals = faults.Signals("gpu", [])

    def run_pipeline(*what: Any, **options: Any) -> Any:
        assert not signals.begun.is_set() and signals.is_alive() and signals.daemon
        options.pop("on_progress")(0, 3)
        assert signals.begun.is_set() and not signals.over.is_set()
        asked.append((what, options))
        return run_with_deaths()

    monkeypatch.setattr(faults, "run_pipeline", run_pipeline)
    row = faults.run_under(signals, "pipeline", 50, 12.5, 1.5, "assets")  # type: ignore[arg-type]
    assert row["left"] == 3 and row["requested"] == 50
    assert signals.over.is_set() and not signals.is_alive()
    options = {"pace_fps": 12.5, "assets": "assets", "hang_ns": 1_500_000_000}
    assert asked == [(("pipeline", 50), options)]

    def interrupted(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(faults, "run_pipeline", interrupted)
    children, names = iter([set()]), iter([set()])
    waiting = faults.Signals("gpu", [(60.0, signal.SIGKILL)])
    with pytest.raises(KeyboardInterrupt):
        faults.run_under(waiting, "pipeline", 50, 12.5, 1.5)  # type: ignore[arg-type]
    assert not waiting.is_alive() and waiting.sent_ns == []


class Event:
    """Stands for an event that a told clock waits for: `over` is set at `at_s`."""

    def __init__(self, clock: list[float], at_s: float) -> None:
        self.clock, self.at_s = clock, at_s
        self.waited: list[float] = []

    def is_set(self) -> bool:
        return self.clock[0] >= self.at_s

    def wait(self, seconds: float = 0.0) -> bool:
        self.waited.append(seconds)
        self.clock[0] += seconds
        return self.is_set()


def test_signals_are_sent_at_their_moments_until_the_run_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """From 100 s on: a stop at 101, its end at 103, a kill whose process has gone at 104, one of which there is none
    yet at 105 (looked for every 20 ms, there at the third look), and one at 110, when the run has ended."""
    clock = [100.0]
    told = SimpleNamespace(monotonic=lambda: clock[0], monotonic_ns=lambda: round(clock[0] * 1e3))
    monkeypatch.setattr(faults, "time", told)
    sent: list[Any] = []

    def send(number: signal.Signals) -> None:
        sent.append((number, clock[0]))
        if clock[0] == 104.0:
            raise psutil.NoSuchProcess(1)

    looks: list[float] = []

    def unit_process(unit: str) -> Any:
        assert unit == "gpu"
        looks.append(clock[0])
        if len(looks) in (4, 5):
            raise LookupError if len(looks) == 4 else psutil.NoSuchProcess(1)
        return SimpleNamespace(send_signal=send)

    monkeypatch.setattr(faults, "unit_process", unit_process)
    stop, go, kill = signal.SIGSTOP, signal.SIGCONT, signal.SIGKILL
    signals = faults.Signals("gpu", [(1.0, stop), (3.0, go), (4.0, kill), (5.0, kill), (10.0, kill)])
    begun, over = Event(clock, 0.0), Event(clock, 107.0)
    signals.begun, signals.over = begun, over  # type: ignore[assignment]
    signals.run()
    assert sent == [(stop, 101.0), (go, 103.0), (kill, 104.0), (kill, pytest.approx(105.04))]
    assert signals.sent_ns == [101_000, 105_040]
    assert begun.waited == [0.0] and over.waited[:3] == [1.0, 2.0, 1.0]
    assert looks[3:] == [105.0, pytest.approx(105.02), pytest.approx(105.04)]
    late = faults.Signals("gpu", [(1.0, kill)])
    late.over = Event(clock, 0.0)  # type: ignore[assignment]
    assert late._process() is None and hash(late) == id(late) and late.name == "signals"


def test_a_units_process_is_found_by_its_name_in_any_generation(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["other", faults.process_name("gpu"), faults.process_name("cpu")]
    found = [SimpleNamespace(name=lambda name=name: name) for name in names]
    monkeypatch.setattr(
        faults.psutil, "Process", lambda: SimpleNamespace(children=lambda recursive: found if recursive else [])
    )
    assert faults.unit_process("cpu") is found[2]
    with pytest.raises(LookupError):
        faults.unit_process("dsp")
