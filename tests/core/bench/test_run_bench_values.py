"""`bench pipeline` and `bench scenario`: what they ask of runs, and what they make of results that are told."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.bench import pipeline, scenario
from trilane.bench.lib.load import Load, Queries
from trilane.errors import BadInputError, TrilaneError
from trilane.hw_profiles.host import host_units, usable_cores
from trilane.pipeline.result import Failure
from trilane.scheduler.events import Settings, chain
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.recording import Recording
from trilane.stages.run_options import RunOptions

MS = 1_000_000
Held = Callable[[str, Any], None]


class ToldConfig:
    """Stands for what was configured: `changed` keeps what is laid over it."""

    runtime = "told"

    def __init__(self, request: RunOptions, **values: Any) -> None:
        self.request, self.values = request, values
        self.accuracy = {request.avatar: f"accuracy of {request.avatar}"}
        self.assets = f"assets of {request.avatar}"
        self.config = self

    def changed(self, **values: Any) -> ToldConfig:
        return ToldConfig(self.request, **{**self.values, **values})


def _times(mean: float) -> SimpleNamespace:
    return SimpleNamespace(mean=mean)


def result_of(policy: str, frame_ms: float, **changes: Any) -> SimpleNamespace:
    """A run of `pose` (2 ms) and `present` (3 ms) on the unit `host`, and `raster` (10 ms).

    The unit of `raster` is the slowest and the busiest, and is not the last by its name.
    """
    stage = {"pose": ("host", 2.0), "raster": ("gpu", 10.0), "present": ("host", 3.0)}
    report = SimpleNamespace(
        policy=policy,
        fps=1000 / frame_ms,
        efficiency=0.75,
        frame_time_ms=_times(frame_ms),
        stages={name: SimpleNamespace(unit=unit, service_ms=_times(mean)) for name, (unit, mean) in stage.items()},
        units={"host": SimpleNamespace(busy=0.3, restarts=5), "gpu": SimpleNamespace(busy=0.6, restarts=2)},
    )
    jobs = [("gpu", 0, 0, 0, 10), ("gpu", 14, 17, 20, 50), ("host", 0, 0, 30, 40)]
    told = {
        "report": report,
        "recording": Recording(chain((("pose", "host"), ("raster", "gpu")), "double", "raster"), Settings(20)),
        "jobs": [JobRecord("raster", unit, 0, *instants) for unit, *instants in jobs],
        "dropped": {"a": 2, "b": 3},
        "lost": {"c": 1, "d": 6},
        "presented": 20,
        "interrupted": False,
        "failure": None,
    }
    return SimpleNamespace(**told | changes)


@pytest.fixture
def configured(monkeypatch: pytest.MonkeyPatch) -> list[RunOptions]:
    asked: list[RunOptions] = []
    for module in (pipeline, scenario):
        monkeypatch.setattr(module, "configure", lambda request, _: asked.append(request) or ToldConfig(request))
    return asked


FIGURES = {
    "efficiency": 0.75,
    "slowest": "gpu",
    "alone_ms": 10.0,
    "all_alone_ms": 15.0,
    "busiest": "gpu",
    "idle": pytest.approx(10 / 50),
    "starved": pytest.approx(4 / 50),
    "undispatched": pytest.approx(3 / 50),
    "overhead": pytest.approx(3 / 50),
    "in_run_over_alone": 1.0,
    "latency_p50_ms": None,
    "latency_p99_ms": None,
}


def test_a_rounds_runs_are_set_against_the_sequential_ones(
    monkeypatch: pytest.MonkeyPatch, configured: list[RunOptions]
) -> None:
    """Sequential frames of 20, 22 and 24 ms (hops 5, 7, 9), between them 10 ms pipelined. First round: gain 2.1, bound
    (15 + 6) / 10; second: 2.3 and (15 + 8) / 10. No step of theirs is recorded: no frame has a latency."""
    sequential = iter([20.0, 22.0, 24.0])
    asked: list[dict[str, Any]] = []

    def run_avatar(config: ToldConfig, assets: str, **options: Any) -> Any:
        folder = config.values["out_dir"]
        assert folder.is_dir() and re.fullmatch(r"trilane-bench-\w{8}", folder.name)
        asked.append({**options, "assets": assets, "values": {**config.values, "out_dir": None}})
        policy = options["policy"]
        return result_of(policy, next(sequential) if policy == "sequential" else 10.0)

    monkeypatch.setattr(pipeline, "run_avatar", run_avatar)
    cores = usable_cores()
    result = pipeline.measure(
        avatar=("x",), size=("64x64",), policy=("latest",), edge=("orphan",), frames=30, rounds=2, video=False
    )
    first, second = result["rows"]
    setting = {"avatar": "x", "size": "64x64", "cores": len(cores)}
    assert first == {
        **setting,
        **{"policy": "sequential", "edge": "double", "fps": (50 + 1000 / 22) / 2, "frame_ms": 21.0, "hops_ms": 6.0},
        **FIGURES,
        **{"dropped": 10, "lost": 14, "gain": 1.0, "bound": pytest.approx((20 + 22) / 20)},
        "gain_of_bound": pytest.approx((10 / 20 + 10 / 22) / 2),
        "of_bound_low": pytest.approx(10 / 22),
        "of_bound_high": pytest.approx(10 / 20),
    }
    assert second == {
        **setting,
        **{"policy": "latest", "edge": "orphan", "fps": 100.0, "frame_ms": 10.0, "hops_ms": None},
        **FIGURES,
        **{"dropped": 10, "lost": 14, "gain": pytest.approx(2.2), "bound": pytest.approx((21 + 23) / 20)},
        "gain_of_bound": pytest.approx((2.1 * 10 / 21 + 2.3 * 10 / 23) / 2),
        "of_bound_low": pytest.approx(2.3 * 10 / 23),
        "of_bound_high": pytest.approx(2.1 * 10 / 21),
    }
    assert result["accuracy"] == {"x": "accuracy of x"}
    assert result["config"] == {"frames": 30, "rounds": 2, "runtime": "told", "video": False}
    assert configured == [RunOptions(size="64x64", avatar="x", frames=30, runtime="auto")]
    values = {"out_dir": None, "record": False, "units": host_units(cores)}
    one = {"policy": "sequential", "edge": "double", "pace_fps": None}
    other = {"policy": "latest", "edge": "orphan", "pace_fps": 1.25 * 1000 / 10}
    whole = {"assets": "assets of x", "values": values}
    assert asked == [each | whole for each in (one, other, one, other, one)]


def test_every_avatar_size_and_number_of_cores_is_measured(
    monkeypatch: pytest.MonkeyPatch, configured: list[RunOptions]
) -> None:
    monkeypatch.setattr(pipeline, "run_avatar", lambda *_, policy, **__: result_of(policy, 20.0))
    monkeypatch.setattr(pipeline.networks, "full_width_bundle", lambda: Path("/made"))
    monkeypatch.setattr(pipeline, "usable_cores", lambda: (4, 6, 7))
    units: list[Any] = []
    monkeypatch.setattr(pipeline, "host_units", lambda cores: units.append(cores) or {})
    result = pipeline.measure(avatar=("x", "resnet18"), size=("32x32", "64x64"), cores=(0, 2), rounds=1, frames=20)
    order = [(a, size, n) for a in ("x", "resnet18") for size in ("32x32", "64x64") for n in (3, 2)]
    found = [(row["avatar"], row["size"], row["cores"]) for row in result["rows"]]
    assert found == [each for each in order for _ in range(2)]
    assert [request.avatar for request in configured] == ["x"] * 4 + ["/made"] * 4
    assert units == [(4, 6, 7), (4, 6)] * 4
    assert [*result["accuracy"]] == [f"{name} at {size}" for name in ("x", "resnet18") for size in ("32x32", "64x64")]
    assert result["accuracy"]["resnet18 at 32x32"] == "accuracy of /made"
    for bad in ((4,), (0, 5), (-1,)):
        with pytest.raises(BadInputError, match=r"numbers from 1 to the 3 that this process may use"):
            pipeline.measure(cores=bad)
    for asked in ({"frames": 19}, {"rounds": 0}):
        with pytest.raises(BadInputError, match="expected at least 20 and 1"):
            pipeline.measure(**asked)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"interrupted": True}, KeyboardInterrupt, "^$"),
        ({"failure": Failure("a stage failed")}, TrilaneError, "policy='sequential'.*: a stage failed"),
        ({"presented": 1}, TrilaneError, "no frames were presented"),
    ],
)
@pytest.mark.usefixtures("configured")
def test_a_run_that_fails_ends_the_bench(
    monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], error: type[BaseException], message: str
) -> None:
    monkeypatch.setattr(pipeline, "run_avatar", lambda *_, **__: result_of("sequential", 20.0, **changes))
    with pytest.raises(error, match=message):
        pipeline.measure(rounds=1)
    monkeypatch.setattr(pipeline, "run_avatar", lambda *_, policy, **__: result_of(policy, 20.0, presented=2))
    assert len(pipeline.measure(rounds=1)["rows"]) == 2


def test_latencies_make_a_scenarios_row() -> None:
    """Seventy queries, one a second, answered after 1 to 70 ms but the last after 80: 64 need 90 %, one may be late."""
    load = Load("single-stream", seconds=60.0)
    queries = Queries(asked_s=[float(n) for n in range(70)])
    queries.answered_s = [n + (n + 1) / 1000 for n in range(69)] + [69.08]
    row = scenario._row(load, queries, None)
    assert row == {
        "scenario": "single-stream",
        "judge": "trilane",
        "verdict": "VALID",
        "queries": 70,
        "seconds": pytest.approx(69.08),
        "rate": pytest.approx(70 / 69.08),
        "p50_ms": pytest.approx(35.5),
        "percentile": 0.9,
        "percentile_ms": pytest.approx(80.0),
        "max_ms": pytest.approx(80.0),
        "because": "",
    }
    short = scenario._row(Load("single-stream", seconds=70.0), queries, None)
    assert (short["verdict"], short["because"]) == ("INVALID", "it lasted 69.1 s, expected 70 s")
    for valid, verdict in ((True, "VALID"), (False, "INVALID")):
        loadgen: Any = SimpleNamespace(verdict=SimpleNamespace(valid=valid))
        row = scenario._row(Load("single-stream", seconds=70.0), queries, loadgen)
        assert (row["judge"], row["verdict"], row["because"]) == ("loadgen", verdict, "")


def test_every_scenario_is_asked_of_every_judge(monkeypatch: pytest.MonkeyPatch, configured: list[RunOptions]) -> None:
    ran: list[Any] = []

    def run_scenario(*asked: Any) -> tuple[dict[str, Any], str]:
        ran.append(asked)
        return {"row": len(ran)}, "summary" if asked[3] == "loadgen" else ""

    monkeypatch.setattr(scenario, "run_scenario", run_scenario)
    looked: list[str] = []
    monkeypatch.setattr(scenario, "load_generator", lambda: looked.append("there"))
    monkeypatch.setattr(scenario, "avatar_pipeline", lambda config, assets, edge: (config.values, assets, edge))
    names, judges = ("offline", "server"), ("trilane", "loadgen")
    result = scenario.measure(
        scenario=names, judge=judges, avatar="x", seconds=3.0, rate=4.0, limit_ms=5.0, samples=6, edge="single", seed=7
    )
    assert result == {
        "rows": [{"row": n} for n in (1, 2, 3, 4)],
        "summaries": {"offline, loadgen": "summary", "server, loadgen": "summary"},
        "accuracy": {"x": "accuracy of x"},
        "config": {"size": "256x256", "policy": "pipelined", "edge": "single", "runtime": "told", "seed": 7},
    }
    made = ({"record": False}, "assets of x", "single")
    assert ran == [
        (made, "assets of x", Load(name, 3.0, 4.0, 5.0, 6, 7), judge, "pipelined") for name in names for judge in judges
    ]
    assert configured == [RunOptions(size="256x256", avatar="x", frames=1_000_000, runtime="auto")]
    assert looked == ["there"]
    scenario.measure(scenario=names[:1], avatar="x")
    assert len(looked) == 1


class Loadgen:
    """Stands for the player that lets LoadGen ask."""

    def __init__(self, load: Load, queries: Queries) -> None:
        self.load, self.queries = load, queries
        self.verdict = SimpleNamespace(valid=True, summary="its summary")
        self.answered, self.ended, self.unanswered = queries.answered, queries.ended, queries.unanswered

    def play(self, requests: Any) -> None:
        scenario.play(self.load, requests, self.queries)


@pytest.mark.parametrize(
    ("judge", "name", "size"),
    [("trilane", "multi-stream", 3), ("trilane", "offline", 1), ("loadgen", "multi-stream", 1)],
)
def test_a_run_is_asked_on_a_thread_while_it_goes_on(
    monkeypatch: pytest.MonkeyPatch, judge: str, name: str, size: int
) -> None:
    load, threads, asked = Load(name, 1.0, samples=3), [], []

    def play(what: Load, requests: Any, queries: Queries) -> None:
        threads.append(threading.current_thread())
        assert (what, queries.size) == (load, size)
        queries.asked_s, queries.answered_s = [1.0], [2.0]
        queries.over = requests.answered == queries.answered

    def run_pipeline(*what: Any, requests: Any, **options: Any) -> Any:
        asked.append((what, options))
        assert not threads, "asking begins when the queue is open"
        requests.is_open.set()
        while not (events := requests.events()):
            time.sleep(0.001)
        assert [type(event).__name__ for event in events] == ["Stop"]
        return SimpleNamespace(failure=None, interrupted=False)

    monkeypatch.setattr(scenario, "play", play)
    monkeypatch.setattr(scenario, "LoadGenPlayer", Loadgen)
    monkeypatch.setattr(scenario, "run_pipeline", run_pipeline)
    row, summary = scenario.run_scenario("pipeline", "assets", load, judge, "latest")  # type: ignore[arg-type]
    assert (row["judge"], summary) == (judge, "its summary" if judge == "loadgen" else "")
    assert (row["p50_ms"], row["queries"], row["max_ms"]) == (1000.0, 1, 1000.0)
    assert asked == [(("pipeline", 1_000_000), {"policy": "latest", "assets": "assets"})]
    (player,) = threads
    assert (player.name, player.daemon, player.is_alive()) == ("player", True, False) and hash(player) == id(player)


@pytest.mark.parametrize(
    ("failure", "interrupted", "error", "words"),
    [
        (Failure("it broke"), True, TrilaneError, "^it broke$"),
        (None, True, KeyboardInterrupt, "^$"),
        (None, False, TrilaneError, "^nobody answered$"),
    ],
)
def test_what_ends_a_scenario(
    monkeypatch: pytest.MonkeyPatch, failure: Any, interrupted: bool, error: type[BaseException], words: str
) -> None:
    def play(*_: Any) -> None:
        raise TrilaneError("nobody answered")

    closed: list[Any] = []

    def run_pipeline(*_: Any, requests: Any, **__: Any) -> Any:
        closed.append(requests)
        return SimpleNamespace(failure=failure, interrupted=interrupted)

    monkeypatch.setattr(scenario, "play", play)
    monkeypatch.setattr(scenario, "run_pipeline", run_pipeline)
    with pytest.raises(error, match=words):
        scenario.run_scenario("pipeline", {}, Load("offline", 1.0), "trilane", "latest")  # type: ignore[arg-type]
    assert closed[0].is_open.is_set(), "a queue that is closed lets whoever waits for it go on"


@pytest.mark.parametrize(
    ("option", "bad", "words"),
    [
        ("scenario", ("x",), "--scenario: found 'x', expected one of single-stream, multi-stream, server, offline"),
        ("judge", ("x",), "--judge: found 'x', expected one of trilane, loadgen"),
        ("seconds", 0.09, "--seconds: found 0.09, expected 0.1 to 3600"),
        ("rate", 1001.0, "--rate: found 1001, expected 0.1 to 1000"),
        ("limit_ms", 0.9, "--limit-ms: found 0.9, expected 1 to 60000"),
        ("samples", 65, "--samples: found 65, expected 1 to 64"),
    ],
)
def test_a_scenario_out_of_range_is_refused_by_name(option: str, bad: Any, words: str) -> None:
    with pytest.raises(BadInputError, match=f"^{words}$"):
        scenario.measure(**{option: bad})
