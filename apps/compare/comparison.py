"""A comparison of one or more sides with a base, as data and in words.

Rule: table, JSON and page show only the content of a comparison. The verdict is `no difference`, begins with
`cannot tell`, or is a sentence. The sentence names the change of the frame time or, without one, of the latency. The
reasons follow in this order: instructions that differ, stages that take longer or shorter, units that wait more or
less, losses, drops, errors and bytes. Settings with a known effect come last.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from trilane.apps.compare.difference import ALPHA, LEAST_FRAMES, MATTERS, MOST_FRAMES, Difference, Finding, rejected
from trilane.apps.compare.rows import (
    BUSY,
    BYTES,
    DROPPED,
    ERROR,
    FRAME_TIME,
    IDLE,
    LATENCY,
    LOST,
    PACE,
    SERVICE,
    SHARE,
    WORK,
    Figure,
    Rows,
    margin_of,
    named,
    remarks,
    rows_of,
)
from trilane.apps.compare.run_frames import INSTRUCTION_TIME, INSTRUCTIONS
from trilane.apps.compare.sides import Change, ComparedRun, RunKind, Side, changes
from trilane.apps.explain.reasons import bound_text
from trilane.errors import BadInputError
from trilane.pipeline.run_metrics import Bound, PathShare
from trilane.scheduler.ledger import CAUSES
from trilane.scheduler.policy import POLICIES
from trilane.scheduler.stats import CONFIDENCE_TEXT

SCHEMA: Final = 1
METHOD: Final = (
    f"intervals hold {CONFIDENCE_TEXT}; that the verdict names a difference by chance has a probability of at most "
    f"{100 * ALPHA:.0f} % (Holm); no difference: surely less than {100 * MATTERS:.0f} %; cannot tell: neither"
)
SEVERAL: Final = (
    "a side with several runs shows the arithmetic mean of their values; the change of a ratio compares "
    "geometric means, so it may differ from the ratio of the means shown"
)
NO_DIFFERENCE: Final = str(Finding.SAME)
TOO_FEW: Final = f"{Finding.UNKNOWN}: too short"
#: The least change of a share of idle time that the verdict names.
TELLING_SHARE: Final = 0.05
MOST_NAMED: Final = 4
NOT_EXPLAINED: Final = "no stage, unit or setting alone explains it; the cores may have another speed"
WITHOUT_FRACTION: Final = 999.5
#: A setting and its new value -> how the verdict explains a difference by it.
REASONS: Final = {("policy", name): f"{policy.told} under {name}" for name, policy in POLICIES.items()}
WAITS: Final = {cause.name: cause.told for cause in CAUSES}
DASH: Final = "–"
IN_THOUSANDS: Final = 10_000


class Bounds(NamedTuple):
    """The bounds of the runs on both sides; None for a run with an unknown bound.

    `base`, `other`: bounds on each side, in the order of the runs.
    `outcome`: finding whether the bounding unit changed. A change is certain only if each side has one bounding unit,
    and no bound has rivals. If a report lacks the key `rivals`, the unit must surely have more than half of the path.
    """

    base: tuple[Bound | None, ...]
    other: tuple[Bound | None, ...]

    @property
    def outcome(self) -> Finding:
        every = [bound.unit if bound else None for bound in (*self.base, *self.other)]
        units = [unit for unit in every if unit is not None]
        if len(units) < len(every):
            return Finding.UNKNOWN
        base, other = ({unit.name for unit in side} for side in (units[: len(self.base)], units[len(self.base) :]))
        if len(base | other) == 1:
            return Finding.SAME
        is_sure = all(_is_sure(unit) for unit in units)
        return Finding.DIFFERS if len(base) == len(other) == 1 and is_sure else Finding.UNKNOWN

    def as_json(self) -> dict[str, Any]:
        """Return the value of `bound` in an entry of `comparisons` or `trials` of `trilane compare --json`."""
        sides = {name: [bound and bound.as_json() for bound in side] for name, side in self._asdict().items()}
        return {**sides, "outcome": str(self.outcome)}


def bounds_of(base: Side, other: Side) -> Bounds:
    """Return the bounds in the reports of the sides `base` and `other`."""
    return Bounds(*(tuple(told.figures.bound for told in side.runs) for side in (base, other)))


def _is_sure(unit: PathShare) -> bool:
    return (unit.share_low or 0.0) > 0.5 if unit.rivals is None else not unit.rivals


@dataclass(frozen=True)
class Comparison:
    """The comparison of the side `other` with the side `base`.

    `rows`: difference of each figure.
    `differing`: figures that differ significantly, by tests of many figures together.
    `changes`: settings and facts of the machine that changed.
    `verdict`: verdict in words, as the function `verdict` returns it.
    `bounds`: bounds of the runs on both sides.
    `notes`: remarks for the user.
    """

    base: Side
    other: Side
    rows: Rows
    differing: tuple[Figure, ...]
    changes: tuple[Change, ...]
    verdict: str
    bounds: Bounds
    notes: tuple[str, ...]

    @property
    def unsure(self) -> tuple[str, ...]:
        """Sentences about the runs that cannot be trusted, one for each such run."""
        return tuple(spoilt((*self.base.runs, *self.other.runs)))

    def as_json(self) -> dict[str, Any]:
        """Return the comparison as an entry of `comparisons` in the document of `trilane compare --json`."""
        return {
            "run": self.other.name,
            "verdict": self.verdict,
            "outcome": str(self.whole),
            "unsure": list(self.unsure),
            "bound": self.bounds.as_json(),
            "changes": [change._asdict() for change in self.changes],
            "rows": [
                {**figure._asdict(), **row.as_json(), "differs": figure in self.differing}
                | {"outcome": str(self.outcome(figure))}
                for figure, row in self.rows.items()
            ],
            "notes": list(self.notes),
        }

    @property
    def whole(self) -> Finding:
        """The finding about the whole comparison, as the verdict states it."""
        if self.differing:
            return Finding.DIFFERS
        return Finding.SAME if self.verdict == NO_DIFFERENCE else Finding.UNKNOWN

    def outcome(self, figure: Figure) -> Finding:
        """Return the finding about `figure`, a key of `rows`."""
        row = self.rows[figure]
        return row.outcome(differs=figure in self.differing, margin=margin_of(figure, row))


def document(comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """Return the document of `trilane compare --json`.

    `comparisons`: one or more, with the same base. If there are several, `verdict` names each side. Each entry of
    `changes` names its side as `run`.
    """
    several = len(comparisons) > 1
    return {
        "schema": SCHEMA,
        "base": comparisons[0].base.name,
        "verdict": "; ".join(f"{each.other.name}: {each.verdict}" if several else each.verdict for each in comparisons),
        "changes": [{"run": each.other.name, **change._asdict()} for each in comparisons for change in each.changes],
        "comparisons": [each.as_json() for each in comparisons],
        "method": METHOD,
    }


def compare(base: Side, other: Side) -> Comparison:
    """Return the comparison of the side `other` with the side `base`.

    Raises BadInputError if the sides have no time in common.
    """
    rows = rows_of(base, other)
    if not rows:
        names = ", ".join([*base.runs[0].figures.stages][:8])
        raise BadInputError(other.name, f"no time that {base.name} has too", f"a measurement with a name of: {names}")
    first = named(rows)
    differing = _differing(rows, first)
    if differing:
        differing += _differing(rows, [figure for figure in rows if figure not in first])
    changed = tuple(changes(base.runs[0], other.runs[0]))
    said = verdict(rows, first, differing, changed, _stages(base.runs[0]))
    return Comparison(base, other, rows, differing, changed, said, bounds_of(base, other), tuple(_notes(base, other)))


def _differing(rows: Rows, figures: Sequence[Figure]) -> tuple[Figure, ...]:
    """Return the `figures` with a significant difference.

    All figures with scatter are tested together. A figure without scatter needs no test.
    `rows`: difference of each figure.
    """
    tested = {figure: rows[figure].probability or 0.0 for figure in figures if rows[figure].probability is not None}
    uncertain = [figure for figure in tested if rows[figure].deviation]
    fallen = dict(zip(uncertain, rejected([tested[figure] for figure in uncertain]), strict=True))
    return tuple(figure for figure, probability in tested.items() if fallen.get(figure, probability < ALPHA))


def _stages(run: ComparedRun) -> dict[str, list[str]]:
    """Return the names of the stages of each unit, by the unit's name."""
    found: dict[str, list[str]] = {}
    for name, stage in run.figures.stages.items():
        found.setdefault(stage.unit, []).append(name)
    return found


