"""Slices of traces as samples: rows of Perfetto's own tests, a trace that Trilane writes, Chrome's events, damage."""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Callable
from typing import Any

import pytest
from google.protobuf import text_format
from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import Trace, TracePacket

from trilane.errors import BadInputError
from trilane.pipeline.measurements.measurement import Measurements

#: google/perfetto, test/trace_processor/diff_tests, `test_slice_self_dur`: two slices, one in the other.
ATRACE = """
packet { ftrace_events { cpu: 0
  event { timestamp: 1000 pid: 10 print { buf: "B|10|ParentSlice" } }
  event { timestamp: 1200 pid: 10 print { buf: "B|10|ChildSlice" } }
  event { timestamp: 1500 pid: 10 print { buf: "E|10" } }
  event { timestamp: 2000 pid: 10 print { buf: "E|10" } }
} }
"""
#: By the comments of track_event.proto and clock_snapshot.proto: a name by number, and a clock of the sequence that
#: counts microseconds from event to event. Run 1 from 1,001,000 ns for 4 us, run 2 for 6 us.
INTERNED = """
packet { trusted_packet_sequence_id: 1 sequence_flags: 1 timestamp: 0
  clock_snapshot { clocks { clock_id: 64 timestamp: 1000 is_incremental: true unit_multiplier_ns: 1000 }
                   clocks { clock_id: 6 timestamp: 1000000 } }
  trace_packet_defaults { timestamp_clock_id: 64 track_event_defaults { track_uuid: 7 } }
  interned_data { event_names { iid: 3 name: "run" } } }
packet { trusted_packet_sequence_id: 1 timestamp: 1 track_event { type: TYPE_SLICE_BEGIN name_iid: 3 } }
packet { trusted_packet_sequence_id: 1 timestamp: 4 track_event { type: TYPE_SLICE_END } }
packet { trusted_packet_sequence_id: 1 timestamp: 1 track_event { type: TYPE_SLICE_BEGIN name_iid: 3 } }
packet { trusted_packet_sequence_id: 1 timestamp: 6 track_event { type: TYPE_SLICE_END } }
"""


def binary(text: str) -> bytes:
    return bytes(text_format.Parse(text, Trace()).SerializeToString())


def samples(found: Measurements) -> dict[str, tuple[float, ...]]:
    assert {each.kind for each in found.measurements} == {"wall"}
    return {each.name: each.samples_ms for each in found.measurements}


#: A thread that moves from CPU 0 to 1 and back: runs from 1 to 11 and from 50 to 60 us. CPU 0's bundle comes first.
MOVED = """
packet { ftrace_events { cpu: 0 event { timestamp: 1000 pid: 10 print { buf: "B|10|run" } }
                                event { timestamp: 60000 pid: 10 print { buf: "E|10" } } } }
packet { ftrace_events { cpu: 1 event { timestamp: 11000 pid: 10 print { buf: "E|10" } }
                                event { timestamp: 50000 pid: 10 print { buf: "B|10|run" } } } }
"""


#: google/perfetto, diff_tests/parser/track_event: a slice that begins on one thread and ends on another, 100 ns.
TWO_THREADS = """
packet { trusted_packet_sequence_id: 1 timestamp: 5100 incremental_state_cleared: true
  track_event { track_uuid: 12 categories: "cat" name: "event1_on_async2" type: 1 } }
packet { trusted_packet_sequence_id: 2 timestamp: 5200
  track_event { track_uuid: 12 categories: "cat" name: "event1_on_async2" type: 2 } }
"""
#: By the comments of track_event.proto events of older Chrome: phase X (88) of 3 us, phases B and E of 2 us.
COMPLETE = """
packet { trusted_packet_sequence_id: 1 timestamp: 1000
  track_event { name: "infer" legacy_event { phase: 88 duration_us: 3 } } }
"""
BEGIN_AND_END = """
packet { trusted_packet_sequence_id: 1 timestamp: 1000
  track_event { name: "infer" legacy_event { phase: 66 } } }
packet { trusted_packet_sequence_id: 1 timestamp: 3000 track_event { legacy_event { phase: 69 } } }
packet { trusted_packet_sequence_id: 1 timestamp: 3000 track_event { name: "mark" legacy_event { phase: 73 } } }
"""


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (ATRACE, {"ChildSlice": (3e-4,), "ParentSlice": (1e-3,)}),
        (INTERNED, {"run": (0.004, 0.006)}),
        (MOVED, {"run": (0.01, 0.01)}),
        (TWO_THREADS, {"event1_on_async2": (1e-4,)}),
        (COMPLETE, {"infer": (0.003,)}),
        (BEGIN_AND_END, {"infer": (0.002,)}),
    ],
    ids=["a thread", "names by number", "several cpus", "two threads", "a complete event", "begin and end"],
)
def test_slices_are_samples(
    text: str, expected: dict[str, tuple[float, ...]], read: Callable[[bytes], Measurements]
) -> None:
    assert samples(read(binary(text))) == expected


