"""`bench pipeline`, with `--beside` and without: what it makes of runs whose figures are told, by hand."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import Pipe
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.bench import pipeline
from trilane.bench.pipeline import Asked, AvatarProcess, Ran, avatar_processes, serve
from trilane.errors import BadInputError, TrilaneError
from trilane.hw_profiles.host import host_units, usable_cores
from trilane.pipeline.result import Failure
from trilane.pipeline.run_metrics import StageTimes, TimeSummary
from trilane.scheduler.events import Settings, chain
from trilane.scheduler.ledger import JobRecord
from trilane.scheduler.placement import SCHEDULER_NS
from trilane.scheduler.recording import Recording
from trilane.scheduler.virtual import simulate
from trilane.stages.run_options import RunOptions

MS = 1_000_000


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
        units={"host": SimpleNamespace(busy=0.3), "gpu": SimpleNamespace(busy=0.6)},
    )
    jobs = [("gpu", 0, 0, 0, 10), ("gpu", 14, 17, 20, 50), ("host", 0, 0, 30, 40)]
    told = {
        "report": report,
        "recording": Recording(chain((("pose", "host"), ("raster", "gpu")), "double", "raster"), Settings(20)),
        "jobs": [JobRecord("raster", unit, 0, *instants) for unit, *instants in jobs],
        **{"dropped": {"a": 2, "b": 3}, "lost": {"c": 1, "d": 6}, "presented": 20},
        **{"interrupted": False, "failure": None},
    }
    return SimpleNamespace(**told | changes)


@pytest.fixture
def configured(monkeypatch: pytest.MonkeyPatch) -> list[RunOptions]:
    asked: list[RunOptions] = []
    monkeypatch.setattr(pipeline, "configure", lambda request, _: asked.append(request) or ToldConfig(request))
    return asked


def test_a_rounds_runs_are_set_against_the_sequential_ones(
    monkeypatch: pytest.MonkeyPatch, configured: list[RunOptions]
) -> None:
    """Sequential frames of 20, 22 and 24 ms (hops 5, 7, 9), between them 10 ms pipelined. First round: gain 2.1, bound
    (15 + 6) / 10; second: 2.3 and (15 + 8) / 10. No step of theirs is recorded: no frame has a latency."""
    sequential = iter([20.0, 22.0, 24.0])
    asked: list[Any] = []

    def run_avatar(config: ToldConfig, _assets: str, *, policy: str, edge: str, pace_fps: float | None) -> Any:
        assert config.values["out_dir"].is_dir() and config.values["record"] is False
        asked.append((policy, edge, pace_fps, config.values["units"]))
        return result_of(policy, next(sequential) if policy == "sequential" else 10.0)

    monkeypatch.setattr(pipeline, "run_avatar", run_avatar)
    units = host_units(usable_cores())
    result = pipeline.measure(
        avatar=("x",), size=("64x64",), policy=("latest",), edge=("orphan",), frames=30, rounds=2, video=False
    )
    first, second = result["rows"]
    same = {
        **{"avatar": "x", "size": "64x64", "cores": len(usable_cores()), "dropped": 10, "lost": 14},
        **{"efficiency": 0.75, "slowest": "gpu", "busiest": "gpu", "alone_ms": 10.0, "all_alone_ms": 15.0},
        **{"idle": pytest.approx(10 / 50), "starved": pytest.approx(4 / 50), "undispatched": pytest.approx(3 / 50)},
        **{"overhead": pytest.approx(3 / 50), "in_run_over_alone": 1.0, "latency_p50_ms": None, "latency_p99_ms": None},
    }
    assert first == {
        **same,
        **{"policy": "sequential", "edge": "double", "fps": (50 + 1000 / 22) / 2, "frame_ms": 21.0, "hops_ms": 6.0},
        **{"gain": 1.0, "bound": pytest.approx((20 + 22) / 20), "gain_of_bound": pytest.approx((1 / 2 + 10 / 22) / 2)},
        **{"of_bound_low": pytest.approx(10 / 22), "of_bound_high": pytest.approx(10 / 20)},
    }
    assert second == {
        **same,
        **{"policy": "latest", "edge": "orphan", "fps": 100.0, "frame_ms": 10.0, "hops_ms": None},
        **{"gain": pytest.approx(2.2), "bound": pytest.approx((21 + 23) / 20), "gain_of_bound": pytest.approx(1.0)},
        **{"of_bound_low": pytest.approx(1.0), "of_bound_high": pytest.approx(1.0)},
    }
    assert result["accuracy"] == {"x": "accuracy of x"}
    assert result["config"] == {"frames": 30, "rounds": 2, "runtime": "told", "video": False}
    assert configured == [RunOptions(size="64x64", avatar="x", frames=30, runtime="auto")]
    one, other = ("sequential", "double", None, units), ("latest", "orphan", 1.25 * 1000 / 10, units)
    assert asked == [one, other, one, other, one]


def test_every_avatar_size_and_number_of_cores_is_measured(
    monkeypatch: pytest.MonkeyPatch, configured: list[RunOptions]
) -> None:
    monkeypatch.setattr(pipeline, "run_avatar", lambda *_, policy, **__: result_of(policy, 20.0))
    monkeypatch.setattr(pipeline.networks, "full_width_bundle", lambda: Path("/made"))
    monkeypatch.setattr(pipeline, "usable_cores", lambda: (4, 6, 7))
    result = pipeline.measure(avatar=("x", "resnet18"), size=("32x32", "64x64"), cores=(0, 2), rounds=1, frames=20)
    order = [(a, size, n) for a in ("x", "resnet18") for size in ("32x32", "64x64") for n in (3, 2)]
    found = [(row["avatar"], row["size"], row["cores"]) for row in result["rows"]]
    assert found == [each for each in order for _ in range(2)]
    assert [request.avatar for request in configured] == ["x"] * 4 + ["/made"] * 4
    assert [*result["accuracy"]] == [f"{name} at {size}" for name in ("x", "resnet18") for size in ("32x32", "64x64")]
    for bad in ((4,), (0, 5), (-1,)):
        with pytest.raises(BadInputError, match=r"numbers from 1 to the 3 that this process may use"):
            pipeline.measure(cores=bad)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"frames": 19}, "expected at least 20 and 1"),
        ({"rounds": 0}, "expected at least 20 and 1"),
        ({"policy": ("best",)}, "--policy"),
        ({"edge": ("quadruple",)}, "--edge"),
        ({"size": ("63x64",)}, "size: found side 63"),
        ({"beside": "hiker", "avatar": ("default", "dancer")}, "--avatar: found 2 values with --beside, expected one"),
        ({"beside": "hiker", "edge": ("single", "double")}, "--edge: found 2 values"),
        ({"beside": "hiker", "policy": ("latest",)}, "--policy: found latest with --beside, expected pipelined"),
    ],
)
def test_what_cannot_be_measured_is_refused(asked: dict[str, Any], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        pipeline.measure(**asked)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"interrupted": True}, KeyboardInterrupt, "^$"),
        ({"failure": Failure("a stage failed")}, TrilaneError, "policy='sequential'.*: a stage failed"),
        ({"presented": 1}, TrilaneError, "1 of at least 2 frames were presented"),
    ],
)
@pytest.mark.usefixtures("configured")
def test_a_run_that_fails_ends_the_bench(
    monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], error: type[BaseException], message: str
) -> None:
    monkeypatch.setattr(pipeline, "run_avatar", lambda *_, **__: result_of("sequential", 20.0, **changes))
    with pytest.raises(error, match=message):
        pipeline.measure(rounds=1)


def test_idle_between_jobs_by_hand() -> None:
    """0-10 a job; the next input comes at 14 (starved 4), is dispatched at 17 (3) and begun at 20 (overhead 3); the
    last one's was there and it is dispatched at once, but begins at 41: overhead 1. Span 50, idle 11."""
    times = ((14, 17, 20, 40), (0, 0, 0, 10), (5, 6, 41, 50))
    assert pipeline.idle_between_jobs([JobRecord("infer", "dsp", 0, *each) for each in times]) == pytest.approx(
        {"idle": 11 / 50, "starved": 4 / 50, "undispatched": 3 / 50, "overhead": 4 / 50}
    )


