"""The formats of a trace: Perfetto's packets (ui.perfetto.dev) or Chrome's JSON (chrome://tracing).

Rule: both formats have tracks, slices, instants, counters and flow arrows. Times are ns of the run's clock. The caller
writes the slices of a track in the order of their begins, without overlap. Memory is bounded: packets are written in
blocks, JSON event by event. An incomplete file is readable up to its last block or event.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import IO, Any, Final, NamedTuple, Protocol

from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import Trace, TracePacket, TrackDescriptor, TrackEvent

#: Notes of a slice by name: numbers and texts, also in mappings and sequences.
Notes = Mapping[str, Any]
NO_NOTES: Notes = {}
SEQUENCE: Final = 1
BLOCK_BYTES: Final = 1 << 18
PLAIN_BYTES: Final = 16 << 20
LONGEST_INT: Final = 1 << 63
#: Tag of `Trace.packet`. In a trace, this tag and a length stand before each packet.
PACKET_FIELD: Final = b"\x0a"
NS_PER_US: Final = 1000
CATEGORY: Final = "frame"


class FlowArrow(NamedTuple):
    """The arrow that connects the jobs of a frame, as it goes through one slice.

    `number`: number of the arrow, above 0. `begins`, `ends`: whether the arrow begins or ends at the slice.
    """

    number: int
    begins: bool = False
    ends: bool = False


class Sink(Protocol):
    """A writer of a trace file. Tracks have numbers, which its methods return and take.

    A viewer shows the `notes` of a slice or event, by name.
    """

    def recurring(self, names: Iterable[str]) -> None:
        """Announce names of slices and instants that will occur often."""

    def process(self, name: str) -> int:
        """Begin a group of tracks named `name`, and return the number of its top track."""

    def track(self, name: str, parent: int, rank: int = 0) -> int:
        """Begin a track named `name` below the track `parent`, and return its number.

        A viewer may show tracks of equal name as one track.

        `rank`: place among the tracks below `parent`, the smallest on top.
        """

    def counter_track(self, name: str, parent: int, rank: int = 0, unit: str = "") -> int:
        """Begin a track of a counter `name` below the track `parent`, and return its number.

        `rank`: as in `track`. `unit`: unit of the values, such as "B"; "" for none.
        """

    def slice(
        self, track: int, begin_ns: int, end_ns: int, name: str, notes: Notes = NO_NOTES, flow: FlowArrow | None = None
    ) -> None:
        """Write the slice `name` of the track number `track`, from `begin_ns` to `end_ns`.

        `notes`: notes of the slice. `flow`: arrow that goes through the slice; None for no arrow.
        """

    def begin(self, track: int, at_ns: int, name: str, notes: Notes = NO_NOTES) -> None:
        """Begin the slice `name` of the track at `at_ns`; a call of `end` ends it."""

    def end(self, track: int, at_ns: int) -> None:
        """End the slice of the track that `begin` began."""

    def instant(self, track: int, at_ns: int, name: str, notes: Notes = NO_NOTES) -> None:
        """Write an event without duration on the track."""

    def count(self, track: int, at_ns: int, value: float) -> None:
        """Give the counter `track` the value `value` from `at_ns` on."""

    def close(self) -> None:
        """Write the rest of the trace to the file. The file stays open."""


class PacketSink:
    """A `Sink` that writes Perfetto's packets.

    The first `plain_bytes` bytes are plain packets, so any protobuf reader can read a trace of some minutes. Later
    packets are compressed in blocks (`TracePacket.compressed_packets`, zlib), as Perfetto's own recorder does.
    Recurring names are interned: the first packet that uses a name defines the name's number.

    `file`: file for bytes; the caller closes it after `close`.
    """

    def __init__(self, file: IO[bytes], plain_bytes: int = PLAIN_BYTES) -> None:
        self._file, self._block, self._plain_bytes = file, bytearray(), plain_bytes
        self._tracks = self._processes = 0
        self._recurring: set[str] = set()
        self._event_names: dict[str, int] = {}
        self._note_names: dict[str, int] = {}
        self._ended, self._counted = (
            _packet(0, 0, kind) for kind in (TrackEvent.TYPE_SLICE_END, TrackEvent.TYPE_COUNTER)
        )
        first = TracePacket(trusted_packet_sequence_id=SEQUENCE)
        first.sequence_flags = TracePacket.SEQ_INCREMENTAL_STATE_CLEARED
        self._add(first)

    def recurring(self, names: Iterable[str]) -> None:
        self._recurring.update(names)

    def process(self, name: str) -> int:
        self._processes += 1
        return self._describe(name, sibling_order_rank=self._processes, child_ordering=TrackDescriptor.EXPLICIT)

    def track(self, name: str, parent: int, rank: int = 0) -> int:
        ordering = TrackDescriptor.EXPLICIT
        return self._describe(name, parent_uuid=parent, sibling_order_rank=rank, child_ordering=ordering)

    def counter_track(self, name: str, parent: int, rank: int = 0, unit: str = "") -> int:
        return self._describe(name, parent_uuid=parent, sibling_order_rank=rank, counter={"unit_name": unit})

    def slice(
        self, track: int, begin_ns: int, end_ns: int, name: str, notes: Notes = NO_NOTES, flow: FlowArrow | None = None
    ) -> None:
        packet = self._named(track, begin_ns, TrackEvent.TYPE_SLICE_BEGIN, name, notes)
        if flow is not None:
            packet.track_event.flow_ids.append(flow.number)
        self._add(packet)
        self.end(track, end_ns)

    def begin(self, track: int, at_ns: int, name: str, notes: Notes = NO_NOTES) -> None:
        packet = _packet(track, at_ns, TrackEvent.TYPE_SLICE_BEGIN)
        packet.track_event.name = name
        for key, value in notes.items():
            _fill(packet.track_event.debug_annotations.add(name=key), value)
        self._add(packet)

    def end(self, track: int, at_ns: int) -> None:
        packet = self._ended  # reused: the ends of slices differ only in these two numbers
        packet.timestamp, packet.track_event.track_uuid = at_ns, track
        self._add(packet)

    def instant(self, track: int, at_ns: int, name: str, notes: Notes = NO_NOTES) -> None:
        self._add(self._named(track, at_ns, TrackEvent.TYPE_INSTANT, name, notes))

    def count(self, track: int, at_ns: int, value: float) -> None:
        packet = self._counted
        event = packet.track_event
        packet.timestamp, event.track_uuid = at_ns, track
        if -LONGEST_INT <= value < LONGEST_INT and value == int(value):
            event.counter_value = int(value)
        else:
            event.double_counter_value = value  # setting one of the two fields unsets the other
        self._add(packet)

    def close(self) -> None:
        self._write_block()
        self._file.flush()

    def _describe(self, name: str, **fields: Any) -> int:
        self._tracks += 1
        self._add(TracePacket(track_descriptor=TrackDescriptor(uuid=self._tracks, name=name, **fields)))
        return self._tracks

    def _named(self, track: int, at_ns: int, kind: int, name: str, notes: Notes) -> Any:
        """Return a packet with the event `name` on the track number `track`.

        Recurring names and names of notes are interned.

        `kind`: as in `_packet`.
        """
        packet = _packet(track, at_ns, kind)
        event = packet.track_event
        if name in self._recurring:
            event.name_iid = self._event_names.get(name) or _intern(self._event_names, name, packet, "event_names")
            packet.sequence_flags = TracePacket.SEQ_NEEDS_INCREMENTAL_STATE
        else:
            event.name = name
        for key, value in notes.items():
            number = self._note_names.get(key) or _intern(self._note_names, key, packet, "debug_annotation_names")
            _fill(event.debug_annotations.add(name_iid=number), value)
            packet.sequence_flags = TracePacket.SEQ_NEEDS_INCREMENTAL_STATE
        return packet

    def _add(self, packet: Any) -> None:
        content = packet.SerializeToString()
        self._block += PACKET_FIELD + _varint(len(content)) + content
        if len(self._block) >= BLOCK_BYTES:
            self._write_block()

    def _write_block(self) -> None:
        content = bytes(self._block)
        self._block.clear()
        self._plain_bytes -= len(content)
        if self._plain_bytes < 0:
            content = Trace(packet=[TracePacket(compressed_packets=zlib.compress(content))]).SerializeToString()
        self._file.write(content)


@lru_cache(maxsize=1024)
def _varint(number: int) -> bytes:
    """Return `number` as a protobuf varint: seven bits a byte, the lowest first.

    All bytes but the last have the top bit set.
    """
    groups = bytearray()
    while number > 0x7F:
        groups.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes((*groups, number))


def _packet(track: int, at_ns: int, kind: int) -> Any:
    """Return a packet with an event at `at_ns` on the track number `track`.

    `kind`: type of the event in `TrackEvent`, such as TYPE_INSTANT.
    """
    packet = TracePacket(timestamp=at_ns, trusted_packet_sequence_id=SEQUENCE)
    event = packet.track_event
    event.type, event.track_uuid = kind, track
    return packet


def _intern(numbers: dict[str, int], name: str, packet: Any, table: str) -> int:
    """Give `name` the next number, define it in `packet`, and return the number.

    `numbers`: numbers by name so far. `table`: field of the packet's interned data that defines such names.
    """
    numbers[name] = number = len(numbers) + 1
    getattr(packet.interned_data, table).add(iid=number, name=name)
    return number


def _fill(note: Any, value: Any) -> None:
    """Set the debug annotation `note` to `value`, a number, a text or None, also nested in mappings and sequences."""
    if isinstance(value, bool):
        note.bool_value = value
    elif isinstance(value, int) and -LONGEST_INT <= value < LONGEST_INT:
        note.int_value = value
    elif isinstance(value, float):
        note.double_value = value
    elif value is None or (isinstance(value, Mapping | Sequence) and not value):
        note.string_value = "none"
    elif isinstance(value, Mapping):
        for key, below in value.items():
            _fill(note.dict_entries.add(name=str(key)), below)
    elif isinstance(value, Sequence) and not isinstance(value, str):
        for below in value:
            _fill(note.array_values.add(), below)
    else:
        note.string_value = str(value)


class ChromeSink:
    """A `Sink` that writes Chrome's JSON, event by event.

    The format is the Trace Event Format, docs.google.com/document/d/1CvAClvFfyA5R-PhYUmn5OOQtYMH4h6I0nSsKchNAySU. In
    the file, a group of tracks is a process, and a track is a thread. Times in the file are in us.

    `file`: file for text; the caller closes it after `close`.
    """

    def __init__(self, file: IO[str]) -> None:
        self._file, self._is_first, self._tracks = file, True, 0
        self._names: dict[int, str] = {}
        self._process_of: dict[int, int] = {}
        file.write('{"displayTimeUnit": "ms", "traceEvents": [')

    def recurring(self, names: Iterable[str]) -> None:
        """Do nothing: Chrome's JSON has every name in full."""

    def process(self, name: str) -> int:
        number = self._new(name)
        self._process_of[number] = number
        self._write(ph="M", pid=number, name="process_name", args={"name": name})
        return number

    def track(self, name: str, parent: int, rank: int = 0) -> int:  # noqa: ARG002 - tracks stand in the order of the calls
        number = self._child(name, parent)
        pid = self._process_of[number]
        self._write(ph="M", pid=pid, tid=number, name="thread_name", args={"name": self._names[number]})
        self._write(ph="M", pid=pid, tid=number, name="thread_sort_index", args={"sort_index": number})
        return number

    def counter_track(self, name: str, parent: int, rank: int = 0, unit: str = "") -> int:  # noqa: ARG002
        return self._child(f"{name}, {unit}" if unit else name, parent)

    def slice(
        self, track: int, begin_ns: int, end_ns: int, name: str, notes: Notes = NO_NOTES, flow: FlowArrow | None = None
    ) -> None:
        times = {"ts": begin_ns / NS_PER_US, "dur": (end_ns - begin_ns) / NS_PER_US}
        self._write(ph="X", **self._at(track), **times, name=name, args=notes)
        if flow is not None:
            phase = "s" if flow.begins else "f" if flow.ends else "t"
            where = {**self._at(track), "ts": begin_ns / NS_PER_US, "bp": "e"}
            self._write(ph=phase, **where, id=flow.number, cat=CATEGORY, name=CATEGORY)

    def begin(self, track: int, at_ns: int, name: str, notes: Notes = NO_NOTES) -> None:
        self._write(ph="B", **self._at(track), ts=at_ns / NS_PER_US, name=name, args=notes)

    def end(self, track: int, at_ns: int) -> None:
        self._write(ph="E", **self._at(track), ts=at_ns / NS_PER_US)

    def instant(self, track: int, at_ns: int, name: str, notes: Notes = NO_NOTES) -> None:
        self._write(ph="i", s="t", **self._at(track), ts=at_ns / NS_PER_US, name=name, args=notes)

    def count(self, track: int, at_ns: int, value: float) -> None:
        where = {"pid": self._process_of[track], "ts": at_ns / NS_PER_US}
        self._write(ph="C", **where, name=self._names[track], args={"value": value})

    def close(self) -> None:
        self._file.write("\n]}\n")
        self._file.flush()

    def _new(self, name: str) -> int:
        self._tracks += 1
        self._names[self._tracks] = name
        return self._tracks

    def _child(self, name: str, parent: int) -> int:
        """Begin a track below `parent`, and return its number.

        If `parent` is no group, its name is put in front of `name`, because Chrome's threads have no hierarchy.
        """
        pid = self._process_of[parent]
        number = self._new(name if parent == pid else f"{self._names[parent]}: {name}")
        self._process_of[number] = pid
        return number

    def _at(self, track: int) -> dict[str, int]:
        return {"pid": self._process_of[track], "tid": track}

    def _write(self, **event: Any) -> None:
        self._file.write("\n" if self._is_first else ",\n")
        self._is_first = False
        self._file.write(json.dumps(event, separators=(",", ":"), allow_nan=False))
