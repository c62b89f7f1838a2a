"""Motion files: how each format is read and repaired, what is detected, refused and played."""

from __future__ import annotations

import math
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.joint_chain import chained_places, degrees_between, limb_directions
from trilane.errors import BadInputError
from trilane.scene.motion.builtin import walk_wave_turn
from trilane.scene.motion.files import as_played, load_motion
from trilane.scene.motion.motion import REST_PELVIS, SMPL_REST_PELVIS, T_POSE, Motion, Wrap
from trilane.scene.rotations import about, matrix_from_rotvec, rotvec_from_matrix
from trilane.scene.schema import AvatarSpec, scene_from


def load(path: Path | str, **spec: Any) -> Motion:
    return load_motion(AvatarSpec(motion=str(path), **spec), Path("/"))


def test_a_folder_and_an_npz_of_a_pickle_are_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.npy").mkdir()
    with pytest.raises(BadInputError, match="a folder"):
        load(tmp_path / "folder.npy")
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("poses.npy", pickle.dumps({}))
    with pytest.raises(BadInputError, match=r"no readable \.npz"):
        load(path)


def test_real_smplx_poses_stand_up(shared_data: Path) -> None:
    motion = load(shared_data / "motion" / "smplx_poses_8.npy")
    assert "Z up, as the body stands" in motion.notes
    assert (matrix_from_rotvec(motion.poses[:, 0])[:, 1, 1] > 0.8).all()


RATE, FRAMES = 30, 90


