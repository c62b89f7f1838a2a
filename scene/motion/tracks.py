"""Tracks of named joints over time, and rotations computed from them: the input of retargeting, from any file.

Joints have their SMPL-X names. Unit and axes are the file's own, and equal in all arrays. Positions alone tell in
which frames the person stands, and whether a skeleton is built like the avatar's. The file's zero pose does not matter.

**Trunk.** Hip line, trunk line and shoulder line define coordinate frames, in the same way for the recording and for
the avatar at rest. A joint's rotation takes the avatar's frame to the recorded one. Programs put the joints of the
trunk at different depths in the body. Therefore, if a skeleton is not built like the avatar's, moments at which the
person stands straight determine the constant pitch of each part.

**Limbs.** A bone points where the recorded bone points. Its twist about its length follows the file's own rotations, so
that it never flips when the limb is straight. These rotations are right except for one constant angle. The angle is
chosen so that, on average over the recording, elbows and knees bend, and toes and fingers point, as the avatar's do. No
zero pose is needed for this.

Functions take vectors (T, 3) and rotation matrices (T, 3, 3), and return proper rotations for finite input.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINT_NAMES
from trilane.scene.rotations import about, matrix_from_quat, matrix_from_rotvec, normalised

SIDES = ("left", "right")


@dataclass(frozen=True)
class Tracks:
    """Joints over T frames, by SMPL-X name.

    `places`: positions (T, 3) of each joint.
    `turns`: global rotations (T, 3, 3) of each joint, if the file has them.
    `tips`: positions (T, 3) at which a joint's bone ends: at a joint of any name, or at an end site.
    """

    places: Mapping[str, F64]
    turns: Mapping[str, F64] = field(default_factory=dict)
    tips: Mapping[str, F64] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        return len(self.places["left_hip"])

    def has(self, *names: str) -> bool:
        """Return whether all joints `names` have positions."""
        return all(name in self.places for name in names)

    def between(self, part: str) -> F64:
        """Return the middle (T, 3) between the left and the right joint of a pair, such as `hip`."""
        return (self.places[f"left_{part}"] + self.places[f"right_{part}"]) / 2

    def across(self, part: str) -> F64:
        """Return the vector (T, 3) from the right to the left joint of a pair, such as `hip`."""
        return self.places[f"left_{part}"] - self.places[f"right_{part}"]

    def bone(self, start: str, end: str) -> F64:
        """Return the vector (T, 3) from joint `start` to joint `end`."""
        return self.places[end] - self.places[start]


def at_rest(joints: F64) -> Tracks:
    """Return the rest joints (55, 3) of an avatar as Tracks of one frame."""
    return Tracks({name: joints[None, index] for index, name in enumerate(JOINT_NAMES[: len(joints)])})


def unit(vectors: F64) -> F64:
    """Scale vectors (..., 3) to unit length; a zero vector stays zero."""
    length = np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True))
    return np.asarray(vectors / np.where(length > 0, length, 1.0))


def angle_between(a: F64, b: F64) -> F64:
    """Return angles (...), radians, between vectors `a` and `b` (..., 3); exact near 0 and pi."""
    cross = np.cross(a, b)
    return np.asarray(np.arctan2(np.sqrt((cross * cross).sum(axis=-1)), (a * b).sum(axis=-1)))


#: A person stands if the angles between thighs and trunk line, and the bends of the knees, are below these; radians.
STRAIGHT_HIP, STANDING_KNEE = np.radians(25.0), np.radians(50.0)
#: A standing frame is straight if its knees bend by less than STRAIGHT_KNEE, or by at most LITTLE_MORE than in the
#: straightest frame; radians.
STRAIGHT_KNEE, LITTLE_MORE = np.radians(10.0), np.radians(5.0)
#: Largest lean, radians, of a leg that counts as below its hip; share of these frames in which the foot lies flat.
LEG_BELOW, PLANTED_SHARE = np.radians(35.0), 0.25
#: A mean up direction counts as an axis of the file if the cosine between them is above this.
NEAR_AXIS = np.cos(np.radians(30.0))
#: Pairs of joints with a constant distance. If two skeletons are built alike, their distances are the same.
RIGID = (
    ("left_hip", "right_hip"), ("pelvis", "left_hip"), ("pelvis", "spine1"), ("left_hip", "spine1"),
    ("spine1", "spine2"), ("spine2", "spine3"), ("spine3", "neck"), ("spine3", "left_collar"), ("neck", "left_collar"),
    ("left_collar", "right_collar"), ("left_collar", "left_shoulder"), ("left_ankle", "left_foot"),
)  # fmt: skip
#: Such distances may differ by SAME_SHARE of the distance plus SAME_LEGS of the length of a leg.
SAME_SHARE, SAME_LEGS = 0.02, 0.003


def standing_frames(tracks: Tracks, trunk: F64) -> NDArray[np.bool_]:
    """Return a mask (T,) of the frames in which the person stands as straight as anywhere in the recording.

    Thighs must be in line with the vector `trunk` (T, 3), and the knees straight.
    """
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
    """Return the up direction (3,) of the recording: the file's axis nearest to the mean direction of trunk and legs.

    `trunk` (T, 3): vector along the trunk. `stands` (T,): frames over which the mean is taken; all if none stands. If
    no axis is near the mean direction, that direction itself is up.
    """
    legs = tracks.between("hip") - tracks.between("ankle")
    both = unit(trunk) + unit(legs)
    mean = unit(both[stands].mean(axis=0) if stands.any() else both.mean(axis=0))
    nearest = np.eye(3)[np.abs(mean).argmax()] * np.sign(mean[np.abs(mean).argmax()])
    return np.asarray(nearest if nearest @ mean > NEAR_AXIS else mean)


def planted_frames(tracks: Tracks, side: str, foot: F64, up: F64) -> NDArray[np.bool_]:
    """Return a mask (T,) of the frames in which a foot most likely lies flat.

    Such a foot hardly moves, and its leg is below the hip.
    `side`: `left` or `right`. `foot` (T, 3): vector from the ankle to the toes. `up` (3,): up direction of the
    recording.
    """
    below = angle_between(tracks.bone(f"{side}_ankle", f"{side}_hip"), up) < LEG_BELOW
    if tracks.frames == 1 or not below.any():
        return np.asarray(below)
    ankle = tracks.places[f"{side}_ankle"]
    speed = sum(np.linalg.norm(np.gradient(place, axis=0), axis=-1) for place in (ankle, ankle + foot))
    return np.asarray(below & (speed <= np.quantile(np.asarray(speed)[below], PLANTED_SHARE)))


def leg_length(tracks: Tracks) -> float:
    """Return the length of a leg from hip over knee to ankle: the mean of both legs, and the median over all frames."""
    bones = [
        np.linalg.norm(tracks.bone(f"{side}_{start}", f"{side}_{end}"), axis=-1)
        for side in SIDES
        for start, end in (("hip", "knee"), ("knee", "ankle"))
    ]
    return float(np.median(sum(bones)) / 2)


def built_alike(tracks: Tracks, rest: Tracks) -> bool:
    """Return whether `tracks` and `rest` have equal distances between joints, relative to the length of their legs.

    The result is False if `tracks` lacks the joints of the trunk.
    """
    scale = leg_length(tracks) / leg_length(rest)
    pairs = [pair for pair in RIGID if tracks.has(*pair)]
    for pair in pairs:
        ours = float(np.linalg.norm(rest.bone(*pair)[0])) * scale
        theirs = float(np.median(np.linalg.norm(tracks.bone(*pair), axis=-1)))
        if abs(ours - theirs) > SAME_SHARE * ours + SAME_LEGS * leg_length(tracks):
            return False
    return ("spine1", "spine2") in pairs or ("spine3", "neck") in pairs


#: A unit vector's part perpendicular to another vector is too short to define a direction if its length is below this.
TOO_SHORT = 1e-6


def transposed(turns: F64) -> F64:
    """Return the inverse, which is the transpose, of each rotation (T, 3, 3)."""
    return np.swapaxes(turns, -1, -2)


def turned(turns: F64, vectors: F64) -> F64:
    """Return `vectors` (T, 3) or (3,), rotated by `turns` (T, 3, 3) or (3, 3)."""
    return np.asarray((turns @ vectors[..., None])[..., 0])


def beside(vectors: F64, axis: F64) -> F64:
    """Return the part of `vectors` (T, 3) that is perpendicular to the unit vectors `axis` (T, 3)."""
    return np.asarray(vectors - (vectors * axis).sum(axis=-1, keepdims=True) * axis)


def frames_along(exact: F64, other: F64, first: str) -> F64:
    """Return coordinate frames (T, 3, 3) with the directions left, up and forward as columns.

    `first`: which direction `exact` is, `left` or `up`.
    `exact` (T, 3): that direction, kept exactly.
    `other` (T, 3): the other of left and up, kept approximately. If it is parallel to `exact`, any perpendicular
    direction replaces it.
    """
    a = unit(exact)
    b = beside(unit(other), a)
    along = np.linalg.norm(b, axis=-1, keepdims=True) < TOO_SHORT
    b = unit(np.where(along, np.cross(a, np.eye(3)[np.abs(a).argmin(axis=-1)]), b) if along.any() else b)
    left, up = (a, b) if first == "left" else (b, a)
    return np.stack([left, up, np.cross(left, up)], axis=-1)


def least_turns(source: F64, target: F64) -> F64:
    """Return the rotations (T, 3, 3) of the least angle from directions `source` (T, 3) to directions `target` (T, 3).

    The quaternion of each is (1 + cos, cross product), normalised. Between opposite directions, the axis is any
    perpendicular one.
    """
    a, b = np.broadcast_arrays(unit(source), unit(target))
    axis, cosine = np.cross(a, b), (a * b).sum(axis=-1)
    opposite = cosine < -1 + TOO_SHORT**2
    if opposite.any():
        axis = np.where(opposite[..., None], np.cross(a, np.eye(3)[np.abs(a).argmin(axis=-1)]), axis)
    quats = np.concatenate([np.where(opposite, 0.0, 1 + cosine)[..., None], axis], axis=-1)
    return matrix_from_quat(normalised(quats))


def mean_turn(turns: F64) -> F64:
    """Return the rotation (3, 3) nearest to the mean of `turns` (T, 3, 3), by least squares of the entries.

    Moakher, "Means and averaging in the group of rotations", SIAM J. Matrix Analysis 24(1), 2002.
    """
    u, _, v = np.linalg.svd(turns.mean(axis=0))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v)


def level_with(turns: F64, base: F64, where: NDArray[np.bool_]) -> F64:
    """Return `turns` (T, 3, 3) after one constant rotation that makes their mean equal to the mean of `base` (T, 3, 3).

    `where` (T,): frames over which the means are taken.
    """
    return np.asarray(turns @ mean_turn(transposed(base[where]) @ turns[where]).T)


#: A limb is straight if the sine of its bend is below this. A knee that is bent backwards a little then does not flip.
LEAST_BEND = np.sin(np.radians(15.0))

#: Evidence for a twist: a direction (3,) of the avatar at rest, and its recorded directions (T, 3). The lengths of
#: their parts perpendicular to the bone are weights.
Evidence = tuple[F64, F64]


def limb_turns(bone: F64, recorded: F64, carrier: F64, evidence: Sequence[Evidence]) -> F64:
    """Return global rotations (T, 3, 3) that take the avatar's rest `bone` (3,) to the recorded directions (T, 3).

    `carrier` (T, 3, 3): rotations whose change over time the twist follows.
    `evidence`: evidence for the constant part of the twist. Without evidence, the rest bone has no twist: it is turned
    by the least angle to the mean recorded direction in the carrier's axes.
    """
    target = unit(recorded)
    within = unit(turned(transposed(carrier), target).mean(axis=0))
    held = least_turns(turned(carrier, within), target) @ carrier
    laid = least_turns(bone[None], within[None])[0]
    return np.asarray(held @ _twist(held, within, laid, evidence) @ laid)


def _twist(held: F64, axis: F64, laid: F64, evidence: Sequence[Evidence]) -> F64:
    """Return the rotation (3, 3) about `axis` (3,) that brings the evidence closest to its recorded directions."""
    cosine = sine = 0.0
    inside = transposed(held)
    for ours, theirs in evidence:
        expected = unit(beside((laid @ ours)[None], axis[None]))
        found = beside(turned(inside, theirs), axis[None]).sum(axis=0)
        cosine += float(found @ expected[0])
        sine += float(found @ np.cross(axis, expected[0]))
    if np.hypot(cosine, sine) < TOO_SHORT:
        return np.eye(3)
    return matrix_from_rotvec(axis * np.arctan2(sine, cosine))


def hinge(upper: F64, lower: F64) -> F64:
    """Return axes (T, 3) about which a limb bends from `upper` to `lower` (T, 3).

    The length of each is the sine of the bend less LEAST_BEND, or 0 for a straight limb.
    """
    axes = np.cross(unit(upper), unit(lower))
    sines = np.linalg.norm(axes, axis=-1, keepdims=True)
    return np.asarray(axes * np.clip(1 - LEAST_BEND / np.maximum(sines, TOO_SHORT), 0.0, 1.0))


def swung(parent: F64, bone: F64, recorded: F64) -> F64:
    """Return the rotations (T, 3, 3) nearest to `parent` (T, 3, 3) that take `bone` (3,) to `recorded` (T, 3)."""
    return least_turns(turned(parent, bone), recorded) @ parent


SPINE = ("spine1", "spine2", "spine3")
#: Joints that may be the upper end of the trunk line: the first of these that the recording has.
TOPS = ("neck", "shoulder", "head", "spine3")
#: Least distance between the collar joints, as a share of the distance between the shoulders. Closer collar joints do
#: not show the chest's direction.
LEAST_COLLARS = 0.1
#: Share of the rotation from hip line to shoulder line that each part of the trunk has made.
TWIST = {"pelvis": 0.0, "spine1": 1 / 3, "spine2": 2 / 3, "spine3": 1.0}


@dataclass(frozen=True)
class TrunkLine:
    """The line of the trunk, from the hips to its upper end.

    `top`: a name of TOPS, or `knee` for a recording without trunk: the line then continues from the knees through the
    hips.
    """

    top: str

    def end(self, tracks: Tracks) -> F64:
        """Return the upper end of the line, positions (T, 3)."""
        if self.top == "shoulder":
            return tracks.between("shoulder")
        if self.top == "knee":
            return 2 * tracks.between("hip") - tracks.between("knee")
        return tracks.places[self.top]

    def along(self, tracks: Tracks) -> F64:
        """Return the vector (T, 3) from the pelvis to the upper end."""
        return self.end(tracks) - tracks.places["pelvis"]

    def points(self, tracks: Tracks) -> F64:
        """Return the middle of the hips, the recorded joints of the spine, and the upper end: positions (n, T, 3)."""
        inner = [tracks.places[name] for name in self.inner if name in tracks.places]
        return np.stack([tracks.between("hip"), *inner, self.end(tracks)])

    @property
    def inner(self) -> tuple[str, ...]:
        """Names of the joints of the spine that may be between the ends of the line."""
        return {"knee": (), "spine3": SPINE[:2]}.get(self.top, SPINE)

    def shares(self, rest: Tracks) -> F64:
        """Return the places (3,) of the avatar's three spine joints along the line, 0 to 1.

        Joints at the upper end and above it get 1. `rest`: joints of the avatar at rest.
        """
        inner = line_shares(self.points(rest))[1:-1, 0]
        return np.append(inner, np.ones(len(SPINE) - len(inner)))


def trunk_line(tracks: Tracks) -> TrunkLine:
    """Return the trunk line for the joints that `tracks` has."""
    for top in TOPS:
        names = [f"{side}_{top}" for side in SIDES] if top == "shoulder" else [top]
        if tracks.has(*names):
            return TrunkLine(top)
    return TrunkLine("knee")


def line_shares(points: F64) -> F64:
    """Return the place (n, T) of each point along its polyline (n, T, 3): 0 at the beginning, 1 at the end."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    reached = np.concatenate([np.zeros((1, points.shape[1])), np.cumsum(steps, axis=0)])
    return np.asarray(reached / np.where(reached[-1] > 0, reached[-1], 1.0))


