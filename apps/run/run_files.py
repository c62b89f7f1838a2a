"""Makes the video, contact sheet, checksum, recording and trace of a run folder.

The sources are the segments (short videos, each with a digest file) and the journal of the run.

Rule: no frame is encoded twice. video.mp4 gets the packets of the segments, and the contact sheet is decoded from
video.mp4. The journal is read once, record by record.
"""

from __future__ import annotations

import errno
import hashlib
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
from PIL import Image, ImageDraw

from trilane.apps.explain.trace import NAME as TRACE_NAME
from trilane.apps.explain.trace import RunTracks
from trilane.apps.explain.trace_sinks import PacketSink
from trilane.errors import UnwrittenError
from trilane.pipeline.journal import NAME, Begun, Stepped, read_journal
from trilane.scheduler.recording import header_line, step_line
from trilane.stages.cpu.present import KEYFRAME_EVERY, SEGMENTS, full_disk_told

EVENTS, VIDEO, SHEET = "events.jsonl", "video.mp4", "contact.png"
COLUMNS, ROWS = 4, 5
THUMB_WIDTH = 320
FAST_PNG = 1  # zlib level: files are a fifth larger than at the best level, but need a quarter of the time


def write_files(work: Path, fps: float, frames: int) -> tuple[dict[str, Any], UnwrittenError | None]:
    """Write every file of the run folder `work` except the report. Return (facts, error).

    `facts` has two keys of the report. `video` has the fields of `trilane.apps.run.report.Video`; it is None without a
    video. `checksum` is the result of `run_checksum`; it is None if segments were removed.
    `error` is None if every file is complete. Otherwise, it says that the disk is full, or that segments were removed
    during the run. On a full disk, each file is complete or absent, and the segments stay until the video and the
    contact sheet are complete. If segments were removed, the files are made from the remaining segments.

    `fps`: frames a second of the scene. `frames`: least number of frames that the segments should contain.
    Raises BadInputError for a broken journal.
    """
    segments = work / SEGMENTS
    facts: dict[str, Any] = {"video": None, "checksum": None}
    try:
        checksum = run_checksum(sorted(segments.glob("*.sha256")))
        joined, removed = join_folder(segments, work / VIDEO, fps, frames)
        facts["checksum"] = None if removed else checksum
        if joined is not None:
            facts["video"] = {"frames": joined.frames, "seconds": joined.seconds}
            with _whole_or_absent(work / SHEET):
                contact_sheet(work / VIDEO, work / SHEET, fps)
        shutil.rmtree(segments, ignore_errors=True)
        with _whole_or_absent(work / EVENTS, work / TRACE_NAME):
            _write_from_journal(work / NAME, work)
    except UnwrittenError as error:
        return facts, error
    return facts, removed


@contextmanager
def _whole_or_absent(*files: Path) -> Iterator[None]:
    """Remove all `files` if the block that writes them fails. Raises UnwrittenError if the disk is full."""
    try:
        with full_disk_told(files[0]):
            yield
    except Exception:
        for file in files:
            file.unlink(missing_ok=True)
        raise


def _write_from_journal(journal: Path, folder: Path) -> None:
    """Write the recording and the trace into `folder`, from the file `journal`.

    Raises BadInputError if the file is no journal.
    """
    tracks: RunTracks | None = None
    with (folder / EVENTS).open("w", encoding="utf-8") as events, (folder / TRACE_NAME).open("wb") as file:
        sink = PacketSink(file)
        for record in read_journal(journal):
            if isinstance(record, Begun):
                tracks = RunTracks(sink, record)
                events.write(header_line(record.graph, record.settings))
            elif tracks is not None:
                tracks.add(record)
                if isinstance(record, Stepped):
                    events.write(step_line(*record))
        if tracks is not None:
            tracks.close()
            sink.close()


@dataclass(frozen=True)
class JoinedVideo:
    """A video that `join_segments` wrote.

    `frames`: number of pictures. `seconds`: time at which the last picture ends.
    """

    frames: int
    seconds: float


def join_folder(
    segments: Path, target: Path, fps: float, frames: int
) -> tuple[JoinedVideo | None, UnwrittenError | None]:
    """Join the segments in the folder `segments` to the video `target`. Return (video, error).

    `video` is None if no segment contains a frame. `error` says that files were removed during the run; it is None if
    no file is missing. Numbers of frames reveal missing files. Each encoded frame has a line in a digest file, and its
    picture is in the segment beside this file. Only a segment's last picture may be missing, if a kill interrupted it.
    `fps`: frames a second of the scene. `frames`: least number of frames that were encoded.
    Raises UnwrittenError if the disk is full.
    """
    digests = sorted(segments.glob("*.sha256"))
    whole = [path for path in sorted(segments.glob("*.mp4")) if path.with_suffix(".sha256") in digests]
    with _whole_or_absent(target):
        joined = join_segments(whole, target, fps)
    lines, shown = sum(len(_digest_lines(path)) for path in digests), joined.frames if joined else 0
    if frames <= lines <= shown + len(digests):
        return joined, None
    return joined, UnwrittenError(
        segments, FileNotFoundError(errno.ENOENT, "files were removed from it during the run")
    )


