"""Cameras: conventions of each format, what is repaired and noted, what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilane.errors import BadInputError
from trilane.scene.camera.files import load_camera
from trilane.scene.camera.path import ORBITS, CameraPath, look_at, projection_matrix
from trilane.scene.rotations import Y_UP_FROM_Z_UP, about, matrix_from_quat, quat_from_matrix
from trilane.scene.schema import CameraSpec

OPTICAL = np.diag([1.0, -1.0, -1.0])


def load(source: Path | str, **spec: Any) -> CameraPath:
    return load_camera(CameraSpec(source=str(source), **spec), Path("/"))


def path_of_poses(count: int = 5) -> list[tuple[np.ndarray, np.ndarray]]:
    """Camera to world, OpenGL axes, Y up: turns left, climbs, looks a little down."""
    return [
        (about(1, np.array(0.1 * k)) @ about(0, np.array(-0.2)), np.array([0.1 * k, 1.5, 2.0])) for k in range(count)
    ]


def arkit_line(t: float, turn: np.ndarray, place: np.ndarray) -> str:
    return " ".join(f"{value:.12g}" for value in (t, *np.column_stack([turn, place]).ravel()))


def write_arkit(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join(["# log", *lines, ""]))
    return path


def arkit(tmp_path: Path, roll: float = 0.0) -> Path:
    lines = [
        arkit_line(1e14 + k * 2e7, turn @ about(2, np.array(roll)), place)
        for k, (turn, place) in enumerate(path_of_poses())
    ]
    return write_arkit(tmp_path / "arkit.txt", lines)


def check_path(camera: CameraPath, step_s: float) -> None:
    """The path is `path_of_poses`."""
    for k, (turn, place) in enumerate(path_of_poses()):
        actual_turn, actual_place = camera.pose(k * step_s)
        assert actual_turn == pytest.approx(turn, abs=1e-6)
        assert actual_place == pytest.approx(place, abs=1e-6)


def test_arkit_is_opengl_camera_to_world_in_nanoseconds(tmp_path: Path) -> None:
    camera = load(arkit(tmp_path))
    check_path(camera, 0.02)
    assert "time in ns" in camera.notes[0]
    assert camera.recorded


@pytest.mark.parametrize("quarter", [1, 2, 3])
def test_a_turned_device_gives_an_upright_picture(tmp_path: Path, quarter: int) -> None:
    camera = load(arkit(tmp_path, roll=-quarter * np.pi / 2))
    check_path(camera, 0.02)
    assert f"the picture is turned by {quarter * 90} degrees" in " ".join(camera.notes)


def test_tum_is_optical_and_z_up(tmp_path: Path) -> None:
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for k, (turn, place) in enumerate(path_of_poses()):
        w, x, y, z = quat_from_matrix(Y_UP_FROM_Z_UP.T @ turn @ OPTICAL)
        tx, ty, tz = Y_UP_FROM_Z_UP.T @ place
        lines.append(f"{1305031098.5 + k * 0.5:.4f} {tx} {ty} {tz} {x} {y} {z} {w}")
    (tmp_path / "tum.txt").write_text("\n".join(lines))
    camera = load(tmp_path / "tum.txt")
    check_path(camera, 0.5)
    assert "Z up" in camera.notes


def nerf_file(path: Path, **extra: Any) -> Path:
    frames = []
    for turn, place in path_of_poses():
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = Y_UP_FROM_Z_UP.T @ turn, Y_UP_FROM_Z_UP.T @ place
        frames.append({"file_path": "x.png", "transform_matrix": matrix.tolist()})
    path.write_text(json.dumps({"frames": frames, **extra}))
    return path


def test_nerf_is_opengl_and_z_up_with_its_own_lens(tmp_path: Path) -> None:
    camera = load(nerf_file(tmp_path / "transforms.json", fl_y=400.0, h=480, w=640))
    check_path(camera, 1 / 30)
    assert camera.lens(0.0, (480, 640)).fov_y_deg == pytest.approx(np.degrees(2 * np.arctan(240 / 400)))
    assert "by `fl_y`" in " ".join(camera.notes)


@pytest.mark.parametrize(("extra", "fov_y"), [
    ({"camera_angle_x": 1.0, "w": 800, "h": 800}, 1.0),
    ({"fl_x": 500, "w": 1000, "h": 500}, 2 * np.arctan(0.5)),
    ({}, 2 * np.arctan(np.tan(np.radians(25)) * 0.75)),
])  # fmt: skip
def test_the_lens_of_a_nerf_file(tmp_path: Path, extra: dict[str, float], fov_y: float) -> None:
    camera = load(nerf_file(tmp_path / "transforms.json", **extra))
    assert camera.lens(0.0, (480, 640)).fov_y_deg == pytest.approx(np.degrees(fov_y))
    assert load(tmp_path / "transforms.json", fov_y_deg=33.0).lens(0.0, (480, 640)).fov_y_deg == pytest.approx(33.0)


def test_holes_in_a_log_are_mended_and_said(tmp_path: Path) -> None:
    poses = path_of_poses(12)
    times = [0, 20, 40, 60, 60, 50, 120, 140, 160, 180, 200, 220]
    lines = [arkit_line(1e14 + t * 1e6, *pose) for t, pose in zip(times, poses, strict=True)]
    lines[9] = arkit_line(1e14 + 180e6, np.full((3, 3), np.nan), np.zeros(3))
    lines[8] = arkit_line(1e14 + 160e6, np.eye(3) * 2, np.zeros(3))
    camera = load(write_arkit(tmp_path / "a.txt", lines))
    notes = " ".join(camera.notes)
    assert "2 samples not finite or no rotation (first: line 10)" in notes
    assert "2 samples with repeated or decreasing times left out" in notes
    assert "gaps, the longest 60 ms" in notes
    assert (np.diff(camera.times_s) > 0).all()
    assert np.isfinite(camera.sample(0.17)).all()


WRONG = {
    "columns": ("1 2 3\n", "3 columns"),
    "ragged": (arkit_line(0, np.eye(3), np.ones(3)) + "\n1 2\n", "line 2"),
    "words": (" ".join(["x"] * 13), "could not convert"),
    "comments only": ("# nothing\n", "0 columns"),
    "no rotations": (arkit_line(0, np.zeros((3, 3)), np.zeros(3)), "1 samples that are no rotation"),
    "empty": ("", "an empty file"),
    "not json": ("{", "no valid JSON"),
    "no frames": ("{}", "no list `frames`"),
    "zero frames": ('{"frames": []}', "0 frames"),
    "no matrix": ('{"frames": [{}]}', "frames[0].transform_matrix"),
    "bad matrix": ('{"frames": [{"transform_matrix": [[1]]}]}', "shape (1, 1)"),
    "bad lens": ('{"frames": [{"transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}], "fl_x": -1}', "fl_x"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_files_are_refused_by_name(tmp_path: Path, case: str) -> None:
    text, found = WRONG[case]
    path = tmp_path / ("a.json" if "{" in text else "a.txt")
    path.write_text(text)
    with pytest.raises(BadInputError) as raised:
        load(path)
    assert str(path) in str(raised.value)
    assert found in str(raised.value)


def test_no_such_camera() -> None:
    with pytest.raises(BadInputError, match="orbit"):
        load("builtin:drone")
    with pytest.raises(BadInputError, match="no such file"):
        load("/nowhere/log.txt")


@given(st.text(max_size=200))
@settings(max_examples=60)
def test_any_text_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.mktemp("any") / "a.txt"
    path.write_text(text, encoding="utf-8")
    for kind in ("auto", "arkit", "tum", "nerf"):
        try:
            load(path, format=kind)
        except BadInputError as error:
            assert "a.txt" in str(error)


def test_one_pose_is_held_and_a_path_runs_back(tmp_path: Path) -> None:
    still = load(write_arkit(tmp_path / "one.txt", [arkit_line(5.0, *path_of_poses(1)[0])]))
    assert still.course == "one pose: held"
    assert still.sample(123.0) == pytest.approx(still.sample(0.0))
    camera = load(arkit(tmp_path))
    assert camera.sample(0.08 + 0.03) == pytest.approx(camera.sample(0.08 - 0.03))


def test_views_are_rigid_and_between_samples_on_the_arc(tmp_path: Path) -> None:
    camera = load(arkit(tmp_path))
    view = camera.sample(0.031)
    assert view[:3, :3] @ view[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    between = about(1, np.array(0.155)) @ about(0, np.array(-0.2))
    assert np.abs(view[:3, :3].T - between).max() < 1e-4


@pytest.mark.parametrize("name", ORBITS)
def test_built_in_cameras_are_level_cyclic_and_look_at_their_target(name: str) -> None:
    camera = load(f"builtin:{name}")
    orbit = ORBITS[name]
    assert not camera.recorded
    assert camera.sample(1.0) == pytest.approx(camera.sample(1.0 + orbit.period_s), abs=1e-9)
    for t_s in (0.0, 2.3, 7.7):
        x, y, z, _ = camera.sample(t_s) @ [*orbit.target, 1.0]
        assert abs(x) < 1e-2
        assert abs(y) < 1e-2
        assert orbit.near_m - 0.1 < -z < orbit.far_m + 0.5


def test_the_projection_maps_the_frustum_to_the_cube() -> None:
    matrix = projection_matrix(60.0, 2.0, 0.1, 50.0)
    for depth, expected in ((0.1, -1.0), (50.0, 1.0)):
        top = depth * np.tan(np.radians(30))
        clip = matrix @ [2 * top, top, -depth, 1.0]
        assert clip[:3] / clip[3] == pytest.approx([1.0, 1.0, expected])


def test_look_at_puts_the_target_ahead_and_up_above() -> None:
    view = look_at(np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.0, 0.0]))
    assert view @ [1, 2, 3, 1] == pytest.approx([0, 0, 0, 1])
    assert (view @ [0, 1, 0, 1])[:2] == pytest.approx([0, 0])
    assert (view @ [0, 2, 0, 1])[1] > 0


def test_real_logs_are_what_they_are(shared_data: Path) -> None:
    arkit_log = load(shared_data / "camera" / "arkit_camera_pose.txt")
    assert "Y up, device held so that the picture is turned by 90 degrees" in arkit_log.notes
    assert any("1 gaps, the longest 33 ms" in note for note in arkit_log.notes)
    tum_log = load(shared_data / "camera" / "tum_freiburg1_xyz.txt")
    assert "Z up" in tum_log.notes
    assert any("1 gaps, the longest 110 ms" in note for note in tum_log.notes)
    for camera in (arkit_log, tum_log):
        ups = matrix_from_quat(camera.quats)[:, 1, 1]
        assert np.median(ups) > 0.6
