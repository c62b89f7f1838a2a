"""What a scene will put on the screen, looked at before the run. Rule: the same bounds and the same layouts as in the
run, on a fixed number of frames spread over the scene.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from trilane.avatars.bundle import CLOTHES_STANDOFF_M
from trilane.avatars.integer_network import NetworkFile
from trilane.avatars.network_reshape import STRIDE, reshaped
from trilane.body.body import ShapedBody
from trilane.body.kinematics import Skeleton
from trilane.scene.crop import Rect
from trilane.scene.planner import TensorBudget, ideal_shape
from trilane.scene.schema import Scene
from trilane.scene.shape_set import MOST_SHAPES, Demand, ShapeSet, choose_shapes, joined
from trilane.scene.staging import Staged
from trilane.stages.cpu.mesh_bounds import MeshBounds

#: Of the scene, over all avatars; but at least so many of each.
FORESEEN_FRAMES, LEAST_FRAMES = 96, 24
#: Shapes of each size that is stepped down to.
MOST_SMALLER = 3
#: A network that is ready to run holds its tensors once, and a runtime may lay each of them out anew.
COPIES = 2
MB = 1_000_000
BYTE_TYPES = (2, 3)  # of ONNX: uint8 and int8


@dataclass(frozen=True)
class Foreseen:
    """`shapes`: to make ready. `frames`: numbers of those that were looked at. `seen`: on how many somebody is.

    `left_out`: how many of the sizes that are stepped down to have no shape, because `memory_mb` has no room for one.
    """

    shapes: ShapeSet
    frames: tuple[int, ...]
    seen: int
    left_out: int = 0

    @property
    def note(self) -> str:
        """What a person should know of it."""
        names = ", ".join(f"{height}x{width}" for height, width in self.shapes.shapes)
        looked_at = f"somebody is seen in {self.seen} of {len(self.frames)} frames looked at"
        text = f"tensor: planned in shapes {names} ({looked_at})"
        if self.shapes.unserved:
            text += f"; {self.shapes.unserved} of them have no shape of their own within memory_mb and are less dense"
        return text

    def notes(self, memory_mb: int) -> tuple[str, ...]:
        """`note`, and what `memory_mb` has no room for: smaller sizes, or even one network, by computed memory."""
        notes = [self.note]
        if self.left_out:
            notes.append(
                f"memory: {self.left_out} of the smaller tensor sizes have no shape within memory_mb {memory_mb}"
            )
        needed = math.ceil(self.shapes.memory_bytes / MB)
        if needed > memory_mb:
            notes.append(
                f"memory: the network may take {needed} MB, more than memory_mb {memory_mb}: one is always ready"
            )
        return tuple(notes)


def foresee(
    scene: Scene, staged: Staged, bodies: Sequence[ShapedBody], network: NetworkFile, budgets: Sequence[TensorBudget]
) -> Foreseen:
    """The tensor shapes that `scene` needs.

    `bodies`: of its avatars, in order.
    `network`: that all of them share.
    `budgets`: of its tensors, the largest first; the further ones are stepped down to, where memory has room for them.
    """
    count = min(scene.frames, max(FORESEEN_FRAMES // len(bodies), LEAST_FRAMES))
    frames = tuple(index * scene.frames // count for index in range(count))
    output = (scene.output.height, scene.output.width)
    seen = [rects for rects in foreseen_rects(scene, staged, bodies, frames) if rects]
    per_pixel = bytes_per_pixel(network)
    chosen, left_out = ShapeSet((), 0, 0), 0
    for budget in budgets:
        demands = [Demand(ideal_shape(rects, output, budget), budget.of(len(rects))) for rects in seen]
        anyway = demands or [Demand((STRIDE, STRIDE), budget.of(1))]
        left = scene.memory_mb * MB - chosen.memory_bytes
        is_smaller = bool(chosen.shapes)
        most = MOST_SMALLER if is_smaller else MOST_SHAPES
        found = choose_shapes(anyway, per_pixel, left, most, optional=is_smaller)
        left_out += not found.shapes
        chosen = joined(chosen, found)
    return Foreseen(chosen, frames, len(seen), left_out)


def foreseen_rects(
    scene: Scene, staged: Staged, bodies: Sequence[ShapedBody], frames: Sequence[int]
) -> Iterator[list[Rect]]:
    """For each of `frames` the rectangles of the avatars that are visible, in the order of the scene."""
    distinct = {id(body): MeshBounds(body, standoff_m=CLOTHES_STANDOFF_M) for body in bodies}
    skeletons = [Skeleton(body.joints, body.body.parents) for body in bodies]
    for frame in frames:
        t_s = frame / scene.fps
        clip = staged.camera.projection(t_s, (scene.output.height, scene.output.width)) @ staged.camera.sample(t_s)
        rects = []
        for body, skeleton, mover in zip(bodies, skeletons, staged.movers, strict=True):
            pose, translation = mover.sample(t_s)
            posed = skeleton.pose(pose, translation, mover.world)
            rect = distinct[id(body)].rect(posed, clip) if np.isfinite(posed.matrices).all() else None
            rects += [rect] if rect is not None else []
        yield rects


def bytes_per_pixel(network: NetworkFile) -> float:
    """Memory of `network`, ready to run, for each pixel of its tensor: COPIES of all its tensors of bytes."""
    _, height, width, _ = network.shape
    if not network.model.graph.value_info:
        network = reshaped(network, height + STRIDE, width)
        height += STRIDE
    sizes = [
        math.prod(dim.dim_value for dim in value.type.tensor_type.shape.dim)
        for value in network.model.graph.value_info
        if value.type.tensor_type.elem_type in BYTE_TYPES
    ]
    return float(COPIES * sum(sizes) / (height * width))
