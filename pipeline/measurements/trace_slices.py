"""Reads the named slices of a trace as samples: Perfetto's packets and Chrome's JSON, without Perfetto's processor.

Slices come from track events, and from marks of Android's atrace in ftrace packets. Track events may have interned
names, delta clocks, compressed packets, or the form of older versions of Chrome. The length of a slice is a wall time:
it contains all waits of the slice's thread.

Sources: the comments of Perfetto's protos (track_event.proto, clock_snapshot.proto); Chrome's Trace Event Format.
"""

from __future__ import annotations

import re
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from trilane.errors import BadInputError
from trilane.pipeline.measurements.measurement import Measurements, is_finite

if TYPE_CHECKING:
    from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import TracePacket

WHAT: Final = "slice, with what its thread waited for"
WHAT_ASYNC: Final = "asynchronous slice, with all waiting"
BEGINS, ENDS, ASYNC = "BbS", "EeF", "beSF"  # phases of Chrome's events; b, e, S and F belong to asynchronous slices
#: Meaning of the events of all other phases, by phase.
NO_SLICES: Final = {
    "M": "a name or another fact of a process or thread, no slice",
    "C": "a counter, no slice",
    **dict.fromkeys("iIRn", "a moment, no slice"),
    **dict.fromkeys("Tp", "a step within an asynchronous slice"),
    **dict.fromkeys("stf", "an arrow between slices, no slice"),
    **dict.fromkeys("NOD", "the life of an object, no slice"),
    **dict.fromkeys("vV", "a dump of the memory, no slice"),
    "P": "a sample of a profiler, no slice",
    "c": "a mark of a clock, no slice",
}
UNENDED: Final = "a slice that does not end in the trace"
MOST_UNPACKED_BYTES: Final = 512 << 20
FIRST_OWN_CLOCK, LAST_OWN_CLOCK = 64, 127  # clocks of a sequence; higher numbers are clocks of the whole trace
STATE_CLEARED, NEEDS_STATE = 1, 2  # flags of a packet
LOST_STATE: Final = "an event whose names or clock were in packets that are lost"
NO_CLOCK: Final = "an event on a clock that the trace does not explain"
ATRACE: Final = re.compile(r"([BE])(?:\|(\d+)(?:\|(.*))?)?\s*", re.DOTALL)
#: Traces as text are recognised, but not read: lines of ftrace, and Perfetto's text.
FTRACE_TEXT: Final = re.compile(r"^# tracer: |\[\d{3}\] .{0,40}\d+\.\d+: \w+: ", re.MULTILINE)
PERFETTO_TEXT: Final = re.compile(r"\s*packet\s*:?\s*\{")
PACKET: Final = 0x0A  # field 1 of a Trace, with a length


def is_perfetto(head: bytes) -> bool:
    """Return whether a file begins like a trace of Perfetto: with a packet and its length, and not with text.

    `head`: first bytes of the file.
    """
    if head[:1] != bytes([PACKET]):
        return False
    try:
        text = head.decode()
    except UnicodeDecodeError as error:
        return error.start < len(head) - 4  # the head may end within a character
    return any(ord(letter) < 9 or 13 < ord(letter) < 32 for letter in text)


def read_perfetto(data: bytes) -> Measurements:
    """Return the slices of a Perfetto trace, whose bytes are `data`. Raises BadInputError for other bytes."""
    found = Measurements("Perfetto trace", "wall times of named slices")
    _Slices(found).read(data)
    return found


def packets_in(data: bytes) -> Iterator[TracePacket]:
    """Yield the packets of a trace in order, compressed or not, one by one: a long trace is never held as objects.

    Raises google.protobuf.message.DecodeError or zlib.error for bytes that are no trace, BadInputError for a trace that
    is too large.
    """
    from google.protobuf.message import DecodeError

    left = _left_after(data, MOST_UNPACKED_BYTES)
    for packet in _uncompressed(data):
        if not packet.compressed_packets:
            yield packet
            continue
        inner = zlib.decompressobj().decompress(packet.compressed_packets, left + 1)
        left = _left_after(inner, left)
        for each in _uncompressed(inner):
            if each.compressed_packets:
                raise DecodeError("packed packets in packed packets")
            yield each


def _left_after(data: bytes, left: int) -> int:
    """Return how many further bytes may be read after `data`. Raises BadInputError if `data` exceeds `left` bytes."""
    if len(data) > left:
        found = f"over {MOST_UNPACKED_BYTES >> 20} MiB unpacked"
        raise BadInputError("the trace", found, "less", "record for a shorter time")
    return left - len(data)


def _uncompressed(data: bytes) -> Iterator[TracePacket]:
    """Yield the packets of `data` as they are. Raises DecodeError."""
    from google.protobuf.message import DecodeError
    from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import TracePacket

    at = 0
    while at < len(data):
        size, start = _varint(data, at + 1)
        if data[at] != PACKET or size < 0 or start + size > len(data):
            raise DecodeError("a packet is cut off")
        packet = TracePacket()
        packet.ParseFromString(data[start : start + size])
        at = start + size
        yield packet


