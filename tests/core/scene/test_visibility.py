"""What cameras show of bodies whose places are known, and the best place, against searches by plain loops."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.body.joints import Skeleton
from trilane.scene import rotations as rot
from trilane.scene import visibility as search
from trilane.scene.camera.path import CameraPath, one_lens
from trilane.scene.camera_placement import place_camera
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.motion.motion import Motion, Wrap
from trilane.scene.mover import Mover, make_mover, outline
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene
from trilane.scene.visibility import seen_at, seen_notes


def standing(body: ShapedBody, **spec: float) -> Mover:
    return make_mover(AvatarSpec(**spec), BUILTIN["t-pose"](), body)


def walking(body: ShapedBody, speed: float) -> Mover:
    """To the side, 20 seconds long; speed in m/s."""
    places = np.array([[0.0, 0.0, 0.0], [20 * speed, 0.0, 0.0]])
    motion = Motion(np.array([0.0, 20.0]), np.zeros((2, 55, 3)), places, None, (), Wrap.HOLD)
    return make_mover(AvatarSpec(), motion, body)


def film_of_poses(turns: list[F64], places: list[list[float]]) -> CameraPath:
    """One pose a frame, 30 a second, 60 degrees high."""
    quats = rot.quat_from_matrix(np.stack(turns))
    return CameraPath(
        np.arange(len(turns)) / 30, quats, np.array(places, float), one_lens(60.0, 0.1, 50.0), (), Wrap.HOLD
    )


def notes_of(path: CameraPath, frames: int, body: ShapedBody) -> tuple[str, ...]:
    scene, mover = Scene(frames=frames, camera=CameraSpec(place="none")), standing(body)
    return seen_notes(place_camera(path, scene, [mover], [body]), scene, [mover], [body])


@pytest.mark.parametrize("distance", [4.0, 6.0, 12.0])
def test_half_as_near_half_as_large(body: ShapedBody, distance: float) -> None:
    """A level lens of 60 degrees at 0.9 m: a point h above it and d before it is at h / (d tan 30 degrees)."""
    mover, path = standing(body), film_of_poses([np.eye(3)], [[0.0, 0.9, distance]])
    pose, place = mover.sample(0.0)
    points = outline(body).posed(Skeleton(body.joints, body.body.parents).pose(pose, place, mover.world).matrices)
    heights = (points[:, 1] - 0.9) / (distance - points[:, 2]) / math.tan(math.radians(30))
    share = (heights.max() - heights.min()) / 2
    assert notes_of(path, 5, body) == (
        f"whole body in the picture in 100% of the 5 frames, {share:.0%} of its height on average",
    )


@pytest.mark.parametrize(("distance", "hint"), [(18.0, False), (20.0, True)])
def test_a_person_of_a_twelfth_of_the_height_gets_a_hint(body: ShapedBody, distance: float, hint: bool) -> None:
    """1.7 m are 8 % of the height of this lens 18.4 m off. Only a camera from a file that was placed has a unit."""
    mover, path = standing(body), film_of_poses([np.eye(3)], [[0.0, 0.9, distance]])
    camera = place_camera(path, Scene(camera=CameraSpec(place="none")), [mover], [body])
    for spec, said in ((CameraSpec(source="a.txt"), hint), (CameraSpec(), False)):
        notes = seen_notes(camera, Scene(camera=spec), [mover], [body])
        assert any("camera.metres_per_unit" in note for note in notes) == said
    unplaced = Scene(camera=CameraSpec(source="a.txt", place="none"))
    assert len(seen_notes(camera, unplaced, [mover], [body])) == 1


@pytest.mark.parametrize(("speed", "walk"), [(1.0, False), (1.2, True)])
def test_a_person_who_is_small_because_they_walk_far_gets_another_hint(
    body: ShapedBody, speed: float, walk: bool
) -> None:
    """In 300 frames at 30 a second 9.97 s pass: 9.97 m at 1 m/s, 11.96 m at 1.2 m/s."""
    mover, path = walking(body, speed), film_of_poses([np.eye(3)], [[0.0, 0.9, 40.0]])
    camera = place_camera(path, Scene(camera=CameraSpec(place="none")), [mover], [body])
    notes = seen_notes(camera, Scene(camera=CameraSpec(source="a.txt")), [mover], [body])
    assert any("a walk of 12 m; start_s" in note for note in notes) == walk
    assert any("camera.metres_per_unit" in note for note in notes) != walk


def test_all_frames_of_the_run_count(body: ShapedBody) -> None:
    """Of ten frames four look at the person, three past the feet, and three the other way."""
    away, down, ahead = rot.about(1, math.pi), rot.about(0, math.radians(35)), np.eye(3)
    path = film_of_poses([ahead] * 4 + [down] * 3 + [away] * 3, [[0.0, 0.9, 5.0]] * 10)
    (note,) = notes_of(path, 10, body)
    assert note.startswith("whole body in the picture in 40% of the 10 frames, a part of it in 30%, nobody in 30%, ")
    (note,) = notes_of(path, 4, body)
    assert note.startswith("whole body in the picture in 100% of the 4 frames, ")


def test_a_long_run_is_looked_at_evenly(body: ShapedBody) -> None:
    """Held from frame 10 on: the person is in view in the first of 300 of the 60,000 frames alone."""
    path = film_of_poses([np.eye(3)] * 10 + [rot.about(1, math.pi)], [[0.0, 0.9, 5.0]] * 11)
    (note,) = notes_of(path, 60_000, body)
    assert note.startswith("whole body in the picture in 0% of 300 of the 60000 frames, evenly spread, nobody in 100%")


def test_clip_planes_and_the_camera_within_the_body(body: ShapedBody) -> None:
    """Beyond the far plane nobody is seen; through the chest the near plane cuts, and a part is seen."""
    path = film_of_poses([np.eye(3)] * 3, [[0.0, 0.9, 52.0], [0.0, 1.2, 0.0], [0.0, 0.9, 5.0]])
    mover = standing(body)
    camera = place_camera(path, Scene(camera=CameraSpec(place="none")), [mover], [body])
    seen = seen_at(path.times_s, camera, [mover], [body], (480, 640))
    assert seen.nobody.tolist() == [1, 0, 0]
    assert seen.whole.tolist() == [0, 0, 1]


def test_one_of_two_persons_is_not_enough(body: ShapedBody) -> None:
    """Whole means all bodies, nobody means none."""
    path = film_of_poses([np.eye(3)], [[0.0, 0.9, 5.0]])
    movers = [standing(body), make_mover(AvatarSpec(position=(50.0, 0.0, 0.0)), BUILTIN["t-pose"](), body)]
    camera = place_camera(path, Scene(camera=CameraSpec(place="none")), movers, [body, body])
    seen = seen_at(path.times_s, camera, movers, [body, body], (480, 640))
    assert (seen.whole.tolist(), seen.nobody.tolist()) == ([0], [0])


#: Of x and of y: factor and addend to normalised device coordinates.
LENS = ((1.3, 0.05), (1.73, -0.1))
LEVEL = ((1.0, 0.0), (1.0, 0.0))


def box(low: F64, high: F64) -> F64:
    return np.array([[(low, high)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)], dtype=np.float64)


def film(seed: int = 0) -> search.Filming:
    """Three moments of a camera that looks roughly along -Z, and boxes of people about the scene's origin."""
    random = np.random.default_rng(seed)
    turns = np.stack([rot.matrix_from_rotvec(random.normal(0, 0.15, 3)) for _ in range(3)])
    eyes = np.array([20.0, 1.6, -7.0]) + random.normal(0, 0.2, (3, 3))
    lows = np.array([-0.4, 0.0, -0.3]) + random.normal(0, 0.05, (3, 3))
    points = np.stack([box(low, low + np.array([0.8, 1.7, 0.5])) for low in lows])
    return search.Filming(eyes, turns, np.array([LENS] * 3), points)


