"""Renders training samples of the default body: the UV image of the body, and a picture of the clothed body.

Rule: crop, tensor shape and rasterisation are the same as in the pipeline. A sample depends only on its seed. No near
plane cuts the body or its clothes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F32, F64, U8, Floats, Shape
from trilane.body.body import ShapedBody
from trilane.body.joints import Skeleton
from trilane.body.skinning import largest_weights
from trilane.stages.gpu.opengl import build_program, eye_of, open_context, set_uniforms
from trilane.stages.gpu.raster import Placement
from trilane.stages.gpu.skinned_mesh import BodyPose, MeshDraw, SkinnedMesh, enough_weights, mesh_arrays
from trilane.training import clothing as joint
from trilane.training.clothing import DEFAULT, MATERIALS, Landmarks, Layer, Look, clothing_layers, find_landmarks
from trilane.training.random_views import BANDS, ClothedSurface, Crop, Cropper, View, random_pose, random_view
from trilane.training.surface import body_arrays

BAND_NAMES = tuple(BANDS)
ANYWHERE_BAND = len(BAND_NAMES)
LEAST_PIXELS = 200
PoseSource = Callable[[np.random.Generator], F64]


@dataclass(frozen=True)
class Sample:
    """A planned sample of the synthetic person.

    `pose`: axis-angle (55,3), radians. `view`: camera of the whole screen. `crop`: part of the screen that the tensor
    shows. `band`: an index into BAND_NAMES, or ANYWHERE_BAND.
    """

    pose: F64
    view: View
    crop: Crop
    band: int
    picture: int = 0  # number of a capture's frame, see `Planned`; the synthetic person has no frames


class SampleRenderer:
    """Plans and renders samples of one body, with an OpenGL context of its own."""

    def __init__(self, shaped: ShapedBody, threads: int | None = None, samples: int = 2, look: Look = DEFAULT) -> None:
        """Put clothes on the body and open the context.

        `shaped`: body. The UV image is drawn with the body's offsets, if any; clothes are put on the skin.
        `threads`: number of threads of a software OpenGL driver; None for the driver's default.
        `samples`: number of samples of the ground truth along each side of a pixel, even.
        `look`: clothes and colours. Its shape coefficients are not used: `shaped` has a shape already.
        Raises MissingPartError without OpenGL.
        """
        body = shaped.body
        arrays = body_arrays(shaped.bare())
        top = largest_weights(body.weights, enough_weights(body))
        mesh = mesh_arrays(shaped.vertices, body.faces, body.uv, body.uv_faces, top.joints, top.weights)
        landmarks = find_landmarks(arrays.vertices, arrays.joints, arrays.weights)
        self.skeleton = Skeleton(shaped.joints, body.parents)
        self.cropper = Cropper(shaped)
        self.ctx = open_context(threads)
        self.mesh = SkinnedMesh(self.ctx, mesh)
        self._uv = UvRaster(self.ctx, self.mesh)
        layers = clothing_layers(arrays, landmarks, look)
        self.surface = ClothedSurface(layers)
        self.clothed_body = ClothedBody(self.ctx, layers, landmarks, samples, look)

    def plan(self, seed: Sequence[int], source: PoseSource, band: str, size: str | float) -> Sample:
        """Return the planned sample of `seed`: a pose, and the first random view that is usable.

        A view is usable if enough of the body is on the screen and the near plane cuts nothing.

        `seed`: numbers that seed the random generator.
        `source`: function that returns a pose from the random generator.
        `band`: a name of BANDS, or `anywhere`.
        `size`: tensor size, as `shape_buckets` takes it, or density, as `Cropper.crop_of` takes it.
        """
        rng = np.random.default_rng(seed)
        pose = source(rng)
        posed = self.skeleton.pose(pose)
        points = self.surface.posed(posed)
        while True:
            view = random_view(rng, band, posed.joints)
            if not self.surface.is_clear_of(view, points):
                continue
            crop = self.cropper.crop_of(posed, view, size)
            if crop is not None and crop.pixels >= LEAST_PIXELS:
                return Sample(pose, view, crop, BAND_NAMES.index(band) if band in BANDS else ANYWHERE_BAND)

    def training_sample(self, seed: Sequence[int], band: str, density: float) -> Sample:
        """Return the planned sample of `seed` in a random pose, see `plan`."""
        return self.plan(seed, random_pose, band, density)

    def crop(self, sample: Sample, buckets: Sequence[Shape]) -> Crop:
        """Return the crop of `sample` in one of the tensor shapes `buckets`."""
        crop = self.cropper.crop(self.skeleton.pose(sample.pose), sample.view, buckets)
        assert crop is not None  # a planned sample is seen
        return crop

    def placed(self, sample: Sample) -> tuple[F64, Placement]:
        """Return the view matrix (4,4) of `sample`, and the placement of its body for the GPU unit's packed pass.

        The placement is valid until the next call that poses the body.
        """
        joints, crop = self.skeleton.pose(sample.pose).matrices, sample.crop
        return sample.view.view, Placement(joints, crop.projection, (0, 0, *crop.shape))

    def render(self, sample: Sample) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Return the UV image (h,w,3) float32 (u, v, coverage) and the ground truth (h,w,4) uint8, straight alpha."""
        joints = self.skeleton.pose(sample.pose).matrices
        crop = sample.crop
        uv = self._uv.render(joints, sample.view.view, crop.projection, crop.shape)
        rgba = self.clothed_body.render(joints, sample.view.view, crop.projection, crop.shape)
        return uv, rgba


