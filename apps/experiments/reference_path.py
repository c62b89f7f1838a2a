"""The reference path of a frame, with causes of error that can be switched on.

Rule: without a cause, the path is the plan `full` (`bench/lib/full_picture.py`). The body is in float64 with everything
on. The raster is supersampled in float64, from a float texture, into an unrounded tensor of about the network's own
area. The network is in FP32, and its picture is blended in linear light in float64 and not rounded. Each cause replaces
one of these steps by the run's step. With all causes, the picture is the run's. Motion, camera, background and contact
shadows are always the run's. A cause may need other causes (`NEEDS`). For example, a runtime reads bytes, so `RUNTIME`
needs `PACKING`. The composite stage reads pictures of the run's tensor, so `COMPOSITE` needs `CROP`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import BUCKET_STEP, F32, F64, U8, Mask, Shape
from trilane.avatars.network_file import Affine, NetworkFile, reshaped
from trilane.bench.lib.cast import (
    Box,
    Cast,
    CastView,
    RasterLayer,
    enlarged,
    grown,
    laid_over,
    placed,
    premultiplied,
    shrunk,
)
from trilane.bench.lib.float_raster import quantise
from trilane.bench.lib.full_picture import SAMPLES, FullBody, Paint, as_written, fineness, float_network, supersampled
from trilane.bench.lib.stage_chain import AvatarFrames
from trilane.body.body import Body
from trilane.body.joints import JOINTS, POSE_FEATURES, Posed, Skeleton
from trilane.body.skinning import DETAILS, EVERYTHING, Detail, FrameSkinner
from trilane.scene.crop import Cell, Rect, crop_projection
from trilane.scene.planner import FrameWork
from trilane.stages.avatar_assets import AvatarData
from trilane.stages.configure import Checked
from trilane.stages.dsp.runtime import Binding, RuntimeOptions, load_runtime
from trilane.stages.gpu.skinned_mesh import MeshArrays, avatar_mesh, enough_weights

#: A pixel belongs to a mask if avatars cover at least this share of it.
HALF = 0.5


class Cause(StrEnum):
    """The causes of the difference between a run's picture and the reference, in the order in which they are added."""

    WEIGHTS = "skin weights"
    BLEND = "blend shapes"
    FLOAT32 = "FP32 transforms"
    FLOAT16 = "FP16 texture"
    CROP = "crop and size"
    READS = "one read a pixel"
    PACKING = "INT8 packing"
    RASTER = "GPU raster"
    QUANTISATION = "quantisation"
    RUNTIME = "runtime"
    COMPOSITE = "composite"


Causes = frozenset[Cause]
NOTHING: Causes = frozenset()
BODY: Causes = frozenset({Cause.WEIGHTS, Cause.BLEND, Cause.FLOAT32})
_DRAWN = BODY | {Cause.FLOAT16, Cause.CROP, Cause.READS, Cause.PACKING}
#: Cause -> the causes that must be on too.
NEEDS: dict[Cause, Causes] = {
    Cause.RASTER: _DRAWN,
    Cause.RUNTIME: frozenset({Cause.PACKING, Cause.QUANTISATION}),
    Cause.COMPOSITE: frozenset({Cause.CROP}),
}
WHAT: dict[Cause, str] = {
    Cause.WEIGHTS: "the run's skin weights instead of all; hands and face at rest where the plan says so",
    Cause.BLEND: "pose blend shapes left out where the plan says so; in FP16 where the GPU unit skins",
    Cause.FLOAT32: "joints, vertices and camera in float32",
    Cause.FLOAT16: "the neural texture in float16",
    Cause.CROP: "the run's tensor and crop rectangles instead of a tensor for each avatar on the picture's grid",
    Cause.READS: "one read of the texture for each tensor pixel instead of the mean of 4 x 4",
    Cause.PACKING: "the tensor rounded and clamped to bytes",
    Cause.RASTER: "the GPU unit's own tensor instead of the float64 rasteriser's with all of the above",
    Cause.QUANTISATION: "the integer network, as its file says it, instead of the FP32 network",
    Cause.RUNTIME: "the integer network as the run's runtime computes it",
    Cause.COMPOSITE: "the composite stage instead of float64; the network's picture in bytes",
}


def needs(cause: Cause) -> Causes:
    """Return the causes that must be on for `cause`; an empty set for a cause that needs no other."""
    return NEEDS.get(cause, NOTHING)