def _notes(base: Side, other: Side) -> list[str]:
    runs = {told.name: told for told in (*base.runs, *other.runs)}
    notes = remarks(runs.values())
    if len(base.runs) > 1:
        notes.append(SEVERAL)
    return notes + [f"{name}: {text}" for name, told in runs.items() for text in _about(told)]


def spoilt(runs: Sequence[ComparedRun]) -> Iterator[str]:
    """Yield a sentence for each of `runs` that cannot be trusted."""
    for told in runs:
        if not told.trust.trusted:
            yield f"{told.name} is {told.trust.said}"


def _about(told: ComparedRun) -> Iterator[str]:
    """Yield remarks on the data of the run `told`: kind of data, number of frames, end of the journal."""
    if told.kind is RunKind.REPORT:
        yield "a report without a journal, so only summaries are compared, each as uncertain as the mean frame time"
    if told.kind is RunKind.TIMES:
        yield "imported times, so only what has a name on both sides is compared; nobody knows what else ran"
    if told.kind is RunKind.PREDICTION:
        yield "computed by a model, with the error that it expects of itself"
    if told.frames is None or told.figures.frames is None:
        return
    presented = told.figures.frames.presented
    if told.remark:
        yield told.remark
    elif not told.frames.is_whole:
        yield "its journal ends before the run did: compared by the frames until then"
    if presented > MOST_FRAMES:
        yield f"compared by its last {MOST_FRAMES} frames"
    if presented <= LEAST_FRAMES:
        yield f"{presented} frames; to tell what differs, more than {LEAST_FRAMES} are needed"