def still(points: F64, moments: int = 1, lens: tuple[tuple[float, float], ...] = LEVEL) -> search.Filming:
    """A camera at (0, 1, 0) that looks along -Z; a half picture is as wide and as high as the depth."""
    eyes, turns = np.tile([0.0, 1.0, 0.0], (moments, 1)), np.tile(np.eye(3), (moments, 1, 1))
    return search.Filming(eyes, turns, np.tile(lens, (moments, 1, 1)), np.tile(points, (moments, 1, 1)))


def plainly(f: search.Filming, place: F64) -> tuple[float, float, float]:
    """Whole, well, and how near an outermost coordinate comes to the margin: one point after the other."""
    towards = f.eyes[0] - place
    angle = math.atan2(towards[0], towards[2])
    c, s = math.cos(angle), math.sin(angle)
    whole, well, closest = 0, 0.0, 9.0
    for eye, turn, points, ((fx, ax), (fy, ay)) in zip(f.eyes, f.turns, f.points, f.lenses, strict=True):
        rows = []
        for x, y, z in [*points, (points.min(axis=0) + points.max(axis=0)) / 2]:
            right, up, back = turn.T @ (np.array([c * x + s * z, y, c * z - s * x]) + place - eye)
            rows.append((right, up, -back))
        *around, middle = rows
        is_whole = all(depth > 0.3 for *_, depth in around)
        if is_whole:
            ndc = [(abs(fx * x / depth + ax), abs(fy * y / depth + ay)) for x, y, depth in around]
            closest = min(closest, *(abs(max(one) - 0.98) for one in ndc))
            is_whole = max(max(one) for one in ndc) < 0.98
        else:
            closest = min(closest, *(abs(depth - 0.3) for *_, depth in around))
        if is_whole:
            x, y, depth = middle
            heights = [up for _, up, _ in around]
            size = min(fy * (max(heights) - min(heights)) / 2 / depth, 0.75)
            off = max(abs(fx * x / depth + ax), abs(fy * y / depth + ay))
            whole, well = whole + 1, well + size * (1 - 0.5 * min(off, 1) ** 2)
    return whole / len(f.eyes), well / len(f.eyes), closest


