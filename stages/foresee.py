"""Chooses the tensors of a scene before the run: how many pixels they may have, and which shapes are prepared.

The choice uses the bounds and layouts of the run, on a fixed number of frames spread over the scene. If these frames
are close enough to each other, the changes of the tensor's shape are foreseen too.

A tensor has the number of pixels that its network was trained for, or fewer if the scene allows it. Under a policy that
releases frames at a rate, a run may step down to smaller tensors so that frames are in time. An error budget in dB
limits the smallest size, by the avatars' measured errors. Other policies use the smallest size within the budget, or
the full size without a budget.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from trilane.arrays import BUCKET_STEP, Shape
from trilane.avatars.bundle import CLOTHES_STANDOFF_M
from trilane.avatars.network_file import NetworkFile, reshaped
from trilane.avatars.validation import SizeLoss
from trilane.body.body import ShapedBody
from trilane.body.joints import Skeleton
from trilane.errors import BadInputError
from trilane.scene.crop import Rect
from trilane.scene.planner import (
    MOST_SHAPES,
    Demand,
    LookAhead,
    ShapeSet,
    choose_shapes,
    foreseen_changes,
    ideal_shape,
    joined,
    larger_shapes,
    pixels_of,
)
from trilane.scene.schema import Scene
from trilane.scene.staging import Staged
from trilane.scene.tensor_budget import TensorBudget, area
from trilane.scheduler.policy import policy_named
from trilane.stages.cpu.mesh_bounds import MeshBounds
from trilane.units import ALL_WORK, SIDES, work_of_side

KEY = "error_budget_db"


def tensor_works(scene: Scene, policy: str, losses: Sequence[SizeLoss]) -> tuple[tuple[int, ...], str]:
    """Return (`RunConfig.works` of a scene under `policy`, note for a person, which may be empty).

    `losses`: loss of PSNR of each avatar in tensors below full size; without figures if it was not measured.
    Raises BadInputError if the scene has an error budget and an avatar has no measured errors, UnexpectedValue for an
    unknown policy.
    """
    if not scene.plans_tensor:
        return (ALL_WORK,), ""
    works, budget = tuple(work_of_side(side) for side in SIDES), scene.error_budget_db
    paced = policy_named(policy).paced
    if budget is None:
        return (works, "") if paced else ((ALL_WORK,), "")
    for loss in losses:
        if not loss.by_work:
            raise BadInputError(KEY, loss.source, "avatars whose error in smaller tensors was measured")
    lost = {work: [loss.at(work) for loss in losses] for work in works}
    within = tuple(work for work in works if all(db is not None and db <= budget for db in lost[work]))
    least = within[-1]
    worst = max(db for db in lost[least] if db is not None)
    said = (
        f"image error: tensors may have {least / ALL_WORK:.0%} of the pixels that the network was trained for, where "
        f"they lose {worst:.1f} dB of the {budget:g} allowed ({losses[0].source})"
    )
    return (within if paced else within[-1:]), said


#: Number of frames to examine for one avatar. For n avatars, this number is divided by n, but not below LEAST_FRAMES.
FORESEEN_FRAMES, LEAST_FRAMES = 96, 24
#: Largest distance in frames between two examined frames with which changes are foreseen.
MOST_APART = 15
#: Most shapes of each smaller size to which a run may step down.
MOST_SMALLER = 3
#: Number of copies of each tensor in a prepared network: a runtime may keep a second copy in its own layout.
COPIES = 2
MB = 1_000_000
BYTE_TYPES = (2, 3)  # ONNX's uint8 and int8


Changes = tuple[tuple[tuple[float, Shape], ...], ...]


@dataclass(frozen=True)
class Foreseen:
    """The result of `foresee`.

    `shapes`: shapes to prepare.
    `frames`: numbers of the examined frames.
    `seen`: number of examined frames that show somebody.
    `left_out`: number of smaller sizes without a shape, because `memory_mb` has no room for one.
    `limited`: number of examined frames in which the budget has fewer pixels than the avatars need.
    `changes`: for each budget, pairs of a time in seconds at which the tensor changes, and its shape from then on;
    empty if the changes are not foreseen.
    """

    shapes: ShapeSet
    frames: tuple[int, ...]
    seen: int
    left_out: int = 0
    limited: int = 0
    changes: Changes = ()

    @property
    def note(self) -> str:
        """A sentence about the shapes, for a person."""
        names = ", ".join(f"{height}x{width}" for height, width in self.shapes.shapes)
        looked_at = f"somebody is seen in {self.seen} of {len(self.frames)} frames looked at"
        if self.changes:
            looked_at += f"; {len(self.changes[0]) - 1} changes foreseen"
        text = f"tensor: planned in shapes {names} ({looked_at})"
        if self.shapes.unserved:
            text += f"; {self.shapes.unserved} of them have no shape of their own within memory_mb and are less dense"
        return text

    def notes(self, memory_mb: int, most_side: int) -> tuple[str, ...]:
        """Return `note`, and sentences about what `memory_mb` and `most_side` leave out.

        The memory is computed, not measured.
        """
        notes = [self.note]
        if self.left_out:
            notes.append(
                f"memory: {self.left_out} of the smaller tensor sizes have no shape within memory_mb {memory_mb}"
            )
        if self.limited:
            notes.append(
                f"tensor: in {self.limited} of {len(self.frames)} frames looked at, most_side = {most_side} gives "
                "avatars fewer pixels than they need; what the picture loses is not measured"
            )
        needed = math.ceil(self.shapes.memory_bytes / MB)
        if needed > memory_mb:
            notes.append(
                f"memory: the network may take {needed} MB, more than memory_mb {memory_mb}: one is always ready"
            )
        return tuple(notes)


@dataclass(frozen=True)
class Painted:
    """The networks of a scene. `by`: number of the network that paints each avatar; empty if one network paints all."""

    networks: Sequence[NetworkFile]
    by: Sequence[int] = ()


def foresee(
    scene: Scene, staged: Staged, bodies: Sequence[ShapedBody], painted: Painted, budgets: Sequence[TensorBudget]
) -> Foreseen:
    """Return the tensor shapes that `scene` needs, and the changes between them if they can be foreseen.

    `bodies`: bodies of its avatars, in order.
    `painted`: networks that paint the avatars.
    `budgets`: budgets of its tensors, the largest first. The run may step down to smaller budgets, if memory has room
    for their shapes.
    """
    count = min(scene.frames, max(FORESEEN_FRAMES // len(bodies), LEAST_FRAMES))
    frames = tuple(index * scene.frames // count for index in range(count))
    output = (scene.output.height, scene.output.width)
    looks = [
        LookAhead(frame, rects)
        for frame, rects in zip(frames, foreseen_rects(scene, staged, bodies, frames), strict=True)
    ]
    seen = [(list(look.rects.values()), look.networks(painted.by)) for look in looks if look.rects]
    are_close = scene.frames <= MOST_APART * count
    per_pixel = sum(map(bytes_per_pixel, painted.networks))
    limited = sum(is_limited(rects, by, output, budgets[0]) for rects, by in seen)
    chosen, left_out, changes = ShapeSet((), 0, 0), 0, []
    for budget in budgets:
        demands = [
            Demand(ideal_shape(rects, output, budget, by), pixels_of(rects, by, output, budget)) for rects, by in seen
        ]
        anyway = demands or [Demand((BUCKET_STEP, BUCKET_STEP), budget.own)]
        left = scene.memory_mb * MB - chosen.memory_bytes
        is_smaller = bool(chosen.shapes)
        most = MOST_SMALLER if is_smaller else MOST_SHAPES
        found = choose_shapes(anyway, per_pixel, left, most, optional=is_smaller)
        left_out += not found.shapes
        if are_close and found.shapes:
            room = int(left / per_pixel) - sum(map(area, found.shapes))
            limits = most - len(found.shapes), room
            larger, foreseen = _foreseen(looks, output, found.shapes, budget, painted.by, limits)
            found = joined(found, ShapeSet(larger, math.ceil(per_pixel * sum(map(area, larger))), 0))
            changes.append(tuple((frame / scene.fps, shape) for frame, shape in foreseen))
        elif are_close:
            # Without shapes of its own, this budget's tensors change at the same times as the larger budget's.
            changes.append(changes[-1])
        chosen = joined(chosen, found)
    return Foreseen(chosen, frames, len(seen), left_out, limited, tuple(changes))


def is_limited(rects: Sequence[Rect], networks: Sequence[int], output: Shape, budget: TensorBudget) -> bool:
    """Return whether avatars get fewer pixels by `budget` than they would get without its limit.

    `rects`, `networks`: rectangle and network of each avatar in view; `networks` is empty if one paints all.
    `output`: (height, width) of the picture.
    """
    own, wanted = (pixels_of(rects, networks, output, replace(budget, most=m)) for m in (budget.most, sys.maxsize))
    return own < wanted


def _foreseen(
    looks: Sequence[LookAhead],
    output: Shape,
    shapes: Sequence[Shape],
    budget: TensorBudget,
    networks: Sequence[int],
    room: tuple[int, int],
) -> tuple[tuple[Shape, ...], tuple[tuple[int, Shape], ...]]:
    """Return (further shapes to prepare, changes of the tensor's shape with them); larger shapes need fewer changes.

    `room`: (most further shapes, most pixels of all of them together).
    """
    most = budget.most_of(max(len(look.rects) for look in looks))
    larger = larger_shapes(shapes, most)
    while True:
        changes = foreseen_changes(looks, output, (*shapes, *larger), budget, networks)
        taken = {shape for _, shape in changes}
        used = [shape for shape in larger if shape in taken]
        if len(used) <= room[0] and sum(map(area, used)) <= room[1]:
            return tuple(used), changes
        larger = used[:-1]


def foreseen_rects(
    scene: Scene, staged: Staged, bodies: Sequence[ShapedBody], frames: Sequence[int]
) -> Iterator[Mapping[int, Rect]]:
    """Yield for each of the numbers `frames` the rectangles (NDC) of visible avatars with finite poses, by avatar."""
    distinct = {id(body): MeshBounds(body, standoff_m=CLOTHES_STANDOFF_M) for body in bodies}
    skeletons = [Skeleton(body.joints, body.body.parents) for body in bodies]
    for frame in frames:
        t_s = frame / scene.fps
        clip = staged.camera.projection(t_s, (scene.output.height, scene.output.width)) @ staged.camera.sample(t_s)
        rects = {}
        for number, (body, skeleton, mover) in enumerate(zip(bodies, skeletons, staged.movers, strict=True)):
            pose, translation = mover.sample(t_s)
            posed = skeleton.pose(pose, translation, mover.world)
            rect = distinct[id(body)].rect(posed, clip) if np.isfinite(posed.matrices).all() else None
            if rect is not None:
                rects[number] = rect
        yield rects


def bytes_per_pixel(network: NetworkFile) -> float:
    """Return how many bytes of memory the prepared `network` takes for each pixel of its tensor.

    There are COPIES copies of each of the network's byte tensors.
    """
    _, height, width, _ = network.shape
    if not network.model.graph.value_info:
        network = reshaped(network, height + BUCKET_STEP, width)
        height += BUCKET_STEP
    sizes = [
        math.prod(dim.dim_value for dim in value.type.tensor_type.shape.dim)
        for value in network.model.graph.value_info
        if value.type.tensor_type.elem_type in BYTE_TYPES
    ]
    return float(COPIES * sum(sizes) / (height * width))
