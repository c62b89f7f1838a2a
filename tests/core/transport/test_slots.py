"""Slots change hands by the table alone."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilane.transport.slots import (
    FREE,
    READING,
    READY,
    TRANSITIONS,
    WRITING,
    EdgeRule,
    EdgeSlots,
    SlotError,
    edge_rule,
)

RULES = ["single", "double", "triple", "fifo:1", "fifo:5", "orphan", "orphan:4"]


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("single", EdgeRule("single", 1)),
        ("double", EdgeRule("double", 2)),
        ("triple", EdgeRule("triple", 3, mailbox=True, yields=True)),
        ("fifo", EdgeRule("fifo", 4)),
        ("fifo:1", EdgeRule("fifo", 1)),
        ("fifo:64", EdgeRule("fifo", 64)),
        ("orphan", EdgeRule("orphan", 6, yields=True)),
        ("orphan:4", EdgeRule("orphan", 4, yields=True)),
        ("orphan:64", EdgeRule("orphan", 64, yields=True)),
    ],
)
def test_an_edge_has_its_slots_and_its_rules(text: str, rule: EdgeRule) -> None:
    assert edge_rule(text) == rule


UNCOUNTED, FIFO, ORPHAN = (
    "single, double, triple, fifo:N or orphan:N",
    "fifo:N with N from 1 to 64",
    "orphan:N with N from 4",
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        *((text, UNCOUNTED) for text in ("quad", "", "single:2", "double:", "triple:4:4")),
        *((f"fifo:{count}", FIFO) for count in ("", "0", "65", "99999", "x", "4 ", "+4", "4:4")),
        *((f"orphan:{count}", ORPHAN) for count in ("", "3", "65", "x")),
    ],
)
def test_an_edge_that_there_is_not_is_refused_with_those_that_there_are(text: str, expected: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"found edge '{text}', expected {expected}")):
        edge_rule(text)


@pytest.mark.parametrize("verb", sorted(TRANSITIONS))
@pytest.mark.parametrize("state", [FREE, WRITING, READY, READING])
def test_what_the_table_does_not_have_is_refused(verb: str, state: str) -> None:
    edge = EdgeSlots(edge_rule("single"))
    edge.state[0] = state
    before, after = TRANSITIONS[verb]
    if state == before:
        edge._move(verb, 0)
        assert edge.state[0] == after
    else:
        with pytest.raises(SlotError):
            edge._move(verb, 0)


def test_a_mailbox_keeps_the_newest() -> None:
    edge = EdgeSlots(edge_rule("triple"))
    for frame in range(3):
        slot, _ = edge.claim(frame)
        replaced = edge.commit(slot)
        assert replaced == ([frame - 1] if frame else [])
    assert [edge.frame[slot] for slot in edge.ready] == [2]


def test_an_orphan_edge_never_waits_and_gives_up_its_oldest_when_no_slot_is_free() -> None:
    edge = EdgeSlots(edge_rule("orphan:4"))
    for frame in range(3):
        edge.commit(edge.claim(frame)[0])
    assert edge.claim(3) == (3, None)
    assert edge.can_claim()
    assert edge.claim(4) == (0, 0)
    assert [edge.frame[slot] for slot in edge.ready] == [1, 2]
    assert edge.drop(2) == 2
    assert (edge.frame, edge.free) == ([4, 1, -1, 3], [2])


def test_the_slots_of_a_fifo_from_claim_to_release() -> None:
    """Step by step over two slots: which slot, which state, which frame."""
    edge = EdgeSlots(edge_rule("fifo:2"))
    assert (edge.state, edge.frame, edge.free, list(edge.ready), edge.epoch) == (["free"] * 2, [-1, -1], [1, 0], [], 0)
    assert edge.claim(7) == (0, None)
    assert edge.commit(0) == []
    assert edge.claim(8) == (1, None)
    assert (edge.state, edge.frame, edge.can_claim()) == (["ready", "writing"], [7, 8], False)
    with pytest.raises(SlotError, match="no slot to claim"):
        edge.claim(9)
    edge.take(0)
    edge.abandon(1)
    assert (edge.state, edge.frame, edge.free, list(edge.ready)) == (["reading", "free"], [7, -1], [1], [])
    with pytest.raises(SlotError, match="cannot take slot 0, which is reading"):
        edge.take(0)
    edge.release(0)
    assert (edge.state, edge.frame, edge.free) == (["free"] * 2, [-1, -1], [1, 0])


def test_a_frame_given_back_waits_in_its_old_place() -> None:
    edge = EdgeSlots(edge_rule("fifo:4"))
    for frame in range(3):
        edge.commit(edge.claim(frame)[0])
    first, second = list(edge.ready)[:2]
    edge.take(first)
    edge.take(second)
    assert edge.give_back(second) == edge.give_back(first) == []
    assert [edge.frame[slot] for slot in edge.ready] == [0, 1, 2]


def test_a_frame_given_back_to_a_mailbox_is_evicted_by_a_newer_one() -> None:
    edge = EdgeSlots(edge_rule("triple"))
    edge.commit(edge.claim(0)[0])
    held = edge.ready[0]
    edge.take(held)
    edge.commit(edge.claim(1)[0])
    assert edge.give_back(held) == [0]


@given(st.sampled_from(RULES), st.lists(st.integers(0, 6), max_size=200))
def test_any_sequence_keeps_every_slot_in_one_place(text: str, verbs: list[int]) -> None:
    edge, frame, seen = EdgeSlots(edge_rule(text)), 0, []
    for verb in verbs:
        writing = [slot for slot, state in enumerate(edge.state) if state == WRITING]
        reading = [slot for slot, state in enumerate(edge.state) if state == READING]
        if verb in (0, 1) and edge.can_claim():
            edge.claim(frame)
            frame += 1
        elif verb == 2 and writing:
            edge.commit(min(writing, key=edge.frame.__getitem__))
        elif verb == 3 and edge.ready:
            seen.append(edge.frame[edge.ready[0]])
            edge.take(edge.ready[0])
        elif verb == 4 and reading:
            edge.release(reading[0])
        elif verb == 5 and writing:
            edge.abandon(writing[0])
        _check(edge)
    assert seen == sorted(set(seen))


def _check(edge: EdgeSlots) -> None:
    assert sorted(edge.free) == [slot for slot, state in enumerate(edge.state) if state == FREE]
    assert sorted(edge.ready) == [slot for slot, state in enumerate(edge.state) if state == READY]
    frames = [number for number in edge.frame if number >= 0]
    assert len(frames) == len(set(frames)) == edge.rule.slots - len(edge.free)
    assert not edge.rule.mailbox or len(edge.ready) <= 1
