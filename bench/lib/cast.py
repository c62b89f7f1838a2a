"""The avatars in a frame: their places, and the layers of the picture that show them, made without the stages.

Rule: motion, camera and time are as in the pose stage. Therefore a picture shows the same moment as a run's frame.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trilane.arrays import BUCKET_STEP, F32, F64, U8, Floats, Shape, to_code, to_light
from trilane.avatars.bundle import CLOTHES_STANDOFF_M, load_bundle
from trilane.body.joints import Skeleton
from trilane.scene.crop import Rect, crop_projection
from trilane.scene.mover import Mover
from trilane.stages.avatar_assets import AvatarData, load_avatar, staged_of
from trilane.stages.configure import Checked
from trilane.stages.cpu.mesh_bounds import MeshBounds
from trilane.stages.gpu.composite_painters import taps_of


@dataclass(frozen=True)
class CastView:
    """One visible avatar in one frame.

    `index`: number of the avatar in the scene. `folder`: folder of the avatar's bundle.
    `pose` (55,3): axis-angle vectors, radians. `translation` (3,): translation of the root in the body's space, metres.
    `world`: matrix (4,4) from the body's space to the world.
    `joints`: skinning matrices (55,3,4), as the pose stage computes them.
    `box`: rectangle of the picture around the avatar and its clothes; it may reach beyond the picture.
    `depth`: z of the pelvis in the camera's space, metres; negative in front of the camera.
    `view`: view matrix (4,4). `projection`: matrix (4,4) of the projection to the box.
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
    """The avatars and the camera of a scene; says which avatars a frame shows, and where.

    `avatars`: loaded avatars, by the folder of the bundle.
    """

    def __init__(self, checked: Checked) -> None:
        """Load the avatars. `checked`: run of the scene. Raises BadInputError if an avatar cannot be read."""
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
            _Actor(index, folder, mover, data, Skeleton(data.shaped.joints, data.shaped.body.parents), bounds[folder])
            for index, (folder, mover) in enumerate(zip(folders, staged.movers, strict=True))
            for data in [self.avatars[folder]]
        ]

    def seen(self, frame: int) -> list[CastView]:
        """Return the visible avatars in frame number `frame`."""
        t_s = frame / self._fps
        view, whole = self._camera.sample(t_s), self.projection(frame)
        found = (self._seen(actor, t_s, view, whole) for actor in self._actors)
        return [seen for seen in found if seen is not None]

    def boxes(self, frame: int) -> list[Box]:
        """Return the box of each visible avatar in frame number `frame`, clipped to the picture."""
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


# Layers of a picture, blended in linear light in float64: a second implementation of the composite.
#
# Rule: a layer lies on the pixel grid of the picture and may reach beyond its edges. `placed` resamples a picture that
# is off the grid.


