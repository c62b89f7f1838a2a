"""NeRF cameras by value: pixels, lenses and refusals worked out by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.camera_files import angle, load, nerf_text, pixel, pose_z_up
from trilane.errors import BadInputError
from trilane.scene.camera import nerf


def test_a_nerf_view_puts_points_at_their_pixels(tmp_path: Path) -> None:
    """fl_y = 600 of 480 rows: at (1, 2, 3), 4 m along +Y, 0.5 m right (+X), 1 m up (+Z) is 150 above the middle."""
    (tmp_path / "a.json").write_text(nerf_text(pose_z_up(0, (1, 2, 3)), fl_y=600, h=480, fl_x=300, w=640))
    assert pixel(load(tmp_path / "a.json"), [1.5, 4.0, -6.0]) == pytest.approx((320 + 300 / 8, 90))
    lens = {"fl_y": 600, "h": 480, "fl_x": 300, "w": 640, "cx": 310, "cy": 260}
    (tmp_path / "a.json").write_text(nerf_text(pose_z_up(0, (1, 2, 3)), **lens))
    assert pixel(load(tmp_path / "a.json"), [1.5, 4.0, -6.0]) == pytest.approx((310 + 300 / 8, 110))
    (tmp_path / "a.json").write_text(nerf_text(pose_z_up(0, (1, 2, 3))[:3]))  # 3x4 is enough
    load(tmp_path / "a.json")


#: Keys of the file -> field of view of height and width (by tangents of their halves), and where they come from.
LENSES: list[tuple[dict[str, float], float, float, str]] = [
    ({"fl_y": 400, "h": 480, "w": 640}, 0.6, 0.8, "by `fl_y`"),
    ({"fl_y": 400, "h": 480}, 0.6, 0.8, "by `fl_y`"),  # the usual aspect, 4:3
    ({"fl_y": 400, "h": 480, "w": 640, "fl_x": 800, "camera_angle_x": 1.0}, 0.6, 0.4, "by `fl_x` and `fl_y`"),
    ({"fl_x": 500, "w": 800, "h": 400}, 0.4, 0.8, "by `fl_x`"),
    ({"fl_x": 500, "w": 800}, 0.6, 0.8, "by `fl_x`"),
    ({"fl_x": 500, "w": 800, "h": 400, "fl_y": 100}, 2.0, 0.8, "by `fl_x` and `fl_y`"),
    ({"fl_y": 500, "w": 800, "camera_angle_x": math.pi / 2}, 0.75, 1.0, "by `camera_angle_x`"),  # no `h`
    ({"fl_x": 500, "h": 800, "camera_angle_x": math.pi / 2}, 0.75, 1.0, "by `camera_angle_x`"),  # no `w`
    ({"camera_angle_x": math.pi / 2, "w": 1000, "h": 500}, 0.5, 1.0, "by `camera_angle_x`"),
    ({"camera_angle_y": math.pi / 2}, 1.0, 4 / 3, "by `camera_angle_y`"),  # the usual aspect
    ({"camera_angle_y": math.pi / 2, "w": 1000, "h": 500}, 1.0, 2.0, "by `camera_angle_y`"),
    (
        {"camera_angle_x": math.pi / 2, "camera_angle_y": 2 * math.atan(0.4), "w": 1000, "h": 500},
        0.4,
        1.0,
        "by `camera_angle_x` and `camera_angle_y`",
    ),
    ({"camera_angle_x": math.pi / 2, "camera_angle_y": 1.0}, 0.75, 1.0, "by `camera_angle_x`"),  # square pixels
    (
        {"fl_x": 500, "cx": 400, "cy": 300},
        math.tan(math.radians(25)) * 0.75,
        math.tan(math.radians(25)),
        "usual, as focal lengths in pixels need `w` and `h`",
    ),
    ({"w": 1000, "h": 500}, math.tan(math.radians(25)) / 2, math.tan(math.radians(25)), "usual, as the file has none"),
]


@pytest.mark.parametrize(("keys", "tan_y", "tan_x", "note"), LENSES)
def test_the_lens_of_height_and_of_width(
    tmp_path: Path, keys: dict[str, float], tan_y: float, tan_x: float, note: str
) -> None:
    """Held upright, the picture's width becomes its height: a level and a rolled view tell the two apart."""
    roll = np.eye(4)
    roll[:2, :2] = [[0, -1], [1, 0]]
    for matrix, tangent in ((pose_z_up(0), tan_y), (pose_z_up(0) @ roll, tan_x)):
        (tmp_path / "a.json").write_text(nerf_text(matrix, **keys))
        camera = load(tmp_path / "a.json", up_axis="z")
        assert camera.lens(0.0, (480, 640)).fov_y_deg == pytest.approx(angle(tangent))
        assert camera.notes[2] == f"field of view {angle(tangent):.4g} degrees high, {note}"


