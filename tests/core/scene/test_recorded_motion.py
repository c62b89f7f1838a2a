"""Recorded motions by value: numbers chosen by hand, legs by their own chain, bodies on the floor of the file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane.body.joints import JOINT_INDEX
from trilane.errors import BadInputError
from trilane.scene.motion import motion as recorded_module
from trilane.scene.motion.bvh import UPS
from trilane.scene.motion.files import load_motion, load_npy, load_npz
from trilane.scene.motion.motion import (
    ANY,
    REST_PELVIS,
    WORLD,
    Motion,
    RawMotion,
    Wrap,
    bracket,
    lowest,
    motion_from_recording,
    wrapped_time,
)
from trilane.scene.motion.smpl_files import median_step_rad
from trilane.scene.recordings import usable_samples
from trilane.scene.rotations import matrix_from_rotvec
from trilane.scene.schema import AvatarSpec


def turn_about(axis: str, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


# --- AMASS ---


def amass(path: Path, **changes: Any) -> Path:
    """Three frames of 156 columns, each its own number; `None` leaves an array out."""
    arrays = {
        "poses": np.arange(3 * 156).reshape(3, 156) / 100,
        "trans": np.array([[0, 0, 1], [1, 2, 3], [4, 5, 6.0]]),
        "betas": np.array([0.5, -0.5]),
        "mocap_framerate": np.array(120.0),
        **changes,
    }
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    return path


def test_smplh_has_no_jaw_and_eyes(tmp_path: Path) -> None:
    """Columns 0-65 are the body, 66-110 the left hand, 111-155 the right one."""
    raw = load_npz(amass(tmp_path / "a.npz"))
    row = np.arange(156, 312).reshape(52, 3) / 100
    assert raw.poses[1, :22] == pytest.approx(row[:22])
    assert not raw.poses[:, 22:25].any()
    assert raw.poses[1, 25:] == pytest.approx(row[22:])
    assert raw.times_s == pytest.approx([0, 1 / 120, 2 / 120])
    assert raw.translation == pytest.approx(
        np.array([[0.003, -0.351, 1.012], [1.003, 1.649, 3.012], [4.003, 4.649, 6.012]])
    )
    assert raw.betas is not None and raw.betas.tolist() == [0.5, -0.5]
    assert (raw.up, raw.leg_m) == ("z", None)
    assert raw.notes == (
        "AMASS .npz (SMPL-H, 156 columns), 3 frames at 120/s (mocap_framerate)",
        "hands: posed (flat-hand zero)",
        "betas: 2",
    )
    assert REST_PELVIS.tolist() == [0.003, -0.351, 0.012]


WRONG_AMASS: list[tuple[dict[str, Any], str]] = [
    (
        {"poses": None},
        ": found arrays trans, betas, mocap_framerate, expected a motion: `poses` (AMASS); or `smpl_poses` (AIST++); ",
    ),
    (
        {"poses": np.zeros((3, 157))},
        "[poses]: found shape (3, 157), expected (T, 66), (T, 72), (T, 156) or (T, 165), T at least 1, axis-angle",
    ),
    (
        {"poses": np.zeros((0, 156))},
        "[poses]: found shape (0, 156), expected (T, 66), (T, 72), (T, 156) or (T, 165), T at least 1, axis-angle",
    ),
    (
        {"poses": np.zeros(156)},
        "[poses]: found shape (156,), expected (T, 66), (T, 72), (T, 156) or (T, 165), T at least 1, axis-angle",
    ),
    ({"poses": np.full((3, 156), "a")}, "[poses]: found dtype <U1, expected numbers"),
    ({"mocap_framerate": None}, ": found no frame rate, expected a key `mocap_framerate` or `mocap_frame_rate`"),
    ({"mocap_framerate": np.array(0.99)}, "[mocap_framerate]: found 0.99, expected one rate from 1 to 1000 frames/s"),
    ({"mocap_framerate": np.array(1001)}, "[mocap_framerate]: found 1001.0, expected one rate from 1 to 1000 frames/s"),
    ({"mocap_framerate": np.ones(2)}, "[mocap_framerate]: found [1.0, 1.0], expected one rate from 1 to 1000 frames/s"),
    ({"mocap_framerate": np.array("x")}, "[mocap_framerate]: found dtype <U1, expected numbers"),
    ({"trans": np.zeros((3, 2))}, "[trans]: found shape (3, 2), expected (3, 3), a row for each of `poses`"),
    ({"trans": np.full((3, 3), "a")}, "[trans]: found dtype <U1, expected numbers"),
    ({"betas": np.zeros(401)}, "[betas]: found 401 values, some not finite or too many, expected finite numbers"),
    ({"betas": np.array([np.inf])}, "[betas]: found 1 values, some not finite or too many, expected finite numbers"),
    ({"betas": np.array(["a"])}, "[betas]: found dtype <U1, expected numbers"),
]


@pytest.mark.parametrize("case", range(len(WRONG_AMASS)))
def test_a_wrong_amass_file_is_refused_in_one_sentence(tmp_path: Path, case: int) -> None:
    changes, sentence = WRONG_AMASS[case]
    path = amass(tmp_path / "a.npz", **changes)
    with pytest.raises(BadInputError) as raised:
        load_npz(path)
    assert str(raised.value).startswith(f"{path}{sentence}")


# --- SMPL-X arrays ---


def stepping(step: float, joint: int = 5, frames: int = 5) -> np.ndarray:
    poses = np.zeros((frames, 55, 3))
    poses[:, joint, 1] = step * np.arange(frames)
    return poses


def test_steps_above_0_7_are_separate_poses(tmp_path: Path) -> None:
    for step, last, note in (
        (0.69, 4 / 30, "no rate in the format, 30 frames/s assumed"),
        (0.71, 4.0, "neighbours unlike, so taken for separate poses, 1 a second"),
    ):
        np.save(tmp_path / "a.npy", stepping(step))
        raw = load_npy(tmp_path / "a.npy")
        assert raw.times_s[-1] == pytest.approx(last)
        assert raw.notes[1:3] == (note, "hands: all zero, flat")


def test_the_median_step_by_hand() -> None:
    assert median_step_rad(stepping(0.4)) == pytest.approx(0.4)
    assert median_step_rad(stepping(0.4, joint=21)) == pytest.approx(0.4)
    assert median_step_rad(stepping(0.4, joint=22)) == 0.0  # not of the body
    assert median_step_rad(stepping(0.4, frames=2)) == pytest.approx(0.4)
    assert median_step_rad(stepping(0.4, frames=1)) == 0.0
    both = stepping(0.4) + stepping(0.3, joint=6)
    assert median_step_rad(both) == pytest.approx(0.4)  # the largest turn of a frame
    uneven = np.zeros((4, 55, 3))
    uneven[:, 3, 0] = 0.0, 0.1, 0.3, 1.3
    assert median_step_rad(uneven) == pytest.approx(0.2)
    uneven[1, 0, 0] = np.nan
    assert median_step_rad(uneven) == pytest.approx((0.3 + 1.0) / 2)
    uneven[1, 0, 0] = 100.0
    assert median_step_rad(uneven) == pytest.approx((0.3 + 1.0) / 2)
    late = np.concatenate([stepping(0.1, frames=512), stepping(1.0, frames=1500)])
    assert median_step_rad(late) == pytest.approx(0.1)


# --- which reader ---


def test_the_ending_says_which_reader(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((2, 165)))
    (tmp_path / "a.npy").rename(tmp_path / "A.NPY")
    assert load_motion(AvatarSpec(motion="A.NPY"), tmp_path).notes[0] == "SMPL-X .npy, 2 frames"
    amass(tmp_path / "a.npz")
    assert load_motion(AvatarSpec(motion="a.npz"), tmp_path).notes[0].startswith("AMASS")
    names = "builtin:{walk-wave-turn, there-and-back, idle, t-pose}"
    for motion, sentence in (
        ("builtin:dance", f"motion: found 'builtin:dance', expected {names} or a file"),
        ("builtin:tpose", f"motion: found 'builtin:tpose', expected {names} or a file; did you mean 'builtin:t-pose'?"),
        (
            "a.fbx",
            f"{tmp_path}/a.fbx: found no such file, expected a motion file: .npy, .npz, .pkl, .pickle, .bvh",
        ),
        ("b.bvh", f"{tmp_path}/b.bvh: found no such file, expected a motion file"),
    ):
        with pytest.raises(BadInputError) as raised:
            load_motion(AvatarSpec(motion=motion), tmp_path)
        assert str(raised.value) == sentence


# --- recordings ---


def raw_motion(roots: list[list[float]] | None = None, **changes: Any) -> RawMotion:
    poses = np.zeros((len(roots) if roots else 3, 55, 3))
    poses[:, 0] = roots if roots else 0.0
    values = {"times_s": np.arange(len(poses)) + 2.0, "poses": poses, "translation": None, "betas": None, "up": "y"}
    return RawMotion(**{**values, "notes": ("from a file",), **changes})  # type: ignore[arg-type]


def test_a_recording_in_the_middle_of_its_ground() -> None:
    places = np.array([[1.0, 1.0, 3.0], [2.0, 1.5, 9.0], [5.0, 1.0, 4.0]])
    motion = motion_from_recording(raw_motion(translation=places, leg_m=0.8, betas=np.ones(3)), "here", "auto")
    assert motion.translation == pytest.approx(np.array([[-2, 1, -3], [-1, 1.5, 3], [2, 1, -2]]))
    assert motion.times_s.tolist() == [0, 1, 2]
    assert motion.notes == ("from a file", "Y up, as the body stands")
    assert (motion.leg_m, motion.wrap, motion.travels) == (0.8, Wrap.BOUNCE, True)
    assert motion.betas is not None and motion.betas.tolist() == [1, 1, 1]
    still = motion_from_recording(raw_motion(), "here", "auto")
    assert (still.travels, still.leg_m, still.translation.any()) == (False, None, False)


def test_a_recording_is_turned_to_face_the_viewer() -> None:
    """It faces +X and walks along +X at first: afterwards both are +Z, and later turns follow."""
    raw = raw_motion([[0, math.pi / 2, 0], [0, math.pi, 0]], translation=np.array([[0.0, 1, 0], [2.0, 1, 0]]))
    motion = motion_from_recording(raw, "here", "auto")
    assert motion.poses[:, 0] == pytest.approx(np.array([[0, 0, 0], [0, math.pi / 2, 0]]), abs=1e-12)
    assert motion.translation == pytest.approx(np.array([[0, 1, -1], [0, 1, 1]]), abs=1e-12)
    assert raw.poses[0, 0, 1] == math.pi / 2  # the file's content is left alone


def rolled(cosine: float, axis: str) -> list[float]:
    """Root whose up has this cosine with +Y (rolled about z) or with +Z (pitched about x)."""
    return [0, 0, math.acos(cosine)] if axis == "y" else [math.asin(cosine), 0, 0]


@pytest.mark.parametrize(
    ("root", "usual", "stated", "note"),
    [
        (rolled(0.71, "y"), "z", "auto", "Y up, as the body stands"),
        (rolled(0.69, "y"), "z", "auto", "Z up, as usual for the format"),
        (rolled(0.72, "z"), "y", "auto", "Z up, as the body stands"),
        (rolled(0.69, "z"), "y", "auto", "Y up, as the body stands"),  # the cosine with +Y is 0.72
        (rolled(-0.9, "y"), "y", "auto", "Y up, as usual for the format"),
        ([0, 0, 0], "y", "z", "Z up, as given"),
        ([math.pi / 2, 0, 0], "z", "y", "Y up, as given"),
    ],
)
def test_which_axis_is_up(root: list[float], usual: str, stated: str, note: str) -> None:
    assert note in motion_from_recording(raw_motion([root] * 2, up=usual), "here", stated).notes


@pytest.mark.parametrize(("axis", "root"), [
    ("y", [0, 0, 0]),
    ("z", [math.pi / 2, 0, 0]),
    ("x", [0, 0, -math.pi / 2]),
    ("-y", [math.pi, 0, 0]),
    ("-z", [-math.pi / 2, 0, 0]),
    ("-x", [0, 0, math.pi / 2]),
])  # fmt: skip
def test_a_body_in_coordinates_of_any_axes_stands_up(axis: str, root: list[float]) -> None:
    """It climbs by 2 along its own up, which is one of the six axes; afterwards it climbs along +Y."""
    up = np.zeros(3)
    up["xyz".index(axis[-1])] = -1.0 if axis[0] == "-" else 1.0
    raw = raw_motion([root] * 2, translation=np.array([up, 3 * up]), ups=recorded_module.ANY)
    motion = motion_from_recording(raw, "here", "auto")
    assert f"{axis.upper()} up, as the body stands" in motion.notes
    assert motion.translation == pytest.approx(np.array([[0, 1, 0], [0, 3, 0]]), abs=1e-12)
    turn = matrix_from_rotvec(motion.poses[:, 0])
    assert turn[:, :, 1] == pytest.approx(np.array([[0, 1, 0]] * 2), abs=1e-12)
    stated = motion_from_recording(raw, "here", axis)
    assert stated.translation == pytest.approx(motion.translation) and f"{axis.upper()} up, as given" in stated.notes


@pytest.mark.parametrize(("level", "turned"), [(0.31, True), (0.29, False)])
def test_one_who_lies_is_not_turned(level: float, turned: bool) -> None:
    """The body's ahead has a level part of 0.31 or 0.29, along +X."""
    root = turn_about("y", math.pi / 2) @ turn_about("x", -math.acos(level))
    angle = math.acos((np.trace(root) - 1) / 2)
    axis = np.array([root[2, 1] - root[1, 2], root[0, 2] - root[2, 0], root[1, 0] - root[0, 1]]) / (2 * math.sin(angle))
    raw = raw_motion([list(axis * angle)])
    motion = motion_from_recording(raw, "here", "y")
    expected = [-math.acos(level), 0, 0] if turned else list(axis * angle)
    assert motion.poses[0, 0] == pytest.approx(expected, abs=1e-9)


