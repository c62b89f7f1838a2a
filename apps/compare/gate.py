"""A comparison as a gate: each limit is kept, broken, or its outcome is unknown.

Rule: a pass needs proof. A limit is broken if a figure surely became worse, and its interval reaches beyond the limit.
A limit is kept if the whole interval lies within the limit, on a quiet machine. Otherwise, the outcome is unknown, and
the gate states how many runs would decide, if more runs can decide.

The limit `slower` judges the frame time without the share of other programs, and the time, CPU time and counted
instructions of each stage. Counts differ by about 0.1 % between equal runs. They alone decide this limit if every stage
has counts, no setting changed, and the frame time does not contradict the counts.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import expm1, inf, log1p, sqrt
from typing import Any, Final, NamedTuple

from trilane.apps.compare.comparison import change_of, interval_of, name_of, spoilt
from trilane.apps.compare.difference import ALPHA, Difference, rejected
from trilane.apps.compare.rows import (
    CHECKED,
    DROPPED,
    FRAME_TIME,
    LATENCY,
    LOST,
    SERVICE,
    WORK,
    Figure,
    Rows,
    check_rows,
    relief_of,
)
from trilane.apps.compare.run_frames import CPU, INSTRUCTIONS
from trilane.apps.compare.sides import Change, ComparedRun, Side
from trilane.errors import BadInputError, did_you_mean
from trilane.scheduler.stats import student_quantile, student_tails

#: Largest number of runs on each side that `runs_needed` considers.
MOST_RUNS: Final = 200
PERCENT, DECIBELS = "%", "dB"
#: A stage's CPU time and its time on the core count as equal if they differ by at most this share.
SAME_TIME: Final = 0.05
#: Measures that are judged without the share of other programs.
WALL: Final = (FRAME_TIME, LATENCY)
MOST_SAID: Final = 4


class LimitOutcome(StrEnum):
    """The outcome of a limit: kept, broken, or unknown."""

    KEPT = "kept"
    BROKEN = "broken"
    UNKNOWN = "cannot tell"


class GateMetric(NamedTuple):
    """A metric that may have a limit.

    `says`: phrase for a broken limit.
    `of`: figures of the metric, as (measure, statistic).
    `unit`: unit of the limit.
    `is_timed`: whether other programs change its figures.
    `sign`: 1 if more is worse, -1 if less is worse.
    """

    says: str
    of: tuple[tuple[str, str], ...]
    unit: str = PERCENT
    is_timed: bool = True
    sign: int = 1


#: Name in --fail-if -> metric. The limit of a share of the frames is in percentage points.
METRICS: Final = {
    "slower": GateMetric(
        "frames or the jobs of any stage take longer",
        (
            (FRAME_TIME, "mean"),
            (INSTRUCTIONS, "mean"),
            (CPU, "typical"),
            (CPU, "mean"),
            (WORK, "typical"),
            (SERVICE, "mean"),
        ),
    ),
    "frame-time": GateMetric("frames take longer in the mean", ((FRAME_TIME, "mean"),)),
    "frame-time-p99": GateMetric("the slowest 1 % of the frames take longer", ((FRAME_TIME, "p99"),)),
    "latency": GateMetric("frames are shown later in the mean", ((LATENCY, "mean"),)),
    "latency-p99": GateMetric("the latest 1 % of the frames are shown later", ((LATENCY, "p99"),)),
    "instructions": GateMetric("a stage executes more instructions", ((INSTRUCTIONS, "mean"),), is_timed=False),
    "cpu": GateMetric("a stage takes more CPU time", ((CPU, "typical"), (CPU, "mean"))),
    "lost": GateMetric("more of the frames are lost or dropped", ((LOST, "share"), (DROPPED, "share"))),
    "psnr": GateMetric("the frames of --check are worse in the mean", ((CHECKED, "psnr_db"),), DECIBELS, False, -1),
    "worst-psnr": GateMetric("the worst frame of --check is worse", ((CHECKED, "worst_psnr_db"),), DECIBELS, False, -1),
}
#: Measure -> why a comparison may lack it.
ABSENT: Final = {
    CHECKED: "not every run was made with --check",
    INSTRUCTIONS: "not every run has counted instructions (`trilane doctor` says whether this machine counts them)",
}


class Gate(NamedTuple):
    """A limit: how much worse than the base a run may be in one metric.

    `name`: key of METRICS.
    `limit`: largest permitted change for the worse, as a share of the base or in dB. For a share of the frames, it is a
    difference of shares.
    `text`: the limit as its option writes it, such as `slower=5%`.
    """

    name: str
    limit: float
    text: str

    @property
    def metric(self) -> GateMetric:
        return METRICS[self.name]


def read_gate(text: str, option: str = "--fail-if") -> Gate:
    """Return the gate in a text such as `slower=5%` or `psnr=0.5dB`.

    `text`: metric and limit.
    `option`: name of the option, for errors.
    Raises BadInputError for an unknown metric or a wrong unit; the error names the valid ones.
    """
    name, _, value = (part.strip() for part in text.partition("="))
    if name not in METRICS:
        expected = f"METRIC=LIMIT with one of {', '.join(METRICS)}"
        raise BadInputError(option, repr(text), expected, did_you_mean(name, METRICS))
    unit = METRICS[name].unit
    found = re.fullmatch(rf"(\d+(?:\.\d+)?)\s*{unit}", value)
    if found is None:
        raise BadInputError(option, repr(text), f"{name}= and a number with {unit}, such as {name}=5{unit}")
    return Gate(name, float(found[1]) / (100 if unit == PERCENT else 1), f"{name}={found[1]}{unit}")


@dataclass(frozen=True)
class GatedPair:
    """Two sides to judge.

    `name`: name of the other side; for two sweeps, name of the configuration.
    `base`, `other`: runs of each side.
    `rows`: difference of each figure.
    `changes`: settings and facts of the machine that changed.
    """

    name: str
    base: Side
    other: Side
    rows: Rows
    changes: Sequence[Change]


class Weighed(NamedTuple):
    """One figure against its limit.

    `figure`: the figure. `row`: its difference.
    `least`, `most`: smallest and largest change for the worse that remain after known causes explain a part. For a
    ratio, both are logarithms.
    `limit`: limit on the same scale.
    `probability`: probability that runs of one kind are worse by `least` or more.
    `outcome`: outcome of this figure alone.
    `runs`: number of runs on each side that would decide; inf for more than `MOST_RUNS`, None if no number would decide
    or none is needed.
    """

    figure: Figure
    row: Difference
    least: float
    most: float
    limit: float
    probability: float
    outcome: LimitOutcome = LimitOutcome.UNKNOWN
    runs: float | None = None

    @property
    def is_near(self) -> bool:
        """Whether `least` exceeds the limit by at most one standard deviation."""
        return self.row.deviation is not None and self.least - self.row.deviation <= self.limit

    @property
    def said(self) -> str:
        """The figure in words: its change, the interval, and the change without the share of other programs."""
        unit = self.figure.unit
        change = f"{name_of(self.figure)} {change_of(self.row, unit)}"
        if self.row.deviation != 0:
            change += f" ({interval_of(self.row, unit)})"
        if self.figure.measure not in WALL or self.least == self.most:
            return change
        left = self.least if self.least < self.row.effect else self.most
        return f"{change}, {100 * expm1(left):+.1f} % with other programs' share taken out"


class JudgedLimit(NamedTuple):
    """The judgement of one limit for one pair.

    `gate`: the limit.
    `name`: name of the pair.
    `outcome`: outcome of the limit.
    `reason`: reason of the outcome in words.
    `figures`: figures that were judged.
    `runs`: number of runs on each side that would decide for all figures of the limit; inf for more than `MOST_RUNS`.
    None if no number would decide, or if the outcome needs no more runs.
    """

    gate: Gate
    name: str
    outcome: LimitOutcome
    reason: str
    figures: tuple[Weighed, ...]
    runs: float | None = None

    @property
    def said(self) -> str:
        """The limit, the outcome and the reason in one line."""
        return f"{self.gate.text}: {self.outcome}: {self.reason}"

    def as_json(self) -> dict[str, Any]:
        """Return the judgement as an entry of `gates` in the output of `trilane compare --json`."""
        return {
            "run": self.name,
            "limit": self.gate.text,
            "outcome": str(self.outcome),
            "reason": self.reason,
            "runs_needed": None if self.runs is None or self.runs == inf else int(self.runs),
            "figures": [
                {**each.figure._asdict(), "change": each.row.change, "low": each.row.low, "high": each.row.high}
                | {"outcome": str(each.outcome)}
                for each in self.figures
            ],
        }


def whole(judged: Sequence[JudgedLimit]) -> LimitOutcome:
    """Return the outcome of all limits together.

    The result is BROKEN if any limit is broken. Without a broken limit, it is UNKNOWN if the outcome of any limit is
    unknown, otherwise KEPT.
    """
    found = [each.outcome for each in judged]
    return next(
        (outcome for outcome in (LimitOutcome.BROKEN, LimitOutcome.UNKNOWN) if outcome in found), LimitOutcome.KEPT
    )


def judge(gates: Sequence[Gate], pairs: Sequence[GatedPair]) -> list[JudgedLimit]:
    """Return the judgement of every limit for every pair.

    The judgements are in the order of `pairs`, and for each pair in the order of `gates`. All figures are tested
    together, so that false alarms are rare.
    """
    asked = [(gate, pair, list(_weighed(gate, pair))) for pair in pairs for gate in gates]
    every = [each for _, _, figures in asked for each in figures if each.row.deviation]
    fallen = rejected([each.probability for each in every])
    surely = {id(each) for each, falls in zip(every, fallen, strict=True) if falls}
    found = []
    for gate, pair, figures in asked:
        settled = tuple(_settled(each, id(each) in surely, len(every), pair) for each in figures)
        outcome, reason, runs = _judged(gate, pair, settled)
        found.append(JudgedLimit(gate, pair.name, outcome, reason, settled, runs))
    return found


def _weighed(gate: Gate, pair: GatedPair) -> Iterator[Weighed]:
    relief, metric = relief_of(pair.base, pair.other), gate.metric
    rows = check_rows(pair.base, pair.other) if metric.of[0][0] == CHECKED else pair.rows
    is_quiet = not [*spoilt(_runs(pair))]
    works = {figure.of: row for figure, row in rows.items() if (figure.measure, figure.statistic) == (WORK, "typical")}
    for figure, row in rows.items():
        if (figure.measure, figure.statistic) not in metric.of:
            continue
        if _is_said(figure, row, works.get(figure.of), metric, is_quiet):
            continue
        down, up = (min(relief, 0.0), max(relief, 0.0)) if figure.measure in WALL else (-row.explained, row.explained)
        worse = metric.sign * row.effect
        least, most = worse + down, worse + up
        limit = log1p(gate.limit) if row.is_ratio else gate.limit
        yield Weighed(figure, row, least, most, limit, _chance_of(least, row))


def _is_said(figure: Figure, row: Difference, work: Difference | None, metric: GateMetric, is_quiet: bool) -> bool:
    """Return whether `figure` adds nothing to `work`, so that the figure is not judged.

    Both comparisons allow for `SAME_TIME`. CPU time adds nothing if it is as long as `work`. Service time adds nothing
    if it did not grow more than `work`. The mean service time shows if a few jobs take much longer; the typical time
    does not. On a machine that is not quiet, other programs may be the cause, so service time is not judged there. If
    the metric does not judge `work`, every figure adds something.
    `row`: difference of the figure.
    `work`: difference of the stage's typical time on its core; None if it is unknown.
    `metric`: metric with the limit.
    `is_quiet`: whether all runs can be trusted.
    """
    if work is None or (WORK, "typical") not in metric.of:
        return False
    if figure.measure == SERVICE:
        return not is_quiet or row.other * work.base <= (1 + SAME_TIME) * row.base * work.other
    alike = all(abs(mine - its) <= SAME_TIME * its for mine, its in ((row.base, work.base), (row.other, work.other)))
    return figure.measure == CPU and alike


def _chance_of(least: float, row: Difference) -> float:
    """Return the one-sided probability that runs of one kind are worse by `least` or more.

    `row`: difference with the deviation. The probability is 1 if `least` is not above 0, or if the deviation is
    unknown.
    """
    if least <= 0 or row.deviation is None:
        return 1.0
    return student_tails(least / row.deviation, row.freedom) / 2 if row.deviation else 0.0


def _settled(each: Weighed, is_sure: bool, tests: int, pair: GatedPair) -> Weighed:
    """Return `each` with its outcome. If the outcome is unknown, add the number of runs that would decide.

    `each`: figure against its limit.
    `is_sure`: whether the figure is surely worse.
    `tests`: number of figures that are tested together.
    `pair`: pair with the runs of both sides.
    """
    row = each.row
    if row.deviation is None:
        return each
    if each.most + student_quantile(row.freedom) * row.deviation <= each.limit:
        return each._replace(outcome=LimitOutcome.KEPT)
    if is_sure or (row.deviation == 0 and each.least > 0):
        return each._replace(outcome=LimitOutcome.BROKEN)
    return each._replace(runs=runs_needed(each, (len(pair.base.runs), len(pair.other.runs)), tests))


def runs_needed(each: Weighed, sizes: tuple[int, int], tests: int) -> float | None:
    """Return how many runs on each side would decide, as in `Weighed.runs`.

    Further runs are assumed to have the same mean and scatter.
    `each`: figure against its limit.
    `sizes`: present numbers of runs: base, other side.
    `tests`: number of figures that are tested together.
    """
    if each.row.deviation is None or (each.most >= each.limit and each.least <= 0):
        return None
    of_one = each.row.deviation / sqrt(sum(1 / size for size in sizes))
    known = each.row.freedom - sum(sizes) + 2
    for runs in range(max(sizes) + 1, MOST_RUNS + 1):
        deviation, freedom = of_one * sqrt(2 / runs), known + 2 * (runs - 1)
        if each.most + student_quantile(freedom) * deviation <= each.limit:
            return runs
        if each.least > 0 and student_tails(each.least / deviation, freedom) / 2 <= ALPHA / tests:
            return runs
    return inf


def _judged(gate: Gate, pair: GatedPair, figures: tuple[Weighed, ...]) -> tuple[LimitOutcome, str, float | None]:
    """Return outcome, reason and number of runs of a `JudgedLimit`."""
    if worse := [each for each in figures if each.outcome is LimitOutcome.BROKEN]:
        return LimitOutcome.BROKEN, f"{gate.metric.says}: {_list(worse)}", None
    if not figures and gate.metric is METRICS["lost"] and all(run.figures.frames for run in _runs(pair)):
        return LimitOutcome.KEPT, "no run lost or dropped a frame", None
    if not figures:
        return LimitOutcome.UNKNOWN, ABSENT.get(gate.metric.of[0][0], "the two sides share no such figure"), None
    if gate.metric.of[0][0] != CHECKED and (missing := _missing(pair)):
        return LimitOutcome.UNKNOWN, f"not on both sides: {', '.join(missing)}", None
    unsure = [*spoilt(_runs(pair))]
    decisive = _decisive(gate, pair, figures)
    unknown = [each for each in decisive if each.outcome is LimitOutcome.UNKNOWN]
    if not unknown and unsure and gate.metric.is_timed:
        return LimitOutcome.UNKNOWN, f"{'; '.join(unsure)}; repeat it", None
    if not unknown:
        return LimitOutcome.KEPT, _list(decisive), None
    counts = [each.runs for each in unknown]
    runs = None if None in counts else max(count for count in counts if count is not None)
    return LimitOutcome.UNKNOWN, f"{_list(unknown)}; {_remedy(unknown, runs, unsure)}", runs


def _missing(pair: GatedPair) -> list[str]:
    """Return the names of the stages that are in some runs of `pair`, but not in all. Their change is unknown."""
    first, *rest = ({*run.figures.stages} for run in _runs(pair))
    return sorted(first.union(*rest) - first.intersection(*rest))


def _runs(pair: GatedPair) -> tuple[ComparedRun, ...]:
    return (*pair.base.runs, *pair.other.runs)


def _decisive(gate: Gate, pair: GatedPair, figures: Sequence[Weighed]) -> list[Weighed]:
    """Return the figures that must keep the limit.

    For the limit `slower`, these are only the counted instructions, if every stage has counts and no setting changed. A
    frame time that is not near the limit contradicts the counts, and must then keep the limit too. In all other cases,
    these are all `figures`.
    `gate`: the limit. `pair`: the two sides.
    """
    counted = [each for each in figures if each.figure.measure == INSTRUCTIONS]
    frames = [each for each in figures if each.figure.measure == FRAME_TIME]
    stages = pair.base.runs[0].figures.stages
    is_counted = len(counted) == len(stages) > 0 and not pair.changes and gate.name == "slower"
    if is_counted:
        return [*counted, *(each for each in frames if not each.is_near)]
    return [*figures]


def _remedy(unknown: Sequence[Weighed], runs: float | None, unsure: Sequence[str]) -> str:
    if any(each.row.deviation is None for each in unknown):
        return "more frames tell"
    quiet = f"; {'; '.join(unsure)}" if unsure else ""
    if runs is None:
        return f"other programs or the cores' own speed may explain it, so no number of runs tells: repeat it{quiet}"
    if runs == inf:
        return f"more than {MOST_RUNS} runs of each side would be needed (A1,A2,A3){quiet}"
    return f"about {int(runs)} runs of each side would be needed (A1,A2,A3){quiet}"


def _list(figures: Sequence[Weighed]) -> str:
    first = sorted(figures, key=lambda each: each.limit - each.most)[:MOST_SAID]
    more = f", {len(figures) - len(first)} more" if len(figures) > len(first) else ""
    return ", ".join(each.said for each in first) + more


def as_json(judged: Sequence[JudgedLimit]) -> Mapping[str, Any]:
    """Return the keys that gates add to the output of `trilane compare --json`: `outcome` and `gates`."""
    return {"outcome": str(whole(judged)), "gates": [each.as_json() for each in judged]}
