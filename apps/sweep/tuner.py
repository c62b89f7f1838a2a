"""Tuning: a search that finds the best configuration within given limits, with few trials of a sweep's grid.

Rule: Optuna proposes configurations, and this module judges their results. Trials have the names, engines and records
of a sweep. The same seed, goal and results give the same proposals. Therefore a killed search is done again from its
start, and the trials that have ended are not run again. This module starts no process and writes no file.
"""

from __future__ import annotations

import math
import random
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, NamedTuple

from trilane.apps.compare.overview import entry_of, number_of
from trilane.apps.sweep.definition import METRICS, Definition, Options, SweepKind, Trial, Value, trials_of, value_at
from trilane.apps.sweep.store import TrialRecord, of_trial, planned
from trilane.errors import BadInputError, MissingPartError, did_you_mean

#: Number of random proposals before the search learns from results.
DRAWN_FIRST = 10
#: After so many repeated proposals in a row, the search itself chooses an untried configuration.
MOST_KNOWN = 3
#: Number of finished trials before a short run may end a trial.
RUNS_BEFORE_PRUNING = 4
#: If so many trials are done and all lack a figure that was asked for, the search ends with an error.
MOST_WITHOUT_FIGURE = 3
#: A value at a strict limit misses it by this share of the limit.
AT_LIMIT = 1e-9
FRAMES = "frames"
KEEP = re.compile(r"\s*([A-Za-z][\w.-]*)\s*(<=|>=|<|>)\s*([-+]?[\d.]+(?:e[-+]?\d+)?)\s*([A-Za-z]*)\s*", re.IGNORECASE)
#: Function that does the given trials that have not ended, and returns the records of all given trials, by name.
Do = Callable[[Sequence[Trial]], Mapping[str, TrialRecord]]
#: Figures that the frontier compares in addition to the goals and limits, if every judged trial has them.
WEIGHED = ("psnr", "power")


class Keep(NamedTuple):
    """A limit that the answer keeps, such as `psnr>=33`.

    `name`: a key of `METRICS`, or the dotted key of a number in the result. `sign`: `<`, `<=`, `>` or `>=`. `limit`:
    number of the limit, in the unit of the figure.
    """

    name: str
    sign: str
    limit: float

    def __str__(self) -> str:
        return f"{self.name}{self.sign}{self.limit:g}"

    @property
    def more_is_better(self) -> bool:
        return self.sign.startswith(">")

    def miss(self, value: float) -> float:
        """Return by how much `value` misses the limit, as a share of the limit; 0 or less if the limit is kept.

        For a limit of 0, return the plain difference. A value at a strict limit misses it by `AT_LIMIT`.
        """
        over = (self.limit - value if self.more_is_better else value - self.limit) / (abs(self.limit) or 1.0)
        return max(over, AT_LIMIT) if over == 0 and "=" not in self.sign else over


def keep_of(text: str) -> Keep:
    """Return the limit that `text` states, such as `psnr>=33dB`.

    Raises BadInputError for a text of another form, an unknown figure, and a unit that is not the figure's.
    """
    found = KEEP.fullmatch(text)
    try:
        limit = float(found[3]) if found else math.nan
    except ValueError:
        limit = math.nan
    if found is None or not math.isfinite(limit):
        raise BadInputError("--keep", repr(text), "a figure, a sign and a number, such as 'psnr>=33' or 'power<3W'")
    name, unit = found[1], found[4]
    if name not in METRICS and "." not in name:
        expected = f"one of {', '.join(METRICS)}, or a dotted key of the result such as units.dsp.busy"
        raise BadInputError("--keep", repr(name), expected, did_you_mean(name, METRICS))
    own = METRICS[name].unit if name in METRICS else ""
    if unit and unit.lower() != own.lower():
        raise BadInputError("--keep", f"{unit!r} in {text!r}", f"{own or 'no unit'}, the unit of {name}")
    return Keep(name, found[2], limit)