def test_recordings_within_and_beyond_their_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    for angle, fine in ((64.0, True), (-64.0, True), (64.1, False), (-64.1, False)):
        poses = np.zeros((2, 55, 3))
        poses[1, 9, 2] = angle
        if fine:
            motion_from_recording(raw_motion(poses=poses, times_s=np.arange(2.0)), "here", "auto")
            continue
        with pytest.raises(BadInputError) as raised:
            motion_from_recording(raw_motion(poses=poses, times_s=np.arange(2.0)), "here", "auto")
        assert str(raised.value) == (
            "here: found an angle of 64.1, expected axis-angle in radians; convert degrees to radians"
        )
    for place, kept in ((9_999.0, 3), (10_000.0, 2), (-10_000.0, 2), (np.inf, 2)):
        places = np.zeros((3, 3))
        places[1, 0] = place
        assert len(motion_from_recording(raw_motion(translation=places), "here", "auto").times_s) == kept
    monkeypatch.setattr(recorded_module, "MAX_FRAMES", 3)
    motion_from_recording(raw_motion(), "here", "auto")
    monkeypatch.setattr(recorded_module, "MAX_FRAMES", 2)
    with pytest.raises(BadInputError, match="here: found 3 frames, expected at most 2"):
        motion_from_recording(raw_motion(), "here", "auto")


