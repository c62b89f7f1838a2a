"""The pose stage: from a frame's number to everything that the other stages have to know about it.

Rule: motion and camera are asked for the frame's media time, frame / fps; nothing that is not finite leaves here. A
frame that shows what an earlier one showed, or nobody, is told so, skins nothing and skips the stages that would draw.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.avatars.bundle import CLOTHES_STANDOFF_M
from trilane.body.kinematics import Posed, Skeleton
from trilane.body.skinning import FrameSkinner
from trilane.errors import TrilaneError
from trilane.pipeline.shared_assets import Assets
from trilane.pipeline.stage import Skip, UnitContext
from trilane.scene.mover import Mover
from trilane.scene.work import Work, shown_by, work_of
from trilane.stages.avatar_assets import distinct, shaped_body, staged_of
from trilane.stages.config import RunConfig
from trilane.stages.cpu.crop import Rect
from trilane.stages.cpu.mesh_bounds import MeshBounds
from trilane.stages.cpu.tensor_layout import lay_out
from trilane.stages.packets import posed_vertices
from trilane.transport.packets import FRAME_FIELDS, Packet


@dataclass(frozen=True)
class _Actor:
    mover: Mover
    skeleton: Skeleton
    bounds: MeshBounds
    skinner: FrameSkinner | None


@dataclass(frozen=True)
class _Made:
    """What a frame showed, and its header."""

    shown: bytes
    header: NDArray[np.void]


#: Fields of the header in which frames that show the same differ.
OF_THE_FRAME = {*(name for name, _ in FRAME_FIELDS), "media_time_s", "work"}


class PoseStage:
    """Stage `pose` of the CPU unit: no input edge, an output edge of headers."""

    def __init__(self, config: RunConfig, assets: Assets) -> None:
        """The scene of `config`, whose avatars, motions and camera lie in `assets`."""
        scene = config.scene
        self._fps = scene.fps
        self._output = (scene.output.height, scene.output.width)
        self._buckets = config.buckets
        folders = distinct(config)
        bodies = {folder: shaped_body(assets, number) for number, folder in enumerate(folders)}
        bounds = {folder: MeshBounds(body, standoff_m=CLOTHES_STANDOFF_M) for folder, body in bodies.items()}
        staged = staged_of(assets)
        self._actors = [
            _Actor(
                mover,
                Skeleton(bodies[folder].joints, bodies[folder].body.parents),
                bounds[folder],
                FrameSkinner(bodies[folder]) if config.posed_vertices else None,
            )
            for folder, mover in zip(config.avatar_dirs, staged.movers, strict=True)
        ]
        self._camera = staged.camera
        self._projection = staged.camera.projection(scene.output.width / scene.output.height)
        self._counts = config.posed_vertices
        self._made: dict[Work, _Made] = {}
        self._was_seen = [False] * len(self._actors)
        self._slots: list[NDArray[np.void]] = []
        self._vertices: list[list[NDArray[np.float32]]] = []

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Take the output slots. Raises ValueError when the stage has inputs."""
        if inputs:
            raise ValueError("the pose stage has no input edge")
        self._slots = [packet.header for packet in outputs]
        self._vertices = [posed_vertices(packet.payload, self._counts) for packet in outputs]

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:  # noqa: ARG002
        """Fill `outputs[slot_out]` for `frame`; the figure is how many avatars are visible. A `Skip` but for full work.

        Raises ValueError without `slot_out`, TrilaneError when a number of the frame is not finite.
        """
        if slot_out is None:
            raise ValueError("the pose stage needs an output slot")
        packet = self._slots[slot_out]
        t_s = frame / self._fps
        packet["frame"] = frame
        packet["t_sampled_ns"] = time.monotonic_ns()
        packet["media_time_s"] = t_s
        view = self._camera.sample(t_s)
        moved = [actor.mover.sample(t_s) for actor in self._actors]
        _require_all_finite(view, moved, frame)
        shown = shown_by([view, *(array for pair in moved for array in pair)])
        work = work_of(
            shown,
            self._shown_by(Work.FULL),
            self._shown_by(Work.NONE),
            lambda: self._make(slot_out, frame, view, moved),
        )
        packet["work"] = work
        known = self._made.get(Work.FULL if work is Work.REUSE else work)
        if known is not None and known.shown == shown:
            _copy_same(known.header, packet)
        else:
            packet["picture"] = frame if work is Work.FULL else -1
            self._made[work] = _Made(shown, packet.copy())
        visible = float(sum(packet["avatars"]["visible"]))
        return {"visible": visible} if work is Work.FULL else Skip(visible=visible)

    def forget(self) -> None:
        """The next frame in which anybody is seen is a full one."""
        self._made.pop(Work.FULL, None)

    def _shown_by(self, work: Work) -> bytes | None:
        return self._made[work].shown if work in self._made else None

    def _make(self, slot_out: int, frame: int, view: F64, moved: Sequence[tuple[F64, F64]]) -> bool:
        """Fill what the header of slot `slot_out` says of camera and avatars; whether an avatar is visible.

        `view` (4,4), and `moved`, each avatar's pose and place, are those of `frame`.
        """
        packet = self._slots[slot_out]
        packet["avatar_count"] = len(self._actors)
        packet["view"], packet["projection"] = view, self._projection
        clip = self._projection @ view
        vertices: Sequence[NDArray[np.float32] | None] = self._vertices[slot_out] or [None] * len(self._actors)
        seen: list[tuple[NDArray[np.void], Rect]] = []
        for index, actor in enumerate(self._actors):
            avatar = packet["avatars"][index]
            rect = _pose(actor, avatar, vertices[index], index, moved[index], frame, clip, self._was_seen[index])
            self._was_seen[index] = rect is not None
            if rect is not None:
                seen.append((avatar, rect))
        self._lay_out(packet, seen)
        return bool(seen)

    def _lay_out(self, packet: NDArray[np.void], seen: list[tuple[NDArray[np.void], Rect]]) -> None:
        """Crop rectangles, cells and the tensor's shape; the smallest shape when nothing is to be drawn."""
        if not seen:
            packet["tensor_shape"] = min(self._buckets, key=lambda shape: shape[0] * shape[1])
            return
        layout = lay_out([rect for _, rect in seen], self._output, self._buckets)
        packet["tensor_shape"] = layout.shape
        for (avatar, _), (crop, cell) in zip(seen, layout.crops, strict=True):
            avatar["rect"], avatar["tensor_rect"] = crop, cell

    def close(self) -> None:
        """Let go of the slots."""
        self._slots, self._vertices = [], []


