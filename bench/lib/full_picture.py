"""The picture of the plan `full`: everything is modelled, nothing is spared. What plans are compared with.

Rule: written a second time, slowly, where it can be. The body has every weight and every blend shape in float64; the
neural texture is read at SAMPLES x SAMPLES points of a tensor pixel, whose mean is not rounded; the tensor lies on the
picture's grid, with a pixel or a square of them for each pixel of the picture; each avatar has a tensor of its own; the
network is in FP32; its picture is blended in linear light, in float64, over the run's own background.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trilane.arrays import F32, F64, U8
from trilane.bench.lib import float_raster
from trilane.bench.lib.cast import Cast, Seen
from trilane.bench.lib.full_body import FullBody
from trilane.bench.lib.full_network import Paint, float_network
from trilane.bench.lib.layers import Layer, blended, premultiplied, shrunk
from trilane.shapes import Shape
from trilane.stages.avatar_assets import AvatarData
from trilane.stages.gpu.avatar_mesh import avatar_mesh
from trilane.stages.gpu.mesh_arrays import MeshArrays

#: Points of a tensor pixel, along each side, at which the neural texture is read.
SAMPLES = 4
#: The tensor is as many times as fine as the picture as its longer side may be without exceeding this: a small body
#: would lose its face at one tensor pixel for each pixel. A body that is larger has one for each.
FINE_SIDE = 512


@dataclass(frozen=True)
class _Avatar:
    """One distinct avatar. `network`: what paints it, for people."""

    body: FullBody
    mesh: MeshArrays
    texture: F32
    paint: Paint
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
        avatar, shape = self._avatars[seen.folder], seen.box.shape
        finer = fineness(shape)
        vertices = avatar.body.vertices(seen.pose, seen.translation, seen.world)
        clip = seen.projection @ seen.view
        tensor = supersampled(vertices, avatar.mesh, clip, (shape[0] * finer, shape[1] * finer), avatar.texture)
        return Layer(seen.box, seen.depth, shrunk(premultiplied(avatar.paint(tensor)), finer))


def fineness(shape: Shape) -> int:
    """Tensor pixels along each side of a pixel of the picture, for a box of `shape` (height, width)."""
    return max(1, FINE_SIDE // max(shape))


def _avatar(data: AvatarData) -> _Avatar:
    manifest, body = data.bundle.manifest, data.shaped.body
    paint, network = float_network(data.bundle)
    full = FullBody(body, manifest.betas, manifest.expression)
    return _Avatar(full, avatar_mesh(data.shaped), data.texture, paint, network)


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