@dataclass(frozen=True)
class Aim:
    """The goals and limits of a search.

    `goals`: keys of `METRICS`; the best value of the first goal decides which trial is the answer. `keeps`: limits that
    the answer keeps.
    """

    goals: tuple[str, ...] = ("fps",)
    keeps: tuple[Keep, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys([*self.goals, *(keep.name for keep in self.keeps)]))

    def costs(self, figures: Mapping[str, float], names: Sequence[str]) -> tuple[float, ...]:
        """Return the figures with the given `names`, in their order. If more is better, a figure is negated.

        Therefore less is always better in the result. `figures`: figures of a trial, by name.
        """
        return tuple(-figures[name] if self.more_is_better(name) else figures[name] for name in names)

    def misses(self, figures: Mapping[str, float]) -> list[float]:
        return [keep.miss(figures[keep.name]) for keep in self.keeps]

    def missed(self, figures: Mapping[str, float]) -> float:
        return sum(max(0.0, miss) for miss in self.misses(figures))

    def keeps_all(self, figures: Mapping[str, float]) -> bool:
        return all(miss <= 0 for miss in self.misses(figures))

    def has_all(self, figures: Mapping[str, float]) -> bool:
        return all(name in figures for name in self.names)

    def more_is_better(self, name: str) -> bool:
        if name in METRICS:
            return METRICS[name].more_is_better
        return any(keep.more_is_better for keep in self.keeps if keep.name == name)


def figures_of(record: TrialRecord, names: Sequence[str] = ()) -> dict[str, float]:
    """Return the figures of a trial, by name: the `METRICS` that its result has, and the dotted keys among `names`.

    If the result has several pipelines, the first one counts. Times that are not above 0 are left out. Return an empty
    mapping for a trial that is not done.
    """
    if record.status != "done" or record.result is None:
        return {}
    several = record.result.get("pipelines")
    first = several[0] if isinstance(several, list) and several else None
    document = first if isinstance(first, dict) else record.result
    paths = {name: METRICS[name].path if name in METRICS else tuple(name.split(".")) for name in (*METRICS, *names)}
    found = {name: _at(document, path) for name, path in paths.items() if path}
    found["psnr"] = entry_of("", document).psnr_db
    # A run without times may have the time 0, which would win every comparison.
    times = {name for name, metric in METRICS.items() if metric.unit == "ms"}
    return {name: value for name, value in found.items() if value is not None and (value > 0 or name not in times)}


def _at(document: Any, path: Sequence[str]) -> float | None:
    return number_of(value_at(document, path))


class Space:
    """The configurations of a grid, each with its trial.

    The places of a trial are a mapping from each axis to the index of the trial's value on this axis.
    `trials`: all trials, in the grid's order. `axes`: axis -> values. `words`: as for `trials_of`.
    """

    def __init__(self, definition: Definition, words: Callable[[Options], Sequence[str]]) -> None:
        """Make the trials of `definition`. `words`: as for `trials_of`.

        Raises BadInputError for another kind than a grid, for repeats, for a single configuration, and as `trials_of`
        does.
        """
        if definition.kind is not SweepKind.GRID or definition.repeats > 1:
            found = f"kind = '{definition.kind}', repeats = {definition.repeats}"
            raise BadInputError("sweep", found, "a grid without repeats", "tune chooses by itself what to try")
        self.trials = trials_of(definition, words)
        if len(self.trials) < 2:
            raise BadInputError("axes", "one configuration", "two or more", "--axis edge=single,double is an axis")
        self.axes = {name: list(values) for name, values in definition.axes.items()}
        self.words = words

    def at(self, places: Mapping[str, int]) -> Trial:
        number = 0
        for name, values in self.axes.items():
            number = number * len(values) + places[name]
        return self.trials[number]

    def places(self, number: int) -> dict[str, int]:
        """Return the places of trial number `number`. This is the inverse of `at`."""
        found: dict[str, int] = {}
        for name, values in reversed(self.axes.items()):
            number, found[name] = divmod(number, len(values))
        return found

    def steps(self, one: Mapping[str, int], other: Mapping[str, int]) -> int:
        """Return the distance between the trials at places `one` and `other`: a sum over the axes.

        An ordered axis adds the number of steps between the two values. Any other axis adds 1 if the values differ, and
        0 if they are equal.
        """
        apart = {name: abs(one[name] - other[name]) for name in self.axes}
        return sum(steps if name in self.ordered else min(steps, 1) for name, steps in apart.items())

    def shortened(self, trial: Trial, frames: int) -> Trial:
        """Return a copy of `trial` with only `frames` frames. The copy is not among `trials`."""
        options = {**trial.options, FRAMES: frames}
        return replace(trial, options=options, words=tuple(self.words(options)))

    @cached_property
    def ordered(self) -> set[str]:
        """The names of the axes whose values are rising numbers.

        Neighbouring values of such an axis should give similar results.
        """
        return {name for name, values in self.axes.items() if _rises(values)}


