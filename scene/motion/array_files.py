"""Reads motions out of `.npy`, `.npz` and `.pkl` files: one array of poses, or arrays with names.

Rule: what is in a file decides how it is read, not its ending: an array is poses or places of joints, a dict has a
layout.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from trilane.arrays import F64
from trilane.files import npz_names
from trilane.scene.motion import romp_file
from trilane.scene.motion.joint_places import motion_of_places, places_in
from trilane.scene.motion.pickled import printable
from trilane.scene.motion.recorded import RawMotion
from trilane.scene.motion.smpl_file import motion_of
from trilane.scene.motion.smpl_layouts import KEYS
from trilane.scene.motion.smplx_npy import motion_of_array
from trilane.scene.motion.stored import npy_values, npz_values, pickle_values, plain
from trilane.scene.motion.t_pose import T_POSE

EXPECTED = "a motion: arrays of axis-angle poses of SMPL, SMPL-H or SMPL-X"
#: The name that NumPy gives to an array that is saved without one.
NAMELESS = "arr_0"
NPZ_KEYS = (*KEYS, romp_file.POSES, romp_file.PLACES, romp_file.PERSONS, NAMELESS)
MOST_NAMED = 12


def load_npy(path: Path, units: str = "auto", rest: F64 = T_POSE) -> RawMotion:
    """Read a `.npy` file. Raises BadInputError.

    `units`: of places of joints, a key of UNITS_M or `auto`. `rest` (55, 3): rest joints of the avatar, metres.
    """
    values = plain(npy_values(path, EXPECTED))
    places = places_in(values) if isinstance(values, np.ndarray) else None
    if places is not None:
        return motion_of_places(path.suffix.lower(), places, units, rest)
    return _motion(path, values)


def load_npz(path: Path) -> RawMotion:
    """Read an `.npz` file. Raises BadInputError."""
    values = npz_values(path, NPZ_KEYS, EXPECTED)
    names = [printable(name) for name in npz_names(path, EXPECTED)]
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    nameless = names == [NAMELESS]
    return _motion(path, values[NAMELESS] if nameless else values, f"arrays {', '.join(names[:MOST_NAMED])}{more}")


def load_pickle(path: Path) -> RawMotion:
    """Read a pickle, of which nothing is executed. Raises BadInputError."""
    return _motion(path, pickle_values(path, EXPECTED))


def _motion(path: Path, values: Any, there: str = "") -> RawMotion:
    source = path.suffix.lower()
    array = plain(values)
    if isinstance(array, np.ndarray):
        return motion_of_array(str(path), source, array)
    return motion_of(str(path), source, array, there)
