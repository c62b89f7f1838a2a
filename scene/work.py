"""How much of a frame has to be made: all of it, nothing new, or no avatar at all.

Rule: pure; a picture is used again only when everything that it depends on is the same, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import IntEnum

from trilane.arrays import Floats


class Work(IntEnum):
    """What a frame asks for. FULL: a new picture of the avatars. REUSE: the one that is there. NONE: nobody is seen."""

    FULL = 0
    REUSE = 1
    NONE = 2


def shown_by(arrays: Iterable[Floats]) -> bytes:
    """What the picture of the avatars depends on, to be compared: `arrays` of always the same shapes."""
    return b"".join(array.tobytes() for array in arrays)


def work_of(
    shown: bytes, of_picture: bytes | None, of_nobody: bytes | None, is_anybody_seen: Callable[[], bool]
) -> Work:
    """What a frame that shows `shown` asks for.

    `of_picture`: what the frame showed whose picture is there, None when there is none.
    `of_nobody`: what a frame showed on which nobody was seen, None when there was none.
    `is_anybody_seen`: looks whether an avatar is on the screen; asked only when neither frame tells.
    """
    if shown == of_picture:
        return Work.REUSE
    if shown == of_nobody or not is_anybody_seen():
        return Work.NONE
    return Work.FULL
