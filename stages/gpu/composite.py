"""The composite stage: background, planes, contact shadow, avatars, display, in that order, to the presented frame.

Rule: avatars are drawn far to near; one that is not visible leaves no trace. A frame that would be drawn as one that an
output slot still holds is copied, not drawn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64, Floats
from trilane.pipeline.stage import UnitContext
from trilane.scene.planner import FrameWork
from trilane.scene.schema import PlaneSpec
from trilane.shapes import Shape
from trilane.stages.avatar_assets import distinct, shaped_body, staged_of
from trilane.stages.config import RunConfig
from trilane.stages.gpu import opengl_calls
from trilane.stages.gpu.background import Background, open_background
from trilane.stages.gpu.composite_painters import AvatarPainter, PicturePainter, RoomPainter, ShadowPainter
from trilane.stages.gpu.contact_shadows import DISCS, floor_discs
from trilane.stages.gpu.detected_planes import PlanePainter
from trilane.stages.gpu.drawn_frames import Drawing, DrawnFrames
from trilane.stages.gpu.head_up_display import Hud
from trilane.stages.gpu.opengl_context import CONTEXT, checked, describe, open_context
from trilane.stages.gpu.still_background import StillBackground
from trilane.stages.gpu.transfers import counter_of, read_into
from trilane.transport.packets import Packet

ROOM = "room"


class CompositeStage:
    """Draws frames of `shape` (height, width).

    `shapes`: tensor shapes that may come.
    `rest`: rest joints (55,3) of each avatar of the scene, metres.
    `background`: None for the built-in room.
    `eyes`: places (3,) that the room holds from the first frame on, so that it does not grow, nor after a restart.
    `planes`: detected ones to show.
    `hud`: show frame, rate and age.
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
    ) -> None:
        self._ctx, self._shape, self._rest, self._background = ctx, shape, rest, background
        colour = ctx.texture(shape[::-1], 4, internal_format=opengl_calls.SRGB8_ALPHA8)
        self._target = ctx.framebuffer([colour])
        self._still = StillBackground(self._target)
        self._room = RoomPainter(ctx, eyes) if background is None else None
        self._picture = None if background is None else PicturePainter(ctx, shape)
        self._planes = PlanePainter(ctx, planes) if planes else None
        self._hud = Hud(ctx) if hud else None
        self._shadow = ShadowPainter(ctx, len(DISCS) * len(rest))
        self._painter = AvatarPainter(ctx, list(shapes))
        self._held: NDArray[np.void] | None = None  # header of the frame whose picture of the avatars was uploaded
        self._shows_background = 0  # grows with each picture of it
        self._drawn = DrawnFrames()
        self._inputs: Sequence[Packet] = ()
        self._outputs: Sequence[Packet] = ()

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Keep the slots."""
        self._inputs, self._outputs = inputs, outputs

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """Write the frame, (h,w,3) uint8 sRGB, row 0 on top.

        Figures: of a job, 1 or 0 for `nobody` (on the screen), `reused` (the picture of an earlier frame is the right
        one), `stale` (it is not, but that one never came), and `copied` (not drawn: it is an earlier frame's). And the
        bytes moved. The least: what is new of the background, and of the network's picture in the cells of avatars in
        view; and the frame, where it is not one that a slot holds already.
        """
        if slot_in is None or slot_out is None:
            raise ValueError("composite needs an input and an output slot")
        packet, out = self._inputs[slot_in], self._outputs[slot_out]
        pose, moved = packet.header, counter_of(self._ctx)
        moved.start(pose.nbytes)
        with checked(self._ctx):
            self._take(pose, packet.payload)
            drawing = self._drawing(pose)
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
        """Draw the frame that `pose` and the network's `image` (h * w * 4 bytes or more) describe."""
        self._take(pose, image)
        self._draw(pose)

    def _take(self, pose: NDArray[np.void], image: NDArray[np.uint8]) -> None:
        """Upload what is new in this frame: the background's picture, and the avatars' of a full one."""
        if self._background is not None and self._picture is not None:
            picture = self._background.at(float(pose["media_time_s"]))
            if picture is not None:
                self._shows_background += 1
                self._picture.upload(picture)
                counter_of(self._ctx).least += picture.nbytes
        if int(pose["work"]) == FrameWork.FULL:
            self._held = pose.copy()
            if _visible(pose):
                shape = _tensor_shape(pose)
                self._painter.upload(shape, image[: math.prod(shape) * 4])
                counter_of(self._ctx).least += _cells_bytes(pose)

    def _holds(self, picture: int) -> bool:
        """Whether the picture of the avatars that was uploaded is that of frame `picture`."""
        return self._held is not None and int(self._held["picture"]) == picture

    def _drawing(self, pose: NDArray[np.void]) -> Drawing | None:
        """What the frame's bytes depend on; None when it is like no other."""
        if self._hud is not None:
            return None
        nobody = self._held is None or int(pose["work"]) == FrameWork.NONE
        picture = -1 if self._held is None or nobody else int(self._held["picture"])
        return picture, self._shows_background, pose["view"].tobytes(), pose["projection"].tobytes()

    def _draw(self, pose: NDArray[np.void]) -> None:
        """Draw the frame of `pose` with the picture of the avatars that was uploaded last."""
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
            self._painter.draw(self._target, shape, rect, (top, left, height, width))

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
        """Camera z of the pelvis: the most negative is the farthest."""
        pelvis = avatar["joints"][0] @ np.append(self._rest[int(avatar["avatar"])][0], 1.0)
        return float(pose["view"][2, :3] @ pelvis + pose["view"][2, 3])


def _visible(pose: NDArray[np.void]) -> list[Any]:
    return [avatar for avatar in pose["avatars"][: int(pose["avatar_count"])] if avatar["visible"]]


def _cells_bytes(pose: NDArray[np.void]) -> int:
    """Of the network's picture, in the rectangles of the avatars in view."""
    return sum(4 * int(avatar["tensor_rect"][2]) * int(avatar["tensor_rect"][3]) for avatar in _visible(pose))


def _tensor_shape(pose: NDArray[np.void]) -> Shape:
    return int(pose["tensor_shape"][0]), int(pose["tensor_shape"][1])


def build(settings: Mapping[str, Any], unit: UnitContext) -> CompositeStage:
    """The composite stage of the configuration in `settings`. Raises BadInputError, MissingPartError."""
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
    return CompositeStage(ctx, shape, config.buckets, joints, background, camera.reach(), scene.planes, scene.hud)