def test_how_people_are_shown_from_a_place() -> None:
    f = film()
    random = np.random.default_rng(1)
    places = np.array([20.0, 0.0, -7.0]) + random.uniform([-3, -0.5, -9], [3, 0.5, 1], (300, 3))
    places[200:, 1] = random.uniform(-6, 6, 100)  # many of them wholly above or below the picture
    expected = np.array([plainly(f, place) for place in places])
    clear = expected[:, 2] > 0.01  # a heading is rounded by 0.35 degrees, so a point at the border may fall either way
    assert clear.sum() > 200 and set(np.round(expected[clear, 0], 3)) == {0.0, 0.333, 0.667, 1.0}
    shown = search.PlaceJudge(f).shown(places)
    np.testing.assert_allclose(shown.whole[clear], expected[clear, 0])
    np.testing.assert_allclose(shown.well[clear], expected[clear, 1], atol=4e-3)
    np.testing.assert_allclose(shown.score, shown.whole + 0.03 * shown.well)


@pytest.mark.parametrize(
    ("place", "whole", "well"),
    [
        ([0.0, 0.0, -4.0], 1, 0.25),  # 2 m high, 4 m off: a quarter of a picture of 8 m
        ([0.0, 0.0, -8.0], 1, 0.125),
        ([2.0, 0.0, -4.0], 1, 0.25 * (1 - 0.5 * 0.5**2)),  # halfway to the border
        ([3.9, 0.0, -4.0], 1, 0.25 * (1 - 0.5 * 0.975**2)),
        ([3.94, 0.0, -4.0], 0, 0.0),  # beyond 0.98
        ([0.0, 2.9, -4.0], 1, 0.25 * (1 - 0.5 * 0.725**2)),
        ([0.0, 2.94, -4.0], 0, 0.0),
        ([0.0, 0.0, -1.03], 1, 0.75),  # fills 97 % of the picture, more than is wanted
        ([0.0, 0.0, 4.0], 0, 0.0),  # behind
    ],
)
def test_larger_and_nearer_to_the_middle(place: list[float], whole: float, well: float) -> None:
    """A pole from 0 to 2 m, the eye at 1 m: the share of the picture's height, less half of it at the border."""
    shown = search.PlaceJudge(still(np.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]]))).shown(np.array([place]))
    assert (shown.whole[0], shown.well[0]) == (whole, pytest.approx(well, abs=1e-5))


def test_a_small_person_stands_in_the_middle_rather_than_larger_in_the_corner() -> None:
    """2.5 % of the height in the middle is better than 3 % at the border, and 60 % near it better than 30 % within."""
    judge = search.PlaceJudge(still(np.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]])))
    middle, corner = judge.shown(np.array([[0.0, 0.0, -40.0], [32.0, 0.0, -33.3]])).score
    near, far = judge.shown(np.array([[0.7, 0.0, -1.7], [0.0, 0.0, -3.4]])).score
    assert middle > corner and near > far


def test_nothing_nearer_than_the_near_plane_is_whole() -> None:
    """A pole 0.04 m high is whole 0.29 m off only where the clip planes allow it; 0.3 m is the least."""
    points = np.array([[0.0, -0.02, 0.0], [0.0, 0.02, 0.0]])
    places = np.array([[0.0, 1.0, -away] for away in (0.29, 0.31, 0.79, 0.81)])
    assert search.PlaceJudge(still(points)).shown(places).whole.tolist() == [0, 1, 1, 1]
    far = search.PlaceJudge(replace(still(points), nearest_m=0.8))
    assert far.shown(places).whole.tolist() == [0, 0, 0, 1]
    path = CameraPath(np.zeros(1), np.array([[1.0, 0, 0, 0]]), np.zeros((1, 3)), one_lens(60.0, 0.1, 50.0), ())
    made = [search.filming(path, np.eye(3), np.zeros(1), (480, 640), points[None], near) for near in (0.05, 0.8)]
    assert [one.nearest_m for one in made] == [0.3, 0.8]


