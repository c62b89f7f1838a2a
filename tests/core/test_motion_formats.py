"""One walk, written in every array format after its published description, is one body: limbs, trunk, path and floor.

The files are made here, so they show that the formats are read as they are described, not that real files are as
described.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.joint_chain import chained_places, degrees_between, limb_directions
from trilane.scene.motion.builtin import walk_wave_turn
from trilane.scene.motion.load import load_motion
from trilane.scene.motion.motion import REST_PELVIS, SMPL_REST_PELVIS, Motion
from trilane.scene.motion.t_pose import T_POSE
from trilane.scene.rotations import about, matrix_from_rotvec, rotvec_from_matrix
from trilane.scene.schema import AvatarSpec

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