#: The last two events need what the lost packets said.
NEEDY = INTERNED.replace("timestamp: 1 track", "sequence_flags: 2 timestamp: 1 track").replace(
    "timestamp: 6", "sequence_flags: 2 timestamp: 6"
)


@pytest.mark.parametrize(
    ("text", "expected", "count", "reason"),
    [
        (NEEDY, (0.004, 0.006), 0, ""),
        (NEEDY.replace("sequence_flags: 1 ", ""), (), 3, "in packets that are lost"),
        (INTERNED.replace("clock_id: 64", "clock_id: 65", 1), (), 4, "on a clock that the trace does not explain"),
        (INTERNED.replace("clock_id: 64", "clock_id: 130"), (0.004, 0.006), 0, ""),
    ],
)
def test_events_whose_names_or_clock_are_not_there_are_counted(
    text: str, expected: tuple[float, ...], count: int, reason: str, read: Callable[[bytes], Measurements]
) -> None:
    if not expected:
        with pytest.raises(BadInputError):
            read(binary(text))
        text += ATRACE
    found = read(binary(text))
    assert samples(found).get("run", ()) == expected
    assert sum(many for why, many in found.skipped.items() if reason and reason in why) == count


def test_packed_packets(read: Callable[[bytes], Measurements]) -> None:
    packed = Trace(packet=[TracePacket(compressed_packets=zlib.compress(binary(INTERNED)))]).SerializeToString()
    assert samples(read(packed)) == {"run": (0.004, 0.006)}
    twice = Trace(packet=[TracePacket(compressed_packets=zlib.compress(packed))]).SerializeToString()
    with pytest.raises(BadInputError, match="bytes that do not parse"):
        read(twice)


BROKEN: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "cut off": (lambda data: data[:-3], "packet 4: the file is cut off or damaged from here on"),
    "a length that lies": (lambda data: data + b"\n\xff\xff\x7f\x00", "packet 5: the file is cut off"),
    "a length without an end": (lambda data: data + b"\n" + b"\xff" * 12, "packet 5: the file is cut off"),
    "another field": (lambda data: data + b"\x12\x01\x00", "packet 5: the file is cut off"),
    "a packet of noise": (lambda data: data + b"\n\x04\xff\xff\xff\xff", "packet 5: the file is cut off"),
    "packed noise": (
        lambda data: data + Trace(packet=[TracePacket(compressed_packets=b"no zlib")]).SerializeToString(),
        "packet 5: the file is cut off",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_damage_is_named_and_what_came_before_stays(name: str, read: Callable[[bytes], Measurements]) -> None:
    change, reason = BROKEN[name]
    found = read(change(binary(INTERNED)))
    assert samples(found)["run"][0] == 0.004
    assert [f"{each.row}: {each.reason}"[: len(reason)] for each in found.refused] == [reason]


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("timestamp: 2000", "timestamp: 999", "the end of a slice"),
        ("timestamp: 2000", "timestamp: 1000", "a slice without length"),
        ("timestamp: 2000", "timestamp: 9000000000000000000", "over an hour"),
        ('timestamp: 2000 pid: 10 print { buf: "E', 'timestamp: 2000 pid: 11 print { buf: "E', "the end of a slice"),
    ],
)
def test_slices_that_cannot_be(old: str, new: str, reason: str, read: Callable[[bytes], Measurements]) -> None:
    """The slice inside stays."""
    found = read(binary(ATRACE.replace(old, new)))
    assert samples(found) == {"ChildSlice": (3e-4,)}
    said = [each.reason for each in found.refused] + list(found.skipped)
    assert any(reason in each for each in said), said


EVENTS: list[dict[str, Any]] = [
    {"name": "seg", "ph": "X", "ts": 10, "dur": 4000, "pid": 1, "tid": 1},
    {"name": "seg", "ph": "B", "ts": 5000, "pid": 1, "tid": 1},
    {"name": "inner", "ph": "B", "ts": 5100, "pid": 1, "tid": 1},
    {"ph": "E", "ts": 5600, "pid": 1, "tid": 1},
    {"ph": "E", "ts": 11000, "pid": 1, "tid": 1},
    {"name": "process_name", "ph": "M", "pid": 1, "args": {"name": "x"}},
]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            "# tracer: nop\n#\n app-1 (1) [000] ...1 5.1: tracing_mark_write: B|1|seg\n",
            "found a trace as text (ftrace or systrace), expected JSON, or a trace of Perfetto; "
            "convert it with Perfetto's tool: traceconv json file trace.json",
        ),
        ("TRACE:\n  app-123 (  100) [000] ...1 12.345678: tracing_mark_write: B|100|seg\n", "traceconv json file"),
        (ATRACE, "found a Perfetto trace as text, expected the trace itself, or JSON; convert it with"),
        ("a note on [000] 5 tracers\n", "text that begins with"),
    ],
)  # fmt: skip
def test_traces_as_text_name_the_conversion(text: str, reason: str, read: Callable[[bytes], Measurements]) -> None:
    with pytest.raises(BadInputError, match=re.escape(reason)):
        read(text.encode())