def turned(turn: np.ndarray, poses: np.ndarray, pelvis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A motion in a world that is turned."""
    roots = rotvec_from_matrix(turn @ matrix_from_rotvec(poses[:, 0]))
    return np.concatenate([roots[:, None], poses[:, 1:]], axis=1), pelvis @ turn.T


def walk() -> tuple[np.ndarray, np.ndarray]:
    """Poses and places of the pelvis of three seconds in which one walks and waves, at first towards +Z."""
    motion, frames = walk_wave_turn(), slice(100, 100 + 2 * FRAMES, 2)
    ahead = matrix_from_rotvec(motion.poses[100, 0])[:, 2]
    level = about(1, -np.arctan2(ahead[0], ahead[2]))
    return turned(level, motion.poses[frames], motion.translation[frames] + np.array([0, 0.94, 0]))


POSES, PELVIS = walk()
Z_UP, CAMERA = turned(about(0, np.pi / 2), POSES, PELVIS), turned(about(0, np.pi), POSES, PELVIS)


def smpl(poses: np.ndarray) -> np.ndarray:
    """The 72 columns of SMPL, whose hands do not turn."""
    return np.concatenate([poses[:, :22], np.zeros((len(poses), 2, 3))], axis=1).reshape(len(poses), 72)


def as_smplh(poses: np.ndarray) -> np.ndarray:
    return np.delete(poses, [22, 23, 24], axis=1).reshape(len(poses), 156)


def parts(poses: np.ndarray, *names: str) -> dict[str, np.ndarray]:
    """Columns of SMPL-X under the names of pelvis, body, jaw, eyes and hands."""
    rows = poses.reshape(len(poses), 165)
    ends = dict(zip(names, (0, 3, 66, 69, 75), strict=True))
    stops = (*list(ends.values())[1:], 165)
    return {name: rows[:, start:stop] for (name, start), stop in zip(ends.items(), stops, strict=True)}


def romp() -> dict[str, Any]:
    poses, places = CAMERA[0], CAMERA[1] + np.array([0.2, 1.0, 5.0])
    rows = smpl(poses)
    frames = {
        f"{k:08d}.jpg": {
            "smpl_thetas": rows[k : k + 1], "cam_trans": places[k : k + 1] - SMPL_REST_PELVIS,
            "track_ids": np.array([3]),
        }
        for k in range(FRAMES)
    }  # fmt: skip
    return {"results": np.array(frames, dtype=object)}


def glamr() -> dict[str, Any]:
    person = {
        "smpl_pose": smpl(Z_UP[0])[:, 3:], "smpl_orient_world": Z_UP[0][:, 0], "root_trans_world": Z_UP[1],
        "smpl_beta": np.zeros((FRAMES, 10)), "exist_frames": np.ones(FRAMES, dtype=bool),
    }  # fmt: skip
    return {"person_data": {0: person}, "seq_len": FRAMES}


IN_PARTS = ("root_orient", "pose_body", "pose_jaw", "pose_eye", "pose_hand")
#: File -> what is in it.
FILES: dict[str, Callable[[], Any]] = {
    "smpl-66.npy": lambda: POSES[:, :22].reshape(FRAMES, 66),
    "smpl-72.npy": lambda: smpl(POSES),
    "smplh.npy": lambda: as_smplh(POSES),
    "camera.npy": lambda: smpl(CAMERA[0]),
    "places.npy": lambda: chained_places(POSES, PELVIS, T_POSE),
    "amass-66.npz": lambda: {"poses": Z_UP[0][:, :22].reshape(FRAMES, 66), "trans": Z_UP[1] - REST_PELVIS,
                             "mocap_framerate": RATE},
    "amass-72.npz": lambda: {"poses": smpl(Z_UP[0]), "trans": Z_UP[1] - REST_PELVIS, "mocap_frame_rate": RATE},
    "amass-parts.npz": lambda: {**parts(Z_UP[0], *IN_PARTS), "trans": Z_UP[1] - REST_PELVIS, "mocap_frame_rate": RATE},
    "smplx.npz": lambda: {"global_orient": POSES[:, 0], "body_pose": POSES[:, 1:22].reshape(FRAMES, 63),
                          "transl": PELVIS - REST_PELVIS},
    "aist.pkl": lambda: {"smpl_poses": smpl(POSES), "smpl_trans": 93 * (PELVIS - SMPL_REST_PELVIS),
                         "smpl_scaling": np.array([93.0]), "fps": RATE},
    "glamr.pkl": glamr,
    "romp.npz": romp,
}  # fmt: skip


def written(folder: Path, name: str) -> Path:
    path, values = folder / name, FILES[name]()
    if path.suffix == ".npz":
        np.savez(path, **values)
    elif path.suffix == ".npy":
        np.save(path, values)
    else:
        path.write_bytes(pickle.dumps(values, 2))
    return path


def of_walk(motion: Motion) -> np.ndarray:
    """Places of the joints at the frames of the file, whatever rate it was taken to have."""
    return chained_places(*motion.sample_all(np.linspace(0, motion.duration_s, FRAMES)), T_POSE)


@pytest.mark.parametrize("name", FILES)
def test_a_walk_is_one_body_in_every_format(name: str, tmp_path: Path) -> None:
    """Turned to face +Z in its first frame and moved to the middle of its ground, as every recording is."""
    motion = load_motion(AvatarSpec(motion=str(written(tmp_path, name))), Path("/"))
    places = of_walk(motion)
    wanted = limb_directions(chained_places(POSES, PELVIS, T_POSE))
    for limb, direction in limb_directions(places).items():
        assert degrees_between(direction, wanted[limb]).max() < 0.1, limb
    if name.endswith(".npy") and name != "places.npy":
        assert not motion.travels
    else:
        path = PELVIS - (PELVIS.min(axis=0) + PELVIS.max(axis=0)) / 2
        assert places[:, 0, [0, 2]] == pytest.approx(path[:, [0, 2]], abs=1e-3)
        assert np.ptp(places[:, 0, 1]) == pytest.approx(np.ptp(PELVIS[:, 1]), abs=1e-3)


def walking() -> Motion:
    """Five frames a second apart; at t the body is at x = t, turned by t / 10 rad about Y, its elbow bent by t / 4."""
    times = np.arange(5.0)
    poses = np.zeros((5, 55, 3))
    poses[:, 0, 1], poses[:, 18, 0] = times / 10, times / 4
    places = np.stack([times, np.ones(5), np.zeros(5)], axis=1)
    return Motion(times, poses, places, None, ("a walk",), Wrap.BOUNCE)


def played(**keys: Any) -> Motion:
    return as_played(walking(), AvatarSpec(**keys), "here")


def test_nothing_said_changes_nothing() -> None:
    motion = played()
    assert motion.times_s.tolist() == [0, 1, 2, 3, 4] and motion.wrap is Wrap.BOUNCE
    assert motion.translation == pytest.approx(walking().translation)
    assert motion.notes == ("a walk", "4.00 s, then plays back and forth")


def test_a_part_begins_and_ends_between_frames() -> None:
    """From 0.5 to 2.25 s: frames at 1 and 2 s are inside; the ends are interpolated."""
    motion = played(start_s=0.5, end_s=2.25)
    assert motion.times_s == pytest.approx([0, 0.5, 1.5, 1.75])
    assert motion.poses[:, 18, 0] == pytest.approx(np.array([0.5, 1, 2, 2.25]) / 4)
    assert motion.notes[1:] == ("plays from 0.5 s to 2.25 s of 4.00 s", "1.75 s, then plays back and forth")


def test_a_part_faces_ahead_at_first_and_is_in_the_middle_of_its_ground() -> None:
    """It begins turned by 0.2 rad at x = 2; the turn is undone, and the two metres that are left lie along it."""
    motion = played(start_s=2)
    assert motion.poses[:, 0, 1] == pytest.approx([0, 0.1, 0.2])
    ahead = np.array([math.cos(0.2), 0, math.sin(0.2)])  # x, turned by -0.2 rad about Y
    expected = np.outer([-1, 0, 1], ahead) + np.array([0, 1, 0])
    assert motion.translation == pytest.approx(expected)


def test_speed_is_of_what_is_played() -> None:
    motion = played(start_s=1, end_s=3, speed=4)
    assert motion.times_s == pytest.approx([0, 0.25, 0.5])
    assert motion.notes[1] == "plays from 1 s to 3 s of 4.00 s, at 4 times its speed"
    assert motion.sample(0.25)[0][18, 0] == pytest.approx(0.5)
    assert played(speed=0.5).duration_s == 8


@pytest.mark.parametrize(("loop", "wrap", "note", "at_five"), [
    ("repeat", Wrap.LOOP, "4.00 s, then loops: the first frame is 4.00 m from the last", 0.25),
    ("back-and-forth", Wrap.BOUNCE, "4.00 s, then plays back and forth", 0.75),
    ("hold", Wrap.HOLD, "4.00 s, then holds its last frame", 1.0),
])  # fmt: skip
def test_what_follows_the_last_frame(loop: str, wrap: Wrap, note: str, at_five: float) -> None:
    motion = played(loop=loop)
    assert (motion.wrap, motion.notes[-1]) == (wrap, note)
    assert motion.sample(5.0)[0][18, 0] == pytest.approx(at_five)


@pytest.mark.parametrize(("metres", "note"), [
    (0.04, "4.00 s, then loops"), (0.06, "4.00 s, then loops: the first frame is 0.06 m from the last"),
])  # fmt: skip
def test_a_jump_at_the_repeat_is_noted_from_five_centimetres_on(metres: float, note: str) -> None:
    """The walk is 4 m long."""
    walk = walking()
    short = replace(walk, translation=walk.translation * metres / 4)
    assert as_played(short, AvatarSpec(loop="repeat"), "here").notes[-1] == note


@pytest.mark.parametrize(("keys", "sentence"), [
    ({"end_s": 4.5}, "here: end_s: found 4.5, expected at most the motion's length, 4 s"),
    ({"start_s": 4.0}, "here: start_s: found 4, expected less than the motion's length, 4 s"),
    ({"start_s": 9.0}, "here: start_s: found 9, expected less than the motion's length, 4 s"),
])  # fmt: skip
def test_times_beyond_the_motion_are_refused(keys: dict[str, float], sentence: str) -> None:
    with pytest.raises(BadInputError) as raised:
        played(**keys)
    assert str(raised.value) == sentence


def test_a_start_after_the_end_is_refused_by_the_scene() -> None:
    with pytest.raises(BadInputError, match=r"avatars.0: found start_s 3 and end_s 2, expected start_s below end_s"):
        scene_from("a.toml", {"avatars": [{"start_s": 3.0, "end_s": 2.0}]})
    with pytest.raises(BadInputError, match=r"joint_map: found the joint 'left_hipp'.*did you mean 'left_hip'"):
        scene_from("a.toml", {"avatars": [{"joint_map": {"left_hipp": "a"}}]})


def test_built_in_motions_are_played_alike_and_have_no_names() -> None:
    motion = load_motion(AvatarSpec(motion="builtin:walk-wave-turn", start_s=2.5, end_s=5.0, loop="hold"), Path("/"))
    assert (motion.duration_s, motion.wrap) == (2.5, Wrap.HOLD)
    assert motion.notes == (
        "built in: walks, waves and turns, 60 frames/s",
        "plays from 2.5 s to 5 s of 10.00 s",
        "2.50 s, then holds its last frame",
    )
    with pytest.raises(BadInputError, match=r"builtin:idle: found joint_map, expected none: only joints of \.bvh"):
        load_motion(AvatarSpec(motion="builtin:idle", joint_map={"head": "Head"}), Path("/"))


def test_of_a_real_bvh(shared_data: Path) -> None:
    """Every joint of the file is named once: with its partner, or without one."""
    path = shared_data / "motion" / "cmu_jumping_jacks.bvh"
    found = load_motion(AvatarSpec(motion=str(path)), Path()).detected
    assert (found.format, found.rate, found.axes) == ("BVH", "by `Frame Time`", "Y up, as the body stands")
    assert found.reason.endswith("of MotionBuilder")
    assert found.unit.startswith("cmu")
    assert found.joints["left_knee"] == "LeftKnee"
    assert {"LHipJoint", "RHipJoint"} <= set(found.unmapped)
    named = [line.split()[1] for line in path.read_text().splitlines() if line.split()[:1] in (["JOINT"], ["ROOT"])]
    assert sorted((*found.joints.values(), *found.unmapped)) == sorted(named)