def points_at(points: F64, shares: F64) -> F64:
    """Return the points (m, T, 3) of a polyline (n, T, 3) at the shares `shares` (m,) of its length."""
    at = line_shares(points)
    found = np.empty((len(shares), *points.shape[1:]))
    for k, share in enumerate(shares):
        after = np.clip((at < share).sum(axis=0), 1, len(points) - 1)
        frame = np.arange(points.shape[1])
        low, high = at[after - 1, frame], at[after, frame]
        part = (share - low) / np.where(high > low, high - low, 1.0)
        found[k] = points[after - 1, frame] + part[:, None] * (points[after, frame] - points[after - 1, frame])
    return found


@dataclass(frozen=True)
class Trunk:
    """Coordinate frames of a trunk over time.

    `frames`: frame (T, 3, 3) of each joint, with the directions left, up and forward as columns.
    `line` (T, 3): vector from the pelvis to the upper end of the trunk.
    """

    frames: dict[str, F64]
    line: F64


def trunk_of(tracks: Tracks, line: TrunkLine, shares: F64, by_collars: bool) -> Trunk:
    """Return the coordinate frames of pelvis and spine; the spine's joints are at `shares` (3,) of the trunk line.

    `by_collars`: whether collar joints, if there are any, show the chest's direction instead of the shoulders.
    """
    low, *inner, top = points_at(line.points(tracks), np.array([0.0, *shares, 1.0]))
    hips = unit(tracks.across("hip"))
    chest = _across_chest(tracks, hips, by_collars)
    frames = {"pelvis": frames_along(hips, inner[0] - low, "left")}
    for name, start, end in zip(SPINE, inner, [*inner[1:], top], strict=True):
        left = (1 - TWIST[name]) * hips + TWIST[name] * chest
        up = np.where(np.linalg.norm(end - start, axis=-1, keepdims=True) > 0, end - start, line.along(tracks))
        frames[name] = frames_along(left, up, "left") if name == "spine3" else frames_along(up, left, "up")
    return Trunk(frames, line.along(tracks))