def test_the_principal_point_counts_where_only_an_angle_is_known(tmp_path: Path) -> None:
    """f is 320 px of 640x480 at 90 degrees; at (1, 2, 3), 4 m along +Y, 0.5 m right is 40 px, 1 m up 80."""
    lens = {"camera_angle_x": math.pi / 2, "w": 640, "h": 480, "cx": 192, "cy": 336}
    (tmp_path / "a.json").write_text(nerf_text(pose_z_up(0, (1, 2, 3)), **lens))
    assert pixel(load(tmp_path / "a.json"), [1.5, 4.0, -6.0]) == pytest.approx((192 + 40, 336 - 80))


@pytest.mark.parametrize("model", ["EQUIRECTANGULAR", "OMNIDIRECTIONALSTEREO_L", "VR180_R", "ORTHOPHOTO"])
def test_pictures_that_no_lens_makes_are_refused(tmp_path: Path, model: str) -> None:
    text = json.loads(nerf_text(pose_z_up(0), fl_x=500, w=800, h=400))
    for table in (text, text["frames"][0]):
        table["camera_model"] = model
        (tmp_path / "a.json").write_text(json.dumps(text))
        del table["camera_model"]
        with pytest.raises(BadInputError, match=f"camera_model: found {model}, .*; cut the pictures into perspective"):
            load(tmp_path / "a.json")


def test_views_a_step_apart_are_a_film_or_stills(tmp_path: Path) -> None:
    for step, times, note in (
        (5.9, [0, 1 / 30, 2 / 30], "30 a second assumed"),
        (6.1, [0, 1, 2], "stills 6 degrees apart, 1 a second"),
        (90.0, [0, 1, 2], "stills 90 degrees apart, 1 a second"),
    ):
        (tmp_path / "a.json").write_text(nerf_text(*(pose_z_up(k * step) for k in range(3))))
        camera = load(tmp_path / "a.json")
        assert camera.times_s == pytest.approx(times)
        assert camera.notes[0] == f"NeRF transforms, 3 views, no times: {note}, camera to world"
    assert nerf.MAX_FRAMES == 100_000


ONE = pose_z_up(0).tolist()