def test_runs_are_compared_with_the_sequential_ones_before_and_after() -> None:
    """Sequential frames of 30 and 34 ms, hops 2 and 4, in which b takes 9 and 11 and a 10: gain 32 / 16 = 2, bound
    (20 + 3) / 10, of the bound 2 / 2.3. The sequential run beside itself alone: 19 and 2 over 10."""
    base = {"frame_ms": 30.0, "hops_ms": 2.0, "units_ms": {"a": 10.0, "b": 9.0}}
    row = {"frame_ms": 16.0, "hops_ms": None, "units_ms": {"a": 12.0, "b": 9.0}}
    after = {"frame_ms": 34.0, "hops_ms": 4.0, "units_ms": {"a": 10.0, "b": 11.0}}
    pipeline._compare([base, row], after)
    assert (row["gain"], row["bound"], row["gain_of_bound"]) == pytest.approx((2.0, 2.3, 2 / 2.3))
    assert (row["slowest"], row["alone_ms"], row["all_alone_ms"], row["in_run_over_alone"]) == ("a", 10, 20, 1.2)
    assert (base["gain"], base["bound"]) == pytest.approx((1.0, 2.1))


def test_a_row_is_medians_sums_and_the_commonest_name() -> None:
    """Latencies: 50th and 51st of those from 6 ms on, and rank 0.99 * 299, which is 96.01 of those from 9 ms on."""

    def run(fps: float, slowest: str, lost: int) -> dict[str, Any]:
        latencies = [round(fps * 1e6) + 1000 * k for k in range(100)]
        row = {"fps": fps, "slowest": slowest, "lost": lost, "hops_ms": None, "gain_of_bound": fps / 10}
        return row | {"latencies_ns": latencies}

    setting = pipeline.Setting("default", "256", 2, "pipelined", "double")
    row = pipeline._summary(setting, [run(5.0, "gpu", 1), run(9.0, "dsp", 2), run(6.0, "gpu", 4)])
    assert row == vars(setting) | {
        **{"fps": 6.0, "slowest": "gpu", "lost": 7, "hops_ms": None},
        **{"gain_of_bound": 0.6, "of_bound_low": 0.5, "of_bound_high": 0.9},
        **{"latency_p50_ms": pytest.approx(6.0495), "latency_p99_ms": pytest.approx(9.09601)},
    }
    few = pipeline._summary(setting, [run(5.0, "gpu", 1), run(9.0, "dsp", 2)])
    assert (few["latency_p50_ms"], few["latency_p99_ms"]) == (pytest.approx(7.0495), None)


