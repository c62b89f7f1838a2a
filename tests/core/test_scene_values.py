"""Scenes by value: defaults and limits typed again, outlines and floors by hand, a camera's place by plain loops."""

from __future__ import annotations

import dataclasses
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane.avatars.bundle import bundle_folder
from trilane.body.body import ShapedBody, load_body
from trilane.body.joints import JOINT_INDEX
from trilane.body.kinematics import Skeleton
from trilane.body.skinning import CpuSkinner
from trilane.errors import BadInputError
from trilane.scene import camera_placement as placement
from trilane.scene import rotations as rot
from trilane.scene.body_outline import DIRECTIONS, outline
from trilane.scene.camera.path import CameraPath, Lens
from trilane.scene.floor import floor_lift, ground_rule, leg_length
from trilane.scene.load import find_scene, load_scene, located, scene_from, scene_names
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.motion.motion import Motion, Wrap
from trilane.scene.mover import Mover, make_mover
from trilane.scene.placed_camera import PlacedCamera
from trilane.scene.schema import AvatarSpec, CameraSpec, OutputSpec, PlaneSpec, Scene
from trilane.scene.staged_arrays import staged_from_arrays, staged_to_arrays
from trilane.scene.staging import Staged, stage_scene


@pytest.fixture(scope="module")
def body() -> ShapedBody:
    return load_body(bundle_folder("default") / "body.npz").shape()


# --- schema ---


def test_what_a_scene_leaves_out() -> None:
    assert Scene().model_dump() == {
        "name": "scene", "fps": 30.0, "frames": 300, "size": "256", "background": "room", "hud": False, "planes": (),
        "texture_filter": "linear", "error_budget_px": 0.5, "output": {"width": 640, "height": 480},
        "camera": {
            "source": "builtin:orbit", "format": "auto", "fov_y_deg": None, "near_m": 0.05, "far_m": 100.0,
            "place": "auto",
        },
        "avatars": ({
            "bundle": "default", "motion": "builtin:walk-wave-turn", "position": (0.0, 0.0, 0.0), "heading_deg": 0.0,
            "up_axis": "auto", "units": "auto", "ground": "auto",
        },),
    }  # fmt: skip
    assert PlaneSpec().model_dump() == {
        "centre": (0.0, 0.0, 0.0), "normal": (0.0, 1.0, 0.0), "width_m": 2.0, "depth_m": 2.0, "turn_deg": 0.0,
    }  # fmt: skip


#: Model, key, values that are fine, values that are not.
LIMITS: list[tuple[type, str, list[Any], list[Any]]] = [
    (OutputSpec, "width", [64, 4096], [62, 65, 4098]),
    (OutputSpec, "height", [64, 4096], [62, 65, 4098]),
    (
        AvatarSpec,
        "position",
        [(-1e4, 1e4, 0)],
        [(1.1e4, 0, 0), (0, -1.1e4, 0), (0, 0, 1.1e4), (0, math.nan, 0), (0, 0)],
    ),
    (AvatarSpec, "heading_deg", [-3600, 3600], [-3601, 3601, math.nan]),
    (AvatarSpec, "up_axis", ["auto", "y", "z"], ["x"]),
    (AvatarSpec, "units", ["auto", "m", "cm", "in", "cmu"], ["mm"]),
    (AvatarSpec, "ground", ["auto", "sequence", "frame", "none"], ["floor"]),
    (CameraSpec, "format", ["auto", "arkit", "tum", "nerf"], ["colmap"]),
    (CameraSpec, "fov_y_deg", [1.1, 169.9, None], [1, 170, math.nan]),
    (CameraSpec, "near_m", [1e-4, 99.9], [0, 100, 0.99e-4, math.nan]),
    (CameraSpec, "far_m", [0.051, 5e4], [0, 0.05, 5.01e4, math.inf]),
    (CameraSpec, "place", ["auto", "none"], ["here"]),
    (PlaneSpec, "width_m", [0.001, 1000], [0, 1001, math.nan]),
    (PlaneSpec, "depth_m", [0.001, 1000], [0, 1001, math.nan]),
    (PlaneSpec, "turn_deg", [1e9], [math.nan, math.inf]),
    (PlaneSpec, "centre", [(1e9, 0, 0)], [(0, 0, math.inf), (0, 0)]),
    (PlaneSpec, "normal", [(0, 0, 1.1e-6), (0, 0, 0.9e6)], [(0, 0, 1e-6), (0, 0, 1e6), (0, 0, 0), (0, math.nan, 0)]),
    (Scene, "name", ["x" * 80, "a b.c-d_e"], ["", "x" * 81, "a/b", "a\n"]),
    (Scene, "fps", [0.01, 1000], [0, 1001, math.nan]),
    (Scene, "frames", [1, 10_000_000], [0, 10_000_001]),
    (Scene, "size", ["32", "64x96"], ["33", "64x95"]),
    (Scene, "planes", [({},) * 32], [({},) * 33]),
    (Scene, "texture_filter", ["linear", "mipmap", "anisotropic"], ["nearest"]),
    (Scene, "error_budget_px", [0], [-0.1, math.inf]),
    (Scene, "avatars", [({},) * 8], [(), ({},) * 9]),
]


