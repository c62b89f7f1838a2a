"""The composite stage: it draws background, planes, contact shadows, avatars and the text display, in that order.

Avatars are drawn from far to near; an avatar that is not visible leaves no trace. If an output slot still has an equal
frame, the new frame is copied instead of drawn. Only this stage writes to its output slots, so their bytes stay until
it writes there again.

While the camera stands still, everything under the avatars is drawn for two frames, and copied for all further ones.
The first frame of a view is only drawn, because most views of a moving camera never come again. The second frame is
also kept in host memory. A software driver copies from there in a tenth of a millisecond; a copy between framebuffers
takes twenty times as long.

The text display shows frame number and time of the picture, and the rate and the age of frames, which this stage
measures. Rate and age are updated four times a second, so that a person can read them. Their measurement starts again
when the frame numbers start again.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from trilane.arrays import F64, Floats, Shape
from trilane.pipeline.stage import UnitContext
from trilane.scene.planner import FrameWork
from trilane.scene.schema import PlaneSpec
from trilane.stages.avatar_assets import distinct, shaped_body, staged_of
from trilane.stages.config import PAINTED_CHANNELS, RunConfig, network_parts
from trilane.stages.gpu import opengl
from trilane.stages.gpu.background import Background, open_background
from trilane.stages.gpu.composite_painters import (
    DISCS,
    AvatarPainter,
    PicturePainter,
    PlanePainter,
    RoomPainter,
    ShadowPainter,
    floor_discs,
)
from trilane.stages.gpu.opengl import (
    CONTEXT,
    build_program,
    checked,
    counter_of,
    describe,
    open_context,
    read_into,
    upload,
)
from trilane.transport.packets import Packet
from trilane.units import ROOM

#: Inputs of a frame's picture: number of the avatars' picture, number of the background's picture, view, projection.
Drawing = tuple[int, int, bytes, bytes]


class DrawnFrames:
    """Remembers which drawing each output slot has. A drawing is the inputs from which a frame's picture follows."""

    def __init__(self) -> None:
        self._slots: dict[int, tuple[Drawing | None, int]] = {}

    def slot_of(self, drawing: Drawing | None, preferred: int) -> int | None:
        """Return a slot that has `drawing`, if possible `preferred`; None if no slot has it or `drawing` is None."""
        if drawing is None:
            return None
        held = [slot for slot, (there, _) in self._slots.items() if there == drawing]
        return preferred if preferred in held else held[0] if held else None

    def note(self, slot: int, drawing: Drawing | None, frame: int, copied_from: int | None) -> int:
        """Note that `slot` has the drawing of `frame` from now on; return the field `repeats` of the frame's header.

        `copied_from`: slot that already had the drawing; None if it was drawn now.
        """
        drawn = frame if copied_from is None else self._slots[copied_from][1]
        self._slots[slot] = (drawing, drawn)
        return 0 if copied_from is None else drawn + 1


class StillBackground:
    """Keeps the pixels of a background that two frames in a row have, so that further frames copy them.

    `target`: framebuffer with one RGBA colour attachment of 8 bits.
    """

    def __init__(self, target: Any) -> None:
        self._target = target
        self._bytes = np.empty(target.width * target.height * 4, np.uint8)
        self._shown: Hashable = None
        self._is_kept = False

    def draw(self, shown: Hashable, draw: Callable[[], None]) -> None:
        """Fill the target with a background: copy the kept pixels, or else call `draw`.

        `shown`: value that identifies the background; not None.
        """
        if shown == self._shown and self._is_kept:
            upload(self._target.ctx, self._target.color_attachments[0], self._bytes)
            return
        draw()
        self._is_kept = shown == self._shown
        self._shown = shown
        if self._is_kept:
            read_into(self._target.ctx, self._target, self._bytes, components=4, alignment=1)


SIZE = (232, 62)  # width, height
MARGIN_PX = 8
TEXT_PX = 15
RENEW_NS = 250_000_000
REMEMBERED = 60
SHEET, INK = (0, 0, 0, 150), (255, 255, 255, 255)


class Hud:
    """Draws the text display into the lower left corner of a target; a smaller target shows only a part of it."""

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
        """Blend the text display over `target`. `pose`: header of the frame."""
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
    """Return the line of the text display with rate and age.

    `pose`: header of the frame.
    `presented_ns`: times at which the last frames were composed, ascending, up to this frame.
    """
    span = presented_ns[-1] - presented_ns[0]
    rate = f"{(len(presented_ns) - 1) * 1e9 / span:.1f} fps" if span > 0 else "- fps"
    age_ms = (presented_ns[-1] - int(pose["t_sampled_ns"])) / 1e6
    return f"{rate}   {age_ms:.0f} ms from pose"


def hud_lines(pose: NDArray[np.void], measured: str) -> list[str]:
    """Return the three lines of the text display for the frame with header `pose`.

    `measured`: middle line, from `measured_line`.
    """
    height, width = pose["tensor_shape"].tolist()
    visible = int(sum(avatar["visible"] for avatar in pose["avatars"][: int(pose["avatar_count"])]))
    return [
        f"frame {int(pose['frame'])}   {float(pose['media_time_s']):.2f} s",
        measured,
        f"tensor {height}x{width}   {visible} in view",
    ]


