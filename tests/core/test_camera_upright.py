"""Which way is up in a recording: first-camera coordinates, turned devices, tilted worlds, far-off maps."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from trilane.scene.camera.recorded import MAP_M, UP, find_upright, near_origin
from trilane.scene.rotations import about, matrix_from_rotvec

OPTICAL = np.diag([1.0, -1.0, -1.0])


def pan(degrees: float, pitch_deg: float, roll_deg: float = 0.0, count: int = 31) -> np.ndarray:
    """Level cameras (N, 3, 3) in a Y-up world that turn by `degrees` to either side; their pictures rolled."""
    headings = np.radians(degrees) * np.linspace(-1, 1, count)
    return about(1, headings) @ about(0, math.radians(pitch_deg)) @ about(2, math.radians(roll_deg))


@pytest.mark.parametrize("pitch", [-25.0, 0.0, 25.0])
@pytest.mark.parametrize("degrees", [5.0, 30.0, 170.0])
def test_first_camera_coordinates(degrees: float, pitch: float) -> None:
    """World axes are the first view's optical ones; up is -Y, or where the horizons are level if that was tilted."""
    turns = pan(degrees, pitch)
    first = turns[len(turns) // 2] @ OPTICAL  # columns: right, down, ahead
    found = find_upright(first.T @ turns, "z", is_levelled=False)
    assert found.quarter == 0
    true = first.T @ [0.0, 1.0, 0.0]
    allowed = 1e-6 if pitch == 0.0 or degrees == 170.0 else abs(math.radians(pitch)) + 1e-6
    assert math.acos(min(1.0, float(found.up @ true))) < allowed, found.note


def test_a_map_of_the_first_picture_that_does_not_tell_its_pitch_says_so() -> None:
    """It pans by 5 degrees, looking down by 20: the axes are taken for level, and nothing else is known."""
    turns = pan(5.0, -20.0)
    said = "; the axes are those of the first picture: if that looked down or up, the floor is tilted by as much"
    for axes, up in ((OPTICAL, "-Y"), (np.eye(3), "Y")):
        own = (turns[0] @ axes).T @ turns
        assert find_upright(own, "-y" if up == "-Y" else "y", is_levelled=False).note.removesuffix(said) == f"{up} up"
        assert find_upright(own, "-y", is_levelled=False).note.endswith(said)
        assert not find_upright(own, "y", is_levelled=True).note.endswith(said)  # gravity is known
        assert not find_upright(own[:1], "-y", is_levelled=False).note.endswith(said)  # one picture makes no map
    wide = pan(170.0, -20.0)
    assert not find_upright((wide[0] @ OPTICAL).T @ wide, "-y", is_levelled=False).note.endswith(
        said
    )  # the horizons tell it
    assert not find_upright(about(1, 0.01) @ wide[:2], "y", is_levelled=False).note.endswith(said)


@pytest.mark.parametrize(("degrees", "pitch"), [(0, 0), (0, -20), (5, -20), (15, -50), (45, -50), (120, -35), (170, 0)])
def test_up_is_found_in_every_axis_system(degrees: float, pitch: float) -> None:
    """Where the camera looks within 20 degrees of level, or pans by 15 either way; held by hand, 2 degrees off."""
    rng = np.random.default_rng(18)
    turns = pan(degrees, pitch) @ about(0, rng.normal(0, 0.035, 31)) @ about(2, rng.normal(0, 0.035, 31))
    for order, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1.0, -1.0), repeat=3)):
        system = np.eye(3)[list(order)] * np.array(signs)[:, None]
        if np.linalg.det(system) < 0:
            continue
        for usual in ("y", "z", "-y"):
            found = find_upright(system @ turns, usual, is_levelled=False)
            assert found.quarter == 0 and found.up @ system[:, 1] == pytest.approx(1.0), found.note


@pytest.mark.parametrize("quarter", range(4))
def test_a_turned_device_is_believed_where_its_horizon_says_so(quarter: int) -> None:
    """A pan of 40 degrees either way; a picture on its head is rather one of a world with another up."""
    turns = pan(40.0, -10.0, roll_deg=-90.0 * quarter)
    for is_levelled in (True,) if quarter == 2 else (False, True):
        found = find_upright(turns, "y", is_levelled)
        assert (found.up.tolist(), found.quarter) == ([0.0, 1.0, 0.0], quarter), found.note


def test_a_turn_is_not_believed_before_every_axis() -> None:
    """One view that is turned by 90 degrees: in a world that may be any, its own up; in a levelled one the turn."""
    turns = pan(0.0, 0.0, roll_deg=-90.0, count=1)
    assert find_upright(turns, "y", is_levelled=False).note == (
        "X up, as the camera is held (not Y, usual for the format)"
    )
    assert (
        find_upright(turns, "y", is_levelled=True).note
        == "Y up, device held so that the picture is turned by 90 degrees"
    )


def test_horizons_decide_where_a_camera_looks_down() -> None:
    """50 degrees down, panning by 20 either way: -Z, the usual axis, is nearer to the pictures' up, but not level."""
    turns = pan(20.0, -50.0)
    assert (turns[:, :, 1] @ UP["-z"]).mean() > (turns[:, :, 1] @ UP["y"]).mean() > 0.6
    assert find_upright(turns, "-z", is_levelled=False).up.tolist() == list(UP["y"])


def test_a_near_rival_is_named() -> None:
    """Looking 59 degrees down, a still camera in a Z-up world and a level one in another look nearly alike."""
    turns = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ pan(0.0, -59.0, count=1)
    note = find_upright(turns, "z", is_levelled=False).note
    assert "fits nearly as well: camera.up_axis decides" in note
    assert find_upright(turns, "z", is_levelled=False, stated="z").note == "Z up, as given"


@pytest.mark.parametrize("seed", range(5))
def test_a_tilted_world_is_levelled_by_its_horizons(seed: int) -> None:
    """Photos round an object, in a world that is turned anyhow: up is found within the noise of the horizons."""
    rng = np.random.default_rng(seed)
    system = matrix_from_rotvec(rng.uniform(-2, 2, 3))
    turns = pan(120.0, -20.0) @ about(2, rng.normal(0, 0.03, 31))
    found = find_upright(system @ turns, "-y", is_levelled=False)
    assert math.degrees(math.acos(found.up @ (system @ [0.0, 1.0, 0.0]))) < 2.0
    assert "where the pictures' horizons are level" in found.note


def test_pictures_without_a_horizon_keep_the_usual_axis() -> None:
    """A camera that looks straight down and turns: no axis is on average above its pictures but the one behind it."""
    turns = about(1, np.linspace(0, 2 * math.pi, 32, endpoint=False)) @ about(0, -math.pi / 2)
    found = find_upright(turns, "y", is_levelled=True)
    assert found.up.tolist() == list(UP["y"]) and "usual for the format" in found.note


def test_the_offset_of_a_map_is_taken_off_and_said() -> None:
    places = np.array([[500_010.0, 5_400_020.0, 300.0], [500_012.4, 5_400_020.0, 300.0], [np.nan, 0, 0]])
    near, notes = near_origin(places)
    assert near[1] - near[0] == pytest.approx([2.4, 0, 0]) and np.abs(near[:2]).max() < 2.0
    assert notes == ("origin of the map moved: (500011, 5400020, 300) subtracted from all places",)
    for kept in (np.full((3, 3), MAP_M), np.full((2, 3), np.nan)):
        assert near_origin(kept)[1] == () and near_origin(kept)[0] is kept