def verdict(
    rows: Rows,
    named: Sequence[Figure],
    differing: Sequence[Figure],
    changes: Sequence[Change],
    stages: Mapping[str, Sequence[str]],
) -> str:
    """Return the verdict: `no difference`, a text that begins with `cannot tell`, or a sentence on what differs.

    `rows`: difference of each figure.
    `named`: figures that decide the verdict.
    `differing`: figures that differ, tested together.
    `changes`: changes of configuration and machine.
    `stages`: names of the stages of each unit.
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
    """Return the verdict if no figure surely differs: `no difference`, or a text that begins with `cannot tell`.

    If every stage has counted instructions and `changes` is empty, only the instructions decide. Otherwise, times
    decide.
    `rows`, `named`, `changes`, `stages`: as in `verdict`.
    """
    counted = [figure for figure in named if figure.measure == INSTRUCTIONS]
    is_counted = len(counted) == sum(map(len, stages.values())) > 0 and not changes
    rested_on = counted if is_counted else [figure for figure in named if figure.measure in (FRAME_TIME, WORK, SERVICE)]
    if all(rows[figure].probability is None for figure in rested_on):
        return TOO_FEW
    unknown = {
        figure: rows[figure]
        for figure in rested_on
        if rows[figure].outcome(differs=False, margin=margin_of(figure, rows[figure])) is Finding.UNKNOWN
    }
    if not unknown:
        return NO_DIFFERENCE
    ordered = sorted(
        unknown.items(), key=lambda each: (each[0].measure != FRAME_TIME, -abs(each[1].other - each[1].base))
    )
    said = (f"{figure.of or figure.measure} {signed(row, figure.unit)}" for figure, row in ordered[:MOST_NAMED])
    return f"{Finding.UNKNOWN}: {', '.join(said)}: runs of one kind may differ by as much"


def _programs(found: Rows) -> Iterator[str]:
    """Yield phrases about stages whose number of instructions, or time of an instruction, differs.

    All phrases about the number of instructions come first. `found`: rows that differ.
    """
    for figure, row in found.items():
        if figure.measure == INSTRUCTIONS:
            sign = 1 if row.change > 0 else -1
            more = f"{_amount(sign * row.change, row, figure.unit)} {'more' if sign > 0 else 'fewer'} instructions"
            yield f"{figure.of} executes {more}{_between(row, sign, figure.unit)}"
    for figure, row in found.items():
        if figure.measure == INSTRUCTION_TIME:
            yield f"an instruction of {figure.of} takes {longer(row, figure.unit)}, as the machine lets it"


def _heads(found: Rows) -> Iterator[str]:
    """Yield the change of the frame time or, if the frame time does not differ, of the latency.

    The change of the mean is preferred. If only percentiles differ, the first of them is named. `found`: rows that
    differ.
    """
    for measure in (FRAME_TIME, LATENCY):
        mine = {figure: row for figure, row in found.items() if figure.measure == measure}
        of_mean = [figure for figure in mine if figure.statistic == "mean"] or [*mine][:1]
        for figure in of_mean:
            name = measure if figure.statistic == "mean" else f"{figure.statistic} of the {measure}"
            yield f"{name} {signed(mine[figure], figure.unit)}"
        if of_mean:
            return


def _works(found: Rows, rows: Rows, changes: Sequence[Change]) -> Iterator[str]:
    """Yield a phrase for each stage that takes longer or shorter, the largest change in ms first, `MOST_NAMED` at most.

    Stages whose instructions differ are left out, because `_programs` names them.
    `found`: rows that differ.
    `rows`: all rows.
    `changes`: changes of settings, which may explain the change of a stage.
    """
    by_stage: dict[str, tuple[Figure, Difference]] = {}
    counted = {figure.of for figure in found if figure.measure in (INSTRUCTIONS, INSTRUCTION_TIME)}
    measure = WORK if any(figure.measure == WORK for figure in rows) else SERVICE
    for figure, row in found.items():
        if figure.measure == measure and figure.of not in counted:
            by_stage.setdefault(figure.of, (figure, row))
    held = {change.key.removeprefix(PACE) for change in changes if change.key.startswith(PACE)}
    ordered = sorted(by_stage.values(), key=lambda each: -abs(each[1].other - each[1].base))
    for figure, row in ordered[:MOST_NAMED]:
        at = "" if figure.statistic in ("typical", "mean") else f" at {figure.statistic}"
        why = ", as it is told to (pace_ns)" if figure.of in held else ""
        yield f"{figure.of} takes {longer(row, figure.unit)}{at}{why}"


def _waits(found: Rows, rows: Rows, stages: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield phrases for units that wait more if frames take longer, or less if frames take less time.

    If the frame time does not differ, both kinds are yielded. Changes below `TELLING_SHARE` are left out. Increases
    come first. Within increases and decreases, the units that were busiest in the base come first. At most `MOST_NAMED`
    phrases are yielded.
    `found`: rows that differ.
    `rows`: all rows.
    `stages`: names of the stages of each unit.
    """
    frame_time = next((row.change for figure, row in found.items() if figure.measure == FRAME_TIME), 0.0)
    telling = [
        (figure, row)
        for figure, row in found.items()
        if figure.measure == IDLE and abs(row.change) >= TELLING_SHARE and row.change * frame_time >= 0
    ]
    busy = {figure.of: row.base for figure, row in rows.items() if figure.measure == BUSY}
    for figure, row in sorted(telling, key=lambda each: (each[1].change < 0, -busy.get(each[0].of, 0.0)))[:MOST_NAMED]:
        what = WAITS[figure.cause]
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
    """Return a change of a time in words, such as `5 % longer (4.2 to 5.8)`.

    `row`: difference with the change and its interval. `unit`: unit of the figure.
    """
    word = "longer" if row.change > 0 else "shorter"
    sign = 1 if row.change > 0 else -1
    return f"{_amount(sign * row.change, row, unit)} {word}{_between(row, sign, unit)}"


