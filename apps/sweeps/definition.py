"""What a sweep tries: a command with fixed options, and axes whose values are combined.

Rule: pure. The same definition gives the same trials in the same order, on every machine.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from trilane.apps.sweeps.trial import Options, Trial, Value
from trilane.errors import BadInputError, did_you_mean

MOST_TRIALS = 100_000


class Kind(StrEnum):
    """Every combination; the axes side by side, first with first; some combinations, drawn from a seed."""

    GRID = "grid"
    LIST = "list"
    RANDOM = "random"


@dataclass(frozen=True)
class Definition:
    """`axes`: option: its values, at least one. `count`: of `RANDOM`, how many. `repeats`: of every configuration."""

    command: tuple[str, ...]
    options: Options = field(default_factory=dict)
    axes: Mapping[str, Sequence[Value]] = field(default_factory=dict)
    kind: Kind = Kind.GRID
    count: int | None = None
    seed: int = 0
    repeats: int = 1


def kind_named(where: str, word: str) -> Kind:
    """Raises BadInputError for a word that is none."""
    if word not in [*Kind]:
        raise BadInputError(where, repr(word), f"one of {', '.join(Kind)}", did_you_mean(word, Kind))
    return Kind(word)


def trials_of(definition: Definition, words: Callable[[Options], Sequence[str]]) -> list[Trial]:
    """The trials, the last axis changing fastest, repeats of a configuration one after the other.

    `words`: the options of a configuration as a command line has them.
    Raises BadInputError for axes that do not fit each other, for more than `MOST_TRIALS`, and for a trial given twice.
    """
    made = [
        Trial(definition.command, options, tuple(words(options)), repeat)
        for options in _configurations(definition)
        for repeat in range(1, definition.repeats + 1)
    ]
    seen: set[str] = set()
    for trial in made:
        if trial.id in seen:
            raise BadInputError("axes", f"{trial.line} twice", "each trial once", "repeats = 2 measures it again")
        seen.add(trial.id)
    return made


def _configurations(definition: Definition) -> Iterator[Options]:
    _check(definition)
    names = list(definition.axes)
    if definition.kind is Kind.LIST and names:
        combinations: Iterator[Sequence[Value]] = zip(*definition.axes.values(), strict=True)
    else:
        combinations = (_combination(definition, number) for number in _numbers(definition))
    for values in combinations:
        yield {**definition.options, **dict(zip(names, values, strict=True))}


def _check(definition: Definition) -> None:
    for name in definition.axes:
        if not definition.axes[name]:
            raise BadInputError(f"axes.{name}", "no value", "at least one")
        if name in definition.options:
            raise BadInputError(f"axes.{name}", "an axis that is a fixed option too", "one of them")
    lengths = {name: len(values) for name, values in definition.axes.items()}
    if definition.kind is Kind.LIST and len(set(lengths.values())) > 1:
        found = ", ".join(f"{count} of {name}" for name, count in lengths.items())
        raise BadInputError("axes", found, "as many values of each", "a list takes the axes side by side")
    if _count(definition) * definition.repeats > MOST_TRIALS:
        found = f"{_count(definition) * definition.repeats} trials"
        raise BadInputError("axes", found, f"at most {MOST_TRIALS}", "draw some of them: kind = 'random' with a count")


def _count(definition: Definition) -> int:
    """How many configurations there are; raises BadInputError for more drawn than there are."""
    if definition.kind is Kind.LIST:
        return max((len(values) for values in definition.axes.values()), default=1)
    whole = math.prod(len(values) for values in definition.axes.values())
    if definition.kind is Kind.GRID:
        return whole
    if definition.count is None or not 1 <= definition.count <= whole:
        found = "none" if definition.count is None else str(definition.count)
        raise BadInputError("count", found, f"1 to {whole}", "so many combinations the axes have")
    return definition.count


def _numbers(definition: Definition) -> Sequence[int]:
    """Of the combinations, as a grid numbers them; those drawn are in the grid's order."""
    whole = math.prod(len(values) for values in definition.axes.values())
    if definition.kind is Kind.RANDOM:
        return sorted(random.Random(definition.seed).sample(range(whole), _count(definition)))
    return range(whole)


def _combination(definition: Definition, number: int) -> list[Value]:
    """Digits of `number`, written with as many digits as there are axes, each counted to its axis's length."""
    digits: list[Value] = []
    for values in reversed(list(definition.axes.values())):
        number, place = divmod(number, len(values))
        digits.append(values[place])
    return digits[::-1]
