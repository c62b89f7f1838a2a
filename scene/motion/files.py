"""Loads the motion of an avatar, built in or from a file, and applies what the scene says about playing it.

The suffix of a file decides which reader is used; the reader's errors name the file. A key that a format does not use
is refused, not ignored. `start_s` and `end_s` are times of the motion itself, before `speed`. A part of a motion is
placed like a whole motion: its first frame faces +Z, and the middle of the ground that it covers is the origin.

Files of NumPy hold poses, dicts of arrays, or only positions of joints. Positions, as in HumanML3D, are (T, 22, 3) in
the order of SMPL's joints. Poses may have the same shape, so the content decides. An array holds positions if its
bones, relative to the legs, are as long as a person's, alike on both sides, and rigid. Also, the hips must be on either
side of the pelvis, and the trunk must not be folded. `retarget.py` computes rotations from positions. Positions do not
determine twists. Therefore a limb twists as its bend and the toes suggest, and the head turns as the neck does.

HumanML3D: https://github.com/EricGuo5513/HumanML3D (`new_joints`: 20 frames a second, metres, Y up).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.body.joints import JOINT_NAMES, JOINT_PARENTS, JOINTS
from trilane.errors import BadInputError, did_you_mean
from trilane.files import as_numbers, npz_names, refuse_other, require_file
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.motion.bvh import UPS, among_all, feet_of, load_retargeted, unit_of
from trilane.scene.motion.motion import T_POSE, Motion, RawMotion, Wrap, centred, facing, motion_from_recording
from trilane.scene.motion.pickled import printable
from trilane.scene.motion.retarget import retarget
from trilane.scene.motion.smpl_files import KEYS, ROMP_PERSONS, ROMP_PLACES, ROMP_POSES, motion_of, motion_of_array
from trilane.scene.motion.stored import npy_values, npz_values, pickle_values, plain
from trilane.scene.motion.tracks import Tracks, leg_length
from trilane.scene.recordings import Detected
from trilane.scene.rotations import matrix_from_rotvec, rotvec_from_matrix
from trilane.scene.schema import BUILT_IN_PREFIX, AvatarSpec

RATE_HZ = 20.0
#: Joints that are read from positions; further joints, such as SMPL's hands or fingers, are ignored.
NAMES = JOINT_NAMES[:22]
COUNTS = (22, 24, 52, JOINTS)
_ENDS = np.arange(1, len(NAMES))
_STARTS = np.array(JOINT_PARENTS[1 : len(NAMES)])
#: Indices of thighs and shins among the bones.
_LEGS = [index for index, end in enumerate(_ENDS) if NAMES[end].endswith(("knee", "ankle"))]
#: Indices of the bones of the left side and, in the same order, of the right side.
_LEFT, _RIGHT = (
    [index for index, end in enumerate(_ENDS) if NAMES[end].startswith(side)] for side in ("left", "right")
)
_TRUNK = [index for index, end in enumerate(_ENDS) if "_" not in NAMES[end]]
#: Largest factor by which a bone may be longer or shorter than a plain body's, relative to the legs: for limbs, and for
#: the trunk, which skeletons divide differently.
LIKE_A_LIMB, LIKE_A_SPINE = 2.0, 4.0
#: Largest such factor against the same bone of the other side, and against the bone's median length over time.
LIKE_THE_OTHER, RIGID = 1.3, 1.25
#: Least distance between the hips, as a share of the way from hip to hip over the pelvis; least distance between pelvis
#: and neck, as a share of the way along the spine.
HIPS_APART, TRUNK_STRAIGHT = 0.45, 0.7


def places_in(array: NDArray[Any]) -> F64 | None:
    """Return the joint positions (T, 22, 3) in `array`, (T, J, 3) or (T, 3 J); None if it does not hold positions."""
    flat = array.reshape(len(array), -1) if array.ndim in (2, 3) and array.size else np.zeros((0, 0))
    if flat.shape[1] not in [3 * count for count in COUNTS] or flat.dtype.kind not in "fiu":
        return None
    places = as_numbers("", flat[:, : 3 * len(NAMES)], "numbers").reshape(len(flat), -1, 3)
    sound = _sound(places)
    return places if 2 * np.count_nonzero(sound) > len(places) else None


def _sound(places: F64) -> NDArray[np.bool_]:
    """Return a mask (T,) of the frames of `places` (T, 22, 3) that show a person, by the module docstring's rules."""
    with np.errstate(all="ignore"):
        bones = _bones(places)
        usual = np.nanmedian(bones, axis=0) if np.isfinite(bones).any(axis=0).all() else np.zeros(len(_ENDS))
        person = _bones(T_POSE[None, : len(NAMES)])[0]
        likeness = (usual / usual[_LEGS].sum()) / (person / person[_LEGS].sum())
        alike = (
            _within(np.delete(likeness, _TRUNK), LIKE_A_LIMB)
            and _within(likeness[_TRUNK], LIKE_A_SPINE)
            and _within(usual[_LEFT] / usual[_RIGHT], LIKE_THE_OTHER)
        )
        rigid = ((bones < RIGID * usual) & (bones > usual / RIGID)).all(axis=1)
        return np.asarray(alike & rigid & _upright_parts(places))


def _upright_parts(places: F64) -> NDArray[np.bool_]:
    """Return a mask (T,) of the frames of `places` with hips apart and an unfolded trunk."""
    at = {name: places[:, index] for index, name in enumerate(NAMES)}

    def way(*names: str) -> F64:
        return np.asarray(sum(np.linalg.norm(at[b] - at[a], axis=-1) for a, b in itertools.pairwise(names)))

    hips = way("left_hip", "right_hip") > HIPS_APART * way("left_hip", "pelvis", "right_hip")
    trunk = way("pelvis", "neck") > TRUNK_STRAIGHT * way("pelvis", "spine1", "spine2", "spine3", "neck")
    return np.asarray(hips & trunk)


