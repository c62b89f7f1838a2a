"""What lies under the avatars while the camera stands still. Rule: it is drawn twice and copied from then on.

The first frame of a view is only drawn, because most views of a moving camera never come again; the second one is kept,
in host memory: a software driver copies it from there in a tenth of a millisecond, and takes twenty times as long to
copy between framebuffers. A copy has the bytes of what was drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

import numpy as np

from trilane.stages.gpu.transfers import read_into, upload


class StillBackground:
    """Keeps the background of `target`, a framebuffer with one colour of four bytes."""

    def __init__(self, target: Any) -> None:
        self._target = target
        self._bytes = np.empty(target.width * target.height * 4, np.uint8)
        self._shown: Hashable = None
        self._is_kept = False

    def draw(self, shown: Hashable, draw: Callable[[], None]) -> None:
        """Fill the target with the background that `shown`, which is not None, stands for: by `draw`, or a copy."""
        if shown == self._shown and self._is_kept:
            upload(self._target.ctx, self._target.color_attachments[0], self._bytes)
            return
        draw()
        self._is_kept = shown == self._shown
        self._shown = shown
        if self._is_kept:
            read_into(self._target.ctx, self._target, self._bytes, components=4, alignment=1)
