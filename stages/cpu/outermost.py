"""Which vertices of a skinned body may be outermost on the screen. Rule: float32 finds them, float64 decides.

All vertices are projected in float32, in memory that is allocated once; those whose place on the screen comes within
twice the rounding error of the furthest are handed on. So the furthest of them in float64 is the furthest of all.

Rounding. With u = 2**-24, a clip coordinate c = r . v + d is a sum of three products of rounded factors and d, so it is
off by at most 6 u (sum |r_k| |v_k| + |d|), and 8 u of that, the sphere's reach added, holds what the reach and its
rounding add: call it e_c. A quotient q = c / w, with w >= w_least, is off by at most
(e_c + |q| e_w) / w_least + 4 u |q|, where |q| is at most 1 for what is on the screen.
"""

from __future__ import annotations

import numpy as np

from trilane.arrays import F32, F64, I64

#: Half the distance from 1 to the next float32: a rounding is off by this share at most.
U = 2.0**-24
W_LEAST = 1e-9


class Outermost:
    """For bodies of `count` vertices."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._flat = np.empty((4, count), np.float32)
        self._scratch = np.empty((3, count), np.float32)
        self._is_far = np.empty(count, np.bool_)

    def of(self, vertices: F32, camera: F64, radius: float) -> I64 | None:
        """Numbers of the vertices (N,) that may be outermost of spheres of `radius` metres about `vertices` (V,3).

        `camera`: (4,4) to clip space. None when a sphere may reach over the screen's edge or a clip plane.
        """
        reach = radius * np.linalg.norm(camera[:, :3], axis=1)
        error = self._project(vertices, camera, reach)
        x, y, z, w = self._flat
        near, far = (radius * float(np.linalg.norm(camera[3, :3] + sign * camera[2, :3])) for sign in (1, -1))
        scratch, least, most = self._scratch
        if not np.add(w, z, out=scratch).min() > near + error[2] + error[3]:
            return None
        if not np.subtract(w, z, out=scratch).min() > far + error[2] + error[3]:
            return None
        w_least = float(np.subtract(w, np.float32(reach[3]), out=least).min()) - error[3]
        if not w_least > W_LEAST:
            return None
        np.reciprocal(least, out=least)
        np.reciprocal(np.add(w, np.float32(reach[3]), out=most), out=most)
        slack = 2 * ((error + error[3]) / w_least + 4 * U)
        sides = [self._side(row, reach[k], sign, float(slack[k])) for k, row in enumerate((x, y)) for sign in (1, -1)]
        found = [side for side in sides if side is not None]
        return np.concatenate(found) if len(found) == len(sides) else None

    def _project(self, vertices: F32, camera: F64, reach: F64) -> F64:
        """Write the clip coordinates; by how much each of the four may be off."""
        np.matmul(camera[:, :3].astype(np.float32), vertices.T, out=self._flat)
        self._flat += camera[:, 3:].astype(np.float32)
        furthest = max(float(vertices.max()), -float(vertices.min()))
        return np.asarray(8 * U * (np.abs(camera[:, :3]).sum(axis=1) * furthest + np.abs(camera[:, 3]) + reach))

    def _side(self, row: F32, reach: float, sign: int, slack: float) -> I64 | None:
        """The vertices that may be lowest along `row` of clip coordinates (`sign` 1) or highest (-1)."""
        scratch, least, most = self._scratch
        place = np.subtract(row, np.float32(reach), out=scratch) if sign > 0 else np.negative(row, out=scratch)
        if sign < 0:
            place -= np.float32(reach)
        place *= least if place.min() <= 0 else most
        lowest = float(place.min())
        if not lowest > slack - 1.0:
            return None
        return np.flatnonzero(np.less_equal(place, np.float32(lowest + slack + U), out=self._is_far))
