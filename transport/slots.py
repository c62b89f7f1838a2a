"""Which unit a slot belongs to, and when. Rule: a slot changes hands by a transition of the table, and by nothing else.

    FREE --claim--> WRITING --commit--> READY --take--> READING --release--> FREE

WRITING belongs to the producer's unit, READING to the consumer's, FREE and READY to nobody. Pure: no memory, no clock.
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
    """An edge's policy. `mailbox`: a commit replaces what waits. `yields`: a claim may replace the oldest waiting."""

    name: str
    slots: int
    mailbox: bool = False
    yields: bool = False


#: Name -> rule; the count of those in COUNTED may be given as NAME:N.
RULES = {
    "single": EdgeRule("single", 1),
    "double": EdgeRule("double", 2),
    "triple": EdgeRule("triple", 3, mailbox=True, yields=True),
    "fifo": EdgeRule("fifo", 4),
    "orphan": EdgeRule("orphan", 6, yields=True),
}
COUNTED = {"fifo": 1, "orphan": 4}  # least count: an orphan edge has two slots read, one written and one waiting


def edge_rule(text: str) -> EdgeRule:
    """`single`, `double`, `triple`, `fifo[:N]`, `orphan[:N]`. Raises UnexpectedValue."""
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

    `frame[i]` is -1 when none. `ready`: slots that wait for the edge's consumer, oldest first. `passing`: those that
    wait for the stage at which a bypass of this edge ends. `epoch` grows at each fault.
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
        """Whether a slot is free, or may be taken from the oldest waiting frame."""
        return bool(self.free) or (self.rule.yields and bool(self.ready or self.passing))

    def claim(self, frame: int) -> tuple[int, int | None]:
        """A slot to write `frame` into, and the waiting frame that was evicted from it, if one was.

        A frame on the bypass is evicted before any other, for no frame can need it.
        Raises SlotError when none is free and none may be evicted.
        """
        dropped = None
        if not self.free and self.rule.yields and (self.ready or self.passing):
            dropped = self.drop((self.passing or self.ready)[0])
        if not self.free:
            raise SlotError("no slot to claim")
        slot = self.free.pop()
        self._move("claim", slot)
        self.frame[slot] = frame
        return slot, dropped

    def commit(self, slot: int, skips: bool = False) -> list[int]:
        """The slot's frame is complete; returns the frames that it replaces. `skips`: it takes the bypass."""
        self._move("commit", slot)
        line = self.passing if skips else self.ready
        replaced = [self.drop(old) for old in list(line)] if self.rule.mailbox else []
        line.append(slot)
        return replaced

    def take(self, slot: int) -> None:
        """The unit of the stage that the slot waits for reads it from now on."""
        self._move("take", slot)
        self._line_of(slot).remove(slot)

    def release(self, slot: int) -> None:
        """The unit that took the slot has read it."""
        self._move("release", slot)
        self._empty(slot)

    def abandon(self, slot: int) -> None:
        """The producer's unit will not complete the slot."""
        self._move("abandon", slot)
        self._empty(slot)

    def drop(self, slot: int) -> int:
        """Take a waiting frame out; returns its number."""
        self._move("drop", slot)
        self._line_of(slot).remove(slot)
        frame = self.frame[slot]
        self._empty(slot)
        return frame

    def give_back(self, slot: int, skips: bool = False) -> list[int]:
        """A taken frame waits again, in its old place; returns it when a newer one waits in a mailbox."""
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