def up_to(cause: Cause) -> Causes:
    """Return `cause` and all causes before it in the order of `Cause`."""
    order = list(Cause)
    return frozenset(order[: order.index(cause) + 1])


def require_complete(causes: Iterable[Cause]) -> Causes:
    """Return `causes` as a set. Raises ValueError if one of them needs a cause that is missing."""
    found = frozenset(causes)
    for cause in found:
        if missing := needs(cause) - found:
            raise ValueError(f"{cause} needs {', '.join(sorted(missing))}")
    return found


class RunBody:
    """Computes the vertices of one distinct avatar with any causes.

    In float64, the vertices are computed joint by joint. In float32, Trilane's own skinning computes them. If the CPU
    unit skins and all causes are on, the result equals this unit's vertices to the bit.

    `data`: avatar. `on_cpu`: whether the CPU unit skins the body; if not, the GPU unit skins it.
    """

    def __init__(self, data: AvatarData, *, on_cpu: bool) -> None:
        self._data, self._on_cpu = data, on_cpu
        self._skeleton = Skeleton(data.shaped.joints, data.shaped.body.parents)
        self._full: dict[Detail, FullBody] = {}
        self._skinners: dict[Detail, FrameSkinner] = {}

    def vertices(self, seen: CastView, level: int | None, causes: Causes) -> F64:
        """Return the vertices (V,3) float64, metres, in the world.

        `seen`: the avatar in a frame.
        `level`: index into `DETAILS` that the run's plan chose. None if the run does not show the avatar; nothing is
        left out then. If the GPU unit skins, its own detail replaces `DETAILS[level]`.
        `causes`: causes that are on; only the causes in `BODY` have an effect.
        """
        detail = self._detail(level, causes)
        if Cause.FLOAT32 not in causes:
            return self._full_body(detail).vertices(seen.pose, seen.translation, seen.world)
        posed = self._skeleton.pose(seen.pose, seen.translation, seen.world)
        return (self._by_cpu(detail, posed) if self._on_cpu else self._by_gpu(detail, posed)).astype(np.float64)

    def _detail(self, level: int | None, causes: Causes) -> Detail:
        """Return the level of detail. Where a cause is on, it is the run's; otherwise, nothing is left out.

        `WEIGHTS` concerns skin weights, hands and face; `BLEND` concerns pose blend shapes. `level`, `causes`: as in
        `vertices`.
        """
        run = EVERYTHING
        if self._on_cpu:
            run = EVERYTHING if level is None else DETAILS[level]
        elif level is not None:
            run = Detail("the GPU unit's", enough_weights(self._body), hands_and_face=True, pose_blend=False)
        weights = run if Cause.WEIGHTS in causes else EVERYTHING
        blend = run.pose_blend if Cause.BLEND in causes else True
        return Detail("mixed", weights.weight_count, weights.hands_and_face, blend)

    @property
    def _body(self) -> Body:
        return self._data.shaped.body

    def _full_body(self, detail: Detail) -> FullBody:
        if detail not in self._full:
            manifest = self._data.bundle.manifest
            body = replace(self._body, weights=detail.weights(self._data.shaped), posedirs=self._blend(detail))
            self._full[detail] = FullBody(body, manifest.betas, manifest.expression)
        return self._full[detail]

    def _blend(self, detail: Detail) -> F32 | None:
        """Return the pose blend shapes for `detail`, in float32; None for no pose blend shapes.

        If `detail` leaves them out, the CPU unit has none, and the GPU unit has them rounded to float16.
        """
        if detail.pose_blend or self._body.posedirs is None:
            return self._body.posedirs
        return None if self._on_cpu else self._body.posedirs.astype(np.float16).astype(np.float32)

    def _by_cpu(self, detail: Detail, posed: Posed) -> F32:
        if detail not in self._skinners:
            self._skinners[detail] = FrameSkinner(self._data.shaped, detail)
        vertices = np.empty_like(self._data.shaped.vertices, np.float32)
        self._skinners[detail].skin_into(posed, vertices)
        return vertices

    def _by_gpu(self, detail: Detail, posed: Posed) -> F32:
        """Return the vertices (V,3) float32, metres, by the formula of the vertex shader.

        The result of each step is rounded to float32.
        """
        rest, blend = self._data.shaped.vertices.astype(np.float32), self._blend(detail)
        if blend is not None:
            rest = rest + (blend.reshape(-1, POSE_FEATURES) @ posed.feature).reshape(-1, 3)
        moved = (detail.weights(self._data.shaped) @ posed.matrices.reshape(JOINTS, 12)).reshape(-1, 3, 4)
        return np.asarray(np.einsum("vab,vb->va", moved[:, :, :3], rest) + moved[:, :, 3], np.float32)


