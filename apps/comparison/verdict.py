"""The sentence that says what differs and the likely cause. Rule: it names what holds for all comparisons together.

First the frame time, then what explains it, the most telling first: stages whose work takes longer or shorter, units
that wait more or less, then what a setting that changed is known to do. What a rule below does not explain is named all
the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from trilane.apps.comparison.configuration import Change
from trilane.apps.comparison.difference import Difference, Outcome
from trilane.apps.comparison.rows import (
    BUSY,
    BYTES,
    DROPPED,
    ERROR,
    FRAME_TIME,
    IDLE,
    LATENCY,
    LOST,
    SERVICE,
    SHARE,
    WORK,
    Figure,
    Rows,
    margin_of,
)
from trilane.apps.comparison.run_frames import INSTRUCTION_TIME, INSTRUCTIONS

NO_DIFFERENCE: Final = str(Outcome.SAME)
TOO_FEW: Final = f"{Outcome.UNKNOWN}: too short"
#: A cause of idle time is named where its share has changed by so much.
TELLING_SHARE: Final = 0.05
MOST_NAMED: Final = 4
NOT_EXPLAINED: Final = "no stage, unit or setting alone explains it; the cores may have another speed"
MANY: Final = 999.5
#: What is said of the values of a setting.
REASONS: Final = {
    ("policy", "sequential"): "one frame at a time under sequential",
    ("policy", "pipelined"): "several frames at a time under pipelined",
    ("policy", "latest"): "the newest pose wins under latest",
    ("policy", "deadline"): "late frames are dropped under deadline",
}
WAITS: Final = {
    "starved": "is starved",
    "blocked": "is blocked",
    "throttled": "is held by its cap",
    "preempted": "has no core",
    "overhead": "waits for messages or its process",
}


def verdict(
    rows: Rows,
    named: Sequence[Figure],
    differing: Sequence[Figure],
    changes: Sequence[Change],
    stages: Mapping[str, Sequence[str]],
) -> str:
    """`no difference`, or a sentence, which begins with `cannot tell` where it cannot be told.

    `named`: figures of `rows` that it rests on; `differing`: those that differ, all together. `changes`: of the
    configuration. `stages`: names of each unit's.
    """
    if not differing:
        return _not_told(rows, named, changes, stages)
    found = {figure: rows[figure] for figure in differing}
    heads = list(_heads(found))
    causes = [*_programs(found), *_works(found, rows, changes), *_waits(found, rows, stages), *_others(found)]
    settings = ((change.key.rpartition(".")[2], str(change.other)) for change in changes)
    reasons = [REASONS[setting] for setting in settings if setting in REASONS]
    if not causes:
        causes = [NOT_EXPLAINED] if not reasons and any(figure.measure == WORK for figure in rows) else []
        if not heads:
            causes = [_plain(figure, row) for figure, row in [*found.items()][:MOST_NAMED]]
    parts = ["; ".join(heads), "; ".join(causes), "; ".join(reasons) if heads or causes else ""]
    return ": ".join(part for part in parts if part)


def _not_told(
    rows: Rows, named: Sequence[Figure], changes: Sequence[Change], stages: Mapping[str, Sequence[str]]
) -> str:
    """Where nothing surely differs: that nothing that matters does, or that this cannot be told, and of what.

    Where nothing was set otherwise and every stage's instructions were counted, these alone are the program.
    """
    counted = [figure for figure in named if figure.measure == INSTRUCTIONS]
    is_counted = len(counted) == sum(map(len, stages.values())) and not changes
    rested_on = counted if is_counted else [figure for figure in named if figure.measure in (FRAME_TIME, WORK, SERVICE)]
    if all(rows[figure].probability is None for figure in rested_on):
        return TOO_FEW
    unknown = {
        figure: rows[figure]
        for figure in rested_on
        if rows[figure].outcome(differs=False, margin=margin_of(figure, rows[figure])) is Outcome.UNKNOWN
    }
    if not unknown:
        return NO_DIFFERENCE
    ordered = sorted(
        unknown.items(), key=lambda each: (each[0].measure != FRAME_TIME, -abs(each[1].other - each[1].base))
    )
    said = (f"{figure.of or figure.measure} {signed(row, figure.unit)}" for figure, row in ordered[:MOST_NAMED])
    return f"{Outcome.UNKNOWN}: {', '.join(said)}: runs of one kind may differ by as much"


def _programs(found: Rows) -> Iterator[str]:
    """Stages that execute more instructions or fewer, and those whose instructions take longer or shorter."""
    for figure, row in found.items():
        if figure.measure == INSTRUCTIONS:
            sign = 1 if row.change > 0 else -1
            more = f"{_amount(sign * row.change, row, figure.unit)} {'more' if sign > 0 else 'fewer'} instructions"
            yield f"{figure.of} executes {more}{_between(row, sign)}"
    for figure, row in found.items():
        if figure.measure == INSTRUCTION_TIME:
            yield f"an instruction of {figure.of} takes {longer(row, figure.unit)}, as the machine lets it"


def _heads(found: Rows) -> Iterator[str]:
    """The frame time; where it is as it was, its percentiles and the latency."""
    for measure in (FRAME_TIME, LATENCY):
        mine = {figure: row for figure, row in found.items() if figure.measure == measure}
        of_mean = [figure for figure in mine if figure.statistic == "mean"] or [*mine][:1]
        for figure in of_mean:
            name = measure if figure.statistic == "mean" else f"{figure.statistic} of the {measure}"
            yield f"{name} {signed(mine[figure], figure.unit)}"
        if of_mean:
            return


def _works(found: Rows, rows: Rows, changes: Sequence[Change]) -> Iterator[str]:
    """Stages without counted instructions, by how many milliseconds their work has changed."""
    by_stage: dict[str, tuple[Figure, Difference]] = {}
    counted = {figure.of for figure in found if figure.measure in (INSTRUCTIONS, INSTRUCTION_TIME)}
    measure = WORK if any(figure.measure == WORK for figure in rows) else SERVICE
    for figure, row in found.items():
        if figure.measure == measure and figure.of not in counted:
            by_stage.setdefault(figure.of, (figure, row))
    held = {
        change.key.removeprefix("config.pace_ns.") for change in changes if change.key.startswith("config.pace_ns.")
    }
    ordered = sorted(by_stage.values(), key=lambda each: -abs(each[1].other - each[1].base))
    for figure, row in ordered[:MOST_NAMED]:
        at = "" if figure.statistic in ("typical", "mean") else f" at {figure.statistic}"
        why = ", as it is told to (pace_ns)" if figure.of in held else ""
        yield f"{figure.of} takes {longer(row, figure.unit)}{at}{why}"


def _waits(found: Rows, rows: Rows, stages: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Units that wait more where frames take longer, or less where shorter, those that were the busiest first."""
    frame_time = next((row.change for figure, row in found.items() if figure.measure == FRAME_TIME), 0.0)
    telling = [
        (figure, row)
        for figure, row in found.items()
        if figure.measure == IDLE and abs(row.change) >= TELLING_SHARE and row.change * frame_time >= 0
    ]
    busy = {figure.of: row.base for figure, row in rows.items() if figure.measure == BUSY}
    for figure, row in sorted(telling, key=lambda each: (each[1].change < 0, -busy.get(each[0].of, 0.0)))[:MOST_NAMED]:
        what = WAITS.get(figure.cause, f"is {figure.cause}")
        names = ", ".join(stages.get(figure.of, ()))
        yield f"unit {figure.of} ({names}) {what} {100 * row.other:.0f} % of the time, was {100 * row.base:.0f} %"


