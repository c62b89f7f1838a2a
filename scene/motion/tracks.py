"""Places, turns and end sites of named joints over time: the input of retargeting, from any file.

Names are those of the SMPL-X joints; units and axes are the file's own, the same in all arrays. Places alone tell which
frames stand, and whether a skeleton is built like the avatar's: the file's zero pose does not matter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINT_NAMES

SIDES = ("left", "right")


@dataclass(frozen=True)
class Tracks:
    """Joints over T frames.

    `places`: place (T, 3) of each joint. `turns`: global turn (T, 3, 3) of each joint, where the file has one. `tips`:
    place (T, 3) where a joint's bone ends, at a joint of any name or an end site.
    """

    places: Mapping[str, F64]
    turns: Mapping[str, F64] = field(default_factory=dict)
    tips: Mapping[str, F64] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.places["left_hip"])

    def has(self, *names: str) -> bool:
        """Return whether all of these joints have places."""
        return all(name in self.places for name in names)

    def between(self, part: str) -> F64:
        """Return the middle (T, 3) of the left and the right joint of a pair, such as `hip`."""
        return (self.places[f"left_{part}"] + self.places[f"right_{part}"]) / 2

    def across(self, part: str) -> F64:
        """Return the way (T, 3) from the right joint of a pair to the left one."""
        return self.places[f"left_{part}"] - self.places[f"right_{part}"]

    def bone(self, start: str, end: str) -> F64:
        """Return the way (T, 3) from one joint to another."""
        return self.places[end] - self.places[start]


def at_rest(joints: F64) -> Tracks:
    """Return one frame of Tracks: the rest joints (55, 3) of an avatar."""
    return Tracks({name: joints[None, index] for index, name in enumerate(JOINT_NAMES[: len(joints)])})


def unit(vectors: F64) -> F64:
    """Scale vectors (..., 3) to unit length; a zero vector stays zero."""
    length = np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True))
    return np.asarray(vectors / np.where(length > 0, length, 1.0))


def angle_between(a: F64, b: F64) -> F64:
    """Return angles (...) between vectors (..., 3), radians; exact near 0 and pi."""
    cross = np.cross(a, b)
    return np.asarray(np.arctan2(np.sqrt((cross * cross).sum(axis=-1)), (a * b).sum(axis=-1)))


#: Largest angle between the thighs and the trunk's line, and largest bend of the knees, of a person who stands;
#: radians.
STRAIGHT_HIP, STANDING_KNEE = np.radians(25.0), np.radians(50.0)
#: Bend of the knees below which a standing frame counts as straight, and how much more than the best one's it may be.
STRAIGHT_KNEE, LITTLE_MORE = np.radians(10.0), np.radians(5.0)
#: Largest lean of a leg that is below its hip, radians; share of such frames in which the foot is flat on the floor.
LEG_BELOW, PLANTED_SHARE = np.radians(35.0), 0.25
#: Cosine of the angle within which the direction that a body stands in counts as the axis beside it.
NEAR_AXIS = np.cos(np.radians(30.0))
#: Pairs of joints of one bone or one part: some of their distances are the same in two skeletons that are built alike.
RIGID = (
    ("left_hip", "right_hip"),
    ("pelvis", "left_hip"),
    ("pelvis", "spine1"),
    ("left_hip", "spine1"),
    ("spine1", "spine2"),
    ("spine2", "spine3"),
    ("spine3", "neck"),
    ("spine3", "left_collar"),
    ("neck", "left_collar"),
    ("left_collar", "right_collar"),
    ("left_collar", "left_shoulder"),
    ("left_ankle", "left_foot"),
)
#: Largest difference of such distances, as a share of them and of the legs.
SAME_SHARE, SAME_LEGS = 0.02, 0.003


def standing_frames(tracks: Tracks, trunk: F64) -> NDArray[np.bool_]:
    """Return which frames (T,) stand straightest: thighs in line with the trunk (T, 3), and straight knees."""
    bend = np.zeros(tracks.frames)
    stands = np.ones(tracks.frames, dtype=bool)
    for side in SIDES:
        thigh, shin = tracks.bone(f"{side}_hip", f"{side}_knee"), tracks.bone(f"{side}_knee", f"{side}_ankle")
        bend = np.maximum(bend, angle_between(thigh, shin))
        stands &= angle_between(thigh, -trunk) < STRAIGHT_HIP
    stands &= bend < STANDING_KNEE
    if not stands.any():
        return stands
    return np.asarray(stands & (bend < max(STRAIGHT_KNEE, bend[stands].min() + LITTLE_MORE)))


def upward(tracks: Tracks, trunk: F64, stands: NDArray[np.bool_]) -> F64:
    """Return up (3,) in the recording: the file's axis nearest to the mean direction of trunk and legs.

    The mean is over the frames that stand, or over all when none does. It is up itself where no axis is near.
    """
    legs = tracks.between("hip") - tracks.between("ankle")
    both = unit(trunk) + unit(legs)
    mean = unit(both[stands].mean(axis=0) if stands.any() else both.mean(axis=0))
    nearest = np.eye(3)[np.abs(mean).argmax()] * np.sign(mean[np.abs(mean).argmax()])
    return np.asarray(nearest if nearest @ mean > NEAR_AXIS else mean)


def planted_frames(tracks: Tracks, side: str, foot: F64, up: F64) -> NDArray[np.bool_]:
    """Return the frames (T,) in which a foot most likely lies flat: it hardly moves, and the leg is below the hip.

    `foot` (T, 3): way from the ankle to the toes. `up` (3,): direction that is up in the recording.
    """
    below = angle_between(tracks.bone(f"{side}_ankle", f"{side}_hip"), up) < LEG_BELOW
    if tracks.frames == 1 or not below.any():
        return np.asarray(below)
    ankle = tracks.places[f"{side}_ankle"]
    speed = sum(np.linalg.norm(np.gradient(place, axis=0), axis=-1) for place in (ankle, ankle + foot))
    return np.asarray(below & (speed <= np.quantile(np.asarray(speed)[below], PLANTED_SHARE)))


def leg_length(tracks: Tracks) -> float:
    """Return the mean length of both legs, hip to knee to ankle: the median over all frames."""
    bones = [
        np.linalg.norm(tracks.bone(f"{side}_{start}", f"{side}_{end}"), axis=-1)
        for side in SIDES
        for start, end in (("hip", "knee"), ("knee", "ankle"))
    ]
    return float(np.median(sum(bones)) / 2)


def built_alike(tracks: Tracks, rest: Tracks) -> bool:
    """Return whether `tracks` and `rest` have the same distances between joints, relative to their legs."""
    scale = leg_length(tracks) / leg_length(rest)
    pairs = [pair for pair in RIGID if tracks.has(*pair)]
    for pair in pairs:
        ours = float(np.linalg.norm(rest.bone(*pair)[0])) * scale
        theirs = float(np.median(np.linalg.norm(tracks.bone(*pair), axis=-1)))
        if abs(ours - theirs) > SAME_SHARE * ours + SAME_LEGS * leg_length(tracks):
            return False
    return ("spine1", "spine2") in pairs or ("spine3", "neck") in pairs
