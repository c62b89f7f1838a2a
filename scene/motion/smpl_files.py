"""Motions of the SMPL family from arrays in any file: AMASS, AIST++, GLAMR, smplx, ROMP, or one array.

An `ArrayLayout`, which is data, states how a program names its arrays. Joints that a layout does not have are at rest;
other keys are ignored. If a file has several persons, only the person with the most frames is read, and a note says so.

An array alone has no frame rate. If neighbouring frames are similar, 30 frames a second are assumed. If they differ by
more than POSE_SET_STEP_RAD, they are separate poses, one a second. ROMP saves a dict for each frame, with a row for
each person in it. The number in a frame's name is its time. Coordinates are relative to the camera, with Y down.

Sources: AMASS (https://amass.is.tue.mpg.de); `smplx` (https://github.com/vchoutas/smplx, arguments of `forward`);
AIST++ (https://github.com/google/aistplusplus_api: 60 frames a second, Y up, `smpl_trans` in units in which the body is
`smpl_scaling` times as large); GLAMR (https://github.com/NVlabs/GLAMR: `root_trans_world` is the pelvis's position, Z
up); ROMP (https://github.com/Arthur151/ROMP, `simple_romp`).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX, JOINTS
from trilane.errors import BadInputError
from trilane.files import ARRAYS, RATE_KEYS, as_numbers
from trilane.scene.motion.motion import ANY, REST_PELVIS, SMPL_REST_PELVIS, WORLD, RawMotion
from trilane.scene.motion.pickled import printable
from trilane.scene.motion.stored import FoundTable, contents, tables_in
from trilane.scene.recordings import Detected
from trilane.scene.rotations import matrix_from_rotvec, rotvec_from_matrix

#: Index for SMPL's two hand joints, which the SMPL-X body does not have.
NO_JOINT = -1
#: For each number of columns: indices of the joints in their order, and name of the layout that has them.
Widths = Mapping[int, tuple[tuple[int, ...], str]]
BODY = tuple(range(22))
SMPL_HANDS = (NO_JOINT, NO_JOINT)
FINGERS = tuple(range(25, JOINTS))
#: Numbers of columns of whole poses, pelvis first.
WHOLE: Widths = {
    66: (BODY, "SMPL body"),
    72: ((*BODY, *SMPL_HANDS), "SMPL"),
    156: ((*BODY, *FINGERS), "SMPL-H"),
    165: (tuple(range(JOINTS)), "SMPL-X"),
}
#: Numbers of columns of parts of poses, which have arrays of their own.
PELVIS: Widths = {3: ((0,), "")}
BELOW_PELVIS: Widths = {63: (BODY[1:], "SMPL-X body"), 69: ((*BODY[1:], *SMPL_HANDS), "SMPL")}
BOTH_HANDS: Widths = {90: (FINGERS, "")}


def from_joint(joint: str, count: int) -> Widths:
    """Return the allowed width of an array that has `count` joints in SMPL-X order, beginning with `joint`."""
    first = JOINT_INDEX[joint]
    return {3 * count: (tuple(range(first, first + count)), "")}


@dataclass(frozen=True)
class JointTurns:
    """The rotations in an array.

    `turns` (T, 55, 3): axis-angle.
    `columns`: number of columns of the array.
    `whose`: name of the layout, "" for a part of a pose.
    `notes`: notes for people.
    """

    turns: F64
    columns: int
    whose: str
    notes: tuple[str, ...] = ()


def turns_in(where: str, array: NDArray[Any], widths: Widths) -> JointTurns:
    """Return the rotations in `array`, (T, W) or (T, W / 3, 3); joints that it does not have are at rest.

    `where`: name of the array, for messages.
    `widths`: allowed numbers of columns W.
    Raises BadInputError for any other shape, and for anything but numbers.
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
    return JointTurns(turns, flat.shape[1], whose, notes)


def shapes(widths: Widths) -> str:
    """Return the allowed shapes of `widths` as text, such as `(T, 66), (T, 72) or (T, 156)`."""
    *others, last = [f"(T, {width})" for width in widths]
    return f"{', '.join(others)} or {last}" if others else last


