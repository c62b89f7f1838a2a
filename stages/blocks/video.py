"""The blocks of video files: `video` reads a video, and `encode` writes one.

The block `video` writes the pictures of a video file, or of a folder of pictures, scaled and cropped to one size. Frame
n of a video is the picture that is shown n / rate seconds after the video's start. The rate is the run's, or else the
file's, or else 30. Frame n of a folder is picture n. After its end a video or folder begins again. A frame is found by
its number, so a unit that was started again goes on at the right frame.

The block `encode` writes pictures to a video. They go to a segment below the run's folder. If the unit is killed, its
segment is complete except for the last frames. After the run the segments are joined to the video. If somebody watches
the run, the newest picture goes to the window too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
from numpy.typing import NDArray

from trilane.arrays import U8, Shape
from trilane.errors import BadInputError
from trilane.pipeline.stage import Arrays, PortedStage, UnitContext
from trilane.stages.cpu.present import Segment
from trilane.stages.gpu.background import is_picture, pictures_in, read_picture
from trilane.stages.gpu.video_reader import VideoReader, open_video, require_video, video_stream
from trilane.transport.live_window import LiveWindow

DEFAULT_FPS = 30.0
EXPECTED = "a video or a folder of pictures"


class FoundPictures(NamedTuple):
    """Facts about a video or a folder of pictures.

    `pictures`: number of pictures; 0 if it is not known.
    `fps`: the file's own rate in frames a second; None if it has none.
    """

    pictures: int
    fps: float | None


def footage(path: Path) -> FoundPictures:
    """Return number and rate of the pictures of a video or a folder. Raises BadInputError if `path` has no pictures."""
    if not path.exists():
        raise BadInputError(path, "no such file", EXPECTED, "put it there, or change `path`")
    if files := _pictures(path):
        return FoundPictures(len(files), None)
    require_video(path)
    try:
        with open_video(path) as container:
            stream = video_stream(container, path)
            rate = stream.average_rate or stream.guessed_rate
            count = stream.frames or sum(packet.size > 0 for packet in container.demux(stream))
            return FoundPictures(count, float(rate) if rate else None)
    except (av.FFmpegError, OSError) as error:
        raise BadInputError(path, f"no readable video ({error})", EXPECTED, "convert it to .mp4") from None


def _pictures(path: Path) -> list[Path]:
    """Return the pictures of a folder, or the single picture `path`; empty for a video."""
    return pictures_in(path) if path.is_dir() else [path] if is_picture(path) else []


class VideoStage(PortedStage):
    """Writes one picture for each frame. Raises BadInputError for a file that cannot be read."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(settings)
        self._path = self.settings.folder / self.settings.keys["path"]
        height, width = next(iter(self.writes.values())).shape[:2]
        self._shape: Shape = (height, width)
        self._files = _pictures(self._path)
        self._reader = None if self._files else VideoReader(self._path, self._shape)
        self._fps = self.settings.keys.get("fps") or (None if self._files else footage(self._path).fps) or DEFAULT_FPS
        self._picture: U8 = np.zeros((height, width, 3), np.uint8)

    def work(self, frame: int, arrays: Sequence[NDArray[Any] | None], outputs: Arrays) -> Mapping[str, float]:  # noqa: ARG002
        if self._reader is None:
            self._picture = read_picture(self._files[frame % len(self._files)], self._shape)
        elif (picture := self._reader.at(frame / self._fps)) is not None:
            self._picture = picture
        for target in outputs.values():
            target[...] = self._picture
        return {}

    def close(self) -> None:
        if self._reader is not None:
            self._reader.close()


def build_video(settings: Mapping[str, Any], unit: UnitContext) -> VideoStage:  # noqa: ARG001 - a factory's signature
    """Build the block `video`. Raises BadInputError."""
    return VideoStage(settings)


class Encode(PortedStage):
    """Encodes one picture for each frame.

    Sides are cut to even numbers, because the video's colours need it. Raises BadInputError for a side of one pixel.
    Its keys:

    `fps`: rate of the video in frames a second.
    `segments`: name of the folder of segments below the run's folder.
    `window`: path of the window for the newest picture, or empty.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(settings)
        height, width, self._channels = self.reads[0].type.shape
        if min(height, width) < 2:
            where, found = f"{self.settings.where}.in", f"a picture of {width}x{height} pixels"
            raise BadInputError(where, found, "at least 2x2 pixels")
        self._height, self._width = height // 2 * 2, width // 2 * 2
        self._fps = self.settings.keys["fps"]
        folder = self.settings.run_folder / self.settings.keys["segments"]
        self._segment: Segment | None = Segment.begun(folder, self._fps, self._height, self._width)
        window = self.settings.keys.get("window")
        self._window = LiveWindow.opened(Path(window), self._height, self._width) if window else None

    def work(self, frame: int, arrays: Sequence[NDArray[Any] | None], outputs: Arrays) -> Mapping[str, float]:  # noqa: ARG002
        if arrays[0] is None or self._segment is None:
            return {}
        picture = arrays[0][: self._height, : self._width, :3]
        picture = np.ascontiguousarray(picture if self._channels > 1 else np.repeat(picture, 3, axis=2))
        if self._window is not None and self._window.is_looked_at:
            self._window.show(frame, frame / self._fps, self.sampled_ns, picture)
        self._segment.moved.start()
        self._segment.digest(frame, picture)
        self._segment.add(frame, picture)
        return {}

    def close(self) -> None:
        if self._segment is not None:
            self._segment.close()
            self._segment = None


def build_encode(settings: Mapping[str, Any], unit: UnitContext) -> Encode:  # noqa: ARG001 - a factory's signature
    """Build the block `encode`."""
    return Encode(settings)
