"""Load patterns, verdicts and LoadGen: clocks and answers that are told, MLPerf's published numbers, sums by hand."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilane.bench import scenario
from trilane.bench.scenario import Load, LoadGenPlayer, Queries, bound_ms, load_generator, queries_needed, tail, verdict
from trilane.errors import BadInputError, MissingPartError, TrilaneError
from trilane.stages.run_options import RunOptions

Held = Callable[[str, Any], None]


class Clock:
    """Stands for a module's `time`: a second of it passes for every look and for what is slept."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        self.now += 1.0
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class Run:
    """Stands for a run: every frame that is asked for is answered `delay` seconds of the clock later."""

    def __init__(self, clock: Clock, queries: Queries, delay: float = 0.25) -> None:
        self._clock, self._queries, self._delay = clock, queries, delay
        self.asked: list[int] = []
        self.moments: list[float] = []

    def request(self, frames: int) -> None:
        self.asked.append(frames)
        self.moments.append(self._clock.now)
        for frame in range(frames):
            self._clock.now += self._delay
            self._queries.answered(frame)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    told = Clock()
    monkeypatch.setattr(scenario, "time", told)
    return told


def played(clock: Clock, asked: Load) -> tuple[list[int], Queries]:
    queries = Queries(size=asked.samples if asked.scenario == "multi-stream" else 1)
    run = Run(clock, queries)
    scenario.play(asked, run, queries)  # type: ignore[arg-type]
    return run.asked, queries


def test_one_query_at_a_time_until_there_are_enough_and_the_time_has_passed(clock: Clock) -> None:
    """Eight to warm up together, then 64 of a frame each; each takes the delay and the clock's next look."""
    asked, queries = played(clock, Load("single-stream", seconds=1.0))
    assert asked == [8] + [1] * 64
    assert queries.latencies_ms == pytest.approx([1250.0] * 64)
    asked, _ = played(clock, Load("single-stream", seconds=1000.0))
    assert len(asked) - 1 == pytest.approx(1000 / 3.25, abs=2), "looks at the clock: loop, ask, answer"


def test_a_query_of_several_frames_is_answered_with_the_last(clock: Clock) -> None:
    asked, queries = played(clock, Load("multi-stream", seconds=1.0, samples=3))
    assert asked == [24] + [3] * 662
    assert queries.latencies_ms == pytest.approx([3 * 250.0 + 1000.0] * 662)


def test_all_at_once_asks_a_tenth_more_than_the_time_takes(clock: Clock) -> None:
    """64 queries first, answered after 80 s (a look and a quarter each), then 1.1 * 0.8 a second * 201 s."""
    asked, queries = played(clock, Load("offline", seconds=201.0))
    assert asked == [8, 64, 177]
    assert len(queries.asked_s) == 177


def test_all_at_once_asks_for_no_more_frames_than_a_run_has(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenario, "MAX_FRAMES", 100)
    asked, _ = played(clock, Load("offline", seconds=201.0))
    assert asked == [8, 64, 28]


def test_a_server_is_asked_at_the_moments_of_its_seed(clock: Clock, held: Held) -> None:
    """Until there are enough queries, or the run is over."""
    begin, queries = clock.now, Queries()
    run = Run(clock, queries, 0.0)
    scenario.PATTERNS["server"](Load("server", 1.0, rate=0.05, seed=3), run, queries)  # type: ignore[arg-type]
    assert len(run.moments) == 662
    held("moments", [moment - begin for moment in run.moments])
    asked: list[int] = []

    def request(count: int) -> None:
        asked.append(count)
        queries.over = len(asked) == 2

    scenario.PATTERNS["server"](Load("server", 1.0), SimpleNamespace(request=request), queries)  # type: ignore[arg-type]
    assert asked == [1, 1]


def test_what_ends_a_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenario, "STALLED_S", 0.001)
    queries = Queries(asked_s=[1.0, 2.0], answered_s=[1.5])
    with pytest.raises(TrilaneError, match=r"^no query was answered for 0 s$"):
        queries.wait()
    queries.ended()
    with pytest.raises(TrilaneError, match="ended before every query"):
        queries.wait()
    queries.answered(0)
    queries.wait()
    assert len(queries.answered_s) == 2
    queries.unanswered({"a:late": 2, "b": 1})
    cause = r"^frames of queries were dropped or lost \(a:late 2, b 1\), and every query must be answered: a single"
    with pytest.raises(TrilaneError, match=cause):
        queries.wait()


@pytest.mark.parametrize(("percentile", "late", "queries"), [(0.90, 1, 64), (0.95, 1, 130), (0.99, 1, 662)])
def test_query_counts_are_the_published_ones(percentile: float, late: int, queries: int) -> None:
    assert queries_needed(percentile, late) == queries


