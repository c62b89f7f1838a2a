"""The background of a camera that stands still: copied bytes are those that drawing gives."""

from __future__ import annotations

from typing import Any

import numpy as np

from trilane.scene.schema import PlaneSpec
from trilane.stages.config import pose_dtype
from trilane.stages.gpu import opengl
from trilane.stages.gpu.composite import CompositeStage, StillBackground
from trilane.transport.packets import Packet, SlotLayout, view_packet

SHAPE = (18, 26)
SIZE = SHAPE[0] * SHAPE[1] * 3


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


def packet(payload: int) -> Packet:
    layout = SlotLayout(pose_dtype(1), payload)
    return view_packet(memoryview(bytearray(layout.slot_bytes)), layout)


def test_frames_over_a_kept_room_are_those_over_a_drawn_one(gl: Any) -> None:
    """An avatar moves before a camera that stands still for five frames, then goes on: all frames as by a new stage."""
    source = packet(8 * 8 * 4)
    source.payload[:] = np.random.default_rng(0).integers(0, 256, 8 * 8 * 4, dtype=np.uint8)
    pose = source.header
    pose["avatar_count"], pose["tensor_shape"] = 1, (8, 8)
    pose["projection"] = ((1.5, 0, 0, 0), (0, 2, 0, 0), (0, 0, -1.02, -0.2), (0, 0, -1, 0))
    pose["avatars"]["visible"], pose["avatars"]["tensor_rect"] = 1, (0, 0, 8, 8)
    pose["avatars"]["joints"] = np.eye(3, 4)
    rest, planes = [np.full((55, 3), 0.05)], [PlaneSpec(width_m=1.0, depth_m=1.0)]

    def made() -> CompositeStage:
        return CompositeStage(gl, SHAPE, [(8, 8)], rest, None, planes=planes)

    def frame_of(stage: CompositeStage, number: int) -> bytes:
        target = packet(SIZE)
        stage.bind([source], [target])
        stage.run(number, 0, 0)
        return target.payload[:SIZE].tobytes()

    kept, frames = made(), set()
    for number, away in enumerate((2.0, 2.0, 2.0, 2.0, 2.0, 2.2, 2.4)):
        pose["view"] = np.eye(4)
        pose["view"][:3, 3] = 0.1, -1.0, -away
        pose["avatars"]["rect"] = -0.5 + 0.1 * number, -0.5, 0.2 + 0.1 * number, 0.4
        frame = frame_of(kept, number)
        assert frame == frame_of(made(), number)
        frames.add(frame)
    assert len(frames) == 7
