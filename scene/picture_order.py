"""In which order the pictures of a folder follow each other, and where some are missing.

Rule: numbers in names are compared as numbers. Names that are alike but for one number are the frames of a film, whose
number is their time: while one is missing, the picture before it is shown.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

#: Of neighbours in a film, at least so many are one step apart, and it has at most so many times as many frames as
#: pictures; else the numbers say nothing of time.
LEAST_IN_STEP, MOST_MISSING = 0.5, 4
NAMED_GAPS = 3
LAST_NUMBER = re.compile(r"(.*?)(\d{1,15})(\D*)\Z", re.DOTALL)


@dataclass(frozen=True)
class Order:
    """`frames`: at which frame of the film each picture is first shown, increasing from 0. `count`: frames of the film.

    `note`: on what is missing, for people; empty when nothing is.
    """

    frames: tuple[int, ...]
    count: int
    note: str


def in_order(names: Sequence[str]) -> list[str]:
    """`names` of files, sorted."""
    return sorted(names, key=lambda name: ([_part(part) for part in re.split(r"(\d+)", name)], name))


def _part(text: str) -> tuple[int, str]:
    return (int(text), "") if text.isdecimal() else (-1, text)


def film_of(names: Sequence[str]) -> Order:
    """The film of the pictures `names`, at least one, which are in order."""
    numbers = _numbers(names)
    step = _step(numbers)
    if not step:
        return Order(tuple(range(len(names))), len(names), "")
    frames = tuple((number - numbers[0]) // step for number in numbers)
    return Order(frames, frames[-1] + 1, _missing(numbers, step))


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