def test_frames_that_are_left_out_leave_with_all_they_have() -> None:
    poses = np.zeros((4, 55, 3))
    poses[:, 7, 0] = 0.1, np.nan, 0.3, 0.4
    places = np.array([[0.0, 1, 0], [9, 9, 9], [2, 1, 0], [4, 1, 0]])
    motion = motion_from_recording(raw_motion(poses=poses, times_s=np.arange(4.0), translation=places), "here", "auto")
    assert motion.times_s.tolist() == [0, 2, 3]
    assert motion.poses[:, 7, 0] == pytest.approx([0.1, 0.3, 0.4])
    assert motion.translation[:, 0] == pytest.approx([-2, 0, 2])


# --- usable samples ---


def usable(times: list[float], bad: tuple[int, ...] = ()) -> tuple[list[int], tuple[str, ...]]:
    readable = np.array([k not in bad for k in range(len(times))])
    indices, notes = usable_samples("here", np.array(times), readable)
    return indices.tolist(), notes


def test_usable_samples_by_hand() -> None:
    assert usable([0, 1, 2, 3]) == ([0, 1, 2, 3], ())
    assert usable([0, 1, 2, 3, 4], bad=(2,)) == (
        [0, 1, 3, 4],
        (
            "1 samples not finite or no rotation (first: number 2), interpolated across",
            "1 gap, the longest 2000 ms, interpolated across",
        ),
    )
    assert usable([0, 1, 1, 0.5, 2, np.nan]) == (
        [0, 1, 4],
        (
            "1 samples not finite or no rotation (first: number 5), interpolated across",
            "2 samples with repeated or decreasing times left out",
        ),
    )


