"""The body of the plan `full`, in float64: every blend shape, every skin weight, no table of the house's.

Rule: written out as the SMPL-X layout says it, joint by joint, so that it stands beside `body/` as a second way.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trilane.arrays import F64
from trilane.body.body import Body
from trilane.body.joints import JOINTS
from trilane.body.kinematics import rodrigues


class FullBody:
    """`rest` (V,3): the rest shape, metres. `joints` (55,3): its joints."""

    def __init__(self, body: Body, betas: Sequence[float] = (), expression: Sequence[float] = ()) -> None:
        """`body` in the shape `betas` with the `expression`; missing coefficients are 0."""
        self._body = body
        self._weights = body.weights.astype(np.float64)
        self.rest = body.v_template.astype(np.float64)
        for directions, values in ((body.shape_dirs, betas), (body.expression_dirs, expression)):
            self.rest = self.rest + directions[:, :, : len(values)].astype(np.float64) @ np.array(values, np.float64)
        self.joints = body.j_regressor.astype(np.float64) @ self.rest
        if body.offsets is not None:
            self.rest = self.rest + body.offsets

    def vertices(self, pose: F64, translation: F64, world: F64) -> F64:
        """(V,3) metres, in the world.

        `pose`: (55,3) axis-angle, radians.
        `translation`: (3,) of the root in body space, metres.
        `world`: (4,4) from body space to the world.
        """
        turns = rodrigues(np.asarray(pose, np.float64).reshape(JOINTS, 3))
        rest = self.rest
        if self._body.posedirs is not None:
            rest = rest + self._body.posedirs.astype(np.float64) @ (turns[1:] - np.eye(3)).reshape(-1)
        placed = self._placed(turns, np.asarray(translation, np.float64), np.asarray(world, np.float64))
        moved = np.einsum("vj,jab->vab", self._weights, placed)
        return np.asarray(np.einsum("vab,vb->va", moved[:, :, :3], rest) + moved[:, :, 3])

    def _placed(self, turns: F64, translation: F64, world: F64) -> F64:
        """(55,3,4): from the rest shape to the world, for what each joint moves."""
        placed: dict[int, F64] = {}

        def place(joint: int) -> F64:
            """(4,4) of `joint`: its parent's, then a shift to the joint, the turn, and a shift back."""
            if joint not in placed:
                parent = int(self._body.parents[joint])
                above = world @ _shift(translation) if parent < 0 else place(parent)
                turn = np.eye(4)
                turn[:3, :3] = turns[joint]
                at = self.joints[joint]
                placed[joint] = above @ _shift(at) @ turn @ _shift(-at)
            return placed[joint]

        return np.stack([place(joint)[:3] for joint in range(JOINTS)])


def _shift(by: F64) -> F64:
    matrix = np.eye(4)
    matrix[:3, 3] = by
    return matrix
