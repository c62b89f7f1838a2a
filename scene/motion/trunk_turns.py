"""Turns of pelvis, spine, neck and shoulders from places: hip line, line of the trunk, shoulder line.

Rule: the same frames are built in the recording and in the avatar's rest pose, and a joint's turn takes one to the
other. Programs put the joints of the trunk at different depths in the body, so in a skeleton that is not built like the
avatar's the constant pitch of each frame is that of the frames in which the person stands straight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.scene.motion.frame_turns import frames_along, least_turns, transposed, turned
from trilane.scene.motion.tracks import SIDES, Tracks, unit
from trilane.scene.rotations import about

SPINE = ("spine1", "spine2", "spine3")
#: What the line of the trunk ends at: the first that the recording has.
TOPS = ("neck", "shoulder", "head", "spine3")
#: Collar joints are told from the spine when they are this far apart, as a share of the shoulders.
LEAST_COLLARS = 0.1
#: How far each part of the spine has turned from the hips' left to the shoulders' left.
TWIST = {"pelvis": 0.0, "spine1": 1 / 3, "spine2": 2 / 3, "spine3": 1.0}


@dataclass(frozen=True)
class TrunkLine:
    """The line of the trunk. `top`: of TOPS, or `knee` for a recording without trunk, which is seen from the hips."""

    top: str

    def end(self, tracks: Tracks) -> F64:
        """Its upper end (T, 3)."""
        if self.top == "shoulder":
            return tracks.between("shoulder")
        if self.top == "knee":
            return 2 * tracks.between("hip") - tracks.between("knee")
        return tracks.places[self.top]

    def along(self, tracks: Tracks) -> F64:
        """From the pelvis to its upper end, (T, 3)."""
        return self.end(tracks) - tracks.places["pelvis"]

    def points(self, tracks: Tracks) -> F64:
        """The middle of the hips, the joints of the spine that the recording has, the upper end: (n, T, 3)."""
        inner = [tracks.places[name] for name in self.inner if name in tracks.places]
        return np.stack([tracks.between("hip"), *inner, self.end(tracks)])

    @property
    def inner(self) -> tuple[str, ...]:
        """The joints of the spine that may lie between its ends."""
        return {"knee": (), "spine3": SPINE[:2]}.get(self.top, SPINE)

    def shares(self, rest: Tracks) -> F64:
        """How far along it (3,) the spine's joints are in an avatar; 1 for those at its end and above."""
        inner = line_shares(self.points(rest))[1:-1, 0]
        return np.append(inner, np.ones(len(SPINE) - len(inner)))


def trunk_line(tracks: Tracks) -> TrunkLine:
    """The line of the trunk that the joints of `tracks` allow."""
    for top in TOPS:
        names = [f"{side}_{top}" for side in SIDES] if top == "shoulder" else [top]
        if tracks.has(*names):
            return TrunkLine(top)
    return TrunkLine("knee")


def line_shares(points: F64) -> F64:
    """How far along a line (n, T, 3) each of its points lies: 0 at its beginning, 1 at its end, (n, T)."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    reached = np.concatenate([np.zeros((1, points.shape[1])), np.cumsum(steps, axis=0)])
    return np.asarray(reached / np.where(reached[-1] > 0, reached[-1], 1.0))


def points_at(points: F64, shares: F64) -> F64:
    """The points (m, T, 3) of a line (n, T, 3) at constant `shares` (m,) of its length."""
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
    """Frames over time of a trunk, before they are laid on the avatar's.

    `frames`: joint -> (T, 3, 3), left, up and forward as columns. `line`: (T, 3).
    """

    frames: dict[str, F64]
    line: F64


def trunk_of(tracks: Tracks, line: TrunkLine, shares: F64, by_collars: bool) -> Trunk:
    """The frames of pelvis and spine, with the joints of the spine at `shares` (3,) of the line.

    `by_collars`: whether the chest turns with its collar joints, where they are apart, or with the shoulders.
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
    """The left (T, 3) of the chest: along the collar joints if they are apart, else along the shoulders."""
    if not tracks.has("left_shoulder", "right_shoulder"):
        return hips
    shoulders = tracks.across("shoulder")
    if by_collars and collars_apart(tracks):
        return unit(tracks.across("collar"))
    return unit(shoulders)


def collars_apart(tracks: Tracks) -> bool:
    """Whether the recording has collar joints that stand beside the spine, not in it."""
    if not tracks.has("left_collar", "right_collar", "left_shoulder", "right_shoulder"):
        return False
    widths = [np.median(np.linalg.norm(tracks.across(part), axis=-1)) for part in ("collar", "shoulder")]
    return bool(widths[0] > LEAST_COLLARS * widths[1])


def pitch_in(frames: F64, vectors: F64) -> F64:
    """Angle (T,) of vectors (T, 3) from up to forward, in frames (T, 3, 3); radians."""
    local = turned(transposed(frames), vectors)
    return np.asarray(np.arctan2(local[:, 2], local[:, 1]))


def turns_of_trunk(recorded: Trunk, rest: Trunk, stands: NDArray[np.bool_], own: bool) -> dict[str, F64]:
    """Global turns (T, 3, 3) of pelvis and spine.

    `recorded`, `rest`: of the recording, and of the avatar. `stands` (T,): the frames in which the person stands
    straight, from which the pitch of each part is taken unless `own`, for a skeleton that is built like the avatar's.
    """
    turns = {}
    for name, frames in recorded.frames.items():
        ours = rest.frames[name]
        offset = 0.0
        if not own and stands.any():
            offset = float(np.median(pitch_in(frames, recorded.line)[stands]) - pitch_in(ours, rest.line)[0])
        turns[name] = frames @ about(0, offset) @ ours[0].T
    return turns


def with_neck_on(line: F64, turns: dict[str, F64], rest: Tracks) -> dict[str, F64]:
    """Turns of the spine, of which the lower two are turned once more, so that the neck lies along `line` (T, 3).

    `line`: from the pelvis, of any length. The neck is at q + R c, where R is the turn looked for, c from the lowest
    joint of the spine to the highest, and q the rest of the way; so it is at s times the direction of `line` for the s
    at which q is |c| from it.
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
    """Global turns (T, 3, 3) of both collar joints: from where they point in the chest, whose turns are `chest`.

    With `own` false they point, on average over the frames that stand, as the avatar's do at rest, the same on both
    sides; when none stands, they stay as at rest in the chest.
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
    """Turns of chest and collars, turned once more by the least turn that lays the shoulders along `across` (T, 3)."""
    ends = []
    for side in SIDES:
        chest, collar, shoulder = (rest.places[name][0] for name in ("spine3", f"{side}_collar", f"{side}_shoulder"))
        ends.append(turned(turns["spine3"], collar - chest) + turned(turns[f"{side}_collar"], shoulder - collar))
    once_more = least_turns(ends[0] - ends[1], across)
    return turns | {name: once_more @ turns[name] for name in ("spine3", "left_collar", "right_collar")}


def turns_of_neck(tracks: Tracks, rest: Tracks, chest: F64) -> F64:
    """Global turns (T, 3, 3) of the neck: it points to the head as recorded; its left is the chest's."""
    if not tracks.has("neck", "head"):
        return chest
    left = chest[:, :, 0]
    ours = frames_along(rest.bone("neck", "head"), np.array([[1.0, 0.0, 0.0]]), "up")
    return np.asarray(frames_along(tracks.bone("neck", "head"), left, "up") @ ours[0].T)