def test_a_gap_is_longer_than_one_and_a_half_steps() -> None:
    assert usable([0, 1, 2, 3.5])[1] == ()
    assert usable([0, 1, 2, 3.51])[1] == ("1 gap, the longest 1510 ms, interpolated across",)
    assert usable([0, 9])[1] == ()
    assert usable([0, 1, 9]) == ([0, 1, 2], ("1 gap, the longest 8000 ms, interpolated across",))


def test_half_of_the_samples_is_enough() -> None:
    assert usable([0, 1, 2, 3], bad=(0, 2))[0] == [1, 3]
    for times, bad, broken, late in (([0, 1, 2], (0, 1), 2, 0), ([3, 2, 1], (), 0, 2), ([0], (0,), 1, 0)):
        with pytest.raises(BadInputError) as raised:
            usable(times, bad)
        first = f" (first: number {bad[0]})" if bad else ""
        assert str(raised.value) == (
            f"here: found {broken} samples that are not finite or no rotation{first} and {late} times that do "
            f"not increase, of {len(times)}, expected at least half of the samples sound"
        )


# --- sampling ---


def test_times_beyond_the_end_by_hand() -> None:
    cases = ((0.0, 0.0, 0.0), (1.5, 1.5, 1.5), (2.5, 0.5, 1.5), (4.5, 0.5, 0.5), (-0.5, 1.5, 0.5), (3.0, 1.0, 1.0))
    for t_s, loops, bounces in cases:
        assert wrapped_time(t_s, 2.0, Wrap.LOOP) == loops
        assert wrapped_time(t_s, 2.0, Wrap.BOUNCE) == bounces
    assert (Wrap.LOOP.value, Wrap.BOUNCE.value) == ("loops", "plays back and forth")
    assert wrapped_time(0.7, 0.5, Wrap.BOUNCE) == pytest.approx(0.3)
    assert wrapped_time(3.0, -1.0, Wrap.LOOP) == 0.0


