"""A mesh and a fragment shader, drawn with as few skin weights as each triangle needs.

Rule: a triangle whose corners have at most four weights is skinned with four, and so on; positions are the same to the
last bit, for a weight of 0 adds nothing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from trilane.arrays import Floats
from trilane.stages.gpu.camera import target_clip
from trilane.stages.gpu.mesh import BodyPose, Mesh
from trilane.stages.gpu.program import build_program, set_uniforms


class MeshDraw:
    """`mesh` drawn with `fragment`, a file of `trilane.shaders` or a path; `defines` go to both shaders."""

    def __init__(self, ctx: Any, mesh: Mesh, fragment: str | Path, **defines: int | str) -> None:
        self._mesh, self._ctx = mesh, ctx
        self._parts = []
        for weights, indices in mesh.batches:
            program = build_program(ctx, mesh.vertex_shader, fragment, **mesh.defines, **defines, K=weights)
            self._parts.append((program, mesh.vertex_array(program, indices)))

    def set(self, values: dict[str, Any]) -> None:
        """Set uniforms, where the compiler kept them."""
        for program, _ in self._parts:
            set_uniforms(program, values)

    def draw(self, pose: BodyPose, view: Floats, projection: Floats) -> None:
        """Draw into the target in use, with the tests that are enabled."""
        clip = target_clip(view, projection)
        self._mesh.upload_pose(pose)
        for program, vertices in self._parts:
            self._mesh.bind_pose(program)
            program["clip_from_world"].write(clip)
            vertices.render()
