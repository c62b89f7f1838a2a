"""In which order the pictures of a folder follow each other, and where some are missing.

Rule: numbers in names are compared as numbers. Names that are alike but for one number are the frames of a film, whose
number is their time: while one is missing, the picture before it is shown. Names that are times, as data sets of
robots have them, are kept as they are.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

#: Of neighbours in a film, at least so many are one step apart, and it has at most so many times as many frames as
#: pictures; else the numbers say nothing of time.
LEAST_IN_STEP, MOST_MISSING = 0.5, 4
NAMED_GAPS = 3
#: A step between times above so many usual ones is a gap.
GAP = 1.5
#: Names that are times since 1970, in seconds, milli-, micro- or nanoseconds; and their range, of 2001 to 2100.
CLOCKS = {r"\d{10}\.\d{1,9}": 1.0, r"\d{13}": 1e-3, r"\d{16}": 1e-6, r"\d{19}": 1e-9}
EARLIEST_S, LATEST_S = 1e9, 4.1e9
ROUNDING_S = 1e-6
LAST_NUMBER = re.compile(r"(.*?)(\d{1,15})(\D*)\Z", re.DOTALL)


@dataclass(frozen=True)
class Film:
    """`times_s`: when each picture is first shown, from 0. `period_s`: after which time the film starts again.

    `rate`: of the pictures, and what is missing, for people. `began_s`: of the first one, seconds since 1970; None
    where names do not say it.
    """

    times_s: tuple[float, ...]
    period_s: float
    rate: tuple[str, ...]
    began_s: float | None = None

    def number_at(self, time_s: float) -> int:
        """The number of the picture that is shown at `time_s`."""
        return bisect_right(self.times_s, (time_s + ROUNDING_S) % self.period_s) - 1


def in_order(names: Sequence[str]) -> list[str]:
    """`names` of files, sorted."""
    return sorted(names, key=lambda name: ([_part(part) for part in re.split(r"(\d+)", name)], name))


def _part(text: str) -> tuple[int, str]:
    return (int(text), "") if text.isdecimal() else (-1, text)


def film_of(names: Sequence[str], fps: float) -> Film:
    """The film of the pictures `names`, at least one, which are in order; numbered ones follow each other at `fps`."""
    clock = _clock(names)
    if clock:
        return _by_clock(clock)
    numbers = _numbers(names)
    step = _step(numbers)
    frames = [(number - numbers[0]) // step for number in numbers] if step else list(range(len(names)))
    missing = _missing(numbers, step) if step else ""
    times = tuple(frame / fps for frame in frames)
    return Film(times, (frames[-1] + 1) / fps, (f"{fps:g}/s", *((missing,) if missing else ())))


def _clock(names: Sequence[str]) -> list[float]:
    """Seconds since 1970 that each name is, increasing; none when there is one picture, or they are something else."""
    stems = [name.rpartition(".")[0] for name in names]
    for pattern, unit in CLOCKS.items():
        times = [float(stem) * unit for stem in stems if re.fullmatch(pattern, stem)]
        if len(times) == len(stems) > 1 and EARLIEST_S < times[0] < times[-1] < LATEST_S:
            return times if all(earlier < later for earlier, later in pairwise(times)) else []
    return []


def _by_clock(clock: Sequence[float]) -> Film:
    times = tuple(time - clock[0] for time in clock)
    steps = sorted(later - earlier for earlier, later in pairwise(times))
    usual = median(steps)
    rate = [f"{1 / usual:.4g}/s by the times that are their names"]
    gaps = sum(step > GAP * usual for step in steps)
    if gaps:
        rate.append(f"{gaps} gaps, the longest {1000 * steps[-1]:.0f} ms: the picture before is held")
    return Film(times, times[-1] + usual, tuple(rate), clock[0])


def _numbers(names: Sequence[str]) -> list[int]:
    """The number of each of `names`, when that is all in which they differ but for their endings; else none."""
    parts = [LAST_NUMBER.match(name.rpartition(".")[0]) for name in names]
    found = [part for part in parts if part]
    if len(found) < len(names) or len({(part[1], part[3]) for part in found}) > 1:
        return []
    return [int(part[2]) for part in found]


def _step(numbers: Sequence[int]) -> int:
    """From one frame to the next; 0 when `numbers` are not those of a film."""
    steps = Counter(later - earlier for earlier, later in pairwise(numbers))
    if not steps:
        return 0
    step, times = min(steps.items(), key=lambda item: (-item[1], item[0]))
    if min(steps) <= 0 or times < LEAST_IN_STEP * (len(numbers) - 1) or any(other % step for other in steps):
        return 0
    return step if (numbers[-1] - numbers[0]) // step < MOST_MISSING * len(numbers) else 0


def _missing(numbers: Sequence[int], step: int) -> str:
    gaps = [(earlier + step, later - step) for earlier, later in pairwise(numbers) if later - earlier > step]
    if not gaps:
        return ""
    count = sum((last - first) // step + 1 for first, last in gaps)
    named = [f"{first}" if first == last else f"{first} to {last}" for first, last in gaps[:NAMED_GAPS]]
    more = " and others" if len(gaps) > NAMED_GAPS else ""
    return f"{count} numbers missing ({', '.join(named)}{more}): the picture before is held"