def test_neighbours_in_time_by_hand() -> None:
    times = np.array([0.0, 1.0, 3.0])
    for t_s, expected in ((0.0, (0, 1, 0.0)), (0.25, (0, 1, 0.25)), (1.0, (1, 2, 0.0)), (2.0, (1, 2, 0.5)),
                          (3.0, (1, 2, 1.0)), (9.0, (1, 2, 1.0)), (-9.0, (0, 1, 0.0))):  # fmt: skip
        assert bracket(times, t_s) == expected
    assert bracket(np.zeros(1), 5.0) == (0, 0, 0.0)


def test_a_sample_between_two_frames() -> None:
    poses = np.zeros((3, 55, 3))
    poses[:, 4, 2] = 0.0, 1.0, -2.0
    places = np.array([[0.0, 0, 0], [2, 4, 6], [4, 0, 0]])
    motion = Motion(np.array([0.0, 1.0, 2.0]), poses, places, None, (), Wrap.LOOP)
    assert (motion.leg_m, motion.travels, motion.duration_s) == (None, True, 2.0)
    times = np.array([0.25, 1.25, 3.25, -0.5])
    for t_s, angle, place in zip(
        times, (0.25, 0.25, 0.25, -0.5), ([0.5, 1, 1.5], [2.5, 3, 4.5], [2.5, 3, 4.5], [3, 2, 3]), strict=True
    ):
        pose, translation = motion.sample(t_s)
        assert pose[4] == pytest.approx([0, 0, angle])
        assert translation == pytest.approx(place)
        assert np.abs(pose).sum() == pytest.approx(abs(angle))
    all_poses, all_places = motion.sample_all(times)
    assert all_poses[:, 4, 2] == pytest.approx([0.25, 0.25, 0.25, -0.5])
    assert all_places == pytest.approx(np.array([[0.5, 1, 1.5], [2.5, 3, 4.5], [2.5, 3, 4.5], [3, 2, 3]]))
    assert JOINT_INDEX["left_knee"] == 4


#: Turns of the pelvis in a world with Y up: on the back, on the belly, head down; and who stands with -Y, Z or -Z up.
ON_BACK, ON_BELLY, HEAD_DOWN = [-np.pi / 2, 0, 0], [np.pi / 2, 0, 0], [np.pi, 0, 0]
FRAMES = 20


