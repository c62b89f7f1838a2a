"""The head-up display: what frame this is, how fast frames come and how old they are, written on the picture.

Rule: figures are this stage's own clock; they are renewed a few times a second, so that they can be read.
"""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from trilane.stages.gpu.program import build_program

SIZE = (232, 62)  # width, height
MARGIN_PX = 8
TEXT_PX = 15
RENEW_NS = 250_000_000
REMEMBERED = 60
SHEET, INK = (0, 0, 0, 150), (255, 255, 255, 255)


class Hud:
    """Draws into the lower left corner of a target; a smaller one shows what fits."""

    def __init__(self, ctx: Any) -> None:
        self._ctx = ctx
        self._program = build_program(ctx, "screen.vert", "hud.frag")
        self._screen = ctx.vertex_array(self._program, [])
        self._texture = ctx.texture(SIZE, 4)
        self._font = ImageFont.load_default(TEXT_PX)
        self._presented: deque[int] = deque(maxlen=REMEMBERED)
        self._renewed_ns = 0

    def draw(self, target: Any, pose: NDArray[np.void]) -> None:
        """Blend the display for the frame that `pose` describes over `target`."""
        now = time.monotonic_ns()
        self._presented.append(now)
        if now - self._renewed_ns >= RENEW_NS:
            self._renewed_ns = now
            self._texture.write(hud_picture(hud_lines(pose, list(self._presented)), self._font).tobytes())
        corner = MARGIN_PX, target.height - MARGIN_PX - SIZE[1]
        self._program["corner"].value = corner
        target.viewport = (*corner, *SIZE)
        self._ctx.enable_only(moderngl.BLEND)
        self._ctx.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        self._texture.use(0)
        self._screen.render(vertices=3)
        target.viewport = (0, 0, target.width, target.height)


def hud_lines(pose: NDArray[np.void], presented_ns: list[int]) -> list[str]:
    """Three lines; `presented_ns`: when the last frames were composed, the present one last."""
    span = presented_ns[-1] - presented_ns[0]
    rate = f"{(len(presented_ns) - 1) * 1e9 / span:.1f} fps" if span > 0 else "- fps"
    age_ms = (presented_ns[-1] - int(pose["t_pose_ns"])) / 1e6
    height, width = pose["tensor_shape"].tolist()
    visible = int(sum(avatar["visible"] for avatar in pose["avatars"][: int(pose["avatar_count"])]))
    return [
        f"frame {int(pose['frame'])}   {float(pose['media_time_s']):.2f} s",
        f"{rate}   {age_ms:.0f} ms from pose",
        f"tensor {height}x{width}   {visible} in view",
    ]


def hud_picture(lines: list[str], font: Any) -> NDArray[np.uint8]:
    """(62,232,4) uint8, straight alpha: `lines` on a dark sheet."""
    image = Image.new("RGBA", SIZE, SHEET)
    ImageDraw.Draw(image).multiline_text((8, 3), "\n".join(lines), INK, font, spacing=3)
    return np.asarray(image)
