"""The pose stage: from a frame's number to everything that the other stages have to know about it.

Rule: motion and camera are asked for the frame's media time, frame / fps; nothing that is not finite leaves here.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.body.kinematics import Posed, Skeleton
from trilane.errors import TrilaneError
from trilane.pipeline.shared_assets import Assets
from trilane.pipeline.stage import UnitContext
from trilane.scene.mover import Mover
from trilane.scene.planner import Held, plan_tensor
from trilane.scene.tensor_layout import lay_out
from trilane.shapes import Shape
from trilane.stages.avatar_assets import distinct, shaped_body, staged_of
from trilane.stages.config import RunConfig
from trilane.stages.cpu.actor import ModelledBody, Seen
from trilane.stages.packets import posed_vertices
from trilane.transport.packets import Packet


@dataclass(frozen=True)
class _Actor:
    index: int
    mover: Mover
    skeleton: Skeleton
    body: ModelledBody


@dataclass(frozen=True)
class FramePlan:
    """What was decided for a frame: the tensor's shape, None with nobody in view; each visible avatar by its number."""

    shape: Shape | None
    density: float | None
    seen: Mapping[int, Seen]


class PoseStage:
    """Stage `pose` of the CPU unit: no input edge, an output edge of headers. `plan`: of the frame that it did last."""

    def __init__(self, config: RunConfig, assets: Assets) -> None:
        """The scene of `config`, whose avatars, motions and camera lie in `assets`."""
        scene = config.scene
        self._fps = scene.fps
        self._output = (scene.output.height, scene.output.width)
        self._buckets, self._plans_tensor = config.buckets, scene.plans_tensor
        self._held: Held | None = None
        self.plan = FramePlan(None, None, {})
        folders = distinct(config)
        bodies = {
            folder: ModelledBody(shaped_body(assets, number), bool(config.posed_vertices), config.budget_px)
            for number, folder in enumerate(folders)
        }
        staged = staged_of(assets)
        self._actors = [
            _Actor(index, mover, bodies[folder].skeleton(), bodies[folder])
            for index, (folder, mover) in enumerate(zip(config.avatar_dirs, staged.movers, strict=True))
        ]
        self._camera = staged.camera
        self._projection = staged.camera.projection(scene.output.width / scene.output.height)
        self._counts = config.posed_vertices
        self._slots: list[NDArray[np.void]] = []
        self._vertices: list[list[NDArray[np.float32]]] = []

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Take the output slots. Raises ValueError when the stage has inputs."""
        if inputs:
            raise ValueError("the pose stage has no input edge")
        self._slots = [packet.header for packet in outputs]
        self._vertices = [posed_vertices(packet.payload, self._counts) for packet in outputs]

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:  # noqa: ARG002
        """Fill `outputs[slot_out]` for `frame`.

        Metrics: `visible`, how many avatars are; of a frame with any, `level` of `body.detail.DETAILS` and `error_px`,
        the bound on what it moves on the picture, both of the worst avatar; `density` of a planned tensor.

        Raises ValueError without `slot_out`, TrilaneError when a number of the frame is not finite.
        """
        if slot_out is None:
            raise ValueError("the pose stage needs an output slot")
        packet = self._slots[slot_out]
        t_s = frame / self._fps
        packet["frame"] = frame
        packet["t_sampled_ns"] = time.monotonic_ns()
        packet["media_time_s"] = t_s
        packet["avatar_count"] = len(self._actors)
        view = self._camera.sample(t_s)
        packet["view"], packet["projection"] = view, self._projection
        _require_finite(view, frame, "camera")
        clip = self._projection @ view
        vertices: Sequence[NDArray[np.float32] | None] = self._vertices[slot_out] or [None] * len(self._actors)
        seen = [
            (avatar, one)
            for actor, place in zip(self._actors, vertices, strict=True)
            if (one := self._pose(actor, avatar := packet["avatars"][actor.index], place, t_s, frame, clip)) is not None
        ]
        self.plan = self._lay_out(packet, seen)
        return _metrics(self.plan)

    def _lay_out(self, packet: NDArray[np.void], seen: list[tuple[NDArray[np.void], Seen]]) -> FramePlan:
        """Crop rectangles, cells and the tensor's shape; the smallest shape when nothing is to be drawn."""
        if not seen:
            packet["tensor_shape"] = min(self._buckets, key=lambda shape: shape[0] * shape[1])
            return FramePlan(None, None, {})
        rects, density = [one.rect for _, one in seen], None
        if self._plans_tensor:
            plan = plan_tensor(rects, self._output, self._buckets, self._held)
            layout, density, self._held = plan.dense.layout, plan.dense.density, plan.held
        else:
            layout = lay_out(rects, self._output, self._buckets)
        packet["tensor_shape"] = layout.shape
        for (avatar, _), (crop, cell) in zip(seen, layout.crops, strict=True):
            avatar["rect"], avatar["tensor_rect"] = crop, cell
        return FramePlan(layout.shape, density, {int(avatar["avatar"]): one for avatar, one in seen})

    def _pose(
        self,
        actor: _Actor,
        avatar: NDArray[np.void],
        vertices: NDArray[np.float32] | None,
        t_s: float,
        frame: int,
        clip: NDArray[np.float64],
    ) -> Seen | None:
        """Fill one avatar's joints, and `vertices` if given; where it is on the screen, None when it is not visible."""
        index = actor.index
        pose, translation = actor.mover.sample(t_s)
        _require_finite(pose, frame, f"pose of avatar {index}")
        _require_finite(translation, frame, f"place of avatar {index}")
        posed: Posed = actor.skeleton.pose(pose, translation, actor.mover.world)
        _require_finite(posed.matrices, frame, f"joints of avatar {index}")
        seen = actor.body.see(posed, clip, self._output, vertices)
        avatar["avatar"], avatar["visible"] = index, seen is not None
        avatar["joints"], avatar["pose_feature"] = posed.matrices, posed.feature
        return seen

    def close(self) -> None:
        """Let go of the slots."""
        self._slots, self._vertices = [], []


def build(settings: Mapping[str, Any], unit: UnitContext) -> PoseStage:
    """The pose stage of the configuration in `settings`."""
    return PoseStage(RunConfig.model_validate(settings["config"]), unit.assets)


def _metrics(plan: FramePlan) -> dict[str, float]:
    metrics = {"visible": float(len(plan.seen))}
    if plan.seen:
        metrics["level"] = float(max(one.level for one in plan.seen.values()))
        metrics["error_px"] = max(one.error_px for one in plan.seen.values())
    return metrics if plan.density is None else {**metrics, "density": plan.density}


def _require_finite(values: NDArray[np.floating], frame: int, what: str) -> None:
    if not np.isfinite(values).all():
        raise TrilaneError(f"frame {frame}: the {what} is not finite")
