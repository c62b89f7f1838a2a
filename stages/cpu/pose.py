"""The pose stage: from a frame's number, it computes all data that the other stages need about the frame.

Motion and camera are sampled at the frame's media time, frame / fps; all numbers that leave this stage are finite. With
the plan `planned`, a frame that shows nobody, or the same as an earlier frame, skips the stages that draw. A repeated
frame is not skinned. Each body gets a level of its mesh, and the cheapest level of detail that keeps the sum of both
errors within the pixel budget.
"""

from __future__ import annotations

import time
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, F64, Shape
from trilane.avatars.bundle import CLOTHES_STANDOFF_M
from trilane.avatars.mesh_levels import MeshLevel
from trilane.body.body import ShapedBody
from trilane.body.joints import Posed, Skeleton
from trilane.body.skinning import DETAILS, DetailBounds, FrameSkinner
from trilane.errors import TrilaneError
from trilane.machine import moved_of_kept
from trilane.pipeline.memory import Assets, ByteCounter
from trilane.pipeline.stage import Skip, UnitContext
from trilane.scene.camera_placement import steered
from trilane.scene.crop import SCREEN, Rect, cheapest_within, error_px, lay_out_apart, least_w, stretch_of
from trilane.scene.mover import Mover
from trilane.scene.planner import FrameWork, HeldMesh, HeldShape, hold_mesh, plan_tensor, shown_by, work_of
from trilane.stages.avatar_assets import bodies_drawn, distinct, mesh_levels_of, staged_of
from trilane.stages.config import RunConfig, posed_vertices
from trilane.stages.cpu.mesh_bounds import MeshBounds
from trilane.transport.packets import FRAME_FIELDS, Packet

FINEST = len(DETAILS) - 1


@dataclass(frozen=True)
class SeenAvatar:
    """An avatar on the screen.

    `rect`: rectangle of the mesh on the screen, NDC.
    `level`: level of detail, an index into `DETAILS`.
    `error_px`: bound on the error of the level of detail and of the level of the mesh together, pixels of the picture.
    `mesh`: level of the mesh, 0 for the whole mesh.
    `triangles`: number of triangles of this level of the mesh.
    `share`: number of vertices of this level, divided by the whole mesh's number.
    """

    rect: Rect
    level: int
    error_px: float
    mesh: int = 0
    triangles: int = 0
    share: float = 1.0


@dataclass(frozen=True)
class DetailChoice:
    """The choice for an avatar in a frame.

    `mesh`: level of the mesh.
    `level`: level of detail, an index into `DETAILS`.
    `error_px`: bound on the error of both on the picture, pixels.
    """

    mesh: HeldMesh
    level: int
    error_px: float


class DrawnMesh:
    """One level of a body's mesh, with the data for posing it.

    `shaped`: body with the vertices of this level.
    `skins`: whether the CPU unit skins it.
    `details`: whether levels of detail are used.
    `skinners`: skinner for each level of detail; empty if the GPU unit skins.
    `moved_to_skin`: bytes that each skinner reads from memory for a frame.
    """

    def __init__(self, shaped: ShapedBody, skins: bool, details: bool) -> None:
        self.shaped = shaped
        self.skinners: list[FrameSkinner] = []
        if skins and details:
            self.skinners = [FrameSkinner(shaped, detail) for detail in DETAILS]
        elif skins:
            self.skinners = [FrameSkinner(shaped)] * len(DETAILS)
        self.moved_to_skin = [moved_of_kept(skinner.constant_bytes) for skinner in self.skinners]

    def pose(self, posed: Posed, level: int, vertices: F32, moved: ByteCounter) -> F32:
        """Skin the body in pose `posed` into the beginning of `vertices`, and return this part of the array.

        `level`: level of detail, an index into `DETAILS`.
        `moved`: counter of the moved bytes.
        """
        own = vertices[: len(self.shaped.vertices)]
        self.skinners[level].skin_into(posed, own)
        moved.copied(own.nbytes)
        moved.read += self.moved_to_skin[level]
        moved.least += self.moved_to_skin[level] + own.nbytes
        return own