@dataclass(frozen=True)
class ReferenceFrame:
    """The frame `number`, drawn with or without causes.

    `picture`: (h,w,3) sRGB in 0..1. `mask` (h,w) bool: pixels that avatars cover by half or more. `boxes`:
    rectangles around the visible avatars, pixels.
    """

    number: int
    picture: F64
    mask: Mask
    boxes: tuple[Box, ...]


class ReferencePath:
    """The reference path of the scene in `checked`.

    `cast`: avatars and camera of the scene. `frames`: object that makes the run's own frames.
    `networks`: names of the networks that paint the reference. `gl`: OpenGL context in use.
    `output`: (height, width) of the picture. `avatars`: distinct avatars, by the folder of the bundle.
    """

    def __init__(self, checked: Checked) -> None:
        """Load the avatars.

        Raises BadInputError for a broken avatar, MissingPartError without OpenGL or the run's runtime.
        """
        config = checked.config
        self.cast, self.frames = Cast(checked), AvatarFrames(checked)
        self.output: Shape = (config.scene.output.height, config.scene.output.width)
        on_cpu = bool(config.posed_vertices)
        self.avatars = {folder: _avatar(data, config.runtime, on_cpu) for folder, data in self.cast.avatars.items()}
        self._network_of = config.network_of

    @property
    def networks(self) -> list[str]:
        return sorted({avatar.network for avatar in self.avatars.values()})

    @property
    def gl(self) -> Any:
        return self.frames.gl

    def network_of(self, seen: CastView) -> int:
        """Return the number of the network that paints the visible avatar `seen`."""
        return self._network_of(seen.index)

    def frame(self, number: int) -> ReferenceFrame:
        """Return frame `number` without causes, which is the reference."""
        return self.moment(number).frame(NOTHING)

    def moment(self, number: int) -> ReferenceMoment:
        """Return frame `number` as a `ReferenceMoment`, which can be drawn with any causes."""
        return ReferenceMoment(self, number)


