"""Axis-angle turns of the SMPL family on the body's 55 joints, by the number of columns of an array.

Rule: columns that are no joint of the body, SMPL's two hands, are left out, and a note says so if they turn.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX, JOINTS
from trilane.errors import BadInputError
from trilane.files import as_numbers

#: In place of a joint, for turns of SMPL's two hands.
NO_JOINT = -1
#: Number of columns -> the joints, in their order, and whose they are.
Widths = Mapping[int, tuple[tuple[int, ...], str]]
BODY = tuple(range(22))
SMPL_HANDS = (NO_JOINT, NO_JOINT)
FINGERS = tuple(range(25, JOINTS))
#: Whole poses, from the pelvis on.
WHOLE: Widths = {
    66: (BODY, "SMPL body"),
    72: ((*BODY, *SMPL_HANDS), "SMPL"),
    156: ((*BODY, *FINGERS), "SMPL-H"),
    165: (tuple(range(JOINTS)), "SMPL-X"),
}
#: Parts of poses that have arrays of their own.
PELVIS: Widths = {3: ((0,), "")}
BELOW_PELVIS: Widths = {63: (BODY[1:], "SMPL-X body"), 69: ((*BODY[1:], *SMPL_HANDS), "SMPL")}
BOTH_HANDS: Widths = {90: (FINGERS, "")}


def from_joint(joint: str, count: int) -> Widths:
    """`count` joints from `joint` on."""
    first = JOINT_INDEX[joint]
    return {3 * count: (tuple(range(first, first + count)), "")}


@dataclass(frozen=True)
class Turns:
    """`turns` (T, 55, 3): axis-angle. `columns`: of the array; `whose`: they are. `notes`: for people."""

    turns: F64
    columns: int
    whose: str
    notes: tuple[str, ...] = ()


def turns_in(where: str, array: NDArray[Any], widths: Widths) -> Turns:
    """The turns of an `array` (T, W) or (T, W / 3, 3), whose W is one of `widths`; other joints are at rest.

    `where`: the array, for messages. Raises BadInputError for any other shape, and for anything but numbers.
    """
    flat = array.reshape(len(array), -1) if array.ndim == 3 and array.shape[2] == 3 and len(array) else array
    if flat.ndim != 2 or flat.shape[1] not in widths or not len(flat):
        raise BadInputError(where, f"shape {array.shape}", f"{shapes(widths)}, T at least 1, axis-angle")
    joints, whose = widths[flat.shape[1]]
    numbers = as_numbers(where, flat, "numbers").reshape(len(flat), -1, 3)
    turns = np.zeros((len(flat), JOINTS, 3))
    known = [place for place, joint in enumerate(joints) if joint != NO_JOINT]
    turns[:, [joints[place] for place in known]] = numbers[:, known]
    left_out = np.delete(numbers, known, axis=1)
    notes = ("turns of SMPL's two hand joints left out: the body has none such",) if left_out.any() else ()
    return Turns(turns, flat.shape[1], whose, notes)


def shapes(widths: Widths) -> str:
    """`(T, 66), (T, 72) or (T, 156)`."""
    *others, last = [f"(T, {width})" for width in widths]
    return f"{', '.join(others)} or {last}" if others else last
