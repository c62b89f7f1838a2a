"""The picture of the plan `full`: everything is modelled, nothing is spared. Other plans are compared with it.

Rule: it is a second, slow implementation where that is possible. The body has every weight and every blend shape in
float64. The neural texture is read at SAMPLES x SAMPLES points of a tensor pixel, whose mean is not rounded. Each
avatar has a tensor of its own, of about the area that its network is for, where it paints best. The tensor lies on the
picture's grid, so that a square of pixels of one is a pixel of the other. The network is in FP32; its picture is
blended in linear light, in float64, over the run's own background.

Beside it stands the picture with the clothed body itself, drawn as training draws its samples. An avatar's network was
trained to paint that picture, so it shows how good every plan's picture is, including `full`. Only the bundled avatars
have one. Clothes are put on the skin, not on an avatar's offsets, which are these clothes already.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import isqrt
from typing import Any

import numpy as np

from trilane.arrays import BUCKET_STEP, F32, F64, U8, Shape
from trilane.avatars.bundle import BUILT_IN, bundle_folder
from trilane.bench.lib import float_raster
from trilane.bench.lib.cast import Cast, CastView
from trilane.bench.lib.full_network import Paint, float_network
from trilane.bench.lib.layers import RasterLayer, blended, enlarged, grown, premultiplied, shrunk
from trilane.body.body import Body
from trilane.body.joints import JOINTS, rodrigues
from trilane.scene.crop import crop_projection
from trilane.stages.avatar_assets import AvatarData
from trilane.stages.gpu.skinned_mesh import MeshArrays, avatar_mesh
from trilane.training.clothing.clothed_body import ClothedBody
from trilane.training.clothing.layers import clothing_layers
from trilane.training.clothing.looks import find_landmarks, look_of
from trilane.training.surface import body_arrays

#: Number of points along each side of a tensor pixel at which the neural texture is read.
SAMPLES = 4
#: Number of samples of the clothed body along each side of a pixel.
CLOTHED_SAMPLES = 4


class FullBody:
    """The body in float64 with every blend shape and skin weight, joint by joint as the SMPL-X layout defines it.

    `rest` (V,3): rest shape, metres.
    `joints` (55,3): joints of the rest shape, metres.
    """

    def __init__(self, body: Body, betas: Sequence[float] = (), expression: Sequence[float] = ()) -> None:
        """Return the shape `body` by `betas` and `expression`; missing coefficients are 0."""
        self._body = body
        self._weights = body.weights.astype(np.float64)
        self.rest = body.v_template.astype(np.float64)
        for directions, values in ((body.shape_dirs, betas), (body.expression_dirs, expression)):
            self.rest = self.rest + directions[:, :, : len(values)].astype(np.float64) @ np.array(values, np.float64)
        self.joints = body.j_regressor.astype(np.float64) @ self.rest
        if body.offsets is not None:
            self.rest = self.rest + body.offsets

    def vertices(self, pose: F64, translation: F64, world: F64) -> F64:
        """Return the vertices (V,3) in the world, metres.

        `pose`: axis-angle (55,3), radians.
        `translation`: translation (3,) of the root in body space, metres.
        `world`: matrix (4,4) from body space to the world.
        """
        turns = rodrigues(np.asarray(pose, np.float64).reshape(JOINTS, 3))
        rest = self.rest
        if self._body.posedirs is not None:
            rest = rest + self._body.posedirs.astype(np.float64) @ (turns[1:] - np.eye(3)).reshape(-1)
        placed = self._placed(turns, np.asarray(translation, np.float64), np.asarray(world, np.float64))
        moved = np.einsum("vj,jab->vab", self._weights, placed)
        return np.asarray(np.einsum("vab,vb->va", moved[:, :, :3], rest) + moved[:, :, 3])

    def _placed(self, turns: F64, translation: F64, world: F64) -> F64:
        """Return matrices (55,3,4) from the rest shape to the world, for what each joint moves."""
        placed: dict[int, F64] = {}

        def place(joint: int) -> F64:
            """Return the matrix (4,4) of `joint`: its parent's, a shift to the joint, the turn, and a shift back."""
            if joint not in placed:
                parent = int(self._body.parents[joint])
                above = world @ _shift(translation) if parent < 0 else place(parent)
                turn = np.eye(4)
                turn[:3, :3] = turns[joint]
                at = self.joints[joint]
                placed[joint] = above @ _shift(at) @ turn @ _shift(-at)
            return placed[joint]

        return np.stack([place(joint)[:3] for joint in range(JOINTS)])


def _shift(by: F64) -> F64:
    matrix = np.eye(4)
    matrix[:3, 3] = by
    return matrix


@dataclass(frozen=True)
class _Avatar:
    """One distinct avatar.

    `area`: pixels of the tensor that its network is for. `network`: source of the network, for people.
    """

    body: FullBody
    mesh: MeshArrays
    texture: F32
    paint: Paint
    area: int
    network: str


