"""The present stage: it encodes frames as a segment of video, and writes a digest of every frame to a text file.

The stage computes a frame's digest from the bytes in the slot before it encodes the frame. Each process writes one
segment with a name of its own; the parent joins the segments (`apps/run/run_files.py`). A segment is fragmented MP4:
after its writer is killed, the segment is readable, and lacks at most the last frame. Frames that are compared after
the run are kept as arrays in a folder beside the segment.
"""

from __future__ import annotations

import errno
import hashlib
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter
from numpy.typing import NDArray

from trilane.arrays import U8
from trilane.errors import FULL, UnwrittenError
from trilane.pipeline.memory import ByteCounter
from trilane.pipeline.stage import UnitContext
from trilane.stages.config import RunConfig
from trilane.transport.packets import Packet
from trilane.writing import REMOVED, require_name

SEGMENTS = "segments"
KEYFRAME_EVERY = 30
#: One thread, no look-ahead and no reordering: every frame leaves the encoder before the next one comes. With a
#: constant quantiser, x264 does not search a small copy of each frame for its rate (docs/decisions/video-encoding.md).
ENCODER_OPTIONS = {"preset": "ultrafast", "qp": "18", "tune": "zerolatency"}
#: Every frame is a fragment of its own and is written at once, so that a killed writer loses at most the last frame.
FRAGMENTS = {"movflags": "empty_moov+default_base_moof+frag_every_frame", "flush_packets": "1"}
MS = 1e-6  # milliseconds in a nanosecond
NOTHING = ByteCounter().figures()


@contextmanager
def full_disk_told(path: Path) -> Iterator[None]:
    """Turn the errors of a full or failing disk inside the `with` block into an UnwrittenError about `path`."""
    try:
        yield
    except (OSError, av.error.FFmpegError) as error:
        if error.errno not in FULL:
            raise
        raise UnwrittenError(path, OSError(error.errno, os.strerror(error.errno))) from error


class Segment:
    """One file of H.264 video, written frame by frame, and a text file of digests beside it.

    A digest line has the frame's number and the SHA-256 of its bytes (row 0 first, RGB).

    `moved`: counter of the latest frame's bytes. The least bytes are the bytes of a new frame and the encoder's output.
    """

    def __init__(self, path: Path, fps: float, height: int, width: int) -> None:
        rate = Fraction(fps).limit_denominator(1001)
        self._container: Any = av.open(str(path), "w", format="mp4", options=dict(FRAGMENTS))
        self._stream: Any = self._container.add_stream("libx264", rate=rate, options=dict(ENCODER_OPTIONS))
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
        context = self._stream.codec_context
        context.thread_count, context.gop_size, context.time_base = 1, KEYFRAME_EVERY, 1 / rate
        context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
        self._reformatter: Any = VideoReformatter()
        self._last = -1
        self._digest = ""
        self._picture: Any = None
        self.moved = ByteCounter()
        self._path = path
        # Line buffering keeps the digests of finished frames when the process is killed.
        self._digests = path.with_suffix(".sha256").open("w", encoding="ascii", buffering=1)

    @classmethod
    def begun(cls, folder: Path, fps: float, height: int, width: int) -> Segment:
        """Return a new segment in `folder`, which is made if it is missing.

        Raises UnwrittenError if the disk is full or fails, or if somebody removed the folder.
        """
        path = folder / f"{time.monotonic_ns():020d}-{os.getpid()}.mp4"
        try:
            with full_disk_told(path):
                folder.mkdir(parents=True, exist_ok=True)
                return cls(path, fps, height, width)
        except FileNotFoundError as error:  # somebody removed the folder just now
            raise UnwrittenError(path, FileNotFoundError(errno.ENOENT, REMOVED)) from error

    def digest(self, frame: int, pixels: NDArray[np.uint8], repeats: bool = False) -> None:
        """Write the digest of `pixels`, (height, width, 3) and C-contiguous.

        `repeats`: whether the pixels equal the last call's pixels, whose digest is then used.

        Raises UnwrittenError if the disk is full or fails, or if somebody removed the file of digests.
        """
        if not repeats:
            self._digest = hashlib.sha256(pixels.data).hexdigest()
            self.moved.read += pixels.nbytes
        with full_disk_told(self._path):
            self.moved.written += self._digests.write(f"{frame} {self._digest}\n")
        require_name(self._path, self._digests.fileno())

    def add(self, frame: int, pixels: NDArray[np.uint8], repeats: bool = False) -> None:
        """Add frame number `frame` to the video. Raises UnwrittenError if the disk is full or fails.

        `pixels`: (height, width, 3) RGB.
        `repeats`: whether the pixels equal the last call's pixels, which are already converted for the encoder.
        """
        if not repeats:
            rgb = av.VideoFrame.from_numpy_buffer(pixels, format="rgb24")
            self._picture = self._reformatter.reformat(
                rgb, format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
            )
            self.moved.read += pixels.nbytes
            self.moved.least += pixels.nbytes
        picture = self._picture
        self._last = max(self._last + 1, frame)
        picture.pts, picture.time_base = self._last, self._stream.codec_context.time_base
        packets = self._stream.encode(picture)
        with full_disk_told(self._path):
            self._container.mux(packets)
        encoded = sum(packet.size for packet in packets)
        self.moved.written += encoded
        self.moved.least += encoded

    def close(self) -> None:
        """Encode the last frames, then complete the video file and the file of digests.

        Raises UnwrittenError if the disk is full or fails.
        """
        with full_disk_told(self._path):
            self._container.mux(self._stream.encode(None))
            self._container.close()
            self._digests.close()


