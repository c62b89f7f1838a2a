"""A staged scene through plain arrays: every sample afterwards has the same bits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trilane.avatars.bundle import bundle_folder
from trilane.body.body import ShapedBody, load_body
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene
from trilane.scene.staging import Staged, stage_scene, staged_from_arrays, staged_to_arrays

TIMES_S = [*(k / 30 for k in range(150)), *(0.37 * k * k for k in range(40)), 1e5]
LEGS = (("LeftUpLeg", 9), ("RightUpLeg", -9))


@pytest.fixture(scope="module")
def body() -> ShapedBody:
    return load_body(bundle_folder("default") / "body.npz").shape()


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


def arkit(path: Path) -> Path:
    rows = []
    for k in range(60):
        angle = 0.2 * np.sin(k / 9)
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        pose = np.column_stack([turn, [angle, 1.5, 3 - angle]])
        rows.append(" ".join(str(value) for value in (k / 30, *pose.ravel())))
    path.write_text("\n".join(rows))
    return path


@pytest.mark.parametrize("motion", ["builtin:walk-wave-turn", "builtin:idle", "builtin:t-pose"])
@pytest.mark.parametrize("camera", ["builtin:orbit", "builtin:closeup"])
def test_built_in_motions_and_cameras(body: ShapedBody, motion: str, camera: str) -> None:
    scene = Scene(avatars=(AvatarSpec(motion=motion, heading_deg=20.0),), camera=CameraSpec(source=camera))
    check(stage_scene(scene, [body], Path("/")))


def test_a_bvh_and_a_recorded_camera(body: ShapedBody, tmp_path: Path) -> None:
    motion, camera = str(bvh(tmp_path / "a.bvh")), str(arkit(tmp_path / "log.txt"))
    scene = Scene(avatars=(AvatarSpec(motion=motion),), camera=CameraSpec(source=camera), frames=60)
    staged = stage_scene(scene, [body], Path("/"))
    assert staged.camera.path.recorded and staged.movers[0].motion.travels
    check(staged)


def test_two_avatars_and_betas(body: ShapedBody, tmp_path: Path) -> None:
    poses = np.zeros((9, 165))
    poses[:, 48] = np.linspace(0, 0.6, 9)
    place = np.column_stack([np.linspace(0, 1, 9), np.zeros(9), np.full(9, 0.9)])
    np.savez(tmp_path / "a.npz", poses=poses, trans=place, betas=np.ones(16), mocap_framerate=np.array(60.0))
    avatars = (AvatarSpec(position=(-0.6, 0.0, 0.1)), AvatarSpec(motion=str(tmp_path / "a.npz"), ground="sequence"))
    scene = Scene(avatars=avatars, camera=CameraSpec(source=str(arkit(tmp_path / "log.txt"))), frames=60)
    staged = stage_scene(scene, [body, body], Path("/"))
    check(staged)
    betas = [mover.motion.betas for mover in passed_on(staged).movers]
    assert betas[0] is None and np.array_equal(betas[1], np.ones(16))


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
