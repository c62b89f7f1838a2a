"""Reads the motion of a BVH file: its skeleton and channels; `retarget.py` computes the avatar's poses from them.

The syntax is read first, and every error in it names the line. After that, joints are matched by name. A BVH file
states no unit. If the scene does not state it either, the unit is the one that makes the legs nearest to USUAL_LEG_M.
If no unit makes human legs, the file is scaled to that length. A T pose at the beginning is left out if the recording
jumps away from it. Otherwise it is kept.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import BODY_JOINTS, JOINT_INDEX
from trilane.errors import BadInputError
from trilane.files import read_text
from trilane.scene.motion.joint_names import NO_MAP, STATED, match_names, plain
from trilane.scene.motion.motion import T_POSE, RawMotion
from trilane.scene.motion.retarget import retarget
from trilane.scene.motion.tracks import SIDES, Tracks, angle_between, leg_length, trunk_line
from trilane.scene.recordings import Detected
from trilane.scene.rotations import about

EXPECTED = "a BVH file: HIERARCHY, MOTION, Frames, Frame Time, one line of channels a frame"
MAX_JOINTS = 1000
MAX_FRAMES = 200_000
CHANNELS = {f"{axis}{kind}": (kind, k) for kind in ("position", "rotation") for k, axis in enumerate("XYZ")}
_CHANNEL_OF = {name.lower(): name for name in CHANNELS}


@dataclass
class BvhJoint:
    """A joint of the file.

    `name`: name in the file.
    `parent`: index of the parent, -1 for a root; a file may have several roots.
    `offset` (3,): vector from the parent at rest, file units.
    `channels`: names such as `Zrotation`, in file order.
    `first`: column of the joint's first channel in the frames.
    `tip` (3,): vector from the joint to its end site, file units; None without an end site.
    """

    name: str
    parent: int
    offset: F64
    channels: tuple[str, ...] = ()
    first: int = 0
    tip: F64 | None = None


@dataclass(frozen=True)
class Bvh:
    """The content of a BVH file.

    `joints`: joints in file order, each after its parent.
    `frames` (T, columns): value of each channel, in file units or degrees. `frame_time_s`: seconds per frame.
    """

    joints: list[BvhJoint]
    frames: F64
    frame_time_s: float

    def forward(self) -> tuple[F64, F64]:
        """Return global rotations (T, J, 3, 3) and positions (T, J, 3), file units, of all J joints."""
        count = len(self.frames)
        turns, places = np.empty((count, len(self.joints), 3, 3)), np.empty((count, len(self.joints), 3))
        for index, joint in enumerate(self.joints):
            turn, shift = self._local(joint)
            if joint.parent < 0:
                turns[:, index], places[:, index] = turn, shift
            else:
                above = turns[:, joint.parent]
                turns[:, index] = above @ turn
                places[:, index] = places[:, joint.parent] + (above @ shift[..., None])[..., 0]
        return turns, places

    def _local(self, joint: BvhJoint) -> tuple[F64, F64]:
        turn = np.broadcast_to(np.eye(3), (len(self.frames), 3, 3))
        shift = np.tile(joint.offset, (len(self.frames), 1))
        for column, channel in enumerate(joint.channels, joint.first):
            kind, axis = CHANNELS[channel]
            values = self.frames[:, column]
            if kind == "rotation":
                turn = turn @ about(axis, np.radians(values))
            else:
                shift[:, axis] = values
        return turn, shift


@dataclass
class _Words:
    """The words of the hierarchy, read one after the other.

    `words`: (line number, word) pairs. `line`: line of the last word. `read`: number of words that were read.
    """

    path: Path
    words: Sequence[tuple[int, str]]
    line: int = 1
    read: int = 0

    def more(self) -> bool:
        return self.read < len(self.words)

    def next(self) -> str:
        if not self.more():
            raise self.error("the end of the file", EXPECTED)
        self.line, word = self.words[self.read]
        self.read += 1
        return word

    def want(self, *words: str) -> str:
        word = self.next()
        if word.upper() not in words:
            raise self.error(repr(word), " or ".join(words))
        return word.upper()

    def number(self) -> float:
        word = self.next()
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.error(repr(word), "a finite number")
        return value

    def offset(self) -> F64:
        self.want("OFFSET")
        return np.array([self.number() for _ in range(3)])

    def error(self, found: str, expected: str) -> BadInputError:
        return BadInputError(f"{self.path}, line {self.line}", found, expected)


@dataclass
class _Hierarchy:
    words: _Words
    joints: list[BvhJoint] = field(default_factory=list)
    columns: int = 0

    def read(self) -> None:
        """Read everything from HIERARCHY to the closing brace of the last root."""
        self.words.want("HIERARCHY")
        self.words.want("ROOT")
        self._tree()
        while self.words.more():
            word = self.words.next()
            if word.upper() != "ROOT":
                raise self.words.error(repr(word), "another ROOT or a line MOTION")
            self._tree()

    def _tree(self) -> None:
        open_joints = [self._joint(parent=-1)]
        while open_joints:
            word = self.words.want("JOINT", "END", "CHANNELS", "}")
            if word == "JOINT":
                open_joints.append(self._joint(parent=open_joints[-1]))
            elif word == "END":
                self.words.want("SITE")
                self.words.want("{")
                self.joints[open_joints[-1]].tip = self.words.offset()
                self.words.want("}")
            elif word == "CHANNELS":
                self._channels(self.joints[open_joints[-1]])
            else:
                open_joints.pop()

    def _joint(self, parent: int) -> int:
        if len(self.joints) >= MAX_JOINTS:
            raise self.words.error(f"more than {MAX_JOINTS} joints", "a human skeleton")
        name = self.words.next()
        self.words.want("{")
        self.joints.append(BvhJoint(name, parent, self.words.offset()))
        return len(self.joints) - 1

    def _channels(self, joint: BvhJoint) -> None:
        count = self.words.number()
        if count not in range(7):
            raise self.words.error(f"{count:g} channels", "0 to 6")
        names = [self.words.next() for _ in range(int(count))]
        for name in names:
            if name.lower() not in _CHANNEL_OF:
                raise self.words.error(repr(name), "a channel such as Zrotation or Xposition")
        joint.channels, joint.first = tuple(_CHANNEL_OF[name.lower()] for name in names), self.columns
        self.columns += len(names)


def load_bvh(path: Path) -> Bvh:
    """Read the BVH file `path`.

    Raises BadInputError with the line for wrong syntax, too few frames, or a frame with a wrong number of channels.
    """
    lines = read_text(path, EXPECTED).splitlines()
    start = next((k for k, line in enumerate(lines) if line.strip().upper() == "MOTION"), len(lines))
    words = [(number, word) for number, line in enumerate(lines[:start], 1) for word in line.split()]
    hierarchy = _Hierarchy(_Words(path, words))
    hierarchy.read()
    if start == len(lines):
        raise BadInputError(f"{path}, line {len(lines)}", "the end of the file", "a line MOTION")
    count = _header(path, lines, start + 1, "FRAMES:")
    frame_time = _header(path, lines, start + 2, "FRAME TIME:")
    if not 1 <= count <= MAX_FRAMES or count != int(count):
        raise BadInputError(f"{path}, line {start + 2}", f"{count:g} frames", f"1 to {MAX_FRAMES}")
    if not 1e-3 <= frame_time <= 1:
        raise BadInputError(f"{path}, line {start + 3}", f"{frame_time:g} s a frame", "0.001 to 1")
    frames = _rows(path, lines, start + 3, int(count), hierarchy.columns)
    return Bvh(hierarchy.joints, frames, frame_time)


def _header(path: Path, lines: list[str], index: int, key: str) -> float:
    where = f"{path}, line {index + 1}"
    text = " ".join(lines[index].split()) if index < len(lines) else ""
    if not text.upper().startswith(key):
        raise BadInputError(where, repr(text), f"`{key} NUMBER`")
    try:
        return float(text[len(key) :])
    except ValueError:
        raise BadInputError(where, repr(text), f"`{key} NUMBER`") from None


def _rows(path: Path, lines: list[str], start: int, count: int, columns: int) -> F64:
    numbered = [(k + 1, line) for k, line in enumerate(lines[start:], start) if line.strip()]
    if len(numbered) < count:
        raise BadInputError(f"{path}, line {len(lines)}", f"{len(numbered)} frames, then the end", f"{count} frames")
    frames = np.empty((count, columns))
    for row, (number, line) in enumerate(numbered[:count]):
        words = line.split()
        if len(words) != columns:
            raise BadInputError(f"{path}, line {number}", f"{len(words)} numbers", f"{columns}, one for each channel")
        try:
            frames[row] = [float(word) for word in words]
        except ValueError as error:
            raise BadInputError(f"{path}, line {number}", str(error), "numbers") from None
    return frames


#: Metres per unit; `cmu` is the unit of the CMU recordings, 1/0.45 inches.
UNITS_M = {"m": 1.0, "cm": 0.01, "in": 0.0254, "cmu": 0.0254 / 0.45}
USUAL_LEG_M = 0.85
#: Range of a human leg's length, as a multiple of USUAL_LEG_M.
HUMAN_LEG = (0.6, 1.6)


def unit_of(leg: float, units: str) -> tuple[str, float]:
    """Return (note on the unit of lengths, unit in metres).

    `leg`: length of a leg in the file's unit. `units`: a key of UNITS_M, or `auto` to find it by the leg.
    """
    if units != "auto":
        return f"{units}, as given", UNITS_M[units]
    name = min(UNITS_M, key=lambda unit: abs(np.log(leg * UNITS_M[unit] / USUAL_LEG_M)))
    if HUMAN_LEG[0] < leg * UNITS_M[name] / USUAL_LEG_M < HUMAN_LEG[1]:
        return f"{name}, by the length of the legs", UNITS_M[name]
    return f"unknown, scaled to a leg of {USUAL_LEG_M} m", USUAL_LEG_M / leg


#: Largest angle, in a T pose, between arms and hip line and between legs and trunk; largest rotation of a bone that is
#: still. Radians.
IN_T, STILL = np.radians(20.0), np.radians(2.0)
#: A bone jumps if it turns by at least this angle between two frames, radians.
JUMP = np.radians(20.0)
CHAINS = (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))


def leading_t_pose(tracks: Tracks, trunk: F64) -> tuple[int, tuple[str, ...]]:
    """Return (number of frames in a T pose before the motion jumps away from it, a note on that T pose).

    `trunk` (T, 3): vector along the trunk. The number is 0 if there is no T pose, or if the motion moves on without a
    jump.
    """
    pairs = [(f"{side}_{start}", f"{side}_{end}") for start, end in CHAINS for side in SIDES]
    if tracks.frames < 2 or not all(tracks.has(*pair) for pair in pairs):
        return 0, ()
    bones = np.array([tracks.bone(*pair) for pair in pairs])
    moved = np.flatnonzero(angle_between(bones, bones[:, :1]).max(axis=0) > STILL)
    left = tracks.across("hip")
    expected = np.array([left, -left, left, -left, -trunk, -trunk, -trunk, -trunk])[:, 0]
    if not len(moved) or not (angle_between(bones[:, 0], expected) < IN_T).all():
        return 0, ()
    first = int(moved[0])
    if angle_between(bones[:, first], bones[:, first - 1]).max() < JUMP:
        return 0, ("begins in a T pose and moves on from it; `start_s` leaves it out",)
    return first, (f"a T pose before the motion, which jumps away from it: left out, {first} of the frames",)


LEAST_LENGTH = 1e-6
#: Least distance of an end site from its joint, as a share of the legs; a nearer one is a marker, not the end of a
#: bone.
LEAST_TIP = 0.02
#: Axes that may be up; with X up, a body would lie.
UPS = ("y", "z", "-y", "-z")
#: A frame with a larger coordinate, in the file's unit, is damaged.
FARTHEST = 1e9


def load_retargeted(path: Path, units: str, joint_map: Mapping[str, str] = NO_MAP, rest: F64 = T_POSE) -> RawMotion:
    """Read a BVH file as poses of the 55 SMPL-X joints.

    `units`: a key of UNITS_M, or `auto`.
    `joint_map`: as in `match_names`.
    `rest` (55, 3): rest joints of the avatar, metres.
    Raises BadInputError when the file is no BVH, its skeleton is unknown or without length, or no frame is sound.
    """
    bvh = load_bvh(path)
    dialect, index_of, of_roots = _person(path, bvh.joints, joint_map)
    tracks, readable = tracks_of(bvh, index_of)
    if not readable.any():
        found = f"numbers that are not finite, or absurdly large, in all of {len(readable)} frames"
        raise BadInputError(path, found, "at least half of the frames sound")
    leg = leg_length(tracks)
    if leg < LEAST_LENGTH or np.median(np.linalg.norm(tracks.across("hip"), axis=-1)) < LEAST_LENGTH:
        raise BadInputError(path, "legs of no length or hips in one place", "a skeleton with OFFSETs")
    unit, unit_m = unit_of(leg, units)
    poses, places, how = retarget(tracks, rest)
    in_t, of_t_pose = leading_t_pose(tracks, trunk_line(tracks).along(tracks))
    start = int(np.flatnonzero(readable)[in_t])
    partners = sorted(JOINT_INDEX[name] for name in index_of)
    hands = sum(index >= 25 for index in partners)
    rate = 1 / bvh.frame_time_s
    missing = ", ".join(name for name in BODY_JOINTS if name not in index_of)
    no_partner = f"{missing}: no partner, so they follow their parents; `{STATED}` of the avatar names partners"
    notes = (
        f"BVH, {len(bvh.joints)} joints named as in {dialect}, {len(bvh.frames)} frames at {rate:.4g}/s",
        f"units: {unit} (leg of {leg * unit_m:.2f} m)",
        f"{len(index_of)} joints have a partner, {hands} of them in the hands",
        *([no_partner] if missing else []),
        *of_roots,
        *how,
        *of_t_pose,
        "betas: none in the format",
    )
    joints = {name: bvh.joints[index].name for name, index in index_of.items()}
    others = tuple(joint.name for joint in bvh.joints if joint.name not in joints.values())
    reason = f"HIERARCHY, with joint names of {dialect}"
    detected = Detected("BVH", reason, unit=unit, rate="by `Frame Time`", joints=joints, unmapped=others)
    times = np.arange(len(bvh.frames), dtype=np.float64) * bvh.frame_time_s
    poses, places, feet = (
        among_all(values, readable)[start:] for values in (poses, places * unit_m, feet_of(tracks) * unit_m)
    )
    return RawMotion(times[start:], poses, places, None, "y", notes, leg * unit_m, detected, UPS, feet)


def _person(
    path: Path, joints: Sequence[BvhJoint], joint_map: Mapping[str, str]
) -> tuple[str, dict[str, int], tuple[str, ...]]:
    """Return (family of joint names, index of each joint by SMPL-X name, a note if there are several roots).

    If several roots are persons, the person with the most matched joints is taken, the first among equals. If no root
    is a person, all roots together are matched as one person. Raises BadInputError as `match_names` does.
    """
    names = [joint.name for joint in joints]
    roots = [index for index, joint in enumerate(joints) if joint.parent < 0]
    if len(roots) == 1:
        return *match_names(path, names, joint_map), ()
    found: list[tuple[str, dict[str, int], int]] = []
    for root, end in itertools.pairwise([*roots, len(joints)]):
        try:
            family, index_of = match_names(path, names[root:end], joint_map)
        except BadInputError:
            continue
        found.append((family, {name: root + index for name, index in index_of.items()}, root))
    if not found:
        note = f"{len(roots)} ROOTs ({', '.join(names[root] for root in roots)}), taken for one person"
        return *match_names(path, names, joint_map), (note,)
    family, index_of, shown = max(found, key=lambda person: len(person[1]))
    others = ", ".join(names[root] for root in roots if root != shown)
    return family, index_of, (f"{len(roots)} ROOTs: the person of {names[shown]} is shown, not {others}",)


def feet_of(tracks: Tracks) -> F64:
    """Return positions (T, 2, n, 3) of n joints of the left and the right foot: ankles, and toes or bone ends."""
    feet = [[tracks.places[f"{side}_ankle"]] for side in SIDES]
    ends = [tracks.places.get(f"{side}_foot", tracks.tips.get(f"{side}_ankle")) for side in SIDES]
    if all(end is not None for end in ends):
        feet = [[*foot, end] for foot, end in zip(feet, ends, strict=True) if end is not None]
    return np.moveaxis(np.array(feet), 2, 0)


def tracks_of(bvh: Bvh, index_of: dict[str, int]) -> tuple[Tracks, NDArray[np.bool_]]:
    """Return (joints of `index_of` over the readable frames, mask of the readable frames among all frames (T,))."""
    turns, places = bvh.forward()
    with np.errstate(invalid="ignore"):
        readable = np.asarray((np.abs(places) < FARTHEST).all(axis=(1, 2)) & np.isfinite(turns).all(axis=(1, 2, 3)))
    turns, places = turns[readable], places[readable]
    named = {name: places[:, index] for name, index in index_of.items()}
    least = LEAST_TIP * leg_length(Tracks(named)) if len(places) else 0.0
    ends = ((name, _tip(bvh, index, turns, places, least)) for name, index in index_of.items())
    tips = {name: tip for name, tip in ends if tip is not None}
    return Tracks(named, {name: turns[:, index] for name, index in index_of.items()}, tips), readable


def _tip(bvh: Bvh, index: int, turns: F64, places: F64, least: float) -> F64 | None:
    """Return the positions (T, 3) at which the bone of joint `index` ends.

    The end is the end site or a joint directly below, whichever is farthest. A joint at the same position counts as the
    joint itself; thumbs do not count. The result is None if no end is farther than `least`, in the file's unit.
    """
    here, found, reach = {index}, None, max(least, LEAST_LENGTH)
    for k, joint in enumerate(bvh.joints):
        ends = [places[:, k] + turns[:, k] @ joint.tip] if k in here and joint.tip is not None else []
        if joint.parent in here:
            if np.abs(joint.offset).max() < LEAST_LENGTH:
                here.add(k)
            ends.append(places[:, k])
        for end in [] if "thumb" in plain(joint.name) or not len(places) else ends:
            distance = float(np.linalg.norm(end - places[:, index], axis=-1).mean())
            if distance > reach:
                found, reach = end, distance
    return found


def among_all(values: F64, readable: NDArray[np.bool_]) -> F64:
    """Return an array over all frames (T, ...): `values` in the readable frames, NaN in the other frames.

    `readable` (T,): which frames are readable.
    """
    spread = np.full((len(readable), *values.shape[1:]), np.nan)
    spread[readable] = values
    return spread
