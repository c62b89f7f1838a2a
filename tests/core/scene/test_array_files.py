"""Motions in arrays: each layout of the SMPL family from a file made after its description, and places of joints."""

from __future__ import annotations

import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.joint_chain import chained_places, degrees_between, limb_directions
from trilane.body.joints import JOINT_NAMES
from trilane.errors import BadInputError
from trilane.scene.motion.builtin import walk_wave_turn
from trilane.scene.motion.files import load_motion, load_npy, load_npz, load_pickle, places_in
from trilane.scene.motion.motion import SMPL_REST_PELVIS, T_POSE, Motion, RawMotion
from trilane.scene.rotations import matrix_from_rotvec
from trilane.scene.schema import AvatarSpec

ROWS = np.arange(4 * 72).reshape(4, 72) / 1000.0
PLACES = np.arange(12.0).reshape(4, 3)
#: One who stands upright before a camera whose y points down, and looks at it: half a turn about x.
BEFORE_CAMERA = np.concatenate([[np.pi, 0, 0], np.zeros(69)])


def save(path: Path, values: Any, protocol: int = 4) -> Path:
    """`values` in a file of the kind that the ending of `path` says."""
    if path.suffix == ".npz":
        np.savez(path, **values)
    elif path.suffix == ".npy":
        np.save(path, np.array(values) if isinstance(values, np.ndarray) else values, allow_pickle=True)
    else:
        path.write_bytes(pickle.dumps(values, protocol))
    return path


def read(path: Path) -> RawMotion:
    return {".npz": load_npz, ".npy": load_npy, ".pkl": load_pickle}[path.suffix](path)


def body_of(rows: np.ndarray) -> np.ndarray:
    """The first 22 joints of rows of SMPL's 24."""
    return rows.reshape(len(rows), -1, 3)[:, :22]


# --- one array ---


@pytest.mark.parametrize(("width", "whose"), [(66, "SMPL body"), (72, "SMPL"), (156, "SMPL-H"), (165, "SMPL-X")])
def test_an_array_of_any_width_of_the_family(tmp_path: Path, width: int, whose: str) -> None:
    rows = np.arange(4 * width).reshape(4, width) / 1e4
    for array in (rows, rows.reshape(4, -1, 3)):
        raw = read(save(tmp_path / "a.npy", array))
        assert raw.poses[:, :22] == pytest.approx(body_of(rows[:, :66]))
        assert raw.notes[0] == f"{whose} .npy, 4 frames"
        if width >= 156:
            assert raw.poses[:, 25:] == pytest.approx(rows.reshape(4, -1, 3)[:, -30:])
        else:
            assert not raw.poses[:, 22:].any()
    assert raw.poses[:, 22:25].any() == (width == 165)


@pytest.mark.parametrize("shape", [(3, 71), (3, 23, 3), (3, 69), (72,), (0, 72)])
def test_arrays_that_are_no_axis_angle_are_refused_with_the_widths(tmp_path: Path, shape: tuple[int, ...]) -> None:
    path = save(tmp_path / "a.npy", np.zeros(shape))
    with pytest.raises(BadInputError) as raised:
        read(path)
    assert str(raised.value) == (
        f"{path}: found shape {shape}, expected (T, 66), (T, 72), (T, 156) or (T, 165), T at least 1, axis-angle"
    )


# --- AMASS, short and in parts ---


def test_amass_in_parts(tmp_path: Path) -> None:
    """AMASS's newer files have the pelvis, the body, the hands, the jaw and the eyes apart."""
    row = np.arange(165.0) / 100
    parts = {"root_orient": row[:3], "pose_body": row[3:66], "pose_jaw": row[66:69], "pose_eye": row[69:75]}
    parts["pose_hand"] = row[75:]
    arrays = {key: np.stack([part, 2 * part]) for key, part in parts.items()}
    raw = read(save(tmp_path / "a.npz", {**arrays, "trans": PLACES[:2], "mocap_frame_rate": 30, "betas": np.ones(16)}))
    assert raw.poses.reshape(2, 165) == pytest.approx(np.stack([row, 2 * row]))
    assert raw.notes[0] == "AMASS in parts .npz (SMPL-X body, 63 columns), 2 frames at 30/s (mocap_frame_rate)"
    arrays["pose_body"] = arrays["pose_body"][:1]
    with pytest.raises(BadInputError, match=r"\[pose_body\]: found 1 rows, expected 2, as `root_orient`"):
        read(save(tmp_path / "a.npz", {**arrays, "mocap_frame_rate": 30}))


