"""The avatars in a frame and their places, for pictures of a scene that are made without the stages.

Rule: motion, camera and media time are the pose stage's, so a picture shows the same moment as the run's frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trilane.arrays import F32, F64, Shape
from trilane.avatars.bundle import CLOTHES_STANDOFF_M, load_bundle
from trilane.bench.lib.layers import Box, box_around
from trilane.body.joints import Skeleton
from trilane.scene.crop import crop_projection
from trilane.scene.mover import Mover
from trilane.stages.avatar_assets import AvatarData, load_avatar, staged_of
from trilane.stages.configure import Checked
from trilane.stages.cpu.mesh_bounds import MeshBounds


@dataclass(frozen=True)
class CastView:
    """One avatar in one frame.

    `index`: number of the avatar in the scene. `folder`: folder of its bundle. `pose` (55,3), `translation` (3,),
    `world` (4,4): as in `Mover.sample` and `Mover`. `joints` (55,3,4): skinning matrices, as the pose stage computes
    them. `box`: pixels of the picture that hold it, clothes included. `depth`: camera z of the pelvis. `view` (4,4):
    view matrix. `projection` (4,4): projection of the box.
    """

    index: int
    folder: Path
    pose: F64
    translation: F64
    world: F64
    joints: F32
    box: Box
    depth: float
    view: F64
    projection: F64


@dataclass(frozen=True)
class _Actor:
    index: int
    folder: Path
    mover: Mover
    data: AvatarData
    skeleton: Skeleton
    bounds: MeshBounds


class Cast:
    """The avatars and the camera of a scene.

    `avatars`: each distinct avatar, by the folder of its bundle.
    """

    def __init__(self, checked: Checked) -> None:
        """Load the avatars. Raises BadInputError."""
        scene, folders = checked.config.scene, checked.config.avatar_dirs
        self._fps = scene.fps
        self._output: Shape = (scene.output.height, scene.output.width)
        staged = staged_of(checked.assets)
        self._camera = staged.camera
        self.avatars = {folder: load_avatar(load_bundle(folder)) for folder in dict.fromkeys(folders)}
        bounds = {
            folder: MeshBounds(data.shaped, standoff_m=CLOTHES_STANDOFF_M) for folder, data in self.avatars.items()
        }
        self._actors = [
            _Actor(index, folder, mover, data := self.avatars[folder], _skeleton(data), bounds[folder])
            for index, (folder, mover) in enumerate(zip(folders, staged.movers, strict=True))
        ]

    def seen(self, frame: int) -> list[CastView]:
        """Return the avatars that are on the screen in frame number `frame`."""
        t_s = frame / self._fps
        view, whole = self._camera.sample(t_s), self.projection(frame)
        found = (self._seen(actor, t_s, view, whole) for actor in self._actors)
        return [seen for seen in found if seen is not None]

    def boxes(self, frame: int) -> list[Box]:
        """Return the parts of the picture that hold avatars in frame number `frame`."""
        return [seen.box.on(self._output) for seen in self.seen(frame)]

    def projection(self, frame: int) -> F64:
        """Return the projection (4,4) of the whole picture in frame number `frame`."""
        return self._camera.projection(frame / self._fps, self._output)

    def _seen(self, actor: _Actor, t_s: float, view: F64, whole: F64) -> CastView | None:
        pose, translation = actor.mover.sample(t_s)
        world = actor.mover.world
        posed = actor.skeleton.pose(pose, translation, world)
        rect = actor.bounds.rect(posed, whole @ view)
        if rect is None:
            return None
        box = box_around(rect, self._output)
        pelvis = world @ np.append(actor.data.shaped.joints[0] + translation, 1.0)
        projection = crop_projection(whole, box.rect(self._output))
        depth = float(view[2] @ pelvis)
        joints = posed.matrices.copy()
        return CastView(actor.index, actor.folder, pose, translation, world, joints, box, depth, view, projection)


def _skeleton(data: AvatarData) -> Skeleton:
    return Skeleton(data.shaped.joints, data.shaped.body.parents)