def _within(ratios: F64, times: float) -> bool:
    """Return whether all `ratios` are between 1 / `times` and `times`, a factor of 1 or more."""
    return bool(((ratios < times) & (ratios > 1 / times)).all())


def _bones(places: F64) -> F64:
    """Return the lengths (T, 21) of the bones between joint positions (T, 22, 3)."""
    return np.asarray(np.linalg.norm(places[:, _ENDS] - places[:, _STARTS], axis=-1))


def motion_of_places(source: str, places: F64, units: str, rest: F64) -> RawMotion:
    """Return the motion of joints with the positions `places` (T, 22, 3), as `places_in` found them.

    `source`: suffix of the file, for people.
    `units`: a key of UNITS_M, or `auto`.
    `rest` (55, 3): rest joints of the avatar, metres.
    """
    sound = _sound(places)
    tracks = Tracks({name: places[sound, index] for index, name in enumerate(NAMES)})
    unit, unit_m = unit_of(leg_length(tracks), units)
    leg_m = leg_length(tracks) * unit_m
    poses, pelvis, how = retarget(tracks, rest)
    rate = f"{RATE_HZ:g} frames/s, as HumanML3D has them"
    notes = (
        f"places of 22 joints {source}, as of HumanML3D, {len(places)} frames, {rate}: their distances are a person's",
        f"units: {unit} (leg of {leg_m:.2f} m)",
        "turns are made from the places; how limbs twist follows from their bend, the head follows the neck",
        *how,
        "betas: none in the format",
    )
    detected = Detected(
        f"places of joints ({source})", "distances between joints are a person's, and stay so", unit=unit, rate=rate
    )
    poses, pelvis, feet = (among_all(values, sound) for values in (poses, pelvis * unit_m, feet_of(tracks) * unit_m))
    times = np.arange(len(places)) / RATE_HZ
    return RawMotion(times, poses, pelvis, None, "y", notes, leg_m, detected, UPS, feet)


EXPECTED = "a motion: arrays of axis-angle poses of SMPL, SMPL-H or SMPL-X"
#: Name that NumPy gives to an array that is saved without a name.
NAMELESS = "arr_0"
NPZ_KEYS = (*KEYS, ROMP_POSES, ROMP_PLACES, ROMP_PERSONS, NAMELESS)
MOST_NAMED = 12


def load_npy(path: Path, units: str = "auto", rest: F64 = T_POSE) -> RawMotion:
    """Read a `.npy` file. Raises BadInputError.

    `units`: unit of joint positions, a key of UNITS_M or `auto`.
    `rest` (55, 3): rest joints of the avatar, metres.
    """
    values = plain(npy_values(path, EXPECTED))
    places = places_in(values) if isinstance(values, np.ndarray) else None
    if places is not None:
        return motion_of_places(path.suffix.lower(), places, units, rest)
    return _motion(path, values)


def load_npz(path: Path) -> RawMotion:
    """Read an `.npz` file of the SMPL family. Raises BadInputError."""
    values = npz_values(path, NPZ_KEYS, EXPECTED)
    names = [printable(name) for name in npz_names(path, EXPECTED)]
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    nameless = names == [NAMELESS]
    return _motion(path, values[NAMELESS] if nameless else values, f"arrays {', '.join(names[:MOST_NAMED])}{more}")


def load_pickle(path: Path) -> RawMotion:
    """Read a pickle without executing anything in it. Raises BadInputError."""
    return _motion(path, pickle_values(path, EXPECTED))


def _motion(path: Path, values: Any, there: str = "") -> RawMotion:
    source = path.suffix.lower()
    array = plain(values)
    if isinstance(array, np.ndarray):
        return motion_of_array(str(path), source, array)
    return motion_of(str(path), source, array, there)


WRAPS = {"repeat": Wrap.LOOP, "back-and-forth": Wrap.BOUNCE, "hold": Wrap.HOLD}
#: A note mentions a jump of the body at a repeat if it is longer than this, metres.
JUMP_M = 0.05


def as_played(motion: Motion, spec: AvatarSpec, where: str) -> Motion:
    """Return `motion` as `spec` plays it, with notes on what was changed and on what follows the last frame.

    `where`: name of the motion, for messages. Raises BadInputError when the motion is shorter than `spec` requires.
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
    """Return the part of `motion` from `start_s` to `end_s`, with times from 0."""
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
    """Return `motion`, turned to face +Z in its first frame, with the middle of the covered ground at the origin."""
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
#: Suffixes of files whose joints have names.
NAMED = (".bvh",)


def load_motion(spec: AvatarSpec, base: Path, rest: F64 = T_POSE) -> Motion:
    """Load the motion that `spec.motion` names, as `spec` plays it.

    `base`: folder at which a relative path starts.
    `rest` (55, 3): rest joints of the avatar that performs the motion, metres; by default a plain body's.
    Raises BadInputError when there is no such motion, or when the file is unusable.
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
    expected = f"a motion file: {', '.join(_READERS)}"
    try:
        require_file(path, expected)
        refuse_other(path, expected)
    except BadInputError as error:
        return error
    return BadInputError(path, f"the ending {path.suffix!r}", expected)


def _check_named(spec: AvatarSpec, motion: str | Path) -> None:
    """Raise BadInputError if `spec` has a `joint_map`, but the joints in the file `motion` have no names."""
    if spec.joint_map and Path(motion).suffix.lower() not in NAMED:
        raise BadInputError(motion, "joint_map", f"none: only joints of {', '.join(NAMED)} files have names")
