"""Where a recorded camera is put, against plain loops, and how a person turns it, against one put there by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.scene import camera_placement as placement
from trilane.scene import rotations as rot
from trilane.scene.camera.path import CameraPath, look_at, one_lens
from trilane.scene.camera_placement import HIGHEST_DEG, LOWEST_DEG, PlacedCamera, steered
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.motion.motion import Wrap
from trilane.scene.mover import make_mover
from trilane.scene.schema import AvatarSpec, CameraSpec, OutputSpec, Scene
from trilane.scene.visibility import seen_at

#: Of x and of y: factor and addend to normalised device coordinates.
LENS = ((1.3, 0.05), (1.73, -0.1))


def path(turns: list[np.ndarray], places: list[list[float]], recorded: bool = True) -> CameraPath:
    quats = rot.quat_from_matrix(np.stack(turns))
    times = np.arange(len(turns)) / 30
    return CameraPath(
        times, quats, np.array(places, float), one_lens(60.0, 0.1, 50.0), ("path",), Wrap.BOUNCE, recorded
    )


def footage(seed: int = 0) -> placement._Footage:
    """Three frames of a camera that looks roughly along -Z, and boxes of people about the scene's origin."""
    random = np.random.default_rng(seed)
    turns = [rot.matrix_from_rotvec(random.normal(0, 0.15, 3)) for _ in range(3)]
    eyes = np.array([20.0, 1.6, -7.0]) + random.normal(0, 0.2, (3, 3))
    views = np.stack([np.column_stack([turn.T, -turn.T @ eye]) for turn, eye in zip(turns, eyes, strict=True)])
    lows = np.array([-0.4, 0.0, -0.3]) + random.normal(0, 0.05, (3, 3))
    highs = lows + np.array([0.8, 1.7, 0.5])
    boxes = np.stack([
        [[(low, high)[(k >> axis) & 1][axis] for axis in range(3)] for k in range(8)]
        for low, high in zip(lows, highs, strict=True)
    ])  # fmt: skip
    return placement._Footage(views.astype(np.float32), eyes, boxes, np.array([LENS] * 3))


def plain_visibility(f: placement._Footage, place: np.ndarray) -> tuple[float, float]:
    """One corner of one frame after the other."""
    towards = f.eyes[0] - place
    c, s = math.cos(math.atan2(towards[0], towards[2])), math.sin(math.atan2(towards[0], towards[2]))
    whole, tall = 0, 0.0
    for view, box in zip(f.views, f.boxes, strict=True):
        rows, inside, front = [], True, True
        for x, y, z in box:
            right, up, back = view @ [c * x + s * z + place[0], y + place[1], c * z - s * x + place[2], 1.0]
            depth = max(-back, 0.3)
            u, v = right * LENS[0][0] / depth + LENS[0][1], up * LENS[1][0] / depth + LENS[1][1]
            front &= bool(-back > 0.3)
            inside &= bool(abs(u) < 0.97 and abs(v) < 0.97)
            rows.append(min(max(v, -1.0), 1.0))
        whole += inside and front
        tall += (max(rows) - min(rows)) / 2 if inside and front else 0.0
    return whole / len(f.boxes), tall / len(f.boxes)


def test_how_much_of_the_people_is_seen_from_a_place() -> None:
    f = footage()
    random = np.random.default_rng(1)
    ahead = np.array([20.0, 0.0, -7.0]) + random.uniform([-3, -0.5, -9], [3, 0.5, 1], (300, 3))
    ahead[200:, 1] = random.uniform(-6, 6, 100)  # many of them wholly above or below the picture
    whole, size = placement._visibility(f, ahead)
    expected = np.array([plain_visibility(f, place) for place in ahead])
    assert set(np.round(expected[:, 0], 3)) == {0.0, 0.333, 0.667, 1.0}
    np.testing.assert_allclose(whole, expected[:, 0])
    np.testing.assert_allclose(size, expected[:, 1], atol=1e-5)
    score = expected[:, 0] + 0.05 * np.minimum(expected[:, 1], 0.75)
    score[f.eyes[:, 1].min() - ahead[:, 1] < 0.3] = -1.0
    np.testing.assert_array_equal(placement._best(f, ahead), ahead[int(np.argmax(score))])