@dataclass(frozen=True)
class PoseArray:
    """An array of axis-angle rotations in a layout.

    `key`: name of the array. `widths`: allowed numbers of columns. `needed`: whether the layout requires the array.
    """

    key: str
    widths: Widths
    needed: bool = True


@dataclass(frozen=True)
class ArrayLayout:
    """The names that a program gives to its arrays. A key is "" if the program has no such array.

    `name`: name of the layout, for people.
    `arrays`: arrays of rotations.
    `place`: key of positions of the pelvis; with `rest_pelvis`, key of translations of the body.
    `betas`: key of the shape coefficients.
    `rate_hz`: rate if a file has no key of RATE_KEYS, for the reason `rate_why`; None if a file must have such a key.
    `up`, `ups`: as in RawMotion.
    `rest_pelvis` (3,): position of the pelvis at rest, metres, to which translations are added.
    `scale`: key of a number by which positions are divided.
    `mask`: key of an array that says which frames were measured.
    """

    name: str
    arrays: tuple[PoseArray, ...]
    place: str
    betas: str
    rate_hz: float | None
    rate_why: str
    up: str
    rest_pelvis: F64 | None = None
    ups: tuple[str, ...] = WORLD
    scale: str = ""
    mask: str = ""

    @property
    def needs(self) -> tuple[str, ...]:
        """Keys that a dict must have to have this layout."""
        return tuple(array.key for array in self.arrays if array.needed)

    @property
    def keys(self) -> tuple[str, ...]:
        """All keys of a file that are read in this layout."""
        own = (self.place, self.betas, self.scale, self.mask, *RATE_KEYS)
        return (*(array.key for array in self.arrays), *(key for key in own if key))


_VIDEO = "no rate in the file, 30 frames/s assumed"

#: A dict has the first layout whose needed keys it has.
LAYOUTS = (
    ArrayLayout(
        "AMASS", (PoseArray("poses", WHOLE),), "trans", "betas", None, "", "z", REST_PELVIS,
    ),
    ArrayLayout(
        "AIST++", (PoseArray("smpl_poses", WHOLE),), "smpl_trans", "", 60.0,
        "60 frames/s, as AIST++ has them", "y", SMPL_REST_PELVIS, scale="smpl_scaling",
    ),
    ArrayLayout(
        "GLAMR", (PoseArray("smpl_orient_world", PELVIS), PoseArray("smpl_pose", BELOW_PELVIS)), "root_trans_world",
        "smpl_beta", 30.0, _VIDEO, "z", mask="exist_frames",
    ),
    ArrayLayout(
        "AMASS in parts",
        (
            PoseArray("root_orient", PELVIS), PoseArray("pose_body", BELOW_PELVIS),
            PoseArray("pose_hand", BOTH_HANDS, False),
            PoseArray("pose_jaw", from_joint("jaw", 1), False), PoseArray("pose_eye", from_joint("left_eye", 2), False),
        ),
        "trans", "betas", None, "", "z", REST_PELVIS,
    ),
    ArrayLayout(
        "smplx",
        (
            PoseArray("global_orient", PELVIS), PoseArray("body_pose", BELOW_PELVIS),
            PoseArray("jaw_pose", from_joint("jaw", 1), False),
            PoseArray("leye_pose", from_joint("left_eye", 1), False),
            PoseArray("reye_pose", from_joint("right_eye", 1), False),
            PoseArray("left_hand_pose", from_joint("left_index1", 15), False),
            PoseArray("right_hand_pose", from_joint("right_index1", 15), False),
        ),
        "transl", "betas", 30.0, _VIDEO, "y", REST_PELVIS, ANY,
    ),
)  # fmt: skip
KEYS = tuple(dict.fromkeys(key for layout in LAYOUTS for key in layout.keys))
EXPECTED = "; or ".join(f"{' and '.join(f'`{key}`' for key in layout.needs)} ({layout.name})" for layout in LAYOUTS)