def _others(found: Rows) -> Iterator[str]:
    for figure, row in found.items():
        if figure.measure in (LOST, DROPPED):
            yield f"{figure.measure} ({figure.of}) {100 * row.other:.1f} % of the frames, was {100 * row.base:.1f} %"
        elif figure.measure == ERROR:
            yield f"error of {figure.of} {row.other:.4g} {figure.unit}".rstrip() + f", was {row.base:.4g}"
        elif figure.unit == BYTES:
            yield f"{figure.of} {figure.measure} {signed(row, figure.unit)}"


def _plain(figure: Figure, row: Difference) -> str:
    name = " ".join(part for part in (figure.measure, figure.cause, "of" if figure.of else "", figure.of) if part)
    return f"{name} ({figure.statistic}) {signed(row, figure.unit)}"


def longer(row: Difference, unit: str) -> str:
    """Such as `5 % longer (4.2 to 5.8)`."""
    word = "longer" if row.change > 0 else "shorter"
    sign = 1 if row.change > 0 else -1
    return f"{_amount(sign * row.change, row, unit)} {word}{_between(row, sign)}"


def signed(row: Difference, unit: str) -> str:
    """Such as `+48 % (44 to 52)`."""
    return f"{_amount(row.change, row, unit, '+')}{_between(row, 1)}"


def _between(row: Difference, sign: int) -> str:
    """The interval; nothing where both ends are the same to the last digit that is written."""
    if row.low is None or row.high is None:
        return ""
    scale = 100 if row.is_ratio else 1
    low, high = map(_number, sorted((sign * row.low * scale, sign * row.high * scale)))
    return f" ({low} to {high})" if low != high else ""


def _amount(value: float, row: Difference, unit: str, sign: str = "") -> str:
    """A change in its unit; of a share in points of percent."""
    if row.is_ratio or unit == SHARE:
        return f"{_number(100 * value, sign)} {'%' if row.is_ratio else 'points'}"
    return f"{_number(value, sign)} {unit}".rstrip()


def _number(value: float, sign: str = "") -> str:
    """Three digits, and no powers of ten."""
    return f"{value:{sign}.3g}" if abs(value) < MANY else f"{value:{sign}.0f}"
