"""Staged scenes: bodies on the floor, a recording where it films them, notes, arrays with the same bits, refusals."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.camera_files import OPTICAL, write_tum
from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.body.joints import Skeleton
from trilane.errors import BadInputError
from trilane.scene.camera.files import load_camera
from trilane.scene.camera.path import CameraPath, Optics, axes_towards
from trilane.scene.camera_placement import PlacedCamera
from trilane.scene.lens import Known, Lens, of_fov_y
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.motion.motion import Motion, Wrap
from trilane.scene.mover import Mover, make_mover, outline
from trilane.scene.rotations import about
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene
from trilane.scene.staging import Staged, require_person, stage_scene, staged_from_arrays, staged_to_arrays

OUTPUT = (480, 640)


def jump() -> Motion:
    """Stands in the T pose, is half a metre up in the middle; recorded two metres too high."""
    motion = BUILTIN["t-pose"]()
    times = np.linspace(0, 1, 11)
    heights = 2.0 + 0.5 * np.sin(np.pi * np.clip((times - 0.4) / 0.2, 0, 1))
    places = np.column_stack([np.zeros(11), heights, np.zeros(11)])
    return Motion(times, np.repeat(motion.poses, 11, axis=0), places, None, (), motion.wrap, None, travels=True)


def staged(body: ShapedBody, camera: Path | str, motion: Path | str = "builtin:walk-wave-turn", **scene: Any) -> Staged:
    values = {"avatars": (AvatarSpec(motion=str(motion)),), "camera": CameraSpec(source=str(camera)), **scene}
    return stage_scene(Scene(**values), [body], Path("/"))


def whole_share(scene: Staged, body: ShapedBody, frames: int) -> float:
    """Share of frames with every outline vertex of the first avatar in the picture."""
    skeleton, shape = Skeleton(body.joints, body.body.parents), outline(body)
    projection, mover = scene.camera.projection(0.0, OUTPUT), scene.movers[0]
    whole = 0
    for frame in range(0, frames, 4):
        pose, place = mover.sample(frame / 30)
        points = shape.posed(skeleton.pose(pose, place, mover.world).matrices)
        clip = np.column_stack([points, np.ones(len(points))]) @ (projection @ scene.camera.sample(frame / 30)).T
        whole += bool((clip[:, 3] > 0).all() and (np.abs(clip[:, :2]) < clip[:, 3:]).all())
    return whole / len(range(0, frames, 4))


def lowest(body: ShapedBody, mover: Any, t_s: float) -> float:
    pose, place = mover.sample(t_s)
    posed = Skeleton(body.joints, body.body.parents).pose(pose, place, mover.world)
    return float(outline(body).posed(posed.matrices)[:, 1].min())


def test_a_sequence_keeps_its_jumps(body: ShapedBody) -> None:
    mover = make_mover(AvatarSpec(ground="auto"), jump(), body)
    assert lowest(body, mover, 0.0) == pytest.approx(0.0, abs=1e-3)
    assert lowest(body, mover, 0.5) == pytest.approx(0.5, abs=1e-3)


def test_the_walker_is_on_the_floor_in_every_frame(body: ShapedBody) -> None:
    mover = make_mover(AvatarSpec(), BUILTIN["walk-wave-turn"](), body)
    assert max(abs(lowest(body, mover, k / 7)) for k in range(70)) < 0.01


def write_path(path: Path, looks: list[tuple[np.ndarray, np.ndarray]]) -> Path:
    rows = [
        " ".join(str(value) for value in (k / 30, *np.column_stack([turn, place]).ravel()))
        for k, (turn, place) in enumerate(looks)
    ]
    path.write_text("\n".join(rows))
    return path


def wandering(count: int = 60, pitch: float = -0.25) -> list[tuple[np.ndarray, np.ndarray]]:
    angles = 0.15 * np.sin(np.arange(count) / 9)
    return [
        (about(1, np.array(2.0 + a)) @ about(0, np.array(pitch + a / 3)), np.array([30 + a, -7, 12 - a]))
        for a in angles
    ]


def test_a_recording_is_moved_as_one_upright_piece(body: ShapedBody, tmp_path: Path) -> None:
    looks = wandering(pitch=-0.6)
    scene = staged(body, write_path(tmp_path / "log.txt", looks), frames=60, background="film.mp4")
    views = [scene.camera.sample(k / 30) for k in range(60)]
    recorded = []
    for turn, place in looks:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, place
        recorded.append(np.linalg.inv(pose))
    moved = np.linalg.inv(views[0]) @ recorded[0]
    for view, original in zip(views, recorded, strict=True):
        assert view @ moved == pytest.approx(original, abs=1e-6)
    assert moved[1, :3] == pytest.approx([0, 1, 0], abs=1e-9)
    assert moved[:3, :3] @ moved[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)


def test_in_a_drawn_room_the_camera_is_tilted_by_one_angle(body: ShapedBody, tmp_path: Path) -> None:
    log = write_path(tmp_path / "log.txt", wandering(pitch=-0.7))
    filmed, drawn = (staged(body, log, frames=60, background=name) for name in ("film.mp4", "room"))
    tilt = np.radians(np.degrees(0.7) - 24)
    for t_s in (0.0, 0.4, 1.1):
        turns = [scene.camera.sample(t_s)[:3, :3].T for scene in (filmed, drawn)]
        level = np.degrees(np.arcsin(-turns[1][1, 2]))
        assert -33 < level < -15
        assert turns[1][1, 0] == pytest.approx(0, abs=1e-6)
        assert turns[0][1] @ about(0, np.array(tilt)) == pytest.approx(turns[1][1], abs=0.02)
    assert any("camera tilted by +16 degrees" in note for note in drawn.notes)
    assert not any("tilted" in note for note in filmed.notes)


def test_the_avatar_is_whole_in_the_picture_and_faces_the_camera(body: ShapedBody, tmp_path: Path) -> None:
    scene = staged(body, write_path(tmp_path / "log.txt", wandering()), "builtin:idle", frames=60)
    assert whole_share(scene, body, 60) == 1.0
    eye = np.linalg.inv(scene.camera.sample(0.0))[:3, 3]
    assert np.degrees(abs(np.arctan2(eye[0], eye[2]))) < 3.0
    assert eye[1] > 0.3
    assert any("whole body in the picture in 100%" in note for note in scene.notes)


def test_a_camera_may_be_left_where_it_is(body: ShapedBody, tmp_path: Path) -> None:
    log = write_path(tmp_path / "log.txt", wandering())
    spec = CameraSpec(source=str(log), place="none")
    scene = stage_scene(Scene(camera=spec), [body], Path("/"))
    assert np.linalg.inv(scene.camera.sample(0.0))[:3, 3] == pytest.approx([30, -7, 12], abs=1e-6)


@pytest.mark.parametrize("camera", ["arkit_camera_pose.txt", "tum_freiburg1_xyz.txt"])
@pytest.mark.parametrize("motion", ["cmu_jumping_jacks.bvh", "smplx_poses_8.npy", None])
def test_real_cameras_see_whole_people_in_nearly_every_frame(
    body: ShapedBody, shared_data: Path, camera: str, motion: str | None
) -> None:
    source = "builtin:walk-wave-turn" if motion is None else shared_data / "motion" / motion
    scene = staged(body, shared_data / "camera" / camera, source)
    assert whole_share(scene, body, 300) >= 0.9  # of the ten seconds that a place is chosen by


@pytest.mark.parametrize("camera", ["arkit_camera_pose.txt", "tum_freiburg1_xyz.txt"])
def test_a_frame_shows_the_same_however_many_a_run_has(body: ShapedBody, shared_data: Path, camera: str) -> None:
    """Pose and lens of each frame that two runs share, to the bit, and the room that holds the camera."""
    motion = shared_data / "motion" / "cmu_jumping_jacks.bvh"
    runs = {count: staged(body, shared_data / "camera" / camera, motion, frames=count) for count in (1, 60, 150, 900)}
    longest = runs.pop(900)
    for count, run in runs.items():
        for frame in range(0, count, 7):
            assert np.array_equal(run.camera.sample(frame / 30), longest.camera.sample(frame / 30))
            assert np.array_equal(*(one.camera.projection(frame / 30, OUTPUT) for one in (run, longest)))
        assert np.array_equal(run.camera.reach(), longest.camera.reach())
        assert run.notes[:-1] == longest.notes[:-1]  # the last one counts the run's frames


def test_a_moment_shows_the_same_at_whatever_rate(body: ShapedBody, tmp_path: Path) -> None:
    log = write_path(tmp_path / "log.txt", wandering())
    slow, fast = (staged(body, log, "builtin:idle", fps=fps, frames=40) for fps in (5.0, 60.0))
    assert np.array_equal(slow.camera.sample(0.6), fast.camera.sample(0.6))


TIMES_S = [*(k / 30 for k in range(150)), *(0.37 * k * k for k in range(40)), 1e5]
LEGS = (("LeftUpLeg", 9), ("RightUpLeg", -9))


def passed_on(staged: Staged) -> Staged:
    """`staged` as another process has it: from bytes, shapes and types alone, in memory that is read-only."""
    arrays = staged_to_arrays(staged)
    return staged_from_arrays(
        {key: np.frombuffer(array.tobytes(), array.dtype).reshape(array.shape) for key, array in arrays.items()}
    )


def check(staged: Staged) -> None:
    again = passed_on(staged)
    assert len(again.movers) == len(staged.movers)
    for t_s in TIMES_S:
        for mover, copy in zip(staged.movers, again.movers, strict=True):
            for expected, actual in zip(mover.sample(t_s), copy.sample(t_s), strict=True):
                assert expected.tobytes() == actual.tobytes()
        assert staged.camera.sample(t_s).tobytes() == again.camera.sample(t_s).tobytes()
    assert staged.camera.projection(0.3, (480, 640)).tobytes() == again.camera.projection(0.3, (480, 640)).tobytes()
    for mover, copy in zip(staged.movers, again.movers, strict=True):
        assert np.array_equal(mover.world, copy.world)
        assert np.array_equal(mover.motion.poses, copy.motion.poses)
        assert (mover.motion.leg_m, mover.motion.wrap) == (copy.motion.leg_m, copy.motion.wrap)
        assert mover.motion.travels == copy.motion.travels
    assert again.camera.path.recorded == staged.camera.path.recorded


def bvh(path: Path) -> Path:
    """Legs that swing over 20 frames while the body walks ahead; in centimetres."""
    channels = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
    lines = ["HIERARCHY", "ROOT Hips", "{", "OFFSET 0 95 0", channels]
    for name, x in LEGS:
        for joint, offset in ((name, f"{x} -3 0"), (name.replace("Up", ""), "0 -40 0")):
            lines += [f"JOINT {joint}", "{", f"OFFSET {offset}", "CHANNELS 3 Zrotation Xrotation Yrotation"]
        foot = name.replace("UpLeg", "Foot")
        lines += [f"JOINT {foot}", "{", "OFFSET 0 -42 0", "CHANNELS 3 Zrotation Xrotation Yrotation", "End Site", "{"]
        lines += ["OFFSET 0 -5 14", "}", "}", "}", "}"]
    lines += ["}", "MOTION", "Frames: 20", "Frame Time: 0.0333333"]
    for frame in range(20):
        swing = 25 * np.sin(frame / 3)
        legs = f"0 {swing:.6f} 0 0 5 0 0 0 0 0 {-swing:.6f} 0 0 9 0 0 0 0"
        lines.append(f"0 {95 + frame % 3} {4 * frame} 0 {swing / 9:.6f} 0 {legs}")
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("motion", ["builtin:walk-wave-turn", "builtin:idle", "builtin:t-pose"])
@pytest.mark.parametrize("camera", ["builtin:orbit", "builtin:closeup"])
def test_built_in_motions_and_cameras(body: ShapedBody, motion: str, camera: str) -> None:
    scene = Scene(avatars=(AvatarSpec(motion=motion, heading_deg=20.0),), camera=CameraSpec(source=camera))
    check(stage_scene(scene, [body], Path("/")))


def test_the_arrays_hold_no_objects_and_the_quaternions_come_along(body: ShapedBody) -> None:
    staged = stage_scene(Scene(), [body], Path("/"))
    assert all(not array.dtype.hasobject for array in staged_to_arrays(staged).values())
    again = passed_on(staged).movers[0].motion
    assert "quats" in vars(again) and np.array_equal(again.quats, staged.movers[0].motion.quats)


def test_an_array_that_is_missing_is_named(body: ShapedBody) -> None:
    arrays = staged_to_arrays(stage_scene(Scene(), [body], Path("/")))
    del arrays["camera.lenses"]
    with pytest.raises(KeyError, match="lenses"):
        staged_from_arrays(arrays)


def test_notes_of_a_staged_scene_say_what_they_are_of(body: ShapedBody) -> None:
    specs = (AvatarSpec(motion="builtin:t-pose"), AvatarSpec(motion="builtin:idle", position=(0.8, 0.0, 0.0)))
    staged = stage_scene(Scene(avatars=specs), [body, body], Path("/"))
    motions = [f"motion: {note}" for mover in staged.movers for note in (*mover.motion.notes, *mover.notes)]
    *notes, seen = staged.notes
    assert notes == [*motions, *(f"camera: {note}" for note in staged.camera.path.notes)]
    assert seen.startswith("camera: whole body in the picture in 100% of the 300 frames, ")
    assert len(motions) >= 4 and staged.notes[0] == "motion: built in: the T pose"


def test_avatars_in_one_place_are_told_of_once(body: ShapedBody) -> None:
    """The second stands in the first one, the third in both, the fourth beside them; the third body begins higher."""
    places = [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.19, 0.0, 0.0), (0.4, 0.0, 0.0)]
    higher = dataclasses.replace(body, joints=body.joints + np.array([0.0, 0.8, 0.0]))
    specs = tuple(
        AvatarSpec(name=name, motion="builtin:t-pose", position=place)
        for name, place in zip("abcd", places, strict=True)
    )
    notes = stage_scene(Scene(avatars=specs), [body, body, higher, body], Path("/")).notes
    remedy = "the key `position` moves an avatar"
    assert [note for note in notes if note.startswith("avatars: ")] == [
        f"avatars: a and b stand in one place; {remedy}",
        f"avatars: a and c stand in one place; {remedy}",
    ]


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
    lens = Optics((Lens(9.0, 8.0, 7.0, 6.0, 5.0, 4.0, Known.WIDTH), of_fov_y(33.0)), 0.2, 44.0, ((3, 4),), (1, 2))
    quats, places = random.normal(size=(2, 4)), random.normal(size=(2, 3))
    camera = CameraPath(
        np.array([0.0, 2.0]),
        quats,
        places,
        lens,
        ("c",),
        wrap,
        leg_m is None,
        pictures=("a", "b"),
        quarter=3,
        is_held=True,
        repeat_s=7.0,
        began_s=None if leg_m is None else 3.0,
    )
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


Z_UP: F64 = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
IDLE = (AvatarSpec(motion="builtin:idle"),)


def refused(source: Path, body: ShapedBody, frames: int = 300, **spec: Any) -> str:
    """What the refusal says; empty where the camera is taken."""
    camera = CameraSpec(source=str(source), **spec)
    scene = Scene(camera=camera, avatars=IDLE, background="film.mp4", frames=frames)
    staged = stage_scene(scene, [body], Path("/"))
    try:
        require_person(scene, staged, [body], Path("/"))
    except BadInputError as error:
        return str(error)
    return ""


def ring(radius: float) -> tuple[F64, F64]:
    """A whole circle that looks inwards, Y up."""
    angle = np.linspace(0, 2 * np.pi, 90)
    places = radius * np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    return axes_towards(places, np.zeros(3)), places


def test_a_ring_in_the_wrong_unit_asks_for_the_unit(tmp_path: Path, body: ShapedBody) -> None:
    """A ring of 0.6 m has no place for a person of 1.7 m; one of 6 m has."""
    turns, places = ring(0.6)
    path = write_tum(tmp_path, Z_UP @ turns, places @ Z_UP.T)
    said = refused(path, body)
    assert said.startswith(f"camera {path}: found the whole person in the picture in ")
    assert "camera.metres_per_unit = 10 would show it in 100%, if it is true" in said
    assert said.endswith("--allow-empty runs it as it is")
    assert refused(path, body, metres_per_unit=10.0) == ""


def test_poses_of_a_robot_ask_for_the_axes(tmp_path: Path, body: ShapedBody) -> None:
    """A robot that goes round a person and faces the person: z is its up, so a camera with these axes sees the sky."""
    turns, places = ring(4.0)
    robot = turns @ np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]).T
    path = write_tum(tmp_path, Z_UP @ robot @ OPTICAL, places @ Z_UP.T)
    said = refused(path, body, up_axis="z")
    assert "in the picture in 0% of the run's frames at the best place" in said
    assert 'camera.axes = "forward-left-up" would show it in 100%' in said
    assert refused(path, body, up_axis="z", axes="forward-left-up") == ""


def test_a_camera_that_stays_is_asked_for_its_place(tmp_path: Path, body: ShapedBody) -> None:
    """Where it was recorded it is 30 m off and looks away; a part of a person in view is enough there."""
    looks = about(1, np.linspace(0.0, 0.2, 60))
    path = write_tum(tmp_path, Z_UP @ looks, np.tile([30.0, -7.0, 1.5], (60, 1)))
    said = refused(path, body, place="none")
    assert "found a part of the person in the picture in 0% of the run's frames where it was recorded" in said
    assert 'camera.place = "auto" would show it in 100%' in said
    near = write_tum(tmp_path, Z_UP @ looks, np.tile([0.0, -1.0, 1.4], (60, 1)))  # head and shoulders
    assert refused(near, body, place="none") == ""


def test_the_frames_of_the_run_are_judged(tmp_path: Path, body: ShapedBody) -> None:
    """A camera that looks away for a third of its time shows nobody in a run of that third."""
    turns = about(1, np.where(np.arange(90) < 30, np.pi, 0.0))
    path = write_tum(tmp_path, Z_UP @ turns, np.tile([0.0, -1.0, 1.4], (90, 1)))
    away_s = load_camera(CameraSpec(source=str(path)), Path("/")).times_s[29]
    assert "in 0% of the run's frames" in refused(path, body, int(away_s * 30), place="none")
    assert refused(path, body, int(away_s * 30 * 3), place="none") == ""


@pytest.mark.parametrize(("shown", "is_taken"), [(1, False), (2, True), (3, True)])
def test_half_of_the_frames_is_enough(shown: int, is_taken: bool, tmp_path: Path, body: ShapedBody) -> None:
    """Of four frames one, two or three look at the person, who stands 3.5 m ahead."""
    turns = about(1, np.where(np.arange(4) < shown, 0.0, np.pi))
    path = write_tum(tmp_path, Z_UP @ turns, np.tile([0.0, -3.5, 1.0], (4, 1)))
    assert (refused(path, body, 4, place="none") == "") == is_taken


def test_people_far_apart_are_shown_from_far_off(tmp_path: Path, body: ShapedBody) -> None:
    """Two people 250 m apart: no unit and no axes are wrong, the camera only has to stand far off."""
    path = write_tum(tmp_path, Z_UP @ np.tile(np.eye(3), (9, 1, 1)), np.zeros((9, 3)))
    people = tuple(AvatarSpec(motion="builtin:idle", position=(x, 0.0, 0.0)) for x in (-125.0, 125.0))
    scene = Scene(camera=CameraSpec(source=str(path)), avatars=people, background="film.mp4")
    staged = stage_scene(scene, [body, body], Path("/"))
    require_person(scene, staged, [body, body], Path("/"))
    assert any(note.startswith("camera: whole body in the picture in 100%") for note in staged.notes)


def test_a_built_in_camera_is_never_refused(body: ShapedBody) -> None:
    scene = Scene(avatars=(AvatarSpec(position=(500.0, 0.0, 0.0)),), camera=CameraSpec(place="none"))
    require_person(scene, stage_scene(scene, [body], Path("/")), [body], Path("/"))


def test_a_camera_that_turns_round_finds_no_key(tmp_path: Path, body: ShapedBody) -> None:
    turns = about(1, np.linspace(0, 4 * np.pi, 90))
    path = write_tum(tmp_path, Z_UP @ turns, np.zeros((90, 3)))
    assert "no single key would show it: check camera.axes, " in refused(path, body)
