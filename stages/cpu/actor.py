"""One avatar of the scene in the CPU unit: posed, modelled as finely as the picture shows, and bounded on the screen.

Rule: the level of detail is the cheapest whose error on the picture has a bound within the budget; where the GPU unit
skins, or the plan is fixed, everything is modelled.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from trilane.arrays import F32, F64
from trilane.avatars.bundle import CLOTHES_STANDOFF_M
from trilane.body.body import ShapedBody
from trilane.body.detail import DETAILS, DetailBounds
from trilane.body.kinematics import Posed, Skeleton
from trilane.body.skinning import FrameSkinner
from trilane.pipeline.moved_bytes import ByteCounter
from trilane.scene.crop import SCREEN, Rect, cheapest_within, error_px, least_w
from trilane.shapes import Shape
from trilane.stages.cpu.mesh_bounds import MeshBounds
from trilane.stages.last_level_cache import moved_of_kept

FINEST = len(DETAILS) - 1


@dataclass(frozen=True)
class Seen:
    """An avatar on the screen. `level`: of `DETAILS`. `error_px`: the bound on what the level moves on the picture."""

    rect: Rect
    level: int
    error_px: float


class ModelledBody:
    """A body that several avatars of a scene may share, with what each level of detail needs.

    `skins`: whether the CPU unit skins it. `budget_px`: the largest error of a level on the picture; 0: everything is
    modelled.
    """

    def __init__(self, shaped: ShapedBody, skins: bool, budget_px: float) -> None:
        self.shaped = shaped
        self.bounds = MeshBounds(shaped, standoff_m=CLOTHES_STANDOFF_M)
        self.budget_px = budget_px if skins else 0.0
        self.skinners = self._skinners() if skins else []
        self.moved_to_skin = [moved_of_kept(skinner.constant_bytes) for skinner in self.skinners]

    def _skinners(self) -> list[FrameSkinner]:
        """One for each level; only the finest when nothing may be left out."""
        if self.budget_px == 0.0:
            return [FrameSkinner(self.shaped)] * len(DETAILS)
        return [FrameSkinner(self.shaped, detail) for detail in DETAILS]

    @cached_property
    def detail(self) -> DetailBounds:
        return DetailBounds(self.shaped)

    def skeleton(self) -> Skeleton:
        return Skeleton(self.shaped.joints, self.shaped.body.parents)

    def choose(self, posed: Posed, clip: F64, output: Shape) -> tuple[int, float]:
        """The level of detail of a frame, and the bound on its error in pixels of a picture of `output`."""
        if self.budget_px == 0.0:
            return FINEST, 0.0
        w = least_w(posed, clip, self.detail.reach, self.detail.blend_m(posed))
        errors = [error_px(metres, clip, w, output) for metres in self.detail.metres(posed)]
        level = cheapest_within(errors, self.budget_px)
        return level, errors[level]

    def see(self, posed: Posed, clip: F64, output: Shape, vertices: F32 | None, moved: ByteCounter) -> Seen | None:
        """Skin the body into `vertices`, if given, and find its rectangle; None when nothing of it is visible.

        `posed`: the frame. `clip` (4,4): projection @ view. `output`: (height, width) of the picture. `moved`: counts
        the vertices, which are written, then read to find the rectangle, and what skinning reads from memory.
        """
        level, error = self.choose(posed, clip, output)
        if vertices is not None:
            self.skinners[level].skin_into(posed, vertices)
            moved.copied(vertices.nbytes)
            moved.read += self.moved_to_skin[level]
            moved.least += self.moved_to_skin[level] + vertices.nbytes
        rect = self.bounds.rect(posed, clip, vertices)
        return None if rect is None else Seen(widened(rect, error, output), level, error)


def widened(rect: Rect, error_px: float, output: Shape) -> Rect:
    """`rect` with `error_px` pixels more on every side, clipped to the screen."""
    x, y = 2.0 * error_px / output[1], 2.0 * error_px / output[0]
    low = max(rect.x0 - x, SCREEN.x0), max(rect.y0 - y, SCREEN.y0)
    high = min(rect.x1 + x, SCREEN.x1), min(rect.y1 + y, SCREEN.y1)
    return Rect(*low, *high)
