"""Checks the values of a journal's records.

Rule: each function takes a value that was read from an untrusted file. It returns the checked value, or raises
UnexpectedValue in plain words. The memory that the checks need does not grow with the run.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from math import isfinite
from typing import Any, Final, get_type_hints

from trilane.scheduler.core import Core
from trilane.scheduler.events import ACTIONS, EVENTS, NEVER, Action, Event, Finish, Graph, Settings
from trilane.scheduler.ledger import ASSIGNED, NAMES, JobRecord
from trilane.scheduler.recording import CARRIED, actions_of, events_of, graph_of, settings_of
from trilane.unexpected_value import UnexpectedValue

LONGEST_FOUND: Final = 80
MOST_NESTED: Final = 32  # depth of the facts; a configuration has five
ACCOUNTS: Final = {ASSIGNED: "assigned", **NAMES}
A_TIME: Final = f"nanoseconds, a whole number from 0 to {NEVER}"
NUMBERS: Final = {int, float}
PLAIN: Final = {int, float, str, bool, type(None)}
#: Types of a job's values. Journals of an older Trilane lack the last fields; none lacks a field before `cpu_ns`.
JOB_TYPES: Final = {
    tuple(get_type_hints(JobRecord).values())[:count]
    for count in range(JobRecord._fields.index("cpu_ns"), len(JobRecord._fields) + 1)
}
SETTINGS_TYPES: Final = {
    name: tuple if "tuple" in str(kind) else kind for name, kind in get_type_hints(Settings).items()
}
#: Indices of the unit and of the stage in the row of each event or action; 0: the row has none.
_NAMED: Final = {
    kind.__name__: tuple(fields.index(name) + 1 if name in fields else 0 for name in ("unit", "stage"))
    for kind in (*EVENTS, *ACTIONS)
    if kind is not Finish
    for fields in [CARRIED.get(kind, kind)._fields]
}


def shown(value: Any) -> str:
    """Return a text that stands for a value in a message; a long text is cut to LONGEST_FOUND characters."""
    text = repr(value)
    return text if len(text) <= LONGEST_FOUND else f"{text[:LONGEST_FOUND]}…"


def time_ns(value: Any) -> int:
    """Return a time of the run's clock in ns, 0 to NEVER."""
    if type(value) is not int or not 0 <= value <= NEVER:
        raise UnexpectedValue(f"time {shown(value)}", A_TIME)
    return value


def text(value: Any) -> str:
    """Return `value`, which must be a text."""
    if type(value) is not str:
        raise UnexpectedValue(f"text {shown(value)}", "a text")
    return value


def numbers(value: Any) -> Mapping[str, float]:
    """Return `value`, which must be a map from names to finite numbers."""
    if type(value) is not dict:
        raise UnexpectedValue(shown(value), "numbers by name")
    if not (set(map(type, value)) <= {str} and set(map(type, value.values())) <= NUMBERS):
        raise UnexpectedValue(shown(value), "numbers by name")
    if not all(map(isfinite, value.values())):
        raise UnexpectedValue(shown(value), "finite numbers by name")
    return value


def counts(value: Any) -> Mapping[str, int]:
    """Return `value`, which must be a map from names to whole numbers of at least 0."""
    found: Any = numbers(value)
    if any(type(each) is not int or each < 0 for each in found.values()):
        raise UnexpectedValue(shown(value), "whole numbers from 0 on, by name")
    return found  # type: ignore[no-any-return]


def facts(value: Any) -> Mapping[str, Any]:
    """Return the facts of a record, by name: values that JSON can contain, at most MOST_NESTED levels deep."""
    if type(value) is not dict:
        raise UnexpectedValue(shown(value), "facts by name")
    waiting: list[tuple[Any, int]] = [(value, 1)]
    while waiting:
        one, depth = waiting.pop()
        if depth > MOST_NESTED:
            raise UnexpectedValue("facts inside facts, too deep", f"at most {MOST_NESTED} of them")
        if type(one) is dict and set(map(type, one)) <= {str}:
            waiting += [(each, depth + 1) for each in one.values()]
        elif type(one) is tuple:
            waiting += [(each, depth + 1) for each in one]
        elif type(one) not in PLAIN or (type(one) is float and not isfinite(one)):
            raise UnexpectedValue(shown(one), "what JSON can hold: texts, finite numbers, lists, names with values")
    return value


def graph(value: Any) -> Graph:
    """Return the graph of a run from its JSON object. Its names must be printable."""
    try:
        found = graph_of(value)
        names = [name for stage in found.stages for name in (stage.name, stage.unit)]
        names += [*found.edges, found.latency_to, *(found.bypass or ())]
    except UnexpectedValue:
        raise
    except (KeyError, TypeError, IndexError, ValueError):
        raise UnexpectedValue(f"graph {shown(value)}", "stages, edges, latency_to and bypass") from None
    for name in names:
        if type(name) is not str or not name.isprintable():
            raise UnexpectedValue(f"name {shown(name)} in the graph", "a text without control characters")
    return found


def settings(value: Any, of_graph: Graph) -> Settings:
    """Return the settings of a run from their JSON object. A scheduler `Core` must accept them.

    `of_graph`: graph of the run.
    """
    try:
        found = settings_of(value)
        for name, kind in SETTINGS_TYPES.items():
            _check_setting(name, kind, getattr(found, name))
        Core(of_graph, found)  # this raises an error that says what is wrong with them
    except UnexpectedValue:
        raise
    except (TypeError, AttributeError):
        raise UnexpectedValue(f"settings {shown(value)}", ", ".join(SETTINGS_TYPES)) from None
    except ValueError as error:
        raise UnexpectedValue(str(error), "settings and a graph of a run") from None
    return found