ASSUMED_RATE_HZ = 30.0
POSE_SET_STEP_RAD = 0.7
_AS_VECTORS = "turn them into axis-angle vectors, such as with scipy.spatial.transform.Rotation.as_rotvec"
#: How to convert an array of another kind, by the shape of one frame.
OTHERS: dict[tuple[int, ...], str] = {
    (263,): "these are HumanML3D's features: make places of joints of them with its recover_from_ric and save those",
    (322,): "these are rows of Motion-X: its columns 0 to 155 are `poses`, 309 to 311 `trans` of an .npz",
    (17,): "these are LLFF's poses_bounds of a camera: export transforms.json or COLMAP's model",
    (251,): "these are the features of KIT-ML: use HumanML3D's places of 22 joints",
    (135,): f"these look like turns of six numbers: {_AS_VECTORS}",
    **{(count, 6): f"these are turns of six numbers: {_AS_VECTORS}" for count in (22, 24, 52, 55)},
    **{(count, 4): f"these are quaternions: {_AS_VECTORS}" for count in (22, 24, 52, 55)},
    **{(count, 3, 3): f"these are matrices: {_AS_VECTORS}" for count in (22, 24, 52, 55)},
}


def motion_of_array(where: str, source: str, array: NDArray[Any]) -> RawMotion:
    """Return the motion of `array`, (T, W) or (T, W / 3, 3), where W is a key of WHOLE.

    `where`: path of the file. `source`: suffix of the file, for people. Raises BadInputError for any other array.
    """
    if array.shape[1:] in OTHERS:
        raise BadInputError(where, f"shape {array.shape}", f"{shapes(WHOLE)}, axis-angle", OTHERS[array.shape[1:]])
    read = turns_in(where, array, WHOLE)
    separate = median_step_rad(read.turns) > POSE_SET_STEP_RAD
    rate = 1.0 if separate else ASSUMED_RATE_HZ
    rate_note = (
        "neighbours unlike, so taken for separate poses, 1 a second"
        if separate
        else f"no rate in the format, {ASSUMED_RATE_HZ:g} frames/s assumed"
    )
    notes = (
        f"{read.whose} {source}, {len(array)} frames",
        rate_note,
        f"hands: {hands_note(read.turns)}",
        "betas: none in the format",
        *read.notes,
    )
    detected = Detected(f"{read.whose} poses ({source})", f"an array of shape {array.shape}", rate=rate_note)
    times = np.arange(len(array)) / rate
    return RawMotion(times, read.turns, None, None, "y", notes, detected=detected, ups=ANY)


def median_step_rad(poses: NDArray[np.float64]) -> float:
    """Return the median, over frames, of the largest rotation of any body joint since the frame before, radians.

    `poses` (T, 55, 3): axis-angle; at most the first 512 readable frames count. The result is 0 for one frame.
    """
    readable = poses[np.isfinite(poses).all(axis=(1, 2)) & (np.abs(poses) < 100).all(axis=(1, 2))]
    if len(readable) < 2:
        return 0.0
    turn = matrix_from_rotvec(readable[:512, :22])
    step = rotvec_from_matrix(np.swapaxes(turn[:-1], -1, -2) @ turn[1:])
    return float(np.median(np.linalg.norm(step, axis=-1).max(axis=1)))


def hands_note(poses: NDArray[np.float64]) -> str:
    """Return a note that says whether the fingers are posed in `poses` (T, 55, 3), axis-angle."""
    return "posed (flat-hand zero)" if np.nan_to_num(poses[:, 25:]).any() else "all zero, flat"


ROMP_POSES, ROMP_PLACES, ROMP_PERSONS = "smpl_thetas", "cam_trans", "track_ids"
ROMP_RATE_HZ = 30.0
LARGEST_TRACK = 1e9
_NUMBER = re.compile(r"(\d+)(?:\.[A-Za-z]+)?$")


