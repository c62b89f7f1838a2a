"""The generator of captures: a fit is where the body stands, noise is as large as it says, a seed repeats."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.body.body import ShapedBody
from trilane.body.joints import Skeleton, rodrigues
from trilane.errors import BadInputError
from trilane.training.capture import synthetic
from trilane.training.capture.capture import camera_direction, frames_by_side, open_capture
from trilane.training.capture.capture_file import OPENGL_FROM_OPENCV, CameraTable
from trilane.training.capture.capture_samples import projected
from trilane.training.capture.synthetic import (
    FILLED,
    MOST_FARTHER,
    Recipe,
    SyntheticCapture,
    framing_view,
    in_camera,
    moved_outline,
    turned_at_random,
    write_capture,
)
from trilane.training.clothing import LOOKS
from trilane.training.random_views import look_at, perspective

NOISY = Recipe(6, (64, 96), seed=3, fit_deg=1.0, fit_mm=5.0, mask_px=2.0)


def test_a_fit_stands_in_the_camera_where_the_body_stands_in_the_world(body: ShapedBody) -> None:
    rng = np.random.default_rng(0)
    pose, view = rng.normal(0, 0.4, (55, 3)), look_at(np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.3, 0.0]), 0.2)
    skeleton = Skeleton(body.joints, body.body.parents)
    wanted = skeleton.pose(pose).joints @ view[:3, :3].T + view[:3, 3]
    turned, place = in_camera(pose, body.joints[0], view)
    assert skeleton.pose(turned, place).joints @ OPENGL_FROM_OPENCV == pytest.approx(wanted, abs=1e-9)
    assert np.array_equal(turned[1:], pose[1:])


@pytest.mark.parametrize("aspect", [0.5, 1.8])
def test_a_view_has_all_of_the_person_and_little_beside(aspect: float) -> None:
    """With the nearest distance the farthest point touches the border of what may be filled, by projecting all."""
    points = np.random.default_rng(1).normal(0, (0.3, 0.8, 0.3), (500, 3)) + np.array([5, 1, 2])
    projection = perspective(0.7, aspect)
    for yaw in (0.0, 1.0, 3.0):
        rng: Any = np.random.default_rng(4)
        near = SimpleNamespace(triangular=rng.triangular, standard_normal=rng.standard_normal, uniform=lambda a, _: a)
        view = framing_view(near, yaw, points, projection)  # type: ignore[arg-type]
        clip = np.column_stack([points, np.ones(500)]) @ (projection @ view).T
        reach = np.abs(clip[:, :2] / clip[:, 3:])
        assert reach.max() == pytest.approx(FILLED) and clip[:, 3].min() > 0
        far = framing_view(np.random.default_rng(4), yaw, points, projection)
        clip = np.column_stack([points, np.ones(500)]) @ (projection @ far).T
        assert FILLED / MOST_FARTHER * 0.9 < np.abs(clip[:, :2] / clip[:, 3:]).max() <= FILLED


def test_joints_are_turned_by_no_more_than_is_said() -> None:
    pose = np.random.default_rng(2).normal(0, 0.8, (55, 3))
    turned = turned_at_random(np.random.default_rng(3), pose, 1.0)
    between = rodrigues(turned) @ rodrigues(pose).transpose(0, 2, 1)
    angles = np.degrees(np.arccos(np.clip((np.trace(between, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert 0.9 < angles.max() <= 1.0 + 1e-6 and angles.std() > 0.2


@pytest.mark.parametrize("most_px", [2.0, 6.0])
def test_an_outline_moves_by_no_more_than_is_said(most_px: float) -> None:
    """Of a straight edge, row by row."""
    mask = np.zeros((240, 120), np.uint8)
    mask[:, 60:] = 255
    moved = moved_outline(np.random.default_rng(0), mask, most_px)
    assert set(np.unique(moved)) == {0, 255}
    edge = (moved == 0).sum(axis=1) - 60
    assert (np.diff(moved.astype(int), axis=1) != 0).sum(axis=1).max() == 1
    assert most_px / 2 < np.abs(edge).max() <= most_px + 1 and edge.min() < 0 < edge.max()


class Drawn(SyntheticCapture):
    """Draws no clothes, which takes seconds: a box about the body's joints on the background."""

    def __init__(self, body: ShapedBody, recipe: Recipe) -> None:
        skeleton = Skeleton(body.joints, body.body.parents)

        def box(_: Any, view: Any, projection: Any, shape: Any) -> Any:
            pixels = projected(self.points, projection @ view, shape)
            (left, top), (right, bottom) = pixels.min(axis=0).astype(int), pixels.max(axis=0).astype(int)
            rgba = np.zeros((*shape, 4), np.uint8)
            rgba[top:bottom, left:right] = (250, 10, 10, 255)
            return rgba

        def posed(found: Any) -> Any:
            self.points = found.joints.copy()
            return self.points

        self._recipe, self._root = recipe, body.joints[0]
        self._projection = recipe.lens.projection(0.05, 100.0)
        self._background = np.zeros((*recipe.shape, 3))
        self._renderer: Any = SimpleNamespace(
            skeleton=skeleton, surface=SimpleNamespace(posed=posed), clothed_body=SimpleNamespace(render=box)
        )