def test_latency_is_from_the_pose_to_the_composited_picture() -> None:
    """A pose of 3, a picture of 5, and 2 to present it, one frame at a time."""
    took = {"pose": 3, "composite": 5, "present": 2}
    graph = chain((("pose", "u"), ("composite", "v"), ("present", "u")), "double", "composite")
    run = simulate(graph, Settings(3, "sequential"), lambda stage, *_: took[stage], keep=True)
    assert run.recording is not None
    assert pipeline.latencies_ns(run.recording, run.jobs) == [8, 8, 8]


def test_sequential_comes_first_and_once() -> None:
    pairs = pipeline._pairs(("sequential", "pipelined"), ("double", "single"))
    assert pairs == [(p, e) for p in ("sequential", "pipelined") for e in ("double", "single")]


def test_what_a_unit_takes_is_without_the_time_in_which_it_had_no_core() -> None:
    """Two poses of 3 ms in the mean, of which one lacked its core for 2 ms."""

    def stage(unit: str, mean: float) -> StageTimes:
        times = TimeSummary(mean=mean, p50=mean, p90=mean, p95=mean, p99=mean, max=mean)
        return StageTimes(unit=unit, service_ms=times, wait_ms=times)

    stages = {"pose": stage("cpu", 3.0), "raster": stage("gpu", 5.0), "present": stage("cpu", 2.0)}
    jobs = tuple(JobRecord("pose", "cpu", n, 0, 0, 0, 9, preempted_ns=n * 2_000_000) for n in range(2))
    result: Any = SimpleNamespace(report=SimpleNamespace(units={"cpu": None, "gpu": None}, stages=stages), jobs=jobs)
    assert pipeline._units_ms(result) == {"cpu": 4.0, "gpu": 5.0}