class ReferenceMoment:
    """One frame, which can be drawn with any causes. Parts that several drawings share are made once.

    `path`: reference path of the scene. `number`: number of the frame.
    `own`: the run's picture (h,w,3) in 0..1. `background`: the run's picture (h,w,3) uint8 without avatars.
    `seen`: visible avatars, by number. `boxes`: rectangles around them, pixels.
    """

    def __init__(self, path: ReferencePath, number: int) -> None:
        self._path, self.number = path, number
        self.seen = {seen.index: seen for seen in path.cast.seen(number)}
        self.boxes = tuple(path.cast.boxes(number))
        self.background = path.frames.background(number)
        self.own: F64 = path.frames.frame(number) / 255.0
        self._header, self._levels = path.frames.posed.copy(), dict(path.frames.levels)
        self._made: dict[Hashable, Any] = {}

    def frame(self, causes: Causes) -> ReferenceFrame:
        """Return the frame with `causes` on. Raises ValueError if one of them needs a cause that is missing."""
        made: ReferenceFrame = self._once(("frame", require_complete(causes)), lambda: self._frame(causes))
        return made

    def _frame(self, causes: Causes) -> ReferenceFrame:
        picture, cover = laid_over(self.background, self._layers(causes))
        if Cause.COMPOSITE in causes:
            picture = self._composited(causes)
        return ReferenceFrame(self.number, picture, cover >= HALF, self.boxes)

    def vertices(self, index: int, causes: Causes) -> F64:
        """Return the vertices (V,3), metres in the world, of the visible avatar number `index`, with `causes` on."""
        seen = self.seen[index]
        body = self._path.avatars[seen.folder].body
        level = self._levels.get(index)
        wanted = causes & {Cause.WEIGHTS, Cause.BLEND, Cause.FLOAT32}
        vertices: F64 = self._once((index, wanted), lambda: body.vertices(seen, level, wanted))
        return vertices

    def clip(self, index: int) -> F64:
        """Return projection @ view (4,4) of the whole picture, for avatar number `index`."""
        return self._path.cast.projection(self.number) @ self.seen[index].view

    def _layers(self, causes: Causes) -> list[RasterLayer]:
        if Cause.CROP not in causes:
            return [self._own_layer(seen, causes) for seen in self.seen.values()]
        cells = self._cells()
        if not cells:
            return []
        light = {network: premultiplied(painted) for network, painted in self._painted(causes).items()}
        return [
            placed(
                light[self._path.network_of(seen)][top : top + height, left : left + width],
                rect,
                self._path.output,
                seen.depth,
            )
            for seen, rect, (top, left, height, width) in cells
        ]

    def _own_layer(self, seen: CastView, causes: Causes) -> RasterLayer:
        """Return the layer of an avatar, painted from a tensor of its own on the picture's grid.

        The plan `full` makes its layers in the same way.
        """
        avatar = self._path.avatars[seen.folder]
        times = fineness(seen.box.shape, avatar.area)
        box = grown(seen.box, BUCKET_STEP * times.denominator)
        height, width = (int(side * times) for side in box.shape)
        projection, view = _rounded(causes, seen.projection, seen.view)
        (clip,) = _rounded(causes, crop_projection(projection, box.within(seen.box)) @ view)
        tensor = self._drawn(seen, clip, (height, width), causes)
        painted = premultiplied(self._paint(avatar, avatar.packed(tensor, causes), causes))
        return RasterLayer(box, seen.depth, enlarged(shrunk(painted, times.numerator), times.denominator))

    def _cells(self) -> list[tuple[CastView, Rect, Cell]]:
        """Return (avatar, crop rectangle, cell) for each avatar in the run's tensors; empty if the run draws no tensor.

        A cell is (top, left, height, width) in the tensor, pixels.
        """
        if int(self._header["work"]) != FrameWork.FULL:
            return []
        visible = [row for row in self._header["avatars"] if row["visible"] and int(row["avatar"]) in self.seen]
        return [(self.seen[int(row["avatar"])], Rect(*map(float, row["rect"])), _cell(row)) for row in visible]

    def _painted(self, causes: Causes) -> dict[int, F32]:
        """Return the picture (h,w,4) that each network paints from the run's tensor, by network number.

        `causes`: causes that are on.
        """
        avatars = {self._path.network_of(seen): self._path.avatars[seen.folder] for seen, _, _ in self._cells()}
        return {
            network: self._paint(avatar, self._tensor(network, avatar, causes), causes)
            for network, avatar in avatars.items()
        }

    def _tensor(self, network: int, avatar: _Avatar, causes: Causes) -> F64:
        """Return the tensor (h,w,C) of network number `network` in real numbers, with the run's shape and crops.

        `avatar`: any avatar that this network paints. `causes`: causes that are on.
        """
        if Cause.RASTER in causes:
            drawn = self._once(("drawn", network), lambda: self._path.frames.tensor_of(self.number, network))
            return avatar.real(drawn)
        height, width = self._header["tensor_shape"].tolist()
        tensor = np.zeros((height, width, avatar.texture.shape[2]))
        for seen, rect, (top, left, high, wide) in self._cells():
            if self._path.network_of(seen) != network:
                continue
            projection, view = _rounded(causes, self._path.cast.projection(self.number), seen.view)
            (clip,) = _rounded(causes, crop_projection(projection, rect) @ view)
            tensor[top : top + high, left : left + wide] = self._drawn(seen, clip, (high, wide), causes)
        return avatar.packed(tensor, causes)

    def _drawn(self, seen: CastView, clip: F64, shape: Shape, causes: Causes) -> F64:
        """Return a tensor (h,w,C) float64 of one avatar, drawn by the float64 rasteriser.

        `seen`: the avatar. `clip`: projection @ view (4,4). `shape`: (height, width) of the tensor. `causes`: causes
        that are on.
        """
        avatar = self._path.avatars[seen.folder]
        vertices, texture = self.vertices(seen.index, causes), avatar.texture
        if Cause.FLOAT16 in causes:
            texture = texture.astype(np.float16).astype(np.float32)
        samples = 1 if Cause.READS in causes else SAMPLES
        key = _digest(vertices, clip, texture), shape, samples
        drawn: F64 = self._once(key, lambda: supersampled(vertices, avatar.mesh, clip, shape, texture, samples))
        return drawn

    def _paint(self, avatar: _Avatar, tensor: F64, causes: Causes) -> F32:
        paint = avatar.paint
        if Cause.RUNTIME in causes:
            paint = avatar.by_runtime
        elif Cause.QUANTISATION in causes:
            paint = avatar.as_written
        painted: F32 = self._once((paint, _digest(tensor)), lambda: paint(tensor))
        return painted

    def _composited(self, causes: Causes) -> F64:
        """Return the frame (h,w,3) in 0..1 as the composite stage makes it from the networks' pictures in bytes.

        If the run draws no tensor, return the run's own picture.
        """
        if not self._cells():
            return self.own
        painted = {one: np.asarray(np.rint(made * 255), np.uint8) for one, made in self._painted(causes).items()}
        key = _digest(*painted.values())
        composited: F64 = self._once(key, lambda: self._path.frames.composited(self.number, painted) / 255.0)
        return composited

    def _once(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """Return the result of `make`, which is called once for each `key`.

        A cause that changes no input of `make` leaves the key the same, so nothing is computed again.
        """
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]


