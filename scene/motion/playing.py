"""How much of a motion is played, how fast, and what follows: `start_s`, `end_s`, `speed` and `loop` of an avatar.

Rule: `start_s` and `end_s` are times of the motion itself, before `speed`. A part of a motion stands as a whole one
does: it faces +Z at first and is centred on the ground that it covers.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trilane.errors import BadInputError
from trilane.scene.motion.motion import Motion, Wrap
from trilane.scene.motion.recorded import centred, facing
from trilane.scene.rotations import matrix_from_rotvec, rotvec_from_matrix
from trilane.scene.schema import AvatarSpec

WRAPS = {"repeat": Wrap.LOOP, "back-and-forth": Wrap.BOUNCE, "hold": Wrap.HOLD}
#: A repeat that moves the body by more than this is said, metres.
JUMP_M = 0.05


def as_played(motion: Motion, spec: AvatarSpec, where: str) -> Motion:
    """`motion` as `spec` plays it; notes say what was changed and what follows the last frame.

    `where`: names the motion in messages. Raises BadInputError when it is shorter than `spec` takes it to be.
    """
    played = replace(motion, wrap=WRAPS.get(spec.loop, motion.wrap))
    changes = []
    if spec.start_s or spec.end_s is not None:
        end_s = motion.duration_s if spec.end_s is None else spec.end_s
        _check_length(motion, spec.start_s, end_s, where)
        played = _standing_alone(_part(played, spec.start_s, end_s))
        changes.append(f"from {spec.start_s:g} s to {end_s:g} s of {motion.duration_s:.2f} s")
    if spec.speed != 1:
        played = replace(played, times_s=played.times_s / spec.speed)
        changes.append(f"at {spec.speed:g} times its speed")
    said = (f"plays {', '.join(changes)}",) if changes else ()
    return replace(played, notes=(*motion.notes, *said, *_end_notes(played)))


def _check_length(motion: Motion, start_s: float, end_s: float, where: str) -> None:
    length_s = motion.duration_s
    if end_s > length_s:
        raise BadInputError(f"{where}: end_s", f"{end_s:g}", f"at most the motion's length, {length_s:.4g} s")
    if start_s >= end_s:
        raise BadInputError(f"{where}: start_s", f"{start_s:g}", f"less than the motion's length, {length_s:.4g} s")


def _part(motion: Motion, start_s: float, end_s: float) -> Motion:
    """What `motion` does between two of its times, which become 0 and its length."""
    inside = (motion.times_s > start_s) & (motion.times_s < end_s)
    ends = replace(motion, wrap=Wrap.HOLD)
    (first, here), (last, there) = ends.sample(start_s), ends.sample(end_s)
    times_s = np.concatenate([[start_s], motion.times_s[inside], [end_s]])
    return replace(
        motion,
        times_s=times_s - start_s,
        stance=None if motion.stance is None else np.interp(times_s, motion.times_s, motion.stance),
        poses=np.concatenate([first[None], motion.poses[inside], last[None]]),
        translation=np.concatenate([here[None], motion.translation[inside], there[None]]),
    )


def _standing_alone(motion: Motion) -> Motion:
    """`motion`, turned to face +Z in its first frame, in the middle of its ground."""
    roots = matrix_from_rotvec(motion.poses[:, 0])
    turn = facing(roots[0])
    poses = motion.poses.copy()
    poses[:, 0] = rotvec_from_matrix(turn @ roots)
    return replace(motion, poses=poses, translation=centred(motion.translation @ turn.T))


def _end_notes(motion: Motion) -> tuple[str, ...]:
    if len(motion.times_s) == 1:
        return ("one frame: held",)
    follows = f"{motion.duration_s:.2f} s, then {motion.wrap.value}"
    jump_m = float(np.linalg.norm(motion.translation[-1] - motion.translation[0]))
    if motion.wrap is Wrap.LOOP and jump_m > JUMP_M:
        return (f"{follows}: the first frame is {jump_m:.2f} m from the last",)
    return (follows,)