# The UV image of a skinned mesh: u and v of every pixel, as float32 or as bytes.
#
# Rule: vertices, rasterisation and pixel centres are the same as in the GPU unit's packed pass, without antialiasing.


class _MeshTarget:
    """Draws a mesh with one fragment shader into framebuffers; keeps a framebuffer for each picture shape."""

    def __init__(self, ctx: Any, mesh: SkinnedMesh, fragment: str, components: int, dtype: str) -> None:
        self._ctx, self._mesh = ctx, mesh
        self._draw = MeshDraw(ctx, mesh, fragment)
        self._components, self._dtype = components, dtype
        self._targets: dict[tuple[int, int], Any] = {}

    def draw(self, pose: BodyPose, view: Floats, projection: Floats, shape: tuple[int, int]) -> Any:
        """Draw the mesh and return the framebuffer of `shape`; pixels off the mesh are 0."""
        target = self._target(shape)
        target.use()
        self._mesh.prepare(self._ctx)
        target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        self._draw.draw(pose, view, projection)
        return target

    def _target(self, shape: tuple[int, int]) -> Any:
        if shape not in self._targets:
            size = (shape[1], shape[0])
            colour = self._ctx.texture(size, self._components, dtype=self._dtype)
            self._targets[shape] = self._ctx.framebuffer([colour], self._ctx.depth_renderbuffer(size))
        return self._targets[shape]


class UvRaster:
    """Draws a mesh into float32 UV images."""

    def __init__(self, ctx: Any, mesh: SkinnedMesh) -> None:
        self._target = _MeshTarget(ctx, mesh, "uv_and_coverage.frag", 4, "f4")

    def render(
        self, joints: F32, view: Floats, projection: Floats, shape: tuple[int, int], feature: F32 | None = None
    ) -> F32:
        """Return the UV image (h,w,3) float32 (u, v, coverage), row 0 on top.

        Coverage is 1 on the mesh; pixels off the mesh are 0, 0, 0.

        `joints`: skinning matrices (55,3,4).
        `view`, `projection`: matrices (4,4) of the camera; for a crop, the crop's projection.
        `shape`: (height, width) of the image.
        `feature`: factors (486,) of pose blend shapes; None if the mesh has none.
        """
        pixels = np.empty((*shape, 4), np.float32)
        target = self._target.draw(BodyPose(joints, feature), view, projection, shape)
        target.read_into(pixels, components=4, dtype="f4", alignment=1)
        return pixels[..., :3]


class UvBytes:
    """Draws a mesh into UV images of two bytes a pixel, for networks whose input is UV coordinates without texture."""

    def __init__(self, ctx: Any, mesh: SkinnedMesh) -> None:
        self._target = _MeshTarget(ctx, mesh, "uv_only.frag", 2, "f1")

    def render_into(self, tensor: U8, joints: F32, view: Floats, projection: Floats, shape: tuple[int, int]) -> None:
        """Write round(255 u) and round(255 v) of every pixel, row 0 on top; 0 off the mesh.

        `tensor`: (h * w * 2,) uint8, written as (h, w, 2).
        `joints`: skinning matrices (55,3,4).
        `view`, `projection`: matrices (4,4) of the camera; for a crop, the crop's projection.
        `shape`: (height, width) of the image.
        """
        target = self._target.draw(BodyPose(joints), view, projection, shape)
        target.read_into(tensor, components=2, alignment=1)


