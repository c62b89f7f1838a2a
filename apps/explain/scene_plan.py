"""The plan that a run makes for each frame of a scene: in words and figures, with costs and savings, and as a drawing.

Rule: the run's own pose stage decides. `ScenePlan` compares a level of detail with the whole body in float64: it
measures the distance of their vertices in the picture. Costs are computed, never measured, by the model of `trilane
predict`. In this model, the cost of an avatar in view depends on its joints and on the vertices that its mesh level
keeps. Every figure says whether it is a bound, measured or computed.

The drawing shows the plan for a frame of each phase, not the painted frame. Its parts are the vertices of the bodies,
the bodies' rectangles and the tensor's crop rectangles.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from trilane.apps.run.report_facts import worst_loss
from trilane.arrays import F64, I64, Shape
from trilane.avatars.network_file import NetworkFile
from trilane.avatars.validation import tolerance_db
from trilane.body.joints import Skeleton
from trilane.body.skinning import DETAILS, CpuSkinner, left_out
from trilane.errors import BadInputError
from trilane.hw_profiles.application import Plan, Variant, stage_times_ms, steady, workers_of
from trilane.hw_profiles.host import described, host_cores, usable_cores
from trilane.hw_profiles.host_model import place_units
from trilane.hw_profiles.profile_files import load_runnable
from trilane.hw_profiles.schema import Profile, corners_of
from trilane.pipeline.memory import Assets
from trilane.scene.crop import Rect
from trilane.scene.planner import FrameWork
from trilane.scene.tensor_budget import MOST_DENSITY
from trilane.scheduler.placement import Ranked
from trilane.stages.avatar_assets import distinct, mesh_levels_of, networks_of, painting, shaped_body, staged_of
from trilane.stages.config import RunConfig, pose_dtype, posed_vertices, posed_vertices_bytes
from trilane.stages.configure import Checked
from trilane.stages.cpu.pose import FramePlan, PoseStage
from trilane.stages.foresee import is_limited
from trilane.transport.packets import Packet, SlotLayout, view_packet
from trilane.transport.slots import DEFAULT_EDGE
from trilane.units import ALL_WORK, COMPUTED, HOST, MEASURED, NS_PER_MS, UNITS, UnitName
from trilane.writing import write_atomically

MOST_FRAMES = 9
GROUND, BODY, MESH, TENSOR, TEXT = (24, 26, 30), (150, 156, 166), (92, 176, 255), (255, 172, 64), (235, 235, 235)


@dataclass(frozen=True)
class PlannedFrame:
    """A planned frame.

    `frame`: number of the frame. `plan`: decisions of the pose stage. `crops`: for each visible avatar, by its number,
    the crop rectangle in NDC.
    """

    frame: int
    plan: FramePlan
    crops: dict[int, Rect]


class ScenePlan:
    """Plans the frames of a checked configuration, one after the other.

    `config`: checked configuration. `assets`: arrays of the run. `output`: (height, width) of the picture.
    `bodies`: body of each avatar. `kept`: for each avatar, the vertices that each level of its mesh keeps.
    """

    def __init__(self, config: RunConfig, assets: Assets) -> None:
        self.config = config
        self.output = (config.scene.output.height, config.scene.output.width)
        self._stage = PoseStage(config, assets)
        self._packet = _packet(config)
        self._stage.bind([], [self._packet])
        self._drawn = posed_vertices(self._packet.payload, config.posed_vertices)
        folders = distinct(config)
        bodies = [shaped_body(assets, number) for number in range(len(folders))]
        kept = [_kept(assets, number) for number in range(len(folders))]
        numbers = [folders.index(folder) for folder in config.avatar_dirs]
        self.bodies, self.kept = [bodies[number] for number in numbers], [kept[number] for number in numbers]
        self._skinners = {id(body): CpuSkinner(body) for body in bodies}
        self._staged = staged_of(assets)

    def decide(self, frame: int) -> PlannedFrame:
        """Return the plan of frame number `frame`, as a run decides.

        Call it for the frames in order, because the tensor's shape depends on the frame before.
        """
        self._stage.run(frame, None, 0)
        plan = self._stage.plan
        crops = {number: Rect(*self._packet.header["avatars"][number]["rect"].tolist()) for number in plan.seen}
        return PlannedFrame(frame, plan, crops)

    def places(self, frame: int, avatar: int) -> F64:
        """Return the places (V,2) of the vertices of the whole body in the picture: x, y in pixels from the top left.

        Vertices outside of the picture have NaN. `frame`, `avatar`: numbers.
        """
        return self._places(self._exact(frame, avatar), frame)

    def measured_px(self, frame: int, avatar: int) -> float:
        """Return the largest distance in the picture between the planned and the exact place of a vertex, in pixels.

        The exact place is from the whole body in float64. Vertices that the level of the mesh leaves out do not count.
        If the GPU unit skins, or if all vertices are outside of the picture, return 0. Call this after `decide(frame)`.
        `frame`, `avatar`: numbers.
        """
        if not self._drawn:
            return 0.0
        kept = self.kept[avatar][int(self._packet.header["avatars"][avatar]["mesh"])]
        exact = self.places(frame, avatar)[kept]
        drawn = self._places(self._drawn[avatar][: len(exact)].astype(np.float64), frame)
        moved = np.linalg.norm(exact - drawn, axis=1)
        return float(np.nanmax(moved, initial=0.0)) if np.isfinite(moved).any() else 0.0

    def _exact(self, frame: int, avatar: int) -> F64:
        body, mover = self.bodies[avatar], self._staged.movers[avatar]
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
    """Return, for each level of an avatar's mesh, the vertices that the level keeps, as indices. Level 0 keeps all.

    `assets`: arrays of the run. `number`: number of the avatar among the distinct avatars.
    """
    return [slice(None), *(np.unique(level.faces).astype(np.int64) for level in mesh_levels_of(assets, number))]


def _packet(config: RunConfig) -> Packet:
    layout = SlotLayout(pose_dtype(len(config.avatar_dirs)), posed_vertices_bytes(config.posed_vertices))
    return view_packet(memoryview(bytearray(layout.slot_bytes)), layout)


def phases(frames: Sequence[PlannedFrame]) -> list[list[PlannedFrame]]:
    """Return the phases: groups of successive frames with the same work, tensor shape and visible avatars.

    The visible avatars must also have the same levels of detail and mesh.
    """
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
    """Draw at most `MOST_FRAMES` of `frames`, evenly spread, into one picture, and write it as the PNG `file`.

    `plan`: plan that decided `frames`. Raises BadInputError if `file` cannot be written.
    """
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


#: Tensor shape of the reference application. Every plan is compared with it.
FIXED: Shape = (512, 512)
MOST_MEASURED = 24  # phases whose error is measured, at one frame each
EXPRESSION = "part of the avatar's shape: it costs nothing per frame"
BOUND = "proved bound, in pixels of the picture"
WHY = {
    FrameWork.NONE: "nobody is on the screen: nothing is drawn, packed or inferred",
    FrameWork.REUSE: "nothing has changed: the picture that is there is shown again",
}
PIPELINED = Variant("pipelined", DEFAULT_EDGE)
#: Numbers of the networks that paint a frame.
Networks = tuple[int, ...]
FIRST: Networks = (0,)
#: Stages that a frame needs even with nobody in view.
ALWAYS = ("pose", "composite", "present")


class ModelledAvatar(NamedTuple):
    """A visible avatar of a phase.

    `avatar`, `name`: its number and name. `modelled`: its level of detail. `mesh`: `level` of its mesh, number of
    `triangles` in this level, and number `of` triangles in the whole mesh. `left_out`: parts that are not modelled.
    `bound_px`: largest bound of the error in the phase. `measured_px`: error in the first frame; None if not measured.
    """

    avatar: int
    name: str
    modelled: str
    mesh: dict[str, int]
    left_out: list[str]
    bound_px: float
    measured_px: float | None


@dataclass(frozen=True)
class ScenePhase:
    """A phase of a scene.

    `cost`, `fixed`: cost of its first frame, by the plan and with a tensor of the shape `FIXED`. `why`: reason for the
    size of the tensor, in words.
    """

    frames: Sequence[PlannedFrame]
    avatars: Sequence[ModelledAvatar]
    cost: FrameCost
    fixed: FrameCost
    why: str

    @property
    def work(self) -> str:
        return self.frames[0].plan.work.name.lower()

    @property
    def density(self) -> list[float] | None:
        """The least and the largest density; None for a tensor whose size is not planned, and for no tensor."""
        first, found = self.frames[0].plan, [planned.plan.density or 0.0 for planned in self.frames]
        return [min(found), max(found)] if first.shape and first.density is not None else None

    @property
    def saved(self) -> dict[str, float]:
        """What the plan saves in the first frame: `pixels`, `gmac` and `work_ms` of `fixed` minus `cost`."""
        keys = ("pixels", "gmac", "work_ms")
        return {key: getattr(self.fixed, key) - getattr(self.cost, key) for key in keys}

    def as_json(self) -> dict[str, Any]:
        tensor = self.frames[0].plan.shape
        return {
            "first_frame": self.frames[0].frame,
            "last_frame": self.frames[-1].frame,
            "frames": len(self.frames),
            "work": self.work,
            "tensor": list(tensor) if tensor else None,
            "density": self.density,
            "avatars": [each._asdict() for each in self.avatars],
            "cost": self.cost._asdict(),
            "saved": self.saved,
            "why": self.why,
        }


class ImageSize(NamedTuple):
    """The size of planned tensors. If the scene fixes the size, `work` and `psnr_loss_db` are None.

    `work`: pixels of a tensor, as a share of its network's own pixels. `psnr_loss_db`: PSNR that this size costs; None
    if not known. `source`: source of both.
    """

    work: float | None
    psnr_loss_db: float | None
    source: str


class PlanExplanation:
    """The explained plan of the scene in `checked`.

    `profile`: hardware profile for which the costs are computed. `performance_profile`: performance profile of its
    units.

    `plan`: plan that decided the frames. `skinned_on`, `detail`: unit that skins, and how levels of detail are chosen.
    `planned`, `fixed`: costs of all frames, by the plan and with tensors of the shape `FIXED`. In both, `frame_ms` is a
    mean; the other fields are sums. `placement`: as `CostModel.placement` returns it.

    Raises BadInputError as `CostModel` does, and for cores that were chosen for another chip than this machine.
    """

    def __init__(self, checked: Checked, profile: str, performance_profile: str) -> None:
        config, scene = checked.config, checked.config.scene
        self.checked, self.profile, self._performance_profile = checked, profile, performance_profile
        self.plan = plan = ScenePlan(config, checked.assets)
        costs = CostModel(networks_of(checked.assets), profile, performance_profile, config.networks_of)
        errors: list[list[float | None]] = []
        frames: list[PlannedFrame] = []
        for frame in range(scene.frames):
            planned = plan.decide(frame)
            if len(phases([*frames[-1:], planned])) > len(frames[-1:]):
                measured = len(errors) < MOST_MEASURED
                errors.append([plan.measured_px(frame, avatar) if measured else None for avatar in planned.plan.seen])
            frames.append(planned)
        groups = phases(frames)
        limited = [any(_is_limited(planned, config, plan.output) for planned in group) for group in groups]
        parts = cache(lambda avatar, level: left_out(DETAILS[level], plan.bodies[avatar].body))

        def modelled(number: int, group: Sequence[PlannedFrame], error: float | None) -> ModelledAvatar:
            one, triangles = group[0].plan.seen[number], len(plan.bodies[number].body.faces)
            return ModelledAvatar(
                number,
                str(scene.avatars[number].name),
                DETAILS[one.level].name,
                {"level": one.mesh, "triangles": one.triangles, "of": triangles},
                parts(number, one.level),
                max(planned.plan.seen[number].error_px for planned in group),
                error,
            )

        self.phases = [
            ScenePhase(
                group,
                [modelled(number, group, px) for number, px in zip(group[0].plan.seen, measured_px, strict=True)],
                _cost(group[0].plan, costs),
                costs.of(FIXED, *costs.in_view(group[0].plan)),
                _why(group, config, is_limited),
            )
            for group, measured_px, is_limited in zip(groups, errors, limited, strict=True)
        ]
        self.image = _image(checked, any(limited))
        self.planned = _total([_cost(one.plan, costs) for one in frames])
        self.fixed = _total([costs.of(FIXED, *costs.in_view(one.plan)) for one in frames])
        self.placement = costs.placement(*_usual(frames, costs), checked.asked_cores)
        self.skinned_on = "cpu" if config.posed_vertices else "gpu"
        self.detail = "by its bound in pixels" if config.posed_vertices and config.budget_px else "everything"

    def as_json(self) -> dict[str, Any]:
        """Return the document of `trilane plan --json`."""
        config, scene = self.checked.config, self.checked.config.scene
        totals = (("", self.planned), ("fixed_", self.fixed))
        return {
            "scene": scene.name,
            "config": {
                "frames": scene.frames,
                "fps": scene.fps,
                "output": list(self.plan.output),
                "plan": scene.plan,
                "size": scene.size,
                "error_budget_px": scene.error_budget_px,
                "error_budget_db": scene.error_budget_db,
                "profile": self.profile,
                "performance_profile": self._performance_profile,
            },
            "shapes": [list(shape) for shape in config.buckets],
            "avatars": [
                {
                    "avatar": number,
                    "name": avatar.name,
                    "bundle": avatar.bundle,
                    "skinned_on": self.skinned_on,
                    "expression": EXPRESSION,
                    "detail": self.detail,
                    "mesh_levels": len(self.plan.kept[number]) - 1,  # without the whole mesh
                    "texture_filter": scene.texture_filter,
                }
                for number, avatar in enumerate(scene.avatars)
            ],
            "phases": [phase.as_json() for phase in self.phases],
            "image": self.image._asdict(),
            "totals": {of + key: getattr(cost, key) for key in FrameCost._fields for of, cost in totals},
            "placement": self.placement,
            "notes": list(self.checked.notes),
            "sources": {
                "bound_px": BOUND,
                "measured_px": f"{MEASURED}, at a phase's first frame, at the vertices that are drawn",
                "pixels, gmac": "counted",
                "ms": COMPUTED,
            },
        }


def _image(checked: Checked, is_limited: bool) -> ImageSize:
    """Return the size of planned tensors.

    `is_limited`: whether `most_side` limits the tensor of any frame. The loss is then not known.
    """
    if not checked.config.scene.plans_tensor:
        return ImageSize(None, None, "the scene fixes the tensor's size")
    work = checked.config.works[0]
    if is_limited:
        source = f"most_side = {checked.config.scene.most_side} gives avatars fewer pixels than they need"
        return ImageSize(work / ALL_WORK, None, source)
    sources = "; ".join(dict.fromkeys(loss.source for loss in checked.losses))
    return ImageSize(work / ALL_WORK, worst_loss(work, checked.losses), sources)


def _cost(plan: FramePlan, costs: CostModel) -> FrameCost:
    return costs.of(plan.shape, *costs.in_view(plan), plan.meshes) if plan.work is FrameWork.FULL else costs.of(None)


def _total(costs: Sequence[FrameCost]) -> FrameCost:
    pixels, gmac, work_ms, frame_ms = (sum(each) for each in zip(*costs, strict=True))
    return FrameCost(pixels, gmac, work_ms, frame_ms / len(costs))


def _tolerance(config: RunConfig) -> str:
    """Return, in words, the PSNR that a planned size may lose; "" if no tables in manifests give the sizes."""
    if not config.size_curves:
        return ""
    sharing = Counter(config.networks or [0] * len(config.avatar_dirs))
    return " or ".join(f"{tolerance:g} dB" for tolerance in sorted({tolerance_db(count) for count in sharing.values()}))


def _is_limited(planned: PlannedFrame, config: RunConfig, output: Shape) -> bool:
    """Return whether `most_side` gives the avatars of a frame fewer pixels than they get without this limit.

    `output`: (height, width) of the picture.
    """
    if planned.plan.density is None or not planned.crops:
        return False
    networks = [config.networks[number] for number in planned.crops] if config.networks else []
    return is_limited(list(planned.crops.values()), networks, output, config.tensor_budgets[0])


def _why(group: Sequence[PlannedFrame], config: RunConfig, is_limited: bool) -> str:
    """Return, in words, why the tensor of a phase has its size.

    `group`: frames of the phase. `is_limited`: whether `most_side` limits one of them.
    """
    first = group[0].plan
    if first.work in WHY:
        return WHY[first.work]
    if first.density is None:
        return "the scene fixes the tensor's size"
    if is_limited:
        return f"as many pixels as most_side = {config.scene.most_side} allows: the avatars need more"
    if tolerance := _tolerance(config):
        return f"the fewest pixels within {tolerance} of the best size, by the table `by_size` in the manifest"
    if max(planned.plan.density or 0.0 for planned in group) >= MOST_DENSITY:
        return f"{MOST_DENSITY:g} tensor pixels along a side of a pixel of the picture: more make no better picture"
    return "the pixels that the network was trained to paint, in the shape that fits best of those that are ready"


def _usual(frames: Sequence[PlannedFrame], costs: CostModel) -> tuple[Shape | None, int, Networks]:
    """Return the most frequent (tensor shape, number of avatars in view, numbers of their networks).

    Only frames with all work count. If there are none, return (None, 0, FIRST).
    """
    full = [one.plan for one in frames if one.plan.work is FrameWork.FULL]
    kinds = Counter((plan.shape, *costs.in_view(plan)) for plan in full)
    return kinds.most_common(1)[0][0] if kinds else (None, 0, FIRST)


class FrameCost(NamedTuple):
    """The cost of one frame.

    `pixels`: pixels of its tensors. `gmac`: multiply-accumulates of its networks, in 1e9.
    `work_ms`: sum of the times of all stages. `frame_ms`: frame time if all frames are like this frame and pipelined.
    """

    pixels: int
    gmac: float
    work_ms: float
    frame_ms: float


def least_frame_ms(chip: Profile, times: Mapping[tuple[str, UnitName], float]) -> float:
    """Return the least frame time of pipelined frames in ms: the time of the busiest core for a frame.

    If the display's shortest interval between frames is longer, return this interval. A unit without a core counts as a
    core. `chip`: hardware profile. `times`: time of each stage's job, in ms, by (stage, unit).
    """
    worker = workers_of(chip)
    busy = (sum(ms for (_, unit), ms in times.items() if worker[unit] == one) for one in set(worker.values()))
    return max(*busy, chip.application.display_ms.or_else(0))


class CostModel:
    """The costs of frames on a chip, by the model of `trilane predict`.

    `networks`: networks of the scene. `profile`: name of the chip's hardware profile. `performance_profile`:
    performance profile of its units. `of`: the function `_of`, which returns the cost of a frame, with a cache.
    """

    def __init__(
        self,
        networks: Sequence[NetworkFile],
        profile: str,
        performance_profile: str,
        painters: Callable[[Iterable[int]], Networks] = lambda _avatars: FIRST,
    ) -> None:
        """Load the hardware profile.

        Raises BadInputError for an unknown profile or performance profile, and for a template, which describes no chip.

        `painters`: function from the numbers of avatars to the numbers of the networks that paint them. Other
        parameters: see `CostModel`.
        """
        self._networks, self._chip, self._painters = networks, load_runnable(profile), painters
        self._corners = corners_of(self._chip, performance_profile)
        self.of = cache(self._of)

    def in_view(self, plan: FramePlan) -> tuple[int, Networks]:
        """Return (number of avatars that a frame shows, numbers of the networks that paint them).

        With nobody in view, the networks are FIRST. `plan`: plan of the frame.
        """
        return len(plan.seen), self._painters(plan.seen) or FIRST

    def _of(
        self, shape: Shape | None, avatars: int = 1, networks: Networks = FIRST, meshes: float | None = None
    ) -> FrameCost:
        """Return the cost of a frame with `avatars` avatars in view.

        With nobody in view, the pose of one avatar still counts, because the pose stage looks for somebody.

        `shape`: shape of the frame's tensors; None for no tensor.
        `networks`: numbers of the networks that paint the avatars, each from a tensor of its own.
        `meshes`: number of drawn vertices, counted in whole meshes; None for a whole mesh of each avatar.
        """
        plan = replace(self._plan(shape, avatars, networks), meshes=meshes)
        times = stage_times_ms(self._chip, plan, self._corners)
        if shape is None:
            kept = {key: ms for key, ms in times.items() if key[0] in ALWAYS}
            return FrameCost(0, 0.0, sum(kept.values()), least_frame_ms(self._chip, kept))
        steady_ms = steady(self._chip, plan, self._corners, quick=True).frame_ms
        return FrameCost(plan.network.pixels, plan.network.work.macs / 1e9, sum(times.values()), steady_ms)

    def placement(
        self,
        shape: Shape | None,
        avatars: int = 1,
        networks: Networks = FIRST,
        asked: Mapping[str, tuple[int, ...]] | None = None,
    ) -> dict[str, Any]:
        """Return the best placement of the units for a typical frame, and why, by the model of `trilane predict`.

        Keys: `units`: cores and threads of each unit. `predicted_ms`: predicted frame time. `why`: the reason in words.
        On another chip than this machine, the first two are None.

        `shape`, `avatars`, `networks`: as in `_of`. `asked`: cores that the user chose, by unit of this machine; None
        for none.

        Raises BadInputError if cores are chosen for another chip than this machine.
        """
        asked = asked or {}
        if self._chip.name != HOST:
            if asked:
                raise BadInputError("--cores", f"cores of {self._chip.name}", f"--profile {HOST}, which has cores")
            return {
                "units": None,
                "predicted_ms": None,
                "why": f"each unit of {self._chip.name} is hardware of its own",
            }
        plan = self._plan(shape, avatars, networks)
        cores = sorted({*usable_cores(), *(core for own in asked.values() for core in own)})
        placed = place_units(self._chip, plan, self._corners, host_cores(cores), asked)
        chosen = {key: placed.facts[key] for key in ("units", "predicted_ms")}
        return {**chosen, "why": f"{described(placed.best.placement)}: {_why_placed(asked, placed.rule)}"}

    def _plan(self, shape: Shape | None, avatars: int, networks: Networks) -> Plan:
        files = [self._networks[number] for number in networks]
        return Plan(painting(files, shape or files[0].shape[1:3], {}), "dsp", PIPELINED, avatars=max(1, avatars))


def _why_placed(asked: Mapping[str, tuple[int, ...]], rule: Ranked) -> str:
    if len(asked) == len(UNITS):
        return "as asked"
    how = "as asked, the others for the least predicted frame time" if asked else "the least predicted frame time"
    by_rule = f"{described(rule.placement)}, {rule.frame_ns / NS_PER_MS:.1f} ms"
    return f"{how}; by the rule for any run, {by_rule}. A run measures and decides for itself"