def signed(row: Difference, unit: str) -> str:
    """Return a change with its sign, such as `+48 % (44 to 52)`.

    `row`: difference with the change and its interval. `unit`: unit of the figure.
    """
    return f"{_amount(row.change, row, unit, '+')}{_between(row, 1, unit)}"


def _between(row: Difference, sign: int, unit: str) -> str:
    """Return the interval of a change, such as ` (44 to 52)`; "" if it is unknown or rounds to a single number.

    `row`: difference with the interval.
    `sign`: 1, or -1 to show the interval of the opposite change.
    `unit`: unit of the figure.
    """
    if row.low is None or row.high is None:
        return ""
    scale = 100 if row.is_ratio or unit == SHARE else 1
    low, high = map(_number, sorted((sign * row.low * scale, sign * row.high * scale)))
    return f" ({low} to {high})" if low != high else ""


def _amount(value: float, row: Difference, unit: str, sign: str = "") -> str:
    """Return a change as text with its unit: a ratio in percent, a share in percentage points.

    `value`: the change of `row`, or the opposite change.
    `row`: difference with the change.
    `unit`: unit of the figure.
    `sign`: `+` to write a sign before positive numbers too, "" for a minus only.
    """
    if row.is_ratio or unit == SHARE:
        return f"{_number(100 * value, sign)} {'%' if row.is_ratio else 'points'}"
    return f"{_number(value, sign)} {unit}".rstrip()


