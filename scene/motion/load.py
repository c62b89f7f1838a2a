"""Loads the motion of a scene's avatar: a built-in one by name, or a file.

Rule: the ending of the file decides which reader is used; the reader's errors name the file. A key that a format has
no use for is refused, not ignored.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from trilane.arrays import F64
from trilane.errors import BadInputError
from trilane.files import refuse_other, require_file
from trilane.near_miss import did_you_mean
from trilane.scene.motion.array_files import load_npy, load_npz, load_pickle
from trilane.scene.motion.builtin import BUILTIN
from trilane.scene.motion.bvh_retarget import load_retargeted
from trilane.scene.motion.motion import Motion
from trilane.scene.motion.playing import as_played
from trilane.scene.motion.recorded import RawMotion, motion_from_recording
from trilane.scene.motion.t_pose import T_POSE
from trilane.scene.schema import AvatarSpec

PREFIX = "builtin:"

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
    """The motion that `spec.motion` names, as `spec` plays it; a relative path starts at `base`.

    `rest` (55, 3): rest joints of the avatar that does it, metres; those of a plain body when there is none. Raises
    BadInputError when there is no such motion or the file is unusable.
    """
    if spec.motion.startswith(PREFIX):
        make = BUILTIN.get(spec.motion.removeprefix(PREFIX))
        if make is None:
            near = did_you_mean(spec.motion.removeprefix(PREFIX), BUILTIN, PREFIX)
            raise BadInputError("motion", repr(spec.motion), f"{PREFIX}{{{', '.join(BUILTIN)}}} or a file", near)
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
    """What is wrong with a file that has the ending of no motion."""
    expected = f"a motion file: {', '.join(_READERS)}"
    try:
        require_file(path, expected)
        refuse_other(path, expected)
    except BadInputError as error:
        return error
    return BadInputError(path, f"the ending {path.suffix!r}", expected)


def _check_named(spec: AvatarSpec, motion: str | Path) -> None:
    """Raises BadInputError when `spec` maps joints of a `motion` that has no names."""
    if spec.joint_map and Path(motion).suffix.lower() not in NAMED:
        raise BadInputError(motion, "joint_map", f"none: only joints of {', '.join(NAMED)} files have names")
