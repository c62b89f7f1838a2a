"""Pictures of a few presented frames, kept without loss beside the run, to be compared when it is over.

Rule: only frames that were asked for are kept; of a number that is never presented, the next one that is. Other frames
cost one comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from trilane.arrays import U8

FOLDER = "kept"


class KeptFrames:
    """Keeps frames `numbers`, which rise, in `folder`/`FOLDER`."""

    def __init__(self, folder: Path, numbers: Sequence[int]) -> None:
        self._folder, self._numbers = folder / FOLDER, list(numbers)
        self._next = self._numbers.pop(0) if self._numbers else None

    def see(self, frame: int, pixels: U8) -> None:
        """Keep frame `frame`, (h,w,3), if it is asked for."""
        if self._next is None or frame < self._next:
            return
        self._folder.mkdir(exist_ok=True)
        np.save(self._folder / f"{frame}.npy", pixels, allow_pickle=False)
        while self._next is not None and self._next <= frame:
            self._next = self._numbers.pop(0) if self._numbers else None


def kept_frames(folder: Path) -> dict[int, Path]:
    """The files of the frames that were kept in `folder`, by number."""
    return {int(file.stem): file for file in sorted((folder / FOLDER).glob("*.npy"), key=lambda file: int(file.stem))}
