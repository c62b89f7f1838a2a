"""The run as a Perfetto trace (ui.perfetto.dev): one track per unit, a slice per job, an arrow along each frame.

Rule: a slice is a job as it was recorded; nothing is drawn that was not measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import TrackDescriptor, TrackEvent
from perfetto.trace_builder.proto_builder import StreamingTraceProtoBuilder

from trilane.scheduler.ledger import JobRecord

SEQUENCE = 1
PROCESS_TRACK = 1


def write_trace(jobs: Sequence[JobRecord], units: Sequence[str], target: Path) -> None:
    """Write the trace. A job has its frame and its wait for the unit, in us, as arguments.

    `jobs`: of the run, in any order.
    `units`: of the run's graph, in the order of their tracks; one that did no job has no track.
    `target`: file to write.
    """
    tracks = {unit: PROCESS_TRACK + 1 + rank for rank, unit in enumerate(units)}
    with target.open("wb") as file:
        builder = StreamingTraceProtoBuilder(file)
        _write_process(builder)
        worked = {job.unit for job in jobs}
        for rank, unit in enumerate(units):
            if unit in worked:
                _write_track(builder, unit, tracks[unit], rank)
        for job in sorted(jobs, key=lambda job: (job.begin_ns, job.end_ns)):
            _write_job(builder, job, tracks[job.unit])


def _write_process(builder: StreamingTraceProtoBuilder) -> None:
    packet = builder.create_packet()
    packet.track_descriptor.uuid = PROCESS_TRACK
    packet.track_descriptor.name = "trilane"
    packet.track_descriptor.child_ordering = TrackDescriptor.EXPLICIT
    builder.write_packet(packet)


def _write_track(builder: StreamingTraceProtoBuilder, unit: str, track: int, rank: int) -> None:
    packet = builder.create_packet()
    packet.track_descriptor.uuid = track
    packet.track_descriptor.parent_uuid = PROCESS_TRACK
    packet.track_descriptor.name = unit
    packet.track_descriptor.sibling_order_rank = rank
    builder.write_packet(packet)


def _write_job(builder: StreamingTraceProtoBuilder, job: JobRecord, track: int) -> None:
    begin = builder.create_packet()
    begin.timestamp = job.begin_ns
    begin.trusted_packet_sequence_id = SEQUENCE
    event = begin.track_event
    event.type, event.track_uuid = TrackEvent.TYPE_SLICE_BEGIN, track
    event.name = job.stage
    event.flow_ids.append(job.frame + 1)  # 0 would be no flow
    for name, value in (("frame", job.frame), ("wait_us", (job.begin_ns - job.ready_ns) // 1000)):
        note = event.debug_annotations.add()
        note.name, note.int_value = name, value
    builder.write_packet(begin)
    end = builder.create_packet()
    end.timestamp = job.end_ns
    end.trusted_packet_sequence_id = SEQUENCE
    end.track_event.type, end.track_event.track_uuid = TrackEvent.TYPE_SLICE_END, track
    builder.write_packet(end)