@pytest.mark.parametrize("case", range(len(LIMITS)))
def test_limits_of_the_schema_on_either_side(case: int) -> None:
    model, key, fine, wrong = LIMITS[case]
    for value in fine:
        model(**{key: value})
    for value in wrong:
        with pytest.raises(ValueError, match=key):
            model(**{key: value})
    with pytest.raises(ValueError, match="frozen"):
        setattr(model(), key, fine[0])
    with pytest.raises(ValueError, match="extra_forbidden"):
        model(colour=1)


def test_a_direction_of_no_length_is_named() -> None:
    with pytest.raises(BadInputError) as raised:
        scene_from("here", {"planes": [{"normal": [0, 0, 0]}]})
    assert str(raised.value) == "here: planes.0.normal: found (0.0, 0.0, 0.0), expected a direction"
    with pytest.raises(BadInputError) as raised:
        scene_from("here", {"camera": {"near_m": 2, "far_m": 2}})
    assert str(raised.value) == (
        "here: camera: found near_m 2 and far_m 2, expected near_m below far_m and far_m at most 1e+06 times near_m"
    )


# --- scene files ---

CHARACTERS = "expected letters, digits, spaces, dots, hyphens and underscores"
SENTENCES: list[tuple[dict[str, Any], str]] = [
    (
        {"colour": 1},
        "colour: found an unknown key, expected a key of the scene schema; correct its spelling or remove it",
    ),
    ({"planes": [{"centre": [0, 0]}]}, "planes.0.centre.2: found nothing, expected a value; add the key"),
    ({"avatars": []}, "avatars: found [], expected at least 1 of them"),
    ({"avatars": [{}] * 9}, f"avatars: found {repr([{}] * 9)[:80]}, expected at most 8 of them"),
    ({"camera": 3}, "camera: found 3, expected a table"),
    ({"planes": 3}, "planes: found 3, expected a list"),
    ({"name": "a/b"}, "name: found 'a/b', " + CHARACTERS),
    ({"name": "/" * 79}, f"name: found '{'/' * 79}..., {CHARACTERS}"),
    ({"frames": 0}, "frames: found 0, expected greater than or equal to 1"),
    ({"name": "/" * 78}, f"name: found '{'/' * 78}', {CHARACTERS}"),
    ({"hud": None}, "hud: found None, expected a valid boolean"),
]


@pytest.mark.parametrize("case", range(len(SENTENCES)))
def test_what_is_wrong_with_a_scene_is_one_sentence(case: int) -> None:
    values, sentence = SENTENCES[case]
    with pytest.raises(BadInputError) as raised:
        scene_from("here", values)
    assert str(raised.value) == f"here: {sentence}"


