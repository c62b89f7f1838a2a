"""Says which unit each slot of an edge belongs to. Rule: a slot changes its state only by an entry of `TRANSITIONS`.

    FREE --claim--> WRITING --commit--> READY --take--> READING --release--> FREE

A WRITING slot belongs to the producer's unit, a READING slot to the units of its readers, a FREE or READY slot to
nobody. If a slot has several readers, it is READY again whenever no job reads it, until the last reader has released
it. The module is pure: it knows neither memory nor a clock.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from trilane.unexpected_value import UnexpectedValue
from trilane.units import either

FREE: Final = "free"
WRITING: Final = "writing"
READY: Final = "ready"
READING: Final = "reading"

TRANSITIONS = {
    "claim": (FREE, WRITING),
    "commit": (WRITING, READY),
    "abandon": (WRITING, FREE),  # the producer died or failed
    "take": (READY, READING),
    "drop": (READY, FREE),  # replaced by a newer frame, or too late
    "release": (READING, FREE),
    "give_back": (READING, READY),  # the consumer died before it began
}

MAX_SLOTS = 64


class SlotError(Exception):
    """The caller asked for a transition that is not in `TRANSITIONS`: a defect of the code, not of a user's input."""


@dataclass(frozen=True)
class EdgeRule:
    """The rule of an edge.

    `slots`: number of slots.
    `mailbox`: whether a new complete frame replaces the waiting frames.
    `yields`: whether a claim without a free slot may evict the oldest waiting frame.
    """

    name: str
    slots: int
    mailbox: bool = False
    yields: bool = False


#: The rules by name. A rule of COUNTED may have a number of slots, as NAME:N.
RULES = {
    "single": EdgeRule("single", 1),
    "double": EdgeRule("double", 2),
    "triple": EdgeRule("triple", 3, mailbox=True, yields=True),
    "fifo": EdgeRule("fifo", 4),
    "orphan": EdgeRule("orphan", 6, yields=True),
}
#: The rule of an edge unless somebody chooses another.
DEFAULT_EDGE: Final = "double"
#: Least N of each rule that may be written NAME:N. An orphan edge needs two slots being read, one being written and one
#: waiting.
COUNTED = {"fifo": 1, "orphan": 4}
#: The rules in words, for a person.
EDGE_WORDS: Final = either(f"{name}:N" if name in COUNTED else name for name in RULES)
#: One edge of each rule, for a menu or a comparison. The fifo states its slots, so that results show them.
EDGES: Final = tuple(f"{name}:{rule.slots}" if name == "fifo" else name for name, rule in RULES.items())


def edge_rule(text: str) -> EdgeRule:
    """Return the rule that `text` names: a name of `RULES`, or NAME:N for a name of `COUNTED`.

    Raises UnexpectedValue for other texts.
    """
    name, colon, count = text.partition(":")
    if name not in RULES or (colon and name not in COUNTED):
        raise UnexpectedValue(f"edge {text!r}", EDGE_WORDS, "such as fifo:3")
    rule = RULES[name]
    if not colon:
        return rule
    if not re.fullmatch(r"[0-9]{1,4}", count) or not COUNTED[name] <= int(count) <= MAX_SLOTS:
        expected = f"{name}:N with N from {COUNTED[name]} to {MAX_SLOTS}"
        raise UnexpectedValue(f"edge {text!r}", expected, f"such as {name}:{COUNTED[name] + 1}")
    return EdgeRule(name, int(count), rule.mailbox, rule.yields)


#: A function that takes a frame's number, and returns whether the frame must keep its slot.
Keeps = Callable[[int], bool]
FIRST_LINE: Final = (0,)


def _keeps_none(_frame: int) -> bool:
    return False