@dataclass(frozen=True)
class _Avatar:
    """One distinct avatar.

    `body`: body that computes vertices. `mesh`: triangles and texture coordinates. `texture`: neural texture (H,W,C).
    `encoding`: scale and zero point of the tensor's bytes. `area`: pixels of the tensor of its network's own size.
    `paint`, `as_written`, `by_runtime`: functions from a tensor of real numbers to the network's picture. They compute
    the network in FP32, in integers as its file says, and in integers on the run's runtime. `network`: name of the
    network that `paint` computes.
    """

    body: RunBody
    mesh: MeshArrays
    texture: F32
    encoding: Affine
    area: int
    paint: Paint
    network: str
    as_written: Paint
    by_runtime: Paint

    def packed(self, tensor: F64, causes: Causes) -> F64:
        """Return `tensor` (h,w,C). If packing is on, round and clamp its values to values that bytes represent."""
        if Cause.PACKING not in causes:
            return tensor
        return self.real(quantise(tensor, self.encoding.scale, self.encoding.zero_point))

    def real(self, tensor: U8) -> F64:
        """Return the real numbers, float64, that the bytes of `tensor` represent."""
        return (tensor.astype(np.float64) - self.encoding.zero_point) * self.encoding.scale


def _avatar(data: AvatarData, runtime: str, on_cpu: bool) -> _Avatar:
    paint, network = float_network(data.bundle)
    entry = data.bundle.manifest.network.input
    _, height, width, _ = data.network.shape
    return _Avatar(
        body=RunBody(data, on_cpu=on_cpu),
        mesh=avatar_mesh(data.shaped),
        texture=data.texture,
        encoding=Affine(entry.scale, entry.zero_point),
        area=height * width,
        paint=paint,
        network=network,
        as_written=as_written(data.network),
        by_runtime=_by_runtime(data.network, runtime),
    )


def _by_runtime(network: NetworkFile, name: str) -> Paint:
    """Return a function that computes `network` on the runtime `name`.

    The function takes a tensor (h,w,C) of real numbers that bytes can represent, and returns the picture (h,w,4) in
    0..1.
    """
    bound: dict[Shape, tuple[U8, U8, Binding]] = {}

    def paint(tensor: F64) -> F32:
        shape = (tensor.shape[0], tensor.shape[1])
        if shape not in bound:
            slots = np.empty((1, *tensor.shape), np.uint8), np.empty((1, *shape, 4), np.uint8)
            session = load_runtime(name).load(reshaped(network, *shape), RuntimeOptions(threads=1))
            bound[shape] = (*slots, session.bind(slots[:1], slots[1:]))
        slot_in, slot_out, binding = bound[shape]
        slot_in[0] = quantise(tensor, network.input.scale, network.input.zero_point)
        binding.run()
        return np.asarray(slot_out[0] / np.float32(255))

    return paint


def _rounded(causes: Causes, *matrices: F64) -> list[F64]:
    """Return `matrices`, rounded to float32 if `Cause.FLOAT32` is on."""
    if Cause.FLOAT32 not in causes:
        return list(matrices)
    return [matrix.astype(np.float32).astype(np.float64) for matrix in matrices]


def _cell(avatar: NDArray[np.void]) -> Cell:
    top, left, height, width = (int(side) for side in avatar["tensor_rect"])
    return top, left, height, width


def _digest(*arrays: NDArray[Any]) -> bytes:
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).digest()
