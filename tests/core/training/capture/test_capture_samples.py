"""Samples of a capture: which part of which frame they show, that picture and UV image agree, and what is left out."""

from __future__ import annotations

import pickle
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from support.small_inputs import write_capture_folder
from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_INDEX, Posed, Skeleton
from trilane.scene.lens import Lens
from trilane.training import subject
from trilane.training.capture.capture import Capture, Fit, open_capture
from trilane.training.capture.capture_samples import (
    Augmentation,
    BodyRaster,
    CaptureRenderer,
    SampleCamera,
    VertexCentres,
    ViewRule,
    augmented_projection,
    held_out_frames,
    image_map,
    moved,
    projected,
    resampled,
    seen_of_frame,
    unmirrored,
    zoomed_view,
)
from trilane.training.capture.check import checked_frame, coverage_of
from trilane.training.random_views import BANDS
from trilane.training.sample_renderer import ANYWHERE_BAND
from trilane.training.subject import captured_subject

WIDE = ViewRule(turn_deg=25, squeeze=0.2, flip_share=0.5, shift=0.1)


class JointCentres(VertexCentres):
    """Centres that are known: the joints of a band, with equal probability."""

    def __init__(self) -> None:
        pass

    def draw(self, rng: np.random.Generator, band: str, posed: Posed) -> F64:
        names = BANDS[band][0]
        return np.array(posed.joints[JOINT_INDEX[names[rng.integers(len(names))]]])


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Eight frames, 640 x 480, with the drawn bodies as masks; red is a frame's column / 4, green its row / 4."""
    folder = write_capture_folder(tmp_path_factory.mktemp("capture") / "mine")
    sizes = "width = 640\nheight = 480\nfx = 560.0\nfy = 520.0\ncx = 330.0\ncy = 250.0\naxes = 'opengl'\n"
    (folder / "capture.toml").write_text(f"[camera]\n{sizes}")
    for part, size in (("frames", (480, 640, 3)), ("masks", (480, 640))):
        for number in range(8):
            Image.fromarray(np.full(size, 255, np.uint8)).save(folder / part / f"{number:03}.png")
    rows, columns = np.mgrid[:480, :640]
    blank = open_capture(folder)
    raster = BodyRaster(blank.shaped, 1)
    for number in range(8):
        drawn = raster.uv_of(blank, number)[..., 2] > 0
        Image.fromarray(np.where(drawn, 255, 0).astype(np.uint8)).save(folder / "masks" / f"{number:03}.png")
        frame = np.dstack([columns / 4, rows / 4, np.full((480, 640), number * 20)]).astype(np.uint8)
        Image.fromarray(frame).save(folder / "frames" / f"{number:03}.png")
    return open_capture(folder)


