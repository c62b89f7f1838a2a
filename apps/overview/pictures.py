"""Stills of runs, for the page: the frame in the middle of each video, as JPEG.

Rule: a video that cannot be read gives no picture and ends nothing; how many pictures a page holds is bounded.
"""

from __future__ import annotations

import io
from pathlib import Path

import av

MOST = 24
QUALITY = 85
WIDTH = 640


def still(video: Path) -> bytes | None:
    """The frame nearest before the middle of `video`, at most `WIDTH` wide; None where there is none."""
    try:
        with av.open(str(video)) as container:
            stream = container.streams.video[0]
            if stream.duration:
                container.seek(stream.duration // 2, stream=stream)
            frame = next(container.decode(stream))
            image = frame.to_image()
    except (av.error.FFmpegError, OSError, StopIteration, IndexError):
        return None
    if image.width > WIDTH:
        image = image.resize((WIDTH, round(image.height * WIDTH / image.width)))
    file = io.BytesIO()
    image.save(file, "JPEG", quality=QUALITY)
    return file.getvalue()
