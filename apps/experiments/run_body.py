"""The body of an avatar between the reference's and the run's: each way in which they differ is switched on or off.

Rule: float64 is `FullBody`, written out joint by joint; float32 is the house's own skinning. With everything on, the
CPU unit's vertices come out to the bit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trilane.apps.experiments.causes import Cause, Causes
from trilane.arrays import F32, F64
from trilane.bench.lib.cast import Seen
from trilane.bench.lib.full_body import FullBody
from trilane.body.body import Body
from trilane.body.joints import JOINTS, POSE_FEATURES
from trilane.body.kinematics import Posed, Skeleton
from trilane.body.skinning import DETAILS, EVERYTHING, Detail, FrameSkinner
from trilane.stages.avatar_assets import AvatarData
from trilane.stages.gpu.skinned_mesh import enough_weights


class RunBody:
    """One distinct avatar. `on_cpu`: whether the CPU unit skins it, else the GPU unit does."""

    def __init__(self, data: AvatarData, *, on_cpu: bool) -> None:
        self._data, self._on_cpu = data, on_cpu
        self._skeleton = Skeleton(data.shaped.joints, data.shaped.body.parents)
        self._full: dict[Detail, FullBody] = {}
        self._skinners: dict[Detail, FrameSkinner] = {}

    def vertices(self, seen: Seen, level: int | None, causes: Causes) -> F64:
        """(V,3) metres, in the world.

        `seen`: the avatar in a frame. `level`: of `DETAILS`, by the run's plan; None where the run does not show it.
        `causes`: those of them that are of the body count.
        """
        detail = self._detail(level, causes)
        if Cause.FLOAT32 not in causes:
            return self._full_body(detail).vertices(seen.pose, seen.translation, seen.world)
        posed = self._skeleton.pose(seen.pose, seen.translation, seen.world)
        return (self._by_cpu(detail, posed) if self._on_cpu else self._by_gpu(detail, posed)).astype(np.float64)

    def _detail(self, level: int | None, causes: Causes) -> Detail:
        """What is modelled: of the run's detail only what `causes` say."""
        run = EVERYTHING
        if self._on_cpu:
            run = EVERYTHING if level is None else DETAILS[level]
        elif level is not None:
            run = Detail("the GPU unit's", enough_weights(self._body), hands_and_face=True, pose_blend=False)
        weights = run if Cause.WEIGHTS in causes else EVERYTHING
        blend = run.pose_blend if Cause.BLEND in causes else True
        return Detail("mixed", weights.weight_count, weights.hands_and_face, blend)

    @property
    def _body(self) -> Body:
        return self._data.shaped.body

    def _full_body(self, detail: Detail) -> FullBody:
        if detail not in self._full:
            manifest = self._data.bundle.manifest
            body = replace(self._body, weights=detail.weights(self._data.shaped), posedirs=self._blend(detail))
            self._full[detail] = FullBody(body, manifest.betas, manifest.expression)
        return self._full[detail]

    def _blend(self, detail: Detail) -> F32 | None:
        """Pose blend shapes. The GPU unit never leaves them out, but has them in float16."""
        if detail.pose_blend or self._body.posedirs is None:
            return self._body.posedirs
        return None if self._on_cpu else self._body.posedirs.astype(np.float16).astype(np.float32)

    def _by_cpu(self, detail: Detail, posed: Posed) -> F32:
        if detail not in self._skinners:
            self._skinners[detail] = FrameSkinner(self._data.shaped, detail)
        vertices = np.empty_like(self._data.shaped.vertices, np.float32)
        self._skinners[detail].skin_into(posed, vertices)
        return vertices

    def _by_gpu(self, detail: Detail, posed: Posed) -> F32:
        """The vertex shader's formula, rounded to float32 after each step."""
        rest, blend = self._data.shaped.vertices.astype(np.float32), self._blend(detail)
        if blend is not None:
            rest = rest + (blend.reshape(-1, POSE_FEATURES) @ posed.feature).reshape(-1, 3)
        moved = (detail.weights(self._data.shaped) @ posed.matrices.reshape(JOINTS, 12)).reshape(-1, 3, 4)
        return np.asarray(np.einsum("vab,vb->va", moved[:, :, :3], rest) + moved[:, :, 3], np.float32)