def raw(root: list[float], pelvis: list[float], **changes: object) -> RawMotion:
    """A stiff body that sways by 3 cm along all axes."""
    poses = np.zeros((FRAMES, 55, 3))
    poses[:, 0] = root
    sway = 0.03 * np.sin(np.linspace(0, 6, FRAMES))[:, None]
    values = {"times_s": np.arange(FRAMES) / 30, "poses": poses, "translation": np.array(pelvis) + sway, "betas": None}
    return RawMotion(**{**values, "up": "y", "notes": (), "ups": UPS, **changes})  # type: ignore[arg-type]


def notes(motion: RawMotion) -> tuple[str, ...]:
    return motion_from_recording(motion, "here", "auto").notes


@pytest.mark.parametrize(
    ("root", "height", "other"), [(ON_BACK, 0.12, "-Z"), (ON_BELLY, 0.2, "Z"), (HEAD_DOWN, 0.72, "-Y")]
)
@pytest.mark.parametrize("away", [0.0, 1.7])
def test_one_who_lies_or_is_upside_down_stays_so(root: list[float], height: float, other: str, away: float) -> None:
    """Toes of one on the belly are 0.146 m below the pelvis."""
    motion = motion_from_recording(raw(root, [away, height, away]), "here", "auto")
    said = f"Y up, as the body lies, or is upside down, on the file's floor: `up_axis` {other} if it stands there"
    assert said in motion.notes
    up = matrix_from_rotvec(motion.poses[:, 0])[:, 1, 1]
    assert up == pytest.approx(np.full(FRAMES, np.cos(root[0])), abs=1e-12)
    assert motion.translation[:, 1].mean() == pytest.approx(height, abs=0.03)


@pytest.mark.parametrize(
    ("root", "pelvis", "axis"),
    [(ON_BACK, [1, 0.1, -0.95], "-Z"), (ON_BELLY, [1, 0.1, 0.95], "Z"), (HEAD_DOWN, [1, -0.95, 3], "-Y")],
)
def test_one_who_stands_on_the_floor_of_another_axis_stands(root: list[float], pelvis: list[float], axis: str) -> None:
    """Also where the places along Y would do for one who lies."""
    assert notes(raw(root, pelvis)) == (f"{axis} up, as the body stands",)


def test_without_a_floor_the_other_axis_is_named() -> None:
    said = ("Z up, as the body stands", "up: one who lies, or is upside down, throughout needs `up_axis` Y")
    assert notes(raw(ON_BELLY, [0, 0, 0])) == said
    assert notes(raw(ON_BELLY, [0, 0.45, 0])) == said  # a floor is not 0.3 m below the toes of one who lies
    assert notes(raw(ON_BELLY, [0, 0, 0], ups=ANY)) == said[:1]  # coordinates of a camera have no floor
    assert notes(raw(ON_BELLY, [0, 0, 0], translation=None)) == said[:1]


def test_who_goes_up_and_down_does_not_lie() -> None:
    """By 0.12 m between a tenth and nine tenths of the frames."""
    places = np.outer(np.linspace(0.13, 0.29, FRAMES), [0, 1, 0])
    assert "Z up, as the body stands" in notes(raw(ON_BELLY, [0, 0, 0], translation=places))


def test_one_who_lies_in_a_z_up_world_stays_so() -> None:
    lying = raw([0, 0, 0], [0, 1.5, 0.15], up="z", ups=WORLD)
    assert notes(lying)[0].startswith("Z up, as the body lies")
    assert notes(raw([0, 0, 0], [0, 0.95, 0.15], up="z", ups=WORLD)) == ("Y up, as the body stands",)


def test_the_lowest_joint_is_that_of_a_body_with_such_legs() -> None:
    """Legs of a plain body are 0.8681 m; half as long ones bring its toes to half of 0.908 m below the pelvis."""
    poses, places = np.zeros((300, 55, 3)), np.tile([0.0, 1.0, 0.0], (300, 1))
    up = np.array([0.0, 1.0, 0.0])
    assert lowest(poses, places, None, up) == pytest.approx(np.full(200, 0.092))
    thigh, shin = np.hypot(np.hypot(14, 408), 34), np.hypot(443, 25)
    assert lowest(poses[:3], places[:3], (thigh + shin) / 2000, up) == pytest.approx(np.full(3, 1 - 0.454))
