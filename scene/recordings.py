"""What readers of motions and cameras share: facts about a file, the choice of usable samples, an order of names.

A sample is left out when its reader finds it unreadable, or when its time is not after the time of the last usable
sample. Sampling interpolates across such holes, and a note says how many samples are left out. A file with more bad
samples than good ones is refused.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64
from trilane.errors import BadInputError


@dataclass(frozen=True)
class Detected:
    """Facts about a file, as texts for people.

    `format`: name of the format. `reason`: how the format was recognised.
    `axes`: axis that points up, and why. `unit`: unit of lengths, and why.
    `rate`: source of the rate. `lens`: source of a camera's lens.
    `joints`: the file's joint name by SMPL-X joint name.
    `unmapped`: names of the file's joints that match no SMPL-X joint, in file order.
    """

    format: str = ""
    reason: str = ""
    axes: str = ""
    unit: str = ""
    rate: str = ""
    lens: str = ""
    joints: Mapping[str, str] = field(default_factory=dict)
    unmapped: tuple[str, ...] = ()


#: Facts about a source that is no file.
NOTHING = Detected()


#: A time step longer than this many median steps is reported as a gap.
GAP = 1.5
#: Times from 2001 to 2100, in seconds since 1970, count as times of a clock. Other times may start at any number.
EARLIEST_S, LATEST_S = 1e9, 4.1e9

#: A function from a sample's index to the sample's place in its file, for messages.
PlaceOf = Callable[[int], str]


def by_number(index: int) -> str:
    """Return the place of sample `index`, for a file whose samples have neither lines nor names."""
    return f"number {index}"


def natural(name: str) -> list[tuple[int, str]]:
    """Return a sort key of a file name by which numbers compare as numbers: `img9` comes before `img10`."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def usable_samples(
    where: str,
    times_s: F64,
    readable: NDArray[np.bool_],
    place_of: PlaceOf = by_number,
    broken_as: str = "not finite or no rotation",
) -> tuple[NDArray[np.intp], tuple[str, ...]]:
    """Return (indices of the usable samples, notes on left-out samples and on gaps in time).

    `where`: file, for messages.
    `times_s` (T,): times of the samples.
    `readable` (T,): whether the values of each sample are readable.
    `place_of`: place of each sample in the file.
    `broken_as`: what is wrong with unreadable samples, in words.
    Raises BadInputError when less than half of the samples are usable.
    """
    timed = readable & np.isfinite(times_s)
    broken = int(len(times_s) - timed.sum())
    indices = np.flatnonzero(timed)
    highest = np.maximum.accumulate(times_s[indices])
    increasing = indices[np.diff(highest, prepend=-np.inf) > 0]
    late = len(indices) - len(increasing)
    first = f" (first: {place_of(int(np.flatnonzero(~timed)[0]))})" if broken else ""
    if not len(increasing) or 2 * len(increasing) < len(times_s):
        raise BadInputError(
            where,
            f"{broken} samples that are {broken_as}{first} and {late} times that do not increase, of {len(times_s)}",
            "at least half of the samples sound",
        )
    notes = []
    if broken:
        notes.append(f"{broken} samples {broken_as}{first}, interpolated across")
    if late:
        notes.append(f"{late} samples with repeated or decreasing times left out")
    return increasing, (*notes, *_gap_notes(times_s[increasing]))


def _gap_notes(times_s: F64) -> tuple[str, ...]:
    steps = np.diff(times_s)
    if len(steps) < 2:
        return ()
    wide = steps[steps > GAP * np.median(steps)]
    if not len(wide):
        return ()
    return (f"{len(wide)} gap{'s' * (len(wide) > 1)}, the longest {wide.max() * 1000:.0f} ms, interpolated across",)
