"""The core and its drivers on the pipeline of the avatar: policies, accounts, determinism, purity."""

from __future__ import annotations

import ast
import random
import sys
from pathlib import Path

import pytest

import trilane.scheduler
from trilane.errors import BadInputError
from trilane.hw_profiles.application import application_graph
from trilane.scheduler.core import Core, run_loop
from trilane.scheduler.events import (
    NEVER,
    Abort,
    Action,
    Dispatch,
    Event,
    Finish,
    FrameRequest,
    JobDone,
    Kill,
    Outcome,
    OutcomeKind,
    Pinged,
    Pong,
    SchedulerStalled,
    Settings,
    StageAlone,
    Stop,
    UnitDied,
    UnitReady,
    chain,
)
from trilane.scheduler.recording import Recording, read, replay
from trilane.scheduler.virtual import Service, Simulation, simulate

MS = 1_000_000
SERVICE_MS = {"pose": 0.3, "raster": 4.0, "infer": 16.0, "composite": 2.0, "present": 3.0}
FRAMES = 200
PURE = (
    "assignment",
    "core",
    "events",
    "flow",
    "ledger",
    "policy",
    "state",
    "stats",
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


def test_frames_are_released_when_they_are_asked_for_and_no_more_than_there_are() -> None:
    inputs = [(1 * MS, FrameRequest(1)), (500 * MS, FrameRequest(3)), (2000 * MS, FrameRequest(FRAMES))]
    result = run(asked=True, inputs=inputs, keep=True)
    begins = [record.begin_ns // MS for record in result.jobs if record.stage == "pose"]
    assert begins[:2] == [1, 500]
    assert begins[4] == 2000
    assert result.report["frames"]["presented"] == FRAMES
    assert result.outcome == Outcome(OutcomeKind.DONE)


def test_a_late_pose_is_newer_and_costs_no_frame() -> None:
    early, late = run(times=uneven), run(times=uneven, latch_ns=3 * MS)
    assert late.report["latency_ms"]["p50"] < early.report["latency_ms"]["p50"] * 0.85
    assert late.report["fps"] > early.report["fps"] * 0.99
    assert late.report["units"]["cpu"]["idle"]["blocked"] > 0


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


DONE = '{"action":"Finish","kind":"done","unit":""}'


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"schema": 7', '"schema": 6', r"line 1: found schema 6; this Trilane reads 7"),
        (DONE, DONE.replace("done", "bored"), "bored"),
    ],
)
def test_a_recording_with_a_strange_word_is_not_read(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "events.jsonl"
    run(keep=True).recording.write(path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(BadInputError, match=said):
        read(path)


def line(fields: str) -> str:
    """A line of one event."""
    return f'{{"t": 9000000000000, "events": [{{{fields}}}], "actions": []}}'


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ('{"t": "abc", "events": [], "actions": []}', "time 'abc'"),
        ('{"t": -1, "events": [], "actions": []}', "time -1"),
        ('{"t": 9e9, "events": [], "actions": []}', "time"),
        (line('"event": "Kill", "unit": "dsp"'), "'Kill', expected one of UnitReady"),
        (line('"event": "UnitDied", "unit": 1'), "expected fields of str"),
        (line('"event": "UnitDied"'), "UnitDied with event, expected event, unit"),
        (line('"event": "UnitDied", "unit": "dsp", "job": 1'), "UnitDied with event, unit, job, expected event, unit"),
        (line('"event": ["UnitDied"], "unit": "dsp"'), "expected one of UnitReady"),
        (line('"unit": "dsp"'), "found 'event'"),
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


# The loop over a clock made by hand, and the end by `Abort`.


class Script:
    """A clock that tells what it was given, and notes what the core asked for and did."""

    def __init__(self, steps: list[tuple[int, tuple[Event, ...]]]) -> None:
        self.steps = steps
        self.deadlines_ns: list[int] = []
        self.performed: list[tuple[int, tuple[Action, ...]]] = []

    def wait(self, deadline_ns: int) -> tuple[int, tuple[Event, ...]]:
        self.deadlines_ns.append(deadline_ns)
        return self.steps.pop(0)

    def perform(self, now_ns: int, actions: tuple[Action, ...]) -> None:
        self.performed.append((now_ns, actions))


def test_the_loop_waits_steps_performs_and_records_until_the_core_finishes() -> None:
    graph, settings = chain([("draw", "gpu")], "double", "draw"), Settings(1, hang_ns=1000)
    script = Script([(10, (UnitReady("gpu"),)), (20, ()), (30, (JobDone("gpu", 0, 12, 29, 12),)), (40, ())])
    recording = Recording(graph, settings)
    assert run_loop(Core(graph, settings), script, recording) == Outcome(OutcomeKind.DONE)
    assert script.deadlines_ns == [NEVER, 1010, 1010]
    (first_ns, (dispatch,)), last = script.performed
    assert first_ns == 10
    assert isinstance(dispatch, Dispatch)
    assert last == (30, (Finish(Outcome(OutcomeKind.DONE)),))
    assert [step[0] for step in recording.steps] == [10, 20, 30]
    assert script.steps == [(40, ())]


def test_an_abort_loses_what_is_in_flight_and_its_recording_replays(tmp_path: Path) -> None:
    result = run(inputs=[(500 * MS + 1, Abort())], keep=True)
    frames = result.report["frames"]
    assert result.outcome == Outcome(OutcomeKind.ABORTED)
    assert frames["lost_by_cause"] == {"aborted": frames["lost"]}
    assert 0 < frames["lost"] < 10 < frames["presented"] < FRAMES
    assert result.recording is not None
    now_ns, events, actions = result.recording.steps[-1]
    assert (now_ns, events, actions) == (500 * MS + 1, (Abort(),), (Finish(result.outcome),))
    result.recording.write(tmp_path / "events.jsonl")
    again = read(tmp_path / "events.jsonl")
    assert again == result.recording
    assert not list(replay(again))


def test_nothing_is_heard_after_the_finish() -> None:
    core = Core(application_graph(), Settings(10, "sequential"))
    (pose,) = core.step(0, tuple(UnitReady(unit) for unit in core.units)).actions
    assert isinstance(pose, Dispatch)
    decision = core.step(5, (Abort(), JobDone("cpu", pose.job.id, 0, 5, 0), UnitDied("gpu")))
    assert decision == ((Finish(Outcome(OutcomeKind.ABORTED)),), NEVER)
    assert core.step(6, (Stop(), UnitDied("cpu"))) == ((), NEVER)
    assert core.ledger.lost_by_cause == {"aborted": 1}


@pytest.mark.parametrize(
    ("event", "said"),
    [
        (UnitReady("dsp"), "unit dsp is ready: UnitReady cannot happen"),
        (UnitDied("npu"), "npu"),
        (StageAlone("infer", 7, 1), "rung 7, but the ladder has 2"),
        (JobDone("cpu", 0, 0, 1, 0, skips=True), "pose skips, but no bypass begins there"),
    ],
)
def test_an_event_that_cannot_follow_is_not_replayed(event: Event, said: str) -> None:
    recording = run("deadline", keep=True, works=(1000, 500), follow=("infer",)).recording
    recording.steps[3] = (recording.steps[3][0], (event,), ())
    with pytest.raises(BadInputError, match=said):
        list(replay(recording))


def test_a_question_about_lateness_changes_no_estimate() -> None:
    settings = Settings(50, "deadline", asked=True, deadline_ns=5 * MS)
    core = Core(application_graph(), settings)
    core.step(0, tuple(UnitReady(unit) for unit in core.units))
    for stage in core.stages:
        stage.estimate_ns = 4 * MS
    core.source.request(2, 0)
    assert core.choice.is_late(core.stages[0], 0)
    assert [stage.estimate_ns for stage in core.stages] == [4 * MS] * 5
    core.step(1, (FrameRequest(1),))
    assert all(stage.estimate_ns < 4 * MS for stage in core.stages)
