"""Draws detected planes as a phone's tracking shows them: faint rectangles with a grid, over the background.

Rule: the planes are those of the scene file; nothing is detected here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import moderngl
import numpy as np

from trilane.arrays import F32, Floats
from trilane.scene.schema import PlaneSpec
from trilane.stages.gpu import opengl_calls
from trilane.stages.gpu.camera_matrices import target_clip
from trilane.stages.gpu.shader_program import build_program
from trilane.stages.gpu.transfers import upload

UPRIGHT = 0.9  # sides of a plane whose unit normal has |y| above this are aligned with the world's x, others with its y


class PlanePainter:
    """Draws `planes` (at least one) into the target in use."""

    def __init__(self, ctx: Any, planes: Sequence[PlaneSpec]) -> None:
        self._ctx, self._count = ctx, len(planes)
        self._program = build_program(ctx, "plane.vert", "plane.frag", PLANES=len(planes))
        self._sheets = ctx.vertex_array(self._program, [])
        sides = [half_sides(plane) for plane in planes]
        self._program["centre"].write(np.array([plane.centre for plane in planes], np.float32))
        self._program["across"].write(np.array([across for across, _ in sides], np.float32))
        self._program["along"].write(np.array([along for _, along in sides], np.float32))

    def draw(self, view: Floats, projection: Floats) -> None:
        """Blend the planes over the target, as seen by `view` and `projection`."""
        self._ctx.enable_only(moderngl.BLEND)
        self._ctx.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        upload(self._ctx, self._program["clip_from_world"], target_clip(view, projection))
        with opengl_calls.srgb_target():
            self._sheets.render(vertices=6 * self._count)


def half_sides(plane: PlaneSpec) -> tuple[F32, F32]:
    """Half of each side of `plane` as a vector (3,), metres: at right angles to each other and to the normal."""
    normal = np.asarray(plane.normal, np.float64) / np.linalg.norm(plane.normal)
    towards = np.array([1.0, 0.0, 0.0]) if abs(normal[1]) > UPRIGHT else np.array([0.0, 1.0, 0.0])
    along = np.cross(normal, towards)
    along /= np.linalg.norm(along)
    across = np.cross(along, normal)
    turn = np.radians(plane.turn_deg)
    across, along = np.cos(turn) * across + np.sin(turn) * along, np.cos(turn) * along - np.sin(turn) * across
    return (plane.width_m / 2 * across).astype(np.float32), (plane.depth_m / 2 * along).astype(np.float32)