@pytest.mark.parametrize("document", [EVENTS, {"traceEvents": EVENTS}], ids=["list", "table"])
def test_chrome_events(document: Any, read: Callable[[bytes], Measurements]) -> None:
    assert samples(read(json.dumps(document).encode())) == {"seg": (4.0, 6.0), "inner": (0.5,)}


@pytest.mark.parametrize(
    ("place", "key", "value", "row", "reason"),
    [
        (0, "dur", -4000, "event 0: seg", "negative"),
        (0, "dur", None, "event 0: seg", "nothing"),
        (0, "dur", "4", "event 0: seg", "a number was expected"),
        (0, "dur", True, "event 0: seg", "a number was expected"),
        (0, "dur", float("nan"), "event 0: seg", "finite"),
        (0, "dur", float("inf"), "event 0: seg", "finite"),
        (0, "dur", 1e13, "event 0: seg", "over an hour"),
        (4, "ts", 4000, "event 4: ", "negative"),
        (4, "ts", "x", "event 4: ", "ts is no number"),
        (2, "ts", [], "event 2: inner", "ts is no number"),
    ],
)
def test_broken_events(
    place: int, key: str, value: Any, row: str, reason: str, read: Callable[[bytes], Measurements]
) -> None:
    changed = [{**each, key: value} if index == place else each for index, each in enumerate(EVENTS)]
    found = read(json.dumps(changed).encode())
    assert [each.row for each in found.refused] == [row]
    assert reason in found.refused[0].reason
    assert "seg" in samples(found)


def asynchronous(phase: str, ts: float, name: str = "job", **keys: Any) -> dict[str, Any]:
    return {"name": name, "cat": "npu", "ph": phase, "ts": ts, "pid": 1, "tid": 1, "id": "0x1", **keys}


#: Pairs by category, id and name: they overlap, end in another process, and lie within each other.
ASYNCHRONOUS: list[dict[str, Any]] = [
    asynchronous("b", 0),
    asynchronous("b", 1000, id="0x2"),
    asynchronous("b", 1500, "part"),
    asynchronous("n", 1600, "part"),
    asynchronous("e", 2000, "part"),
    asynchronous("e", 4000, pid=2),
    asynchronous("e", 7000, id="0x2"),
    asynchronous("S", 0, "old", id=7),
    asynchronous("T", 500, "old", id=7),
    asynchronous("F", 1000, "old", id=7),
]


def test_asynchronous_slices(read: Callable[[bytes], Measurements]) -> None:
    found = read(json.dumps(ASYNCHRONOUS).encode())
    assert samples(found) == {"part": (0.5,), "job": (4.0, 6.0), "old": (1.0,)}
    assert all("with all waiting" in each.what for each in found.measurements)
    assert found.skipped == {"a moment, no slice": 1, "a step within an asynchronous slice": 1}


def test_asynchronous_slices_do_not_mix_with_those_of_threads(read: Callable[[bytes], Measurements]) -> None:
    events = [*ASYNCHRONOUS, {"name": "job", "ph": "X", "ts": 1, "dur": 3000, "pid": 1, "tid": 1}]
    assert samples(read(json.dumps(events).encode())) == {
        "job": (3.0,), "part": (0.5,), "job (async)": (4.0, 6.0), "old": (1.0,),
    }  # fmt: skip


def test_local_ids_are_of_their_process(read: Callable[[bytes], Measurements]) -> None:
    local = {"id": None, "id2": {"local": "0x5"}}
    events = [
        asynchronous("b", 0, **local),
        asynchronous("b", 1000, **local, pid=2),
        asynchronous("e", 3000, **local),
        asynchronous("e", 9000, **local, pid=2),
    ]
    assert samples(read(json.dumps(events).encode())) == {"job": (3.0, 8.0)}


def test_other_events_are_counted_by_their_kind(read: Callable[[bytes], Measurements]) -> None:
    others = [{"name": "x", "ph": phase, "ts": 1} for phase in ("M", "C", "C", "i", "s", "f", "?", "", None)]
    events = [*others, asynchronous("b", 0), asynchronous("e", 1, id="0x3"), asynchronous("b", 5, id=None), EVENTS[0]]
    found = read(json.dumps(events).encode())
    assert found.skipped == {
        "a name or another fact of a process or thread, no slice": 1,
        "a counter, no slice": 2,
        "a moment, no slice": 1,
        "an arrow between slices, no slice": 2,
        "an event of an unknown kind": 3,
        "the end of a slice that began before the trace": 1,
        "a slice that does not end in the trace": 1,
    }
    assert [each.row for each in found.refused] == ["event 11: job"]
    assert "without a name or an id" in found.refused[0].reason