@given(st.integers(1, 400), st.integers(0, 30), st.floats(0.01, 0.5))
def test_tail_is_the_binomials(queries: int, late: int, share: float) -> None:
    direct = sum(math.comb(queries, k) * share**k * (1 - share) ** (queries - k) for k in range(min(late, queries) + 1))
    assert tail(queries, late, share) == pytest.approx(direct, rel=1e-9)


def test_queries_that_are_needed_are_the_least_that_are_enough() -> None:
    for percentile, late in ((0.9, 1), (0.9, 2), (0.9, 5), (0.99, 1), (0.5, 1)):
        needed = queries_needed(percentile, late)
        assert tail(needed, late, 1 - percentile) <= 0.01 + 1e-12 < tail(needed - 1, late, 1 - percentile)
    for count in (63, 64, 88, 89, 90, 112, 200):
        latencies = [float((count - 1) * n % count) for n in range(count)]
        late = max((k for k in range(1, 40) if queries_needed(0.9, k) <= count), default=0)
        assert bound_ms(latencies, 0.9) == (count - late if late else None)
    assert bound_ms([float(n) for n in range(1, 113)], 0.90) == 110.0, "LoadGen's log says that 2 of 112 are left out"


def test_verdicts_in_words() -> None:
    """At the limit is in time. 662 queries of a server may be late once, and two late ones are too many."""
    server = Load("server", seconds=2.0, limit_ms=100.0)
    assert verdict(server, [100.0] * 661 + [101.0], 2.0) == []
    late = verdict(server, [100.0] * 660 + [101.0, 102.0], 1.94)
    words = "2 of 662 queries took longer than 100 ms, too many for 99 % within it"
    assert late == ["it lasted 1.9 s, expected 2 s", words]
    assert verdict(server, [500.0] * 661, 2.0) == ["661 queries, expected 662 for the 99th percentile"]
    assert verdict(Load("offline", 1.0, limit_ms=1.0), [500.0] * 64, 1.0) == []


def test_latencies_make_a_scenarios_row() -> None:
    """Seventy queries, one a second, answered after 1 to 70 ms but the last after 80: 64 need 90 %, one may be late."""
    load = Load("single-stream", seconds=60.0)
    queries = Queries(asked_s=[float(n) for n in range(70)])
    queries.answered_s = [n + (n + 1) / 1000 for n in range(69)] + [69.08]
    row = scenario._row(load, queries, None)
    assert row == {
        **{"scenario": "single-stream", "judge": "trilane", "verdict": "VALID", "queries": 70, "because": ""},
        **{"seconds": pytest.approx(69.08), "rate": pytest.approx(70 / 69.08), "p50_ms": pytest.approx(35.5)},
        **{"percentile": 0.9, "percentile_ms": pytest.approx(80.0), "max_ms": pytest.approx(80.0)},
    }
    short = scenario._row(Load("single-stream", seconds=70.0), queries, None)
    assert (short["verdict"], short["because"]) == ("INVALID", "it lasted 69.1 s, expected 70 s")
    for valid, said in ((True, "VALID"), (False, "INVALID")):
        loadgen: Any = SimpleNamespace(valid=valid)
        row = scenario._row(Load("single-stream", seconds=70.0), queries, loadgen)
        assert (row["judge"], row["verdict"], row["because"]) == ("loadgen", said, "")


