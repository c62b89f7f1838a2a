"""The background of a camera that stands still: copied bytes are those that drawing gives."""

from __future__ import annotations

from typing import Any

import numpy as np

from trilane.stages.gpu import opengl
from trilane.stages.gpu.composite import StillBackground

SHAPE = (18, 26)


def test_a_view_is_drawn_twice_and_then_copied(gl: Any) -> None:
    """What lies over it in between is gone, and a view that comes again is drawn again: the room may have grown."""
    colour = gl.texture(SHAPE[::-1], 4, internal_format=opengl.SRGB8_ALPHA8)
    target = gl.framebuffer([colour])
    still, drawn = StillBackground(target), []

    def draw(view: str) -> None:
        drawn.append(view)
        target.clear(ord(view) / 255, 0.25, 0.5, 1.0)

    for number, view in enumerate("AAAAABABBBA"):
        still.draw(view, lambda view=view: draw(view))
        shown = np.frombuffer(target.read(components=4, alignment=1), np.uint8).reshape(*SHAPE, 4)
        assert (shown == (ord(view), 64, 128, 255)).all(), number
        target.clear(0.9, 0.1, 0.1, 0.3, viewport=(3, 4, 9, 7))
    assert "".join(drawn) == "AA" + "BA" + "BB" + "A"
