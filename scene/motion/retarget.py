"""Retargeting: computes poses of an avatar's 55 SMPL-X joints from recorded joints.

Rotations are computed from positions. Limbs point where the recorded limbs point. Pelvis and trunk turn as the recorded
hip line, trunk and shoulder line turn. The file's own rotations only determine how limbs twist (`tracks.py`), and how
head and toes turn. Therefore neither a file's zero pose nor its axes matter. A joint that the file does not have
follows its parent.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINT_INDEX, JOINT_NAMES, JOINT_PARENTS, JOINTS
from trilane.scene.motion.tracks import (
    SIDES,
    Evidence,
    Tracks,
    angle_between,
    at_rest,
    built_alike,
    hinge,
    leg_length,
    level_with,
    limb_turns,
    planted_frames,
    standing_frames,
    swung,
    transposed,
    trunk_line,
    trunk_of,
    turned,
    turns_of_collars,
    turns_of_neck,
    turns_of_trunk,
    unit,
    upward,
    with_neck_on,
    with_shoulders_on,
)
from trilane.scene.rotations import rotvec_from_matrix

UP, LEFT, FORWARD = (np.eye(3)[k] for k in (1, 0, 2))
FINGERS = ("index", "middle", "pinky", "ring", "thumb")
#: Finger joints to which a hand points: the first of these that the file has. Without any, the hand points to the end
#: of its bone.
HAND_ENDS = ("middle1", "index1", "ring1", "pinky1")
#: Weights of evidence for a twist, against the bend of a limb: the toes' direction, and the least twist from the
#: parent.
OF_TOES, OF_LEAST_TWIST = 0.5, 0.02
#: A planted foot is laid flat if its slope differs from the avatar's by this or more, radians; otherwise it is laid
#: along its recorded bone.
SAME_SLOPE = np.radians(8.0)
#: Distance of the heel behind the ankle, as a share of the bone from the ankle to the toes; as in the built-in walker.
HEEL_BEHIND = 0.057 / np.hypot(0.062, 0.146)
#: Largest difference in slope, radians, between a program's feet and the avatar's; beyond it, the heels are raised
#: throughout.
MOST_STEEPER = np.radians(27.0)


@dataclass
class Retarget:
    """The rotations of one recording on one avatar, filled in from the pelvis outwards.

    `tracks`: the recording.
    `rest`: joints of the avatar at rest.
    `stands` (T,): whether the person stands in each frame.
    `own`: whether the recorded skeleton is built like the avatar's.
    `turns`: global rotations (T, 3, 3) of each joint that is computed so far, by name.
    `notes`: notes for people.
    """

    tracks: Tracks
    rest: Tracks
    stands: NDArray[np.bool_]
    own: bool
    turns: dict[str, F64] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def bone(self, start: str, end: str) -> F64:
        """Return the unit vector (3,) from joint `start` to joint `end` of the avatar at rest."""
        return unit(self.rest.bone(start, end)[0])

    def above(self, name: str) -> F64:
        """Return the global rotations (T, 3, 3) of the parent of joint `name`."""
        return self.turns[JOINT_NAMES[JOINT_PARENTS[JOINT_INDEX[name]]]]

    def lay(self, name: str, bone: F64, recorded: F64, evidence: list[Evidence]) -> None:
        """Set the rotations of joint `name` such that its `bone` (3,) points along `recorded` (T, 3).

        `evidence`: evidence for the twist about the bone.
        """
        swing = swung(self.above(name), bone, recorded)
        side = UP if abs(bone[1]) < 0.7 else FORWARD
        weight = OF_LEAST_TWIST * (1 + (unit(recorded) * turned(self.above(name), bone)).sum(axis=-1))
        least = (side, turned(swing, side) * weight[:, None])
        carrier = self.tracks.turns.get(name, swing)
        self.turns[name] = limb_turns(bone, recorded, carrier, [*evidence, least])


def retarget(tracks: Tracks, joints: F64) -> tuple[F64, F64, tuple[str, ...]]:
    """Return (poses (T, 55, 3), axis-angle; positions (T, 3) of the pelvis; notes for people).

    The positions have the unit of the recording, and fit an avatar whose legs are as long as the recorded ones.
    `tracks`: the recording, in any unit. It must have pelvis, hips, knees and ankles, with the hips apart.
    `joints` (55, 3): rest joints of the avatar, metres.
    """
    rest = at_rest(joints)
    line = trunk_line(tracks)
    trunk = line.along(tracks)
    stands = standing_frames(tracks, trunk)
    work = Retarget(tracks, rest, stands, built_alike(tracks, rest))
    shares, by_collars = line.shares(rest), work.own or bool(stands.any())  # otherwise the collars stay as at rest
    recorded, ours = (trunk_of(joints_of, line, shares, by_collars) for joints_of in (tracks, rest))
    spine = turns_of_trunk(recorded, ours, stands, work.own)
    upper = spine | turns_of_collars(tracks, rest, spine["spine3"], stands, work.own)
    if tracks.has("left_shoulder", "right_shoulder"):
        upper = with_shoulders_on(tracks.across("shoulder"), upper, rest)
    work.turns.update(with_neck_on(trunk, upper, rest) if line.top == "neck" else upper)
    work.turns["neck"] = turns_of_neck(tracks, rest, work.turns["spine3"])
    for side in SIDES:
        _leg(work, side)
        _arm(work, side)
    _feet(work, upward(tracks, trunk, stands))
    _head(work)
    from_hips = joints[0] - rest.between("hip")[0]
    places = tracks.between("hip") + turned(work.turns["pelvis"], from_hips * _scale(work))
    return _local(work.turns, tracks.frames), places, (*_notes(work), *work.notes)


def _leg(work: Retarget, side: str) -> None:
    hip, knee, ankle, toes = (f"{side}_{part}" for part in ("hip", "knee", "ankle", "foot"))
    tracks = work.tracks
    thigh, shin = tracks.bone(hip, knee), tracks.bone(knee, ankle)
    foot = _foot(tracks, side)
    bend = (LEFT, hinge(thigh, shin))
    of_thigh, of_shin = [bend], [bend]
    if foot is not None:
        straight = np.cos(np.minimum(angle_between(thigh, shin), np.pi / 2))[:, None]
        of_thigh.append((work.bone(ankle, toes), unit(foot) * straight * OF_TOES))
        of_shin.append((work.bone(ankle, toes), unit(foot) * OF_TOES))
    work.lay(hip, work.bone(hip, knee), thigh, of_thigh)
    work.lay(knee, work.bone(knee, ankle), shin, of_shin)


def _feet(work: Retarget, up: F64) -> None:
    """Set the rotations of the feet in `work`: along the recorded feet, but with toes and heels above the floor."""
    tracks = work.tracks
    feet = [foot for side in SIDES if (foot := _recorded_foot(work, side, up)) is not None]
    planted = [foot for foot in feet if foot.planted.any()]
    steeper, flat_by = _steeper(work, planted)
    floor = min((float(np.median(foot.height[foot.planted])) for foot in planted), default=0.0)
    for side in SIDES:
        work.turns[f"{side}_ankle"] = work.turns[f"{side}_foot"] = work.turns[f"{side}_knee"]
    for foot in feet:
        ankle, toes = f"{foot.side}_ankle", f"{foot.side}_foot"
        shin = tracks.bone(f"{foot.side}_knee", ankle)
        upright = (work.bone(ankle, f"{foot.side}_knee"), -unit(shin) * OF_LEAST_TWIST)
        level = [upright, (UP, foot.planted[:, None] * up)]
        work.lay(ankle, work.bone(ankle, toes), foot.above(floor, steeper, flat_by, up), level)
        work.turns[toes] = _levelled(work, toes, work.turns[ankle])


@dataclass(frozen=True)
class _RecordedFoot:
    """A recorded foot on the avatar.

    `side`: `left` or `right`.
    `way` (T, 3): vector from the ankle to the toes in the recording.
    `falls` (T,): slope of that vector, radians below the horizontal.
    `planted` (T,): whether the foot most likely lies flat on the floor.
    `height` (T,): height of the avatar's ankle, metres, from any zero.
    `ours`, `length`: slope of the avatar's own bone at rest, radians below the horizontal, and its length, metres.
    """

    side: str
    way: F64
    falls: F64
    planted: NDArray[np.bool_]
    height: F64
    ours: float
    length: float

    def above(self, floor: float, steeper: float, flat_by: float, up: F64) -> F64:
        """Return the vector (T, 3) from ankle to toes, turned where toes or heel would be below the floor.

        `floor`: height of the ankle of a planted foot, metres. `steeper`, `flat_by`: result of `_steeper`; if `steeper`
        is 0, nothing is turned. A foot that lies flat has the slope `ours` + `flat_by`. If `steeper` is above 0, this
        slope limits how far toes may point down. If the ankle is higher by r, the limit's sine is larger by r /
        `length`, which puts the toes on the floor. If `steeper` is below 0, a limit in the other direction does the
        same for the heel, which turns about the ankle.
        """
        if not steeper:
            return self.way
        flat = self.ours + flat_by
        rise = np.maximum(self.height - floor, 0.0) / self.length
        if steeper > 0:
            falls = np.minimum(self.falls, np.arcsin(np.minimum(np.sin(flat) + rise, 1.0)))
        else:
            falls = np.maximum(self.falls, flat - np.arcsin(np.minimum(rise / HEEL_BEHIND, 1.0)))
        level = unit(self.way - (self.way @ up)[:, None] * up)
        return np.asarray(np.cos(falls)[:, None] * level - np.sin(falls)[:, None] * up)


def _recorded_foot(work: Retarget, side: str, up: F64) -> _RecordedFoot | None:
    """Return the recorded foot of a leg whose thigh and shin have rotations; None if its direction is unknown."""
    way = _foot(work.tracks, side)
    if way is None:
        return None
    ours = work.rest.bone(f"{side}_ankle", f"{side}_foot")[0]
    return _RecordedFoot(
        side,
        way,
        angle_between(way, up) - np.pi / 2,
        planted_frames(work.tracks, side, way, up),
        _ankle(work, side) @ up,
        float(angle_between(ours, UP)) - np.pi / 2,
        float(np.linalg.norm(ours)),
    )


def _ankle(work: Retarget, side: str) -> F64:
    """Return positions (T, 3) of the avatar's ankle, metres, from the origin of the recording."""
    rest, hip, knee, ankle = work.rest, *(f"{side}_{part}" for part in ("hip", "knee", "ankle"))
    from_middle = rest.places[hip][0] - rest.between("hip")[0]
    legs = turned(work.turns[hip], rest.bone(hip, knee)[0]) + turned(work.turns[knee], rest.bone(knee, ankle)[0])
    return np.asarray(work.tracks.between("hip") / _scale(work) + turned(work.turns["pelvis"], from_middle) + legs)


