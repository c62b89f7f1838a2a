"""Motion files: how each format is read and repaired, what the notes say, and what is refused."""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilane.errors import BadInputError
from trilane.scene.motion.files import load_motion
from trilane.scene.motion.motion import Motion, Wrap
from trilane.scene.rotations import matrix_from_rotvec
from trilane.scene.schema import AvatarSpec

HALF = np.pi / 2


def load(path: Path | str, **spec: Any) -> Motion:
    return load_motion(AvatarSpec(motion=str(path), **spec), Path("/"))


def poses(frames: int = 4, up: str = "y") -> np.ndarray:
    array = np.zeros((frames, 165))
    array[:, 0] = HALF if up == "z" else 0.0
    array[:, 48:51] = np.linspace(0, 0.3, frames)[:, None]
    return array


def save_npz(path: Path, **arrays: Any) -> Path:
    np.savez(path, **arrays)
    return path


def amass(path: Path, width: int = 165, key: str = "mocap_frame_rate", **extra: Any) -> Path:
    frames = 6
    array = np.zeros((frames, width))
    array[:, 0] = HALF
    array[:, -3:] = 0.5
    trans = np.column_stack([np.linspace(0, 1, frames), np.zeros(frames), np.full(frames, 0.9)])
    return save_npz(path, **{"poses": array, "trans": trans, "betas": np.ones(16), key: np.array(60.0), **extra})


