"""Measurements of other tools in one form, and the checks of every number in them.

    found = Measurements("QNN profile", "times of each run ...")
    found.sample("line 16: RPC (execute) time", "RPC (execute) time", "run", 7784, "us")
    found.measurements, found.refused

Rule: a reader of a format hands each number to `Measurements`, which converts it to ms. A number that no tool can have
measured is refused. A refusal names the row and a reason; other rows stay. Nothing is guessed and nothing is repaired.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypeGuard

import numpy as np

from trilane.errors import BadInputError
from trilane.pipeline.file_keys import LONGEST_MS

#: run: one job of a whole network. layer: a part of such a job. wall: a time measured from outside, with all waits.
Kind = Literal["run", "layer", "wall"]
#: Number of each unit of time in a millisecond. A division by this number rounds once, so 99091 us are 99.091 ms.
PER_MS: Final = {"s": 1e-3, "ms": 1.0, "us": 1e3, "ns": 1e6}
CYCLES: Final = "cycles"
MOST_SAMPLES: Final = 1_000_000  # in one file
MOST_NAMES: Final = 50_000
MOST_REFUSED: Final = 1000  # refused rows that are listed; further ones are only counted
UNNAMED: Final = "unnamed"
LONGEST_NAME: Final = 300
WARM_UP: Final = 1.5  # a first run longer than this times the median of the other runs looks like a warm-up
#: Remedy for a time that contains queueing.
QUEUEING: Final = "a wall time that contains queueing is no service time"


class Refused(NamedTuple):
    """A row that was refused. `row`: its place in the file and its name. `reason`: reason as part of a sentence."""

    row: str
    reason: str


@dataclass(frozen=True)
class Measurement:
    """The times of one thing that a tool measured, such as a run or a layer.

    `name`: name that the tool gives to this thing.
    `kind`: run, layer or wall, see `Kind`.
    `unit`: unit of time in the file: s, ms, us, ns or cycles.
    `what`: contents of the time, in words.
    `samples_ms`: single times; empty if the tool states only figures such as a mean.
    `count`: number of measured times; None if the tool does not state it.
    `mean_ms`, ..., `max_ms`: figures of the times; None if the tool does not state them.
    `share`: share (0 to 1) of the layer in the sum of all layers; None if it is not known.
    `hardware`: hardware that did the work, as the tool names it.
    `service`: whether the time can be the service time of a stage.
    `hint`: warning about the measurement, or empty.
    `more`: other figures in the file, by name.
    """

    name: str
    kind: Kind
    unit: str
    what: str = ""
    samples_ms: tuple[float, ...] = field(default=(), repr=False)
    count: int | None = None
    mean_ms: float | None = None
    sd_ms: float | None = None
    min_ms: float | None = None
    p50_ms: float | None = None
    p95_ms: float | None = None
    max_ms: float | None = None
    share: float | None = None
    hardware: str = ""
    service: bool = True
    hint: str = ""
    more: dict[str, float] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """Return the measurement as JSON values, by the names of the fields."""
        others = {name: value for name, value in vars(self).items() if name != "samples_ms"}
        return {**others, "samples_ms": list(self.samples_ms)}


def is_finite(value: object) -> TypeGuard[int | float]:
    """Return whether a value of a JSON document is a finite number; true and false do not count as numbers."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def number_in(text: str) -> object:
    """Return the number that a text states; for any other text the text itself."""
    try:
        return float(text)
    except ValueError:
        return text