def hud_picture(lines: list[str], font: Any) -> NDArray[np.uint8]:
    """Return a picture of `lines` on a dark background, (62,232,4) uint8, straight alpha."""
    image = Image.new("RGBA", SIZE, SHEET)
    ImageDraw.Draw(image).multiline_text((8, 3), "\n".join(lines), INK, font, spacing=3)
    return np.asarray(image)


class CompositeStage:
    """Draws frames of `shape` (height, width).

    `shapes`: tensor shapes (height, width) that may come.
    `rest`: rest joints (55,3) of each avatar of the scene, metres.
    `background`: background from files; None for the built-in room.
    `eyes`: camera positions (3,) that the room contains from the first frame on, so that the room never grows.
    `planes`: planes of the scene to draw.
    `hud`: whether to draw the text display.
    `painters`: number of the network that paints each avatar; empty if one network paints all.
    """

    def __init__(
        self,
        ctx: Any,
        shape: Shape,
        shapes: Sequence[Shape],
        rest: Sequence[F64],
        background: Background | None,
        eyes: Sequence[Floats] = (),
        planes: Sequence[PlaneSpec] = (),
        hud: bool = False,
        painters: Sequence[int] = (),
    ) -> None:
        self._ctx, self._shape, self._rest, self._background = ctx, shape, rest, background
        colour = ctx.texture(shape[::-1], 4, internal_format=opengl.SRGB8_ALPHA8)
        self._target = ctx.framebuffer([colour])
        self._still = StillBackground(self._target)
        self._room = RoomPainter(ctx, eyes) if background is None else None
        self._picture = None if background is None else PicturePainter(ctx, shape)
        self._planes = PlanePainter(ctx, planes) if planes else None
        self._hud = Hud(ctx) if hud else None
        self._shadow = ShadowPainter(ctx, len(DISCS) * len(rest))
        self._shapes, self._network = list(shapes), painters or [0] * len(rest)
        self._painters = [AvatarPainter(ctx, self._shapes) for _ in set(self._network)]
        self._held: NDArray[np.void] | None = None  # header of the frame whose picture of the avatars was uploaded
        self._shows_background = 0  # number of background pictures so far
        self._drawn = DrawnFrames()
        self._inputs: Sequence[Packet] = ()
        self._outputs: Sequence[Packet] = ()

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        self._inputs, self._outputs = inputs, outputs

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """Write the frame to the output slot, (h,w,3) uint8 sRGB, row 0 on top.

        The metrics are the bytes moved, and four numbers that are 1 or 0:
        - `nobody`: nobody is on the screen;
        - `reused`: the avatars' picture of the right earlier frame is shown again;
        - `stale`: the right picture never came, so an older one is shown;
        - `copied`: the frame was copied from an equal frame in a slot, not drawn.

        The least bytes are new pictures, and the frame if no slot had it. New pictures are the background's, and the
        networks' in the `tensor_rect`s of visible avatars. Raises ValueError without a slot, BadInputError for a
        background that cannot be decoded, and as `opengl.check` does.
        """
        if slot_in is None or slot_out is None:
            raise ValueError("composite needs an input and an output slot")
        packet, out = self._inputs[slot_in], self._outputs[slot_out]
        pose, moved = packet.header, counter_of(self._ctx)
        moved.start(pose.nbytes)
        with checked(self._ctx):
            self._take(pose, packet.payload)
            drawing = self._drawing(pose)
            # A full frame brings a new picture of the avatars, so no slot can hold it already.
            repeated = None if int(pose["work"]) == FrameWork.FULL else self._drawn.slot_of(drawing, slot_out)
            frame_bytes = math.prod(self._shape) * 3
            if repeated is None:
                self._draw(pose)
                read_into(self._ctx, self._target, out.payload[:frame_bytes], components=3, alignment=1)
                moved.written += frame_bytes
                moved.least += frame_bytes
            elif repeated != slot_out:
                out.payload[:frame_bytes] = self._outputs[repeated].payload[:frame_bytes]
                moved.copied(frame_bytes)
        out.header["repeats"] = self._drawn.note(slot_out, drawing, frame, repeated)
        work, is_right = FrameWork(int(pose["work"])), self._holds(int(pose["picture"]))
        said = {
            "nobody": work is FrameWork.NONE,
            "reused": work is FrameWork.REUSE and is_right,
            "stale": work is FrameWork.REUSE and not is_right,
            "copied": repeated is not None,
        }
        return {**{name: float(value) for name, value in said.items()}, **moved.figures()}

    def draw(self, pose: NDArray[np.void], image: NDArray[np.uint8]) -> None:
        """Draw a frame into the target. `pose`: its header. `image`: payload with the networks' pictures."""
        self._take(pose, image)
        self._draw(pose)

    def _take(self, pose: NDArray[np.void], image: NDArray[np.uint8]) -> None:
        """Upload the background's new picture, if there is one, and `image` if the frame is a full frame."""
        if self._background is not None and self._picture is not None:
            picture = self._background.at(float(pose["media_time_s"]))
            if picture is not None:
                self._shows_background += 1
                self._picture.upload(picture)
                counter_of(self._ctx).least += picture.nbytes
        if int(pose["work"]) == FrameWork.FULL:
            # Copied, because a later frame is written to the same slot.
            self._held = pose.copy()
            shape, visible = _tensor_shape(pose), _visible(pose)
            parts = network_parts(image, len(self._painters), self._shapes, PAINTED_CHANNELS)
            for network in {self._network[int(avatar["avatar"])] for avatar in visible}:
                self._painters[network].upload(shape, parts[network][: math.prod(shape) * PAINTED_CHANNELS])
            cells = (avatar["tensor_rect"][2:].tolist() for avatar in visible)
            counter_of(self._ctx).least += sum(PAINTED_CHANNELS * height * width for height, width in cells)

    def _holds(self, picture: int) -> bool:
        """Return whether the uploaded picture of the avatars belongs to the frame with the number `picture`."""
        return self._held is not None and int(self._held["picture"]) == picture

    def _drawing(self, pose: NDArray[np.void]) -> Drawing | None:
        """Return the inputs on which the bytes of the frame with header `pose` depend.

        The result is None if the text display makes each frame different.
        """
        if self._hud is not None:
            return None
        nobody = self._held is None or int(pose["work"]) == FrameWork.NONE
        picture = -1 if self._held is None or nobody else int(self._held["picture"])
        return picture, self._shows_background, pose["view"].tobytes(), pose["projection"].tobytes()

    def _draw(self, pose: NDArray[np.void]) -> None:
        """Draw the frame of `pose`, with the picture of the avatars that was uploaded last."""
        self._target.use()
        shown = self._shows_background, pose["view"].tobytes(), pose["projection"].tobytes()
        self._still.draw(shown, lambda: self._draw_background(pose))
        if self._held is not None and int(pose["work"]) != FrameWork.NONE:
            self._draw_avatars(self._held)
        if self._hud is not None:
            self._hud.draw(self._target, pose)

    def _draw_avatars(self, pose: NDArray[np.void]) -> None:
        visible, shape = _visible(pose), _tensor_shape(pose)
        if visible:
            discs = [floor_discs(avatar["joints"], self._rest[int(avatar["avatar"])]) for avatar in visible]
            self._shadow.draw(pose["view"], pose["projection"], np.concatenate(discs))
        for avatar in sorted(visible, key=lambda a: self._depth(pose, a)):
            rect = tuple(float(side) for side in avatar["rect"])
            top, left, height, width = (int(side) for side in avatar["tensor_rect"])
            painter = self._painters[self._network[int(avatar["avatar"])]]
            painter.draw(self._target, shape, rect, (top, left, height, width))

    def close(self) -> None:
        """Close the background's file."""
        if self._background is not None:
            self._background.close()

    def _draw_background(self, pose: NDArray[np.void]) -> None:
        if self._room is not None:
            self._room.draw(self._target, pose["view"], pose["projection"])
        if self._picture is not None:
            self._picture.draw()
        if self._planes is not None:
            self._planes.draw(pose["view"], pose["projection"])

    def _depth(self, pose: NDArray[np.void], avatar: Any) -> float:
        """Return z of the pelvis of an avatar in camera space, metres; the most negative is the farthest."""
        pelvis = avatar["joints"][0] @ np.append(self._rest[int(avatar["avatar"])][0], 1.0)
        return float(pose["view"][2, :3] @ pelvis + pose["view"][2, 3])


