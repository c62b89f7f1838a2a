"""Real units are given less work when frames would be late, and the recorded run gives the same rungs again."""

from __future__ import annotations

from support.doubles import SLOW_FRAMES, STEPPED_WORKS, stepped_pipeline
from trilane.pipeline.run import run_pipeline
from trilane.scheduler.events import StageAlone
from trilane.scheduler.recording import replay


def test_slow_frames_are_given_less_work() -> None:
    """Infer takes 30 ms of each 50, and from frame 10 to 29 90, of which a fifth is 18."""
    pipeline = stepped_pipeline(30)
    result = run_pipeline(pipeline, 60, policy="latest", fps=20.0, works=STEPPED_WORKS, follow=("infer",))
    assert result.failure is None and sum(result.rungs.values()) == result.presented
    said = [event for _, events, _ in result.recording.steps for event in events if isinstance(event, StageAlone)]
    assert [(event.stage, event.rung) for event in said] == [("infer", 0), ("infer", 1)]
    assert said[0].ns >= 30e6 and said[1].ns >= 6e6
    rungs = {
        action.job.frame: action.job.rung
        for _, _, actions in result.recording.steps
        for action in actions
        if hasattr(action, "job") and action.job.stage == "pose"
    }
    assert any(rungs.get(frame) == 1 for frame in SLOW_FRAMES)
    assert not list(replay(result.recording))
    assert 0 < result.metrics["pose"]["rung"] < 1
