"""Places of joints, as HumanML3D saves them: told from turns by their content, and turned into poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.joint_chain import chained_places, degrees_between, limb_directions
from trilane.body.joints import JOINT_NAMES
from trilane.errors import BadInputError
from trilane.scene.motion.array_files import load_npy
from trilane.scene.motion.builtin import walk_wave_turn
from trilane.scene.motion.joint_places import places_in
from trilane.scene.motion.motion import Motion
from trilane.scene.motion.recorded import RawMotion
from trilane.scene.motion.t_pose import T_POSE
from trilane.scene.rotations import matrix_from_rotvec


def places_of(poses: np.ndarray, pelvis: np.ndarray) -> np.ndarray:
    """Places (T, 22, 3) of the joints of the plain body."""
    return chained_places(poses, pelvis, T_POSE)


@pytest.fixture(scope="module")
def walk() -> Motion:
    return walk_wave_turn()


def read(path: Path, array: np.ndarray) -> RawMotion:
    np.save(path, array)
    return load_npy(path)


def test_limbs_point_where_the_places_say(tmp_path: Path, walk: Motion) -> None:
    """Places of a walk with waving and turning; the poses that are read put the limbs there again."""
    frames = slice(0, 600, 12)
    truth = places_of(walk.poses[frames], walk.translation[frames])
    raw = read(tmp_path / "a.npy", truth.astype(np.float32))
    assert raw.translation is not None
    again = places_of(raw.poses, raw.translation)
    wanted, found = limb_directions(truth), limb_directions(again)
    for name, bone in found.items():
        assert degrees_between(bone, wanted[name]).max() < 0.1, name
    assert np.abs(again - truth).max() < 0.03
    hips = matrix_from_rotvec(raw.poses[:, 0]), matrix_from_rotvec(walk.poses[frames, 0])
    assert degrees_between(hips[0][:, :, 0], hips[1][:, :, 0]).max() < 1.0
    assert raw.times_s[1] == pytest.approx(1 / 20)
    assert raw.up == "y" and raw.feet is not None
    notes = " ".join(raw.notes)
    assert raw.notes[0].startswith("places of 22 joints .npy, as of HumanML3D, 50 frames, 20 frames/s")
    assert "units: m, by the length of the legs" in notes and "the head follows the neck" in notes


@pytest.mark.parametrize(("unit", "unit_m"), [("cm", 0.01), ("m", 1.0)])
def test_units_are_told_by_the_legs(tmp_path: Path, walk: Motion, unit: str, unit_m: float) -> None:
    truth = places_of(walk.poses[:300:60], walk.translation[:300:60])
    raw = read(tmp_path / "a.npy", truth / unit_m)
    assert f"units: {unit}, by the length of the legs" in " ".join(raw.notes)
    assert raw.translation is not None
    assert raw.translation[:, 2] == pytest.approx(truth[:, 0, 2], abs=0.01)


def test_flat_rows_and_more_joints_are_read_alike(tmp_path: Path, walk: Motion) -> None:
    truth = places_of(walk.poses[:100:20], walk.translation[:100:20])
    raw = read(tmp_path / "a.npy", truth)
    hands = np.concatenate([truth, truth[:, 20:22] + 0.08], axis=1)
    for array in (truth.reshape(len(truth), 66), hands, hands.reshape(len(truth), 72)):
        assert read(tmp_path / "a.npy", array).poses == pytest.approx(raw.poses)


def test_frames_with_damaged_places_are_left_out_later(tmp_path: Path, walk: Motion) -> None:
    truth = places_of(walk.poses[:200:20], walk.translation[:200:20])
    truth[3, 5] = np.nan
    truth[4, 5] += 2.0  # a shin of two metres
    raw = read(tmp_path / "a.npy", truth)
    bad = np.isnan(raw.poses).all(axis=(1, 2))
    assert np.flatnonzero(bad).tolist() == [3, 4]


def test_turns_are_no_places(walk: Motion) -> None:
    """Of a walk, of the T pose, of poses at random, and of places whose left leg is half as long as the right one."""
    assert places_in(walk.poses[:, :22]) is None
    assert places_in(np.zeros((5, 22, 3))) is None
    assert places_in(walk.poses[:, :22].reshape(len(walk.poses), 66)) is None
    truth = places_of(walk.poses[:3], walk.translation[:3])
    assert places_in(truth) is not None
    lame = truth.copy()
    lame[:, [4, 7, 10]] = (truth[:, [4, 7, 10]] + truth[:, [1, 1, 1]]) / 2
    assert places_in(lame) is None
    assert places_in(truth[:, :21]) is None and places_in(np.zeros((0, 66))) is None and places_in(np.zeros(66)) is None


@given(st.integers(0, 2**32 - 1), st.floats(0.02, 3), st.booleans())
@settings(max_examples=150)
def test_a_pose_at_random_is_never_taken_for_places(seed: int, size: float, mirrored: bool) -> None:
    """One pose alone, so that no bone can change its length; mirrored, so that both sides are alike."""
    pose = np.random.default_rng(seed).normal(0, size, (1, 22, 3))
    if mirrored:
        for left, name in enumerate(JOINT_NAMES[:22]):
            if name.startswith("left"):
                right = JOINT_NAMES.index(name.replace("left", "right"))
                pose[:, right] = pose[:, left] * (1, -1, -1)
    assert places_in(pose) is None


@pytest.mark.parametrize(("shape", "way"), [
    ((4, 263), "make places of joints of them with its recover_from_ric"),
    ((4, 22, 6), "these are turns of six numbers: turn them into axis-angle vectors"),
    ((4, 24, 3, 3), "these are matrices: turn them into axis-angle vectors"),
    ((4, 52, 4), "these are quaternions: turn them into axis-angle vectors"),
])  # fmt: skip
def test_what_others_save_is_refused_with_a_way(tmp_path: Path, shape: tuple[int, ...], way: str) -> None:
    with pytest.raises(BadInputError) as raised:
        read(tmp_path / "a.npy", np.zeros(shape))
    assert f"found shape {shape}, expected (T, 66), (T, 72), (T, 156) or (T, 165), axis-angle; " in str(raised.value)
    assert way in str(raised.value)
