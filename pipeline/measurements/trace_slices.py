"""Named slices of a trace as samples: Perfetto's packets and Chrome's JSON. No trace processor is needed or fetched.

Slices come from track events (with interned names, delta clocks and compressed packets; those of older Chrome too) and
from marks of Android's atrace in ftrace packets. A slice is a wall time: it contains whatever its thread waited for.
Sources: the comments of Perfetto's protos (track_event.proto, clock_snapshot.proto); Chrome's Trace Event Format.
"""

from __future__ import annotations

import re
import zlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

from trilane.errors import BadInputError
from trilane.pipeline.measurements.measurement import Found, is_finite

if TYPE_CHECKING:
    from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import TracePacket

WHAT: Final = "a slice of the trace, with whatever its thread waited for"
MOST_UNPACKED_BYTES: Final = 512 << 20
FIRST_OWN_CLOCK, LAST_OWN_CLOCK = 64, 127  # clocks of a sequence
STATE_CLEARED: Final = 1
ATRACE: Final = re.compile(r"([BE])(?:\|(\d+)(?:\|(.*))?)?\s*", re.DOTALL)
PACKET: Final = 0x0A  # field 1 of a Trace, with a length


def is_perfetto(head: bytes) -> bool:
    """Say whether a file begins as a trace of Perfetto does: a packet with its length, which is no text."""
    if head[:1] != bytes([PACKET]):
        return False
    try:
        text = head.decode()
    except UnicodeDecodeError as error:
        return error.start < len(head) - 4  # the head may end within a character
    return any(ord(letter) < 9 or 13 < ord(letter) < 32 for letter in text)


def read_perfetto(data: bytes) -> Found:
    """Read the slices of a Perfetto trace. Raises BadInputError for bytes that are none."""
    found = Found("Perfetto trace", "wall times of named slices")
    _Slices(found).read(data)
    return found


class _Sequence:
    """What a writer of packets has said so far: names by number, its clocks, its default track and clock."""

    def __init__(self) -> None:
        self.names: dict[int, str] = {}
        self.clocks: dict[int, list[int]] = {}  # clock: its last time, ns of a tick, whether times are differences
        self.default_clock = 0
        self.default_track = 0


