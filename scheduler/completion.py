"""Computes the earliest time at which a frame can be presented.

Rule: the bound is never later than the truth, so that no frame is given up that could be in time. It is a lower bound
if service times stay what they were lately.

At every stage older frames go first. So a frame begins at a stage after the older frames' work there, or after its own
work at the stages before, whichever ends later. With a bypass, a frame that has not come to its beginning is taken to
do what the last frame there did.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from trilane.scheduler.state import FrameState, StageState


def earliest_completion_ns(
    now_ns: int,
    frame: int,
    position: int,
    stages: Sequence[StageState],
    frames: Mapping[int, FrameState],
    bypass: tuple[int, int] = (0, 0),
) -> int:
    """Return the earliest end of the last stage of `frame`, in ns.

    It is now + max over s >= position of [ max(own work before s, work of older frames at s) + own work from s on ].

    `now_ns`: present time in ns.
    `frame`: number of the frame; frames with smaller numbers are older.
    `position`: position of its next stage in the chain.
    `stages`: stages of the chain, with the estimates of service times.
    `frames`: frames in flight, by number.
    `bypass`: positions of two stages; a frame that has yet to do the first skips the stages between them.
    """
    older = [0] * len(stages)
    for number, state in frames.items():
        if number < frame:
            older[state.position] += 1
    begin, end = bypass
    skipping = sum(older[: begin + 1])
    before, own, latest = sum(older[:position]), 0, 0
    rest = sum(stage.estimate_ns for stage in stages[position:] if position > begin or not begin < stage.position < end)
    for stage in stages[position:]:
        before += older[stage.position]
        is_skipped = begin < stage.position < end
        count = before - skipping if is_skipped else before
        backlog = count * stage.estimate_ns - _done_of_running(now_ns, stage) if count else 0
        latest = max(latest, max(own, backlog) + rest)
        if position > begin or not is_skipped:
            own += stage.estimate_ns
            rest -= stage.estimate_ns
    return now_ns + latest


def _done_of_running(now_ns: int, stage: StageState) -> int:
    """Return how much of the stage's running job is over in ns, by the estimate of its length."""
    queue = stage.unit.queue
    if not queue or queue[0].stage != stage.name:
        return 0
    return min(now_ns - stage.unit.head_since_ns, stage.estimate_ns)