def test_the_names_of_smplx(tmp_path: Path) -> None:
    """Arguments of the smplx package; its hands may be weights of components, which are no turns."""
    row = np.arange(165.0) / 100
    values = {
        "global_orient": row[None, :3], "body_pose": row[None, 3:66], "transl": PLACES[:1], "betas": np.ones((1, 10)),
        "left_hand_pose": np.ones((1, 6)), "right_hand_pose": row[None, 120:165],
    }  # fmt: skip
    raw = read(save(tmp_path / "a.npz", values))
    assert raw.poses[0, :22].ravel() == pytest.approx(row[:66])
    assert not raw.poses[0, 22:40].any()
    assert raw.poses[0, 40:].ravel() == pytest.approx(row[120:])
    assert raw.betas is not None and raw.betas.tolist() == [1] * 10
    assert "`left_hand_pose` of shape (1, 6) left out: no turns of single joints" in raw.notes


# --- AIST++ ---


def aist(**changes: Any) -> dict[str, Any]:
    """A file of AIST++: 72 columns, places in units in which the body is `smpl_scaling` times as large."""
    values = {"smpl_poses": ROWS, "smpl_trans": 93.0 * PLACES, "smpl_scaling": np.array([93.0]), "smpl_loss": 0.1}
    return {key: value for key, value in {**values, **changes}.items() if value is not None}


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_aist_divides_places_by_its_scale_and_has_60_frames_a_second(tmp_path: Path, protocol: int) -> None:
    raw = read(save(tmp_path / "a.pkl", aist(), protocol))
    assert raw.poses[:, :22] == pytest.approx(body_of(ROWS))
    assert raw.translation == pytest.approx(SMPL_REST_PELVIS + PLACES)
    assert raw.times_s == pytest.approx(np.arange(4) / 60)
    assert (raw.up, raw.betas) == ("y", None)
    assert raw.notes[0] == "AIST++ .pkl (SMPL, 72 columns), 4 frames at 60/s (60 frames/s, as AIST++ has them)"
    assert "places divided by `smpl_scaling`, 93" in raw.notes


def test_aist_with_a_rate_of_its_own_or_without_a_scale(tmp_path: Path) -> None:
    raw = read(save(tmp_path / "a.npz", aist(fps=30, smpl_scaling=None, smpl_trans=PLACES)))
    assert raw.times_s == pytest.approx(np.arange(4) / 30)
    assert raw.translation == pytest.approx(SMPL_REST_PELVIS + PLACES)
    assert "no `smpl_scaling`: places taken for metres" in raw.notes


WRONG_AIST: list[tuple[dict[str, Any], str]] = [
    ({"smpl_scaling": np.array([0.0])}, "[smpl_scaling]: found [0.0], expected one scale above 0, at most 10000"),
    ({"smpl_scaling": np.ones(2)}, "[smpl_scaling]: found [1.0, 1.0], expected one scale above 0, at most 10000"),
    ({"smpl_scaling": np.array(np.nan)}, "[smpl_scaling]: found nan, expected one scale above 0, at most 10000"),
    ({"smpl_trans": PLACES[:3]}, "[smpl_trans]: found shape (3, 3), expected (4, 3), a row for each of `smpl_poses`"),
    ({"smpl_trans": "here"}, "[smpl_trans]: found str, expected an array of numbers; save its arrays with NumPy"),
    ({"smpl_poses": [[1.0]]}, "[smpl_poses]: found list, expected an array of numbers; save its arrays with NumPy"),
    ({"smpl_poses": Path("a")}, "[smpl_poses]: found pathlib"),
    ({"smpl_poses": None}, ": found smpl_trans (4, 3), smpl_scaling (1,), smpl_loss (), expected a motion: `poses`"),
]


@pytest.mark.parametrize("case", range(len(WRONG_AIST)))
def test_a_wrong_aist_file_is_named_by_key(tmp_path: Path, case: int) -> None:
    changes, sentence = WRONG_AIST[case]
    path = save(tmp_path / "a.pkl", aist(**changes))
    with pytest.raises(BadInputError) as raised:
        read(path)
    assert str(raised.value).startswith(f"{path}{sentence}")


# --- GLAMR ---