def join_segments(segments: list[Path], target: Path, fps: float) -> JoinedVideo | None:
    """Copy the packets of all `segments` into one MP4 file, and return its facts; None if no segment contains a frame.

    `segments`: files in the order of their frames, each with a digest file beside it.
    `target`: MP4 file to write.
    `fps`: frames a second of the scene.
    Each line of a digest file has the number of a frame. The number determines the time at which the frame's packet is
    shown. If the previous packet ends later than this time, the packet is shown right after the previous packet. Of a
    truncated segment, all complete packets are copied.
    """
    readable = [path for path in segments if _has_packets(path)]
    if not readable:
        return None
    frames, end = 0, 0
    with av.open(str(target), "w", format="mp4", options={"movflags": "faststart"}) as output:
        stream: Any = None
        for path in readable:
            with av.open(str(path)) as segment:
                source = segment.streams.video[0]
                stream = stream or output.add_stream_from_template(source)
                length = round(1 / (fps * source.time_base))
                for packet, number in zip(_packets(segment), _frame_numbers(path), strict=False):
                    packet.pts = packet.dts = max(end, number * length)
                    packet.duration, packet.stream = length, stream
                    end = packet.pts + length
                    output.mux(packet)
                    frames += 1
    return JoinedVideo(frames, end / (length * fps))


def _frame_numbers(segment: Path) -> list[int]:
    return [int(line.split(" ")[0]) for line in _digest_lines(segment.with_suffix(".sha256"))]


def _digest_lines(path: Path) -> list[str]:
    """Return the lines of the digest file `path`, without a last line that is incomplete."""
    return [line for line in path.read_text(encoding="ascii").splitlines(keepends=True) if line.endswith("\n")]


def _packets(container: Any) -> Iterator[Any]:
    """Yield the complete packets of the video stream of `container`, a file that PyAV has opened."""
    try:
        for packet in container.demux(video=0):
            if packet.pts is not None and packet.size:
                yield packet
    except av.error.FFmpegError:
        return


def _has_packets(path: Path) -> bool:
    try:
        with av.open(str(path)) as segment:
            return next(_packets(segment), None) is not None
    except (av.error.FFmpegError, IndexError):
        return False


def run_checksum(digests: list[Path]) -> str | None:
    """Return the SHA-256 over the lines of the files `digests`, sorted by frame number; None if no file has a line.

    A line is a frame's number and the digest of its picture. Runs that presented the same pictures under the same
    numbers have the same checksum.
    """
    lines = [line for path in digests for line in _digest_lines(path)]
    if not lines:
        return None
    ordered = sorted(lines, key=lambda line: int(line.split(" ")[0]))
    return hashlib.sha256("".join(ordered).encode("ascii")).hexdigest()


def contact_sheet(video: Path, target: Path, fps: float) -> int:
    """Write the PNG `target` with up to COLUMNS x ROWS evenly spaced frames of `video`; return how many frames it has.

    The first and the last frame of the video are among them. Each picture shows the number of its frame.
    `fps`: frames a second of the scene. Raises av.error.FFmpegError if the video cannot be decoded.
    """
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        times = sorted(packet.pts for packet in container.demux(stream) if packet.pts is not None)
        count = min(COLUMNS * ROWS, len(times))
        chosen = [times[round(k * (len(times) - 1) / max(1, count - 1))] for k in range(count)]
        decode = _decode_all if len(times) <= KEYFRAME_EVERY * count else _decode_each
        pictures = [(round(pts * stream.time_base * fps), image) for pts, image in decode(container, chosen)]
    _paste(pictures).save(target, compress_level=FAST_PNG)
    return count


def _decode_all(container: Any, wanted: list[int]) -> Iterator[tuple[int, Image.Image]]:
    """Yield (pts, thumbnail) for each pts in `wanted`, in one pass over the video.

    The pts of a frame is the time at which it is shown, in units of the stream's time base.
    """
    container.seek(0)
    for frame in container.decode(video=0):
        if frame.pts in wanted:
            yield frame.pts, _thumbnail(frame)


def _decode_each(container: Any, wanted: list[int]) -> Iterator[tuple[int, Image.Image]]:
    """Yield the same as `_decode_all`, but seek to each frame. A seek is faster if many frames lie between two pts."""
    stream = container.streams.video[0]
    for pts in wanted:
        container.seek(pts, stream=stream)
        yield pts, _thumbnail(next(frame for frame in container.decode(stream) if frame.pts >= pts))


def _thumbnail(frame: Any) -> Image.Image:
    height = frame.height * THUMB_WIDTH // frame.width
    image: Image.Image = frame.to_image(width=THUMB_WIDTH, height=height, interpolation="LANCZOS")
    return image


def _paste(pictures: list[tuple[int, Image.Image]]) -> Image.Image:
    height = pictures[0][1].height
    columns = min(COLUMNS, len(pictures))
    sheet = Image.new("RGB", (columns * THUMB_WIDTH, -(-len(pictures) // columns) * height))
    draw = ImageDraw.Draw(sheet)
    for place, (frame, picture) in enumerate(pictures):
        corner = (place % columns * THUMB_WIDTH, place // columns * height)
        sheet.paste(picture, corner)
        text = (corner[0] + 6, corner[1] + 4)
        draw.text(text, f"frame {frame}", fill="white", stroke_width=2, stroke_fill="black", font_size=14)
    return sheet