def build(settings: Mapping[str, Any], unit: UnitContext) -> PoseStage:
    """The pose stage of the configuration in `settings`."""
    return PoseStage(RunConfig.model_validate(settings["config"]), unit.assets)


def _pose(
    actor: _Actor,
    avatar: NDArray[np.void],
    vertices: NDArray[np.float32] | None,
    index: int,
    moved: tuple[F64, F64],
    frame: int,
    clip: F64,
    was_seen: bool,
) -> Rect | None:
    """Fill one avatar's joints, and `vertices` if given; its rectangle on the screen, None when nothing is visible.

    `was_seen`: in the last frame that was made; if not, it is looked for by its patches before it is skinned.
    """
    pose, translation = moved
    posed: Posed = actor.skeleton.pose(pose, translation, actor.mover.world)
    _require_finite(posed.matrices, frame, f"joints of avatar {index}")
    rect = None
    if was_seen or actor.bounds.may_be_seen(posed, clip):
        if actor.skinner is not None and vertices is not None:
            actor.skinner.skin_into(posed, vertices)
        rect = actor.bounds.rect(posed, clip, vertices)
    avatar["avatar"], avatar["visible"] = index, rect is not None
    avatar["joints"], avatar["pose_feature"] = posed.matrices, posed.feature
    return rect


def _copy_same(source: NDArray[np.void], target: NDArray[np.void]) -> None:
    """All of a header but what belongs to its frame alone."""
    for name in source.dtype.names or ():
        if name not in OF_THE_FRAME:
            target[name] = source[name]


def _require_all_finite(view: F64, moved: Sequence[tuple[F64, F64]], frame: int) -> None:
    _require_finite(view, frame, "camera")
    for index, (pose, translation) in enumerate(moved):
        _require_finite(pose, frame, f"pose of avatar {index}")
        _require_finite(translation, frame, f"place of avatar {index}")


def _require_finite(values: NDArray[np.floating], frame: int, what: str) -> None:
    if not np.isfinite(values).all():
        raise TrilaneError(f"frame {frame}: the {what} is not finite")
