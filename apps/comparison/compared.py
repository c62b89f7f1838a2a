"""The comparison of a base with one or several others, as data. Rule: this is all that table, JSON and page show."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from trilane.apps.comparison.configuration import Change, changes
from trilane.apps.comparison.difference import LEAST_FRAMES, MOST_FRAMES
from trilane.apps.comparison.family import ALPHA, rejected
from trilane.apps.comparison.noise import remarks
from trilane.apps.comparison.rows import FRAME_TIME, Figure, Rows, rows_of
from trilane.apps.comparison.sides import Kind, Side, Told
from trilane.apps.comparison.verdict import verdict
from trilane.errors import BadInputError

SCHEMA: Final = 1
METHOD: Final = (
    "intervals hold 95 %; that any of the figures that are said to differ does so by chance has a probability of at "
    f"most {100 * ALPHA:.0f} % (Holm)"
)
SEVERAL: Final = (
    "of several runs a side: base and other are the arithmetic means of the runs' values; the change is the mean over "
    "the pairs, of ratios the geometric one, so it need not be the ratio of these means"
)


@dataclass(frozen=True)
class Comparison:
    """A side beside the base. `differing`: figures that differ, all of a comparison's together."""

    base: Side
    other: Side
    rows: Rows
    differing: tuple[Figure, ...]
    changes: tuple[Change, ...]
    verdict: str
    notes: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """One entry of `comparisons`."""
        return {
            "run": self.other.name,
            "verdict": self.verdict,
            "changes": [change._asdict() for change in self.changes],
            "rows": [_row(figure, self) for figure in self.rows],
            "notes": list(self.notes),
        }

    @property
    def slower(self) -> float:
        """By which share the mean frame time is longer at the least, of those that differ; 0 where it is not."""
        figure = next((each for each in self.differing if each[:4] == (FRAME_TIME, "", "", "mean")), None)
        low = self.rows[figure].low if figure is not None else None
        return max(low or 0.0, 0.0)


def compare(base: Side, others: Sequence[Side]) -> list[Comparison]:
    """Each of `others` beside `base`. Raises BadInputError for a side that has not as many runs as the base."""
    for other in others:
        if len(other.runs) != len(base.runs):
            remedy = "runs stand in pairs, each in one: give as many on each side, or one on each"
            raise BadInputError(
                other.name, _runs(len(other.runs)), f"{_runs(len(base.runs))}, as {base.name} has", remedy
            )
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


def _runs(count: int) -> str:
    return "1 run" if count == 1 else f"{count} runs"


def _compared(base: Side, other: Side) -> Comparison:
    rows = rows_of(base, other)
    tested = [figure for figure, row in rows.items() if row.probability is not None and (row.base or row.other)]
    fallen = rejected([rows[figure].probability or 0.0 for figure in tested])
    differing = tuple(figure for figure, falls in zip(tested, fallen, strict=True) if falls)
    changed = tuple(changes(base.runs[0].document, other.runs[0].document))
    said = verdict(rows, differing, changed, _stages(base.runs[0].document))
    return Comparison(base, other, rows, differing, changed, said, tuple(_notes(base, other)))


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
    }