def test_every_scenario_is_asked_of_every_judge(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a run makes of its load is tested with processes."""
    requests: list[RunOptions] = []
    said = {"trilane": "", "loadgen": "its summary"}

    class Checked(SimpleNamespace):
        def changed(self, **_: Any) -> Any:
            return self

    told = Checked(assets={}, accuracy={"x": "its accuracy"}, config=SimpleNamespace(runtime="told"))
    monkeypatch.setattr(scenario, "configure", lambda request, _: requests.append(request) or told)
    monkeypatch.setattr(scenario, "load_generator", lambda: None)
    monkeypatch.setattr(scenario, "avatar_pipeline", lambda *_: "pipeline")
    monkeypatch.setattr(scenario, "run_scenario", lambda _pipeline, _assets, *asked: ({"row": asked}, said[asked[1]]))
    names, judges = ("offline", "server"), ("trilane", "loadgen")
    limits: dict[str, Any] = {"seconds": 3.0, "rate": 4.0, "limit_ms": 5.0, "samples": 6, "seed": 7}
    result = scenario.measure(scenario=names, judge=judges, avatar="x", edge="single", **limits)
    assert result == {
        "rows": [{"row": (Load(name, *limits.values()), judge, "pipelined")} for name in names for judge in judges],
        "summaries": {f"{name}, loadgen": "its summary" for name in names},
        "accuracy": {"x": "its accuracy"},
        "config": {"size": "256x256", "policy": "pipelined", "edge": "single", "runtime": "told", "seed": 7},
    }
    assert requests == [RunOptions(size="256x256", avatar="x", frames=1_000_000, runtime="auto")]


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


class LoadGen:
    """Stands for MLCommons' module: does what `during` says, keeps what is completed, and writes `summary`."""

    TestScenario = SimpleNamespace(SingleStream="single", MultiStream="multi", Server="server", Offline="offline")
    TestMode = SimpleNamespace(PerformanceOnly="performance")
    TestSettings = LogSettings = LogOutputSettings = SimpleNamespace

    def __init__(self) -> None:
        self.summary, self.completed, self.left = "Result is : VALID\n", list[Any](), {"system", "library"}
        self.during: Callable[[], object] = lambda: None

    def ConstructSUT(self, issue: Any, _flush: Any) -> str:  # noqa: N802 - its name
        self.issue = issue
        return "system"

    def ConstructQSL(self, *_: Any) -> str:  # noqa: N802 - its name
        return "library"

    def StartTestWithLogSettings(self, _system: str, _library: str, settings: Any, logs: Any) -> None:  # noqa: N802
        self.settings = settings
        self.during()
        (Path(logs.log_output.outdir) / "mlperf_log_summary.txt").write_text(self.summary, encoding="utf-8")

    def DestroyQSL(self, library: str) -> None:  # noqa: N802 - its name
        self.left.remove(library)

    DestroySUT = DestroyQSL

    def QuerySampleResponse(self, number: int, *_: int) -> int:  # noqa: N802 - its name
        return number

    def QuerySamplesComplete(self, responses: list[int]) -> None:  # noqa: N802 - its name
        self.completed += responses


class Frames:
    """Stands for a run: each frame that is asked for is answered at once, until `most` were."""

    def __init__(self, player: LoadGenPlayer, most: int = 1000) -> None:
        self._player, self._most, self.next = player, most, 0

    def request(self, count: int) -> None:
        for _ in range(min(count, self._most - self.next)):
            self.next += 1
            self._player.answered(self.next - 1)


@pytest.fixture
def loadgen(monkeypatch: pytest.MonkeyPatch) -> LoadGen:
    told = LoadGen()
    monkeypatch.setitem(sys.modules, "mlperf_loadgen", told)
    return told


def samples(*ids: int) -> list[Any]:
    return [SimpleNamespace(id=each) for each in ids]


@pytest.mark.parametrize(
    ("summary", "valid"),
    [("x\nResult is : VALID\n", True), ("Result is : INVALID\n", False), ("no such line", False)],
)
def test_loadgen_asks_and_judges(loadgen: LoadGen, summary: str, valid: bool) -> None:
    """Eight frames to warm up are nobody's sample; those after it are answered by their own ids."""
    loadgen.summary = summary
    player = LoadGenPlayer(Load("server", 1.5001, 20.0, 30.0, 5, 7), Queries())
    loadgen.during = lambda: (loadgen.issue(samples(70, 71)), loadgen.issue(samples(90)))
    frames = Frames(player)
    player.play(frames)  # type: ignore[arg-type]
    assert frames.next == 11 and loadgen.completed == [70, 71, 90] and not loadgen.left
    assert (player.valid, player.summary) == (valid, summary)
    assert len(player.queries.latencies_ms) == 3
    told = vars(loadgen.settings)
    assert (told["scenario"], told["min_duration_ms"], told["min_query_count"]) == ("server", 1501, 662)
    assert (told["server_target_qps"], told["server_target_latency_ns"]) == (20.0, 30_000_000)
    assert (told["multi_stream_samples_per_query"], told["schedule_rng_seed"]) == (5, 7)
    assert {value for key, value in told.items() if key.endswith("_percentile")} == {0.99}


@pytest.mark.parametrize(
    ("causes", "words"), [({}, "^the run ended before LoadGen had its answers$"), ({"a": 2}, "a 2")]
)
def test_samples_that_nobody_will_answer_are_completed_once(
    loadgen: LoadGen, causes: dict[str, int], words: str
) -> None:
    """Of four the first is answered; the run ends or drops a frame, and a later query is completed as it comes."""
    player = LoadGenPlayer(Load("offline", 1.0), Queries())

    def during() -> None:
        loadgen.issue(samples(1, 2, 3, 4))
        assert loadgen.completed == [1]
        if causes:
            player.unanswered(causes)
        else:
            player.ended()
        player.answered(9)
        player.ended()
        loadgen.issue(samples(5))

    loadgen.during = during
    with pytest.raises(TrilaneError, match=words):
        player.play(Frames(player, 9))  # type: ignore[arg-type]
    assert loadgen.completed == [1, 2, 3, 4, 5] and not loadgen.left


def test_without_loadgen_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mlperf_loadgen", None)
    with pytest.raises(MissingPartError, match=r"^LoadGen is not installed; .*loadgen"):
        load_generator()
