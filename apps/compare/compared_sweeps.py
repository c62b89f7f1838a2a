"""Compares two sweeps: the trials of each configuration with each other, and the change over all configurations.

Rule: a pair has the same configuration on both sides. Only a repeat that is done in both sweeps counts. Configurations
without such a repeat are named. The report in a trial's run folder is compared. Without a report, the result in the
trial's record is compared.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError

from trilane.apps.compare.comparison import (
    SCHEMA,
    Bounds,
    bound_of_runs,
    bounds_of,
    change_of,
    interval_of,
)
from trilane.apps.compare.difference import ALPHA, LEAST_FRAMES, Difference, Finding, combined, rejected
from trilane.apps.compare.gate import GatedPair
from trilane.apps.compare.rows import FRAME_TIME, MS, Figure, rows_of
from trilane.apps.compare.sides import (
    Change,
    ComparedFigures,
    ComparedRun,
    RunKind,
    Side,
    changes,
    compared_run,
    read_told,
)
from trilane.apps.run.report import REPORT_FILE, Report
from trilane.apps.run.verdict import MOST_OTHERS
from trilane.apps.sweep.store import TRIALS, TrialRecord, read_trials
from trilane.errors import BadInputError
from trilane.scheduler.stats import CONFIDENCE_TEXT

MEAN: Final = Figure(FRAME_TIME, "", "", "mean", MS)
METHOD: Final = (
    "trials of one configuration are compared with each other, repeats as several runs; intervals hold "
    f"{CONFIDENCE_TEXT}; that any of the trials that are said to differ does so by chance has a probability of at most "
    f"{100 * ALPHA:.0f} % (Holm); over all: the geometric mean of the ratios"
)


@dataclass(frozen=True)
class TrialPair:
    """One configuration in both sweeps.

    `sides`: figures of both sides, under the id of the configuration's first trial in the base.
    `options`: options of the configuration, by name.
    `differs`: whether the frame times differ, by a test of all pairs together.
    """

    sides: GatedPair
    options: Mapping[str, Any]
    differs: bool = False

    @property
    def runs(self) -> int:
        """The number of runs on each side."""
        return len(self.sides.base.runs)

    @property
    def frame_time(self) -> Difference:
        """The difference of the mean frame times."""
        return self.sides.rows[MEAN]

    @property
    def bounds(self) -> Bounds:
        """The bounds of the runs on both sides."""
        return bounds_of(self.sides.base, self.sides.other)

    @property
    def outcome(self) -> Finding:
        """The finding about the mean frame time."""
        return self.frame_time.outcome(differs=self.differs)


@dataclass(frozen=True)
class SweepComparison:
    """The comparison of the sweep `other` with the sweep `base`.

    `base`, `other`: folders of the sweeps, as the user gave them.
    `pairs`: configurations with a repeat that is done in both sweeps.
    `over_all`: difference of the mean frame times over all pairs.
    `left_out`: ids of trials of configurations that are not compared. The keys are `not_done`, for configurations
    without a repeat that is done in both sweeps, and `base_alone` and `other_alone`, for those in only one sweep.
    `changes`: changes of settings and machine that all pairs have.
    `notes`: facts that make the comparison less sure.
    """

    base: str
    other: str
    pairs: tuple[TrialPair, ...]
    over_all: Difference
    left_out: Mapping[str, tuple[str, ...]]
    changes: tuple[Change, ...]
    notes: tuple[str, ...]

    @property
    def verdict(self) -> str:
        """The verdict on the frame times, as a phrase."""
        differing = [pair for pair in self.pairs if pair.differs]
        of = f"{len(self.pairs)} trial{'s' * (len(self.pairs) > 1)}"
        whole = f"over all {change_of(self.over_all, MS)} ({interval_of(self.over_all, MS)})"
        if not differing:
            unsure = sum(pair.outcome is Finding.UNKNOWN for pair in self.pairs)
            if unsure == len(self.pairs):
                return f"it cannot be told whether any of {of} differs; {whole}"
            told = f"; of {unsure} it cannot be told" if unsure else ""
            return f"no difference in any of {of}{told}; {whole}"
        slower = sum(pair.frame_time.effect > 0 for pair in differing)
        return f"frame time differs in {len(differing)} of {of}, {slower} of them slower; {whole}"

    @property
    def bound(self) -> str:
        """The bounds in each sweep, and in how many trials the bound changed, in words; "" if no run names a bound."""
        base = [bound for pair in self.pairs for bound in pair.bounds.base]
        other = [bound for pair in self.pairs for bound in pair.bounds.other]
        if not any((*base, *other)):
            return ""
        found = [pair.bounds.outcome for pair in self.pairs]
        changed, unsure = found.count(Finding.DIFFERS), found.count(Finding.UNKNOWN)
        told = f", of {unsure} it cannot be told" if unsure else ""
        of = f"changed in {changed} of {len(found)} trial{'s' * (len(found) > 1)}{told}"
        return f"bound: {bound_of_runs(other)}; was {bound_of_runs(base)}; {of}"

    def as_json(self) -> dict[str, Any]:
        """Return the document that `trilane compare --json` prints for two sweeps."""
        return {
            "schema": SCHEMA,
            "base": self.base,
            "other": self.other,
            "verdict": self.verdict,
            "changes": [change._asdict() for change in self.changes],
            "over_all": self.over_all.as_json(),
            "trials": [
                {"id": pair.sides.name, "options": dict(pair.options), "runs": pair.runs}
                | {**pair.frame_time.as_json(), "differs": pair.differs, "outcome": str(pair.outcome)}
                | {"bound": pair.bounds.as_json()}
                for pair in self.pairs
            ],
            "left_out": {reason: list(names) for reason, names in self.left_out.items()},
            "notes": list(self.notes),
            "method": METHOD,
        }


def is_sweep(name: str) -> bool:
    try:
        return bool(name.strip()) and (Path(name) / TRIALS).is_file()
    except OSError:  # too long a name
        return False


def compare_sweeps(base: str, other: str) -> SweepComparison:
    """Compare two sweeps. `base`, `other`: their folders.

    Raises BadInputError if a sweep or report cannot be read, or if a trial has no command. Raises it also if a compared
    trial has no frame time, or is no run and no prediction. At least one repeat must be done in both sweeps.
    """
    first, second = (_configurations(Path(name)) for name in (base, other))
    found: list[TrialPair] = []
    left: dict[str, list[str]] = {"not_done": [], "base_alone": [], "other_alone": []}
    for key, of_base in first.items():
        name, of_other = _name(of_base), second.get(key, {})
        repeats = [each for each, record in of_base.items() if _is_done(record) and _is_done(of_other.get(each))]
        if repeats:
            sides = _pair(name, _side(base, of_base, repeats), _side(other, of_other, repeats))
            found.append(TrialPair(sides, of_base[repeats[0]].options))
        else:
            left["not_done" if of_other else "base_alone"].append(name)
    left["other_alone"] += [_name(of_other) for key, of_other in second.items() if key not in first]
    if not found:
        missing = f"no trial that {base} has too, done in both"
        remedy = "give two sweeps of one command, with the same options in the same words"
        raise BadInputError(other, missing, "trials of equal configuration", remedy)
    rows = [pair.frame_time for pair in found]
    fallen = iter(rejected([row.probability for row in rows if row.probability is not None]))
    pairs = tuple(replace(pair, differs=pair.frame_time.probability is not None and next(fallen)) for pair in found)
    shared = tuple(each for each in found[0].sides.changes if all(each in pair.sides.changes for pair in found))
    figures = [run.figures for pair in found for side in (pair.sides.base, pair.sides.other) for run in side.runs]
    left_out = {reason: tuple(names) for reason, names in left.items()}
    return SweepComparison(base, other, pairs, combined(rows), left_out, shared, tuple(_notes(figures)))


def _name(repeats: Mapping[int, TrialRecord]) -> str:
    return next(iter(repeats.values())).id


def _side(where: str, of: Mapping[int, TrialRecord], repeats: Sequence[int]) -> Side:
    return Side(where, tuple(_trial(where, of[each]) for each in repeats))


def _pair(name: str, base: Side, other: Side) -> GatedPair:
    """Return the two sides of the pair `name` with their figures.

    `base`, `other`: runs of one configuration in each sweep.
    Raises BadInputError if a run has no frame time.
    """
    rows = rows_of(base, other)
    if MEAN not in rows:
        raise BadInputError(base.name, "trials without a frame time", "a sweep of `run` or `predict`")
    return GatedPair(name, base, other, rows, tuple(changes(base.runs[0], other.runs[0])))


def _configurations(folder: Path) -> dict[str, dict[int, TrialRecord]]:
    """Return the trials of the sweep in `folder`, as {configuration: {number of the repeat: record of the trial}}.

    A configuration is the command and the options as JSON text. Records are in the order in which trials first ended.
    Raises BadInputError as `read_trials` does, and for a trial without a command.
    """
    found: dict[str, dict[int, TrialRecord]] = {}
    for record in read_trials(folder).values():
        words = record.command
        if len(words) < 2:
            raise BadInputError(folder / TRIALS, f"trial {record.id} without a command", "a sweep's trials")
        key = json.dumps([words[1:3] if words[1] == "bench" else words[1:2], record.options], sort_keys=True)
        found.setdefault(key, {})[record.repeat] = record
    return found


def _is_done(record: TrialRecord | None) -> bool:
    return record is not None and record.status == "done"


def _trial(sweep: str, record: TrialRecord) -> ComparedRun:
    """Return the run of a trial, from the report in its run folder or, without a report, from the result in its record.

    `sweep`: folder of the sweep. `record`: record of the trial.
    Raises BadInputError if the report cannot be read, or if the trial is no run and no prediction.
    """
    name, folder = record.id, record.folder or ""
    if folder not in ("", "..") and folder == Path(folder).name and _has_report(Path(sweep, folder)):
        return read_told(str(Path(sweep, folder)))
    document = record.result or {}
    if "expected_error" in document and "frame_time_ms" in document:
        return compared_run(name, RunKind.PREDICTION, document)
    try:
        return compared_run(name, RunKind.REPORT, Report.model_validate(document).as_json())
    except ValidationError:
        raise BadInputError(f"{sweep}: trial {name}", "no run", "a sweep of `run` or `predict`") from None


def _has_report(folder: Path) -> bool:
    try:
        return (folder / REPORT_FILE).is_file()
    except OSError:  # a name that is too long
        return False


def _notes(figures: Sequence[ComparedFigures]) -> Iterator[str]:
    """Yield remarks on other programs that ran at the same time, and on too few frames.

    `figures`: figures of all runs on both sides.
    """
    shares = [share for each in figures if (share := each.other_programs or 0.0) > MOST_OTHERS]
    if shares:
        runs = f"{len(shares)} of {len(figures)} runs"
        yield (
            f"other programs had more than {100 * MOST_OTHERS:.0f} % of the cores in {runs}, "
            f"{100 * max(shares):.0f} % at most, which makes their intervals wider"
        )
    presented = [each.frames.presented for each in figures if each.frames]
    if presented and min(presented) <= LEAST_FRAMES:
        yield f"{min(presented)} frames at the least; to tell what differs, more than {LEAST_FRAMES} are needed"