# The clothed body on the GPU: all layers, painted by `paint.frag`.
#
# Rule: the layers are drawn by `MeshDraw` of the GPU stages. The shader writes linear light; samples are averaged in
# linear light, then encoded as sRGB.

WEIGHTS_PER_VERTEX = 8
PAINT = Path(__file__).with_name("paint.frag")


class ClothedBody:
    """Draws the layers of a clothed body."""

    def __init__(self, ctx: Any, layers: list[Layer], landmarks: Landmarks, samples: int, look: Look = DEFAULT) -> None:
        """Upload the layers to the GPU.

        `ctx`: OpenGL context.
        `layers`: layers from `clothing_layers`.
        `landmarks`: landmarks of the body at rest.
        `samples`: number of samples along each side of a pixel (2 is 2x2), even.
        `look`: look of the layers.
        """
        self._ctx, self._samples = ctx, samples
        self._meshes = [MeshDraw(ctx, _mesh(ctx, layer), PAINT, **look.definitions(landmarks)) for layer in layers]
        for layer, mesh in zip(layers, self._meshes, strict=True):
            mesh.set(_places(landmarks) | {"material": MATERIALS.index(layer.material)})
        self._resolve = build_program(ctx, "whole_screen.vert", "tent_filter.frag", SAMPLES=samples)
        self._screen = ctx.vertex_array(self._resolve, [])
        self._targets: dict[tuple[int, int], tuple[Any, Any, Any]] = {}

    def render(self, joints: F32, view: Floats, projection: Floats, shape: tuple[int, int]) -> U8:
        """Return the picture (h,w,4) uint8, sRGB, straight alpha, row 0 on top; pixels off all layers are 0.

        `joints`: skinning matrices (55,3,4).
        `view`, `projection`: matrices (4,4) of the camera.
        `shape`: (height, width) of the picture.
        """
        large, samples, small = self._target(shape)
        large.use()
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        self._ctx.depth_func = "<"
        large.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        seen_from = {"view": tuple(np.asarray(view, np.float64).T.ravel()), "eye": tuple(eye_of(view))}
        for mesh in self._meshes:
            mesh.set(seen_from)
            mesh.draw(BodyPose(joints), view, projection)
        small.use()
        self._ctx.enable_only(moderngl.NOTHING)
        samples.use(0)
        set_uniforms(self._resolve, {"samples": 0})
        self._screen.render(vertices=3)
        pixels = np.empty((*shape, 4), np.uint8)
        small.read_into(pixels, components=4, alignment=1)
        return pixels

    def _target(self, shape: tuple[int, int]) -> tuple[Any, Any, Any]:
        if shape not in self._targets:
            size = (shape[1] * self._samples, shape[0] * self._samples)
            samples = self._ctx.texture(size, 4, dtype="f2")
            large = self._ctx.framebuffer([samples], self._ctx.depth_renderbuffer(size))
            small = self._ctx.framebuffer([self._ctx.texture(shape[::-1], 4)])
            self._targets[shape] = (large, samples, small)
        return self._targets[shape]


def _mesh(ctx: Any, layer: Layer) -> SkinnedMesh:
    order = np.argsort(-layer.weights, axis=1)[:, :WEIGHTS_PER_VERTEX]
    weight = np.take_along_axis(layer.weights, order, axis=1)
    weight /= weight.sum(axis=1, keepdims=True)
    colour = np.zeros((len(layer.vertices), 4))
    colour[:, 0], colour[:, 1] = layer.light, layer.mark
    no_uv = np.zeros((1, 2))
    return SkinnedMesh(
        ctx,
        mesh_arrays(
            layer.vertices, layer.faces, no_uv, np.zeros_like(layer.faces), order, weight, layer.normal, colour
        ),
    )


def _places(landmarks: Landmarks) -> dict[str, Any]:
    """Return the uniforms of `paint.frag` that hold landmarks, by name."""
    joints = landmarks.joints
    named = {
        "pelvis": joints[joint.PELVIS],
        "hip": joints[joint.HIP],
        "neck": joints[joint.NECK],
        "shoulder": joints[joint.SHOULDER],
        "elbow": joints[joint.ELBOW],
        "ankle": joints[joint.ANKLE],
        "toes": joints[joint.FOOT],
        "eyeball": landmarks.eye,
        "ear": landmarks.ear,
    }
    return {name: tuple(float(x) for x in point) for name, point in named.items()} | {
        "eyeball_radius": landmarks.eye_radius
    }
