"""Describes a picture, a video or a folder of pictures as a background would show it.

Rule: the reader of backgrounds decides whether it is usable; sizes and rates are those that its header states.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import av
import numpy as np
from PIL import ExifTags, Image, ImageDraw

from trilane.apps.inspect.inspection import Inspection, Length, used
from trilane.errors import BadInputError, reason
from trilane.scene.footage import Footage
from trilane.scene.recordings import Detected
from trilane.stages.gpu.background import MOST_PACKETS, is_picture, open_background, pictures_in, read_picture, survey
from trilane.stages.gpu.video_reader import quarters_of

THUMB = (160, 213)  # height, width
COLUMNS, MOST_THUMBS = 4, 8
FOLDER_FPS = 30.0
DAMAGED = (OSError, ValueError, SyntaxError, Image.DecompressionBombError)


def inspect_picture(path: Path) -> Inspection:
    """Read a picture, or a video if it has several frames. Raises BadInputError when no background can use it."""
    if not is_picture(path) and _moves(path):
        return inspect_video(path)
    thumb = read_picture(path, THUMB)
    encoding, facts = picture_facts(path)
    return Inspection(
        "picture",
        f"a {encoding} picture of {facts['width']}x{facts['height']} pixels",
        "",
        used("--background", path),
        Detected(f"{encoding} picture", "the head of the file", axes=_turned(facts["exif_orientation"])),
        facts=facts,
        draw=partial(_sheet, [thumb], [path.name]),
    )


def _moves(path: Path) -> bool:
    """Return whether the picture has several frames."""
    try:
        with Image.open(path) as image:
            return bool(getattr(image, "is_animated", False))
    except DAMAGED:
        return False


def picture_facts(path: Path) -> tuple[str, dict[str, Any]]:
    """Return a picture's encoding, and its `width`, `height`, `mode` and `exif_orientation`. Raises BadInputError."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            turn = image.getexif().get(ExifTags.Base.Orientation, 1)
            return str(image.format), {
                "width": image.width,
                "height": image.height,
                "mode": image.mode,
                "exif_orientation": int(turn) if isinstance(turn, int) and 1 <= turn <= 8 else 1,
            }
    except DAMAGED as error:
        raise BadInputError(path, f"no readable picture ({reason(error)})", "a picture") from error


def _turned(orientation: int) -> str:
    return "" if orientation == 1 else f"EXIF orientation {orientation}: turned or mirrored to be upright"


def inspect_folder(path: Path) -> Inspection:
    """Read a folder of pictures. Raises BadInputError when one of them is not usable."""
    names, footage = pictures_in(path), survey(path, FOLDER_FPS)
    for name in names:
        _require_whole(name)
    sizes = sorted({(facts["width"], facts["height"]) for _, facts in map(picture_facts, names)})
    chosen = [names[k] for k in _spread(len(names))]
    first = f"{sizes[0][0]}x{sizes[0][1]}"
    return Inspection(
        "pictures",
        f"a folder of {len(names)} pictures of {first if len(sizes) == 1 else f'{len(sizes)} sizes'}",
        "",
        used("--background", path),
        Detected("folder of pictures", f"{len(names)} files end as pictures do", rate=_folder_rate(footage)),
        facts={
            "pictures": len(names),
            "first": names[0].name,
            "last": names[-1].name,
            "sizes": [list(s) for s in sizes],
        },
        draw=lambda: _sheet([read_picture(name, THUMB) for name in chosen], [name.name for name in chosen]),
    )


def _folder_rate(footage: Footage) -> str:
    """Return the rate of the pictures in a scene, and what is missing."""
    own = footage.rate if footage.clock_s else ("the scene's, one a frame", *footage.rate[1:])
    return "; ".join(own)


def _require_whole(path: Path) -> None:
    """Raise BadInputError for a picture that cannot be decoded to its end."""
    read_picture(path, (8, 8))


def inspect_video(path: Path) -> Inspection:
    """Read a video. Raises BadInputError when no background can use it."""
    footage = survey(path, FOLDER_FPS)
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            stream = container.streams.video[0]
            facts = _video_facts(stream)
            seconds, stated = _seconds(container, stream), stream.frames
    except (av.FFmpegError, ValueError, OSError) as error:
        raise BadInputError(path, f"no readable video ({error})", "a video that FFmpeg can decode") from error
    rate, turn = facts["rate_hz"], facts["turned_deg"]
    frames = stated or _counted(path)
    turned = f", turned by {turn} degrees" if turn else ""
    return Inspection(
        "video",
        f"a video ({facts['codec']}) of {facts['width']}x{facts['height']} pixels{turned}",
        "",
        used("--background", path),
        Detected(
            f"{facts['codec']} video", "streams that FFmpeg finds", rate="; ".join((*footage.rate, *footage.what[1:]))
        ),
        Length(frames, seconds, rate if stated or not seconds else frames / seconds),
        facts,
        draw=partial(_film, path, seconds),
    )


def _counted(path: Path) -> int:
    """Count the frames of a video whose file does not state their number."""
    with av.open(str(path), metadata_errors="replace") as container:
        packets = container.demux(container.streams.video[0])
        return sum(packet.size > 0 for packet in itertools.islice(packets, MOST_PACKETS))


def _video_facts(stream: Any) -> dict[str, Any]:
    pixels = stream.format
    return {
        "codec": stream.codec_context.name,
        "width": stream.width,
        "height": stream.height,
        "rate_hz": float(stream.average_rate) if stream.average_rate else None,
        "bits": max((part.bits for part in pixels.components), default=8) if pixels else 8,
        "turned_deg": _rotation(stream),
    }


def _rotation(stream: Any) -> int:
    """Return the degrees by which the file says the first frame is to be turned clockwise."""
    for frame in stream.container.decode(stream):
        return 90 * quarters_of(frame)
    return 0


def _seconds(container: Any, stream: Any) -> float:
    if stream.duration:
        return float(stream.duration * stream.time_base)
    return float((container.duration or 0) / av.time_base)


def _film(path: Path, seconds: float) -> Image.Image:
    """Return a sheet of frames at evenly spread times."""
    background = open_background(path, THUMB, FOLDER_FPS)
    pictures, captions = [], []
    try:
        for time_s in np.linspace(0, max(seconds - 0.05, 0), MOST_THUMBS):
            picture = background.at(float(time_s))
            if picture is not None:
                pictures.append(picture)
                captions.append(f"{time_s:.2f} s")
    finally:
        background.close()
    return _sheet(pictures, captions)


def _spread(count: int) -> list[int]:
    return sorted({int(k) for k in np.linspace(0, count - 1, min(count, MOST_THUMBS)).round()})


def _sheet(pictures: Sequence[Any], captions: Sequence[str]) -> Image.Image:
    height, width = THUMB
    columns = min(COLUMNS, len(pictures))
    sheet = Image.new("RGB", (columns * width, -(-len(pictures) // columns) * height))
    draw = ImageDraw.Draw(sheet)
    for place, (picture, caption) in enumerate(zip(pictures, captions, strict=True)):
        corner = (place % columns * width, place // columns * height)
        sheet.paste(Image.fromarray(picture), corner)
        draw.text((corner[0] + 4, corner[1] + 2), caption, fill="white", stroke_width=2, stroke_fill="black")
    return sheet
