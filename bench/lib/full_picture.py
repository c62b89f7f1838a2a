"""The picture of the plan `full`: everything is modelled, nothing is spared. What plans are compared with.

Rule: written a second time, slowly, where it can be. The body has every weight and every blend shape in float64; the
neural texture is read at SAMPLES x SAMPLES points of a tensor pixel, whose mean is not rounded; each avatar has a
tensor of its own, of about the area that its network is for, where it paints best; the tensor lies on the picture's
grid, so that a square of pixels of one is a pixel of the other; the network is in FP32; its picture is blended in
linear light, in float64, over the run's own background.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import isqrt

import numpy as np

from trilane.arrays import F32, F64, U8
from trilane.bench.lib import float_raster
from trilane.bench.lib.cast import Cast, Seen
from trilane.bench.lib.full_body import FullBody
from trilane.bench.lib.full_network import Paint, float_network
from trilane.bench.lib.layers import Layer, blended, enlarged, grown, premultiplied, shrunk
from trilane.scene.crop import crop_projection
from trilane.shapes import BUCKET_STEP, Shape
from trilane.stages.avatar_assets import AvatarData
from trilane.stages.gpu.skinned_mesh import MeshArrays, avatar_mesh

#: Points of a tensor pixel, along each side, at which the neural texture is read.
SAMPLES = 4


@dataclass(frozen=True)
class _Avatar:
    """One distinct avatar. `area`: of the tensor that its network is for, in pixels. `network`: it, for people."""

    body: FullBody
    mesh: MeshArrays
    texture: F32
    paint: Paint
    area: int
    network: str


class FullPictures:
    """Pictures of a scene's cast by the plan `full`."""

    def __init__(self, cast: Cast) -> None:
        """Raises BadInputError, MissingPartError."""
        self._cast = cast
        self._avatars = {folder: _avatar(data) for folder, data in cast.avatars.items()}

    @property
    def networks(self) -> list[str]:
        """What paints the avatars."""
        return sorted({avatar.network for avatar in self._avatars.values()})

    def frame(self, number: int, background: U8) -> U8:
        """(h,w,3) uint8, sRGB: frame `number` over its `background` (h,w,3)."""
        return blended(background, [self._layer(seen) for seen in self._cast.seen(number)])

    def _layer(self, seen: Seen) -> Layer:
        avatar = self._avatars[seen.folder]
        times = fineness(seen.box.shape, avatar.area)
        box = grown(seen.box, BUCKET_STEP * times.denominator)
        height, width = (int(side * times) for side in box.shape)
        vertices = avatar.body.vertices(seen.pose, seen.translation, seen.world)
        clip = crop_projection(seen.projection, box.within(seen.box)) @ seen.view
        tensor = supersampled(vertices, avatar.mesh, clip, (height, width), avatar.texture)
        painted = premultiplied(avatar.paint(tensor))
        return Layer(box, seen.depth, enlarged(shrunk(painted, times.numerator), times.denominator))


def fineness(shape: Shape, area: int) -> Fraction:
    """Tensor pixels for each pixel of the picture along a side: ..., 1/3, 1/2, 1, 2, 3, ...

    It is the one that brings a box of `shape` (height, width) nearest to `area` pixels, in ratio.
    """
    own = shape[0] * shape[1]
    larger, smaller = max(own, area), min(own, area)
    times = isqrt(larger // smaller)
    # Of the two whole numbers about the root, in ratio, it is the larger one beyond their geometric mean.
    times += larger > smaller * times * (times + 1)
    return Fraction(times) if area > own else Fraction(1, times)


def _avatar(data: AvatarData) -> _Avatar:
    manifest, body = data.bundle.manifest, data.shaped.body
    paint, network = float_network(data.bundle)
    _, height, width, _ = data.network.shape
    full = FullBody(body, manifest.betas, manifest.expression)
    return _Avatar(full, avatar_mesh(data.shaped), data.texture, paint, height * width, network)


def supersampled(vertices: F64, mesh: MeshArrays, clip: F64, shape: Shape, texture: F32, samples: int = SAMPLES) -> F64:
    """The network's input as real numbers, (h,w,C) float64: means of `samples` x `samples` reads, 0 off the mesh.

    `vertices`: (V,3) of the body, in the world, metres.
    `mesh`: its triangles and texture coordinates.
    `clip`: (4,4), projection of the tensor @ view.
    `shape`: (height, width) of the tensor.
    `texture`: (H,W,C), read bilinearly.
    """
    fine = (shape[0] * samples, shape[1] * samples)
    image = float_raster.rasterise(vertices[mesh.source], mesh.triangles, mesh.uv, clip, fine, mesh.closed)
    neural = texture.astype(np.float64)
    tensor = np.zeros((*shape, texture.shape[2]))
    for row in np.flatnonzero(image.coverage.reshape(shape[0], -1).any(axis=1)):
        band = np.s_[row * samples : (row + 1) * samples]
        covered = image.coverage[band]
        reads = np.zeros((*covered.shape, texture.shape[2]))
        reads[covered] = float_raster.sample(neural, image.uv[band][covered])
        tensor[row] = shrunk(reads, samples)[0]
    return tensor