def _across_chest(tracks: Tracks, hips: F64, by_collars: bool) -> F64:
    """Return the left direction (T, 3) of the chest: along the collar joints, else the shoulders, else the hips."""
    if not tracks.has("left_shoulder", "right_shoulder"):
        return hips
    part = "shoulder"
    if by_collars and tracks.has("left_collar", "right_collar"):
        collars, shoulders = (np.median(np.linalg.norm(tracks.across(of), axis=-1)) for of in ("collar", "shoulder"))
        part = "collar" if collars > LEAST_COLLARS * shoulders else part
    return unit(tracks.across(part))


def pitch_in(frames: F64, vectors: F64) -> F64:
    """Return the angle (T,), radians, of `vectors` (T, 3) from up towards forward, in coordinate frames (T, 3, 3)."""
    local = turned(transposed(frames), vectors)
    return np.asarray(np.arctan2(local[:, 2], local[:, 1]))


def turns_of_trunk(recorded: Trunk, rest: Trunk, stands: NDArray[np.bool_], own: bool) -> dict[str, F64]:
    """Return global rotations (T, 3, 3) of pelvis and spine, by joint name.

    `recorded`, `rest`: trunk of the recording, and of the avatar at rest.
    `stands` (T,): frames in which the person stands straight; they give the constant pitch of each part if not `own`.
    `own`: whether the recorded skeleton is built like the avatar's.
    """
    turns = {}
    for name, frames in recorded.frames.items():
        ours, offset = rest.frames[name], 0.0
        if not own and stands.any():
            offset = float(np.median(pitch_in(frames, recorded.line)[stands]) - pitch_in(ours, rest.line)[0])
        turns[name] = frames @ about(0, offset) @ ours[0].T
    return turns