def _number(value: float, sign: str = "") -> str:
    """Return a number as text with three significant digits; from 1000 on, rounded to an integer, without exponent.

    `sign`: as in `_amount`.
    """
    return f"{value:{sign}.3g}" if abs(value) < WITHOUT_FRACTION else f"{value:{sign}.0f}"


def name_of(figure: Figure) -> str:
    """Return the name of a figure, such as `idle of dsp: starved`."""
    of = f" of {figure.of}" if figure.of else ""
    cause = f": {figure.cause}" if figure.cause else ""
    return f"{figure.measure}{of}{cause}"


def value_of(value: float, unit: str) -> str:
    """Return `value` of a figure as text with its `unit`; a share is in percent."""
    if unit == BYTES:
        return f"{value:,.0f} {unit}"
    if unit == "" and abs(value) >= IN_THOUSANDS:
        return f"{value:,.0f}"
    return f"{100 * value:.1f} %" if unit == SHARE else f"{value:.4g} {unit}".rstrip()


def change_of(row: Difference, unit: str) -> str:
    """Return the change in `row` as text: a ratio in percent, a share in percentage points, other changes in `unit`."""
    return _scaled(row.change, row, unit)


def interval_of(row: Difference, unit: str) -> str:
    """Return the 95 % interval of the change in `row`, such as `-1.2 to +3.4`; a dash if the interval is unknown.

    `unit`: unit of the figure.
    """
    if row.low is None or row.high is None:
        return DASH
    return f"{_scaled(row.low, row, unit, with_unit=False)} to {_scaled(row.high, row, unit, with_unit=False)}"


def _scaled(value: float, row: Difference, unit: str, *, with_unit: bool = True) -> str:
    if row.is_ratio or unit == SHARE:
        name = "%" if row.is_ratio else "points"
        return f"{100 * value:+.1f} {name}" if with_unit else f"{100 * value:+.1f}"
    return f"{value:+.4g} {unit}".rstrip() if with_unit else f"{value:+.4g}"


def bounds_text(bounds: Bounds) -> str:
    """Return the bounds of the other side and of the base in words; "" if no bound is known, as in predictions."""
    if not any((*bounds.base, *bounds.other)):
        return ""
    changed = " changed" if bounds.outcome is Finding.DIFFERS else ""
    unsure = ": whether it changed cannot be told" if bounds.outcome is Finding.UNKNOWN else ""
    return f"bound{changed}: {bound_of_runs(bounds.other)}; was {bound_of_runs(bounds.base)}{unsure}"


def bound_of_runs(bounds: Sequence[Bound | None]) -> str:
    """Return the bound of a single run in words. For several runs, return how many runs each unit bounded.

    `bounds`: bound of each run; None if it is unknown.
    """
    if len(bounds) == 1:
        return bound_text(bounds[0].as_json()) if bounds[0] else "not known"
    names = Counter(bound.unit.name if bound else "not known" for bound in bounds)
    return ", ".join(f"{name} in {count} of {len(bounds)} runs" for name, count in names.most_common())


def setting(value: Any) -> str:
    """Return the value of a setting as text; a dash for None, which stands for a missing setting."""
    return DASH if value is None else str(value)