#: Milliseconds of each stage; the first has less, for what the scheduler takes counts with it.
STAGES = {"pose": 1.5, "raster": 3, "infer": 4, "composite": 2, "present": 1}
UNITS = {"pose": "cpu", "raster": "gpu", "infer": "dsp", "composite": "gpu", "present": "cpu"}
ONE_CORE = dict.fromkeys(("cpu", "gpu", "dsp"), "0")
ASKED = Asked("default", "64x64", 20, "ort", (0,), video=True, edge="single")


def run_of(frame_ms: float, waits_ms: float = 0.0, frames: int = 11, begin_ms: float = 0.0) -> Ran:
    """A run whose frames are presented every so many ms; each job waits for its core so long."""
    jobs = []
    for frame in range(frames):
        for stage, ms in STAGES.items():
            end_ns = round((begin_ms + (frame + 1) * frame_ms) * MS)
            begin_ns = end_ns - round((ms + waits_ms) * MS)
            jobs.append(JobRecord(stage, UNITS[stage], frame, 0, 0, begin_ns, end_ns, round(waits_ms * MS)))
    return Ran(tuple(jobs), ONE_CORE)


def told(runs: Sequence[dict[str, list[Ran]]]) -> Any:
    """Processes that answer with these runs, by their policies."""

    class Process:
        def __init__(self, own: dict[str, list[Ran]]) -> None:
            self.runs, self.policy = own, ""

        def begin(self, policy: str) -> None:
            self.policy = policy

        def result(self) -> Ran:
            return self.runs[self.policy].pop(0)

    @contextmanager
    def processes(_: Sequence[Asked]) -> Iterator[list[Process]]:
        yield [Process(each) for each in runs]

    return processes


def test_two_runs_on_one_core_are_set_against_twice_the_work_of_a_frame() -> None:
    """Both need 12 ms of one core for a frame, which is never idle: 24 ms a frame each. Measured: 26.4 and 21.6 ms."""
    assert len(STAGES) * SCHEDULER_NS == 0.5 * MS
    runs = [{"sequential": [run_of(12), run_of(12)], "pipelined": [run_of(frame_ms)]} for frame_ms in (26.4, 21.6)]
    first, second = pipeline.measure_beside([ASKED, ASKED], 1, told(runs))
    assert first["virtual_ms"] == pytest.approx(24, rel=0.01)
    assert (first["ratio"], second["ratio"]) == pytest.approx((1.1, 0.9), rel=0.01)
    assert first["isolated_ms"] == pytest.approx(11.5)
    assert (first["pipeline"], second["pipeline"], first["size"], first["strangers"]) == (1, 2, "64x64", 0)


def test_waits_for_a_core_are_no_work_and_say_how_quiet_the_machine_was() -> None:
    runs = [{"sequential": [run_of(30, waits_ms=2.3)] * 2, "pipelined": [run_of(24)]} for _ in range(2)]
    row, _ = pipeline.measure_beside([ASKED, ASKED], 1, told(runs))
    assert (row["isolated_ms"], row["strangers"]) == pytest.approx((11.5, 5 * 2.3 / 11.5))


def test_a_row_is_the_median_of_its_rounds() -> None:
    """Each round's stages are those of the sequential runs before and after it."""
    runs = [{"sequential": [run_of(12)] * 4, "pipelined": [run_of(ms) for ms in (24, 48, 25)]} for _ in range(2)]
    row, _ = pipeline.measure_beside([ASKED, ASKED], 3, told(runs))
    assert row["frame_ms"] == 25
    assert (row["ratio_low"], row["ratio_high"]) == pytest.approx((1, 2), rel=0.01)


def test_only_the_time_in_which_both_ran_counts() -> None:
    """The second begins 50 ms later: of the first 11 frames of 10 ms those from 60 to 110 ms count."""
    assert pipeline.overlapping_ms([run_of(10).jobs, run_of(20, begin_ms=40).jobs]) == [10, 20]
    with pytest.raises(TrilaneError, match="met for 1 frames"):
        pipeline.overlapping_ms([run_of(10).jobs, run_of(10, begin_ms=100).jobs])
    with pytest.raises(TrilaneError, match="presented no frame"):
        pipeline.overlapping_ms([run_of(10).jobs, ()])


