"""The body of a capture as the pipeline rasterises it: UV images of its fits.

Rule: the pipeline's mesh, skinning and raster; a body that has pose blend shapes is drawn with them.
"""

from __future__ import annotations

from trilane.arrays import F32, F64
from trilane.body.body import ShapedBody
from trilane.body.kinematics import Posed, Skeleton
from trilane.shapes import Shape
from trilane.stages.gpu.opengl import open_context
from trilane.stages.gpu.skinned_mesh import BodyPose, SkinnedMesh, avatar_mesh
from trilane.training.capture.capture import Capture
from trilane.training.capture.fits import Fit
from trilane.training.uv_image import UvRaster


class BodyRaster:
    """Draws one shaped body, with an OpenGL context of its own."""

    def __init__(self, shaped: ShapedBody, threads: int | None = None) -> None:
        """Open the context. `threads`: of a software OpenGL driver. Raises MissingPartError without OpenGL."""
        self.ctx = open_context(threads)
        self._blended = shaped.body.posedirs is not None
        self.mesh = SkinnedMesh(self.ctx, avatar_mesh(shaped), shaped.body.posedirs)
        self._raster = UvRaster(self.ctx, self.mesh)
        self.skeleton = Skeleton(shaped.joints, shaped.body.parents)

    def posed(self, fit: Fit) -> Posed:
        """The body of `fit`; valid until the next call."""
        return self.skeleton.pose(fit.pose, fit.place)

    def body_pose(self, fit: Fit) -> BodyPose:
        """The same as the mesh takes it; valid until the next call."""
        posed = self.posed(fit)
        return BodyPose(posed.matrices, posed.feature if self._blended else None)

    def uv(self, fit: Fit, view: F64, projection: F64, shape: Shape) -> F32:
        """The UV image (h,w,3) of `fit`: u, v, coverage. `view`, `projection` (4,4); `shape` (height, width)."""
        pose = self.body_pose(fit)
        return self._raster.render(pose.joints, view, projection, shape, pose.feature)

    def uv_of(self, capture: Capture, number: int) -> F32:
        """The UV image of frame `number` of `capture`, as large as the frame."""
        return self.uv(capture.fits[number], capture.views[number], capture.file.camera.projection(), capture.shape)
