"""The run as a Perfetto trace (ui.perfetto.dev): one track per unit, a slice per job or idle time, an arrow per frame.

Rule: a slice is a job as it was recorded, or the time between two jobs under its cause; nothing is drawn that was not
measured. The slices of a unit do not overlap, so that its accounts can be added up from them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import TrackDescriptor, TrackEvent
from perfetto.trace_builder.proto_builder import StreamingTraceProtoBuilder

from trilane.scheduler.accounts import IdleSlice
from trilane.scheduler.ledger import JobRecord

SEQUENCE = 1
PROCESS_TRACK = 1


def write_trace(jobs: Sequence[JobRecord], units: Sequence[str], target: Path, idle: Sequence[IdleSlice] = ()) -> None:
    """Write the trace.

    A job has its frame and its wait for the unit, in us, as arguments; both kinds of slices have `preempted_ns`, and a
    job has `asleep_ns`, where these are not 0: where in the slice that time lies is not known.

    `jobs`: of the run, in any order.
    `units`: of the run's graph, in the order of their tracks; one that did no job has no track.
    `idle`: what `trilane.scheduler.accounts.idle_slices` makes of the run.
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
        slices: list[JobRecord | IdleSlice] = [*jobs, *(piece for piece in idle if piece.unit in worked)]
        for piece in sorted(slices, key=lambda piece: (piece.begin_ns, piece.end_ns)):
            if isinstance(piece, JobRecord):
                _write_job(builder, piece, tracks[piece.unit])
            else:
                notes = _if_any(preempted_ns=piece.preempted_ns)
                _write_slice(builder, tracks[piece.unit], piece.begin_ns, piece.end_ns, piece.cause, notes)


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
    lost = _if_any(preempted_ns=job.preempted_ns, asleep_ns=job.asleep_ns)
    notes = {"frame": job.frame, "wait_us": (job.begin_ns - job.ready_ns) // 1000, **lost}
    flow = job.frame + 1  # 0 would be no flow
    _write_slice(builder, track, job.begin_ns, job.end_ns, job.stage, notes, flow)


def _if_any(**notes: int) -> dict[str, int]:
    return {name: value for name, value in notes.items() if value}


def _write_slice(
    builder: StreamingTraceProtoBuilder,
    track: int,
    begin_ns: int,
    end_ns: int,
    name: str,
    notes: Mapping[str, int],
    flow: int = 0,
) -> None:
    begin = builder.create_packet()
    begin.timestamp = begin_ns
    begin.trusted_packet_sequence_id = SEQUENCE
    event = begin.track_event
    event.type, event.track_uuid, event.name = TrackEvent.TYPE_SLICE_BEGIN, track, name
    if flow:
        event.flow_ids.append(flow)
    for key, value in notes.items():
        note = event.debug_annotations.add()
        note.name, note.int_value = key, value
    builder.write_packet(begin)
    end = builder.create_packet()
    end.timestamp = end_ns
    end.trusted_packet_sequence_id = SEQUENCE
    end.track_event.type, end.track_event.track_uuid = TrackEvent.TYPE_SLICE_END, track
    builder.write_packet(end)