def _rises(values: Sequence[Value]) -> bool:
    try:
        numbers = [math.nan if isinstance(each, bool | list) else float(each) for each in values]
    except ValueError:
        return False
    return len(numbers) > 1 and all(low < high for low, high in pairwise(numbers))


def required_optuna() -> Any:
    """Return the package `optuna`, after setting its log to errors only. Raises MissingPartError without Optuna."""
    try:
        import optuna
    except ImportError as error:
        raise MissingPartError("tune needs the package optuna", extra="tune") from error
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return optuna


class Search:
    """A search of `space` for `aim`: Optuna's proposals and their results.

    `seed`: seed of the proposals. `tried`: proposed trials that ended, by name, in the order of their ends.
    """

    def __init__(self, space: Space, aim: Aim, seed: int) -> None:
        """Begin a search without results. Raises MissingPartError without Optuna."""
        self.space, self.aim = space, aim
        self.tried: dict[str, Trial] = {}
        self._optuna = required_optuna()
        self._chance = random.Random(seed)
        self._given: set[str] = set()
        self._best: tuple[tuple[float, ...], dict[str, int]] | None = None
        self._is_near = False
        self._study = self._optuna.create_study(
            directions=["minimize"] * len(aim.goals),
            sampler=self._optuna.samplers.TPESampler(seed=seed, multivariate=True, n_startup_trials=DRAWN_FIRST),
            pruner=self._optuna.pruners.MedianPruner(n_startup_trials=RUNS_BEFORE_PRUNING),
        )

    @property
    def has_learned(self) -> bool:
        """Whether any trial had all figures of the goals and limits."""
        return self._best is not None

    @property
    def left(self) -> int:
        """The number of configurations that have not been proposed."""
        return len(self.space.trials) - len(self._given)

    def propose(self) -> tuple[Any, Trial]:
        """Return (Optuna's trial, trial of the space) for a configuration that was not proposed before.

        Call it only if `left` is above 0.
        """
        for _ in range(MOST_KNOWN):
            asked, trial = self._asked()
            if trial.id not in self._given:
                break
            self._study.tell(asked, state=self._optuna.trial.TrialState.FAIL)
        else:
            self._study.enqueue_trial(self._untried())
            asked, trial = self._asked()
        self._given.add(trial.id)
        return asked, trial

    def _untried(self) -> dict[str, int]:
        """Return the places of a configuration that was not proposed before.

        The calls take turns: one returns the configuration nearest to the best so far, the next a random configuration.
        Without a best configuration, all calls return a random one.
        """
        left = [
            self.space.places(number) for number, each in enumerate(self.space.trials) if each.id not in self._given
        ]
        self._chance.shuffle(left)
        self._is_near = not self._is_near
        if self._best is None or not self._is_near:
            return left[0]
        return min(left, key=partial(self.space.steps, self._best[1]))

    def _asked(self) -> tuple[Any, Trial]:
        asked, places = self._study.ask(), {}
        for name, values in self.space.axes.items():
            if name in self.space.ordered:
                places[name] = asked.suggest_int(name, 0, len(values) - 1)
            else:
                places[name] = asked.suggest_categorical(name, list(range(len(values))))
        return asked, self.space.at(places)

    def is_hopeless(self, asked: Any, trial: Trial, record: TrialRecord, frames: int) -> bool:
        """Return whether the result of a short run ends `trial`. If so, count the trial as tried and pruned.

        The short run ends the trial if its first goal is worse than the median of the short runs of completed trials.
        At least `RUNS_BEFORE_PRUNING` trials must be completed. Without this goal in `record`, return False.

        `asked`: Optuna's trial. `record`: record of the short run. `frames`: number of its frames.
        """
        figures = figures_of(record, self.aim.names)
        goal = self.aim.goals[0]
        if goal not in figures:
            return False
        asked.report(self.aim.costs(figures, [goal])[0], frames)
        if not asked.should_prune():
            return False
        self._study.tell(asked, state=self._optuna.trial.TrialState.PRUNED)
        self.tried[trial.id] = trial
        return True

    def learn(self, asked: Any, trial: Trial, record: TrialRecord) -> None:
        """Count `trial` as tried, and tell Optuna its result.

        A trial without a figure of a goal or limit counts as failed.

        `asked`: Optuna's trial. `record`: record of the trial.
        """
        self.tried[trial.id] = trial
        figures = figures_of(record, self.aim.names)
        if not self.aim.has_all(figures):
            self._study.tell(asked, state=self._optuna.trial.TrialState.FAIL)
            return
        for keep, miss in zip(self.aim.keeps, self.aim.misses(figures), strict=True):
            asked.set_constraint(str(keep), miss)
        costs = self.aim.costs(figures, self.aim.goals)
        self._study.tell(asked, costs)
        rank = (self.aim.missed(figures), *costs)
        if self._best is None or rank < self._best[0]:
            self._best = rank, dict(asked.params)