def test_who_is_nearly_in_the_picture_leads_a_climb_and_no_more() -> None:
    """The merit rises towards the picture while no moment is whole, by less than one of four moments is worth."""
    points = np.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    f = still(points, 4)
    judge = search.PlaceJudge(f)
    beside = np.array([[x, 0.0, -4.0] for x in (9.0, 7.5, 6.0, 5.0, 4.0)])
    merits = search._merits(f, judge, beside)
    # Half a moment of four, times 1 - (x / 4 - 0.98) as far as that is above 0.
    assert merits == pytest.approx([0, 0.125 * 0.105, 0.125 * 0.48, 0.125 * 0.73, 0.125 * 0.98], abs=1e-5)
    # One moment in which the pole is far off to the side: whole at three moments is more than nearly at four.
    off = search.Filming(
        f.eyes, f.turns, f.lenses, np.concatenate([f.points[:3], f.points[3:] + np.array([40.0, 0, 0])])
    )
    assert search._merits(off, search.PlaceJudge(off), np.array([[0.0, 0.0, -40.0]]))[0] > 0.75 > merits.max()


def test_an_eye_is_never_on_the_floor() -> None:
    """The place that shows most loses with the floor 0.29 m below the eye; at 0.31 m it wins."""
    f = still(np.array([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]]), 2)
    places = np.array([[0.0, 0.69, -2.0], [0.0, 0.71, -2.0], [0.0, 0.0, -30.0]])
    merits = search._merits(f, search.PlaceJudge(f), places)
    assert merits[1] == -1.0 and merits[0] > merits[2] > 1.0
    place, _ = search.best_place(f)
    assert place[1] <= 0.7


def test_seeds_lie_where_the_camera_looks() -> None:
    """The middle of the bodies falls on the rays of the first picture, or on the floor below them."""
    f = film()
    places = search._seeds(f)
    assert (f.eyes[:, 1].min() - places[:, 1] >= 0.3 - 1e-9).all()
    free = places[places[:, 1] < f.eyes[:, 1].min() - 0.3 - 1e-6]
    middle, ((fx, ax), (fy, ay)) = (f.points[0].min(axis=0) + f.points[0].max(axis=0)) / 2, LENS
    on_rays = 0
    for place in free[:40]:
        towards = f.eyes[0] - place - [0, middle[1], 0]
        at = place + rot.about(1, math.atan2(towards[0], towards[2])) @ middle - f.eyes[0]
        right, up, back = f.turns[0].T @ at
        u, v = fx * right / -back + ax, fy * up / -back + ay
        on_rays += all(min(abs(one - at) for at in search.RAYS_AT) < 0.05 for one in (u, v))
    assert on_rays >= 39  # the point that is nearest to all lines of sight is on none


def test_seeds_reach_from_a_full_picture_to_ten_lengths_of_the_path() -> None:
    """A pole of 2 m fills this picture from 1 m off. Seeds begin at 0.7 of that; 30 of it and 10 paths are the end."""
    f = still(np.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), 2)
    assert search._filling_depth(f) == pytest.approx(1.0)
    depths = -search._seeds(f)[:, 2]
    assert depths[depths > 1e-6].min() == pytest.approx(0.7) and 30 <= depths.max() < 30 * 1.25
    eyes = np.array([[-20.0, 1.0, 0.0], [20.0, 1.0, 0.0]])
    depths = -search._seeds(replace(f, eyes=eyes))[:, 2]
    assert 430 <= depths.max() < 430 * 1.25


def test_people_far_apart_are_searched_far_off() -> None:
    """Two poles 200 m apart fill this picture from 100 m off, whatever their height; a whole view is found."""
    f = still(np.array([[-100.0, 0.0, 0.0], [-100.0, 2.0, 0.0], [100.0, 0.0, 0.0], [100.0, 2.0, 0.0]]), 2)
    assert search._filling_depth(f) == pytest.approx(100.0)
    place, score = search.best_place(f)
    assert score > 1 and 100 / 0.98 - 1 < -place[2] < 130


def test_the_outermost_points_of_all_bodies(body: ShapedBody) -> None:
    """Two avatars in the T pose, 3 m apart: the points reach from the hand of one to that of the other."""
    movers = [make_mover(AvatarSpec(position=(x, 0.0, 1.0)), BUILTIN["t-pose"](), body) for x in (-1.5, 1.5)]
    points = search.outermost_points(np.array([0.0, 1.0]), movers, [body, body])
    rest = body.vertices - body.joints[0]
    wide, deep = rest[:, 0].max() + 1.5, 1 + rest[:, 2].max()
    assert points.shape[::2] == (2, 3)
    assert points[1].max(axis=0) == pytest.approx([wide, np.ptp(rest[:, 1]), deep], abs=0.01)
    assert points[0].min(axis=0) == pytest.approx([rest[:, 0].min() - 1.5, 0, 1 + rest[:, 2].min()], abs=0.01)