def test_the_command_asks_for_both_avatars(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "measure_beside", lambda *asked: [asked])
    result = pipeline.measure(
        **{"size": ("256",), "frames": 30, "rounds": 2, "cores": (1,), "edge": ("single",), "video": False},
        **{"beside": "default", "beside_size": "64"},  # type: ignore[arg-type]
    )
    asked = [Asked("default", size, 30, "auto", usable_cores()[:1], False, "single") for size in ("256", "64")]
    assert result["rows"] == [(asked, 2)]
    assert result["config"] == {"frames": 30, "rounds": 2, "runtime": "auto", "video": False, "cores": 1}


JOBS = (JobRecord("pose", "cpu", 0, 1, 2, 3, 4), JobRecord("infer", "dsp", 0, 4, 5, 6, 7))


def test_a_run_is_begun_by_its_policy_and_answered_with_its_jobs() -> None:
    ours, theirs = Pipe()
    process = AvatarProcess(ours, "default at 64x64")
    process.begin("pipelined")
    assert theirs.recv() == "pipelined"
    theirs.send(([tuple(job) for job in JOBS], {"cpu": "3"}))
    assert process.result() == Ran(JOBS, {"cpu": "3"})
    theirs.send("no driver")
    with pytest.raises(TrilaneError, match=r"^default at 64x64: no driver$"):
        process.result()
    with pytest.raises(TrilaneError, match=r"^default at 64x64: no answer in 0\.001 s$"):
        process.receive(0.001)
    theirs.close()
    with pytest.raises(TrilaneError, match=r"^default at 64x64: its process ended$"):
        process.result()


class ToldPipe:
    """Hands out `policies`, then is closed."""

    def __init__(self, *policies: str) -> None:
        self.policies, self.sent = list(policies), list[Any]()

    def recv(self) -> str:
        if not self.policies:
            raise EOFError
        return self.policies.pop(0)

    def send(self, what: Any) -> None:
        self.sent.append(what)


@pytest.mark.parametrize(
    ("policy", "said"), [("pipelined", None), ("fails", "the gpu died"), ("raises", "ValueError: of the run")]
)
def test_the_process_runs_under_each_policy_until_its_pipe_closes(
    policy: str, said: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that fails is its last."""
    requests: list[RunOptions] = []

    class Checked(ToldConfig):
        def __init__(self, request: RunOptions, **values: Any) -> None:
            super().__init__(request, **values)
            self.units = values.get("units", {})

        def changed(self, **values: Any) -> Checked:
            return Checked(self.request, **{**self.values, **values})

    def run_avatar(config: Any, _assets: str, *, policy: str, edge: str) -> Any:
        assert config.values["record"] and config.values["out_dir"].is_dir() and edge == "single"
        if policy == "raises":
            raise ValueError("of the run")
        return SimpleNamespace(failure=Failure("the gpu died") if policy == "fails" else None, jobs=list(JOBS))

    monkeypatch.setattr(pipeline, "configure", lambda request, _: requests.append(request) or Checked(request))
    monkeypatch.setattr(pipeline, "run_avatar", run_avatar)
    pipe: Any = ToldPipe("sequential", policy, "sequential")
    serve(pipe, replace(ASKED, cores=(3, 5)))
    answer = [tuple(job) for job in JOBS], {"cpu": "3", "gpu": "3", "dsp": "5"}
    assert pipe.sent == [True, answer, *([answer] * 2 if said is None else [said])]
    assert requests == [RunOptions(avatar="default", size="64x64", frames=20, runtime="ort")]


def test_a_process_that_cannot_run_its_avatar_says_so_and_ends() -> None:
    nobody = replace(ASKED, avatar="nobody")
    with pytest.raises(TrilaneError, match=r"^nobody at 64x64: BadInputError: .*nobody"), avatar_processes([nobody]):
        pass
    assert not multiprocessing.active_children()