def test_glamr_has_persons_in_a_world_with_z_up(tmp_path: Path) -> None:
    """Two persons; the second has more frames. Its place is the pelvis's own, its third frame was not measured."""

    def person(frames: int) -> dict[str, Any]:
        return {
            "smpl_pose": np.tile(ROWS[:1, 3:], (frames, 1)),
            "smpl_orient_world": np.tile([[np.pi / 2, 0, 0]], (frames, 1)),
            "root_trans_world": np.arange(3.0 * frames).reshape(frames, 3),
            "smpl_beta": np.tile(np.arange(10.0), (frames, 1)),
            "exist_frames": np.arange(frames) != 2, "smpl_orient_cam": np.zeros((frames, 3)),
        }  # fmt: skip

    path = save(tmp_path / "a.pkl", {"person_data": {0: person(3), 1: person(5)}, "seq_len": 5, "meta": {"algo": "g"}})
    raw = read(path)
    assert raw.times_s == pytest.approx(np.array([0, 1, 3, 4]) / 30)
    assert raw.translation == pytest.approx(np.arange(15.0).reshape(5, 3)[[0, 1, 3, 4]])
    assert raw.poses[0, 0] == pytest.approx([np.pi / 2, 0, 0])
    assert raw.poses[0, 1:22].ravel() == pytest.approx(ROWS[0, 3:66])
    assert raw.betas == pytest.approx(np.arange(10.0))
    assert raw.notes[0] == (
        "GLAMR .pkl (SMPL, 69 columns), 5 frames at 30/s (no rate in the file, 30 frames/s assumed)"
    )
    assert "2 persons in the file: person_data.1, the one with the most frames, is read" in raw.notes
    assert "1 frames that were not measured left out" in raw.notes
    motion = load_motion(AvatarSpec(motion=str(path)), tmp_path)
    assert "Z up, as the body stands" in motion.notes
    for change, sentence in (
        ({"exist_frames": np.zeros(5)}, "[exist_frames]: found no frame that was measured, expected at least one"),
        ({"smpl_beta": np.ones((2, 3, 4))}, "[smpl_beta]: found shape (2, 3, 4), expected (n,), or a row for each"),
    ):
        save(path, {"person_data": {0: {**person(5), **change}}})
        with pytest.raises(BadInputError, match=re.escape(sentence)):
            read(path)


# --- ROMP ---


def seen(*tracks: int, x: float = 0.0) -> dict[str, Any]:
    """What ROMP has of one frame: a row for each person, who stands at (x, 1, 4 + their track) before the camera."""
    return {
        "smpl_thetas": np.stack([BEFORE_CAMERA] * len(tracks)) if tracks else np.zeros((0, 72)),
        "smpl_betas": np.zeros((len(tracks), 10)),
        "cam_trans": np.array([[x, 1.0, 4.0 + track] for track in tracks]).reshape(-1, 3),
        "track_ids": np.array(tracks, dtype=np.int64),
        "verts": np.zeros((len(tracks), 8, 3), dtype=np.float32),
    }


def romp(path: Path, frames: dict[str, Any]) -> RawMotion:
    """As `simple_romp` saves a video: one object named `results`."""
    np.savez(path, results=np.array(frames, dtype=object))
    return read(path)


def test_romp_follows_who_is_there_most_by_the_numbers_of_frames(tmp_path: Path) -> None:
    """Track 7 is in frames 3, 4 and 6, once in the second row; track 1 in two frames."""
    frames = {"00000006.jpg": seen(7, x=0.3), "00000003.jpg": seen(1, 7), "00000004.jpg": seen(7, 1, x=0.1),
              "00000005.jpg": seen()}  # fmt: skip
    raw = romp(tmp_path / "a.npz", frames)
    assert raw.times_s == pytest.approx(np.array([3, 4, 6]) / 30)
    assert raw.translation == pytest.approx(SMPL_REST_PELVIS + np.array([[0, 1, 11], [0.1, 1, 11], [0.3, 1, 11]]))
    assert "track 7 is read, in 3 frames, of 2 in the file" in raw.notes
    motion = load_motion(AvatarSpec(motion=str(tmp_path / "a.npz")), tmp_path)
    assert "-Y up, as the body stands" in motion.notes
    assert matrix_from_rotvec(motion.poses[:, 0]) == pytest.approx(np.stack([np.eye(3)] * 3), abs=1e-9)


def test_romp_without_tracks_is_the_first_of_each_frame(tmp_path: Path) -> None:
    frames = {name: {k: v for k, v in seen(1, 2).items() if k != "track_ids"} for name in ("a", "b")}
    raw = romp(tmp_path / "a.npz", frames)
    assert raw.times_s == pytest.approx([0, 1 / 30])
    assert (
        "the first person of each frame is read; up to 2 persons in a frame and no `track_ids`, so they may change"
        in raw.notes
    )
    one = romp(tmp_path / "a.npz", seen(1))
    assert len(one.times_s) == 1


