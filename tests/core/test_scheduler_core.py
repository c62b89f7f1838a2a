"""The core and its drivers on the pipeline of the avatar: policies, accounts, determinism, purity."""

from __future__ import annotations

import ast
import random
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

import trilane.scheduler
from trilane.errors import BadInputError
from trilane.hw_profiles.application import application_graph
from trilane.scheduler.core import Core
from trilane.scheduler.events import (
    FrameRequest,
    Graph,
    JobDone,
    Kill,
    Outcome,
    OutcomeKind,
    Pinged,
    Pong,
    SchedulerStalled,
    SetDuty,
    Settings,
    StageSpec,
    Stop,
    UnitDied,
    UnitReady,
)
from trilane.scheduler.recording import read, replay
from trilane.scheduler.stats import energy_score
from trilane.scheduler.virtual import Service, Simulation, simulate

MS = 1_000_000
SERVICE_MS = {"pose": 0.3, "raster": 4.0, "infer": 16.0, "composite": 2.0, "present": 3.0}
FRAMES = 200
PURE = (
    "assignment",
    "core",
    "events",
    "flow",
    "frame_source",
    "ledger",
    "policy",
    "state",
    "stats",
    "work_ladder",
)
#: What of the lower layers the core may import.
PURE_BELOW = ("trilane.transport.slots", "trilane.unexpected_value", "trilane.units")


def service(stage: str, _unit: str, _frame: int, _begin_ns: int) -> int:
    return int(SERVICE_MS[stage] * MS)


def uneven(stage: str, unit: str, frame: int, begin_ns: int) -> int:
    return service(stage, unit, frame, begin_ns) * (50 + random.Random(f"{stage} {frame}").randrange(100)) // 100


def run(policy: str = "pipelined", edge: str = "double", times: Service = service, **more: object) -> Simulation:
    settings = {"period_ns": 10 * MS, "deadline_ns": 60 * MS} if policy in ("latest", "deadline") else {}
    driver = {
        key: more.pop(key) for key in ("faults", "inputs", "message_delay_ns", "restart_ns", "keep") if key in more
    }
    return simulate(application_graph(edge), Settings(FRAMES, policy, **{**settings, **more}), times, **driver)


def busy_slowest(report: Mapping[str, Any]) -> float:
    """The work of the slowest unit, the DSP's, for a frame over the frame time."""
    return SERVICE_MS["infer"] / float(report["frame_time_ms"]["mean"])


def test_sequential_takes_the_sum_of_all_stages() -> None:
    report = run("sequential").report
    assert report["frame_time_ms"]["mean"] == pytest.approx(sum(SERVICE_MS.values()))
    assert report["latency_ms"]["max"] == pytest.approx(sum(SERVICE_MS.values()) - SERVICE_MS["present"])


