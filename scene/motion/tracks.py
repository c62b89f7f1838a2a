"""Places, turns and end sites of named joints over time: what is retargeted, whatever file it comes from.

Rule: names are those of the SMPL-X joints; units and axes are the file's own, the same in all arrays.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from trilane.arrays import F64
from trilane.body.joints import JOINT_NAMES

SIDES = ("left", "right")


@dataclass(frozen=True)
class Tracks:
    """Joints over T frames.

    `places`: name -> (T, 3). `turns`: name -> global turn (T, 3, 3), where the file has one. `tips`: name -> place
    (T, 3) of what its bone ends at, a joint of any name or an end site.
    """

    places: Mapping[str, F64]
    turns: Mapping[str, F64] = field(default_factory=dict)
    tips: Mapping[str, F64] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """How many frames there are."""
        return len(self.places["left_hip"])

    def has(self, *names: str) -> bool:
        """Whether all of these joints have places."""
        return all(name in self.places for name in names)

    def between(self, part: str) -> F64:
        """Middle (T, 3) of the left and the right joint of a pair, such as `hip`."""
        return (self.places[f"left_{part}"] + self.places[f"right_{part}"]) / 2

    def across(self, part: str) -> F64:
        """From the right joint of a pair to the left one, (T, 3)."""
        return self.places[f"left_{part}"] - self.places[f"right_{part}"]

    def bone(self, start: str, end: str) -> F64:
        """From one joint to another, (T, 3)."""
        return self.places[end] - self.places[start]


def at_rest(joints: F64) -> Tracks:
    """One frame of Tracks: the rest joints (55, 3) of an avatar."""
    return Tracks({name: joints[None, index] for index, name in enumerate(JOINT_NAMES[: len(joints)])})


def unit(vectors: F64) -> F64:
    """Vectors (..., 3) at unit length; a zero vector stays zero."""
    length = np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True))
    return np.asarray(vectors / np.where(length > 0, length, 1.0))


def angle_between(a: F64, b: F64) -> F64:
    """Angles (...) between vectors (..., 3), radians; exact near 0 and pi."""
    cross = np.cross(a, b)
    return np.asarray(np.arctan2(np.sqrt((cross * cross).sum(axis=-1)), (a * b).sum(axis=-1)))