class FullPictures:
    """Makes pictures of a scene's cast by the plan `full`."""

    def __init__(self, cast: Cast) -> None:
        """Load the networks. Raises BadInputError, MissingPartError."""
        self._cast = cast
        self._avatars = {folder: _avatar(data) for folder, data in cast.avatars.items()}

    @property
    def networks(self) -> list[str]:
        """Sources of the networks that paint the avatars."""
        return sorted({avatar.network for avatar in self._avatars.values()})

    def frame(self, number: int, background: U8) -> U8:
        """Return frame `number` over its `background` (h,w,3): (h,w,3) uint8, sRGB."""
        return blended(background, [self._layer(seen) for seen in self._cast.seen(number)])

    def _layer(self, seen: CastView) -> RasterLayer:
        avatar = self._avatars[seen.folder]
        times = fineness(seen.box.shape, avatar.area)
        box = grown(seen.box, BUCKET_STEP * times.denominator)
        height, width = (int(side * times) for side in box.shape)
        vertices = avatar.body.vertices(seen.pose, seen.translation, seen.world)
        clip = crop_projection(seen.projection, box.within(seen.box)) @ seen.view
        tensor = supersampled(vertices, avatar.mesh, clip, (height, width), avatar.texture)
        painted = premultiplied(avatar.paint(tensor))
        return RasterLayer(box, seen.depth, enlarged(shrunk(painted, times.numerator), times.denominator))


def fineness(shape: Shape, area: int) -> Fraction:
    """Return the tensor pixels for each pixel of the picture along a side: ..., 1/3, 1/2, 1, 2, 3, ...

    The value brings a box of `shape` (height, width) nearest to `area` pixels, in ratio.
    """
    own = shape[0] * shape[1]
    larger, smaller = max(own, area), min(own, area)
    times = isqrt(larger // smaller)
    # The nearer, in ratio, of the two whole numbers about the root is the larger one beyond their geometric mean.
    times += larger > smaller * times * (times + 1)
    return Fraction(times) if area > own else Fraction(1, times)


def _avatar(data: AvatarData) -> _Avatar:
    manifest, body = data.bundle.manifest, data.shaped.body
    paint, network = float_network(data.bundle)
    _, height, width, _ = data.network.shape
    full = FullBody(body, manifest.betas, manifest.expression)
    return _Avatar(full, avatar_mesh(data.shaped), data.texture, paint, height * width, network)


def supersampled(vertices: F64, mesh: MeshArrays, clip: F64, shape: Shape, texture: F32, samples: int = SAMPLES) -> F64:
    """Return the network's input as real numbers, (h,w,C) float64.

    Each is the mean of `samples` x `samples` reads, 0 off the mesh.

    `vertices`: vertices (V,3) of the body, in the world, metres.
    `mesh`: its triangles and texture coordinates.
    `clip`: projection of the tensor @ view, (4,4).
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


class TruePictures:
    """Makes pictures of a cast of bundled avatars as the clothed bodies that they were trained on."""

    def __init__(self, cast: Cast, ctx: Any) -> None:
        """Prepare the clothed bodies. Everybody in the cast must be a bundled avatar.

        `ctx`: OpenGL context in use.
        """
        self._cast = cast
        self._clothed = {folder: _clothed(data, ctx) for folder, data in cast.avatars.items()}

    def frame(self, number: int, background: U8) -> U8:
        """Return frame `number` over its `background` (h,w,3): (h,w,3) uint8, sRGB."""
        return blended(background, self.layers(number))

    def layers(self, number: int) -> list[RasterLayer]:
        """Return the layers of those who are seen in frame `number`, on the picture's grid."""
        layers = []
        for seen in self._cast.seen(number):
            rgba = self._clothed[seen.folder].render(seen.joints, seen.view, seen.projection, seen.box.shape) / 255.0
            layers.append(RasterLayer(seen.box, seen.depth, premultiplied(rgba)))
        return layers


def true_pictures(cast: Cast, ctx: Any) -> TruePictures | None:
    """Return the true pictures of `cast`; None unless everybody in it is a bundled avatar.

    `ctx`: OpenGL context in use.
    """
    is_known = set(cast.avatars) <= {bundle_folder(name).absolute() for name in BUILT_IN}
    return TruePictures(cast, ctx) if is_known else None


def _clothed(data: AvatarData, ctx: Any) -> ClothedBody:
    arrays, look = body_arrays(data.shaped.bare()), look_of(data.bundle.manifest.provenance)
    landmarks = find_landmarks(arrays.vertices, arrays.joints, arrays.weights)
    return ClothedBody(ctx, clothing_layers(arrays, landmarks, look), landmarks, CLOTHED_SAMPLES, look)
