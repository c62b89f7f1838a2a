"""The comparison of a base with one or several others, as data. Rule: this is all that table, JSON and page show."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from trilane.apps.comparison.configuration import Change, changes
from trilane.apps.comparison.difference import LEAST_FRAMES, MATTERS, MOST_FRAMES, Difference, Outcome
from trilane.apps.comparison.family import ALPHA, rejected
from trilane.apps.comparison.noise import remarks
from trilane.apps.comparison.rows import FRAME_TIME, Figure, Rows, margin_of, named, rows_of
from trilane.apps.comparison.sides import Kind, Side, Told
from trilane.apps.comparison.verdict import NO_DIFFERENCE, verdict

SCHEMA: Final = 1
METHOD: Final = (
    "intervals hold 95 %; that the verdict names a difference by chance has a probability of at most "
    f"{100 * ALPHA:.0f} % (Holm); no difference: surely less than {100 * MATTERS:.0f} %; cannot tell: neither"
)
SEVERAL: Final = (
    "of several runs a side: base and other are the arithmetic means of the runs' values; the change of a ratio is "
    "that of their geometric means, so it need not be the ratio of these means"
)


class Bounds(NamedTuple):
    """What bounded each run of either side, as in report.json; None where nobody knows. `outcome`: of the unit's name.

    Its share of the path is all that is known of the path, so that another unit's can be as large unless it is surely
    more than a half.
    """

    base: tuple[Mapping[str, Any] | None, ...]
    other: tuple[Mapping[str, Any] | None, ...]

    @property
    def outcome(self) -> Outcome:
        every = [bound["unit"] if bound else None for bound in (*self.base, *self.other)]
        units = [unit for unit in every if unit is not None]
        if len(units) < len(every):
            return Outcome.UNKNOWN
        base, other = ({unit["name"] for unit in side} for side in (units[: len(self.base)], units[len(self.base) :]))
        if len(base | other) == 1:
            return Outcome.SAME
        is_sure = all((unit["share_low"] or 0.0) > 0.5 for unit in units)
        return Outcome.DIFFERS if len(base) == len(other) == 1 and is_sure else Outcome.UNKNOWN


@dataclass(frozen=True)
class Comparison:
    """A side beside the base. `differing`: figures that differ, all of a comparison's together."""

    base: Side
    other: Side
    rows: Rows
    differing: tuple[Figure, ...]
    changes: tuple[Change, ...]
    verdict: str
    bounds: Bounds
    notes: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """One entry of `comparisons`."""
        return {
            "run": self.other.name,
            "verdict": self.verdict,
            "outcome": str(self.whole),
            "bound": {**self.bounds._asdict(), "outcome": str(self.bounds.outcome)},
            "changes": [change._asdict() for change in self.changes],
            "rows": [_row(figure, self) for figure in self.rows],
            "notes": list(self.notes),
        }

    @property
    def whole(self) -> Outcome:
        """That of the verdict."""
        if self.differing:
            return Outcome.DIFFERS
        return Outcome.SAME if self.verdict == NO_DIFFERENCE else Outcome.UNKNOWN

    def outcome(self, figure: Figure) -> Outcome:
        """Of one of the `rows`."""
        row = self.rows[figure]
        return row.outcome(differs=figure in self.differing, margin=margin_of(figure, row))

    def slower_than(self, limit: float) -> Outcome:
        """Whether the mean frame time is longer by more than the share `limit`: DIFFERS where it surely is."""
        figure = next(each for each in self.rows if each[:4] == (FRAME_TIME, "", "", "mean"))
        return exceeds(self.rows[figure], limit, differs=figure in self.differing)


def exceeds(row: Difference, limit: float, *, differs: bool) -> Outcome:
    """Whether a change is surely above `limit`, surely not, or neither."""
    if row.low is None or row.high is None:
        return Outcome.UNKNOWN
    if differs and row.low > limit:
        return Outcome.DIFFERS
    return Outcome.SAME if row.high <= limit else Outcome.UNKNOWN


def compare(base: Side, others: Sequence[Side]) -> list[Comparison]:
    """Each of `others` beside `base`."""
    return [_compared(base, other) for other in others]


def document(comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """What `trilane compare --json` prints; of several others, `verdict` names each, `changes` say whose they are."""
    several = len(comparisons) > 1
    return {
        "schema": SCHEMA,
        "base": comparisons[0].base.name,
        "verdict": "; ".join(f"{each.other.name}: {each.verdict}" if several else each.verdict for each in comparisons),
        "changes": [{"run": each.other.name, **change._asdict()} for each in comparisons for change in each.changes],
        "comparisons": [each.as_json() for each in comparisons],
        "method": METHOD,
    }


def _compared(base: Side, other: Side) -> Comparison:
    rows = rows_of(base, other)
    first = named(rows)
    differing = _differing(rows, first)
    if differing:
        differing += _differing(rows, [figure for figure in rows if figure not in first])
    changed = tuple(changes(base.runs[0].document, other.runs[0].document))
    said = verdict(rows, first, differing, changed, _stages(base.runs[0].document))
    bounds = Bounds(*(tuple(told.document.get("bound") for told in side.runs) for side in (base, other)))
    return Comparison(base, other, rows, differing, changed, said, bounds, tuple(_notes(base, other)))


def _differing(rows: Rows, figures: Sequence[Figure]) -> tuple[Figure, ...]:
    """Those of `figures` that differ, all of them together; those that chance does not touch are not counted."""
    tested = {figure: rows[figure].probability or 0.0 for figure in figures if rows[figure].probability is not None}
    uncertain = [figure for figure in tested if rows[figure].deviation]
    fallen = dict(zip(uncertain, rejected([tested[figure] for figure in uncertain]), strict=True))
    return tuple(figure for figure, probability in tested.items() if fallen.get(figure, probability < ALPHA))


def _stages(report: Mapping[str, Any]) -> dict[str, list[str]]:
    """Names of each unit's stages."""
    found: dict[str, list[str]] = {}
    for name, row in report["stages"].items():
        found.setdefault(row["unit"], []).append(name)
    return found


def _notes(base: Side, other: Side) -> list[str]:
    runs = {told.name: told for told in (*base.runs, *other.runs)}
    notes = remarks({name: told.document for name, told in runs.items()})
    if len(base.runs) > 1:
        notes.append(SEVERAL)
    return notes + [f"{name}: {text}" for name, told in runs.items() for text in _about(told)]


def _about(told: Told) -> Iterator[str]:
    """What a person should know of what there is of a run."""
    if told.kind is Kind.REPORT:
        yield "a report without a journal, so only summaries are compared, each as uncertain as the mean frame time"
    if told.kind is Kind.PREDICTION:
        yield "computed by a model, with the error that it expects of itself"
    if told.frames is None:
        return
    presented = told.document["frames"]["presented"]
    if told.remark:
        yield told.remark
    elif not told.frames.is_whole:
        yield "its journal ends before the run did: compared by the frames until then"
    if presented > MOST_FRAMES:
        yield f"compared by its last {MOST_FRAMES} frames"
    if presented <= LEAST_FRAMES:
        yield f"{presented} frames; to tell what differs, more than {LEAST_FRAMES} are needed"


def _row(figure: Figure, comparison: Comparison) -> dict[str, Any]:
    row = comparison.rows[figure]
    return {
        **figure._asdict(),
        "base": row.base,
        "other": row.other,
        "change": row.change,
        "low": row.low,
        "high": row.high,
        "is_ratio": row.is_ratio,
        "probability": row.probability,
        "differs": figure in comparison.differing,
        "outcome": str(comparison.outcome(figure)),
    }