def _foot(tracks: Tracks, side: str) -> F64 | None:
    """Return the vector (T, 3) from the ankle to the toes, or else to the end of the foot's bone.

    The result is None if the file has neither toes nor that end, or if the vector is 0 in any frame.
    """
    ankle, toes = f"{side}_ankle", f"{side}_foot"
    end = tracks.places.get(toes, tracks.tips.get(ankle))
    if end is None:
        return None
    foot = end - tracks.places[ankle]
    return foot if np.linalg.norm(foot, axis=-1).min() > 0 else None


def _steeper(work: Retarget, planted: Sequence[_RecordedFoot]) -> tuple[float, float]:
    """Return (how much steeper recorded feet are than the avatar's, how much more a flat foot slopes), radians.

    The first number is the difference of the slopes, cut off at MOST_STEEPER either way. The second is the part that is
    cut off. Both are 0 if the slopes are nearly equal.

    `planted`: feet that lie flat in some frames. The flatter of both feet counts, as the other foot may be on its toes.
    """
    found = min((float(np.median(foot.falls[foot.planted]) - foot.ours) for foot in planted), default=0.0)
    steeper = float(np.clip(found, -MOST_STEEPER, MOST_STEEPER))
    if work.own or abs(steeper) < SAME_SLOPE:
        return 0.0, 0.0
    word = "steeper" if steeper > 0 else "flatter"
    work.notes.append(
        f"feet: {abs(np.degrees(steeper)):.0f}° {word} than the avatar's where they are planted, so they are laid flat "
        "there, and elsewhere as recorded, as far as toes and heels stay above the floor"
    )
    return steeper, found - steeper


