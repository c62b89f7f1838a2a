"""The head-up display: frame number, frame rate, age and tensor size, written on the picture.

Rule: frame number and time are the picture's; rate and age, which this stage measures, are updated four times a second
so that they can be read, and start anew when frame numbers do.
"""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from trilane.stages.gpu.shader_program import build_program
from trilane.stages.gpu.transfers import upload

SIZE = (232, 62)  # width, height
MARGIN_PX = 8
TEXT_PX = 15
RENEW_NS = 250_000_000
REMEMBERED = 60
SHEET, INK = (0, 0, 0, 150), (255, 255, 255, 255)


class Hud:
    """Draws into the lower left corner of a target; a target smaller than the display shows a part of it."""

    def __init__(self, ctx: Any) -> None:
        self._ctx = ctx
        self._program = build_program(ctx, "whole_screen.vert", "head_up_display.frag")
        self._screen = ctx.vertex_array(self._program, [])
        self._texture = ctx.texture(SIZE, 4)
        self._font = ImageFont.load_default(TEXT_PX)
        self._presented: deque[int] = deque(maxlen=REMEMBERED)
        self._renewed_ns = self._frame = 0
        self._measured = ""

    def draw(self, target: Any, pose: NDArray[np.void]) -> None:
        """Blend the display for the frame of pose packet `pose` over `target`."""
        lines = self._lines(pose, time.monotonic_ns())
        upload(self._ctx, self._texture, hud_picture(lines, self._font).tobytes())
        corner = MARGIN_PX, target.height - MARGIN_PX - SIZE[1]
        self._program["corner"].value = corner
        target.viewport = (*corner, *SIZE)
        self._ctx.enable_only(moderngl.BLEND)
        self._ctx.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        self._texture.use(0)
        self._screen.render(vertices=3)
        target.viewport = (0, 0, target.width, target.height)

    def _lines(self, pose: NDArray[np.void], now_ns: int) -> list[str]:
        if int(pose["frame"]) <= self._frame:
            self._presented.clear()
            self._renewed_ns = 0
        self._frame = int(pose["frame"])
        self._presented.append(now_ns)
        if now_ns - self._renewed_ns >= RENEW_NS:
            self._renewed_ns = now_ns
            self._measured = measured_line(pose, list(self._presented))
        return hud_lines(pose, self._measured)


def measured_line(pose: NDArray[np.void], presented_ns: list[int]) -> str:
    """The line of rate and age. `presented_ns`: when the last frames were composed, this frame's time last."""
    span = presented_ns[-1] - presented_ns[0]
    rate = f"{(len(presented_ns) - 1) * 1e9 / span:.1f} fps" if span > 0 else "- fps"
    age_ms = (presented_ns[-1] - int(pose["t_sampled_ns"])) / 1e6
    return f"{rate}   {age_ms:.0f} ms from pose"


def hud_lines(pose: NDArray[np.void], measured: str) -> list[str]:
    """The three lines of the display; `measured` is the middle one."""
    height, width = pose["tensor_shape"].tolist()
    visible = int(sum(avatar["visible"] for avatar in pose["avatars"][: int(pose["avatar_count"])]))
    return [
        f"frame {int(pose['frame'])}   {float(pose['media_time_s']):.2f} s",
        measured,
        f"tensor {height}x{width}   {visible} in view",
    ]


def hud_picture(lines: list[str], font: Any) -> NDArray[np.uint8]:
    """(62,232,4) uint8, straight alpha: `lines` on a dark background."""
    image = Image.new("RGBA", SIZE, SHEET)
    ImageDraw.Draw(image).multiline_text((8, 3), "\n".join(lines), INK, font, spacing=3)
    return np.asarray(image)
