"""A video as a background: a thread decodes its frames in advance and converts them to sRGB.

Each frame is shown at the time that the file gives it, whatever the rate of the run. At most AHEAD decoded frames wait;
the thread and the reader hold one more each.

A video of high dynamic range, PQ or HLG, is converted in three steps:

- The published curves give its light.
- The curve of ITU-R BT.2390 reduces bright light, so that the brightest becomes a display's white. The largest of the
  three primaries decides the reduction of all three, which keeps the hue.
- The light is converted to the primaries of sRGB.

Sources: PQ, HLG and its system gamma are from ITU-R BT.2100-2; the reduction is from BT.2390-10, 5.4.1; reference white
at 203 cd/m2 is from BT.2408-5; the matrix is from BT.2087-0.
"""

from __future__ import annotations

import queue
import re
import threading
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
from av.sidedata.sidedata import Type
from numpy.typing import NDArray

from trilane.arrays import F32, F64, U8, Shape, to_code
from trilane.errors import BadInputError
from trilane.files import HEAD_BYTES, PICTURE, VIDEO, require_file, signature_of_head
from trilane.scene.lens import cover

#: Containers whose reader opens no other file, by FFmpeg's names. Readers of playlists and of numbered pictures do.
CONTAINERS = (
    "mov,matroska,webm,avi,mpegts,mpeg,mpegvideo,m4v,h264,hevc,av1,obu,ivf,ogg,flv,asf,dv,mxf,nut,gif,mjpeg,"
    "yuv4mpegpipe,apng,webp_pipe,png_pipe,bmp_pipe,tiff_pipe,wav,mp3,flac,aac"
)
PQ, HLG = "PQ", "HLG"
#: Light of white on a common display, and the brightest light of a video that is still reduced, not cut; cd/m2.
WHITE, PEAK = 203.0, 1000.0
HLG_GAMMA = 1.2  # HLG's system gamma for a display whose peak is 1000 cd/m2
STEPS = 4096
M1 = 0.1593017578125
LUMA_2020 = np.array([0.2627, 0.6780, 0.0593], np.float32)
SRGB_FROM_2020 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)


def to_srgb(codes: NDArray[np.uint16], transfer: str, is_wide: bool) -> U8:
    """Return a picture of high dynamic range in sRGB, (h,w,3).

    `codes`: R'G'B' from 0 to 65535, (h,w,3).
    `transfer`: PQ or HLG.
    `is_wide`: whether the primaries are BT.2020's; otherwise they are sRGB's.
    """
    light = _eotf(transfer)[codes >> 4]
    if transfer == HLG:
        luma = light @ LUMA_2020
        light *= (PEAK * np.power(np.maximum(luma, 1e-6), HLG_GAMMA - 1))[..., None]
    brightest = np.maximum(np.maximum(light[..., 0], light[..., 1]), light[..., 2])
    steps = np.sqrt(np.minimum(brightest, PEAK)) * ((STEPS - 1) / np.sqrt(PEAK))
    shown = light * _gains()[steps.astype(np.int32)][..., None]
    if is_wide:
        shown = shown @ SRGB_FROM_2020.T
    shade: U8 = _srgb()[(np.sqrt(np.clip(shown, 0, 1)) * (STEPS - 1) + 0.5).astype(np.int32)]
    return shade


@cache
def _eotf(transfer: str) -> F32:
    """Return the light (STEPS,) of STEPS codes from 0 to 1 of `transfer`.

    For PQ, it is the light of the display, cd/m2; for HLG, the light of the scene, 0 to 1.
    """
    code = np.arange(STEPS) / (STEPS - 1)
    if transfer == PQ:
        return pq_light(code).astype(np.float32)
    a = 0.17883277
    b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
    return np.where(code <= 0.5, code**2 / 3, (np.exp((code - c) / a) + b) / 12).astype(np.float32)


def pq_light(code: F64) -> F64:
    """Return the light, cd/m2, of `code`, a code of PQ from 0 to 1."""
    power = np.power(code, 1 / 78.84375)
    return np.asarray(10000 * np.power(np.maximum(power - 0.8359375, 0) / (18.8515625 - 18.6875 * power), 1 / M1))


def pq_code(light: F64) -> F64:
    """Return the code of PQ, 0 to 1, of `light`, cd/m2."""
    power = np.power(light / 10000, M1)
    return np.asarray(np.power((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power), 78.84375))


@cache
def _gains() -> F32:
    """Return the factors (STEPS,) that turn light in cd/m2 into light of a common display, see `roll_off`.

    Entry i is for a light whose square root is the i-th of STEPS equal steps from 0 to the square root of PEAK.
    """
    light = np.maximum(np.linspace(0, np.sqrt(PEAK), STEPS), 1e-3) ** 2
    gains: F32 = (roll_off(light) / light).astype(np.float32)
    return gains