class Measurements:
    """The measurements of one file, which a reader collects.

    `path`: path of the file.
    `tool`: name of the file's format.
    `says`: description of the times in this format, as part of a sentence.
    `refused`: refused rows, at most MOST_REFUSED.
    `refused_count`: number of all refused rows.
    `skipped`: number of rows that do not contain a time of a run, by reason.
    """

    def __init__(self, tool: str, says: str) -> None:
        self.path, self.tool, self.says = Path(), tool, says
        self.refused: list[Refused] = []
        self.refused_count = 0
        self.skipped: Counter[str] = Counter()
        self._samples: dict[tuple[str, Kind], list[float]] = defaultdict(list)
        self._facts: dict[tuple[str, Kind], dict[str, Any]] = {}
        self._made: list[Measurement] = []
        self._left = MOST_SAMPLES

    def refuse(self, row: str, reason: str) -> None:
        """Note a row whose number is not plausible. `row`: place and name of the row, for messages."""
        self.refused_count += 1
        if len(self.refused) < MOST_REFUSED:
            self.refused.append(Refused(row[:LONGEST_NAME], reason))

    def skip(self, reason: str) -> None:
        """Count a row that does not contain a time of a run."""
        self.skipped[reason] += 1

    def number(self, row: str, value: object, what: str = "the time") -> float | None:
        """Return `value` if it is a finite number of at least 0; otherwise refuse the row and return None.

        `row`: place and name of the row, for messages.
        `what`: name of the number in messages.
        """
        if not isinstance(value, int | float) or isinstance(value, bool):
            text = "nothing" if value is None else repr(value)[:40]
            self.refuse(row, f"{what} is {text}: a number was expected")
            return None
        number = float(value)
        if not math.isfinite(number):
            self.refuse(row, f"{what} is {number:g}: a number that is finite was expected")
            return None
        if number < 0:
            self.refuse(row, f"{what} is negative ({number:g})")
            return None
        return number

    def ms(self, row: str, value: object, unit: str, kind: Kind, what: str = "the time") -> float | None:
        """Return `value` in ms; if it is no plausible time, refuse the row and return None.

        A time of 0 is plausible only for a layer.

        `row`, `what`: as for `number`.
        `unit`: unit of `value`, a key of PER_MS.
        `kind`: kind of the measurement.
        """
        number = self.number(row, value, what)
        if number is None:
            return None
        time = number / PER_MS[unit]
        if time > LONGEST_MS:
            self.refuse(row, f"{what} is {number:g} {unit}, over an hour: is the unit right?")
            return None
        if time == 0 and kind != "layer":
            self.refuse(row, f"{what} is 0: a run takes time")
            return None
        return time

    def sample(
        self, row: str, name: str, kind: Kind, value: object, unit: str, what: str = "", **facts: Any
    ) -> float | None:
        """Add a time to the samples of the measurement `name`. Return the time in ms; None if it is refused.

        `row`, `kind`, `value`, `unit`: as for `ms`.
        `what`, `facts`: further fields of the measurement; only its first sample sets them.

        Raises BadInputError for too many times or names.
        """
        time = self.ms(row, value, unit, kind)
        if time is None:
            return None
        key = (name[:LONGEST_NAME] or UNNAMED, kind)
        stated = self._facts.setdefault(key, {"unit": unit, "what": what, **facts})
        if stated["unit"] != unit:
            self.refuse(row, f"in {unit}, but earlier rows of this name are in {stated['unit']}")
            return None
        self._left -= 1
        if self._left < 0 or len(self._facts) > MOST_NAMES:
            raise BadInputError(
                "the file", f"over {MOST_SAMPLES} times, or {MOST_NAMES} names", "fewer", "measure for a shorter time"
            )
        self._samples[key].append(time)
        return time

    def add(self, measurement: Measurement) -> None:
        """Add a measurement of a tool that states figures, but no single times. Raises BadInputError for too many."""
        if len(self._made) >= MOST_NAMES:
            raise BadInputError("the file", f"over {MOST_NAMES} names", "fewer")
        self._made.append(replace(measurement, name=measurement.name[:LONGEST_NAME] or UNNAMED))

    @cached_property
    def measurements(self) -> tuple[Measurement, ...]:
        """All measurements in the order of the file, but sampled ones come first. Use this after the last row only."""
        samples = self._samples.items()
        sampled = [_of_samples(name, kind, values, self._facts[name, kind]) for (name, kind), values in samples]
        return (*sampled, *_told_apart(self._made))


