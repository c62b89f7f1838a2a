"""Levels of a body's mesh: fewer triangles between some of its vertices, and how far each level moves the surface.

A level keeps vertices as they are, so it is a list of triangles. **Where it moves the surface to** is said texel by
texel: the point of the whole mesh that shows a texel, and the point of the level that shows the same one. So the bound
holds for the outline and for what is painted inside of it.

Proof of the bound. A posed point of either mesh is a sum of b_v x_v over the corners of its triangle, with x_v = sum_j
w_vj G_j v and G_j the rigid motion of joint j. Let e_v be the level's b_v minus the whole mesh's; the e_v sum to 0, and
d = sum e_v v is the distance at rest. Seen from a joint k, G_j is G_k and the steps along the bones between the two.
Each step is a turn by an angle t_b about the centre c_b of a joint b. Let y_b = sum e_v W_vb (v - c_b), with W_vb the
sum of w_vj over b and the joints below it. The step of b moves y_b, or d - y_b where k is b or below it. So the
distance is at most

    |d| + sum_b 2 sin(t_b / 2) |y_b or d - y_b|

for any k. Between the places where the edges of the two meshes cross, both points are linear in the texel. So the
distance is largest where edges cross, or at a vertex that the level leaves out. `training/mesh_levels.py` evaluates the
terms there. Pose blend shapes move a vertex by at most r_v = sum_b r_vb |R_b - I|, which adds sum |e_v| r_v.

Rows of terms are taken in groups, with the largest of each term in the group.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from trilane.arrays import F32, F64, I32
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINTS
from trilane.body.kinematics import Posed

#: Error that float32 may add, metres: the rounding of weights, of skinned vertices and of the stored terms.
ROUNDING_M = 5e-6
TURNS = JOINTS - 1
#: About so many rows of terms bound a level.
MOST_ROWS = 2048


@dataclass(frozen=True)
class MeshLevel:
    """A level of a mesh.

    `faces`, `uv_faces` (F,3): triangles, as indices of the whole body's vertices and texture coordinates.
    `rest` (G,), `swing` (G,54), `blend` (G,54): terms of the bound, metres: |d|, the factors of 2 sin(t_b / 2), and
    those of |R_b - I|.
    `uv_error`: distance between the texels at the seams of the level and of the whole mesh, in sides of the texture.
    """

    faces: I32
    uv_faces: I32
    rest: F32
    swing: F32
    blend: F32
    uv_error: float

    def metres(self, posed: Posed) -> float:
        """Return the furthest, in metres, that the level moves a point of the surface in a frame of `Skeleton.pose`."""
        turned = np.linalg.norm(posed.feature.reshape(TURNS, 9), axis=1)
        moved = self.rest + self.swing @ (turned / np.float32(np.sqrt(2.0)))
        if self.has_blend:
            moved = moved + self.blend @ turned
        return float(moved.max()) + ROUNDING_M

    @cached_property
    def has_blend(self) -> bool:
        """Whether pose blend shapes move any vertex."""
        return bool(self.blend.any())

    @cached_property
    def least_m(self) -> float:
        """Least that `metres` returns in any pose: the largest move at rest."""
        return float(self.rest.max())

    def reduced(self, shaped: ShapedBody) -> ShapedBody:
        """Return `shaped` with the triangles of this level and only the vertices that they use, in the same order."""
        used, corners = np.unique(self.faces, return_inverse=True)
        body = shaped.body
        smaller = replace(
            body,
            v_template=body.v_template[used],
            shape_dirs=body.shape_dirs[used],
            expression_dirs=body.expression_dirs[used],
            j_regressor=body.j_regressor[:, used],
            weights=body.weights[used],
            faces=corners.reshape(self.faces.shape).astype(np.int32),
            uv_faces=self.uv_faces,
            posedirs=None if body.posedirs is None else body.posedirs[used],
            offsets=None if body.offsets is None else body.offsets[used],
        )
        return ShapedBody(shaped.vertices[used], shaped.joints, smaller)


def grouped(rest: F64, swing: F64, blend: F64) -> tuple[F32, F32, F32]:
    """Return fewer rows of terms (G,), (G,54), (G,54) that bound all of `rest` (P,), `swing` (P,54), `blend` (P,54).

    Rows that are never the largest, however far the joints turn, are left out. The others are sorted by their two
    largest swings and by their size, and neighbours become one row with the largest of each term.
    """
    most = rest + 2.0 * swing.sum(axis=1) + 2.0 * np.sqrt(2.0) * blend.sum(axis=1)
    matters = most >= rest.max()
    rest, swing, blend, most = rest[matters], swing[matters], blend[matters], most[matters]
    two = np.sort(np.argsort(-swing, axis=1, kind="stable")[:, :2], axis=1)
    key = two[:, 0] * TURNS + two[:, 1]
    order = np.lexsort((most, key))
    begins = np.diff(key[order], prepend=-1) != 0
    begins[:: max(len(rest) // MOST_ROWS, 1)] = True
    starts = np.flatnonzero(begins)
    tops = [np.maximum.reduceat(rows[order], starts, axis=0) for rows in (rest, swing, blend)]
    # Rounded up, so that a term in float32 is never smaller than it was.
    up = [np.nextafter(rows.astype(np.float32), np.float32(np.inf)) for rows in tops]
    return up[0], up[1], up[2]
