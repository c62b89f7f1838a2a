"""The run as a Perfetto trace (ui.perfetto.dev): one track per unit, a slice per job, an arrow along each frame.

Rule: a slice is a job as it was recorded; nothing is drawn that was not measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import TrackDescriptor, TrackEvent
from perfetto.trace_builder.proto_builder import StreamingTraceProtoBuilder

from trilane.scheduler.ledger import JobRecord
from trilane.units import UNITS

SEQUENCE = 1
PROCESS_TRACK = 1


def write_trace(jobs: Sequence[JobRecord], target: Path) -> None:
    """Write `jobs` to `target`. A job that waited for its unit has the wait as an argument, in ms."""
    with target.open("wb") as file:
        builder = StreamingTraceProtoBuilder(file)
        _write_tracks(builder, {job.unit for job in jobs})
        for job in sorted(jobs, key=lambda job: (job.begin_ns, job.end_ns)):
            _write_job(builder, job)


def _track_of(unit: str) -> int:
    return PROCESS_TRACK + 1 + UNITS.index(unit)


def _write_tracks(builder: StreamingTraceProtoBuilder, units: set[str]) -> None:
    packet = builder.create_packet()
    packet.track_descriptor.uuid = PROCESS_TRACK
    packet.track_descriptor.name = "trilane"
    packet.track_descriptor.child_ordering = TrackDescriptor.EXPLICIT
    builder.write_packet(packet)
    for unit in sorted(units, key=UNITS.index):
        packet = builder.create_packet()
        packet.track_descriptor.uuid = _track_of(unit)
        packet.track_descriptor.parent_uuid = PROCESS_TRACK
        packet.track_descriptor.name = unit
        packet.track_descriptor.sibling_order_rank = UNITS.index(unit)
        builder.write_packet(packet)


def _write_job(builder: StreamingTraceProtoBuilder, job: JobRecord) -> None:
    begin = builder.create_packet()
    begin.timestamp = job.begin_ns
    begin.trusted_packet_sequence_id = SEQUENCE
    event = begin.track_event
    event.type, event.track_uuid = TrackEvent.TYPE_SLICE_BEGIN, _track_of(job.unit)
    event.name = job.stage
    event.flow_ids.append(job.frame + 1)
    for name, value in (("frame", job.frame), ("wait_us", (job.begin_ns - job.ready_ns) // 1000)):
        note = event.debug_annotations.add()
        note.name, note.int_value = name, value
    builder.write_packet(begin)
    end = builder.create_packet()
    end.timestamp = job.end_ns
    end.trusted_packet_sequence_id = SEQUENCE
    end.track_event.type, end.track_event.track_uuid = TrackEvent.TYPE_SLICE_END, _track_of(job.unit)
    builder.write_packet(end)
