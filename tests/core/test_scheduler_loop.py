"""The loop over a clock made by hand, the end by `Abort`, and the names of all causes."""

from __future__ import annotations

from pathlib import Path

import pytest

from trilane.errors import BadInputError
from trilane.hw_profiles.application import application_graph
from trilane.scheduler.core import Core, run_loop
from trilane.scheduler.events import (
    NEVER,
    Abort,
    Action,
    Dispatch,
    Drop,
    DropCause,
    Event,
    Finish,
    FrameRequest,
    JobDone,
    Loss,
    LossKind,
    Outcome,
    OutcomeKind,
    Settings,
    Stop,
    UnitDied,
    UnitReady,
    chain,
)
from trilane.scheduler.recording import Recording, read, replay
from trilane.scheduler.virtual import simulate

MS = 1_000_000


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


def service(_stage: str, _unit: str, frame: int, _begin_ns: int) -> int:
    return (3 + frame % 5) * MS


def test_an_abort_loses_what_is_in_flight_and_its_recording_replays(tmp_path: Path) -> None:
    result = simulate(application_graph(), Settings(100), service, inputs=[(200 * MS + 1, Abort())], keep=True)
    frames = result.report["frames"]
    assert result.outcome == Outcome(OutcomeKind.ABORTED)
    assert frames["lost_by_cause"] == {"aborted": frames["lost"]}
    assert 0 < frames["lost"] < 10 < frames["presented"] < 100
    assert result.recording is not None
    now_ns, events, actions = result.recording.steps[-1]
    assert (now_ns, events, actions) == (200 * MS + 1, (Abort(),), (Finish(result.outcome),))
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


def test_an_outcome_that_there_is_not_is_no_recording(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    recording = simulate(application_graph(), Settings(2), service, keep=True).recording
    assert recording is not None
    recording.write(path)
    text = path.read_text()
    done = '{"action":"Finish","kind":"done","unit":""}'
    assert done in text
    path.write_text(text.replace(done, done.replace("done", "bored")))
    with pytest.raises(BadInputError, match="bored"):
        read(path)


def test_an_event_that_cannot_follow_is_not_replayed() -> None:
    recording = simulate(application_graph(), Settings(2), service, keep=True).recording
    assert recording is not None
    now_ns, _, actions = recording.steps[4]
    recording.steps[4] = (now_ns, (UnitReady("dsp"),), actions)
    with pytest.raises(BadInputError, match="unit dsp is ready: UnitReady cannot happen"):
        list(replay(recording))


CAUSES = [
    (Outcome(OutcomeKind.DONE), "done"),
    (Outcome(OutcomeKind.STOPPED), "stopped"),
    (Outcome(OutcomeKind.ABORTED), "aborted"),
    (Outcome(OutcomeKind.GAVE_UP, "dsp"), "gave_up:dsp"),
    (Loss(LossKind.DIED, "cpu"), "died:cpu"),
    (Loss(LossKind.HUNG, "gpu"), "hung:gpu"),
    (Loss(LossKind.GAVE_UP, "dsp"), "gave_up:dsp"),
    (Loss(LossKind.FAILED, "raster"), "failed:raster"),
    (Loss(LossKind.ABORTED), "aborted"),
    (Drop("raster->infer", DropCause.STALE), "raster->infer:stale"),
    (Drop("source->pose", DropCause.LATE), "source->pose:late"),
    (Drop("raster->infer", DropCause.POOL), "raster->infer:pool"),
    (Drop("source->pose", DropCause.QUEUE_FULL), "source->pose:queue_full"),
    (Drop("source->pose", DropCause.TIMEOUT), "source->pose:timeout"),
]


@pytest.mark.parametrize(("cause", "key"), CAUSES, ids=[key for _, key in CAUSES])
def test_a_cause_says_its_key_in_the_report(cause: Outcome | Loss | Drop, key: str) -> None:
    assert str(cause) == f"{cause}" == key


def test_every_kind_of_cause_is_in_the_table_above() -> None:
    kinds = {cause.cause if isinstance(cause, Drop) else cause.kind for cause, _ in CAUSES}
    assert kinds == {*OutcomeKind, *LossKind, *DropCause}


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
