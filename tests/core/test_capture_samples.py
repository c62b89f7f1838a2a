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
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_INDEX
from trilane.body.kinematics import Skeleton
from trilane.errors import BadInputError
from trilane.scene.lens import Lens
from trilane.training import subject
from trilane.training.capture import capture_samples
from trilane.training.capture.body_raster import BodyRaster
from trilane.training.capture.capture import Capture, open_capture
from trilane.training.capture.capture_samples import CaptureRenderer, held_out_frames
from trilane.training.capture.centres import JointCentres, VertexCentres
from trilane.training.capture.check import checked_frame, coverage_of
from trilane.training.capture.image_map import moved, projected, seen_of_frame
from trilane.training.capture.zoomed_view import Camera, ViewRule, zoomed_view
from trilane.training.random_views import BANDS
from trilane.training.sample_renderer import ANYWHERE
from trilane.training.subject import captured_subject

WIDE = ViewRule(turn_deg=25, squeeze=0.2, flip_share=0.5, shift=0.1)


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
    drawn = [JointCentres().draw(rng, "far", posed) for _ in range(40)]
    wanted = posed.joints[[JOINT_INDEX[name] for name in BANDS["far"][0]]]
    assert {tuple(point) for point in drawn} == {tuple(point) for point in wanted}
    centres = VertexCentres(body)
    points = np.array([centres.draw(rng, "face", posed) for _ in range(30)])
    distance = np.linalg.norm(points - posed.joints[JOINT_INDEX["head"]], axis=1)
    at_rest = np.linalg.norm(body.vertices - body.joints[JOINT_INDEX["head"]], axis=1)
    assert distance.max() < at_rest[centres.shares("face") > 0].max() + 0.02 and distance.std() > 0.01


def test_a_view_frames_as_many_metres_as_its_band_says(body: ShapedBody) -> None:
    """Two points that are so many metres apart, one above the other at the centre's depth, by the view's map."""
    posed = Skeleton(body.joints, body.body.parents).pose(np.zeros((55, 3)), (0.0, 0.3, -3.0))
    lens = Lens(4000, 3000, 2600.0, 3000.0, 1900.0, 1600.0)
    camera = Camera(np.eye(4), lens.projection(0.05, 100.0), lens)
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
    camera = Camera(np.eye(4), lens.projection(0.05, 100.0), lens)
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
        sample = renderer.training_sample((5, number), bands[number % 5], "256")
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
        sample = renderer.training_sample((2, number), "full_body", "128")
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
    one, other = first.training_sample((1, 2), "far", "128"), first.training_sample((1, 3), "far", "128")
    again = second.training_sample((1, 2), "far", "128")
    assert np.array_equal(one.by, again.by) and one.picture == again.picture and not np.array_equal(one.by, other.by)
    assert all(np.array_equal(a, b) for a, b in zip(first.render(one), second.render(again), strict=True))


def test_only_the_frames_that_are_given_are_shown(capture: Capture) -> None:
    renderer = CaptureRenderer(capture, (2, 5), WIDE)
    samples = [renderer.training_sample((9, number), "anywhere", "128") for number in range(20)]
    assert {sample.picture for sample in samples} == {2, 5} and {sample.band for sample in samples} == {ANYWHERE}


def test_a_band_that_no_frame_can_show_is_said(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capture_samples, "zoomed_view", lambda *_: None)
    with pytest.raises(BadInputError, match="no view of band face in 1000 draws"):
        CaptureRenderer(capture, (1,), WIDE).training_sample((1,), "face", "128")


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
    asked = found.renderer.training_sample((4,), "far", "128")
    assert asked.picture in (0, 1)
    assert all(np.array_equal(a, b) for a, b in zip(sent.render(asked), found.renderer.render(asked), strict=True))
    assert isinstance(found.renderer, CaptureRenderer) and not isinstance(sent, SimpleNamespace)
