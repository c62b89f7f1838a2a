"""The way past some stages. Rule: a frame on it overtakes none, and its slot goes back to the edge that it came from.

The stage at which the bypass begins says of each frame whether it skips (`JobDone.skips`). The slot of such a frame
waits in `EdgeSlots.passing` of the edge behind that stage, for the stage at which the bypass ends. That stage takes
frames from two sides. It takes the oldest frame, and a frame that skips only when no older frame is still before it.

A frame that skips relies on what a frame that did not skip left at the bypass's end. Such a frame may be lost or
dropped before it gets there, or the unit at the end may be restarted. Then the next job at the bypass's begin is
`fresh`.
"""

from __future__ import annotations

from collections.abc import Mapping

from trilane.scheduler.state import FrameState, StageState
from trilane.transport.slots import EdgeSlots


class Bypass:
    """The way past the stages between `begin` and `end`; a frame that takes it has its slot on `edge`, behind `begin`.

    `must_be_fresh`: whether the next job of `begin` must be fresh.
    `was_taken`: whether the last frame that `begin` did skipped.
    """

    __slots__ = ("begin", "edge", "end", "must_be_fresh", "was_taken")

    def __init__(self, begin: StageState, end: StageState) -> None:
        assert begin.output is not None
        self.begin, self.end, self.edge = begin, end, begin.output
        end.bypassed = begin.output
        self.must_be_fresh = True
        self.was_taken = False


def next_slot(stage: StageState, frames: Mapping[int, FrameState]) -> int:
    """Return the slot that a stage with an input takes next, as `Job.slot_in` counts; -1: none.

    `frames`: frames in flight by number, oldest first.
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
    """Return whether an older frame than `frame` has not come to `stage` yet."""
    for number, state in frames.items():
        if number >= frame:
            return False
        if state.position < stage.position:
            return True
    return False


def side_of(stage: StageState, slot_in: int) -> tuple[EdgeSlots, int]:
    """Return the edge and the slot that `slot_in` of a job of `stage` refers to; the stage must have an input."""
    own = stage.input
    assert own is not None
    if stage.bypassed is None or slot_in < len(own.state):
        return own, slot_in
    return stage.bypassed, slot_in - len(own.state)


def stale_slot(stage: StageState, frames: Mapping[int, FrameState]) -> int:
    """Return the slot of the oldest frame that waits to skip to the stage if that frame is stale; else -1.

    The frame is stale if a newer waiting frame could go as soon. A frame that did not skip is not stale for one that
    does, which may need it. The slot counts as `Job.slot_in` does.
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
    """Return whether a frame between the two oldest that wait to skip is still on its way to the stage."""
    newer = bypassed.frame[bypassed.passing[1]]
    return any(frame < number < newer and state.position < stage.position for number, state in frames.items())