def test_npy_has_an_assumed_rate_and_says_so(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", poses(31).astype(np.float32))
    motion = load(tmp_path / "a.npy")
    assert motion.poses.shape == (31, 55, 3)
    assert motion.duration_s == pytest.approx(1.0)
    assert "30 frames/s assumed" in " ".join(motion.notes)
    assert not motion.travels


def test_unlike_neighbours_are_separate_poses(tmp_path: Path) -> None:
    array = poses(5)
    array[:, 3:66] = np.random.default_rng(0).normal(0, 0.6, (5, 63))
    np.save(tmp_path / "a.npy", array)
    motion = load(tmp_path / "a.npy")
    assert motion.duration_s == pytest.approx(4.0)
    assert "separate poses" in " ".join(motion.notes)


@pytest.mark.parametrize(("up", "stated", "note"), [
    ("y", "auto", "Y up, as the body stands"),
    ("z", "auto", "Z up, as the body stands"),
    ("y", "z", "Z up, as given"),
])  # fmt: skip
def test_the_up_axis_is_the_bodys_own(tmp_path: Path, up: str, stated: str, note: str) -> None:
    np.save(tmp_path / "a.npy", poses(up=up))
    motion = load(tmp_path / "a.npy", up_axis=stated)
    assert note in motion.notes
    if stated == "auto":
        assert matrix_from_rotvec(motion.poses[0, 0]) == pytest.approx(np.eye(3), abs=1e-12)


def test_a_motion_faces_the_viewer_at_first_and_is_centred(tmp_path: Path) -> None:
    path = amass(tmp_path / "a.npz")
    motion = load(path)
    assert matrix_from_rotvec(motion.poses[0, 0])[:, 2] == pytest.approx([0, 0, 1], abs=1e-12)
    ground = motion.translation[:, [0, 2]]
    assert ground.min(axis=0) + ground.max(axis=0) == pytest.approx([0, 0], abs=1e-12)
    assert np.ptp(motion.translation[:, 1]) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("key", ["mocap_framerate", "mocap_frame_rate"])
@pytest.mark.parametrize("width", [156, 165])
def test_amass_in_both_spellings_and_widths(tmp_path: Path, key: str, width: int) -> None:
    motion = load(amass(tmp_path / "a.npz", width, key))
    assert motion.times_s == pytest.approx(np.arange(6) / 60)
    assert motion.poses[0, 54] == pytest.approx([0.5] * 3)
    assert motion.poses[:, 22:25] == pytest.approx(0)
    assert motion.betas is not None
    notes = " ".join(motion.notes)
    assert key in notes
    assert f"{width} columns" in notes
    assert "betas: 16" in notes
    assert "Z up" in notes


def test_broken_frames_are_interpolated_across_and_counted(tmp_path: Path) -> None:
    array = np.zeros((7, 165))
    array[:, 48] = np.linspace(0, 0.6, 7)
    array[3, 100] = np.nan
    np.save(tmp_path / "a.npy", array)
    motion = load(tmp_path / "a.npy")
    assert len(motion.times_s) == 6
    assert motion.sample(3 / 30)[0][16, 0] == pytest.approx(0.3)
    assert any("1 samples not finite" in note and "number 3" in note for note in motion.notes)
    assert any("1 gaps, the longest 67 ms" in note for note in motion.notes)


def test_one_frame_is_held(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", poses(1))
    motion = load(tmp_path / "a.npy")
    assert "one frame: held" in motion.notes
    for t_s in (0.0, 0.5, 1e6):
        assert np.isfinite(motion.sample(t_s)[0]).all()


def test_a_recording_plays_back_and_forth(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", poses(31))
    motion = load(tmp_path / "a.npy")
    assert motion.wrap is Wrap.BOUNCE
    for t_s in (0.2, 0.95):
        assert motion.sample(2 - t_s)[0] == pytest.approx(motion.sample(t_s)[0])
        assert motion.sample(2 + t_s)[0] == pytest.approx(motion.sample(t_s)[0])


WRONG_NPY = {
    "wide": (np.zeros((3, 71)), "shape (3, 71)"),
    "no frames": (np.zeros((0, 165)), "shape (0, 165)"),
    "text": (np.array([["x"] * 165]), "dtype <U1"),
    "all NaN": (np.full((3, 165), np.nan), "3 samples that are not finite"),
    "degrees": (np.full((3, 165), 90.0), "an angle of 90"),
    "scalar": (np.zeros(()), "shape ()"),
}


@pytest.mark.parametrize("case", WRONG_NPY)
def test_a_wrong_npy_is_refused(tmp_path: Path, case: str) -> None:
    array, found = WRONG_NPY[case]
    path = tmp_path / "a.npy"
    np.save(path, array)
    with pytest.raises(BadInputError) as raised:
        load(path)
    assert str(path) in str(raised.value)
    assert found in str(raised.value)


def test_objects_truncated_and_huge_files_are_refused_unread(tmp_path: Path) -> None:
    pickled, cut, huge, empty = (tmp_path / f"{name}.npy" for name in ("pickled", "cut", "huge", "empty"))
    np.save(pickled, np.array([{}]), allow_pickle=True)
    np.save(cut, poses(100))
    cut.write_bytes(cut.read_bytes()[:500])
    with huge.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (10**9, 165)})
    empty.write_bytes(b"")
    for path, found in (
        (pickled, "found nothing, expected a motion"),
        (cut, "truncated"),
        (huge, "at most"),
        (empty, "an empty file"),
    ):
        with pytest.raises(BadInputError, match=found):
            load(path)


def test_missing_folders_and_unknown_endings_are_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.npy").mkdir()
    (tmp_path / "a.fbx").write_text("x")
    for name, found in (("none.npy", "no such file"), ("folder.npy", "a folder"), ("a.fbx", "the ending '.fbx'")):
        with pytest.raises(BadInputError, match=found):
            load(tmp_path / name)
    with pytest.raises(BadInputError, match="walk-wave-turn"):
        load("builtin:dance")


WRONG_AMASS = {
    "poses": ({"poses": np.zeros((6, 71))}, "shape (6, 71)"),
    "trans": ({"trans": np.zeros((5, 3))}, "shape (5, 3)"),
    "betas": ({"betas": np.full(16, np.nan)}, "not finite"),
    "mocap_frame_rate": ({"mocap_frame_rate": np.array(0.0)}, "one rate from 1 to 1000"),
}


@pytest.mark.parametrize("key", WRONG_AMASS)
def test_a_wrong_amass_file_is_named_by_key(tmp_path: Path, key: str) -> None:
    changes, found = WRONG_AMASS[key]
    path = amass(tmp_path / "a.npz", **changes)
    with pytest.raises(BadInputError) as raised:
        load(path)
    assert f"{path}[{key}]" in str(raised.value)
    assert found in str(raised.value)


def test_an_npz_without_its_keys_or_damaged_is_refused(tmp_path: Path) -> None:
    path = save_npz(tmp_path / "a.npz", poses=np.zeros((3, 165)))
    with pytest.raises(BadInputError, match="no frame rate"):
        load(path)
    save_npz(path, trans=np.zeros((3, 3)))
    with pytest.raises(BadInputError, match="found arrays trans, expected a motion: `poses`"):
        load(path)
    path.write_bytes(amass(tmp_path / "b.npz").read_bytes()[:900])
    with pytest.raises(BadInputError, match=r"no readable \.npz"):
        load(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("poses.npy", pickle.dumps({}))
    with pytest.raises(BadInputError, match=r"no readable \.npz"):
        load(path)


@pytest.mark.parametrize("name", ["a.npy", "a.npz"])
@given(st.lists(st.tuples(st.integers(0, 300), st.integers(0, 255)), min_size=1, max_size=6))
@settings(max_examples=60)
def test_damaged_arrays_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, name: str, changes: list[tuple[int, int]]
) -> None:
    path = tmp_path_factory.mktemp("damaged") / name
    if name == "a.npy":
        np.save(path, poses())
    else:
        amass(path)
    content = bytearray(path.read_bytes())
    for place, value in changes:
        content[place] = value
    path.write_bytes(content)
    try:
        load(path)
    except BadInputError as error:
        assert name in str(error)


def test_real_smplx_poses_stand_up(shared_data: Path) -> None:
    motion = load(shared_data / "motion" / "smplx_poses_8.npy")
    assert "Z up, as the body stands" in motion.notes
    assert (matrix_from_rotvec(motion.poses[:, 0])[:, 1, 1] > 0.8).all()
