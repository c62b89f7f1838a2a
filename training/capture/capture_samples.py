"""Samples of a capture for training: random views of its frames, cropped as the pipeline crops.

A sample is a UV image of the body and a ground truth. Rule: the UV image is drawn with the camera of the random view,
and the ground truth is resampled once from the whole frame. Both are empty outside the frame. A sample depends only on
its seed.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

from trilane.arrays import F32, F64, U8, Mask, Shape, shape_buckets
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINTS, Posed, Skeleton
from trilane.body.skinning import blend_matrices
from trilane.errors import BadInputError
from trilane.scene.lens import Lens
from trilane.stages.gpu.opengl import open_context
from trilane.stages.gpu.raster import Placement
from trilane.stages.gpu.skinned_mesh import BodyPose, SkinnedMesh, avatar_mesh
from trilane.training.capture.capture import Capture, Fit
from trilane.training.random_views import ANYWHERE_M, BANDS, OUTPUT_ROWS, SCREENS, Crop, Cropper, View
from trilane.training.sample_renderer import ANYWHERE_BAND, BAND_NAMES, LEAST_PIXELS, UvRaster
from trilane.training.surface import vertex_areas

#: Number of random views that are tried before an error says that no frame has a usable view.
TRIES = 1000
#: Number of frames that are kept decoded, because successive samples often use the same frame.
KEPT = 4
#: Of this many successive good frames, one is held out of training.
HELD_OUT_EVERY = 10


@dataclass(frozen=True)
class CaptureSample:
    """A planned sample of a capture.

    `picture`: number of the frame.
    `crop`: crop with which the body is drawn.
    `by`: map (3,3) from the frame's pixels to the tensor's pixels; it includes the mirroring.
    `mirrored`: whether the columns of the drawn UV image must be reversed afterwards (`unmirrored`).
    `band`: index into BAND_NAMES, or ANYWHERE_BAND.
    """

    picture: int
    crop: Crop
    by: F64
    mirrored: bool
    band: int


class CaptureRenderer:
    """Plans and renders samples of a capture, with an OpenGL context of its own."""

    def __init__(self, capture: Capture, numbers: Sequence[int], rule: ViewRule, threads: int | None = None) -> None:
        """Open the context.

        `numbers`: numbers of the frames of `capture` that samples may show.
        `rule`: limits of the random views.
        `threads`: number of threads of a software OpenGL driver; None: the driver decides.

        Raises MissingPartError without OpenGL.
        """
        self.capture, self._numbers, self._rule = capture, list(numbers), rule
        self._centres = VertexCentres(capture.shaped)
        self._raster = BodyRaster(capture.shaped, threads)
        self.ctx, self.mesh = self._raster.ctx, self._raster.mesh
        self._cropper = Cropper(capture.shaped, pose_blend=True)
        self._projection, self._lens = capture.file.camera.projection(), capture.file.camera.lens
        self._kept: OrderedDict[int, U8] = OrderedDict()

    def training_sample(self, seed: Sequence[int], band: str, density: float) -> CaptureSample:
        """Return the planned sample of `seed`: the first random view with enough of the body on the screen.

        `band`: a name of BANDS, or `anywhere`. `density`: density of the tensor, as `Cropper.crop_of` takes it.
        Raises BadInputError when `TRIES` random views have too little of the body.
        """
        rng = np.random.default_rng(seed)
        for _ in range(TRIES):
            sample = self._drawn(rng, band, density)
            if sample is not None:
                return sample
        found = f"no view of band {band} in {TRIES} draws"
        raise BadInputError(self.capture.folder, found, "frames that show the whole person")

    def whole_sample(self, number: int, size: str) -> CaptureSample | None:
        """Return a planned sample of a whole frame, cropped to the person; None if the body is not in the frame.

        `number`: number of the frame. `size`: tensor size, as `shape_buckets` takes it.
        """
        capture = self.capture
        posed, view, frame = self._raster.posed(capture.fits[number]), capture.views[number], capture.shape
        crop = self._cropper.crop(posed, View(view, self._projection, frame[1] / frame[0]), shape_buckets(size))
        if crop is None:
            return None
        by = map_between(self._projection, crop.projection, frame, crop.shape)
        return CaptureSample(number, crop, by, False, ANYWHERE_BAND)

    def placed(self, sample: CaptureSample) -> tuple[F64, Placement]:
        """Return (view matrix (4,4), placement of the body for the raster) of a sample that is not mirrored."""
        pose, crop = self._raster.body_pose(self.capture.fits[sample.picture]), sample.crop
        placement = Placement(pose.joints, crop.projection, (0, 0, *crop.shape), pose.feature)
        return self.capture.views[sample.picture], placement

    def _drawn(self, rng: np.random.Generator, band: str, density: float) -> CaptureSample | None:
        number = self._numbers[int(rng.integers(len(self._numbers)))]
        view = self.capture.views[number]
        screen = OUTPUT_ROWS, round(OUTPUT_ROWS * SCREENS[rng.integers(len(SCREENS))])
        posed = self._raster.posed(self.capture.fits[number])
        camera = SampleCamera(view, self._projection, self._lens)
        by = zoomed_view(rng, band, posed, camera, self._centres, self._rule, screen)
        if by is None:
            return None
        upright, mirrored = unmirrored(by, screen)
        projection = augmented_projection(self._projection, upright, camera.shape, screen)
        crop = self._cropper.crop_of(posed, View(view, projection, screen[1] / screen[0]), density)
        if crop is None or crop.pixels < LEAST_PIXELS:
            return None
        whole = map_between(self._projection, crop.projection, camera.shape, crop.shape)
        if mirrored:
            whole = np.array([[-1.0, 0.0, crop.shape[1]], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ whole
        return CaptureSample(number, crop, whole, mirrored, BAND_NAMES.index(band) if band in BANDS else ANYWHERE_BAND)

    def render(self, sample: CaptureSample) -> tuple[F32, U8]:
        """Return (UV image (h,w,3): u, v, coverage; ground truth (h,w,4) uint8, straight alpha)."""
        capture, crop = self.capture, sample.crop
        view = capture.views[sample.picture]
        uv = self._raster.uv(capture.fits[sample.picture], view, crop.projection, crop.shape)
        uv = np.ascontiguousarray(uv[:, ::-1]) if sample.mirrored else uv
        uv[~seen_of_frame(sample.by, capture.shape, crop.shape)] = 0
        return uv, resampled(self._picture(sample.picture), sample.by, crop.shape)

    def _picture(self, number: int) -> U8:
        if number not in self._kept:
            self._kept[number] = self.capture.picture(number)
        self._kept.move_to_end(number)
        if len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return self._kept[number]


def held_out_frames(count: int, bad: Sequence[int]) -> tuple[list[int], list[int]]:
    """Return (numbers of the training frames, numbers of the held-out frames). Every tenth good frame is held out.

    `count`: number of all frames. `bad`: numbers of frames with bad fits, which are in neither list.
    """
    good = [number for number in range(count) if number not in set(bad)]
    held_out = good[HELD_OUT_EVERY // 2 :: HELD_OUT_EVERY]
    return [number for number in good if number not in set(held_out)], held_out


# The body of a capture as the pipeline rasterises it: UV images of its fits.
#
# Rule: the body is drawn with the pipeline's mesh, skinning and raster, and with pose blend shapes if it has any.


class BodyRaster:
    """Draws one shaped body, with an OpenGL context of its own."""

    def __init__(self, shaped: ShapedBody, threads: int | None = None) -> None:
        """Open the context.

        `threads`: number of threads of a software OpenGL driver; None: the driver decides.

        Raises MissingPartError without OpenGL.
        """
        self.ctx = open_context(threads)
        self._blended = shaped.body.posedirs is not None
        self.mesh = SkinnedMesh(self.ctx, avatar_mesh(shaped), shaped.body.posedirs)
        self._raster = UvRaster(self.ctx, self.mesh)
        self.skeleton = Skeleton(shaped.joints, shaped.body.parents)

    def posed(self, fit: Fit) -> Posed:
        """Return the posed body of `fit`; valid until the next call."""
        return self.skeleton.pose(fit.pose, fit.place)

    def body_pose(self, fit: Fit) -> BodyPose:
        """Return the pose of `fit` in the form that the mesh takes; valid until the next call."""
        posed = self.posed(fit)
        return BodyPose(posed.matrices, posed.feature if self._blended else None)

    def uv(self, fit: Fit, view: F64, projection: F64, shape: Shape) -> F32:
        """Return the UV image (h,w,3) of `fit`: u, v, coverage.

        `view`, `projection`: matrices (4,4) of the camera. `shape`: (height, width) of the UV image.
        """
        pose = self.body_pose(fit)
        return self._raster.render(pose.joints, view, projection, shape, pose.feature)

    def uv_of(self, capture: Capture, number: int) -> F32:
        """Return the UV image (h,w,3) of frame `number` of `capture`, with the size of the frame."""
        return self.uv(capture.fits[number], capture.views[number], capture.file.camera.projection(), capture.shape)


# Affine maps from a frame to a tensor's picture, and the same maps applied to the camera: camera-space augmentation.
#
# Rule: a single map, in pixels, resamples the ground truth from its full resolution. The same map, converted to clip
# space, changes the projection that rasterises the body. Therefore picture and body agree for any camera matrix, any
# turn, scale, flip and shift, and any aspect ratio. The body is rasterised for each view and never resampled.
#
# The thesis (section 3.3, formulas 3.18 to 3.20) turns and scales the extrinsics and moves the principal point. This is
# equivalent to the map only for lenses with fx = fy. A map after the projection is exact for every lens.
#
# Pixels: x to the right, y down, from the picture's top left corner; the centre of the first pixel is (0.5, 0.5).

NO_FLIP = (False, False)


@dataclass(frozen=True)
class Augmentation:
    """The geometric changes by which a frame becomes a sample.

    `centre`: point (x, y) of the frame, in pixels, that moves to the middle of the target.
    `turn_rad`: clockwise turn about this point, in radians.
    `scale`: target pixels per frame pixel along (x, y), before the turn.
    `flip`: whether the frame is mirrored before the turn: (left-right, upside-down).
    `shift`: shift (x, y) after the turn, in target pixels.
    """

    centre: tuple[float, float]
    turn_rad: float
    scale: tuple[float, float]
    flip: tuple[bool, bool] = NO_FLIP
    shift: tuple[float, float] = (0.0, 0.0)


def image_map(augmentation: Augmentation, target: Shape) -> F64:
    """Return the map (3,3) from pixels of the frame to pixels of the target. `target`: its (height, width)."""
    c, s = np.cos(augmentation.turn_rad), np.sin(augmentation.turn_rad)
    signed = np.where(augmentation.flip, -1.0, 1.0) * augmentation.scale
    result = np.eye(3)
    result[:2, :2] = np.array([[c, -s], [s, c]]) * signed
    middle = np.array([target[1] / 2, target[0] / 2]) + augmentation.shift
    result[:2, 2] = middle - result[:2, :2] @ np.asarray(augmentation.centre)
    return result


def moved(points: ArrayLike, by: F64) -> F64:
    """Return the points (..., 2), in pixels, to which the affine map `by` (3,3) moves `points` (..., 2)."""
    return np.asarray(points, np.float64) @ by[:2, :2].T + by[:2, 2]


def augmented_projection(projection: ArrayLike, by: F64, frame: Shape, target: Shape) -> F64:
    """Return a projection (4,4) whose picture is the picture of `projection` (4,4), moved by the map `by`.

    Depth does not change, and only a flip reverses the winding of triangles.

    `by`: affine map (3,3) from pixels of the picture of `projection` to pixels of the new picture.
    `frame`, `target`: (height, width) of these two pictures.
    """
    plane = _ndc_from_pixels(target) @ by @ np.linalg.inv(_ndc_from_pixels(frame))
    after = np.eye(4)
    after[:2, :2], after[:2, 3] = plane[:2, :2], plane[:2, 2]
    return np.asarray(after @ np.asarray(projection, np.float64))


def map_between(before: ArrayLike, after: ArrayLike, frame: Shape, target: Shape) -> F64:
    """Return the affine map (3,3) from pixels of the picture of `before` to pixels of the picture of `after`.

    `augmented_projection` makes `after` from `before` with this map.

    `before`, `after`: projections (4,4). `frame`, `target`: (height, width) of their pictures.
    """
    clip = np.asarray(after, np.float64) @ _inverse(np.asarray(before, np.float64))
    plane = np.eye(3)
    plane[:2, :2], plane[:2, 2] = clip[:2, :2], clip[:2, 3]
    return np.asarray(_inverse(_ndc_from_pixels(target)) @ plane @ _ndc_from_pixels(frame))


def projected(points: ArrayLike, clip: F64, shape: Shape) -> F64:
    """Return the pixel coordinates (x, y), (..., 2), of world `points` (..., 3) in a picture.

    `clip`: projection @ view, (4,4). `shape`: (height, width) of the picture.
    """
    homogeneous = np.asarray(points, np.float64) @ clip[:, :3].T + clip[:, 3]
    ndc = homogeneous[..., :2] / homogeneous[..., 3:]
    return moved(ndc, _inverse(_ndc_from_pixels(shape)))


def unmirrored(by: F64, target: Shape) -> tuple[F64, bool]:
    """Return (map `by` (3,3) without its mirroring, whether drawn columns must be reversed afterwards).

    A mirroring camera would reverse the winding of triangles, and the raster would cull the wrong triangles. Reversing
    the columns of the drawn picture is exact, because pixel centres lie symmetrically.

    `target`: (height, width) of the drawn picture.
    """
    if np.linalg.det(by[:2, :2]) > 0:
        return by, False
    reverse = np.array([[-1.0, 0.0, target[1]], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    return reverse @ by, True


def seen_of_frame(by: F64, frame: Shape, target: Shape) -> Mask:
    """Return which of the target's pixels (h,w) have their centre inside the frame.

    `by`: map (3,3) from the frame's pixels to the target's pixels. `frame`, `target`: their (height, width).
    """
    rows, columns = np.mgrid[: target[0], : target[1]] + 0.5
    x, y = np.moveaxis(moved(np.stack([columns, rows], axis=-1), _inverse(by)), -1, 0)
    return np.asarray((x >= 0) & (x < frame[1]) & (y >= 0) & (y < frame[0]))


def resampled(rgba: U8, by: F64, target: Shape) -> U8:
    """Return the picture (h,w,4) of shape `target` that the map `by` (3,3) makes from `rgba` (H,W,4), straight alpha.

    Where the map shrinks the picture, whole blocks of pixels are averaged first. This average is sampled bilinearly
    once. Colours are weighted by alpha, and pixels outside `rgba` are 0, 0, 0, 0.
    """
    whole = Image.fromarray(rgba, "RGBA").convert("RGBa")
    columns, rows = (max(1, int(1 / length)) for length in np.linalg.norm(by[:2, :2], axis=0))
    small = whole.reduce((columns, rows)) if (columns, rows) != (1, 1) else whole
    back = np.linalg.inv(by @ np.diag([columns, rows, 1.0]))
    picture = small.transform(target[::-1], Image.Transform.AFFINE, tuple(back[:2].ravel()), Image.Resampling.BILINEAR)
    return np.array(picture.convert("RGBA"))


def _ndc_from_pixels(shape: Shape) -> F64:
    """Return the map (3,3) from pixels of a picture of `shape`, y down, to NDC, y up."""
    return np.array([[2.0 / shape[1], 0.0, -1.0], [0.0, -2.0 / shape[0], 1.0], [0.0, 0.0, 1.0]])


def _inverse(matrix: F64) -> F64:
    return np.asarray(np.linalg.inv(matrix), np.float64)


# Points of the body at which random views are centred: random vertices, so that all parts of the surface are equally
# probable.
#
# Rule: the probability of a vertex is its share of the surface's area. SMPL-X has about as many vertices in the head as
# in all other parts together. Therefore the thesis (section 3.3) weights joints by the volume about them. Here, shares
# of the area make equal areas exactly equally probable.


class VertexCentres:
    """Chooses random vertices of the parts that a band's joints move. A vertex's probability is its share of area."""

    def __init__(self, shaped: ShapedBody) -> None:
        self._shaped = shaped
        self._area = vertex_areas(shaped.vertices.astype(np.float64), shaped.body.faces.astype(np.int64))
        self._joint = shaped.body.weights.argmax(axis=1)

    def shares(self, band: str) -> F64:
        """Return the probability (V,) of each vertex in `band`, a name of `BANDS` or `anywhere`; the sum is 1."""
        names = BANDS[band][0] if band in BANDS else JOINT_NAMES
        area = self._area * np.isin(self._joint, [JOINT_INDEX[name] for name in names])
        return np.asarray(area / area.sum())

    def draw(self, rng: np.random.Generator, band: str, posed: Posed) -> F64:
        """Return the place (3,) of a random vertex of the body `posed`, in metres of the world.

        `band`: band of the view, a name of `BANDS` or `anywhere`.
        """
        vertex = int(rng.choice(len(self._area), p=self.shares(band)))
        weights = self._shaped.body.weights[vertex : vertex + 1].astype(np.float64)
        matrix = blend_matrices(weights, posed.matrices.reshape(JOINTS, 12).astype(np.float64)).reshape(3, 4)
        return np.asarray(matrix[:, :3] @ self._shaped.vertices[vertex] + matrix[:, 3])


# Random views of a frame of a capture: the part of the frame that becomes the screen, by the bands of `random_views`.
#
# Rule: a view is an affine map of the frame's pixels (`image_map`), and the same map is applied to the frame's camera.
# A band states how many metres fill the screen's height, so it means the same as for the synthetic person. A frame is
# enlarged by at most `most_enlarged`.


@dataclass(frozen=True)
class ViewRule:
    """Limits of random views.

    `turn_deg`: largest turn, in degrees.
    `squeeze`: largest relative difference between the scales along x and y.
    `flip_share`: share (0 to 1) of views with left and right exchanged.
    `shift`: largest distance along x or y between the view's centre and the screen's middle, as a share of the screen's
    height.
    `most_enlarged`: most screen pixels per frame pixel, along a side.
    """

    turn_deg: float = 8.0
    squeeze: float = 0.0
    flip_share: float = 0.0
    shift: float = 0.2
    most_enlarged: float = 3.0


@dataclass(frozen=True)
class SampleCamera:
    """A frame's camera. `view`, `projection`: matrices (4,4). `lens`: lens in pixels of the frame."""

    view: F64
    projection: F64
    lens: Lens

    @property
    def shape(self) -> Shape:
        """(height, width) of the frame."""
        return round(self.lens.height_px), round(self.lens.width_px)