def test_an_eye_is_never_on_the_floor() -> None:
    """The place that shows most, but with the floor 0.29 m below the eye, loses; at 0.31 m it wins."""
    f = footage()
    eye = float(f.eyes[:, 1].min())
    good, poor = np.array([20.0, 0.0, -11.0]), np.array([20.0, 0.0, -30.0])
    for below, wins in ((0.31, True), (0.29, False)):
        places = np.array([poor, [good[0], eye - below, good[2]]])
        scores = [a + 0.05 * min(b, 0.75) for a, b in (plain_visibility(f, place) for place in places)]
        best = placement._best(f, places)
        assert (best == places[1]).all() == (wins and scores[1] > scores[0])
        assert scores[1] > 0 or not wins


def test_seeds_lie_where_the_camera_looks() -> None:
    """The middle of the bodies falls on the rays of the first picture, at distances that grow by a quarter."""
    f = footage()
    places = placement._seeds(f)
    assert (f.eyes[:, 1].min() - places[:, 1] >= 0.3 - 1e-9).all()
    free = places[places[:, 1] < f.eyes[:, 1].min() - 0.3 - 1e-6]
    middle = f.boxes[0].mean(axis=0)
    for place in free[:40]:
        towards = f.eyes[0] - place - [0, middle[1], 0]
        turn = rot.about(1, math.atan2(towards[0], towards[2]))
        right, up, back = f.views[0] @ np.append(place + turn @ middle, 1.0)
        u, v = right * LENS[0][0] / -back + LENS[0][1], up * LENS[1][0] / -back + LENS[1][1]
        assert (
            min(abs(u - at) for at in placement.RAYS_AT) < 0.05 and min(abs(v - at) for at in placement.RAYS_AT) < 0.05
        )
    far = np.linalg.norm(places - f.eyes.mean(axis=0), axis=1)
    assert far.min() < 2.0 and far.max() > 30.0


def test_turn_shift_and_distance_of_a_place() -> None:
    """The scene's origin comes to the place, and +Z there points to the first eye."""
    f = footage()
    place = np.array([18.0, -1.0, -9.0])
    turn, shift = placement._transform(f, place)
    assert turn @ place + shift == pytest.approx([0, 0, 0], abs=1e-12)
    towards = (turn @ (f.eyes[0] - place))[[0, 2]]
    assert towards == pytest.approx([0, math.hypot(*(f.eyes[0] - place)[[0, 2]])], abs=1e-12)
    assert turn[1] == pytest.approx([0, 1, 0])
    distances = [math.hypot(eye[0] - 18.0, eye[2] + 9.0) for eye in f.eyes]
    assert placement._distance(f, place) == pytest.approx(sum(distances) / 3)


@pytest.mark.parametrize(
    ("sights", "tilt"),
    [([-10, -20, 0], 0), ([-24.0], 0), ([-30.0], 6), ([5.0, 15.0, 7.0], -7), ([-80.0], 40), ([60.0], -40)],
)
def test_a_camera_that_looks_down_is_tilted_up(sights: list[float], tilt: float) -> None:
    """The median line of sight comes into -24 to 0 degrees, by at most 40."""
    cameras = path([rot.about(0, math.radians(sight)) for sight in sights], [[0, 0, 0]] * len(sights))
    assert placement._tilt_deg(cameras, cameras.times_s) == pytest.approx(tilt, abs=1e-9)


