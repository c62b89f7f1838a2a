"""Says which unit each slot of an edge belongs to. Rule: a slot changes hands only by a transition of the table.

    FREE --claim--> WRITING --commit--> READY --take--> READING --release--> FREE

WRITING belongs to the producer's unit, READING to the consumer's, FREE and READY to nobody. The module is pure: it
knows neither memory nor a clock.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass
from typing import Final

from trilane.unexpected_value import UnexpectedValue

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
    """A transition that the table does not have: a defect of the caller, never of the user's input."""


@dataclass(frozen=True)
class EdgeRule:
    """An edge's policy.

    `slots`: number of slots.
    `mailbox`: whether a commit replaces the waiting frames.
    `yields`: whether a claim may replace the oldest waiting frame.
    """

    name: str
    slots: int
    mailbox: bool = False
    yields: bool = False


#: The rules by name; those in COUNTED may be given with a count, as NAME:N.
RULES = {
    "single": EdgeRule("single", 1),
    "double": EdgeRule("double", 2),
    "triple": EdgeRule("triple", 3, mailbox=True, yields=True),
    "fifo": EdgeRule("fifo", 4),
    "orphan": EdgeRule("orphan", 6, yields=True),
}
COUNTED = {"fifo": 1, "orphan": 4}  # least counts; an orphan edge has two slots read, one written and one waiting


def edge_rule(text: str) -> EdgeRule:
    """Return the rule of `single`, `double`, `triple`, `fifo[:N]` or `orphan[:N]`.

    Raises UnexpectedValue for other texts.
    """
    name, colon, count = text.partition(":")
    if name not in RULES or (colon and name not in COUNTED):
        raise UnexpectedValue(f"edge {text!r}", "single, double, triple, fifo:N or orphan:N")
    rule = RULES[name]
    if not colon:
        return rule
    if not re.fullmatch(r"[0-9]{1,4}", count) or not COUNTED[name] <= int(count) <= MAX_SLOTS:
        raise UnexpectedValue(f"edge {text!r}", f"{name}:N with N from {COUNTED[name]} to {MAX_SLOTS}")
    return EdgeRule(name, int(count), rule.mailbox, rule.yields)


class EdgeSlots:
    """The slots of one edge.

    `frame`: frame in each slot; -1 without one.
    `ready`: slots that wait for the edge's consumer, oldest first.
    `passing`: slots that wait for the stage at which a bypass of this edge ends.
    `epoch`: number that grows at each fault.
    """

    def __init__(self, rule: EdgeRule) -> None:
        self.rule = rule
        self.state = [FREE] * rule.slots
        self.frame = [-1] * rule.slots
        self.free = list(range(rule.slots - 1, -1, -1))
        self.ready: deque[int] = deque()
        self.passing: deque[int] = deque()
        self.epoch = 0

    def can_claim(self) -> bool:
        """Return whether a slot is free, or may be taken from the oldest waiting frame."""
        return bool(self.free) or (self.rule.yields and bool(self.ready or self.passing))

    def claim(self, frame: int) -> tuple[int, int | None]:
        """Claim a slot for `frame`; return the slot and the waiting frame that was evicted from it, or None.

        A frame on the bypass is evicted before any other, because no frame can need it. Raises SlotError when no slot
        is free and none may be evicted.
        """
        dropped = None
        if not self.free and self.rule.yields and (self.ready or self.passing):
            dropped = self.drop((self.passing or self.ready)[0])
        if not self.free:
            raise SlotError("no slot to claim")
        # The slot that was given back last: its memory may still be in the caches.
        slot = self.free.pop()
        self._move("claim", slot)
        self.frame[slot] = frame
        return slot, dropped

    def commit(self, slot: int, skips: bool = False) -> list[int]:
        """Mark the slot's frame as complete, and return the frames that it replaces.

        `skips`: whether it takes the bypass.
        """
        self._move("commit", slot)
        line = self.passing if skips else self.ready
        replaced = [self.drop(old) for old in list(line)] if self.rule.mailbox else []
        line.append(slot)
        return replaced

    def take(self, slot: int) -> None:
        """Let the unit of the stage that the slot waits for read it from now on."""
        self._move("take", slot)
        self._line_of(slot).remove(slot)

    def release(self, slot: int) -> None:
        """Free the slot, which the unit that took it has read."""
        self._move("release", slot)
        self._empty(slot)

    def abandon(self, slot: int) -> None:
        """Free the slot, which the producer's unit will not complete."""
        self._move("abandon", slot)
        self._empty(slot)

    def drop(self, slot: int) -> int:
        """Take a waiting frame out of its slot, and return its number."""
        self._move("drop", slot)
        self._line_of(slot).remove(slot)
        frame = self.frame[slot]
        self._empty(slot)
        return frame

    def give_back(self, slot: int, skips: bool = False) -> list[int]:
        """Let a taken frame wait again in its old place; return it if a newer frame waits in a mailbox."""
        self._move("give_back", slot)
        line = deque(sorted([*(self.passing if skips else self.ready), slot], key=self.frame.__getitem__))
        if skips:
            self.passing = line
        else:
            self.ready = line
        if not self.rule.mailbox:
            return []
        return [self.drop(old) for old in list(line)[:-1]]

    def _line_of(self, slot: int) -> deque[int]:
        return self.passing if self.passing and slot in self.passing else self.ready

    def _move(self, verb: str, slot: int) -> None:
        before, after = TRANSITIONS[verb]
        if self.state[slot] != before:
            raise SlotError(f"cannot {verb} slot {slot}, which is {self.state[slot]}")
        self.state[slot] = after

    def _empty(self, slot: int) -> None:
        self.frame[slot] = -1
        self.free.append(slot)