class _Slices:
    def __init__(self, found: Found) -> None:
        self._found = found
        self._sequences: dict[int, _Sequence] = defaultdict(_Sequence)
        self._open: dict[object, list[tuple[str, int]]] = defaultdict(list)
        self._left = MOST_UNPACKED_BYTES

    def read(self, data: bytes) -> None:
        from google.protobuf.message import DecodeError

        packets = 0
        try:
            for packet in self._packets(data):
                packets += 1
                self._packet(packet)
        except (DecodeError, zlib.error) as error:
            if not packets:
                raise BadInputError("the file", "bytes that do not parse", "a trace of Perfetto") from error
            self._found.refuse(f"packet {packets}", "the file is cut off or damaged from here on")
        unended = sum(len(stack) for stack in self._open.values())
        if unended:
            self._found.skipped["a slice that does not end in the trace"] += unended

    def _packets(self, data: bytes, *, packed: bool = False) -> Iterator[TracePacket]:
        """Yield the packets one by one, so that a long trace is never held as objects. Raises DecodeError."""
        from google.protobuf.message import DecodeError
        from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import TracePacket

        self._left -= len(data)
        if self._left < 0:
            raise BadInputError("the trace", "over 512 MiB unpacked", "less", "record for a shorter time")
        at = 0
        while at < len(data):
            size, start = _varint(data, at + 1)
            if data[at] != PACKET or size < 0 or start + size > len(data):
                raise DecodeError("a packet is cut off")
            packet = TracePacket()
            packet.ParseFromString(data[start : start + size])
            at = start + size
            if packet.compressed_packets and packed:
                raise DecodeError("packed packets in packed packets")
            if packet.compressed_packets:
                unpacker = zlib.decompressobj()
                inner = unpacker.decompress(packet.compressed_packets, self._left + 1)
                yield from self._packets(inner, packed=True)
            else:
                yield packet

    def _packet(self, packet: TracePacket) -> None:
        sequence = self._sequences[packet.trusted_packet_sequence_id]
        if packet.sequence_flags & STATE_CLEARED or packet.incremental_state_cleared:
            sequence = self._sequences[packet.trusted_packet_sequence_id] = _Sequence()
        if packet.HasField("trace_packet_defaults"):
            sequence.default_clock = packet.trace_packet_defaults.timestamp_clock_id
            sequence.default_track = packet.trace_packet_defaults.track_event_defaults.track_uuid
        for each in packet.interned_data.event_names:
            sequence.names[each.iid] = each.name
        for clock in packet.clock_snapshot.clocks:
            if FIRST_OWN_CLOCK <= clock.clock_id <= LAST_OWN_CLOCK:
                tick = int(clock.unit_multiplier_ns) or 1
                sequence.clocks[clock.clock_id] = [clock.timestamp * tick, tick, int(clock.is_incremental)]
        if packet.HasField("track_event"):
            self._event(packet, sequence)
        for event in packet.ftrace_events.event:
            if event.HasField("print"):
                self._mark(event.pid, event.timestamp, event.print.buf)

    def _time(self, packet: TracePacket, sequence: _Sequence) -> int:
        clock = sequence.clocks.get(packet.timestamp_clock_id or sequence.default_clock)
        if clock is None:
            return int(packet.timestamp)
        last, tick, incremental = clock
        clock[0] = packet.timestamp * tick + (last if incremental else 0)
        return clock[0]

    def _event(self, packet: TracePacket, sequence: _Sequence) -> None:
        event, at = packet.track_event, self._time(packet, sequence)
        track = ("track", event.track_uuid or sequence.default_track or packet.trusted_packet_sequence_id)
        phase = event.legacy_event.phase if event.type == event.TYPE_UNSPECIFIED else 0
        name = event.name or sequence.names.get(event.name_iid, "") or f"unnamed {event.name_iid}"
        if event.type == event.TYPE_SLICE_BEGIN or phase == ord("B"):
            self._open[track].append((name, at))
        elif event.type == event.TYPE_SLICE_END or phase == ord("E"):
            self._end(track, at)
        elif phase == ord("X"):
            self._take(name, at, at + 1000 * event.legacy_event.duration_us)

    def _mark(self, thread: int, at: int, text: str) -> None:
        """Take a mark of atrace: `B|process|name` begins a slice of the thread, `E` ends its last one."""
        mark = ATRACE.fullmatch(text)
        if mark is None:
            return
        if mark[1] == "B":
            self._open["thread", thread].append(((mark[3] or "").strip(), at))
        else:
            self._end(("thread", thread), at)

    def _end(self, track: object, at: int) -> None:
        if not self._open[track]:
            self._found.skip("the end of a slice that began before the trace")
            return
        self._take(*self._open[track].pop(), at)

    def _take(self, name: str, begin: int, end: int) -> None:
        if end < begin:
            self._found.refuse(f"slice {name!r} at {begin} ns", f"it ends {begin - end} ns before it begins")
        elif end == begin:
            self._found.skip("a slice without length")
        else:
            self._found.sample(f"slice {name!r} at {begin} ns", name, "wall", end - begin, "ns", WHAT)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return the number at `at` in protobuf's form and the place behind it; -1 where it does not end."""
    value = 0
    for index in range(10):
        if at + index >= len(data):
            break
        byte = data[at + index]
        value |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return value, at + index + 1
    return -1, at


def read_chrome(events: Sequence[Any]) -> Found:
    """Read the slices of a trace in Chrome's format: complete events, and pairs of begin and end. Times are us."""
    found = Found("Chrome trace (JSON)", "wall times of named slices")
    open_: dict[tuple[object, object], list[tuple[str, float]]] = defaultdict(list)
    for index, event in enumerate(events):
        row = f"event {index}"
        if not isinstance(event, dict):
            found.refuse(row, "no table")
            continue
        name, phase, track = str(event.get("name", "")), event.get("ph"), (str(event.get("pid")), str(event.get("tid")))
        row = f"{row}: {name}"
        if phase == "X":
            if event.get("dur") == 0:
                found.skip("a slice without length")
            else:
                found.sample(row, name, "wall", event.get("dur"), "us", WHAT)
        elif phase in ("B", "E"):
            at = event.get("ts")
            if not is_finite(at):
                found.refuse(row, "ts is no number")
            elif phase == "B":
                open_[track].append((name, float(at)))
            elif open_[track] and name not in ("", open_[track][-1][0]):
                found.skip("the end of another slice than the one that is open")
            elif open_[track]:
                name, begin = open_[track].pop()
                found.sample(row, name, "wall", float(at) - begin, "us", WHAT)
            else:
                found.skip("the end of a slice that began before the trace")
        else:
            found.skip("no slice, such as a counter or a name")
    return found
