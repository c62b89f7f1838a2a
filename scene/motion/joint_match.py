"""Which joint of a file is which joint of the body: by the tables of names, and by what the scene states.

Rule: what the scene states (`joint_map`) comes first, a table of names fills the rest, and no joint of the file is two
of the body's.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from trilane.errors import BadInputError
from trilane.near_miss import did_you_mean
from trilane.scene.motion.bvh_joint_names import DIALECTS, plain

REQUIRED = ("pelvis", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle")
#: What the pelvis is called in most families: found beside any other table, since it is one joint and no limb.
PELVIS = ("hips", "pelvis", "hip")
#: What names the joints that are in no table.
STATED = "joint_map"
NO_MAP: Mapping[str, str] = {}


def match_names(path: Path, names: list[str], joint_map: Mapping[str, str] = NO_MAP) -> tuple[str, dict[str, int]]:
    """What named the joints, such as the family that has the most of `names`, and {SMPL-X name: index in `names`}.

    `joint_map`: SMPL-X name -> name in the file, or empty for none; it overrules the tables. Raises BadInputError about
    `path` when the file has no joint that the map names, or REQUIRED ones have no partner.
    """
    stated = {target: _stated(path, names, target, source) for target, source in joint_map.items()}
    index_of: dict[str, int] = {}
    for index, name in enumerate(names):
        index_of.setdefault(plain(name), index)
    matches = {family: _by_table(table, index_of) for family, table in DIALECTS.items()}
    best = max(matches, key=lambda family: (not _missing(matches[family], stated), len(matches[family])))
    found = _overruled(matches[best], stated)
    missing = _missing(found, {})
    if missing:
        raise BadInputError(
            path,
            f"joints {', '.join(names[:6])} …, of which none is {missing[0]}",
            f"the joint names of {', '.join(DIALECTS)}",
            f'say which is which in the scene: joint_map = {{{missing[0]} = "...", ...}} for {", ".join(missing)}',
        )
    return " and ".join(word for word, used in ((best, matches[best]), (STATED, joint_map)) if used), found


def _missing(found: Mapping[str, int], stated: Mapping[str, int | None]) -> list[str]:
    """Those of REQUIRED that neither has."""
    return [name for name in REQUIRED if name not in found and stated.get(name) is None]


def _stated(path: Path, names: list[str], target: str, source: str) -> int | None:
    """Index of the joint `source`, written as in the file or in another case; None for an empty one."""
    if not source:
        return None
    if source in names:
        return names.index(source)
    for index, name in enumerate(names):
        if plain(name) == plain(source):
            return index
    near = did_you_mean(source, names) or f"the file has {', '.join(names[:40])}"
    raise BadInputError(path, f"no joint {source!r}, which joint_map names for {target}", "a joint of the file", near)


def _by_table(table: Mapping[str, str], index_of: Mapping[str, int]) -> dict[str, int]:
    """{SMPL-X name: index} of what `table` finds, and the pelvis; of several names the first in the table."""
    found: dict[str, int] = {}
    for source, target in table.items():
        if source in index_of:
            found.setdefault(target, index_of[source])
    named = next((index_of[name] for name in PELVIS if name in index_of), None)
    if named is not None and named not in found.values():
        found.setdefault("pelvis", named)
    return found


def _overruled(found: Mapping[str, int], stated: Mapping[str, int | None]) -> dict[str, int]:
    """`found` beside what is `stated`: without joints that are stated, or whose joint of the file is."""
    taken = set(stated.values())
    kept = {target: index for target, index in found.items() if target not in stated and index not in taken}
    return kept | {target: index for target, index in stated.items() if index is not None}
