"""COLMAP's text files. Rule: an image is two lines, of which the second, its points, is skipped, and may be missing.

Format: https://colmap.github.io/format.html#text-format.
"""

from __future__ import annotations

from pathlib import Path

from trilane.errors import BadInputError
from trilane.files import read_text
from trilane.scene.camera.colmap_model import BY_NAME, MAX_NAME, ColmapCamera, ColmapImage, checked_camera

CAMERAS = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS a line"
IMAGES = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME a line, then its points"
WORDS = 10  # of an image's first line, without blanks in its name


def read_cameras_text(path: Path) -> dict[int, ColmapCamera]:
    """The cameras of `path` by their numbers. Raises BadInputError with the line."""
    cameras = {}
    for number, line in _lines(path, CAMERAS):
        where, words = f"{path}, line {number}", line.split()
        if len(words) < 5 or words[1] not in BY_NAME:
            found = f"the camera model {words[1]!r}" if len(words) > 1 else f"{len(words)} words"
            raise BadInputError(where, found, f"{CAMERAS}, with one of {', '.join(BY_NAME)}")
        try:
            numbers = [float(word) for word in words[2:]]
            camera = int(words[0])
        except ValueError as error:
            raise BadInputError(where, str(error), CAMERAS) from None
        cameras[camera] = checked_camera(where, BY_NAME[words[1]], (numbers[0], numbers[1]), numbers[2:])
    return cameras


def read_images_text(path: Path) -> list[ColmapImage]:
    """The images of `path`. Raises BadInputError with the line."""
    images, is_points = [], False
    for number, line in _lines(path, IMAGES, keeps_blank=True):
        is_image = _is_image(line)
        if is_image:
            images.append(_image(f"{path}, line {number}", line))
        elif not is_points and line:
            raise BadInputError(f"{path}, line {number}", repr(line[:40]), IMAGES)
        is_points = is_image
    return images


def _lines(path: Path, expected: str, keeps_blank: bool = False) -> list[tuple[int, str]]:
    lines = ((number, line.strip()) for number, line in enumerate(read_text(path, expected).splitlines(), 1))
    return [(number, line) for number, line in lines if not line.startswith("#") and (line or keeps_blank)]


def _is_image(line: str) -> bool:
    """Whether the line has a name behind its numbers; points are triples of numbers."""
    words = line.split(maxsplit=WORDS - 1)
    if len(words) < WORDS:
        return False
    try:
        [float(word) for word in words[WORDS - 1].split()]
    except ValueError:
        return True
    return len(line.split()) % 3 != 0


def _image(where: str, line: str) -> ColmapImage:
    words = line.split(maxsplit=WORDS - 1)
    try:
        if len(words[9]) > MAX_NAME:
            raise BadInputError(where, f"a name of {len(words[9])} letters", f"at most {MAX_NAME}")
        numbers = tuple(float(word) for word in words[1:8])
        return ColmapImage(words[9], numbers[:4], numbers[4:], int(words[8]))
    except ValueError as error:
        raise BadInputError(where, str(error), IMAGES) from None
