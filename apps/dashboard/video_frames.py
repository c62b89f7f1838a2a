"""The pictures of a finished run, from its video. Rule: one is decoded when it is asked for, and none is kept."""

from __future__ import annotations

import io
from fractions import Fraction
from pathlib import Path
from typing import Any

import av

JPEG_QUALITY = 82


class VideoFrames:
    """`path`: a video of `trilane run`, in which frame n is shown from n / `fps` on.

    Raises OSError and av.error.FFmpegError.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self._container: Any = av.open(str(path))
        self._stream: Any = self._container.streams.video[0]
        self._fps = fps

    def jpeg(self, frame: int) -> bytes | None:
        """What was shown when frame `frame` was; None when the video does not reach so far."""
        at = Fraction(frame) / Fraction(self._fps).limit_denominator(1001)
        pts = int(at / self._stream.time_base)
        self._container.seek(pts, stream=self._stream, backward=True)
        newest = None
        half = Fraction(1, 2) / Fraction(self._fps).limit_denominator(1001) / self._stream.time_base
        for picture in self._container.decode(self._stream):
            if newest is not None and picture.pts > pts + half:
                break
            newest = picture
        return None if newest is None else jpeg_of(newest.to_image())

    def close(self) -> None:
        self._container.close()


def jpeg_of(image: Any) -> bytes:
    """A Pillow image as a JPEG."""
    target = io.BytesIO()
    image.save(target, "JPEG", quality=JPEG_QUALITY)
    return target.getvalue()
