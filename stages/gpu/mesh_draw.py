"""Draws a mesh with a fragment shader, each triangle with as few skin weights as its corners need.

Rule: a triangle whose corners have at most four weights is skinned with four, and so on; positions are the same to the
last bit, because a weight of 0 adds nothing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from trilane.arrays import Floats
from trilane.stages.gpu.camera_matrices import target_clip
from trilane.stages.gpu.shader_program import build_program, set_uniforms
from trilane.stages.gpu.skinned_mesh import BodyPose, Mesh
from trilane.stages.gpu.transfers import upload


class MeshDraw:
    """A mesh, drawn with one fragment shader."""

    def __init__(self, ctx: Any, mesh: Mesh, fragment: str | Path, **defines: int | str) -> None:
        """Build a program for each number of skin weights.

        `ctx`: the OpenGL context.
        `mesh`: what to draw.
        `fragment`: a file of `trilane.shaders`, or a path.
        `defines`: preprocessor definitions of both shaders.
        Raises TrilaneError when a shader does not compile.
        """
        self._mesh, self._ctx = mesh, ctx
        self._parts = []
        for weights, indices in mesh.batches:
            program = build_program(ctx, mesh.vertex_shader, fragment, **mesh.defines, **defines, K=weights)
            self._parts.append((program, mesh.vertex_array(program, indices)))

    def set(self, values: dict[str, Any]) -> None:
        """Set the uniforms of `values`; those that the shader's compiler removed are skipped."""
        for program, _ in self._parts:
            set_uniforms(program, values)

    def draw(self, pose: BodyPose, view: Floats, projection: Floats) -> None:
        """Draw into the target in use, with the depth test and culling that are enabled."""
        clip = target_clip(view, projection)
        self._mesh.upload_pose(pose)
        for program, vertices in self._parts:
            self._mesh.bind_pose(program)
            upload(self._ctx, program["clip_from_world"], clip)
            vertices.render()