@pytest.mark.parametrize("edge", ["double", "fifo:4"])
def test_pipelined_keeps_the_slowest_unit_busy(edge: str) -> None:
    report = run(edge=edge, message_delay_ns=MS // 10).report
    assert busy_slowest(report) == pytest.approx(1)
    assert report["units"]["dsp"]["busy"] > 0.99
    assert report["frames"]["presented"] == FRAMES


def test_without_dispatch_ahead_the_hops_would_show() -> None:
    """With one slot per edge nothing can be held, so each frame pays for the stages around the network."""
    assert busy_slowest(run(edge="single").report) < 0.8


def test_latest_presents_at_the_pace_of_the_slowest_and_drops_the_rest() -> None:
    report = run("latest", "triple").report
    frames = report["frames"]
    assert busy_slowest(report) == pytest.approx(1, abs=0.01)
    assert frames["presented"] + sum(frames["dropped"].values()) == FRAMES
    assert report["latency_ms"]["max"] < run(period_ns=10 * MS).report["latency_ms"]["max"] * 0.6


@pytest.mark.parametrize("edge", ["single", "double", "triple", "fifo:4", "orphan"])
def test_deadline_presents_hardly_anything_late_and_little_less_than_can_be(edge: str) -> None:
    report = run("deadline", edge).report
    best = 1e3 / SERVICE_MS["infer"] if edge != "single" else 40
    assert report["deadline_misses"] <= 0.03 * FRAMES
    assert report["fps"] > 0.9 * best


def test_deadline_drops_nothing_when_there_is_time() -> None:
    report = run("deadline", period_ns=33 * MS, deadline_ns=99 * MS).report
    assert report["frames"]["presented"] == FRAMES
    assert report["fps"] == pytest.approx(1e3 / 33)


def test_one_slow_job_does_not_drop_frames_for_ever() -> None:
    def slow_once(stage: str, unit: str, frame: int, begin_ns: int) -> int:
        return 500 * MS if (stage, frame) == ("infer", 5) else service(stage, unit, frame, begin_ns)

    frames = run("deadline", times=slow_once, period_ns=33 * MS, deadline_ns=99 * MS).report["frames"]
    assert frames["presented"] > 0.7 * FRAMES


@pytest.mark.parametrize("policy", ["sequential", "pipelined", "latest", "deadline"])
@pytest.mark.parametrize("edge", ["single", "double", "triple", "fifo:3", "orphan"])
def test_every_account_adds_up(policy: str, edge: str) -> None:
    report = run(policy, edge, uneven, message_delay_ns=MS // 20, faults=[(300 * MS, "dsp"), (700 * MS, "cpu")]).report
    frames = report["frames"]
    assert frames["presented"] + frames["lost"] + sum(frames["dropped"].values()) == FRAMES
    for row in report["units"].values():
        parts = [row["busy"], *row["idle"].values()]
        assert sum(parts) == pytest.approx(1)
        assert min(parts) >= 0


def test_a_limit_of_frames_in_flight_bounds_latency_and_shows_as_blocked() -> None:
    free, limited = run(), run(in_flight=3)
    assert limited.report["latency_ms"]["p50"] < free.report["latency_ms"]["p50"] * 0.8
    assert limited.report["units"]["cpu"]["idle"]["blocked"] > 0.5


def test_a_queue_limit_and_a_timeout_turn_frames_away() -> None:
    dropped = run(period_ns=5 * MS, in_queue=4, in_flight=3).report["frames"]["dropped"]
    assert set(dropped) == {"source->pose:queue_full"}
    dropped = run(period_ns=5 * MS, queue_timeout_ns=40 * MS, in_flight=3).report["frames"]["dropped"]
    assert set(dropped) == {"source->pose:timeout"}


def test_arrivals_are_kept() -> None:
    arrivals = tuple(index * index * MS for index in range(FRAMES))
    jobs = run(arrivals_ns=arrivals, keep=True).jobs
    poses = {record.frame: record.begin_ns for record in jobs if record.stage == "pose"}
    assert all(poses[frame] >= arrivals[frame] for frame in poses)
    assert poses[FRAMES - 1] == arrivals[-1]


def test_frames_are_released_when_they_are_asked_for_and_no_more_than_there_are() -> None:
    inputs = [(1 * MS, FrameRequest(1)), (500 * MS, FrameRequest(3)), (2000 * MS, FrameRequest(FRAMES))]
    result = run(asked=True, inputs=inputs, keep=True)
    begins = [record.begin_ns // MS for record in result.jobs if record.stage == "pose"]
    assert begins[:2] == [1, 500]
    assert begins[4] == 2000
    assert result.report["frames"]["presented"] == FRAMES
    assert result.outcome == Outcome(OutcomeKind.DONE)


def test_a_run_that_nobody_asks_of_ends_when_it_is_told() -> None:
    result = run(asked=True, inputs=[(1 * MS, FrameRequest(2)), (900 * MS, Stop())])
    assert (result.report["frames"]["presented"], result.outcome) == (2, Outcome(OutcomeKind.STOPPED))


def test_a_late_pose_is_newer_and_costs_no_frame() -> None:
    early, late = run(times=uneven), run(times=uneven, latch_ns=3 * MS)
    assert late.report["latency_ms"]["p50"] < early.report["latency_ms"]["p50"] * 0.85
    assert late.report["fps"] > early.report["fps"] * 0.99
    assert late.report["units"]["cpu"]["idle"]["blocked"] > 0


def test_a_late_pose_waits_for_nobody_who_is_gone() -> None:
    result = run(latch_ns=2 * MS, faults=[(300 * MS, "gpu"), (900 * MS, "cpu")], restart_ns=50 * MS)
    assert result.outcome == Outcome(OutcomeKind.DONE)
    assert result.report["frames"]["presented"] + result.report["frames"]["lost"] == FRAMES


def test_the_score_of_a_run_falls_with_lateness_and_with_drops() -> None:
    slow, fast = (run(period_ns=period * MS, deadline_ns=3 * period * MS).report["xrbench"] for period in (1, 1000))
    assert fast == {"real_time": pytest.approx(1), "qoe": 1, "energy": None}
    assert slow["real_time"] < 0.1
    dropped = run(period_ns=5 * MS, deadline_ns=10_000 * MS, in_queue=4, in_flight=3).report
    assert dropped["xrbench"]["qoe"] == pytest.approx(dropped["frames"]["presented"] / FRAMES)


def test_the_energy_score_falls_to_0_at_xrbenchs_limit() -> None:
    assert [energy_score(mj) for mj in (0, 750, 1500, 9000)] == [1, 0.5, 0, 0]


def test_a_duty_cycle_throttles_a_unit() -> None:
    report = run(inputs=[(0, SetDuty("dsp", 500))]).report
    assert report["frame_time_ms"]["mean"] == pytest.approx(2 * SERVICE_MS["infer"], rel=0.01)
    assert report["units"]["dsp"]["idle"]["throttled"] == pytest.approx(0.5, abs=0.02)


def test_stop_finishes_what_is_in_flight() -> None:
    result = run(inputs=[(500 * MS, Stop())])
    assert result.outcome == Outcome(OutcomeKind.STOPPED)
    assert 0 < result.report["frames"]["presented"] < FRAMES
    assert result.report["frames"]["lost"] == 0


def test_a_unit_that_dies_costs_the_frame_it_worked_on() -> None:
    result = run(faults=[(508 * MS, "dsp")], keep=True)
    assert result.report["frames"]["lost_by_cause"] == {"died:dsp": 1}
    assert result.report["frames"]["presented"] == FRAMES - 1
    assert result.report["units"]["dsp"]["restarts"] == 1
    assert max(step[0] for step in result.recording.steps) > 1500 * MS


def test_a_unit_that_hangs_is_killed_and_restarted() -> None:
    def hangs(stage: str, unit: str, frame: int, begin_ns: int) -> int:
        return 10**15 if (stage, frame) == ("infer", 7) else service(stage, unit, frame, begin_ns)

    frames = run(times=hangs, hang_ns=1000 * MS).report["frames"]
    assert frames["lost_by_cause"] == {"hung:dsp": 1}
    assert frames["presented"] == FRAMES - 1


def test_a_unit_that_keeps_dying_ends_the_run() -> None:
    def never(stage: str, unit: str, frame: int, begin_ns: int) -> int:
        return 10**15 if stage == "infer" else service(stage, unit, frame, begin_ns)

    result = run(times=never, hang_ns=100 * MS, max_failures=3)
    assert result.outcome == Outcome(OutcomeKind.GAVE_UP, "dsp")
    frames = result.report["frames"]
    assert frames["presented"] == 0
    assert frames["lost_by_cause"]["hung:dsp"] == 4


def test_equal_inputs_give_equal_runs() -> None:
    runs = [run("deadline", "fifo:3", uneven, keep=True, faults=[(400 * MS, "gpu")]) for _ in range(10)]
    assert all(other == runs[0] for other in runs)


def test_a_recording_replays_and_a_changed_one_does_not(tmp_path: Path) -> None:
    recording = run("latest", "triple", uneven, keep=True, faults=[(400 * MS, "gpu")]).recording
    recording.write(tmp_path / "events.jsonl")
    again = read(tmp_path / "events.jsonl")
    assert again == recording
    assert not list(replay(again))
    del again.steps[40]
    assert list(replay(again))


@pytest.mark.parametrize("text", ["", "{}\n", "[1]\n", "\x00", '{"graph": 1}\n'])
def test_a_file_that_is_no_recording_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "events.jsonl"
    path.write_text(text)
    with pytest.raises(BadInputError, match=r"events\.jsonl, line 1"):
        read(path)


def test_a_recording_of_another_schema_is_not_replayed(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    run("pipelined", keep=True).recording.write(path)
    path.write_text(path.read_text().replace('"schema": 7', '"schema": 6', 1))
    with pytest.raises(BadInputError, match=r"line 1: found schema 6; this Trilane reads 7"):
        read(path)


def event(fields: str) -> str:
    """A line of one event."""
    return f'{{"t": 9000000000000, "events": [{{{fields}}}], "actions": []}}'


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ('{"t": "abc", "events": [], "actions": []}', "time 'abc'"),
        ('{"t": -1, "events": [], "actions": []}', "time -1"),
        ('{"t": 9e9, "events": [], "actions": []}', "time"),
        (event('"event": "Kill", "unit": "dsp"'), "'Kill', expected one of UnitReady"),
        (event('"event": "UnitDied", "unit": 1'), "expected fields of str"),
        (event('"event": "UnitDied"'), "UnitDied with event, expected event, unit"),
        (event('"event": "UnitDied", "unit": "dsp", "job": 1'), "UnitDied with event, unit, job, expected event, unit"),
        (event('"event": ["UnitDied"], "unit": "dsp"'), "expected one of UnitReady"),
        (event('"unit": "dsp"'), "found 'event'"),
        ('{"t": 9000000000000, "events": ["UnitDied"], "actions": []}', "string indices"),
        (
            '{"t": 9000000000000, "events": [], "actions": [{"action": "Kill"}]}',
            "Kill with action, expected action, unit",
        ),
        ("[" * 100_000, "line 4"),
        ('{"t": 9', "line 4"),
    ],
)
def test_a_line_that_is_no_step_is_named(tmp_path: Path, row: str, said: str) -> None:
    path = tmp_path / "events.jsonl"
    run("pipelined", keep=True).recording.write(path)
    path.write_text("\n".join([*path.read_text().splitlines()[:3], row]))
    with pytest.raises(BadInputError, match=r"events\.jsonl, line 4") as refused:
        read(path)
    assert said in str(refused.value)


def test_events_of_a_unit_that_there_is_not_are_not_replayed() -> None:
    recording = run("pipelined", keep=True).recording
    now_ns, _, actions = recording.steps[5]
    recording.steps[5] = (now_ns, (UnitDied("npu"),), actions)
    with pytest.raises(BadInputError, match="npu"):
        list(replay(recording))


def test_a_core_that_was_left_alone_gives_its_units_as_much_longer() -> None:
    core = Core(application_graph(), Settings(10, "sequential", hang_ns=100))
    core.step(0, tuple(UnitReady(unit) for unit in ("cpu", "gpu", "dsp")))
    core.step(10, (Pinged("dsp"),))
    assert core.step(1050, (SchedulerStalled(1000),)).actions == ()
    assert core.step(1100).actions == (Kill("cpu"),)
    assert core.step(1110).actions == (Kill("dsp"),)


def test_only_a_question_that_nobody_answers_costs_an_idle_unit_its_life() -> None:
    """The DSP and the CPU have nothing to do while the GPU's job runs; both are asked, one answers."""
    core = Core(application_graph(), Settings(10, "sequential", hang_ns=100))
    (pose,) = core.step(0, tuple(UnitReady(unit) for unit in ("cpu", "gpu", "dsp"))).actions
    core.step(10, (JobDone("cpu", pose.job.id, 0, 10, 0),))
    core.step(20, (Pinged("cpu"), Pinged("dsp")))
    core.step(30, (Pong("cpu"), Pong("gpu")))
    decision = core.step(109)
    assert (decision.actions, decision.next_deadline_ns) == ((), 110)
    assert core.step(110).actions == (Kill("gpu"),)
    assert core.step(120).actions == (Kill("dsp"),)
    assert core.step(100_000).actions == ()


def test_settings_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="found policy"):
        Core(application_graph(), Settings(1, "fastest"))
    with pytest.raises(ValueError, match="needs a period"):
        Core(application_graph(), Settings(1, "latest"))
    with pytest.raises(ValueError, match="found edge"):
        Core(application_graph("quad"), Settings(1))
    with pytest.raises(ValueError, match="different names"):
        Graph((StageSpec("a", "cpu"), StageSpec("a", "cpu")), ("double",), "a")
    with pytest.raises(ValueError, match="latency to"):
        Graph((StageSpec("a", "cpu"),), (), "b")


@pytest.mark.parametrize("module", [*(f"trilane.scheduler.{name}" for name in PURE), *PURE_BELOW])
def test_the_core_knows_no_clock_and_does_no_io(module: str) -> None:
    path = Path(trilane.__file__).parent / Path(*module.split(".")[1:]).with_suffix(".py")
    tree = ast.parse(path.read_text())
    names = [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    ours = {f"trilane.scheduler.{name}" for name in PURE} | {"trilane.scheduler", *PURE_BELOW}
    for name in names:
        assert name in ours or name.split(".")[0] in sys.stdlib_module_names
        assert name.split(".")[0] not in {"time", "datetime", "os", "io", "socket", "pathlib", "random", "threading"}
    calls = {node.func.id for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
    assert not calls & {"open", "print", "input"}
