"""Slots change hands by the table alone."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilane.transport.slots import FREE, READING, READY, TRANSITIONS, WRITING, EdgeSlots, SlotError, edge_rule

RULES = ["single", "double", "triple", "fifo:1", "fifo:5", "orphan", "orphan:4"]


@pytest.mark.parametrize(("text", "slots"), [("single", 1), ("double", 2), ("triple", 3), ("fifo:7", 7), ("fifo", 4)])
def test_an_edge_kind_has_its_number_of_slots(text: str, slots: int) -> None:
    assert edge_rule(text).slots == slots


@pytest.mark.parametrize("text", ["quad", "single:2", "fifo:0", "fifo:65", "fifo:x", "orphan:3", "", "fifo:4 "])
def test_an_unknown_edge_is_named(text: str) -> None:
    with pytest.raises(ValueError, match="found edge"):
        edge_rule(text)


@pytest.mark.parametrize("count", ["", "0", "65", "12345", "x", "4 ", "+4", "4:4"])
def test_a_count_that_is_none_is_told_what_it_may_be(count: str) -> None:
    with pytest.raises(ValueError, match="expected fifo:N with N from 1 to 64"):
        edge_rule(f"fifo:{count}")
    with pytest.raises(ValueError, match="expected orphan:N with N from 4 to 64"):
        edge_rule(f"orphan:{count if count != '65' else '3'}")
    with pytest.raises(ValueError, match="expected single, double, triple, fifo:N or orphan:N"):
        edge_rule(f"double:{count}")


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


def test_an_orphan_edge_never_waits_and_gives_up_its_oldest() -> None:
    edge = EdgeSlots(edge_rule("orphan:4"))
    dropped = []
    for frame in range(10):
        slot, evicted = edge.claim(frame)
        dropped.append(evicted)
        edge.commit(slot)
    assert dropped == [None] * 4 + list(range(6))


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
