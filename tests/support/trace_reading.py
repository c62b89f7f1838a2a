"""A Perfetto trace as tests look at it. Rule: read by the format's rules, not by the code that writes it."""

from __future__ import annotations

import zlib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import Trace, TrackEvent


class Slice(NamedTuple):
    """A slice or, of no length, an instant. `track`: names from the outermost on, joined by slashes."""

    track: str
    name: str
    begin_ns: int
    end_ns: int
    notes: dict[str, Any]
    flows: tuple[int, ...]


@dataclass
class ReadTrace:
    """`tracks`: of each number its parent, name and rank. `slices`: in the order in which they end in the file.

    `counts`: of each counter's track, (ns, value) in the order of the file. `open`: slices without an end.
    """

    tracks: dict[int, tuple[int, str, int]] = field(default_factory=dict)
    slices: list[tuple[int, Slice]] = field(default_factory=list)
    instants: list[Slice] = field(default_factory=list)
    counts: dict[str, list[tuple[int, float]]] = field(default_factory=lambda: defaultdict(list))
    open: dict[int, list[Slice]] = field(default_factory=lambda: defaultdict(list))

    def path(self, track: int) -> str:
        """The names of a track and those above it."""
        parent, name, _ = self.tracks[track]
        return f"{self.path(parent)}/{name}" if parent else name

    def of(self, path: str) -> list[Slice]:
        """The slices of the tracks whose path ends so, by their begins."""
        return sorted((piece for _, piece in self.slices if piece.track.endswith(path)), key=lambda one: one.begin_ns)


def read_trace(content: bytes) -> ReadTrace:
    """Raises ValueError where a slice ends that has not begun, or begins before its track's last one ended."""
    read, names, note_names = ReadTrace(), dict[int, str](), dict[int, str]()
    until_ns: dict[int, int] = {}
    for packet in _packets(content):
        if packet.HasField("track_descriptor"):
            described = packet.track_descriptor
            read.tracks[described.uuid] = described.parent_uuid, described.name, described.sibling_order_rank
        names.update((each.iid, each.name) for each in packet.interned_data.event_names)
        note_names.update((each.iid, each.name) for each in packet.interned_data.debug_annotation_names)
        if not packet.HasField("track_event"):
            continue
        event, at_ns = packet.track_event, packet.timestamp
        track, path = event.track_uuid, read.path(event.track_uuid)
        if event.type == TrackEvent.TYPE_COUNTER:
            value = event.counter_value if event.HasField("counter_value") else event.double_counter_value
            read.counts[path].append((at_ns, value))
        elif event.type == TrackEvent.TYPE_SLICE_END:
            begun = read.open[track].pop()
            read.slices.append((track, begun._replace(end_ns=at_ns)))
            until_ns[track] = at_ns
        else:
            name = names[event.name_iid] if event.name_iid else event.name
            notes = {note.name or note_names[note.name_iid]: _value(note) for note in event.debug_annotations}
            piece = Slice(path, name, at_ns, at_ns, notes, tuple(event.flow_ids))
            if event.type == TrackEvent.TYPE_INSTANT:
                read.instants.append(piece)
                continue
            if read.open[track] or at_ns < until_ns.get(track, at_ns):
                raise ValueError(f"{piece} lies over {read.open[track]}, or begins before {until_ns.get(track)}")
            read.open[track].append(piece)
    return read


def _packets(content: bytes) -> Iterator[Any]:
    for packet in Trace.FromString(content).packet:
        if packet.compressed_packets:
            yield from Trace.FromString(zlib.decompress(packet.compressed_packets)).packet
        else:
            yield packet


def _value(note: Any) -> Any:
    if note.dict_entries:
        return {entry.name: _value(entry) for entry in note.dict_entries}
    if note.array_values:
        return [_value(entry) for entry in note.array_values]
    kind = next(name for name in ("bool", "uint", "int", "double", "string") if note.HasField(f"{name}_value"))
    return getattr(note, f"{kind}_value")
