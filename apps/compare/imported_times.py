"""Imported times as a side of a comparison: a JSON file with `measurements`, given the keys of a report.

Rule: each measurement is the time of a job of the stage with its name. It stands beside a measurement of that name, or
beside the stage of a run. The only wall time stands for the frame time. Nobody knows the machine's state, so two
measurements scatter as any two runs on the host clock.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from math import sqrt
from pathlib import Path
from statistics import stdev
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from trilane.errors import BadInputError
from trilane.units import HOST_CLOCK

MEASUREMENTS: Final = "measurements"
EXPECTED: Final = "imported times: JSON with `measurements`, each with `name`, `kind` and `mean_ms`"
WALL: Final = "wall"
#: Unit that imported stages stand on; nothing is known of it.
UNIT: Final = "imported"
#: Longest and shortest time that can be one, in ms: an hour, and a millionth of a nanosecond.
LONGEST_MS, SHORTEST_MS = 3.6e6, 1e-12
Ms = Annotated[float, Field(ge=0, le=LONGEST_MS)]


class Measurement(BaseModel):
    """One measured time.

    `kind`: such as `run`, `layer` or `wall`. `count`, `sd_ms`: number and standard deviation of the values.
    `samples_ms`: every value, where the file has it. `file`: file that it was read from.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    name: str = Field(min_length=1)
    kind: str
    count: int | None = Field(default=None, ge=0, le=1 << 53)
    mean_ms: Ms | None = None
    sd_ms: Ms | None = None
    p50_ms: Ms | None = None
    samples_ms: tuple[Ms, ...] = ()
    file: str = ""

    @property
    def ms(self) -> float:
        """The mean, else the median; 0 for a measurement in another unit, such as cycles."""
        return self.mean_ms or self.p50_ms or 0.0

    @property
    def error(self) -> float | None:
        """Standard error of the mean as a share of it; None where nothing shows it."""
        count = len(self.samples_ms) or self.count or 0
        deviation = stdev(self.samples_ms) if len(self.samples_ms) > 1 else self.sd_ms
        return None if deviation is None or count < 2 else deviation / sqrt(count) / self.ms


def imported(document: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return the keys of a report that a comparison reads. Raises BadInputError naming the first wrong key."""
    rows = [_measurement(row, f"{path}: {MEASUREMENTS}.{place}") for place, row in enumerate(document[MEASUREMENTS])]
    rows = [row for row in rows if row.ms >= SHORTEST_MS]
    if not rows:
        raise BadInputError(f"{path}: {MEASUREMENTS}", "no time", "one or more", "docs/compare.md has the keys")
    if len(files := {row.file for row in rows}) > 1:
        remedy = "give several runs of one kind as A.json,B.json"
        raise BadInputError(path, f"times of {len(files)} files", "the times of one file", remedy)
    rows = _told_apart(rows)
    names = [row.name for row in rows]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise BadInputError(f"{path}: {MEASUREMENTS}", f"{twice!r} twice", "each name once")
    frames = _frames(rows)
    return {
        "clock": HOST_CLOCK,
        "stages": {row.name: {"unit": UNIT, "service_ms": _times(row)} for row in rows if row is not frames},
        "units": {},
        "config": {},
        "machine": {},
        "frame_time_ms": _times(frames) if frames else {},
        "latency_ms": {},
        "deviation": _deviation(rows),
    }


def _measurement(row: Any, where: str) -> Measurement:
    try:
        return Measurement.model_validate(row)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise BadInputError(f"{where}.{key}".rstrip("."), first["msg"].lower(), EXPECTED) from None


def _told_apart(rows: Sequence[Measurement]) -> list[Measurement]:
    """Return the measurements, with its kind in the name of each whose name another kind has too."""
    counts = Counter(row.name for row in rows)
    longer = [row.model_copy(update={"name": f"{row.name} ({row.kind})"}) for row in rows]
    return [long if counts[row.name] > 1 else row for row, long in zip(rows, longer, strict=True)]


def _frames(rows: Sequence[Measurement]) -> Measurement | None:
    """Return the measurement that stands for a frame: the only wall time."""
    found = [row for row in rows if row.kind == WALL]
    return found[0] if len(found) == 1 else None


def _times(row: Measurement) -> dict[str, float]:
    return {"mean": row.ms} | ({} if row.p50_ms is None else {"p50": row.p50_ms})


def _deviation(rows: Sequence[Measurement]) -> float | None:
    """Return the standard error that a comparison takes for every figure: the largest that is known, None for none."""
    return max((error for row in rows if (error := row.error) is not None), default=None)
