"""What a run would decide for each frame of a scene. Rule: the pose stage of the run decides, and nothing else does;
what its levels of detail move on the picture is measured against the whole body in float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trilane.arrays import F64
from trilane.body.kinematics import Skeleton
from trilane.body.skinning import CpuSkinner
from trilane.pipeline.shared_assets import Assets
from trilane.scene.crop import Rect
from trilane.stages.avatar_assets import distinct, shaped_body, staged_of
from trilane.stages.config import RunConfig, pose_dtype, posed_vertices, posed_vertices_bytes
from trilane.stages.cpu.pose import FramePlan, PoseStage
from trilane.transport.packets import Packet, SlotLayout, view_packet


@dataclass(frozen=True)
class PlannedFrame:
    """`plan`: what the pose stage decided. `crops`: by avatar, the rectangle of the screen that the tensor shows."""

    frame: int
    plan: FramePlan
    crops: dict[int, Rect]


class ScenePlan:
    """The frames of a configuration that was checked, in order."""

    def __init__(self, config: RunConfig, assets: Assets) -> None:
        self.config, self._assets = config, assets
        self.output = (config.scene.output.height, config.scene.output.width)
        self._stage = PoseStage(config, assets)
        self._packet = _packet(config)
        self._stage.bind([], [self._packet])
        self._drawn = posed_vertices(self._packet.payload, config.posed_vertices)
        bodies = [shaped_body(assets, number) for number in range(len(distinct(config)))]
        self._bodies = [bodies[distinct(config).index(folder)] for folder in config.avatar_dirs]
        self._skinners = {id(body): CpuSkinner(body) for body in bodies}
        self._staged = staged_of(assets)

    def decide(self, frame: int) -> PlannedFrame:
        """What the run does with `frame`; frames are to come in order, since one's shape depends on the one before."""
        self._stage.run(frame, None, 0)
        plan = self._stage.plan
        crops = {number: Rect(*self._packet.header["avatars"][number]["rect"].tolist()) for number in plan.seen}
        return PlannedFrame(frame, plan, crops)

    def places(self, frame: int, avatar: int) -> F64:
        """(V,2) pixels of the picture at which the whole body's vertices lie, NaN for those that are not on it."""
        return self._places(self._exact(frame, avatar), frame)

    def measured_px(self, frame: int, avatar: int) -> float:
        """How far what was decided last, for `frame`, moves a vertex of `avatar` that is on the picture."""
        if not self._drawn:
            return 0.0
        exact = self.places(frame, avatar)
        drawn = self._places(self._drawn[avatar].astype(np.float64), frame)
        moved = np.linalg.norm(exact - drawn, axis=1)
        return float(np.nanmax(moved, initial=0.0)) if np.isfinite(moved).any() else 0.0

    def _exact(self, frame: int, avatar: int) -> F64:
        body, mover = self._bodies[avatar], self._staged.movers[avatar]
        pose, translation = mover.sample(frame / self.config.scene.fps)
        posed = Skeleton(body.joints, body.body.parents).pose(pose, translation, mover.world)
        return self._skinners[id(body)].vertices(posed)

    def _places(self, vertices: F64, frame: int) -> F64:
        height, width = self.output
        camera = self._staged.camera
        t_s = frame / self.config.scene.fps
        clip = camera.projection(t_s, self.output) @ camera.sample(t_s)
        points = vertices @ clip[:, :3].T + clip[:, 3]
        seen = (points[:, 3] > 0) & (np.abs(points[:, :3]) <= points[:, 3:]).all(axis=1)
        places = points[:, :2] / np.where(seen, points[:, 3], np.nan)[:, None]
        return np.asarray((places * (1.0, -1.0) + 1.0) / 2.0 * (width, height))


def _packet(config: RunConfig) -> Packet:
    layout = SlotLayout(pose_dtype(len(config.avatar_dirs)), posed_vertices_bytes(config.posed_vertices))
    return view_packet(memoryview(bytearray(layout.slot_bytes)), layout)


def phases(frames: Sequence[PlannedFrame]) -> list[list[PlannedFrame]]:
    """Frames in a row of the same work and tensor shape, which model the same avatars at the same levels of detail."""
    groups: list[list[PlannedFrame]] = []
    for planned in frames:
        if groups and _kind(groups[-1][-1]) == _kind(planned):
            groups[-1].append(planned)
        else:
            groups.append([planned])
    return groups


def _kind(planned: PlannedFrame) -> tuple[object, ...]:
    levels = tuple((number, one.level) for number, one in sorted(planned.plan.seen.items()))
    return planned.plan.work, planned.plan.shape, levels