class EdgeSlots:
    """The slots behind one stage. They belong to the edge to the next stage, or to a stream with several readers.

    There are two kinds of readers. A reader that takes frame by frame has a line of waiting slots. A reader of the
    newest frame holds that frame's slot until a newer frame comes. A slot is free when its last reader has released it.

    `state`: state of each slot.
    `frame`: number of the frame in each slot; -1 for none.
    `free`: the free slots; the last one is claimed next.
    `lines`: for each reader that takes frame by frame, the slots that wait for it, oldest frame first.
    `ready`: the first line.
    `newest`: for each reader of the newest frame, the slot that it holds; -1 before the first frame.
    `epoch`: number that grows when the process of a unit at the edge is lost.
    """

    def __init__(self, rule: EdgeRule, lines: int = 1, newest: int = 0) -> None:
        """Make all slots free.

        `lines`: number of readers that take frame by frame.
        `newest`: number of readers that take the newest frame.
        """
        self.rule = rule
        self.state = [FREE] * rule.slots
        self.frame = [-1] * rule.slots
        self.free = list(range(rule.slots - 1, -1, -1))
        self.lines: tuple[deque[int], ...] = tuple(deque() for _ in range(lines))
        self.ready = self.lines[0] if lines else deque()
        self.newest = [-1] * newest
        self.epoch = 0
        self._left = [0] * rule.slots  # readers that have yet to release the slot
        self._reading = [0] * rule.slots  # jobs that read the slot; not counted for a single reader
        self._is_shared = lines > 1 or newest > 0

    def can_claim(self, keeps: Keeps = _keeps_none) -> bool:
        """Return whether `claim` would find a slot: a free slot, or the slot of a waiting frame that may be evicted.

        `keeps`: function that says which frames must not be evicted.
        """
        return bool(self.free) or (self.rule.yields and self._evictable(keeps) >= 0)

    def claim(self, frame: int, keeps: Keeps = _keeps_none) -> tuple[int, int | None]:
        """Claim a slot for `frame`; return (slot, number of the evicted frame; None if no frame was evicted).

        A waiting frame is evicted only if no slot is free and the edge's rule allows it (`yields`). With `keeps`, it is
        the oldest frame of all lines that may be evicted. Without `keeps`, frames of the last line are evicted first,
        the oldest first: frames on a bypass wait in that line, and no later frame needs them.

        `keeps`: function that says which frames must not be evicted; without it, every waiting frame may be evicted.

        Raises SlotError if no slot is free and no frame may be evicted.
        """
        dropped = None
        if not self.free and self.rule.yields and (oldest := self._evictable(keeps)) >= 0:
            dropped = self.drop(oldest)
        if not self.free:
            raise SlotError("no slot to claim")
        # The slot that was given back last: its memory may still be in the caches.
        slot = self.free.pop()
        self._move("claim", slot)
        self.frame[slot] = frame
        return slot, dropped

    def commit(self, slot: int, to: Sequence[int] = FIRST_LINE, keeps: Keeps = _keeps_none) -> list[int]:
        """Mark the slot's frame as complete, and return the waiting frames that it replaces (only in a mailbox).

        If no reader takes the frame, the slot is free again.

        `to`: indices of the lines in which the slot waits from now on.
        `keeps`: function that says which frames must not be replaced.
        """
        self._move("commit", slot)
        replaced = []
        if self.rule.mailbox:
            for line in to:
                old = [each for each in self.lines[line] if not self._reading[each] and not keeps(self.frame[each])]
                replaced += [self.drop(each) for each in old]
        for line in to:
            self.lines[line].append(slot)
        self._left[slot] = len(to)
        if self.newest:
            self._hold(slot)
        elif not to:
            self._move("drop", slot)
            self._empty(slot)
        return replaced

    def _hold(self, slot: int) -> None:
        """Let all readers of the newest frame hold the slot, and release the slots that they held before."""
        self._left[slot] += len(self.newest)
        for reader, held in enumerate(self.newest):
            self.newest[reader] = slot
            if held >= 0:
                self._leave(held)

    def take(self, slot: int, line: int = 0) -> None:
        """Take the slot out of line number `line`: from now on, a job of that line's reader reads the slot."""
        if not self._reading[slot] or slot not in self.lines[line]:
            self._move("take", slot)
        if self._is_shared:
            self._reading[slot] += 1
        self.lines[line].remove(slot)

    def take_newest(self, reader: int) -> int:
        """Let a job read the slot of the newest frame, and return the slot; -1 before the first frame.

        `reader`: index in `newest` of the reader that does the job.
        """
        slot = self.newest[reader]
        if slot >= 0:
            if not self._reading[slot]:
                self._move("take", slot)
            self._reading[slot] += 1
            self._left[slot] += 1
        return slot

    def release(self, slot: int) -> None:
        """Note that a job has read the slot. The slot becomes free if no further reader needs it."""
        if not self._is_shared:
            self._move("release", slot)
            self._empty(slot)
            return
        if not self._reading[slot]:
            raise SlotError(f"cannot release slot {slot}, which is {self.state[slot]}")
        self._reading[slot] -= 1
        if not self._reading[slot]:
            self._move("give_back", slot)
        self._leave(slot)

    def abandon(self, slot: int) -> None:
        """Free a slot that the producer's unit will not complete."""
        self._move("abandon", slot)
        self._empty(slot)

    def drop(self, slot: int) -> int:
        """Free the slot of a waiting frame that no job reads, and return the frame's number."""
        self._move("drop", slot)
        for line in self.lines:
            if slot in line:
                line.remove(slot)
        for reader, held in enumerate(self.newest):
            if held == slot:
                self.newest[reader] = -1
        frame = self.frame[slot]
        self._left[slot] = 0
        self._empty(slot)
        return frame

    def pass_by(self, frame: int, line: int) -> None:
        """Take `frame` out of `line`, if it waits there. Its slot becomes free if no other reader needs the frame."""
        for slot in self.lines[line]:
            if self.frame[slot] == frame:
                self.lines[line].remove(slot)
                self._leave(slot)
                return

    def give_back(self, slot: int, line: int = 0, keeps: Keeps | None = None) -> list[int]:
        """Put a taken slot back into `line`, ordered by frame. Return the frames that a mailbox drops for newer ones.

        `keeps`: function that says which frames must not be replaced; None: every frame may be replaced.
        """
        if self._is_shared:
            self._reading[slot] -= 1
        if not self._reading[slot]:
            self._move("give_back", slot)
        waiting = self.lines[line]
        waiting.append(slot)
        ordered = sorted(waiting, key=self.frame.__getitem__)
        waiting.clear()
        waiting.extend(ordered)
        if not self.rule.mailbox:
            return []
        old = [each for each in ordered[:-1] if not self._reading[each] and each not in self.newest]
        return [self.drop(each) for each in old if keeps is None or not keeps(self.frame[each])]

    def _evictable(self, keeps: Keeps) -> int:
        """Return the slot whose frame `claim` evicts; -1 if no frame may be evicted. `keeps`: as in `claim`."""
        found = -1
        for line in reversed(self.lines):
            for slot in line:
                if not self._reading[slot] and slot not in self.newest and not keeps(self.frame[slot]):
                    if keeps is _keeps_none:
                        return slot
                    if found < 0 or self.frame[slot] < self.frame[found]:
                        found = slot
                    break
        return found

    def _leave(self, slot: int) -> None:
        """Note that one reader no longer needs the slot; free the slot after its last reader."""
        self._left[slot] -= 1
        if not self._left[slot]:
            self._move("drop", slot)
            self._empty(slot)

    def _move(self, verb: str, slot: int) -> None:
        before, after = TRANSITIONS[verb]
        if self.state[slot] != before:
            raise SlotError(f"cannot {verb} slot {slot}, which is {self.state[slot]}")
        self.state[slot] = after

    def _empty(self, slot: int) -> None:
        self.frame[slot] = -1
        self.free.append(slot)