class ModelledBody:
    """A body that several avatars of a scene may share, with the data of each of its levels.

    `bodies`: the whole body, then the body of each level of its mesh.
    `levels`: levels of its mesh, the finest first.
    `skins`: whether the CPU unit skins it.
    `budget_px`: largest error on the picture in pixels; 0: everything is modelled.
    """

    def __init__(
        self, bodies: Sequence[ShapedBody], levels: Sequence[MeshLevel], skins: bool, budget_px: float
    ) -> None:
        self.shaped = bodies[0]
        self.budget_px = budget_px
        self.details = skins and budget_px > 0.0
        self.levels = levels if budget_px > 0.0 else ()
        self.meshes = [DrawnMesh(body, skins, self.details) for body in bodies]
        # The bounds of the whole mesh serve for all levels, because rectangles are widened by a level's error.
        self.bounds = MeshBounds(self.shaped, standoff_m=CLOTHES_STANDOFF_M)

    @cached_property
    def detail(self) -> DetailBounds:
        return DetailBounds(self.shaped)

    def skeleton(self) -> Skeleton:
        return Skeleton(self.shaped.joints, self.shaped.body.parents)

    def choose(self, posed: Posed, clip: F64, output: Shape, before: HeldMesh | None = None) -> DetailChoice:
        """Return the levels of mesh and detail for a frame, with the bound on their error.

        `posed`: pose of the frame.
        `clip`: projection @ view (4,4).
        `output`: (height, width) of the picture.
        `before`: level of the mesh in the previous frame; None if there was none.
        """
        if not self.details and not self.levels:
            return DetailChoice(HeldMesh(0), FINEST, 0.0)
        w = least_w(posed, clip, self.detail.reach, self.detail.blend_m(posed))
        stretch = stretch_of(clip, output)
        moved = [0.0]
        for level in self.levels:
            is_too_coarse = error_px(level.least_m, stretch, w) > self.budget_px  # in any pose
            moved.append(level.least_m if is_too_coarse else level.metres(posed))
        mesh = hold_mesh([error_px(metres, stretch, w) for metres in moved], self.budget_px, before)
        details = self.detail.metres(posed) if self.details else [0.0]
        errors = [error_px(metres + moved[mesh.level], stretch, w) for metres in details]
        chosen = cheapest_within(errors, self.budget_px)
        return DetailChoice(mesh, chosen if self.details else FINEST, errors[chosen])

    def see(
        self, posed: Posed, clip: F64, output: Shape, vertices: F32 | None, moved: ByteCounter, choice: DetailChoice
    ) -> SeenAvatar | None:
        """Skin the body, and return its rectangle and levels; None if nothing of it is visible.

        `posed`: pose of the frame.
        `clip`: projection @ view (4,4).
        `output`: (height, width) of the picture.
        `vertices`: array for the skinned vertices (V,3); None: the body is not skinned here.
        `moved`: counter of the bytes that skinning reads and writes, and that the search for the rectangle reads.
        `choice`: result of `choose` for the frame.
        """
        mesh = self.meshes[choice.mesh.level]
        own = None if vertices is None else mesh.pose(posed, choice.level, vertices, moved)
        rect = self.bounds.rect(posed, clip, own)
        if rect is None:
            return None
        grown = widened(rect, choice.error_px, output)
        share = len(mesh.shaped.vertices) / len(self.shaped.vertices)
        triangles = len(mesh.shaped.body.faces)
        return SeenAvatar(grown, choice.level, choice.error_px, choice.mesh.level, triangles, share)


def widened(rect: Rect, error_px: float, output: Shape) -> Rect:
    """Return `rect` with `error_px` pixels more on every side, clipped to the screen.

    `output`: (height, width) of the picture in pixels.
    """
    x, y = 2.0 * error_px / output[1], 2.0 * error_px / output[0]
    low = max(rect.x0 - x, SCREEN.x0), max(rect.y0 - y, SCREEN.y0)
    high = min(rect.x1 + x, SCREEN.x1), min(rect.y1 + y, SCREEN.y1)
    return Rect(*low, *high)


