"""What a scene says of playing a motion: a part of it, faster or slower, and what follows."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane.errors import BadInputError
from trilane.scene.motion.files import as_played, load_motion
from trilane.scene.motion.motion import Motion, Wrap, wrapped_time
from trilane.scene.schema import AvatarSpec, scene_from


def walk() -> Motion:
    """Five frames a second apart; at t the body is at x = t, turned by t / 10 rad about Y, its elbow bent by t / 4."""
    times = np.arange(5.0)
    poses = np.zeros((5, 55, 3))
    poses[:, 0, 1], poses[:, 18, 0] = times / 10, times / 4
    places = np.stack([times, np.ones(5), np.zeros(5)], axis=1)
    return Motion(times, poses, places, None, ("a walk",), Wrap.BOUNCE)


def played(**keys: Any) -> Motion:
    return as_played(walk(), AvatarSpec(**keys), "here")


def test_nothing_said_changes_nothing() -> None:
    motion = played()
    assert motion.times_s.tolist() == [0, 1, 2, 3, 4] and motion.wrap is Wrap.BOUNCE
    assert motion.translation == pytest.approx(walk().translation)
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


def test_frames_at_the_ends_of_a_part_are_taken_once() -> None:
    motion = played(start_s=1, end_s=3)
    assert motion.times_s.tolist() == [0, 1, 2]
    assert motion.poses[:, 18, 0] == pytest.approx([0.25, 0.5, 0.75])


def test_the_end_of_a_loop_is_its_last_frame() -> None:
    looping = as_played(walk(), AvatarSpec(loop="repeat", end_s=4.0), "here")
    assert looping.poses[-1, 18, 0] == pytest.approx(1.0)


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


def test_a_held_motion_stays_at_its_ends() -> None:
    assert [wrapped_time(t_s, 4.0, Wrap.HOLD) for t_s in (-1.0, 0.0, 3.0, 4.0, 1e6)] == [0, 0, 3, 4, 4]


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