class PresentStage:
    """Stage `present` of the CPU unit, with an input edge of frames and no output.

    If the run is recorded, a job reports `digest_ms`, `encode_ms` and the bytes moved; otherwise it reports zero bytes.
    """

    def __init__(self, config: RunConfig) -> None:
        self._height, self._width = config.scene.output.height, config.scene.output.width
        self._fps = config.scene.fps
        self._folder = config.out_dir / SEGMENTS if config.record else None
        self._frames: list[NDArray[np.uint8]] = []
        self._headers: list[NDArray[np.void]] = []
        self._drawn = -1
        self._segment: Segment | None = None
        self._window = config.opened_window()
        self._kept = KeptFrames(config.out_dir, config.kept)

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Make the views of the slots, and the encoder.

        Raises ValueError if there are outputs, UnwrittenError as `Segment.begun` does.
        """
        if outputs:
            raise ValueError("the present stage has no output edge")
        size = self._height * self._width * 3
        self._headers = [packet.header for packet in inputs]
        self._frames = [packet.payload[:size].reshape(self._height, self._width, 3) for packet in inputs]
        if self._folder is not None:
            self._segment = Segment.begun(self._folder, self._fps, self._height, self._width)

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:  # noqa: ARG002
        """Present `inputs[slot_in]` as frame `frame`, and return metrics.

        Raises ValueError if `slot_in` is None, UnwrittenError as `Segment.digest` and `Segment.add` do.
        """
        if slot_in is None:
            raise ValueError("the present stage needs an input slot")
        if self._window is not None and self._window.is_looked_at:
            header = self._headers[slot_in]
            times = float(header["media_time_s"]), int(header["t_sampled_ns"])
            self._window.show(frame, *times, self._frames[slot_in])
        self._kept.see(frame, self._frames[slot_in])
        if self._segment is None:
            return NOTHING
        pixels, drawn = self._frames[slot_in], int(self._headers[slot_in]["repeats"]) - 1
        repeats = drawn == self._drawn >= 0
        self._drawn = drawn if drawn >= 0 else frame
        self._segment.moved.start()
        start = time.perf_counter_ns()
        self._segment.digest(frame, pixels, repeats)
        digested = time.perf_counter_ns()
        self._segment.add(frame, pixels, repeats)
        encode_ms = (time.perf_counter_ns() - digested) * MS
        return {"digest_ms": (digested - start) * MS, "encode_ms": encode_ms, **self._segment.moved.figures()}

    def close(self) -> None:
        """Complete the video file and the file of digests, if frames are recorded. Raises as `Segment.close` does."""
        if self._segment is not None:
            self._segment.close()
            self._segment = None


def build(settings: Mapping[str, Any], unit: UnitContext) -> PresentStage:  # noqa: ARG001 - a factory's signature
    """Build the present stage of the configuration in `settings`."""
    return PresentStage(RunConfig.model_validate(settings["config"]))


KEPT_FOLDER = "kept"


class KeptFrames:
    """Keeps the frames `numbers`, ascending, as arrays in `folder`/`KEPT_FOLDER`.

    If a frame is not presented, the next presented frame is kept in its place.
    """

    def __init__(self, folder: Path, numbers: Sequence[int]) -> None:
        self._folder, self._numbers = folder / KEPT_FOLDER, list(numbers)
        self._next = self._numbers.pop(0) if self._numbers else None

    def see(self, frame: int, pixels: U8) -> None:
        """Keep `pixels` (h,w,3) of frame `frame` if the frame is the next of the numbers or follows it."""
        if self._next is None or frame < self._next:
            return
        self._folder.mkdir(exist_ok=True)
        np.save(self._folder / f"{frame}.npy", pixels, allow_pickle=False)
        while self._next is not None and self._next <= frame:
            self._next = self._numbers.pop(0) if self._numbers else None


def kept_frames(folder: Path) -> dict[int, Path]:
    """Return the files of the frames that were kept in `folder`, by frame number."""
    return {
        int(file.stem): file for file in sorted((folder / KEPT_FOLDER).glob("*.npy"), key=lambda file: int(file.stem))
    }