def tune(search: Search, do: Do, budget: int, together: int = 1, short: int | None = None) -> Mapping[str, TrialRecord]:
    """Try at most `budget` configurations, and return the records of all trials that were done in full, by name.

    `search`: search without results. `do`: function that does trials. `together`: number of configurations that are
    proposed and done at once. `short`: number of frames of a short run before each full run; None for no short runs.

    Raises BadInputError if `MOST_WITHOUT_FIGURE` or more trials are done, and all lack the same figure of a goal or
    limit.
    """
    records: dict[str, TrialRecord] = {}
    while len(search.tried) < budget and search.left:
        count = min(together, budget - len(search.tried), search.left)
        batch = [search.propose() for _ in range(count)]
        if short is not None:
            first = {trial.id: search.space.shortened(trial, short) for _, trial in batch}
            ended = do(list(first.values()))
            batch = [
                (asked, trial)
                for asked, trial in batch
                if not search.is_hopeless(asked, trial, ended[first[trial.id].id], short)
            ]
        records.update(do([trial for _, trial in batch]) if batch else {})
        for asked, trial in batch:
            search.learn(asked, trial, records[trial.id])
        if not search.has_learned:
            _require_figures(search.aim, [record for record in records.values() if record.status == "done"])
    return records


def _require_figures(aim: Aim, done: Sequence[TrialRecord]) -> None:
    if len(done) < MOST_WITHOUT_FIGURE:
        return
    known = {name for record in done for name in figures_of(record, aim.names)}
    for name in aim.names:
        if name not in known:
            what = " ".join(done[0].command[1:2])
            remedy = "measure it: tune run with --check 4" if name.endswith("psnr") else ""
            expected = f"one of {', '.join(sorted(known))}"
            raise BadInputError(
                "goal" if name in aim.goals else "--keep", f"{name}, which no {what} has", expected, remedy
            )


@dataclass(frozen=True)
class JudgedTrial:
    """A trial in the answer of a search.

    `record`: record of the trial. `metrics`: its figures, by name. `keeps`: whether it keeps all limits; None if it
    lacks a figure of a goal or limit. `misses`: limits that it misses.
    """

    record: TrialRecord
    metrics: Mapping[str, float]
    keeps: bool | None
    misses: tuple[str, ...]

    @property
    def command(self) -> list[str]:
        """The words of the command line that runs the configuration by hand, without `--json`."""
        return list(self.record.command[:-1])

    def row(self) -> dict[str, Any]:
        """Return the trial as an entry of `trials` in the output of `trilane tune --json`."""
        return {**self.record.row(), "metrics": self.metrics, "keeps": self.keeps}

    def chosen(self) -> dict[str, Any]:
        """Return the trial as `best`, `nearest` or an entry of `frontier` in the output of `trilane tune --json`."""
        return {
            **{"id": self.record.id, "command": self.command, "options": self.record.options},
            **{"metrics": self.metrics, "keeps": self.keeps, "misses": self.misses, "unsure": self.record.unsure},
        }