def with_neck_on(line: F64, turns: dict[str, F64], rest: Tracks) -> dict[str, F64]:
    """Return `turns` with spine1 and spine2 turned once more, so that the neck is in the direction `line` (T, 3).

    `line`: vector from the pelvis, of any length. The neck is at q + R c, with R the rotation to find. c is the vector
    from the lowest joint of the spine to the highest, and q the sum of the other bones. The neck must also be at s
    times the unit vector of `line`. Therefore s is chosen so that the neck is |c| from q.
    """
    joint = {name: rest.places[name][0] for name in ("pelvis", *SPINE, "neck")}
    along = unit(line)
    c = turned(turns["spine1"], joint["spine2"] - joint["spine1"])
    c += turned(turns["spine2"], joint["spine3"] - joint["spine2"])
    q = turned(turns["pelvis"], joint["spine1"] - joint["pelvis"])
    q += turned(turns["spine3"], joint["neck"] - joint["spine3"])
    ahead = (along * q).sum(axis=-1, keepdims=True)
    beside = (q * q).sum(axis=-1, keepdims=True) - ahead**2
    reach = np.sqrt(np.maximum((c * c).sum(axis=-1, keepdims=True) - beside, 0.0))
    once_more = least_turns(c, (ahead + reach) * along - q)
    return turns | {name: once_more @ turns[name] for name in ("spine1", "spine2")}


