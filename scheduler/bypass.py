"""The way past some stages. Rule: a frame on it overtakes none, and its slot goes back to the edge that it came from.

The stage at which the bypass begins says of each frame whether it skips (`JobDone.skips`). The slot of a frame that
does waits in `EdgeSlots.passing` of the edge behind that stage, for the stage at which the bypass ends. That stage has
two sides from which frames come: it takes the oldest, and one that skips only when no older frame is still before it.

What a frame that skips relies on was left at the bypass's end by one that did not. When such a frame is lost or dropped
before it got there, or the unit at the end was started anew, the next job of the stage at the beginning is `fresh`.
"""

from __future__ import annotations

from collections.abc import Mapping

from trilane.scheduler.state import FrameState, StageState
from trilane.transport.slots import EdgeSlots


class Bypass:
    """The way past the stages between `begin` and `end`; a frame that takes it has its slot on `edge`, behind `begin`.

    `must_be_fresh`: of the next job of `begin`. `was_taken`: whether the last frame that `begin` did skipped.
    """

    __slots__ = ("begin", "edge", "end", "must_be_fresh", "was_taken")

    def __init__(self, begin: StageState, end: StageState) -> None:
        assert begin.output is not None
        self.begin, self.end, self.edge = begin, end, begin.output
        end.bypassed = begin.output
        self.must_be_fresh = True
        self.was_taken = False


def next_slot(stage: StageState, frames: Mapping[int, FrameState]) -> int:
    """What a stage that has an input takes next, as `Job.slot_in` counts; -1: nothing.

    `frames`: those in flight, by number, oldest first.
    """
    own, bypassed = stage.input, stage.bypassed
    assert own is not None
    if bypassed is None or not bypassed.passing:
        return own.ready[0] if own.ready else -1
    slot = bypassed.passing[0]
    frame = bypassed.frame[slot]
    if own.ready:
        if own.frame[own.ready[0]] < frame:
            return own.ready[0]
    elif is_older_before(stage, frame, frames):
        return -1
    return len(own.state) + slot


def is_older_before(stage: StageState, frame: int, frames: Mapping[int, FrameState]) -> bool:
    """Whether an older frame than `frame` has not come to `stage` yet."""
    for number, state in frames.items():
        if number >= frame:
            return False
        if state.position < stage.position:
            return True
    return False


def side_of(stage: StageState, slot_in: int) -> tuple[EdgeSlots, int]:
    """The edge and its slot that `Job.slot_in` of a job of `stage`, which has an input, means."""
    own = stage.input
    assert own is not None
    if stage.bypassed is None or slot_in < len(own.state):
        return own, slot_in
    return stage.bypassed, slot_in - len(own.state)


def stale_slot(stage: StageState, frames: Mapping[int, FrameState]) -> int:
    """Of the frames that wait to skip to the stage, the oldest, where a newer one that waits could go as soon; else -1.

    As `Job.slot_in` counts. A frame that did not skip is not stale for one that does, which may need it.
    """
    own, bypassed = stage.input, stage.bypassed
    if own is None or bypassed is None or not bypassed.passing:
        return -1
    slot = bypassed.passing[0]
    frame = bypassed.frame[slot]
    newest = own.frame[own.ready[-1]] if own.ready else -1
    if newest > frame or (len(bypassed.passing) > 1 and not _parts(stage, frame, bypassed, frames)):
        return len(own.state) + slot
    return -1


def _parts(stage: StageState, frame: int, bypassed: EdgeSlots, frames: Mapping[int, FrameState]) -> bool:
    """Whether a frame that does not skip is still on its way to the stage between the two oldest that wait to skip."""
    newer = bypassed.frame[bypassed.passing[1]]
    return any(frame < number < newer and state.position < stage.position for number, state in frames.items())