def motion_of_frames(found: list[FoundTable], source: str) -> RawMotion:
    """Return the motion of one person over the frames `found`, dicts of ROMP that all have ROMP_POSES.

    `source`: suffix of the file, for people. Raises BadInputError when an array of a frame is unusable.
    """
    rows, who = _rows_of_person(found)
    numbers, how = _frame_numbers(found)
    order = [int(place) for place in np.argsort(numbers, kind="stable") if rows[place] >= 0]
    turns = [
        turns_in(f"{frame.where}[{ROMP_POSES}]", _rows_in(frame, ROMP_POSES)[row : row + 1], WHOLE)
        for frame, row in ((found[place], rows[place]) for place in order)
    ]
    places = [_row_place(found[place], rows[place]) for place in order]
    known = [place for place in places if place is not None]
    poses = np.concatenate([each.turns for each in turns])
    notes = (
        f"ROMP {source} ({turns[0].whose}, {turns[0].columns} columns), {len(order)} frames, {how}, "
        f"no rate in the file, {ROMP_RATE_HZ:g} frames/s assumed",
        f"hands: {hands_note(poses)}",
        who,
        *(() if len(known) == len(places) else (f"no `{ROMP_PLACES}` in some frames: stays in place",)),
        *dict.fromkeys(note for each in turns for note in each.notes),
    )
    return RawMotion(
        np.array([numbers[place] for place in order]) / ROMP_RATE_HZ,
        poses,
        SMPL_REST_PELVIS + np.stack(known) if len(known) == len(places) else None,
        None,
        "-y",
        notes,
        detected=Detected(
            f"ROMP {source}", f"`{ROMP_POSES}` in {len(found)} frames", unit="m", rate=f"{how}, {ROMP_RATE_HZ:g}/s"
        ),
        ups=ANY,
    )


def _frame_numbers(found: list[FoundTable]) -> tuple[NDArray[np.int64], str]:
    """Return (number of each frame, a note on the source of the numbers).

    The numbers are those in the frames' names, if all names end in different numbers; otherwise the frames' indices.
    """
    matches = [_NUMBER.search(frame.name) for frame in found]
    named = [int(match[1][-9:]) for match in matches if match is not None]
    if len(named) == len(found) == len(set(named)):
        return np.array(named), "numbered by their names"
    return np.arange(len(found)), "in the file's order"


def _rows_of_person(found: list[FoundTable]) -> tuple[list[int], str]:
    """Return (row of one person in each frame, -1 if absent; a note). Raises BadInputError if no frame has anybody."""
    counts = [len(_rows_in(frame, ROMP_POSES)) for frame in found]
    if all(frame.has(ROMP_PERSONS) for frame in found):
        tracks = [_tracks_in(frame)[:count] for frame, count in zip(found, counts, strict=True)]
        times = Counter(track for each in tracks for track in set(each))
        if times:
            person, most = times.most_common(1)[0]
            rows = [each.index(person) if person in each else -1 for each in tracks]
            return rows, f"track {person} is read, in {most} frames, of {len(times)} in the file"
    if not any(counts):
        raise BadInputError(found[0].where, "nobody in any frame", f"rows of `{ROMP_POSES}`")
    several = (
        f"; up to {max(counts)} persons in a frame and no `{ROMP_PERSONS}`, so they may change"
        if max(counts) > 1
        else ""
    )
    return [0 if count else -1 for count in counts], f"the first person of each frame is read{several}"


def _tracks_in(frame: FoundTable) -> list[int]:
    """Return the track of the person in each row of `frame`. Raises BadInputError for anything but whole numbers."""
    where = f"{frame.where}[{ROMP_PERSONS}]"
    tracks = as_numbers(where, _rows_in(frame, ROMP_PERSONS), "numbers").ravel()
    wrong = tracks[~(np.abs(tracks) <= LARGEST_TRACK)]  # `~` includes NaN, which no comparison holds for
    if wrong.size:
        raise BadInputError(where, f"{wrong[0]:g}", f"whole numbers up to {LARGEST_TRACK:g}")
    return [int(track) for track in tracks]