@dataclass(frozen=True)
class Answer:
    """The answer of a search.

    `best`: the best trial that keeps all limits; None if no trial keeps them. `nearest`: the trial that misses the
    limits least; None if there is a `best`. `weighed`: names of the figures that the frontier compares. `frontier`:
    trials that no other trial beats. `trials`: all trials. `size`: number of all configurations. `not_tried`: for each
    axis, the values that no trial had; an axis whose values were all tried is missing.
    """

    best: JudgedTrial | None
    nearest: JudgedTrial | None
    weighed: list[str]
    frontier: list[JudgedTrial]
    trials: list[JudgedTrial]
    size: int
    not_tried: dict[str, list[Value]]

    @property
    def left(self) -> int:
        """The number of configurations that were not tried."""
        return self.size - len(self.trials)

    def as_json(self) -> dict[str, Any]:
        """Return the keys of the output of `trilane tune --json` that the search answers (docs/tune.md)."""
        return {
            "best": self.best and self.best.chosen(),
            "nearest": self.nearest and self.nearest.chosen(),
            "weighed": self.weighed,
            "frontier": [trial.chosen() for trial in self.frontier],
            "trials": [trial.row() for trial in self.trials],
            "not_tried": {"count": self.left, "of": self.size, "values": self.not_tried},
        }


def answer(search: Search, records: Mapping[str, TrialRecord]) -> Answer:
    """Return the answer of a search.

    `search`: search that has ended. `records`: all known records of the space by the trial's name, also from an earlier
    search or sweep.
    """
    aim, space = search.aim, search.space
    found = [trial for trial in space.trials if trial.id in records and trial.id not in search.tried]
    ended = [*search.tried.values(), *found]
    pruned = {"status": "pruned"}
    tried = [
        of_trial(trial, records[trial.id]) if trial.id in records else planned(trial).model_copy(update=pruned)
        for trial in ended
    ]
    trials = [_judged(aim, record) for record in tried]
    judged = [trial for trial in trials if trial.keeps is not None]
    weighed = [name for name in WEIGHED if judged and all(name in trial.metrics for trial in judged)]
    names = list(dict.fromkeys([*aim.names, *weighed]))
    costs = {trial.record.id: aim.costs(trial.metrics, names) for trial in judged}
    numbers = {trial.id: number for number, trial in enumerate(space.trials)}

    def cost(trial: JudgedTrial) -> tuple[float, ...]:
        return costs[trial.record.id]

    fit = [trial for trial in judged if trial.keeps]
    best = min(fit, key=lambda trial: (cost(trial), numbers[trial.record.id]), default=None)
    nearest = min(judged, key=lambda trial: (aim.missed(trial.metrics), cost(trial)), default=None)
    on = _frontier(costs)
    untried = {
        name: [each for each in several if all(trial.options[name] != each for trial in ended)]
        for name, several in space.axes.items()
    }
    return Answer(
        best=best,
        nearest=None if best else nearest,
        weighed=names,
        frontier=sorted((trial for trial in judged if trial.record.id in on), key=cost),
        trials=trials,
        size=len(space.trials),
        not_tried={name: left for name, left in untried.items() if left},
    )


def _judged(aim: Aim, record: TrialRecord) -> JudgedTrial:
    figures = figures_of(record, aim.names)
    if not aim.has_all(figures):
        return JudgedTrial(record, figures, None, ())
    missed = (str(keep) for keep, miss in zip(aim.keeps, aim.misses(figures), strict=True) if miss > 0)
    return JudgedTrial(record, figures, aim.keeps_all(figures), tuple(missed))


def _frontier(costs: Mapping[str, tuple[float, ...]]) -> set[str]:
    """Return the names of the trials that no other trial beats.

    One trial beats another if none of its costs is higher and at least one is lower. `costs`: costs by the trial's
    name.
    """

    def beats(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
        return one != other and all(a <= b for a, b in zip(one, other, strict=True))

    several = set(costs.values())
    on = {own for own in several if not any(beats(other, own) for other in several)}
    return {name for name, own in costs.items() if own in on}