@dataclass(frozen=True)
class _Actor:
    index: int
    mover: Mover
    skeleton: Skeleton
    body: ModelledBody

    def pivot(self, translation: F64) -> F64:
        """Return the place (3,) of the root joint in the world, metres. `translation`: from `Mover.sample`, (3,)."""
        return np.asarray(
            self.mover.world[:3, :3] @ (self.body.shaped.joints[0] + translation) + self.mover.world[:3, 3]
        )


@dataclass(frozen=True)
class FramePlan:
    """The decisions for a frame.

    `work`: kind of work that the frame needs.
    `shape`: shape of the tensor; None with nobody in view.
    `density`: density of a planned tensor, else None.
    `seen`: visible avatars by their numbers.
    """

    work: FrameWork
    shape: Shape | None
    density: float | None
    seen: Mapping[int, SeenAvatar]

    @property
    def meshes(self) -> float:
        """The sum of `share` over all visible avatars: the drawn vertices, counted in whole meshes."""
        return sum(one.share for one in self.seen.values())


@dataclass(frozen=True)
class _Made:
    """A frame that was computed.

    `shown`: bytes that are equal for frames that show the same.
    `header`: copy of its header.
    `plan`: decisions for the frame.
    """

    shown: bytes
    header: NDArray[np.void]
    plan: FramePlan


#: Fields of the header that may differ between frames that show the same.
OF_THE_FRAME = {*(name for name, _ in FRAME_FIELDS), "media_time_s", "work"}