def test_places_of_files_and_names_that_are_built_in(tmp_path: Path) -> None:
    base = Path("/base")
    for name in ("room", "default", "builtin:orbit"):
        assert located(name, base) == name
    assert (located("a.png", base), located("/x/a.png", base)) == ("/base/a.png", "/x/a.png")
    with pytest.raises(BadInputError) as raised:
        located("", base)
    assert str(raised.value) == "name of a file: found nothing, expected a path, or the name of something built in"
    assert find_scene("x/y.toml") == Path("x/y.toml")
    assert find_scene("pair").name == "pair.toml" and find_scene("pair").is_file()
    with pytest.raises(BadInputError) as raised:
        find_scene("beach")
    assert str(raised.value) == "scene: found 'beach', expected a .toml file or one of closeup, default, far, pair"
    path = tmp_path / "my.toml"
    path.write_text("[camera]\nnear_m = 0.1\n[[avatars]]\nheading_deg = 3.0\n")
    loaded = load_scene(path)
    assert loaded == {
        "name": "my", "background": "room", "camera": {"near_m": 0.1, "source": "builtin:orbit"},
        "avatars": [{"heading_deg": 3.0, "motion": "builtin:walk-wave-turn", "bundle": "default"}],
    }  # fmt: skip
    path.write_text("frames = 3\n")
    assert load_scene(path)["avatars"] == [{"motion": "builtin:walk-wave-turn", "bundle": "default"}]
    path.write_text("a = = 3\n")
    with pytest.raises(BadInputError, match=r"my.toml: found no valid TOML \(.*\), expected a scene file \(TOML\)"):
        load_scene(path)


WALK, STAND = {"bundle": "default", "motion": "builtin:walk-wave-turn"}, {"bundle": "default", "motion": "builtin:idle"}
SCENES: dict[str, tuple[int, str, list[dict[str, Any]]]] = {
    "closeup": (240, "builtin:closeup", [STAND]),
    "default": (300, "builtin:orbit", [WALK]),
    "far": (300, "builtin:far", [WALK]),
    "pair": (300, "builtin:static", [
        {**WALK, "position": [-0.55, 0.0, 0.0], "heading_deg": 8.0},
        {**STAND, "position": [0.6, 0.0, 0.0], "heading_deg": -12.0},
    ]),
}  # fmt: skip


def test_the_scenes_that_come_along_are_what_they_are() -> None:
    assert scene_names() == sorted(SCENES)
    for name, (frames, camera, avatars) in SCENES.items():
        assert tomllib.loads(find_scene(name).read_text()) == {
            "name": name, "fps": 30, "frames": frames, "size": "256", "background": "room",
            "output": {"width": 640, "height": 480}, "camera": {"source": camera}, "avatars": avatars,
        }  # fmt: skip


# --- rotations ---


