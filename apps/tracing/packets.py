"""A trace as Perfetto's packets (ui.perfetto.dev, trace processor). Rule: bounded memory, and a long trace stays small.

Packets are collected until a block is full, and written. The first PLAIN_BYTES are packets as they are, so that a
protobuf reader needs nothing else to read a trace of some minutes; what follows is compressed, a block at a time
(`TracePacket.compressed_packets`, zlib, as Perfetto's own recorder writes them). Names that come again and again are
interned: the first packet that uses one brings it along. A file that ends early is whole up to its last block.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import IO, Any, Final

from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import Trace, TracePacket, TrackDescriptor, TrackEvent

from trilane.apps.tracing.sink import NO_NOTES, Flow, Notes

SEQUENCE: Final = 1
BLOCK_BYTES: Final = 1 << 18
PLAIN_BYTES: Final = 16 << 20
LONGEST_INT: Final = 1 << 63
#: Tag of `Trace.packet`: a trace is its packets one after the other, each behind this and its length.
PACKET_FIELD: Final = b"\x0a"


class PacketSink:
    """`Sink` of a file. `file`: opened for writing bytes; whoever opened it closes it, after `close`."""

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
        self, track: int, begin_ns: int, end_ns: int, name: str, notes: Notes = NO_NOTES, flow: Flow | None = None
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
        packet = self._ended  # used again and again: it holds numbers alone
        packet.timestamp, packet.track_event.track_uuid = at_ns, track
        self._add(packet)

    def instant(self, track: int, at_ns: int, name: str, notes: Notes = NO_NOTES) -> None:
        self._add(self._named(track, at_ns, TrackEvent.TYPE_INSTANT, name, notes))

    def count(self, track: int, at_ns: int, value: float) -> None:
        packet = self._counted
        event = packet.track_event
        packet.timestamp, event.track_uuid = at_ns, track
        if value == int(value):
            event.counter_value = int(value)
        else:
            event.double_counter_value = value  # one of the two is set: it unsets the other
        self._add(packet)

    def close(self) -> None:
        self._write_block()
        self._file.flush()

    def _describe(self, name: str, **fields: Any) -> int:
        self._tracks += 1
        self._add(TracePacket(track_descriptor=TrackDescriptor(uuid=self._tracks, name=name, **fields)))
        return self._tracks

    def _named(self, track: int, at_ns: int, kind: int, name: str, notes: Notes) -> Any:
        """An event whose name and notes are interned, where they recur."""
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


def packets_in(content: bytes) -> Iterator[TracePacket]:
    """The packets of a trace in order, of one as it is or of one that was compressed.

    Raises google.protobuf.message.DecodeError for bytes that are no trace.
    """
    for packet in Trace.FromString(content).packet:
        if packet.HasField("compressed_packets"):
            yield from Trace.FromString(zlib.decompress(packet.compressed_packets)).packet
        else:
            yield packet


@lru_cache(maxsize=1024)
def _varint(number: int) -> bytes:
    """A length as protobuf writes it: seven bits a byte, the lowest first, the top bit set but in the last one."""
    groups = bytearray()
    while number > 0x7F:
        groups.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes((*groups, number))


def _packet(track: int, at_ns: int, kind: int) -> Any:
    """An event of a track."""
    packet = TracePacket(timestamp=at_ns, trusted_packet_sequence_id=SEQUENCE)
    event = packet.track_event
    event.type, event.track_uuid = kind, track
    return packet


def _intern(numbers: dict[str, int], name: str, packet: Any, table: str) -> int:
    """The number of a name that no packet before this one has."""
    numbers[name] = number = len(numbers) + 1
    getattr(packet.interned_data, table).add(iid=number, name=name)
    return number


def _fill(note: Any, value: Any) -> None:
    """Give an annotation its value."""
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