def _check_setting(name: str, kind: type[Any], value: Any) -> None:
    if type(value) is not kind:
        raise UnexpectedValue(f"setting {name} {shown(value)}", f"a value like {kind()!r}")
    entries: tuple[Any, ...] = value if kind is tuple else (value,)
    for each in entries:
        wanted: Any = (str if name == "follow" else int) if kind is tuple else kind
        if type(each) is not wanted or (wanted is int and not 0 <= each <= NEVER):
            raise UnexpectedValue(f"setting {name} {shown(value)}", f"whole numbers from 0 to {NEVER}, and texts")


class RunValues:
    """Checks values against the graph of a run, and against earlier records: times of steps, names, jobs."""

    def __init__(self, of_graph: Graph) -> None:
        self._unit_of = {stage.name: stage.unit for stage in of_graph.stages}
        self._units = frozenset(of_graph.units)
        self._last_frame = dict.fromkeys(self._unit_of, -1)
        self._step_ns = 0

    def step_ns(self, value: Any) -> int:
        """Return the time of a step in ns, which must not be before the last step's time."""
        if type(value) is not int or not self._step_ns <= value <= NEVER:
            raise UnexpectedValue(
                f"time {shown(value)} of a step", f"{A_TIME}, not before the last step's {self._step_ns}"
            )
        self._step_ns = value
        return value

    def unit(self, value: Any) -> str:
        """Return `value`, which must be the name of a unit of the graph."""
        if type(value) is not str or value not in self._units:
            raise _unknown("unit", value, self._units)
        return value

    def account(self, value: Any) -> int:
        """Return `value`, which must be the number of an account of the ledger."""
        if type(value) is not int or value not in ACCOUNTS:
            known = ", ".join(f"{number} ({name})" for number, name in ACCOUNTS.items())
            raise UnexpectedValue(f"account {shown(value)}", f"one of {known}")
        return value

    def events(self, rows: Any) -> tuple[Event, ...]:
        """Return the events of a step from their rows (`recording.row_of`)."""
        found = events_of(_rows(rows))
        for row in rows:
            self._check_row(row)
            if row[0] == "JobDone" and not 0 <= row[3] <= row[4]:
                raise UnexpectedValue(f"a job from {row[3]} to {row[4]} ns", "one that does not end before it begins")
        return found

    def actions(self, rows: Any) -> tuple[Action, ...]:
        """Return the actions of a step from their rows (`recording.row_of`)."""
        found = actions_of(_rows(rows))
        for row in rows:
            self._check_row(row)
        return found

    def _check_row(self, row: tuple[Any, ...]) -> None:
        """Check that a row of checked types names only units and stages of the graph, with numbers in range."""
        unit, stage = _NAMED.get(row[0], (0, 0))
        if unit and row[unit] not in self._units:
            raise _unknown("unit", row[unit], self._units)
        if stage and row[stage] not in self._unit_of:
            raise _unknown("stage", row[stage], self._unit_of)
        for value in row:
            if type(value) is int and not -1 <= value <= NEVER:
                raise UnexpectedValue(f"{value} in {row[0]}", f"a whole number from -1 to {NEVER}")

    def job(self, row: Any) -> JobRecord:
        """Return a job that has ended, from the values of its fields.

        Its frame must be newer than the last frame of its stage.
        """
        if type(row) is not tuple or tuple(map(type, row)) not in JOB_TYPES:
            raise UnexpectedValue(f"job {shown(row)}", f"texts and whole numbers: {', '.join(JobRecord._fields)}")
        job = JobRecord(*row)
        fields: tuple[Any, ...] = row
        stage, unit, frame, ready_ns, dispatch_ns, begin_ns, end_ns, *lost = fields
        if self._unit_of.get(stage) != unit:
            if stage not in self._unit_of:
                raise _unknown("stage", stage, self._unit_of)
            self.unit(unit)
            raise UnexpectedValue(f"stage {stage!r} on unit {unit!r}", f"unit {self._unit_of[stage]!r}")
        if (
            min(ready_ns, dispatch_ns, begin_ns, *lost) < 0
            or not max(ready_ns, dispatch_ns, begin_ns) <= end_ns <= NEVER
        ):
            raise UnexpectedValue(f"job {shown(row)}", f"times from 0 to its end, and that at most {NEVER} ns")
        last = self._last_frame[stage]
        if max(lost) > NEVER or not last < frame <= NEVER:
            expected = f"one after its last, {last}: no job comes twice"
            raise UnexpectedValue(f"frame {frame} of stage {stage!r}", expected)
        self._last_frame[stage] = frame
        return job


def _rows(rows: Any) -> tuple[Any, ...]:
    if type(rows) is not tuple or not all(type(row) is tuple and row for row in rows):
        raise UnexpectedValue(shown(rows), "a list of events or actions, each a name and its fields")
    return rows


def _unknown(kind: str, name: Any, names: Collection[str]) -> UnexpectedValue:
    return UnexpectedValue(f"{kind} {shown(name)}", f"one of the graph's: {', '.join(sorted(names))}")