def _row_place(frame: FoundTable, row: int) -> F64 | None:
    """Return the position (3,) of the person in row `row` of `frame`, metres, in the camera's coordinates.

    The result is None if the frame has no positions. Raises BadInputError when positions and poses do not match.
    """
    if not frame.has(ROMP_PLACES):
        return None
    places = _rows_in(frame, ROMP_PLACES)
    if places.shape != (len(_rows_in(frame, ROMP_POSES)), 3):
        raise BadInputError(
            f"{frame.where}[{ROMP_PLACES}]", f"shape {places.shape}", f"a row of 3 for each of `{ROMP_POSES}`"
        )
    return as_numbers(f"{frame.where}[{ROMP_PLACES}]", places[row], "numbers")


def _rows_in(frame: FoundTable, key: str) -> NDArray[np.generic]:
    array = frame.array(key)
    if not array.ndim:
        raise BadInputError(f"{frame.where}[{key}]", "one number", "a row for each person")
    return array


MAX_BETAS = 400
LARGEST_SCALE = 1e4
NO_RATE = "save it again with mocap_frame_rate=..., or its poses alone as .npy, which is played at 30/s"


def motion_of(where: str, source: str, values: Any, there: str = "") -> RawMotion:
    """Return the motion in `values`, the content of a file.

    `where`: path of the file, for messages.
    `source`: suffix of the file, for people.
    `there`: content of the file, for messages, when `values` are only a part of it.
    Raises BadInputError when no layout fits, or when an array is unusable.
    """
    tables = [
        FoundTable(f"{where}[{printable(name)}]" if name else where, name, table) for name, table in tables_in(values)
    ]
    frames_of_romp = [table for table in tables if table.has(ROMP_POSES)]
    if frames_of_romp:
        return motion_of_frames(frames_of_romp, source)
    layout, found = _layout_of(tables) or (None, [])
    if layout is None:
        raise BadInputError(where, there or contents(values), f"a motion: {EXPECTED}; or `{ROMP_POSES}` (ROMP)", ARRAYS)
    read = [(_turns(layout, each), each) for each in found]
    turns, chosen = max(read, key=lambda one: len(one[0].turns))
    frames = len(turns.turns)
    rate, how = _rate(layout, chosen)
    places, place_notes = _places(layout, chosen, frames)
    kept = _measured(layout, chosen, frames)
    betas = _betas(layout, chosen)
    who = [f"read from {printable(chosen.name)}"] if chosen.name else []
    if len(found) > 1:
        who = [f"{len(found)} persons in the file: {printable(chosen.name)}, the one with the most frames, is read"]
    notes = (
        f"{layout.name} {source} ({turns.whose}, {turns.columns} columns), {frames} frames at {rate:g}/s ({how})",
        f"hands: {hands_note(turns.turns)}",
        f"betas: {'none' if betas is None else len(betas)}",
        *place_notes,
        *turns.notes,
        *who,
        *((f"{int((~kept).sum())} frames that were not measured left out",) if not kept.all() else ()),
    )
    reason = " and ".join(f"`{key}`" for key in layout.needs)
    detected = Detected(
        f"{layout.name} {source} ({turns.whose})",
        f"{reason} of {turns.columns} columns",
        unit="m",
        rate=f"by `{how}`" if how in RATE_KEYS else how,
    )
    return RawMotion(
        np.arange(frames)[kept] / rate,
        turns.turns[kept],
        None if places is None else places[kept],
        betas,
        layout.up,
        notes,
        detected=detected,
        ups=layout.ups,
    )


def _layout_of(tables: list[FoundTable]) -> tuple[ArrayLayout, list[FoundTable]] | None:
    """Return (first layout that any of `tables` has, all tables that have it); None if no table has a layout."""
    for layout in LAYOUTS:
        found = [table for table in tables if all(table.has(key) for key in layout.needs)]
        if found:
            return layout, found
    return None