class PoseStage:
    """Stage `pose` of the CPU unit. It has no input edge; its output edge carries headers and skinned vertices.

    `plan`: plan of the last frame.
    """

    def __init__(self, config: RunConfig, assets: Assets) -> None:
        """Prepare the scene of `config`. `assets`: its avatars, motions and camera."""
        scene = config.scene
        self._fps = scene.fps
        self._output = (scene.output.height, scene.output.width)
        self._buckets, self._plans_tensor = config.buckets, scene.plans_tensor
        self._budgets, self._changes = config.tensor_budgets, config.changes
        self._painters = [config.network_of(number) for number in range(len(config.avatar_dirs))]
        self._rung = 0
        self._held: HeldShape | None = None
        self._skips = scene.plan == "planned"
        self.plan = FramePlan(FrameWork.NONE, None, None, {})
        folders = distinct(config)
        bodies = {
            folder: ModelledBody(
                bodies_drawn(config, assets, number),
                mesh_levels_of(assets, number),
                bool(config.posed_vertices),
                config.budget_px,
            )
            for number, folder in enumerate(folders)
        }
        staged = staged_of(assets)
        self._actors = [
            _Actor(index, mover, bodies[folder].skeleton(), bodies[folder])
            for index, (folder, mover) in enumerate(zip(config.avatar_dirs, staged.movers, strict=True))
        ]
        self._camera = staged.camera
        self._counts = config.posed_vertices
        self._window = config.opened_window()
        self._made: dict[FrameWork, _Made] = {}
        self._moved = ByteCounter()
        self._was_seen = [False] * len(self._actors)
        self._meshes: list[HeldMesh | None] = [None] * len(self._actors)
        self._slots: list[NDArray[np.void]] = []
        self._vertices: list[list[NDArray[np.float32]]] = []

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Take the output slots. Raises ValueError if there are inputs."""
        if inputs:
            raise ValueError("the pose stage has no input edge")
        self._slots = [packet.header for packet in outputs]
        self._vertices = [posed_vertices(packet.payload, self._counts) for packet in outputs]

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:  # noqa: ARG002
        """Fill `outputs[slot_out]` for `frame`, and return metrics: a `Skip` if the frame needs less than full work.

        With a fixed plan, all frames need full work.

        The metrics are `visible`, the number of visible avatars, and the bytes moved. A full frame with visible avatars
        also has their largest `level` and `error_px`, their sum of `triangles`, and a planned tensor's `density`. The
        least bytes are the samples of motions and camera, the header, and what skinning reads and writes.

        Raises ValueError without `slot_out`, TrilaneError if a number of the frame is not finite.
        """
        if slot_out is None:
            raise ValueError("the pose stage needs an output slot")
        packet = self._slots[slot_out]
        self._moved.start()
        t_s = frame / self._fps
        packet["frame"] = frame
        packet["t_sampled_ns"] = time.monotonic_ns()
        packet["media_time_s"] = t_s
        moved = [actor.mover.sample(t_s) for actor in self._actors]
        view, projection = self._view(t_s, moved), self._camera.projection(t_s, self._output)
        _require_finite(view, frame, "camera")
        for index, (pose, translation) in enumerate(moved):
            _require_finite(pose, frame, f"pose of avatar {index}")
            _require_finite(translation, frame, f"place of avatar {index}")
        self._count(packet, view, moved)
        shown = shown_by([view, projection, *(array for pair in moved for array in pair)])
        work = self._work_of(shown, lambda: self._make(slot_out, frame, view, projection, moved))
        packet["work"] = work
        known = self._made.get(FrameWork.FULL if work is FrameWork.REUSE else work)
        if self._skips and known is not None and known.shown == shown:
            for name in packet.dtype.names or ():
                if name not in OF_THE_FRAME:
                    packet[name] = known.header[name]
            self.plan = replace(known.plan, work=work)
        else:
            packet["picture"] = frame if work is FrameWork.FULL else -1
            self.plan = replace(self.plan, work=work)
            # Copied, because a later frame is written to the same slot.
            self._made[work] = _Made(shown, packet.copy(), self.plan)
        return _metrics(self.plan, self._moved)

    def _count(self, packet: NDArray[np.void], view: F64, moved: Sequence[tuple[F64, F64]]) -> None:
        """Count the bytes that every frame moves: the samples of motions and camera, and the header `packet`."""
        sampled = view.nbytes + sum(array.nbytes for pair in moved for array in pair)
        self._moved.read += sampled
        self._moved.written += packet.nbytes
        self._moved.least += sampled + packet.nbytes

    def _view(self, t_s: float, moved: Sequence[tuple[F64, F64]]) -> F64:
        """Return the matrix (4,4) from world to camera: the scene's camera, steered about the first avatar."""
        view = self._camera.sample(t_s)
        if self._window is None:
            return view
        return steered(view, self._actors[0].pivot(moved[0][1]), *self._window.steering)

    def _work_of(self, shown: bytes, is_anybody_seen: Callable[[], bool]) -> FrameWork:
        if self._skips:
            return work_of(shown, self._shown_by(FrameWork.FULL), self._shown_by(FrameWork.NONE), is_anybody_seen)
        is_anybody_seen()
        return FrameWork.FULL

    def forget(self) -> None:
        """Let the next frame with a visible avatar be a full frame."""
        self._made.pop(FrameWork.FULL, None)

    def step_to(self, rung: int) -> None:
        """Limit the pixels of later tensors to the share `RunConfig.works[rung]`, in thousandths."""
        self._rung = rung

    def _shown_by(self, work: FrameWork) -> bytes | None:
        return self._made[work].shown if work in self._made else None

    def _make(self, slot_out: int, frame: int, view: F64, projection: F64, moved: Sequence[tuple[F64, F64]]) -> bool:
        """Fill the header of slot `slot_out` with camera and avatars, and return whether an avatar is visible."""
        packet = self._slots[slot_out]
        packet["avatar_count"] = len(self._actors)
        packet["view"], packet["projection"] = view, projection
        clip = projection @ view
        vertices: Sequence[NDArray[np.float32] | None] = self._vertices[slot_out] or [None] * len(self._actors)
        seen = [
            (avatar, one)
            for actor, place in zip(self._actors, vertices, strict=True)
            if (one := self._see(actor, avatar := packet["avatars"][actor.index], place, moved, frame, clip))
            is not None
        ]
        self.plan = self._lay_out(packet, seen)
        return bool(seen)

    def _lay_out(self, packet: NDArray[np.void], seen: list[tuple[NDArray[np.void], SeenAvatar]]) -> FramePlan:
        """Set crop rectangles, `tensor_rect`s and the tensor's shape in the header `packet`.

        With nobody in view, the tensor has the smallest shape.
        """
        if not seen:
            packet["tensor_shape"] = min(self._buckets, key=lambda shape: shape[0] * shape[1])
            return FramePlan(FrameWork.NONE, None, None, {})
        rects, density = [one.rect for _, one in seen], None
        painters = [self._painters[int(avatar["avatar"])] for avatar, _ in seen]
        if self._plans_tensor:
            foreseen = self._foreseen(float(packet["media_time_s"]))
            budget = self._budgets[self._rung]
            plan = plan_tensor(rects, self._output, self._buckets, budget, self._held, foreseen, painters)
            layout, density, self._held = plan.dense.layout, plan.dense.density, plan.held
        else:
            layout = lay_out_apart(rects, painters, self._output, self._buckets)
        packet["tensor_shape"] = layout.shape
        for (avatar, _), (crop, cell) in zip(seen, layout.crops, strict=True):
            avatar["rect"], avatar["tensor_rect"] = crop, cell
        return FramePlan(FrameWork.FULL, layout.shape, density, {int(avatar["avatar"]): one for avatar, one in seen})

    def _foreseen(self, t_s: float) -> Shape | None:
        """Return the foreseen shape of the tensor at `t_s`; None if it was not foreseen."""
        if not self._changes:
            return None
        changes = self._changes[self._rung]
        # Half a microsecond is added so that rounding does not make a change one frame late.
        return changes[max(bisect_right(changes, t_s + 5e-7, key=lambda change: change[0]) - 1, 0)][1]

    def _see(
        self,
        actor: _Actor,
        avatar: NDArray[np.void],
        vertices: NDArray[np.float32] | None,
        moved: Sequence[tuple[F64, F64]],
        frame: int,
        clip: NDArray[np.float64],
    ) -> SeenAvatar | None:
        """Fill one avatar's part of the header, and return what is seen of it; None if it is not visible.

        An avatar that is far off the screen is not posed. If the last computed frame did not show the avatar, it is
        skinned only if its coarse patches may be on the screen.
        """
        pose, translation = moved[actor.index]
        avatar["avatar"], avatar["visible"] = actor.index, False
        if actor.body.bounds.is_off_screen(actor.pivot(translation), clip):
            self._was_seen[actor.index] = False
            return None
        posed: Posed = actor.skeleton.pose(pose, translation, actor.mover.world)
        _require_finite(posed.matrices, frame, f"joints of avatar {actor.index}")
        seen = None
        if self._was_seen[actor.index] or actor.body.bounds.may_be_seen(posed, clip):
            choice = actor.body.choose(posed, clip, self._output, self._meshes[actor.index])
            self._meshes[actor.index], avatar["mesh"] = choice.mesh, choice.mesh.level
            seen = actor.body.see(posed, clip, self._output, vertices, self._moved, choice)
        self._was_seen[actor.index] = seen is not None
        avatar["visible"] = seen is not None
        avatar["joints"], avatar["pose_feature"] = posed.matrices, posed.feature
        return seen

    def close(self) -> None:
        """Drop the views of the slots."""
        self._slots, self._vertices = [], []


def build(settings: Mapping[str, Any], unit: UnitContext) -> PoseStage:
    """Build the pose stage of the configuration in `settings`."""
    return PoseStage(RunConfig.model_validate(settings["config"]), unit.assets)


def _metrics(plan: FramePlan, moved: ByteCounter) -> Mapping[str, float]:
    metrics = {"visible": float(len(plan.seen)), **moved.figures()}
    if plan.work is not FrameWork.FULL:
        return Skip(metrics)
    if plan.seen:
        metrics["level"] = float(max(one.level for one in plan.seen.values()))
        metrics["error_px"] = max(one.error_px for one in plan.seen.values())
        metrics["triangles"] = float(sum(one.triangles for one in plan.seen.values()))
    return metrics if plan.density is None else {**metrics, "density": plan.density}


def _require_finite(values: NDArray[np.floating], frame: int, what: str) -> None:
    if not np.isfinite(values).all():
        raise TrilaneError(f"frame {frame}: the {what} is not finite")