class Box(NamedTuple):
    """A rectangle of a picture, pixels: rows `top` to `bottom` - 1, columns `left` to `right` - 1."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def shape(self) -> Shape:
        return self.bottom - self.top, self.right - self.left

    def rect(self, output: Shape) -> Rect:
        """Return the box in normalised device coordinates of a picture. `output`: (height, width) of the picture."""
        across, down = 2.0 / output[1], 2.0 / output[0]
        return Rect(self.left * across - 1, 1 - self.bottom * down, self.right * across - 1, 1 - self.top * down)

    def within(self, other: Box) -> Rect:
        """Return the box in the normalised device coordinates of a screen that shows exactly the box `other`."""
        moved = Box(self.top - other.top, self.left - other.left, self.bottom - other.top, self.right - other.left)
        return moved.rect(other.shape)

    def on(self, output: Shape) -> Box:
        """Return the part of the box that lies on a picture. `output`: (height, width) of the picture."""
        return Box(max(self.top, 0), max(self.left, 0), min(self.bottom, output[0]), min(self.right, output[1]))


@dataclass(frozen=True)
class RasterLayer:
    """A layer of a picture.

    `box`: pixels of the picture that the layer covers. `depth`: as in `CastView`, least for the farthest layer.
    `light`: array (h,w,4) in 0..1: linear light of three colours times alpha, and alpha.
    """

    box: Box
    depth: float
    light: F64


def box_around(rect: Rect, output: Shape) -> Box:
    """Return the smallest box of whole pixels around `rect`, grown until both sides are multiples of 32.

    `rect`: rectangle in normalised device coordinates. `output`: (height, width) of the picture.
    """
    top, bottom = np.floor((1 - rect.y1) / 2 * output[0]), np.ceil((1 - rect.y0) / 2 * output[0])
    left, right = np.floor((1 + rect.x0) / 2 * output[1]), np.ceil((1 + rect.x1) / 2 * output[1])
    return grown(Box(int(top), int(left), int(bottom), int(right)), BUCKET_STEP)


def grown(box: Box, step: int) -> Box:
    """Return `box`, grown evenly until both sides are multiples of `step` pixels.

    If an odd number of rows is added, the bottom gets one row more than the top. If an odd number of columns is added,
    the right side gets one column more than the left side.
    """
    rows, columns = _grown(box.top, box.bottom, step), _grown(box.left, box.right, step)
    return Box(rows[0], columns[0], rows[1], columns[1])


def _grown(first: int, last: int, step: int) -> tuple[int, int]:
    more = -(last - first) % step
    return first - more // 2, last + more - more // 2


def premultiplied(rgba: Floats) -> F64:
    """Return an array (h,w,4): linear light times alpha, and alpha. `rgba`: (h,w,4) sRGB with straight alpha, 0..1."""
    straight = np.asarray(rgba, np.float64)
    alpha = straight[..., 3:]
    return np.concatenate([to_light(straight[..., :3]) * alpha, alpha], axis=-1)


def shrunk(light: F64, factor: int) -> F64:
    """Return an array (h,w,C) with the means over squares of `factor` x `factor` pixels.

    `light`: array (h * factor, w * factor, C).
    """
    height, width, channels = light.shape
    squares = light.reshape(height // factor, factor, width // factor, factor, channels)
    return np.asarray(squares.mean(axis=(1, 3)))


def enlarged(light: F64, factor: int) -> F64:
    """Return `light` (h,w,C), enlarged bilinearly to (h * factor, w * factor, C).

    The outer borders of both pictures coincide. Beyond the centres of the outermost pixels of `light`, their values are
    repeated.
    """
    return _enlarged_down(_enlarged_down(light, factor).swapaxes(0, 1), factor).swapaxes(0, 1)


def _enlarged_down(light: F64, factor: int) -> F64:
    places = np.clip((np.arange(len(light) * factor) + 0.5) / factor - 0.5, 0, len(light) - 1)
    above = np.floor(places).astype(int)
    below = np.minimum(above + 1, len(light) - 1)
    share = (places - above)[:, None, None]
    return np.asarray((1 - share) * light[above] + share * light[below])


def placed(light: F64, rect: Rect, output: Shape, depth: float) -> RasterLayer:
    """Return a layer with the picture `light`, resampled at the pixels of the whole picture.

    Each pixel whose centre lies in `rect` is the mean of bilinear reads, which are evenly spread over the pixel. The
    number of reads is the same as in the composite stage. Beyond the centres of the outermost pixels of `light`, their
    values are repeated.
    `light`: array (h,w,4) that fills `rect`. `rect`: rectangle in normalised device coordinates. `output`: (height,
    width) of the whole picture. `depth`: depth of the layer.
    """
    top, bottom = (1 - rect.y1) / 2 * output[0], (1 - rect.y0) / 2 * output[0]
    left, right = (1 + rect.x0) / 2 * output[1], (1 + rect.x1) / 2 * output[1]
    height, width = light.shape[:2]
    taps = taps_of((height, width), (bottom - top, right - left))
    first_row, rows = _reads(top, bottom, height, output[0], taps)
    first_column, columns = _reads(left, right, width, output[1], taps)
    box = Box(first_row, first_column, first_row + len(rows), first_column + len(columns))
    across = np.einsum("xw,hwc->hxc", columns, light, optimize=True)
    return RasterLayer(box, depth, np.asarray(np.einsum("yh,hxc->yxc", rows, across, optimize=True)))


def _reads(begin: float, end: float, count: int, side: int, taps: int) -> tuple[int, F64]:
    """Return (first, weights): how a layer is resampled along one axis of a picture.

    The n pixels of the picture with centres in [begin, end) get values; `first` is the number of the first of them. Row
    k of `weights` (n, count) has the weights of the layer's pixels for pixel `first` + k of the picture.
    `count`: pixels of the layer. `side`: pixels of the picture. `taps`: reads for a pixel of the picture.
    """
    first, last = (min(max(int(np.ceil(place - 0.5)), 0), side) for place in (begin, end))
    middles = np.arange(first, last)[:, None] + 0.5
    offsets = (np.arange(taps) + 0.5) / taps - 0.5
    places = np.clip((middles + offsets - begin) / (end - begin) * count - 0.5, 0, count - 1)
    lower = np.floor(places).astype(int)
    upper, share = np.minimum(lower + 1, count - 1), places - lower
    weights = np.zeros((last - first, count))
    pixel = np.broadcast_to(np.arange(last - first)[:, None], places.shape)
    np.add.at(weights, (pixel, lower), (1 - share) / taps)
    np.add.at(weights, (pixel, upper), share / taps)
    return first, weights


def blended(background: U8, layers: Iterable[RasterLayer]) -> U8:
    """Return a picture (h,w,3) uint8 sRGB: the `layers` over `background`, blended from the farthest to the nearest.

    `background`: picture (h,w,3) uint8 sRGB.
    """
    return np.asarray(np.rint(laid_over(background, layers)[0] * 255), np.uint8)


def laid_over(background: U8, layers: Iterable[RasterLayer]) -> tuple[F64, F64]:
    """Return (picture, cover): the result of `blended` before rounding, and how much the layers cover each pixel.

    The picture is (h,w,3) sRGB in 0..1. The cover is (h,w), from 0, only background, to 1, no background.
    """
    output = (background.shape[0], background.shape[1])
    light, seen_through = to_light(background / 255.0), np.ones(output)
    for layer in sorted(layers, key=lambda layer: layer.depth):
        box = layer.box.on(output)
        own = layer.light[box.top - layer.box.top :, box.left - layer.box.left :][: box.shape[0], : box.shape[1]]
        part = np.s_[box.top : box.bottom, box.left : box.right]
        light[part] = own[..., :3] + (1 - own[..., 3:]) * light[part]
        seen_through[part] *= 1 - own[..., 3]
    return to_code(light), 1 - seen_through
