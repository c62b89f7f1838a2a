"""Reads what ROMP saves: a dict for each frame, or for one picture, with a row for each person in it.

Rule: with `track_ids` the person who is in the most frames is read, else the first of each frame; a note says which.
The number in a frame's name is its time. Coordinates are the camera's, y down
(https://github.com/Arthur151/ROMP, `simple_romp`).
"""

from __future__ import annotations

import re
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.files import as_numbers
from trilane.scene.motion.motion import SMPL_REST_PELVIS
from trilane.scene.motion.recorded import ANY, RawMotion
from trilane.scene.motion.smpl_turns import WHOLE, Turns, turns_in
from trilane.scene.motion.smplx_npy import hands_note
from trilane.scene.motion.stored import Found
from trilane.scene.recordings import Detected

POSES, PLACES, PERSONS = "smpl_thetas", "cam_trans", "track_ids"
RATE_HZ = 30.0
_NUMBER = re.compile(r"(\d+)(?:\.[A-Za-z]+)?$")


def motion_of_frames(found: list[Found], source: str) -> RawMotion:
    """The motion of one person over the frames `found`, each of which has POSES.

    `source`: ending of the file, for people. Raises BadInputError when the arrays of a frame are none, or do not fit.
    """
    rows, who = _rows(found)
    numbers, how = _frame_numbers(found)
    order = [int(place) for place in np.argsort(numbers, kind="stable") if rows[place] >= 0]
    turns = [_turns(found[place], rows[place]) for place in order]
    places = [_place(found[place], rows[place]) for place in order]
    known = [place for place in places if place is not None]
    poses = np.concatenate([each.turns for each in turns])
    notes = (
        f"ROMP {source} ({turns[0].whose}, {turns[0].columns} columns), {len(order)} frames, {how}, "
        f"no rate in the file, {RATE_HZ:g} frames/s assumed",
        f"hands: {hands_note(poses)}",
        who,
        *(() if len(known) == len(places) else (f"no `{PLACES}` in some frames: stays in place",)),
        *dict.fromkeys(note for each in turns for note in each.notes),
    )
    return RawMotion(
        np.array([numbers[place] for place in order]) / RATE_HZ,
        poses,
        SMPL_REST_PELVIS + np.stack(known) if len(known) == len(places) else None,
        None,
        "-y",
        notes,
        detected=Detected(
            f"ROMP {source}", f"`{POSES}` in {len(found)} frames", unit="m", rate=f"{how}, {RATE_HZ:g}/s"
        ),
        ups=ANY,
    )


def _frame_numbers(found: list[Found]) -> tuple[NDArray[np.int64], str]:
    """The number of each frame, by its name where all names end in numbers and no two in the same one."""
    matches = [_NUMBER.search(frame.name) for frame in found]
    named = [int(match[1][-9:]) for match in matches if match is not None]
    if len(named) == len(found) == len(set(named)):
        return np.array(named), "numbered by their names"
    return np.arange(len(found)), "in the file's order"


def _rows(found: list[Found]) -> tuple[list[int], str]:
    """The row of the person in each frame, -1 where there is none; and a note on who it is."""
    counts = [len(_array(frame, POSES)) for frame in found]
    if all(frame.has(PERSONS) for frame in found):
        persons = [
            as_numbers(f"{frame.where}[{PERSONS}]", _array(frame, PERSONS), "numbers").ravel() for frame in found
        ]
        tracks = [[int(each) for each in ids[:count]] for ids, count in zip(persons, counts, strict=True)]
        times = Counter(track for each in tracks for track in set(each))
        if times:
            person, most = times.most_common(1)[0]
            rows = [each.index(person) if person in each else -1 for each in tracks]
            return rows, f"track {person} is read, in {most} frames, of {len(times)} in the file"
    if not any(counts):
        raise BadInputError(found[0].where, "nobody in any frame", f"rows of `{POSES}`")
    several = (
        f"; up to {max(counts)} persons in a frame and no `{PERSONS}`, so they may change" if max(counts) > 1 else ""
    )
    return [0 if count else -1 for count in counts], f"the first person of each frame is read{several}"


def _turns(frame: Found, row: int) -> Turns:
    return turns_in(f"{frame.where}[{POSES}]", _array(frame, POSES)[row : row + 1], WHOLE)


def _place(frame: Found, row: int) -> F64 | None:
    """Where the body is (3,) before the camera, metres."""
    if not frame.has(PLACES):
        return None
    places = _array(frame, PLACES)
    if places.shape != (len(_array(frame, POSES)), 3):
        raise BadInputError(f"{frame.where}[{PLACES}]", f"shape {places.shape}", f"a row of 3 for each of `{POSES}`")
    return as_numbers(f"{frame.where}[{PLACES}]", places[row], "numbers")


def _array(frame: Found, key: str) -> NDArray[np.generic]:
    array = frame.array(key)
    if not array.ndim:
        raise BadInputError(f"{frame.where}[{key}]", "one number", "a row for each person")
    return array
