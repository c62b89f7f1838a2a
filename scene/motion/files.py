"""Loads the motion of a scene's avatar, a built-in one by name or a file, and plays the part that the scene asks for.

The ending of the file decides which reader is used; the reader's errors name the file. A key that a format has no use
for is refused, not ignored. `start_s` and `end_s` are times of the motion itself, before `speed`. A part of a motion is
placed as a whole one: it faces +Z at first and is centred on the ground that it covers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from trilane.arrays import F64
from trilane.errors import BadInputError, did_you_mean
from trilane.files import refuse_other, require_file
from trilane.scene.motion.array_files import load_npy, load_npz, load_pickle
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.motion.bvh import load_retargeted
from trilane.scene.motion.motion import T_POSE, Motion, Wrap
from trilane.scene.motion.recorded import RawMotion, centred, facing, motion_from_recording
from trilane.scene.rotations import matrix_from_rotvec, rotvec_from_matrix
from trilane.scene.schema import BUILT_IN_PREFIX, AvatarSpec

WRAPS = {"repeat": Wrap.LOOP, "back-and-forth": Wrap.BOUNCE, "hold": Wrap.HOLD}
#: Least move of the body at a repeat that a note mentions, metres.
JUMP_M = 0.05


def as_played(motion: Motion, spec: AvatarSpec, where: str) -> Motion:
    """Return `motion` as `spec` plays it; notes say what was changed and what follows the last frame.

    `where`: name of the motion in messages. Raises BadInputError when it is shorter than `spec` requires.
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
    """Return the part of `motion` between two of its times, which become 0 and its length."""
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
    """Turn `motion` to face +Z in its first frame, and move it to the middle of its ground."""
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


_READERS: dict[str, Callable[[Path, AvatarSpec, F64], RawMotion]] = {
    ".npy": lambda path, spec, rest: load_npy(path, spec.units, rest),
    ".npz": lambda path, _spec, _rest: load_npz(path),
    ".pkl": lambda path, _spec, _rest: load_pickle(path),
    ".pickle": lambda path, _spec, _rest: load_pickle(path),
    ".bvh": lambda path, spec, rest: load_retargeted(path, spec.units, spec.joint_map, rest),
}
#: Endings of files whose joints have names.
NAMED = (".bvh",)


def load_motion(spec: AvatarSpec, base: Path, rest: F64 = T_POSE) -> Motion:
    """Load the motion that `spec.motion` names, as `spec` plays it; a relative path starts at `base`.

    `rest` (55, 3): rest joints of the avatar that does it, metres; those of a plain body when there is none. Raises
    BadInputError when there is no such motion or the file is unusable.
    """
    if spec.motion.startswith(BUILT_IN_PREFIX):
        name, names = spec.motion.removeprefix(BUILT_IN_PREFIX), ", ".join(BUILTIN)
        make = BUILTIN.get(name)
        if make is None:
            near = did_you_mean(name, BUILTIN, BUILT_IN_PREFIX)
            raise BadInputError("motion", repr(spec.motion), f"{BUILT_IN_PREFIX}{{{names}}} or a file", near)
        _check_named(spec, spec.motion)
        return as_played(make(), spec, spec.motion)
    path = base / spec.motion
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise _of_no_reader(path)
    _check_named(spec, path)
    require_file(path, "a motion file")
    with np.errstate(over="ignore", invalid="ignore"):  # `usable_samples` leaves out what is not finite
        motion = motion_from_recording(reader(path, spec, rest), str(path), spec.up_axis)
    return as_played(motion, spec, str(path))


def _of_no_reader(path: Path) -> BadInputError:
    """Return the error for a file that has the ending of no motion."""
    expected = f"a motion file: {', '.join(_READERS)}"
    try:
        require_file(path, expected)
        refuse_other(path, expected)
    except BadInputError as error:
        return error
    return BadInputError(path, f"the ending {path.suffix!r}", expected)


def _check_named(spec: AvatarSpec, motion: str | Path) -> None:
    """Raise BadInputError when `spec` maps joints of a `motion` that has no names."""
    if spec.joint_map and Path(motion).suffix.lower() not in NAMED:
        raise BadInputError(motion, "joint_map", f"none: only joints of {', '.join(NAMED)} files have names")