def test_rotations_by_hand() -> None:
    h = math.sqrt(0.5)
    assert rot.quat_from_rotvec([0, math.pi / 2, 0]) == pytest.approx([h, 0, h, 0])
    assert rot.quat_from_rotvec([2 * math.pi, 0, 0]) == pytest.approx([-1, 0, 0, 0])
    assert rot.rotvec_from_quat([-h, 0, h, 0]) == pytest.approx([0, -math.pi / 2, 0])
    assert rot.rotvec_from_quat([1, 1e-13, 0, 0]) == pytest.approx([2e-13, 0, 0])
    assert rot.rotvec_from_quat([-1, 1e-13, 0, 0]) == pytest.approx([-2e-13, 0, 0])
    assert rot.rotvec_from_quat([0, 0, 0, 1]) == pytest.approx([0, 0, math.pi])
    assert rot.quat_multiply([0, 1, 0, 0], [0, 0, 1, 0]) == pytest.approx([0, 0, 0, 1])  # i j = k
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        turn = rot.about(axis, math.pi / 2)
        assert turn[:, i] == pytest.approx(np.eye(3)[j], abs=1e-15)
        assert turn[:, j] == pytest.approx(-np.eye(3)[i], abs=1e-15)
    assert rot.about(1, [0.0, 0.5]).shape == (2, 3, 3)
    assert rot.Y_UP_FROM_Z_UP.tolist() == [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    assert np.isnan(rot.normalised([0, 0, 0])).all()


def test_quaternions_of_every_largest_component() -> None:
    """Half turns about each axis and about the diagonals, and a turn with all parts."""
    h = math.sqrt(0.5)
    for quat in (
        [0, 1, 0, 0],
        [0, 0, 1, 0],
        [0, 0, 0, 1],
        [0, h, h, 0],
        [0, 0, h, h],
        [0, h, 0, h],
        [0.5, 0.1, -0.7, 0.5],
    ):
        unit = np.array(quat) / np.linalg.norm(quat)
        found = rot.quat_from_matrix(rot.matrix_from_quat(unit))
        assert abs(found @ unit) == pytest.approx(1.0, abs=1e-12)


def test_many_rotations_at_once_are_each_as_alone() -> None:
    random = np.random.default_rng(5)
    vectors = random.normal(0, 2, (2, 3, 3))
    quats = rot.quat_from_rotvec(vectors)
    other = rot.quat_from_rotvec(random.normal(0, 2, (2, 3, 3)))
    share = random.random((2, 3))
    for i in range(2):
        for j in range(3):
            assert quats[i, j] == pytest.approx(rot.quat_from_rotvec(vectors[i, j]))
            assert rot.rotvec_from_quat(quats)[i, j] == pytest.approx(rot.rotvec_from_quat(quats[i, j]))
            matrix = rot.matrix_from_quat(quats[i, j])
            assert rot.matrix_from_quat(quats)[i, j] == pytest.approx(matrix)
            assert rot.quat_from_matrix(rot.matrix_from_quat(quats))[i, j] == pytest.approx(
                rot.quat_from_matrix(matrix)
            )
            assert rot.slerp(quats, other, share)[i, j] == pytest.approx(
                rot.slerp(quats[i, j], other[i, j], share[i, j])
            )
            assert rot.normalised(vectors)[i, j] == pytest.approx(vectors[i, j] / np.linalg.norm(vectors[i, j]))


def test_slerp_by_hand() -> None:
    start, end = np.array([1.0, 0, 0, 0]), rot.quat_from_rotvec([0, 1.2, 0])
    for share in (0.0, 0.25, 1.0):
        for sign in (1, -1):
            found = rot.rotvec_from_quat(rot.slerp(start, sign * end, share))
            assert found == pytest.approx([0, 1.2 * share, 0], abs=1e-12)
    near = rot.quat_from_rotvec([0, 1.9e-6, 0])
    assert rot.slerp(start, near, 0.25)[2] == pytest.approx(0.95e-6 / 4, rel=1e-9)
    far = rot.quat_from_rotvec([0, 2.1e-6, 0])
    assert rot.slerp(start, far, 0.25)[2] == pytest.approx(1.05e-6 / 4, rel=1e-3)


def test_shortest_turns_by_hand() -> None:
    assert rot.shortest_turn([2, 0, 0], [0, 3, 0]) == pytest.approx(rot.about(2, math.pi / 2))
    assert rot.shortest_turn([1, 0, 0], [1, 0, 0]) == pytest.approx(np.eye(3))
    fallback = rot.shortest_turn([0, 1, 0], [0, -1, 0], fallback=[0.3, 0.8, 0.4])
    axis = np.array([0.6, 0, 0.8])
    assert fallback == pytest.approx(2 * np.outer(axis, axis) - np.eye(3))
    for i in range(3):  # the fallback itself has no perpendicular part
        unit = np.eye(3)[i]
        turn = rot.shortest_turn(unit, -unit, fallback=unit)
        assert turn @ unit == pytest.approx(-unit) and np.linalg.det(turn) == pytest.approx(1.0)


# --- outline and floor ---


def test_directions_are_the_axes_and_diagonals_of_a_cube() -> None:
    h = 1 / math.sqrt(3)
    wanted = {tuple(sign * row) for row in np.eye(3) for sign in (1, -1)}
    wanted |= {(x * h, y * h, z * h) for x in (1, -1) for y in (1, -1) for z in (1, -1)}
    assert {tuple(np.round(row, 12) + 0.0) for row in DIRECTIONS} == {tuple(np.round(row, 12) + 0.0) for row in wanted}
    assert len(DIRECTIONS) == 14


def test_an_outline_is_the_outermost_vertices_of_each_joint(body: ShapedBody) -> None:
    shape = outline(body)
    owner = body.body.weights.argmax(axis=1)
    wanted = set()
    for joint in set(owner.tolist()):
        own = [v for v in range(len(owner)) if owner[v] == joint]
        for direction in DIRECTIONS:
            wanted.add(own[int(np.argmax(body.vertices[own].astype(np.float64) @ direction))])
    rows = sorted(wanted)
    np.testing.assert_array_equal(shape.points[:, :3], body.vertices[rows])
    assert (shape.points[:, 3] == 1).all()
    assert shape.joints.shape == shape.weights.shape == (len(rows), 4)
    np.testing.assert_allclose(shape.weights.sum(axis=1), 1.0)
    pose = np.random.default_rng(1).normal(0, 0.4, 165)
    posed = Skeleton(body.joints, body.body.parents).pose(pose, [0.3, 1.0, -0.2])
    exact = CpuSkinner(body, 4, pose_blend=False).vertices(posed)[rows]
    np.testing.assert_allclose(shape.posed(posed.matrices), exact, atol=1e-6)
    stacked = np.stack([posed.matrices[:, 1] + [0, 0, 0, k] for k in range(35)])  # 35 frames, each 1 m higher
    np.testing.assert_allclose(shape.lowest(stacked), exact[:, 1].min() + np.arange(35), atol=1e-5)
    np.testing.assert_allclose(shape.lowest(stacked[:1]), exact[:, 1].min(), atol=1e-5)


def test_a_leg_is_thigh_and_shin() -> None:
    joints = np.zeros((55, 3))
    joints[JOINT_INDEX["left_hip"]] = 0, 1, 0
    joints[JOINT_INDEX["left_knee"]] = 0.3, 0.6, 0
    joints[JOINT_INDEX["left_ankle"]] = 0.3, 0.6, -0.25
    assert leg_length(joints) == pytest.approx(0.5 + 0.25)


def still(times: list[float], heights: list[float], travels: bool = True, leg_m: float | None = None) -> Motion:
    """The T pose at the given heights of the pelvis."""
    places = np.column_stack([np.arange(len(times)) * 0.5, heights, np.zeros(len(times))])
    return Motion(np.array(times), np.zeros((len(times), 55, 3)), places, None, ("made",), Wrap.BOUNCE, leg_m, travels)


def sole(body: ShapedBody) -> float:
    """How far the lowest vertex of the T pose lies below the pelvis."""
    return float(body.joints[0, 1] - body.vertices[:, 1].min())


def test_which_rule_puts_a_motion_on_the_floor() -> None:
    assert [ground_rule(still([0], [1], travels), "auto") for travels in (True, False)] == ["sequence", "frame"]
    for rule in ("sequence", "frame", "none"):
        assert ground_rule(still([0], [1], False), rule) == rule


def lift(body: ShapedBody, motion: Motion, rule: Any, scale: float = 1.0) -> tuple[list[float], np.ndarray]:
    skeleton = Skeleton(body.joints, body.body.parents)
    times, metres = floor_lift(motion, skeleton, outline(body), -body.joints[0], scale, rule)
    return times.tolist(), metres


def test_each_frame_is_lifted_by_its_own_height(body: ShapedBody) -> None:
    times, metres = lift(body, still([0, 0.1, 0.2], [2.0, 2.4, 2.2]), "frame")
    assert times == pytest.approx([k / 30 for k in range(7)])  # 30 a second, more than the motion has
    expected = np.interp(np.arange(7) / 30, [0, 0.1, 0.2], [2.0, 2.4, 2.2])
    assert metres == pytest.approx(sole(body) - expected, abs=1e-5)
    times, metres = lift(body, still([0, 0.01, 0.02], [2.0, 2.4, 2.2]), "frame", scale=0.5)
    assert times == pytest.approx([0, 0.01, 0.02])  # as many as the motion has
    assert metres == pytest.approx(sole(body) - np.array([1.0, 1.2, 1.1]), abs=1e-5)
    assert len(lift(body, still([0, 40.0], [2.0, 2.0]), "frame")[0]) == 600
    assert lift(body, still([0, 1], [3, 3]), "none") == ([0.0], [0.0])


def test_a_sequence_is_lifted_by_its_fifth_percentile(body: ShapedBody) -> None:
    heights = 1.0 + np.arange(101) / 100
    times, metres = lift(body, still((np.arange(101) / 100).tolist(), heights.tolist()), "sequence")
    assert times == [0.0]
    assert metres == pytest.approx([sole(body) - 1.05], abs=1e-5)


# --- movers ---


def test_a_mover_by_hand(body: ShapedBody) -> None:
    """Legs half as long as the avatar's: places are doubled; the rest pelvis is taken off; the lift is in between."""
    leg = leg_length(body.joints)
    motion = still([0, 1], [0.5, 0.7], leg_m=leg / 2)
    spec = AvatarSpec(position=(1, 2, 3), heading_deg=90, ground="none")
    mover = make_mover(spec, motion, body)
    assert mover.scale == pytest.approx(2.0)
    assert mover.shift == pytest.approx(-body.joints[0])
    assert mover.world == pytest.approx(np.array([[0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]]))
    assert mover.notes == ("floor: heights as recorded", "places scaled by 2.000 for the avatar's legs")
    middle = motion.translation[0] + 0.25 * (motion.translation[1] - motion.translation[0])
    _, place = mover.sample(0.25)
    assert place == pytest.approx(2 * middle - body.joints[0])
    lifted = dataclasses.replace(mover, lift_times_s=np.array([0.0, 0.5, 1.0]), lift_m=np.array([1.0, 3.0, 3.5]))
    for t_s in (0.25, 1.75):  # the motion runs back after a second, and so does the lift
        _, place = lifted.sample(t_s)
        assert place == pytest.approx(2 * middle - body.joints[0] + [0, 2.0, 0])
    assert motion.translation[0].tolist() == [0.0, 0.5, 0.0]


@pytest.mark.parametrize(("ratio", "said"), [(1.009, False), (1.011, True), (0.991, False), (0.989, True)])
def test_a_scale_of_more_than_a_hundredth_is_said(body: ShapedBody, ratio: float, said: bool) -> None:
    mover = make_mover(AvatarSpec(), still([0], [1], leg_m=leg_length(body.joints) / ratio), body)
    assert mover.notes[0] == "floor: the lowest point over the motion touches it"
    assert mover.notes[1:] == ((f"places scaled by {ratio:.3f} for the avatar's legs",) if said else ())
    frame = make_mover(AvatarSpec(), still([0], [1], travels=False), body)
    assert (frame.scale, frame.notes) == (1.0, ("floor: the lowest point of the body touches it in every frame",))


# --- where a camera is put ---


def path(turns: list[np.ndarray], places: list[list[float]], recorded: bool = True) -> CameraPath:
    quats = rot.quat_from_matrix(np.stack(turns))
    times = np.arange(len(turns)) / 30
    return CameraPath(times, quats, np.array(places, float), Lens(60.0, 0.1, 50.0), ("path",), Wrap.BOUNCE, recorded)


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
    return placement._Footage(views.astype(np.float32), eyes, boxes, np.array([1.3, 1.73]))


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
            u, v = right * f.scale[0] / depth, up * f.scale[1] / depth
            front &= bool(-back > 0.3)
            inside &= bool(abs(u) < 0.97 and abs(v) < 0.97)
            rows.append(min(max(v, -1.0), 1.0))
        whole += inside and front
        tall += (max(rows) - min(rows)) / 2 if front else 0.0
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
    score = expected[:, 0] + 0.12 * np.minimum(expected[:, 1], 0.75)
    score[f.eyes[:, 1].min() - ahead[:, 1] < 0.3] = -1.0
    np.testing.assert_array_equal(placement._best(f, ahead), ahead[int(np.argmax(score))])


def test_an_eye_is_never_on_the_floor() -> None:
    """The place that shows most, but with the floor 0.29 m below the eye, loses; at 0.31 m it wins."""
    f = footage()
    eye = float(f.eyes[:, 1].min())
    good, poor = np.array([20.0, 0.0, -11.0]), np.array([20.0, 0.0, -30.0])
    for below, wins in ((0.31, True), (0.29, False)):
        places = np.array([poor, [good[0], eye - below, good[2]]])
        scores = [a + 0.12 * min(b, 0.75) for a, b in (plain_visibility(f, place) for place in places)]
        best = placement._best(f, places)
        assert (best == places[1]).all() == (wins and scores[1] > scores[0])
        assert scores[1] > 0 or not wins


def test_the_grids_of_places() -> None:
    f = footage()
    grid = placement._coarse_grid(f) - f.eyes.mean(axis=0)
    assert len(grid) == 29 * 15 * 29
    for axis, low, high, step in ((0, -7.0, 7.0, 0.5), (1, -3.6, -0.8, 0.2), (2, -7.0, 7.0, 0.5)):
        values = np.unique(np.round(grid[:, axis], 9))
        assert (values[0], values[-1]) == pytest.approx((low, high))
        assert np.diff(values) == pytest.approx(step)
    finer = placement._finer_grid(np.array([1.0, 2.0, 3.0]), 0.25)
    assert finer[0].tolist() == [1, 2, 3] and len(finer) == 28
    wanted = {(1 + a, 2 + b, 3 + c) for a in (-0.25, 0, 0.25) for b in (-0.25, 0, 0.25) for c in (-0.25, 0, 0.25)}
    assert {tuple(row) for row in finer[1:]} == wanted
    assert (placement.SCORED_FRAMES, placement.FINER_M, placement.PLACES_AT_ONCE) == (48, (0.25, 0.12, 0.06), 256)


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
    made = placement._footage(camera, mount, camera.times_s, scene, movers, [body, body])
    assert made.eyes.tolist() == [[0, 1, 5], [1, 1, 5]]
    assert made.scale == pytest.approx([math.sqrt(3) / 2, math.sqrt(3)])
    for k, turn in enumerate((np.eye(3), rot.about(1, 0.3))):
        axes = turn @ mount
        assert made.views[k] == pytest.approx(np.column_stack([axes.T, -axes.T @ made.eyes[k]]), abs=1e-6)
    assert {tuple(corner) for corner in made.boxes[0]} == {
        tuple((lows, highs)[bit][0][axis] for axis, bit in enumerate(bits))
        for bits in [(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]
    }


def test_a_built_in_camera_stays_and_a_placed_one_is_moved_with_its_path() -> None:
    look = rot.about(0, 0.3) @ rot.about(1, 0.4)
    camera = path([look], [[1.0, 2.0, 3.0]])
    turn, mount, shift = rot.about(1, 0.7), rot.about(0, 0.1), np.array([0.5, 0.0, -1.0])
    placed = PlacedCamera(camera, turn, shift, mount, ())
    eye, axes = turn @ [1.0, 2.0, 3.0] + shift, turn @ look @ mount
    view = placed.sample(0.0)
    assert view[:3, :3] == pytest.approx(axes.T) and view[:3, 3] == pytest.approx(-axes.T @ eye)
    assert placed.projection(2.0) == pytest.approx(camera.projection(2.0))
    for kept, spec in (
        (path([np.eye(3)], [[9, 9, 9]], recorded=False), CameraSpec()),
        (camera, CameraSpec(place="none")),
    ):
        same = placement.place_camera(kept, Scene(camera=spec), [], [])
        assert same.sample(0.0) == pytest.approx(kept.sample(0.0)) and same.notes == ()


def test_notes_of_a_placed_camera(body: ShapedBody) -> None:
    """A camera that looks 30 degrees down in a drawn room; its notes say what can be computed again."""
    camera = path([rot.about(0, math.radians(-30))] * 5, [[30.0, -7.0, 12.0]] * 5)
    mover = make_mover(AvatarSpec(), BUILTIN["t-pose"](), body)
    placed = placement.place_camera(camera, Scene(frames=60), [mover], [body])
    assert placed.mount == pytest.approx(rot.about(0, math.radians(6)))
    eye = placed.turn @ [30.0, -7.0, 12.0] + placed.shift
    assert placed.notes == (
        "camera tilted by +6 degrees on its mount",
        f"camera set down {math.hypot(eye[0], eye[2]):.1f} m from the avatar, {eye[1]:.1f} m over the floor on average",
        placed.notes[2],
    )
    assert placed.notes[2].startswith("whole body in the picture in 100% of the frames, ")
    share = float(placed.notes[2].split(", ")[1].split("%")[0]) / 100
    assert 0.6 < share < 0.97  # as large as the picture takes it, up to ENOUGH_SIZE and the finest step
    assert abs(eye[0]) < 1e-9 and 0.3 <= eye[1] <= 3.7


# --- staged scenes ---


def test_notes_of_a_staged_scene_say_what_they_are_of(body: ShapedBody) -> None:
    specs = (AvatarSpec(motion="builtin:t-pose"), AvatarSpec(motion="builtin:idle"))
    staged = stage_scene(Scene(avatars=specs), [body, body], Path("/"))
    motions = [f"motion: {note}" for mover in staged.movers for note in (*mover.motion.notes, *mover.notes)]
    assert staged.notes == (*motions, *(f"camera: {note}" for note in staged.camera.path.notes))
    assert len(motions) >= 4 and staged.notes[0] == "motion: built in: the T pose, one frame: held"


@pytest.mark.parametrize("wrap", Wrap)
@pytest.mark.parametrize("leg_m", [None, 0.8])
def test_every_field_survives_as_an_array(wrap: Wrap, leg_m: float | None) -> None:
    random = np.random.default_rng(4)
    motion = Motion(
        np.array([0.0, 0.5, 1.0]), random.normal(size=(3, 55, 3)), random.normal(size=(3, 3)),
        None if leg_m is None else random.normal(size=4), ("note",), wrap, leg_m, leg_m is None,
    )  # fmt: skip
    mover = Mover(
        motion,
        random.normal(size=(4, 4)),
        1.3,
        random.normal(size=3),
        np.array([0.0, 1.0]),
        np.array([2.0, 3.0]),
        ("n",),
    )
    lens = Lens(33.0, 0.2, 44.0)
    quats, places = random.normal(size=(2, 4)), random.normal(size=(2, 3))
    camera = CameraPath(np.array([0.0, 2.0]), quats, places, lens, ("c",), wrap, leg_m is None)
    placed = PlacedCamera(camera, random.normal(size=(3, 3)), random.normal(size=3), random.normal(size=(3, 3)), ("p",))
    arrays = staged_to_arrays(Staged((mover, mover), placed, ("all",)))
    again = staged_from_arrays(arrays)
    assert again.notes == () and len(again.movers) == 2
    assert ("mover.1.betas" in arrays, "mover.0.leg_m" in arrays) == (leg_m is not None, leg_m is not None)

    def same(ours: Any, theirs: Any) -> None:
        for field in dataclasses.fields(ours):
            if field.name == "notes":
                assert getattr(theirs, "notes") == ()  # noqa: B009
            elif dataclasses.is_dataclass(getattr(ours, field.name)):
                same(getattr(ours, field.name), getattr(theirs, field.name))
            else:
                np.testing.assert_array_equal(getattr(ours, field.name), getattr(theirs, field.name))

    same(mover, again.movers[1])
    same(placed, again.camera)