def _of_samples(name: str, kind: Kind, samples: list[float], facts: dict[str, Any]) -> Measurement:
    times = np.array(samples)
    p50, p95 = np.percentile(times, (50, 95))
    hint = ""
    if kind == "run" and len(samples) > 2 and samples[0] > WARM_UP * float(np.median(times[1:])):
        hint = f"the first run took {samples[0] / float(np.median(times[1:])):.1f} times the median: a warm-up?"
    return Measurement(
        name,
        kind,
        samples_ms=tuple(samples),
        count=len(samples),
        mean_ms=math.fsum(samples) / len(samples),
        sd_ms=float(times.std(ddof=1)) if len(samples) > 1 else None,
        min_ms=float(times.min()),
        p50_ms=float(p50),
        p95_ms=float(p95),
        max_ms=float(times.max()),
        hint=hint,
        **facts,
    )


def _told_apart(made: list[Measurement]) -> list[Measurement]:
    """Return the measurements, with numbers after names that repeat: `net.tflite`, `net.tflite #2`."""
    seen: Counter[str] = Counter()
    result = []
    for each in made:
        seen[each.name] += 1
        number = seen[each.name]
        result.append(each if number == 1 else replace(each, name=f"{each.name} #{number}"))
    return result


#: Relative rounding of a figure that a tool prints with six digits.
ROUNDING: Final = 2e-5


def contradiction(stated: Measurement) -> str:
    """Return a sentence about two figures of a measurement that contradict each other; "" if no two figures do.

    Mean and percentiles must lie between the least and the largest time, and a higher percentile must not be smaller.
    """
    mean, sd, low, high = stated.mean_ms, stated.sd_ms, stated.min_ms, stated.max_ms
    named = [("the least", low), ("the median", stated.p50_ms), ("p95", stated.p95_ms), ("the largest", high)]
    ordered = [(name, value) for name, value in named if value is not None]
    for (name, value), (next_name, next_value) in pairwise(ordered):
        if value > next_value * (1 + ROUNDING):
            return f"{name} ({value:g} ms) is above {next_name} ({next_value:g} ms)"
    if mean is not None and low is not None and mean < low * (1 - ROUNDING):
        return f"the mean ({mean:g} ms) is below the least ({low:g} ms)"
    if mean is not None and high is not None and mean > high * (1 + ROUNDING):
        return f"the mean ({mean:g} ms) is above the largest ({high:g} ms)"
    if None not in (sd, low, high) and sd > (high - low) * (1 + ROUNDING) + 1e-3:  # type: ignore[operator]
        return f"the standard deviation ({sd:g} ms) is larger than all of the range"
    return ""


def falling(values: Sequence[float], slack: float = 0.0) -> list[int]:
    """Return the indices of a longest subsequence of `values` that never rises by more than `slack`.

    Of several longest subsequences, the function returns the one with the largest sum, because a wrong time is more
    often too short than too long. Therefore a value that fits others may be left out: [10, 9, 8, 8.5] gives [0, 1, 3].

    `slack`: largest rise from one value of the subsequence to the next, as a share of the first of the two.
    """

    limits = [-value * (1 + slack) for value in values]  # negative, because bisect needs an order that rises
    order = sorted(limits)
    # A Fenwick tree over `order`: length, sum and -index of the last value of the best series so far. Of equal series
    # the one whose last value comes first is the best.
    best = [(0, 0.0, 1)] * (len(order) + 1)
    series, before = [], list[int]()
    for index, (value, limit) in enumerate(zip(values, limits, strict=True)):
        found, place = best[0], bisect_right(order, -value)
        while place:
            found, place = max(found, best[place]), place & (place - 1)
        series.append((found[0] + 1, found[1] + value, -index))
        before.append(-found[2])
        place = bisect_left(order, limit) + 1
        while place < len(best):
            best[place] = max(best[place], series[index])
            place += place & -place
    kept, last = list[int](), -max(series, default=(0, 0.0, 1))[2]
    while last >= 0:
        kept.append(last)
        last = before[last]
    return kept[::-1]