def _levelled(work: Retarget, name: str, base: F64) -> F64:
    """Return the file's rotations (T, 3, 3) of joint `name` after one constant rotation; `base` if the file has none.

    The constant makes their mean equal to the mean of `base` (T, 3, 3). Means are over frames that stand, or over all
    frames if none stands.
    """
    turns = work.tracks.turns.get(name)
    if turns is None:
        return base
    where = work.stands if work.stands.any() else np.ones(len(base), dtype=bool)
    return level_with(turns, base, where)


def _arm(work: Retarget, side: str) -> None:
    shoulder, elbow, wrist = (f"{side}_{part}" for part in ("shoulder", "elbow", "wrist"))
    tracks = work.tracks
    bones = {}
    for start, end in ((shoulder, elbow), (elbow, wrist)):
        far = tracks.places.get(end, tracks.tips.get(start))
        if far is not None and tracks.has(start):
            bones[start, end] = far - tracks.places[start]
    bend: list[Evidence] = []
    if len(bones) == 2:
        bend = [(-UP if side == "left" else UP, hinge(*bones.values()))]
    for pair in ((shoulder, elbow), (elbow, wrist)):
        if pair in bones:
            work.lay(pair[0], work.bone(*pair), bones[pair], bend)
        else:
            work.turns[pair[0]] = work.above(pair[0])
    _hand(work, side)


