"""The configuration of a run of the avatar, checked by the parent, and the contents of the avatar's packets.

A `RunConfig` is plain data; the parent has checked every path in it. Axis orders and signs in packets follow
docs/conventions.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, field_validator

from trilane.arrays import F32, U8, Shape, shape_buckets
from trilane.body.joints import JOINTS, POSE_FEATURES
from trilane.errors import BadInputError
from trilane.pipeline.description import UnitSettings
from trilane.scene.schema import Scene, StrictModel
from trilane.scene.tensor_budget import Curve, TensorBudget
from trilane.transport.live_window import LiveWindow
from trilane.transport.packets import header_dtype
from trilane.unexpected_value import UnexpectedValue
from trilane.units import ALL_WORK, UnitName

#: One avatar of a frame.
#: `avatar`: number of the avatar in the scene.
#: `joints`: skinning matrices, metres, world space, row-major 3x4: x_world = sum_k w_k (joints_k @ [x_rest, 1]).
#: `pose_feature`: (R - I) row-major of joints 1..54; multiplies the body's `posedirs`.
#: `rect`: crop rectangle x0, y0, x1, y1 in normalised device coordinates, y up: the mesh's rectangle clipped to
#: [-1, 1], grown to the tensor's aspect so that tensor pixels are square; the grown part may exceed the screen.
#: `tensor_rect`: top, left, height, width of the tensor's part that shows the crop rectangle, in tensor pixels.
#: `mesh`: level of the mesh that is drawn: 0 for the whole mesh, then the avatar's `MeshLevel`s, the finest first.
#: `visible`: 0 if nothing of the avatar is on screen; the other fields are then unspecified.
AVATAR_DTYPE = np.dtype(
    [
        ("avatar", "<i4"),
        ("visible", "<i4"),
        ("mesh", "<i4"),
        ("rect", "<f4", (4,)),
        ("tensor_rect", "<i4", (4,)),
        ("joints", "<f4", (JOINTS, 3, 4)),
        ("pose_feature", "<f4", (POSE_FEATURES,)),
    ],
    align=True,
)


def pose_dtype(avatars: int) -> np.dtype[Any]:
    """Return the layout of the header of a packet with `avatars` avatars. Its fields:

    `avatar_count`: number of avatars.
    `work`: value of `FrameWork`.
    `picture`: number of the frame whose picture of the avatars is shown; -1 if none is.
    `repeats`: 0 for a composited frame that was drawn; otherwise 1 + the number of the drawn frame with the same bytes.
    `media_time_s`: time in motion and camera.
    `tensor_shape`: (height, width) of this frame's tensor (the shape bucket).
    `view`: matrix from world to camera, row-major for column vectors.
    `projection`: OpenGL clip matrix, row-major for column vectors.
    `avatars`: AVATAR_DTYPE of each avatar.
    """
    return header_dtype(
        [
            ("avatar_count", "<i4"),
            ("work", "<i4"),
            ("picture", "<i8"),
            ("repeats", "<i8"),
            ("media_time_s", "<f8"),
            ("tensor_shape", "<i4", (2,)),
            ("view", "<f4", (4, 4)),
            ("projection", "<f4", (4, 4)),
            ("avatars", AVATAR_DTYPE, (avatars,)),
        ]
    )


def posed_vertices(payload: U8, counts: Sequence[int]) -> list[F32]:
    """Return the skinned vertices of each avatar as a view (V,3) float32 of `payload`, a payload of the pose edge.

    The vertices are in the body's order, in metres, in world space. A level of the mesh has fewer vertices than the
    whole mesh, and fills the beginning of its view.

    `counts`: number of vertices of each avatar; empty if the GPU unit skins.
    """
    views, start = [], 0
    for count in counts:
        size = posed_vertices_bytes([count])
        views.append(payload[start : start + size].view(np.float32).reshape(count, 3))
        start += size
    return views


def posed_vertices_bytes(counts: Sequence[int]) -> int:
    """Return the size in bytes of a payload for `posed_vertices`."""
    return sum(counts) * 3 * np.dtype(np.float32).itemsize


PAINTED_CHANNELS = 4  # channels of a network's picture: red, green, blue, alpha


@dataclass(frozen=True)
class Quantisation:
    """Scale and zero point of a tensor's bytes: real = (q - zero_point) * scale, q from 0 to 255.

    Raises BadInputError for a scale that is not positive, or a zero point that is no byte.
    """

    scale: float
    zero_point: int

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise BadInputError("quantisation scale", str(self.scale), "a positive number")
        if not 0 <= self.zero_point <= 255:
            raise BadInputError("quantisation zero point", str(self.zero_point), "0 to 255")


class NetworkCut(StrictModel):
    """A cut of the network at the quantised tensor `at`; the part after the cut runs on `unit`."""

    at: str
    unit: UnitName


class RunConfig(StrictModel):
    """One run of the avatar, as plain data. Paths are absolute and were checked by the parent.

    `scene`: scene to show, with its avatars.
    `out_dir`: temporary run folder.
    `avatar_dirs`: bundle folder of each avatar of the scene.
    `units`: cores and threads of each unit.
    `runtime`: name of the DSP unit's inference runtime.
    `networks`: number of the network that paints each avatar; empty if one network paints all. Each network has its own
    tensor in a slot, and all tensors have one shape.
    `shapes`: tensor shapes if the scene plans the tensor; empty: the shapes of the scene's size.
    `changes`: for each of `works`, pairs of a time in seconds at which a planned tensor changes, and its shape from
    then on; empty if the changes were not foreseen.
    `own_pixels`: number of pixels of the tensor with which the network was trained.
    `size_curves`: measured tensor pixels of each avatar, by the picture's pixels that its body covers; empty if one of
    them was not measured.
    `works`: sizes of a planned tensor in thousandths of `own_pixels`, the largest first. The run steps down to smaller
    ones if frames would be late.
    `record`: whether the frames are encoded to a video.
    `posed_vertices`: number of vertices of each avatar if the CPU unit skins; empty if the GPU unit does.
    `pace_ns`: least time of a job in ns, by stage.
    `cuts`: cuts of the network; its first part runs on the DSP unit.
    `kept`: numbers of frames whose presented pictures are kept, to compare them after the run.
    `window`: file of the window, the shared memory for watching the run and steering its camera; None: no window.
    """

    scene: Scene
    out_dir: Path
    avatar_dirs: tuple[Path, ...]
    units: dict[str, UnitSettings]
    runtime: str = "ort"
    networks: tuple[int, ...] = ()
    shapes: tuple[Shape, ...] = ()
    changes: tuple[tuple[tuple[float, Shape], ...], ...] = ()
    own_pixels: int = 0
    size_curves: tuple[Curve, ...] = ()
    works: tuple[int, ...] = (ALL_WORK,)
    record: bool = True
    posed_vertices: tuple[int, ...] = ()
    pace_ns: dict[str, int] = Field(default={})
    cuts: tuple[NetworkCut, ...] = ()
    kept: tuple[int, ...] = ()
    window: Path | None = None

    @field_validator("units")
    @classmethod
    def _units_known(cls, units: dict[str, UnitSettings]) -> dict[str, UnitSettings]:
        unknown = set(units) - {"cpu", "gpu", "dsp"}
        if unknown:
            raise UnexpectedValue(f"unknown unit {sorted(unknown)}", "cpu, gpu, dsp")
        return units

    def opened_window(self) -> LiveWindow | None:
        """Map and return the window; None without one. Raises OSError if the process that made it has ended."""
        output = self.scene.output
        return None if self.window is None else LiveWindow.opened(self.window, output.height, output.width)

    @property
    def buckets(self) -> list[Shape]:
        return list(self.shapes) or shape_buckets(self.scene.size)

    @property
    def tensor_budgets(self) -> tuple[TensorBudget, ...]:
        """The budgets of a planned tensor: one for each of its sizes, which the field `works` lists."""
        whole = TensorBudget(self.own_pixels, self.scene.most_side**2, curves=self.size_curves)
        return tuple(whole.scaled(work) for work in self.works)

    @property
    def budget_px(self) -> float:
        """The largest permitted error of a vertex on the picture, pixels; 0 if everything is modelled."""
        return self.scene.error_budget_px if self.scene.plan == "planned" else 0.0

    def network_of(self, avatar: int) -> int:
        """Return the number of the network that paints the avatar with the number `avatar`."""
        return self.networks[avatar] if self.networks else 0

    def networks_of(self, avatars: Iterable[int]) -> tuple[int, ...]:
        """Return the numbers of the networks that paint the avatars with the numbers `avatars`, ascending."""
        return tuple(sorted({self.network_of(avatar) for avatar in avatars}))

    @property
    def infer_units(self) -> tuple[str, ...]:
        """The unit of each part of the network, in the order of the parts."""
        return ("dsp", *(cut.unit for cut in self.cuts))

    @property
    def infer_names(self) -> tuple[str, ...]:
        """The names of the stages that run the parts: `infer`, `infer-2`, ..."""
        return ("infer", *(f"infer-{number}" for number in range(2, len(self.cuts) + 2)))

    @property
    def max_tensor_pixels(self) -> int:
        return max(math.prod(shape) for shape in self.buckets)


def network_parts(payload: U8, networks: int, shapes: Sequence[Shape], channels: int) -> list[U8]:
    """Return views of the parts of a slot's `payload`, one part for each network.

    `networks`: number of networks.
    `shapes`: shapes that a tensor may have; each part has room for the largest.
    `channels`: most channels of a pixel.
    """
    size = channels * max(math.prod(shape) for shape in shapes)
    return [payload[number * size : (number + 1) * size] for number in range(networks)]
