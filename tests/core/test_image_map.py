"""Camera-space augmentation: what is done to a picture and to its camera is the same, to a hundredth of a pixel."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trilane.body.body import ShapedBody
from trilane.body.kinematics import Skeleton
from trilane.scene.lens import Lens
from trilane.training.capture.capture_samples import (
    Augmentation,
    BodyRaster,
    augmented_projection,
    image_map,
    moved,
    projected,
    resampled,
    seen_of_frame,
    unmirrored,
)
from trilane.training.capture.fits import Fit

FRAME, TARGET = (180, 320), (160, 96)
LENS = Lens(320, 180, 300.0, 260.0, 150.0, 97.0)
PROJECTION = LENS.projection(0.05, 100.0)


def drawn(rng: np.random.Generator, centre: Any, most_zoom: float = 12.0) -> Augmentation:
    """Any augmentation about a point that is near `centre`."""
    flip = rng.random(2) < 0.5
    return Augmentation(
        centre=tuple(centre + rng.uniform(-20, 20, 2)),
        turn_rad=rng.uniform(-np.pi, np.pi),
        scale=tuple(np.exp(rng.uniform(np.log(0.3), np.log(most_zoom), 2))),
        flip=(bool(flip[0]), bool(flip[1])),
        shift=tuple(rng.uniform(-30, 30, 2)),
    )


def test_joints_agree_over_10000_draws(body: ShapedBody) -> None:
    """In the augmented camera and in the augmented image, against the steps done one after the other to each point."""
    rng = np.random.default_rng(3)
    skeleton, kinds = Skeleton(body.joints, body.body.parents), set()
    for number in range(10_000):
        if number % 500 == 0:
            pose = rng.uniform(-1, 1, (55, 3))
            joints = skeleton.pose(pose, (0.0, 0.0, rng.uniform(-6, -3))).joints.copy()
            frame, target = ((180, 320), (160, 96)) if number % 1000 else ((333, 200), (64, 256))
            projection = LENS.scaled(frame[1], frame[0]).projection(0.05, 100.0)
            lens = LENS.scaled(frame[1], frame[0])
            x = lens.cx + lens.fx * joints[:, 0] / -joints[:, 2]
            y = lens.cy - lens.fy * joints[:, 1] / -joints[:, 2]
        one = drawn(rng, (frame[1] / 2, frame[0] / 2))
        kinds.add(one.flip)
        point = (x - one.centre[0]) * one.scale[0] + 1j * (y - one.centre[1]) * one.scale[1]
        point = np.where(one.flip[0], -1, 1) * point.real + 1j * np.where(one.flip[1], -1, 1) * point.imag
        point = point * np.exp(1j * one.turn_rad) + complex(*one.shift) + (target[1] + 1j * target[0]) / 2
        by = image_map(one, target)
        camera = projected(joints, augmented_projection(projection, by, frame, target), target)
        assert np.abs(camera - np.stack([point.real, point.imag], axis=-1)).max() < 0.01
    assert len(kinds) == 4


def test_the_thesis_says_the_same_of_a_lens_with_square_pixels(body: ShapedBody) -> None:
    """Formulas 3.18 to 3.20: extrinsics R S, then a moved principal point, of pixels alike on both sides."""
    rng = np.random.default_rng(4)
    lens = Lens(320, 180, 280.0, 280.0, 150.0, 97.0)
    points = body.joints + np.array([0.1, 0.2, -4.0])
    for _ in range(50):
        one = drawn(rng, (160, 90))
        c, s = np.cos(one.turn_rad), np.sin(one.turn_rad)
        turn = np.array([[c, -s], [s, c]]) * np.where(one.flip, -1, 1) * one.scale
        ray = np.stack([points[:, 0], -points[:, 1]], axis=-1) / -points[:, 2:]  # x right, y down, as the thesis has it
        principal = turn @ (np.array([lens.cx, lens.cy]) - one.centre) + one.shift + np.array(TARGET[::-1]) / 2
        wanted = lens.fx * ray @ turn.T + principal
        clip = augmented_projection(lens.projection(0.05, 100.0), image_map(one, TARGET), FRAME, TARGET)
        assert projected(points, clip, TARGET) == pytest.approx(wanted, abs=1e-6)


def test_scaling_and_cutting_is_what_a_lens_says() -> None:
    by = image_map(Augmentation((100.0, 70.0), 0.0, (2.0, 0.5)), (64, 96))
    lens = LENS.scaled(640, 90).cropped(2 * 100 - 48, 35 - 32, 96, 64)
    clip = augmented_projection(PROJECTION, by, FRAME, (64, 96))
    assert clip == pytest.approx(lens.projection(0.05, 100.0), abs=1e-9)


def test_a_quarter_turn_is_what_a_lens_says() -> None:
    by = image_map(Augmentation((160.0, 90.0), np.pi / 2, (1.0, 1.0)), (320, 180))
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (9, 3)) - (0, 0, 4)
    clip = augmented_projection(PROJECTION, by, FRAME, (320, 180))
    turned = np.stack([points[:, 1], -points[:, 0], points[:, 2]], axis=-1)  # what is to the right comes to the bottom
    lens = LENS.turned(1)
    assert projected(points, clip, (320, 180)) == pytest.approx(
        projected(turned, lens.projection(0.05, 100.0), (320, 180)), abs=1e-6
    )


def test_a_dot_of_the_frame_is_resampled_to_where_the_camera_has_it() -> None:
    """By the centroid of a soft dot, so the resampling itself is measured: flips, turns, shrinking and enlarging."""
    rng = np.random.default_rng(5)
    for _ in range(40):
        point = rng.uniform((120, 70), (200, 110))
        y, x = np.mgrid[: FRAME[0], : FRAME[1]] + 0.5
        alpha = np.exp(-((x - point[0]) ** 2 + (y - point[1]) ** 2) / (2 * 5.0**2))
        frame = np.dstack([np.full((*FRAME, 3), 200, np.uint8), np.round(255 * alpha).astype(np.uint8)])
        flip = rng.random(2) < 0.5
        one = Augmentation(
            (point[0] + rng.uniform(-8, 8), point[1] + rng.uniform(-8, 8)),
            rng.uniform(-3, 3),
            tuple(rng.uniform(0.25, 1.6, 2)),
            (bool(flip[0]), bool(flip[1])),
            tuple(rng.uniform(-8, 8, 2)),
        )
        by = image_map(one, TARGET)
        weight = resampled(frame, by, TARGET)[..., 3].astype(np.float64)
        rows, columns = np.mgrid[: TARGET[0], : TARGET[1]] + 0.5
        centroid = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        depth = 3.0
        ray = np.array([(point[0] - LENS.cx) / LENS.fx, -(point[1] - LENS.cy) / LENS.fy, -1.0]) * depth
        clip = augmented_projection(PROJECTION, by, FRAME, TARGET)
        assert np.abs(centroid - projected(ray, clip, TARGET)).max() < 0.1


def test_colours_are_weighted_by_alpha_and_shrinking_takes_every_pixel() -> None:
    """8 x 8 pixels become one: three quarters are transparent black, a quarter is opaque (200, 80, 40)."""
    frame = np.zeros((64, 64, 4), np.uint8)
    frame[::2, ::2] = (200, 80, 40, 255)
    small = resampled(frame, image_map(Augmentation((32.0, 32.0), 0.0, (0.125, 0.125)), (8, 8)), (8, 8))
    assert np.abs(small[2:6, 2:6].astype(int) - (200, 80, 40, 64)).max() <= 2


def test_what_lies_beyond_the_frame_is_not_seen() -> None:
    by = image_map(Augmentation((0.0, 90.0), 0.0, (1.0, 1.0)), (40, 20))
    seen = seen_of_frame(by, FRAME, (40, 20))
    assert not seen[:, :10].any() and seen[:, 10:].all()
    frame = np.full((*FRAME, 4), 255, np.uint8)
    assert not resampled(frame, by, (40, 20))[:, :9].any()


@pytest.mark.parametrize("flip", [(False, False), (True, False), (False, True), (True, True)])
def test_the_drawn_body_covers_the_resampled_mask(body: ShapedBody, flip: tuple[bool, bool]) -> None:
    """A body drawn with the augmented camera, against the same body drawn in the frame and resampled.

    They differ within a pixel of the outline alone. Mirrored, triangles would face the other way.
    """
    pose = np.zeros((55, 3))
    pose[0] = (0.0, 0.7, 0.0)
    fit = Fit(pose, np.array([0.0, 0.2, -2.6]), np.zeros(0), np.zeros(0))
    raster, frame, target = BodyRaster(body, 1), (720, 1280), (192, 128)
    projection = Lens(1280, 720, 900.0, 900.0, 600.0, 380.0).projection(0.05, 100.0)
    whole = raster.uv(fit, np.eye(4), projection, frame)
    by, mirrored = unmirrored(image_map(Augmentation((640.0, 300.0), 0.3, (0.25, 0.3), flip), target), target)
    assert mirrored == (flip[0] != flip[1])
    again = raster.uv(fit, np.eye(4), augmented_projection(projection, by, frame, target), target)
    again = again[:, ::-1] if mirrored else again
    mask = np.dstack([np.zeros((*frame, 3), np.uint8), np.where(whole[..., 2] > 0, 255, 0).astype(np.uint8)])
    original = image_map(Augmentation((640.0, 300.0), 0.3, (0.25, 0.3), flip), target)
    wanted = resampled(mask, original, target)[..., 3]
    covered = again[..., 2] > 0
    assert covered.sum() > 2000
    assert not covered[wanted == 0].any() and covered[wanted == 255].all()
    assert moved((640.0, 300.0), original) == pytest.approx((64, 96))