def turns_of_collars(tracks: Tracks, rest: Tracks, chest: F64, stands: NDArray[np.bool_], own: bool) -> dict[str, F64]:
    """Return global rotations (T, 3, 3) of both collar joints, by joint name.

    `chest` (T, 3, 3): global rotations of the chest.
    `stands` (T,): frames in which the person stands straight.
    `own`: whether the recorded skeleton is built like the avatar's.

    If not `own`, both collars are corrected by one constant, symmetric rotation. After this rotation, the collars
    point, on average over `stands`, as the avatar's collars at rest. If no frame stands, the collars keep their rest
    pose in the chest.
    """
    still = {f"{side}_collar": chest for side in SIDES}
    if not tracks.has(*still, "left_shoulder", "right_shoulder") or not (own or stands.any()):
        return still
    inside = transposed(chest)
    local = {side: unit(turned(inside, tracks.bone(f"{side}_collar", f"{side}_shoulder"))) for side in SIDES}
    bones = {side: unit(rest.bone(f"{side}_collar", f"{side}_shoulder")) for side in SIDES}
    if not own:
        mirror = np.array([-1.0, 1.0, 1.0])
        middle = unit((local["left"][stands].mean(axis=0) + mirror * local["right"][stands].mean(axis=0))[None])
        back = least_turns(middle, bones["left"])[0]
        flip = np.diag(mirror)
        local = {"left": turned(back, local["left"]), "right": turned(flip @ back @ flip, local["right"])}
    return {f"{side}_collar": chest @ least_turns(bones[side], local[side]) for side in SIDES}


