"""Samples of a capture for training: random views of its frames, cropped as the pipeline crops.

Rule: the UV image is drawn with the view's own camera, the ground truth is resampled once from the whole frame, and
both are empty where the frame ends. A sample depends only on its seed.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trilane.arrays import F32, F64, U8
from trilane.errors import BadInputError
from trilane.shapes import shape_buckets
from trilane.stages.gpu.packed_pass import Placement
from trilane.training.capture.body_raster import BodyRaster
from trilane.training.capture.capture import Capture
from trilane.training.capture.centres import Centres, VertexCentres
from trilane.training.capture.image_map import augmented_projection, map_between, resampled, seen_of_frame, unmirrored
from trilane.training.capture.zoomed_view import Camera, ViewRule, screen_shape, zoomed_view
from trilane.training.random_views import BANDS, View
from trilane.training.sample_crop import Crop, Cropper
from trilane.training.sample_renderer import ANYWHERE_BAND, BAND_NAMES, LEAST_PIXELS

#: Draws of a view before it is said that no frame has one.
TRIES = 1000
#: Frames that are kept decoded, because samples of one frame follow each other.
KEPT = 4
#: Of successive frames one is held out.
HELD_OUT_EVERY = 10


@dataclass(frozen=True)
class CaptureSample:
    """What to render. `picture`: number of the frame. `crop`: its projection draws the body, before it is mirrored.

    `by` (3,3): from the frame's pixels to the tensor's. `mirrored`: whether `by` mirrors, see `unmirrored`. `band`: an
    index into BAND_NAMES, or ANYWHERE_BAND.
    """

    picture: int
    crop: Crop
    by: F64
    mirrored: bool
    band: int


class CaptureRenderer:
    """Plans and renders samples of a capture, with an OpenGL context of its own."""

    def __init__(
        self,
        capture: Capture,
        numbers: Sequence[int],
        rule: ViewRule,
        centres: Centres | None = None,
        threads: int | None = None,
    ) -> None:
        """Open the context.

        `capture`: whose frames `numbers` are shown.
        `rule`: of the views.
        `centres`: what they are centred on; vertices by area if None.
        `threads`: of a software OpenGL driver.
        Raises MissingPartError without OpenGL.
        """
        self.capture, self._numbers, self._rule = capture, list(numbers), rule
        self._centres = centres or VertexCentres(capture.shaped)
        self._raster = BodyRaster(capture.shaped, threads)
        self.ctx, self.mesh = self._raster.ctx, self._raster.mesh
        self._cropper = Cropper(capture.shaped, pose_blend=True)
        self._projection, self._lens = capture.file.camera.projection(), capture.file.camera.lens
        self._kept: OrderedDict[int, U8] = OrderedDict()

    def training_sample(self, seed: Sequence[int], band: str, size: str) -> CaptureSample:
        """The sample of `seed`: draws frames and views until enough of the body is on the screen.

        `band`: a name of BANDS, or `anywhere`. `size`: the tensor size, as `shape_buckets` takes it.
        Raises BadInputError when no frame has such a view.
        """
        rng = np.random.default_rng(seed)
        for _ in range(TRIES):
            sample = self._drawn(rng, band, size)
            if sample is not None:
                return sample
        found = f"no view of band {band} in {TRIES} draws"
        raise BadInputError(self.capture.folder, found, "frames that show the whole person")

    def whole_sample(self, number: int, size: str) -> CaptureSample | None:
        """Frame `number` as it is, cropped to the person; None where nothing of the body is in it."""
        posed, view, frame = (
            self._raster.posed(self.capture.fits[number]),
            self.capture.views[number],
            self.capture.shape,
        )
        crop = self._cropper.crop(posed, View(view, self._projection, frame[1] / frame[0]), shape_buckets(size))
        if crop is None:
            return None
        by = map_between(self._projection, crop.projection, frame, crop.shape)
        return CaptureSample(number, crop, by, False, ANYWHERE_BAND)

    def placed(self, sample: CaptureSample) -> tuple[F64, Placement]:
        """The camera (4,4) of a sample that is not mirrored, and its body as the packed pass draws it."""
        pose, crop = self._raster.body_pose(self.capture.fits[sample.picture]), sample.crop
        placement = Placement(pose.joints, crop.projection, (0, 0, *crop.shape), pose.feature)
        return self.capture.views[sample.picture], placement

    def _drawn(self, rng: np.random.Generator, band: str, size: str) -> CaptureSample | None:
        number = self._numbers[int(rng.integers(len(self._numbers)))]
        view, screen = self.capture.views[number], screen_shape(rng)
        posed = self._raster.posed(self.capture.fits[number])
        camera = Camera(view, self._projection, self._lens)
        by = zoomed_view(rng, band, posed, camera, self._centres, self._rule, screen)
        if by is None:
            return None
        upright, mirrored = unmirrored(by, screen)
        projection = augmented_projection(self._projection, upright, camera.shape, screen)
        crop = self._cropper.crop(posed, View(view, projection, screen[1] / screen[0]), shape_buckets(size))
        if crop is None or crop.pixels < LEAST_PIXELS:
            return None
        whole = map_between(self._projection, crop.projection, camera.shape, crop.shape)
        if mirrored:
            whole = np.array([[-1.0, 0.0, crop.shape[1]], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ whole
        return CaptureSample(number, crop, whole, mirrored, BAND_NAMES.index(band) if band in BANDS else ANYWHERE_BAND)

    def render(self, sample: CaptureSample) -> tuple[F32, U8]:
        """The UV image (h,w,3) float32 of u, v, coverage, and the ground truth (h,w,4) uint8, straight alpha."""
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
    """Of `count` frames, none of them `bad`: those to train on, and every tenth, which training never reads."""
    good = [number for number in range(count) if number not in set(bad)]
    held_out = good[HELD_OUT_EVERY // 2 :: HELD_OUT_EVERY]
    return [number for number in good if number not in set(held_out)], held_out