def _visible(pose: NDArray[np.void]) -> list[Any]:
    return [avatar for avatar in pose["avatars"][: int(pose["avatar_count"])] if avatar["visible"]]


def _tensor_shape(pose: NDArray[np.void]) -> Shape:
    return int(pose["tensor_shape"][0]), int(pose["tensor_shape"][1])


def build(settings: Mapping[str, Any], unit: UnitContext) -> CompositeStage:
    """Build the composite stage of the configuration in `settings`. Raises BadInputError, MissingPartError."""
    config = RunConfig.model_validate(settings["config"])
    scene = config.scene
    shape, folders = (scene.output.height, scene.output.width), distinct(config)
    joints = [shaped_body(unit.assets, folders.index(folder)).joints for folder in config.avatar_dirs]
    camera = staged_of(unit.assets).camera
    background = None
    if scene.background != ROOM:
        background = open_background(Path(scene.background), shape, scene.fps, camera.path)
    ctx = unit.shared(CONTEXT, lambda: open_context(unit.settings.threads))
    driver = describe(ctx)
    if driver.hardware:
        unit.use_device(driver.renderer)
    eyes, networks = camera.reach(), config.networks
    return CompositeStage(ctx, shape, config.buckets, joints, background, eyes, scene.planes, scene.hud, networks)