REFUSED: dict[str, tuple[Any, str]] = {
    "list": (
        [],
        ": found no list `frames`, expected a NeRF transforms.json: `frames`, each with a 4x4 `transform_matrix`",
    ),
    "frames": ({"frames": {}}, ": found no list `frames`, expected"),
    "none": ({"frames": []}, ": frames: found 0 frames, expected 1 to 100000"),
    "number": ({"frames": [3]}, ": frames[0].transform_matrix: found shape (), expected a 4x4 matrix"),
    "text": (
        {"frames": [{"transform_matrix": ONE}, {"transform_matrix": "x"}]},
        ": frames[1].transform_matrix: found something else than numbers, expected a 4x4 matrix",
    ),
    "shape": (
        {"frames": [{"transform_matrix": [[1] * 4] * 5}]},
        ": frames[0].transform_matrix: found shape (5, 4), exp",
    ),
    "no directions": (
        {"frames": [{"transform_matrix": ONE}] * 3 + [{"transform_matrix": [[0] * 4] * 4}]},
        ": frames[3].transform_matrix: found a matrix without an inverse, expected a 4x4 matrix, camera to world; "
        "leave this view out",
    ),
    "two directions": (
        {"frames": [{"transform_matrix": [[1, 2, 0, 5], [0, 0, 1, 5], [0, 0, 0, 5]]}]},
        ": frames[0].transform_matrix: found a matrix without an inverse",
    ),
    "no last row": (
        {"frames": [{"transform_matrix": [[1, 0, 0, 5], [0, 1, 0, 5], [0, 0, 1, 5], [0] * 4]}]},
        ": frames[0].transform_matrix: found a matrix without an inverse",
    ),
    "no rotation": (
        {"frames": [{"transform_matrix": [[2, 0, 0, 5], [0, 1, 0, 5], [0, 0, 1, 5], [0, 0, 0, 1]]}]},
        ": found 1 samples that are no rotation (first: frames[0].transform_matrix) and 0 times",
    ),
    "true": ({"frames": [{"transform_matrix": ONE}], "w": True}, ": w: found True, expected a positive number"),
    "zero": ({"frames": [{"transform_matrix": ONE}], "h": 0}, ": h: found 0, expected a positive number"),
    "words": (
        {"frames": [{"transform_matrix": ONE}], "fl_x": "x" * 50},
        f": fl_x: found '{'x' * 39}, expected a positive",
    ),
    "infinite": (
        {"frames": [{"transform_matrix": ONE}], "fl_y": math.inf},
        ": fl_y: found inf, expected a positive nu",
    ),
    "pi": (
        {"frames": [{"transform_matrix": ONE}], "camera_angle_x": math.pi},
        ": camera_angle_x: found 3.14159, expected an angle in radians below pi",
    ),
    "wide": (
        {"frames": [{"transform_matrix": ONE}], "fl_y": 1, "h": 24, "w": 24},
        ": found a field of view of 170.5 degrees over the height, expected 1 to 170",
    ),
    "narrow": (
        {"frames": [{"transform_matrix": ONE}], "fl_y": 60, "h": 1, "w": 60},
        ": found a field of view of 0.9549 degrees over the height, expected 1 to 170",
    ),
    "wide only across": (
        {"frames": [{"transform_matrix": ONE}], "fl_y": 1, "h": 2, "w": 24},
        ": found a field of view of 170.5 degrees over the width, expected 1 to 170",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_wrong_nerf_file_is_refused_in_one_sentence(tmp_path: Path, case: str) -> None:
    content, sentence = REFUSED[case]
    path = tmp_path / "a.json"
    path.write_text(json.dumps(content))
    with pytest.raises(BadInputError) as raised:
        load(path)
    assert f"{path}{sentence}" in str(raised.value)


def test_fields_of_view_just_inside_the_range_are_read(tmp_path: Path) -> None:
    for degrees in (1.1, 169.0):
        tangent = math.tan(math.radians(degrees / 2))
        (tmp_path / "a.json").write_text(nerf_text(pose_z_up(0), fl_y=100.0, h=200 * tangent, w=200 * tangent))
        assert load(tmp_path / "a.json").lens(0.0, (480, 640)).fov_y_deg == pytest.approx(degrees)


def test_a_nerf_file_may_have_so_many_views(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nerf, "MAX_FRAMES", 2)
    (tmp_path / "a.json").write_text(nerf_text(*[pose_z_up(0)] * 2))
    load(tmp_path / "a.json")
    (tmp_path / "a.json").write_text(nerf_text(*[pose_z_up(0)] * 3))
    with pytest.raises(BadInputError, match="found 3 frames, expected 1 to 2"):
        load(tmp_path / "a.json")