def roll_off(light: F64) -> F64:
    """Return the light of a common display for `light`, an array of any shape, in cd/m2 up to PEAK.

    In the result, 1 is the display's white, which is WHITE cd/m2. Lights below the knee of the curve are only divided
    by WHITE. The spline of ITU-R BT.2390 compresses brighter lights, so that PEAK becomes 1.
    """
    peak = pq_code(np.array(PEAK))
    code, most = pq_code(light) / peak, float(pq_code(np.array(WHITE)) / peak)
    knee = 1.5 * most - 0.5
    t = np.clip((code - knee) / (1 - knee), 0, 1)
    spline = (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee) + (3 * t**2 - 2 * t**3) * most
    return np.asarray(pq_light(np.where(code < knee, code, spline) * peak) / WHITE)


@cache
def _srgb() -> U8:
    """Return sRGB bytes (STEPS,). Entry i is for the light (i / (STEPS - 1)) ** 2."""
    light = (np.arange(STEPS) / (STEPS - 1)) ** 2
    return (to_code(light) * 255 + 0.5).astype(np.uint8)


AHEAD = 4
A_VIDEO = "a video, a picture, or a folder of pictures"
#: Control characters that no text contains.
NO_TEXT = re.compile(rb"[\x00-\x08\x0e-\x1a\x1c-\x1f]")
MAX_PIXELS = 64_000_000
DEFAULT_STEP_S = 1 / 30
ROUNDING_S = 1e-6
#: Transfers and primaries by their numbers in ITU-T H.273, which FFmpeg uses.
TRANSFERS, BT2020_PRIMARIES = {16: PQ, 18: HLG}, 9
MIN_ASPECT = 0.1  # least aspect of a pixel; anything beyond is a mistake in the file
MICROSECONDS = 1e6  # in a second: the unit of a container's duration and of its seeks