class _Sequence:
    """The state of one writer of packets (a sequence in Perfetto's words).

    `names`: names of events by their numbers.
    `clocks`: for each clock of the writer, its last time in ns, the ns of a tick, and 1 if times are differences.
    `default_clock`, `default_track`: clock and track of packets that state none.
    """

    def __init__(self) -> None:
        self.names: dict[int, str] = {}
        self.clocks: dict[int, list[int]] = {}
        self.default_clock = 0
        self.default_track = 0
        self.is_known = False  # whether no packet of the writer is missing


class _Slices:
    """Reads the slices of a Perfetto trace.

    Packets of several writers come in any order. Therefore all begins and ends are collected by track, and then paired.
    """

    def __init__(self, found: Measurements) -> None:
        self._found = found
        self._sequences: dict[int, _Sequence] = defaultdict(_Sequence)
        self._clocks: dict[int, list[int]] = {}  # of the whole trace, as in `_Sequence`
        self._marks: dict[object, list[tuple[int, str | None]]] = defaultdict(list)  # time, name; None for an end

    def read(self, data: bytes) -> None:
        from google.protobuf.message import DecodeError

        packets = 0
        try:
            for packet in packets_in(data):
                packets += 1
                self._packet(packet)
        except (DecodeError, zlib.error) as error:
            if not packets:
                raise BadInputError("the file", "bytes that do not parse", "a trace of Perfetto") from error
            self._found.refuse(f"packet {packets}", "the file is cut off or damaged from here on")
        for marks in self._marks.values():
            self._pair(sorted(marks, key=lambda mark: mark[0]))  # marks of one time stay in their order

    def _pair(self, marks: Sequence[tuple[int, str | None]]) -> None:
        """Add the slices of one track. Each end belongs to the last begin that is still open.

        `marks`: pairs (time in ns, name of the slice that begins; None for an end), in the order of time.
        """
        begun: list[tuple[str, int]] = []
        for at, name in marks:
            if name is not None:
                begun.append((name, at))
            elif begun:
                self._take(*begun.pop(), at)
            else:
                self._found.skip("the end of a slice that began before the trace")
        if begun:
            self._found.skipped[UNENDED] += len(begun)

    def _packet(self, packet: TracePacket) -> None:
        sequence = self._learned(packet)
        if packet.HasField("track_event"):
            if packet.sequence_flags & NEEDS_STATE and not sequence.is_known:
                self._found.skip(LOST_STATE)
            elif (at := self._time(packet, sequence)) is None:
                self._found.skip(NO_CLOCK)
            else:
                self._event(packet, sequence, at)
        for event in packet.ftrace_events.event:
            if event.HasField("print"):
                self._mark(event.pid, event.timestamp, event.print.buf)

    def _learned(self, packet: TracePacket) -> _Sequence:
        """Add a packet's names, defaults and clocks to the state of its writer, and return this state."""
        sequence = self._sequences[packet.trusted_packet_sequence_id]
        if packet.previous_packet_dropped:
            sequence.is_known = False
        if packet.sequence_flags & STATE_CLEARED or packet.incremental_state_cleared:
            sequence = self._sequences[packet.trusted_packet_sequence_id] = _Sequence()
            sequence.is_known = True
        if packet.HasField("trace_packet_defaults"):
            sequence.default_clock = packet.trace_packet_defaults.timestamp_clock_id
            sequence.default_track = packet.trace_packet_defaults.track_event_defaults.track_uuid
        for each in packet.interned_data.event_names:
            sequence.names[each.iid] = each.name
        for clock in packet.clock_snapshot.clocks:
            if clock.clock_id >= FIRST_OWN_CLOCK:
                clocks = sequence.clocks if clock.clock_id <= LAST_OWN_CLOCK else self._clocks
                tick = int(clock.unit_multiplier_ns) or 1
                clocks[clock.clock_id] = [clock.timestamp * tick, tick, int(clock.is_incremental)]
        return sequence

    def _time(self, packet: TracePacket, sequence: _Sequence) -> int | None:
        """Return the time of a packet in ns; None if its clock belongs to a program and no snapshot explains it."""
        known = packet.timestamp_clock_id or sequence.default_clock
        clock = sequence.clocks.get(known) or self._clocks.get(known)
        if clock is None:
            return int(packet.timestamp) if known < FIRST_OWN_CLOCK else None
        last, tick, incremental = clock
        clock[0] = packet.timestamp * tick + (last if incremental else 0)
        return clock[0]

    def _event(self, packet: TracePacket, sequence: _Sequence, at: int) -> None:
        event = packet.track_event
        track = ("track", event.track_uuid or sequence.default_track or packet.trusted_packet_sequence_id)
        phase = event.legacy_event.phase if event.type == event.TYPE_UNSPECIFIED else 0
        name = event.name or sequence.names.get(event.name_iid, "") or f"unnamed {event.name_iid}"
        if event.type == event.TYPE_SLICE_BEGIN or phase == ord("B"):
            self._marks[track].append((at, name))
        elif event.type == event.TYPE_SLICE_END or phase == ord("E"):
            self._marks[track].append((at, None))
        elif phase == ord("X"):
            self._take(name, at, at + 1000 * event.legacy_event.duration_us)

    def _mark(self, thread: int, at: int, text: str) -> None:
        """Collect a mark of atrace: `B|process|name` begins a slice of the thread, `E` ends the thread's last slice.

        `thread`: id of the thread.
        `at`: time in ns.
        """
        mark = ATRACE.fullmatch(text)
        if mark is not None:
            self._marks["thread", thread].append((at, (mark[3] or "").strip() if mark[1] == "B" else None))

    def _take(self, name: str, begin: int, end: int) -> None:
        if end < begin:
            self._found.refuse(f"slice {name!r} at {begin} ns", f"it ends {begin - end} ns before it begins")
        elif end == begin:
            self._found.skip("a slice without length")
        else:
            self._found.sample(f"slice {name!r} at {begin} ns", name, "wall", end - begin, "ns", WHAT)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Return (number, index of the byte behind it) of the protobuf varint at index `at`.

    If the varint does not end, return (-1, `at`).
    """
    value = 0
    for index in range(10):
        if at + index >= len(data):
            break
        byte = data[at + index]
        value |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return value, at + index + 1
    return -1, at


def read_chrome(events: Sequence[Any]) -> Measurements:
    """Return the slices of a trace in Chrome's format: complete events, and pairs of begin and end. Times are in us.

    If an asynchronous slice has the name of an ordinary slice, it is called `name (async)`, so that the times of the
    two do not mix.
    """
    found = Measurements("Chrome trace (JSON)", "wall times of named slices")
    slices = _ChromeSlices(found)
    for index, event in enumerate(events):
        if isinstance(event, dict):
            slices.event(f"event {index}: {event.get('name', '')}", event)
        else:
            found.refuse(f"event {index}", "no table")
    slices.end()
    return found


class _ChromeSlices:
    def __init__(self, found: Measurements) -> None:
        self._found = found
        self._open: dict[tuple[str, ...], list[tuple[str, float]]] = defaultdict(list)
        self._names: set[str] = set()  # of slices of threads
        self._asynchronous: list[tuple[str, str, float]] = []

    def event(self, row: str, event: Mapping[str, Any]) -> None:
        name, phase, at = str(event.get("name", "")), str(event.get("ph", "")), event.get("ts")
        if phase == "X":
            self._take(row, name, event.get("dur"))
        elif len(phase) != 1 or phase not in BEGINS + ENDS:
            self._found.skip(NO_SLICES.get(phase, "an event of an unknown kind"))
        elif not is_finite(at):
            self._found.refuse(row, "ts is no number")
        elif not (track := _asynchronous_track(event) if phase in ASYNC else _thread(event)):
            self._found.refuse(row, "an asynchronous slice without a name or an id, which tell its end")
        elif phase in BEGINS:
            self._open[track].append((name, float(at)))
        elif not self._open[track]:
            self._found.skip("the end of a slice that began before the trace")
        elif name not in ("", self._open[track][-1][0]):
            self._found.skip("the end of another slice than the one that is open")
        else:
            name, begin = self._open[track].pop()
            if phase in ASYNC:
                self._asynchronous.append((row, name, float(at) - begin))
            else:
                self._take(row, name, float(at) - begin)

    def end(self) -> None:
        for row, name, time in self._asynchronous:
            self._sample(row, f"{name} (async)" if name in self._names else name, time, WHAT_ASYNC)
        unended = sum(map(len, self._open.values()))
        if unended:
            self._found.skipped[UNENDED] += unended

    def _take(self, row: str, name: str, time: object) -> None:
        self._names.add(name)
        self._sample(row, name, time, WHAT)

    def _sample(self, row: str, name: str, time: object, what: str) -> None:
        if time == 0:
            self._found.skip("a slice without length")
        else:
            self._found.sample(row, name, "wall", time, "us", what)


def _thread(event: Mapping[str, Any]) -> tuple[str, ...]:
    return str(event.get("pid")), str(event.get("tid"))


def _asynchronous_track(event: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the key that begin and end of an asynchronous slice have in common; () if a part of the key is missing.

    Only a slice with a local id must end in the process where it began.
    """
    name, id_, scoped = event.get("name"), event.get("id"), event.get("id2")
    process = ""
    if isinstance(scoped, dict):
        id_ = scoped.get("global", scoped.get("local"))
        process = str(event.get("pid")) if "local" in scoped else ""
    if id_ is None or not name:
        return ()
    return "async", str(event.get("cat", "")), str(event.get("scope", "")), str(id_), str(name), process
