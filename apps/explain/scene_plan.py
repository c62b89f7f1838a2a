"""The plan that a run makes for each frame of a scene, also as a picture.

Rule: the run's own pose stage decides. `ScenePlan` measures how far a level of detail moves vertices on the picture,
against the whole body in float64. The picture shows the plan, not the painted frame: the bodies' vertices, their
rectangles and the tensor's, for a frame of each phase.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from trilane.arrays import F64, I64, Shape
from trilane.body.joints import Skeleton
from trilane.body.skinning import CpuSkinner
from trilane.pipeline.memory import Assets
from trilane.scene.crop import Rect
from trilane.stages.avatar_assets import distinct, mesh_levels_of, shaped_body, staged_of
from trilane.stages.config import RunConfig, pose_dtype, posed_vertices, posed_vertices_bytes
from trilane.stages.cpu.pose import FramePlan, PoseStage
from trilane.transport.packets import Packet, SlotLayout, view_packet
from trilane.writing import write_atomically

MOST_FRAMES = 9
GROUND, BODY, MESH, TENSOR, TEXT = (24, 26, 30), (150, 156, 166), (92, 176, 255), (255, 172, 64), (235, 235, 235)


@dataclass(frozen=True)
class PlannedFrame:
    """A planned frame.

    `plan`: decision of the pose stage. `crops`: by avatar, the rectangle of the screen that the tensor shows.
    """

    frame: int
    plan: FramePlan
    crops: dict[int, Rect]


class ScenePlan:
    """The plan of a configuration that was checked, frame by frame in order."""

    def __init__(self, config: RunConfig, assets: Assets) -> None:
        self.config, self._assets = config, assets
        self.output = (config.scene.output.height, config.scene.output.width)
        self._stage = PoseStage(config, assets)
        self._packet = _packet(config)
        self._stage.bind([], [self._packet])
        self._drawn = posed_vertices(self._packet.payload, config.posed_vertices)
        bodies = [shaped_body(assets, number) for number in range(len(distinct(config)))]
        self._bodies = [bodies[distinct(config).index(folder)] for folder in config.avatar_dirs]
        kept = [_kept(assets, number) for number in range(len(bodies))]
        self._kept = [kept[distinct(config).index(folder)] for folder in config.avatar_dirs]
        self._skinners = {id(body): CpuSkinner(body) for body in bodies}
        self._staged = staged_of(assets)

    def decide(self, frame: int) -> PlannedFrame:
        """Decide `frame` as the run does. Frames come in order, because the shape of one depends on the one before."""
        self._stage.run(frame, None, 0)
        plan = self._stage.plan
        crops = {number: Rect(*self._packet.header["avatars"][number]["rect"].tolist()) for number in plan.seen}
        return PlannedFrame(frame, plan, crops)

    def places(self, frame: int, avatar: int) -> F64:
        """Return the pixels (V,2) of the picture where the whole body's vertices lie; NaN for any outside of it."""
        return self._places(self._exact(frame, avatar), frame)

    def measured_px(self, frame: int, avatar: int) -> float:
        """Return the largest distance in pixels by which the last decision, for `frame`, moves a vertex of `avatar`.

        Vertices that the level of the mesh leaves out do not count.
        """
        if not self._drawn:
            return 0.0
        kept = self._kept[avatar][int(self._packet.header["avatars"][avatar]["mesh"])]
        exact = self.places(frame, avatar)[kept]
        drawn = self._places(self._drawn[avatar][: len(exact)].astype(np.float64), frame)
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


def _kept(assets: Assets, number: int) -> list[I64 | slice]:
    """Return the numbers of the vertices that each level of the mesh of distinct avatar `number` keeps."""
    return [slice(None), *(np.unique(level.faces).astype(np.int64) for level in mesh_levels_of(assets, number))]


def _packet(config: RunConfig) -> Packet:
    layout = SlotLayout(pose_dtype(len(config.avatar_dirs)), posed_vertices_bytes(config.posed_vertices))
    return view_packet(memoryview(bytearray(layout.slot_bytes)), layout)


def phases(frames: Sequence[PlannedFrame]) -> list[list[PlannedFrame]]:
    """Group frames in a row of equal work and tensor shape that model the same avatars at the same levels."""
    groups: list[list[PlannedFrame]] = []
    for planned in frames:
        if groups and _kind(groups[-1][-1]) == _kind(planned):
            groups[-1].append(planned)
        else:
            groups.append([planned])
    return groups


def _kind(planned: PlannedFrame) -> tuple[object, ...]:
    levels = tuple((number, one.level, one.mesh) for number, one in sorted(planned.plan.seen.items()))
    return planned.plan.work, planned.plan.shape, levels


def draw_plan(plan: ScenePlan, frames: Sequence[PlannedFrame], file: Path) -> None:
    """Write a sheet of at most `MOST_FRAMES` of `frames`, evenly spread, as PNG; `file` is replaced whole."""
    step = max(1, math.ceil(len(frames) / MOST_FRAMES))
    tiles = [_tile(plan, planned) for planned in frames[::step]]
    columns = math.ceil(math.sqrt(len(tiles)))
    height, width = plan.output
    sheet = Image.new("RGB", (columns * width, math.ceil(len(tiles) / columns) * height))
    for number, tile in enumerate(tiles):
        sheet.paste(tile, (number % columns * width, number // columns * height))
    with write_atomically(file) as draft:
        sheet.save(draft, format="PNG")


def _tile(plan: ScenePlan, planned: PlannedFrame) -> Image.Image:
    height, width = plan.output
    pixels = np.full((height, width, 3), GROUND, np.uint8)
    for avatar in planned.plan.seen:
        places = plan.places(planned.frame, avatar)
        columns, rows = places[np.isfinite(places).all(axis=1)].astype(int).T
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        pixels[rows[inside], columns[inside]] = BODY
    image = Image.fromarray(pixels)
    draw = ImageDraw.Draw(image)
    for avatar, one in planned.plan.seen.items():
        draw.rectangle(_box(planned.crops[avatar], plan.output), outline=TENSOR)
        draw.rectangle(_box(one.rect, plan.output), outline=MESH)
    draw.text((6, 4), _label(planned), fill=TEXT)
    return image


def _box(rect: Rect, output: Shape) -> tuple[float, float, float, float]:
    height, width = output
    left, right = (rect.x0 + 1) / 2 * width, (rect.x1 + 1) / 2 * width - 1
    top, bottom = (1 - rect.y1) / 2 * height, (1 - rect.y0) / 2 * height - 1
    return left, top, max(right, left), max(bottom, top)


def _label(planned: PlannedFrame) -> str:
    shape = planned.plan.shape
    if shape is None:
        return f"frame {planned.frame}: nobody in view"
    density = "" if planned.plan.density is None else f", density {planned.plan.density:.2f}"
    return f"frame {planned.frame}: tensor {shape[0]}x{shape[1]}{density}"