class VideoReader:
    """The first video stream of a file, scaled and cropped, played in a loop.

    `path`: video file.
    `shape`: size of the pictures, (h,w).
    `turned`: number of quarter turns clockwise; None for what the file says.
    Raises BadInputError if the file is no video or cannot be decoded.
    """

    def __init__(self, path: Path, shape: Shape, turned: int | None = None) -> None:
        require_video(path)
        self._path, self._shape, self._turned = path, shape, turned
        self._start_s: float | None = None  # time of the file's first frame, by the file's own clock
        self._period_s = 0.0  # length of the loop; 0 until the video has ended once
        self._shown_s = -1.0
        self._next: tuple[float, U8]
        self._queue: queue.Queue[tuple[float, U8] | Exception]
        self._open(0.0)

    def at(self, time_s: float) -> U8 | None:
        """Return the newest frame (h,w,3) that is not after `time_s`; None if an earlier call returned this frame.

        If `time_s` lies before the time of the last returned frame, the video is opened again. This happens at the
        first frame of a run that was rehearsed. Raises BadInputError if the file cannot be decoded.
        """
        if time_s + ROUNDING_S < self._shown_s:
            self.close()
            self._open(time_s)
        due = None
        while self._next[0] <= time_s + ROUNDING_S:
            self._shown_s, due = self._next
            item = self._queue.get()
            if isinstance(item, Exception):
                raise item
            self._next = item
        return due

    def _open(self, from_s: float) -> None:
        """Start to decode at `from_s` or a little earlier."""
        self._queue = queue.Queue(AHEAD)
        self._stop = threading.Event()
        self._shown_s = -1.0
        frames = self._frames(from_s)
        self._next = next(frames)
        self._thread = threading.Thread(target=self._decode, args=(frames,), name="background video", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the thread and close the file."""
        self._stop.set()
        with suppress(queue.Empty):
            while True:
                self._queue.get_nowait()
        self._thread.join()

    def _decode(self, frames: Iterator[tuple[float, U8]]) -> None:
        try:
            for item in frames:
                self._put(item)
                if self._stop.is_set():
                    return
        except Exception as error:
            self._put(error)

    def _put(self, item: tuple[float, U8] | Exception) -> None:
        while not self._stop.is_set():
            with suppress(queue.Full):
                return self._queue.put(item, timeout=0.1)

    def _frames(self, from_s: float) -> Iterator[tuple[float, U8]]:
        """Yield (time, picture) without end, starting at `from_s` or a little earlier.

        Raises BadInputError for a video without frames.
        """
        begin = from_s // self._period_s * self._period_s if self._period_s else 0.0
        seek_s = from_s - begin
        while True:
            last, step = -1.0, DEFAULT_STEP_S
            for time_s, picture in self._one_round(seek_s):
                at = max(time_s, last)  # times decrease in some files
                step = at - last if at > last >= 0 else step
                last = at
                yield begin + at, picture
            if last < 0:
                raise BadInputError(self._path, "no video frame", "a video with at least one frame")
            self._period_s = last + step
            begin, seek_s = begin + self._period_s, 0.0

    def _one_round(self, seek_s: float) -> Iterator[tuple[float, U8]]:
        """Yield (time, picture) from the last key frame before `seek_s` on. The file's first frame has time 0."""
        try:
            with open_video(self._path) as container:
                stream = video_stream(container, self._path)
                if self._start_s is not None and 0 < seek_s < (container.duration or 0) / MICROSECONDS:
                    container.seek(round((self._start_s + seek_s) * MICROSECONDS))
                for index, frame in enumerate(container.decode(stream)):
                    time_s = frame.time if frame.time is not None else index * DEFAULT_STEP_S
                    self._start_s = time_s if self._start_s is None else self._start_s
                    yield max(time_s - self._start_s, 0.0), self._fit(frame, pixels_of(stream))
        except (av.FFmpegError, ValueError) as error:
            raise BadInputError(self._path, f"no readable video ({error})", "a video that FFmpeg can decode") from error

    def _fit(self, frame: Any, pixels: Pixels) -> U8:
        check_size(self._path, frame)
        return fitted(frame, pixels, self._shape, self._turned)


def fitted(frame: Any, pixels: Pixels, shape: Shape, turned: int | None = None) -> U8:
    """Return the picture of `frame`, scaled, cropped and turned.

    `frame`: decoded frame.
    `pixels`: facts about its pixels.
    `shape`: size of the picture, (h,w).
    `turned`: number of quarter turns clockwise; None for the turns and the mirroring that the file says.
    """
    quarters = quarters_of(frame) if turned is None else turned % 4
    stored = (frame.height, round(frame.width * pixels.aspect))
    cut = cover(stored[::-1] if quarters % 2 else stored, shape)
    height, width = (cut.width, cut.height) if quarters % 2 else (cut.height, cut.width)
    scaled = frame.reformat(width=width, height=height, format="rgb48le" if pixels.transfer else "rgb24").to_ndarray()
    if turned is None and is_mirrored(frame):
        scaled = scaled[::-1]
    upright = np.rot90(scaled, -quarters)[cut.top : cut.top + shape[0], cut.left : cut.left + shape[1]]
    return to_srgb(upright, pixels.transfer, pixels.is_wide) if pixels.transfer else np.ascontiguousarray(upright)


def quarters_of(frame: Any) -> int:
    """Return the number of quarter turns clockwise that the file of `frame` says."""
    return int(-round(frame.rotation / 90) % 4)


def is_mirrored(frame: Any) -> bool:
    """Return whether the file says to mirror `frame` top to bottom before it is turned, as files of selfies do.

    FFmpeg computes the angle from the direction of x (`av_display_rotation_get`). After this turn, a mirror image
    differs only by a reversed y.
    """
    for side in frame.side_data:
        if side.type == Type.DISPLAYMATRIX:
            (a, b, _), (c, d, _), _ = np.frombuffer(bytes(side), np.int32).reshape(3, 3).astype(float)
            return bool(a * d - b * c < 0)
    return False


def check_size(path: Path, frame: Any) -> None:
    """Raise BadInputError if `frame` of `path` is too large."""
    if frame.width * frame.height > MAX_PIXELS:
        raise BadInputError(path, f"{frame.width}x{frame.height} pixels", f"at most {MAX_PIXELS} pixels")


def open_video(path: Path) -> Any:
    """Return the open file as a container, for reading.

    Raises av.FFmpegError for a file that is no video, or that makes FFmpeg open another file.
    """
    return av.open(str(path), metadata_errors="replace", options={"format_whitelist": CONTAINERS})


def require_video(path: Path) -> None:
    """Raise BadInputError for a text or another file that is no video, even if FFmpeg would open it.

    FFmpeg opens texts that name other files, such as playlists.
    """
    require_file(path, A_VIDEO)
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError as error:
        raise BadInputError.of_os_error(path, error, A_VIDEO) from None
    signature = signature_of_head(head)
    if signature is not None and signature.group not in (PICTURE, VIDEO):
        raise BadInputError(path, signature.name, A_VIDEO, signature.remedy)
    if signature is None and is_text(head):
        raise BadInputError(path, "text", A_VIDEO)


def is_text(head: bytes) -> bool:
    """Return whether a file that begins with `head` may be text; the head of a video has bytes that no text has."""
    return not NO_TEXT.search(head)


def video_stream(container: Any, path: Path) -> Any:
    """Return the first video stream of `container`. Raises BadInputError if there is none."""
    if not container.streams.video:
        raise BadInputError(path, "no video stream", "a video")
    return container.streams.video[0]


class Pixels(NamedTuple):
    """Facts about the pixels of a video.

    `aspect`: width of a pixel divided by its height.
    `transfer`: PQ or HLG; empty for a video of the usual range.
    `is_wide`: whether the primaries are BT.2020's.
    """

    aspect: float = 1.0
    transfer: str = ""
    is_wide: bool = False


def pixels_of(stream: Any) -> Pixels:
    """Return the facts about the pixels of a video `stream`."""
    codec = stream.codec_context
    aspect = float(codec.sample_aspect_ratio or 0)
    return Pixels(
        aspect if MIN_ASPECT < aspect < 1 / MIN_ASPECT else 1.0,
        TRANSFERS.get(int(codec.color_trc), ""),
        int(codec.color_primaries) == BT2020_PRIMARIES,
    )