def test_romp_with_nobody_or_arrays_that_do_not_fit(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="found nobody in any frame"):
        romp(tmp_path / "a.npz", {"1.jpg": seen()})
    with pytest.raises(
        BadInputError, match=r"results\.1\.jpg\]\[cam_trans\]: found shape \(2, 3\), expected a row of 3"
    ):
        romp(tmp_path / "a.npz", {"1.jpg": {**seen(1), "cam_trans": np.zeros((2, 3))}})
    for track in (np.nan, 1e300):
        with pytest.raises(
            BadInputError, match=rf"track_ids\]: found {re.escape(f'{track:g}')}, expected whole numbers"
        ):
            romp(tmp_path / "a.npz", {"1.jpg": {**seen(1), "track_ids": np.array([track])}})
    with pytest.raises(BadInputError, match=r"\[smpl_thetas\]: found one number"):
        romp(tmp_path / "a.npz", {"1.jpg": {**seen(1), "smpl_thetas": 3.0}})


# --- what is none ---


def test_a_file_without_a_motion_says_what_it_has(tmp_path: Path) -> None:
    for values, found in (
        ({"verts": np.zeros((2, 3)), "name": "x"}, "found verts (2, 3), name, expected a motion: `poses` (AMASS); or "),
        ({"a": {"b": {"verts": np.zeros(2)}}}, "found verts (2,) in a.b, expected"),
        ([1.0, "x"], "found a list, expected"),
        ({}, "found nothing, expected"),
        ("text", "found a str, expected"),
    ):
        with pytest.raises(BadInputError) as raised:
            read(save(tmp_path / "a.pkl", values))
        assert found in str(raised.value) and "numpy.savez" in str(raised.value)


def test_a_pickle_that_would_run_is_refused_and_not_run(tmp_path: Path) -> None:
    made = tmp_path / "made"
    (tmp_path / "a.pkl").write_bytes(f"cos\nsystem\n(S'touch {made}'\ntR.".encode())
    with pytest.raises(BadInputError, match=r"found os\.system, which is not built, expected"):
        read(tmp_path / "a.pkl")
    assert not made.exists()
    (tmp_path / "a.pkl").write_bytes(b"cjoblib.numpy_pickle\nNumpyArrayWrapper\n)R.")
    with pytest.raises(BadInputError, match=r"found a file of joblib.*numpy\.savez"):
        read(tmp_path / "a.pkl")


def places_of(poses: np.ndarray, pelvis: np.ndarray) -> np.ndarray:
    """Places (T, 22, 3) of the joints of the plain body."""
    return chained_places(poses, pelvis, T_POSE)


@pytest.fixture(scope="module")
def walk() -> Motion:
    return walk_wave_turn()


def test_limbs_point_where_the_places_say(tmp_path: Path, walk: Motion) -> None:
    """Places of a walk with waving and turning; the poses that are read put the limbs there again."""
    frames = slice(0, 600, 12)
    truth = places_of(walk.poses[frames], walk.translation[frames])
    raw = read(save(tmp_path / "a.npy", truth.astype(np.float32)))
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


def test_flat_rows_and_more_joints_are_read_alike(tmp_path: Path, walk: Motion) -> None:
    truth = places_of(walk.poses[:100:20], walk.translation[:100:20])
    raw = read(save(tmp_path / "a.npy", truth))
    hands = np.concatenate([truth, truth[:, 20:22] + 0.08], axis=1)
    for array in (truth.reshape(len(truth), 66), hands, hands.reshape(len(truth), 72)):
        assert read(save(tmp_path / "a.npy", array)).poses == pytest.approx(raw.poses)


def test_frames_with_damaged_places_are_left_out_later(tmp_path: Path, walk: Motion) -> None:
    truth = places_of(walk.poses[:200:20], walk.translation[:200:20])
    truth[3, 5] = np.nan
    truth[4, 5] += 2.0  # a shin of two metres
    raw = read(save(tmp_path / "a.npy", truth))
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
        read(save(tmp_path / "a.npy", np.zeros(shape)))
    assert f"found shape {shape}, expected (T, 66), (T, 72), (T, 156) or (T, 165), axis-angle; " in str(raised.value)
    assert way in str(raised.value)