def test_vertices_are_drawn_by_their_area(body: ShapedBody) -> None:
    """Each region as often as its share of the surface says, though a quarter of all vertices are the hands'."""
    vertices, centres = body.vertices.astype(np.float64), VertexCentres(body)
    a, b, c = (vertices[body.body.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    middles = (a + b + c) / 3
    shares = centres.shares("anywhere")
    assert shares.sum() == pytest.approx(1) and (shares >= 0).all()
    for low, high in ((-2.0, -0.5), (-0.5, 0.0), (0.0, 0.3), (0.3, 2.0)):  # slices of the body's height
        of_faces = area[(middles[:, 1] >= low) & (middles[:, 1] < high)].sum() / area.sum()
        assert shares[(vertices[:, 1] >= low) & (vertices[:, 1] < high)].sum() == pytest.approx(of_faces, abs=0.01)
    hands = np.abs(vertices[:, 0]) > abs(body.joints[JOINT_INDEX["left_wrist"], 0])
    assert hands.mean() > 0.2 and shares[hands].sum() < 0.08
    face = centres.shares("face")
    assert set(body.body.weights[face > 0].argmax(axis=1)) == {JOINT_INDEX["head"]}


def test_centres_lie_on_the_posed_body(body: ShapedBody) -> None:
    pose = np.random.default_rng(0).normal(0, 0.3, (55, 3))
    posed = Skeleton(body.joints, body.body.parents).pose(pose, (1.0, 2.0, 3.0))
    rng = np.random.default_rng(1)
    centres = VertexCentres(body)
    points = np.array([centres.draw(rng, "face", posed) for _ in range(30)])
    distance = np.linalg.norm(points - posed.joints[JOINT_INDEX["head"]], axis=1)
    at_rest = np.linalg.norm(body.vertices - body.joints[JOINT_INDEX["head"]], axis=1)
    assert distance.max() < at_rest[centres.shares("face") > 0].max() + 0.02 and distance.std() > 0.01


def test_a_view_frames_as_many_metres_as_its_band_says(body: ShapedBody) -> None:
    """Two points that are so many metres apart, one above the other at the centre's depth, by the view's map."""
    posed = Skeleton(body.joints, body.body.parents).pose(np.zeros((55, 3)), (0.0, 0.3, -3.0))
    lens = Lens(4000, 3000, 2600.0, 3000.0, 1900.0, 1600.0)
    camera = SampleCamera(np.eye(4), lens.projection(0.05, 100.0), lens)
    rule = ViewRule(turn_deg=0, shift=0.0, most_enlarged=1e6)
    for band, (names, least, most) in BANDS.items():
        heights = []
        for seed in range(40):
            by = zoomed_view(np.random.default_rng(seed), band, posed, camera, JointCentres(), rule, (480, 640))
            assert by is not None
            for name in names:
                point = posed.joints[JOINT_INDEX[name]]
                beside = point + np.array([[0, 0, 0], [0, 0.1, 0], [0, -0.1, 0], [0.1, 0, 0]])
                middle, top, bottom, right = moved(projected(beside, camera.projection, camera.shape), by)
                if np.abs(middle - (320, 240)).max() < 1e-6:
                    heights.append(480 / (bottom[1] - top[1]) * 0.2)
                    assert right[0] - middle[0] == pytest.approx((bottom[1] - top[1]) / 2)
        assert len(heights) == 40 and least <= min(heights) < 1.25 * least and most / 1.25 < max(heights) <= most


def test_a_view_is_enlarged_by_so_much_at_most_and_keeps_its_centre_in_the_frame(body: ShapedBody) -> None:
    skeleton = Skeleton(body.joints, body.body.parents)
    posed = skeleton.pose(np.zeros((55, 3)), (0.0, 0.3, -3.0))
    lens = Lens(200, 150, 130.0, 150.0, 95.0, 80.0)
    camera = SampleCamera(np.eye(4), lens.projection(0.05, 100.0), lens)
    rule = replace(WIDE, most_enlarged=2.0)
    for seed in range(20):
        by = zoomed_view(np.random.default_rng(seed), "face", posed, camera, JointCentres(), rule, (480, 640))
        assert by is not None and np.linalg.norm(by[:2, :2], axis=0).max() <= 2.0 * 1.2
    views = [
        zoomed_view(np.random.default_rng(seed), "far", posed, camera, JointCentres(), WIDE, (480, 640))
        for seed in range(60)
    ]
    assert 15 < sum(view is not None and np.linalg.det(view[:2, :2]) < 0 for view in views) < 45
    for place in ((0.0, 9.0, -3.0), (0.0, 0.3, 3.0)):  # above the frame, behind the camera
        posed = skeleton.pose(np.zeros((55, 3)), place)
        assert zoomed_view(np.random.default_rng(0), "face", posed, camera, JointCentres(), WIDE, (480, 640)) is None


def test_the_picture_lies_on_the_uv_image_in_every_view(capture: Capture) -> None:
    """The mask is the body drawn in the frame, the UV image is drawn anew: they differ at the outline alone."""
    renderer = CaptureRenderer(capture, range(8), WIDE)
    mirrored, bands = Counter[bool](), ("far", "full_body", "upper_body", "face", "anywhere")
    for number in range(15):
        sample = renderer.training_sample((5, number), bands[number % 5], 1.0)
        uv, rgba = renderer.render(sample)
        drawn, alpha = uv[..., 2] > 0, rgba[..., 3]
        assert drawn.shape == alpha.shape == sample.crop.shape and sample.band == number % 5
        inside = seen_of_frame(sample.by, capture.shape, sample.crop.shape)
        assert drawn.any() and not drawn[~inside].any()
        wrong = inside & ((drawn & (alpha == 0)) | (~drawn & (alpha == 255)))
        # A pixel of the frame is covered by its middle: its outline is off by half of one, as large as it is here.
        outline = np.abs(np.diff(drawn.astype(int), axis=1)).sum() + np.abs(np.diff(drawn.astype(int), axis=0)).sum()
        assert wrong.sum() <= 0.5 * np.linalg.norm(sample.by[:2, :2], axis=0).max() * outline
        row, column = np.argwhere((alpha == 255) & drawn)[drawn.sum() // 3]
        x, y = moved((column + 0.5, row + 0.5), np.asarray(np.linalg.inv(sample.by)))
        assert np.abs(rgba[row, column, :2] - (x / 4, y / 4)).max() < 1.5
        assert rgba[row, column, 2] == 20 * sample.picture
        mirrored[sample.mirrored] += 1
    assert min(mirrored[True], mirrored[False]) > 2


def test_where_the_frame_ends_the_body_ends_as_well(capture: Capture) -> None:
    """The body stands across the right edge: what is drawn of it beyond is taken away, and only that."""
    aside = tuple(replace(fit, place=fit.place + np.array([1.6, 0.0, 0.0])) for fit in capture.fits)
    renderer = CaptureRenderer(replace(capture, fits=aside), range(8), replace(WIDE, flip_share=0.0))
    beyond = 0
    for number in range(6):
        sample = renderer.training_sample((2, number), "full_body", 1.0)
        uv, _ = renderer.render(sample)
        raster = renderer._raster.uv(
            aside[sample.picture], capture.views[sample.picture], sample.crop.projection, sample.crop.shape
        )
        inside = seen_of_frame(sample.by, capture.shape, sample.crop.shape)
        assert not uv[~inside].any() and np.array_equal(uv[inside], raster[inside])
        beyond += int((raster[~inside][:, 2] > 0).sum())
    assert beyond > 500


def test_a_sample_depends_on_its_seed_alone(capture: Capture) -> None:
    first, second = CaptureRenderer(capture, range(8), WIDE), CaptureRenderer(capture, range(8), WIDE)
    one, other = first.training_sample((1, 2), "far", "128"), first.training_sample((1, 3), "far", 1.0)
    again = second.training_sample((1, 2), "far", 1.0)
    assert np.array_equal(one.by, again.by) and one.picture == again.picture and not np.array_equal(one.by, other.by)
    assert all(np.array_equal(a, b) for a, b in zip(first.render(one), second.render(again), strict=True))


def test_only_the_frames_that_are_given_are_shown(capture: Capture) -> None:
    renderer = CaptureRenderer(capture, (2, 5), WIDE)
    samples = [renderer.training_sample((9, number), "anywhere", 1.0) for number in range(20)]
    assert {sample.picture for sample in samples} == {2, 5} and {sample.band for sample in samples} == {ANYWHERE_BAND}


def test_every_tenth_good_frame_is_held_out() -> None:
    kept, held_out = held_out_frames(24, [0, 5, 23])
    assert held_out == [7, 17] and kept == [n for n in range(24) if n not in (0, 5, 7, 17, 23)]
    assert held_out_frames(4, []) == ([0, 1, 2, 3], [])


def test_the_person_of_a_capture(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frame 3 shows somebody else's outline: it is left out, and said so. What renders is sent to other processes."""
    elsewhere = np.zeros((480, 640), np.uint8)
    elsewhere[:60, :80] = 255
    path = Path(capture.folder / "masks" / "003.png")
    before = path.read_bytes()
    Image.fromarray(elsewhere).save(path)
    monkeypatch.setattr(subject, "held_out_frames", lambda count, bad: ([0, 1], [count - 1, *bad]))
    lines: list[str] = []
    found = captured_subject(capture.folder, 1, lines.append)
    path.write_bytes(before)
    raster, coverage = BodyRaster(capture.shaped, 1), coverage_of(capture)
    for number in (0, 1):
        coverage.add(coverage.drawn(*checked_frame(capture, raster, number)[1:]))
    seen = coverage.share()
    assert lines[0] == "2 frames of 8 to train on; held out: 2, with bad fits: 1" and 0.2 < seen < 0.8
    assert lines[1:] == [
        f"{1 - seen:.1%} of the body's texels are seen by no frame: filled from seen ones, along the surface"
    ]
    assert found.unseen is not None and np.array_equal(found.unseen, coverage.unseen)
    assert found.facts == {
        "body": "that of a capture",
        "frames": 8,
        "held_out_frames": ["007.png", "003.png"],
        "bad_frames": ["003.png"],
        "texels": {"seen": seen, "regions": coverage.share_by_region(), "never_seen": coverage.never_seen()},
    }
    assert found.person.betas == pytest.approx([0.35] * 10) and found.person.body == capture.body_file
    assert np.array_equal(found.shaped.vertices, capture.shaped.vertices) and found.truth is None
    sent: Any = pickle.loads(pickle.dumps(found.source))()  # noqa: S301 - as the pool sends it
    asked = found.renderer.training_sample((4,), "far", 1.0)
    assert asked.picture in (0, 1)
    assert all(np.array_equal(a, b) for a, b in zip(sent.render(asked), found.renderer.render(asked), strict=True))
    assert isinstance(found.renderer, CaptureRenderer) and not isinstance(sent, SimpleNamespace)


# Camera-space augmentation: what is done to a picture and to its camera is the same, to a hundredth of a pixel.

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