def _hand(work: Retarget, side: str) -> None:
    wrist = f"{side}_wrist"
    tracks = work.tracks
    ends = [f"{side}_{end}" for end in HAND_ENDS if tracks.has(wrist, f"{side}_{end}")]
    if ends:
        work.lay(wrist, work.bone(wrist, ends[0]), tracks.bone(wrist, ends[0]), _palm(work, side))
    elif tracks.has(wrist) and wrist in tracks.tips:
        recorded = tracks.tips[wrist] - tracks.places[wrist]
        work.lay(wrist, work.bone(wrist, f"{side}_middle1"), recorded, _palm(work, side))
    else:
        work.turns[wrist] = work.above(wrist)
    for finger, part in itertools.product(FINGERS, (1, 2, 3)):
        name, end = f"{side}_{finger}{part}", f"{side}_{finger}{part + 1}"
        if part < 3 and tracks.has(name, end):
            work.turns[name] = swung(work.above(name), work.bone(name, end), tracks.bone(name, end))
        else:
            work.turns[name] = work.above(name)


def _palm(work: Retarget, side: str) -> list[Evidence]:
    """Return evidence for a hand's twist: the vector from little finger to index finger, else from wrist to thumb."""
    for start, end in (("pinky1", "index1"), ("wrist", "thumb1")):
        names = f"{side}_{start}", f"{side}_{end}"
        if work.tracks.has(*names):
            return [(work.bone(*names), unit(work.tracks.bone(*names)))]
    return []


def _head(work: Retarget) -> None:
    work.turns["head"] = _levelled(work, "head", work.turns["spine3"])
    for name in ("jaw", "left_eye", "right_eye"):
        work.turns[name] = work.turns["head"]


def _local(turns: dict[str, F64], frames: int) -> F64:
    """Return the rotation of each joint relative to its parent, axis-angle (T, 55, 3), from global ones (T, 3, 3)."""
    poses = np.zeros((frames, JOINTS, 3))
    for index, name in enumerate(JOINT_NAMES):
        above = turns[JOINT_NAMES[JOINT_PARENTS[index]]] if index else np.eye(3)
        poses[:, index] = rotvec_from_matrix(transposed(above) @ turns[name])
    return poses


def _scale(work: Retarget) -> float:
    """Return the length of the recorded leg, in the recording's unit, over the length of the avatar's leg in metres."""
    return leg_length(work.tracks) / leg_length(work.rest)


def _notes(work: Retarget) -> list[str]:
    count = int(work.stands.sum())
    if work.own:
        trunk = "skeleton: built like the avatar's"
    elif count:
        trunk = (
            "skeleton: not built like the avatar's; how trunk and shoulders stand at rest comes from the straightest "
            f"legs, {count} of {work.tracks.frames} frames"
        )
    else:
        trunk = (
            "skeleton: not built like the avatar's, and no frame has straight legs; the pitch of pelvis, trunk and "
            "head may be some 15° off"
        )
    head = (
        "head: as the file turns it, straight ahead on average" if "head" in work.tracks.turns else "head: as the neck"
    )
    return [trunk, head, *_backwards(work)]


def _backwards(work: Retarget) -> list[str]:
    """Return a note if the feet point backwards; the skeleton's left and right define the front."""
    feet = [foot for foot in (_foot(work.tracks, side) for side in SIDES) if foot is not None]
    ahead = [np.median(turned(transposed(work.turns["pelvis"]), unit(foot))[:, 2]) for foot in feet]
    if not ahead or max(ahead) > -0.3:
        return []
    return ["feet point backwards: the file's left and right are exchanged, or it is a mirror image"]