def zoomed_view(
    rng: np.random.Generator,
    band: str,
    posed: Posed,
    camera: SampleCamera,
    centres: VertexCentres,
    rule: ViewRule,
    screen: Shape,
) -> F64 | None:
    """Return a random map (3,3) from the frame's pixels to the screen's pixels.

    Return None if the view's centre is outside the frame or behind the camera.

    `band`: band of the view, a name of `BANDS` or `anywhere`.
    `posed`: body in the frame. `camera`: camera of the frame.
    `centres`: object that chooses the vertex at the view's centre.
    `rule`: limits of the view.
    `screen`: (height, width) of the screen.
    """
    least, most = BANDS[band][1:] if band in BANDS else ANYWHERE_M
    point = centres.draw(rng, band, posed)
    framed = float(np.exp(rng.uniform(np.log(least), np.log(most))))
    depth = -float(camera.view[2, :3] @ point + camera.view[2, 3])
    pixel = projected(point, camera.projection @ camera.view, camera.shape)
    turn = np.radians(rng.uniform(-rule.turn_deg, rule.turn_deg))
    squeeze = float(np.exp(rng.uniform(-1, 1) * np.log1p(rule.squeeze) / 2))
    flip = bool(rng.random() < rule.flip_share)
    shift = rng.uniform(-rule.shift, rule.shift, 2) * screen[0]
    if depth <= 0 or not (0 <= pixel[0] < camera.shape[1] and 0 <= pixel[1] < camera.shape[0]):
        return None
    scale = np.array([screen[0] * depth / (framed * focal) for focal in (camera.lens.fx, camera.lens.fy)])
    scale *= np.array([squeeze, 1 / squeeze]) * min(1.0, rule.most_enlarged / scale.max())
    centre, beside = (float(pixel[0]), float(pixel[1])), (float(shift[0]), float(shift[1]))
    return image_map(Augmentation(centre, turn, (float(scale[0]), float(scale[1])), (flip, False), beside), screen)