def test_what_is_written_is_a_capture_and_its_truth_another(body: ShapedBody, tmp_path: Path) -> None:
    """The truth's joints project into the mask's box; those of the noisy fits lie up to 5 mm and a degree off."""
    (tmp_path / "a").mkdir()
    assert list(write_capture(tmp_path / "a", Drawn(body, NOISY), NOISY)) == list(range(6))
    capture, truth = open_capture(tmp_path / "a"), open_capture(tmp_path / "a" / "truth")
    skeleton = Skeleton(body.joints, body.body.parents)
    for number in range(6):
        mask = truth.picture(number)[..., 3]
        rows, columns = np.nonzero(mask)
        joints = skeleton.pose(truth.fits[number].pose, truth.fits[number].place).joints
        pixels = projected(joints, truth.file.camera.projection() @ truth.views[number], truth.shape)
        assert np.abs(pixels.min(axis=0) - (columns.min(), rows.min())).max() < 1.01
        assert np.abs(pixels.max(axis=0) - (columns.max(), rows.max())).max() < 2.01
        off = np.abs(capture.fits[number].place - truth.fits[number].place)
        assert 0 < off.max() <= 0.005 + 1e-6
        assert (capture.picture(number)[..., 3] != mask).any()
        assert np.array_equal(capture.frames.read(number), truth.frames.read(number))
    assert "up to 1 degrees and 5 mm" in (tmp_path / "a" / "capture.toml").read_text()
    assert "Noise: none" in (tmp_path / "a" / "truth" / "capture.toml").read_text()


def test_four_frames_show_all_sides(body: ShapedBody) -> None:
    for seed in range(20):
        drawn = Drawn(body, Recipe(4, (64, 96), seed))
        frames = [drawn.frame(number) for number in range(4)]
        view = CameraTable.model_construct().view()
        directions = [camera_direction(one.pose, body.joints[0] + one.place, view) for one in frames]
        assert set(frames_by_side([yaw for yaw, _ in directions]).values()) == {1}


def test_the_same_seed_writes_the_same_bytes(body: ShapedBody, tmp_path: Path) -> None:
    recipes = {"a": NOISY, "b": NOISY, "c": Recipe(6, (64, 96), seed=4)}
    for name, recipe in recipes.items():
        (tmp_path / name).mkdir()
        list(write_capture(tmp_path / name, Drawn(body, recipe), recipe))
    a, b, c = (
        {path.relative_to(tmp_path / name): path.read_bytes() for path in (tmp_path / name).rglob("*.png")}
        for name in "abc"
    )
    assert a == b and len(a) == 18
    assert len(c) == 12 and all(a[name] != content for name, content in c.items())
    assert np.array_equal(open_capture(tmp_path / "a").fits[2].pose, open_capture(tmp_path / "b").fits[2].pose)


def test_fits_have_the_shape_of_the_look(body: ShapedBody, tmp_path: Path) -> None:
    """Of the hiker, whose body the capture then has, which is another one than the default's."""
    recipe = Recipe(4, (64, 96), look="hiker")
    list(write_capture(tmp_path, Drawn(body, recipe), recipe))
    capture = open_capture(tmp_path)
    assert capture.betas[:6] == pytest.approx(LOOKS["hiker"].betas) and not capture.betas[6:].any()
    wanted = body.body.shape(LOOKS["hiker"].betas).vertices
    assert np.abs(capture.shaped.vertices - wanted).max() < 1e-6
    assert np.abs(wanted - body.vertices).max() > 0.05
    assert "# Look: hiker." in (tmp_path / "capture.toml").read_text()


def test_the_command_writes_all_or_nothing(tmp_path: Path, command: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(synthetic, "SyntheticCapture", Drawn)
    words = ("avatar", "create-data", tmp_path / "new", "--frames", 5, "--picture", "96x64", "--fit-mm", 2)
    out, err = command(*words)
    assert "MB on the disk" in err and str(tmp_path / "new" / "truth") in out
    assert len(open_capture(tmp_path / "new")) == 5
    assert "expected a folder that is not there yet" in command(*words, code=2)[1]
    for wrong in ("96", "96x63", "5000x600", "96x64x3"):
        assert "--picture: found" in command(*words[:2], tmp_path / "w", "--picture", wrong, code=2)[1]

    assert "expected one of default, hiker" in command(*words[:2], tmp_path / "w", "--look", "nobody", code=2)[1]

    def break_off(*_: Any) -> Any:
        raise BadInputError("fits", "a defect", "none")

    monkeypatch.setattr(synthetic, "_write_shot", break_off)
    assert "a defect" in command("avatar", "create-data", tmp_path / "other", "--picture", "96x64", code=2)[1]
    assert [path.name for path in tmp_path.iterdir()] == ["new"]