def test_what_is_filmed_is_boxed_in(body: ShapedBody) -> None:
    """Two avatars in the T pose, 3 m apart: the box of each frame reaches from one to the other."""
    motion = BUILTIN["t-pose"]()
    specs = [AvatarSpec(position=(x, 0.0, 1.0)) for x in (-1.5, 1.5)]
    movers = [make_mover(spec, motion, body) for spec in specs]
    lows, highs = placement._bounds(np.array([0.0, 1.0]), movers, [body, body])
    rest = body.vertices - body.joints[0]
    wide = rest[:, 0].max() + 1.5
    assert highs[1] == pytest.approx([wide, np.ptp(rest[:, 1]), 1 + rest[:, 2].max()], abs=2e-3)
    assert lows[0] == pytest.approx([rest[:, 0].min() - 1.5, 0, 1 + rest[:, 2].min()], abs=2e-3)
    camera = path([np.eye(3), rot.about(1, 0.3)], [[0, 1, 5], [1, 1, 5]])
    mount = rot.about(0, 0.2)
    scene = Scene(output=OutputSpec(width=800, height=400))
    made = placement._footage(camera, mount, camera.times_s, scene, (lows, highs))
    assert made.eyes.tolist() == [[0, 1, 5], [1, 1, 5]]
    assert made.lenses == pytest.approx(np.array([[[math.sqrt(3) / 2, 0], [math.sqrt(3), 0]]] * 2))
    for k, turn in enumerate((np.eye(3), rot.about(1, 0.3))):
        axes = turn @ mount
        assert made.views[k] == pytest.approx(np.column_stack([axes.T, -axes.T @ made.eyes[k]]), abs=1e-6)
    assert {tuple(corner) for corner in made.boxes[0]} == {
        tuple((lows, highs)[bit][0][axis] for axis, bit in enumerate(bits))
        for bits in [(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]
    }


def test_a_built_in_camera_stays_and_a_placed_one_is_moved_with_its_path(body: ShapedBody) -> None:
    look = rot.about(0, 0.3) @ rot.about(1, 0.4)
    camera = path([look], [[1.0, 2.0, 3.0]])
    turn, mount, shift = rot.about(1, 0.7), rot.about(0, 0.1), np.array([0.5, 0.0, -1.0])
    placed = PlacedCamera(camera, turn, shift, mount, ())
    eye, axes = turn @ [1.0, 2.0, 3.0] + shift, turn @ look @ mount
    view = placed.sample(0.0)
    assert view[:3, :3] == pytest.approx(axes.T) and view[:3, 3] == pytest.approx(-axes.T @ eye)
    assert placed.projection(0.0, (240, 480)) == pytest.approx(camera.projection(0.0, (240, 480)))
    built_in = path([np.eye(3)], [[0, 0.9, 5]], recorded=False)
    mover = make_mover(AvatarSpec(), BUILTIN["t-pose"](), body)
    same = placement.place_camera(built_in, Scene(), [mover], [body])
    assert same.sample(0.0).tobytes() == built_in.sample(0.0).tobytes() and same.notes == ()
    same = placement.place_camera(camera, Scene(camera=CameraSpec(place="none")), [mover], [body])
    assert same.sample(0.0) == pytest.approx(camera.sample(0.0))
    assert same.notes == ()


def test_notes_of_a_placed_camera(body: ShapedBody) -> None:
    """A camera that looks 30 degrees down in a drawn room; its notes say what can be computed again."""
    camera = path([rot.about(0, math.radians(-30))] * 5, [[30.0, -7.0, 12.0]] * 5)
    mover = make_mover(AvatarSpec(), BUILTIN["t-pose"](), body)
    placed = placement.place_camera(camera, Scene(), [mover], [body])
    assert placed.mount == pytest.approx(rot.about(0, math.radians(6)))
    eye = placed.turn @ [30.0, -7.0, 12.0] + placed.shift
    assert placed.notes == (
        "camera tilted by +6 degrees on its mount",
        f"camera set down {math.hypot(eye[0], eye[2]):.1f} m from the avatar, {eye[1]:.1f} m over the floor on average",
    )
    seen = seen_at(camera.times_s, placed, [mover], [body], (480, 640))
    assert seen.whole.all()
    assert 0.6 < seen.height.min() < 0.97  # as large as the picture takes it, up to ENOUGH_SIZE and the finest step
    assert abs(eye[0]) < 1e-9 and 0.3 <= eye[1] <= 3.7


def test_the_reach_of_a_camera_is_where_it_ever_stands() -> None:
    """Three places, turned by a quarter about +Y, x to -z and z to x, and shifted."""
    camera = path([np.eye(3)] * 3, [[1, 2, 3], [-1, 5, 4], [0, 4, 9]])
    placed = PlacedCamera(camera, rot.about(1, math.pi / 2), np.array([10.0, 0.0, -1.0]), np.eye(3), ())
    low, high = placed.reach()
    assert low == pytest.approx([13, 2, -2]) and high == pytest.approx([19, 5, 0])
    for t_s in np.linspace(0, 0.3, 50):
        eye = np.linalg.inv(placed.sample(float(t_s)))[:3, 3]
        assert (eye >= low - 1e-9).all() and (eye <= high + 1e-9).all()


PIVOT: F64 = np.array([1.0, 0.9, -2.0])


def placed(azimuth_deg: float, elevation_deg: float, distance_m: float) -> F64:
    """A level camera that looks at the pivot from there; at 0, 0 from along +Z."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    arm = np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    return look_at(PIVOT + distance_m * arm, PIVOT)


@pytest.mark.parametrize(
    ("start", "turn", "zoom", "end"),
    [
        ((0, 0, 4), (90, 0), 1.0, (90, 0, 4)),
        ((30, 10, 4), (-75, 20), 1.0, (-45, 30, 4)),
        ((30, 10, 4), (0, 0), 2.0, (30, 10, 2)),
        ((-100, 40, 3), (200, -30), 0.5, (100, 10, 6)),
        ((20, 30, 4), (0, 500), 1.0, (20, HIGHEST_DEG, 4)),
        ((20, 30, 4), (5, -500), 1.0, (25, LOWEST_DEG, 4)),
        ((20, -30, 4), (0, -10), 1.0, (20, -30, 4)),
    ],
)
def test_a_camera_that_looks_at_the_pivot_is_where_it_would_be_put(
    start: tuple[float, float, float], turn: tuple[float, float], zoom: float, end: tuple[float, float, float]
) -> None:
    np.testing.assert_allclose(steered(placed(*start), PIVOT, *turn, zoom), placed(*end), atol=1e-12)


def test_without_a_turn_the_view_keeps_every_bit() -> None:
    view = placed(33, 7, 3.3)
    assert steered(view, PIVOT, 0.0, 0.0, 1.0).tobytes() == view.tobytes()


def test_a_camera_that_looks_past_the_pivot_keeps_it_at_the_same_place_of_the_picture() -> None:
    view = look_at(np.array([2.0, 1.5, 2.0]), np.array([0.0, 1.2, 0.5]))
    before = view[:3, :3] @ PIVOT + view[:3, 3]
    turned = steered(view, PIVOT, 40.0, 15.0, 1.0)
    np.testing.assert_allclose(turned[:3, :3] @ PIVOT + turned[:3, 3], before, atol=1e-12)
    nearer = steered(view, PIVOT, 40.0, 15.0, 3.0)
    np.testing.assert_allclose(nearer[:3, :3] @ PIVOT + nearer[:3, 3], before / 3, atol=1e-12)
    np.testing.assert_allclose(turned[:3, :3] @ turned[:3, :3].T, np.eye(3), atol=1e-12)


def test_a_camera_over_the_pivot_turns_about_the_vertical_alone() -> None:
    view = np.eye(4)
    view[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # looks down
    view[:3, 3] = -view[:3, :3] @ (PIVOT + np.array([0, 3, 0]))
    turned = steered(view, PIVOT, 90.0, 20.0, 1.0)
    np.testing.assert_allclose(turned[:3, :3] @ PIVOT + turned[:3, 3], [0, 0, -3], atol=1e-12)
    assert np.isfinite(turned).all()