def _turns(layout: ArrayLayout, found: FoundTable) -> JointTurns:
    """Return the rotations of all of the layout's arrays together. No two arrays have a joint in common.

    Raises BadInputError when an array has another number of frames than the first array.
    """
    parts, notes = [], []
    for array in layout.arrays:
        if not found.has(array.key):
            continue
        values = found.array(array.key)
        if not array.needed and values.shape[1:] not in ((width,) for width in array.widths):
            notes.append(f"`{array.key}` of shape {values.shape} left out: no turns of single joints")
            continue
        parts.append(turns_in(f"{found.where}[{array.key}]", values, array.widths))
        if len(parts[-1].turns) != len(parts[0].turns):
            raise BadInputError(
                f"{found.where}[{array.key}]", f"{len(values)} rows", f"{len(parts[0].turns)}, as `{layout.needs[0]}`"
            )
    whole = next(part for part in parts if part.whose)
    said = (*notes, *(note for part in parts for note in part.notes))
    return JointTurns(np.sum([part.turns for part in parts], axis=0), whole.columns, whole.whose, said)


def _rate(layout: ArrayLayout, found: FoundTable) -> tuple[float, str]:
    for key in RATE_KEYS:
        if found.has(key):
            value = found.numbers(key)
            if value.size != 1 or not 1 <= value.item() <= 1000:
                raise BadInputError(
                    f"{found.where}[{key}]", str(value.tolist())[:80], "one rate from 1 to 1000 frames/s"
                )
            return float(value.item()), key
    if layout.rate_hz is None:
        raise BadInputError(found.where, "no frame rate", f"a key `{RATE_KEYS[0]}` or `{RATE_KEYS[1]}`", NO_RATE)
    return layout.rate_hz, layout.rate_why


def _places(layout: ArrayLayout, found: FoundTable, frames: int) -> tuple[F64 | None, tuple[str, ...]]:
    """Return (positions of the pelvis (T, 3), metres, or None if the file has none; notes)."""
    key = layout.place
    if not found.has(key):
        return None, (f"no `{key}`: stays in place",)
    if found.array(key).shape != (frames, 3):
        first = layout.needs[0]
        raise BadInputError(
            f"{found.where}[{key}]", f"shape {found.array(key).shape}", f"({frames}, 3), a row for each of `{first}`"
        )
    places = found.numbers(key)
    notes: tuple[str, ...] = ()
    if found.has(layout.scale):
        scale = _scale(layout, found)
        places, notes = places / scale, (f"places divided by `{layout.scale}`, {scale:.4g}",)
    elif layout.scale:
        notes = (f"no `{layout.scale}`: places taken for metres",)
    return (places if layout.rest_pelvis is None else layout.rest_pelvis + places), notes


def _scale(layout: ArrayLayout, found: FoundTable) -> float:
    value = found.numbers(layout.scale)
    if value.size != 1 or not 0 < value.item() <= LARGEST_SCALE:
        where = f"{found.where}[{layout.scale}]"
        raise BadInputError(where, str(value.tolist())[:80], f"one scale above 0, at most {LARGEST_SCALE:g}")
    return float(value.item())


def _measured(layout: ArrayLayout, found: FoundTable, frames: int) -> NDArray[np.bool_]:
    """Return a mask (T,) of the frames that were measured; all True if the file does not say."""
    if not found.has(layout.mask):
        return np.ones(frames, dtype=bool)
    mask = found.array(layout.mask)
    if mask.shape != (frames,) or mask.dtype.kind not in "biuf":
        raise BadInputError(f"{found.where}[{layout.mask}]", f"shape {mask.shape}", f"({frames},), true or false")
    if not mask.any():
        raise BadInputError(f"{found.where}[{layout.mask}]", "no frame that was measured", "at least one")
    return np.asarray(mask != 0)


def _betas(layout: ArrayLayout, found: FoundTable) -> F64 | None:
    """Return the shape coefficients (n,), averaged if each frame has its own; None if the file has none."""
    if not found.has(layout.betas):
        return None
    where = f"{found.where}[{layout.betas}]"
    betas = found.numbers(layout.betas)
    if betas.ndim > 2:
        raise BadInputError(where, f"shape {betas.shape}", "(n,), or a row for each frame")
    flat = betas.mean(axis=0) if betas.ndim == 2 and len(betas) > 1 else betas.reshape(-1)
    if flat.size > MAX_BETAS or not np.isfinite(flat).all():
        raise BadInputError(where, f"{flat.size} values, some not finite or too many", "finite numbers")
    return flat
