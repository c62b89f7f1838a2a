"""When a frame can be presented at the earliest. Rule: a bound: no frame is given up that could be in time.

The bound holds as far as service times are what they were lately: older frames go first at every stage, so a frame
waits at each for their work there, or arrives after its own work before it, whichever is later.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from trilane.scheduler.state import FrameState, StageState


def earliest_completion_ns(
    now_ns: int, frame: int, position: int, stages: Sequence[StageState], frames: Mapping[int, FrameState]
) -> int:
    """End of the last stage for `frame`, whose next stage is at `position`.

    max over s >= position of [ max(own work before s, work of older frames at s) + own work from s on ].
    """
    older = [0] * len(stages)
    for number, state in frames.items():
        if number < frame:
            older[state.position] += 1
    before, own, latest = sum(older[:position]), 0, 0
    rest = sum(stage.estimate_ns for stage in stages[position:])
    for stage in stages[position:]:
        before += older[stage.position]
        backlog = before * stage.estimate_ns - _done_of_running(now_ns, stage) if before else 0
        latest = max(latest, max(own, backlog) + rest)
        own += stage.estimate_ns
        rest -= stage.estimate_ns
    return now_ns + latest


def _done_of_running(now_ns: int, stage: StageState) -> int:
    """How much of the stage's running job is over, by the estimate of its length."""
    queue = stage.unit.queue
    if not queue or queue[0].stage != stage.name:
        return 0
    return min(now_ns - stage.unit.head_since_ns, stage.estimate_ns)