def with_shoulders_on(across: F64, turns: dict[str, F64], rest: Tracks) -> dict[str, F64]:
    """Return `turns` with chest and collars turned by the least angle that lays the shoulder line along `across`.

    `across` (T, 3): vector from the right to the left recorded shoulder. `turns`: global rotations (T, 3, 3), by joint
    name. `rest`: the avatar at rest.
    """
    ends = []
    for side in SIDES:
        chest, collar, shoulder = (rest.places[name][0] for name in ("spine3", f"{side}_collar", f"{side}_shoulder"))
        ends.append(turned(turns["spine3"], collar - chest) + turned(turns[f"{side}_collar"], shoulder - collar))
    once_more = least_turns(ends[0] - ends[1], across)
    return turns | {name: once_more @ turns[name] for name in ("spine3", "left_collar", "right_collar")}


def turns_of_neck(tracks: Tracks, rest: Tracks, chest: F64) -> F64:
    """Return global rotations (T, 3, 3) of the neck, which points to the recorded head, with the left of the chest.

    `chest` (T, 3, 3): global rotations of the chest, which are the result if neck or head was not recorded.
    """
    if not tracks.has("neck", "head"):
        return chest
    ours = frames_along(rest.bone("neck", "head"), np.array([[1.0, 0.0, 0.0]]), "up")
    return np.asarray(frames_along(tracks.bone("neck", "head"), chest[:, :, 0], "up") @ ours[0].T)
