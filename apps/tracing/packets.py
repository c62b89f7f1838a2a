"""A trace as Perfetto's packets (ui.perfetto.dev, trace processor). Rule: bounded memory, and a long trace stays small.

Packets are collected until a block is full, and written. The first PLAIN_BYTES are packets as they are, so that a
protobuf reader needs nothing else to read a trace of some minutes; what follows is compressed, a block at a time
(`TracePacket.compressed_packets`, zlib, as Perfetto's own recorder writes them). Names that come again and again are
interned: the first packet that uses one brings it along. A file that ends early is whole up to its last block.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import IO, Any, Final

from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import Trace, TracePacket, TrackDescriptor, TrackEvent

from trilane.apps.tracing.sink import NO_NOTES, Flow, Notes

SEQUENCE: Final = 1
PACKETS_PER_BLOCK: Final = 4096
PLAIN_BYTES: Final = 16 << 20
LONGEST_INT: Final = 1 << 63


class PacketSink:
    """`Sink` of a file. `file`: opened for writing bytes; whoever opened it closes it, after `close`."""

    def __init__(self, file: IO[bytes], plain_bytes: int = PLAIN_BYTES) -> None:
        self._file, self._block, self._plain_bytes = file, Trace(), plain_bytes
        self._in_block = self._tracks = self._processes = 0
        self._recurring: set[str] = set()
        self._event_names: dict[str, int] = {}
        self._note_names: dict[str, int] = {}
        self._packet().sequence_flags = TracePacket.SEQ_INCREMENTAL_STATE_CLEARED
        self._block.packet[0].trusted_packet_sequence_id = SEQUENCE

    def recurring(self, names: Iterable[str]) -> None:
        self._recurring.update(names)

    def process(self, name: str) -> int:
        self._processes += 1
        descriptor = self._descriptor(name)
        descriptor.sibling_order_rank = self._processes
        descriptor.child_ordering = TrackDescriptor.EXPLICIT
        return self._tracks

    def track(self, name: str, parent: int, rank: int = 0) -> int:
        descriptor = self._descriptor(name)
        descriptor.parent_uuid, descriptor.sibling_order_rank = parent, rank
        descriptor.child_ordering = TrackDescriptor.EXPLICIT
        return self._tracks

    def counter_track(self, name: str, parent: int, rank: int = 0, unit: str = "") -> int:
        descriptor = self._descriptor(name)
        descriptor.parent_uuid, descriptor.sibling_order_rank = parent, rank
        descriptor.counter.unit_name = unit
        return self._tracks

    def slice(
        self, track: int, begin_ns: int, end_ns: int, name: str, notes: Notes = NO_NOTES, flow: Flow | None = None
    ) -> None:
        event = self._named(track, begin_ns, TrackEvent.TYPE_SLICE_BEGIN, name, notes)
        if flow is not None:
            event.flow_ids.append(flow.number)
        self._event(track, end_ns, TrackEvent.TYPE_SLICE_END)

    def begin(self, track: int, at_ns: int, name: str, notes: Notes = NO_NOTES) -> None:
        event = self._event(track, at_ns, TrackEvent.TYPE_SLICE_BEGIN).track_event
        event.name = name
        for key, value in notes.items():
            _fill(event.debug_annotations.add(name=key), value)

    def end(self, track: int, at_ns: int) -> None:
        self._event(track, at_ns, TrackEvent.TYPE_SLICE_END)

    def instant(self, track: int, at_ns: int, name: str, notes: Notes = NO_NOTES) -> None:
        self._named(track, at_ns, TrackEvent.TYPE_INSTANT, name, notes)

    def count(self, track: int, at_ns: int, value: float) -> None:
        event = self._event(track, at_ns, TrackEvent.TYPE_COUNTER).track_event
        if value == int(value):
            event.counter_value = int(value)
        else:
            event.double_counter_value = value

    def close(self) -> None:
        self._write_block()
        self._file.flush()

    def _descriptor(self, name: str) -> Any:
        self._tracks += 1
        descriptor = self._packet().track_descriptor
        descriptor.uuid, descriptor.name = self._tracks, name
        return descriptor

    def _named(self, track: int, at_ns: int, kind: int, name: str, notes: Notes) -> Any:
        """An event whose name and notes are interned, where they recur."""
        packet = self._event(track, at_ns, kind)
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
        return event

    def _event(self, track: int, at_ns: int, kind: int) -> Any:
        packet = self._packet()
        packet.timestamp, packet.trusted_packet_sequence_id = at_ns, SEQUENCE
        event = packet.track_event
        event.type, event.track_uuid = kind, track
        return packet

    def _packet(self) -> Any:
        if self._in_block == PACKETS_PER_BLOCK:
            self._write_block()
        self._in_block += 1
        return self._block.packet.add()

    def _write_block(self) -> None:
        content = self._block.SerializeToString()
        self._block, self._in_block = Trace(), 0  # a new one: what a message has held it never gives back
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
