"""Records the steps of a run: its events and the core's actions.

Rule: a replay gives the same actions, or says at which steps the actions differ.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, get_type_hints

from trilane.errors import BadInputError
from trilane.scheduler.core import Core
from trilane.scheduler.events import (
    ACTIONS,
    EVENTS,
    Action,
    Dispatch,
    Event,
    Finish,
    Graph,
    Input,
    Job,
    Outcome,
    Settings,
    StageSpec,
)
from trilane.scheduler.state import UnitLifeError
from trilane.unexpected_value import UnexpectedValue

SCHEMA = 7
#: Actions with one field, a tuple: the fields of this tuple are written as if they were the action's.
CARRIED: dict[Any, Any] = {Dispatch: Job, Finish: Outcome}


def _forms(kinds: tuple[Any, ...]) -> dict[str, tuple[Any, dict[str, Any]]]:
    """Return (class, types of its fields by name, in the order of a row) of each event or action, by its name."""
    return {kind.__name__: (kind, get_type_hints(CARRIED.get(kind, kind))) for kind in kinds}


_EVENTS, _ACTIONS = _forms(EVENTS), _forms(ACTIONS)


@dataclass
class Recording:
    """The steps of one run, as tuples (now_ns, events, actions).

    `accounts`: (time in ns, unit, account) for each change. From this time on, the unit's time goes to this account, a
    number of ledger.py. `accounts` is not written, because a replay computes it again.
    """

    graph: Graph
    settings: Settings
    steps: list[tuple[int, tuple[Event, ...], tuple[Action, ...]]] = field(default_factory=list)
    accounts: list[tuple[int, str, int]] = field(default_factory=list, compare=False)
    _account_of: dict[str, int] = field(default_factory=dict, compare=False, repr=False)

    def add(self, now_ns: int, events: tuple[Event, ...], actions: tuple[Action, ...], core: Core) -> None:
        """Add a step that `core` has just taken."""
        self.steps.append((now_ns, events, actions))
        for unit in core.units.values():
            if self._account_of.get(unit.name) != unit.account:
                self._account_of[unit.name] = unit.account
                self.accounts.append((unit.account_ns, unit.name, unit.account))

    def write(self, path: Path) -> None:
        """Write the recording as JSON lines (`header_line`, `step_line`). Raises OSError."""
        with path.open("w", encoding="utf-8") as file:
            file.write(header_line(self.graph, self.settings))
            for now_ns, events, actions in self.steps:
                file.write(step_line(now_ns, events, actions))


def header_line(graph: Graph, settings: Settings) -> str:
    """Return the first line of a recording: a JSON object with the keys `schema`, `graph` and `settings`."""
    return json.dumps({"schema": SCHEMA, "graph": graph.written(), "settings": asdict(settings)}) + "\n"


def step_line(now_ns: int, events: Iterable[Event], actions: Iterable[Action]) -> str:
    """Return the line of a step: a JSON object with the keys `t` (ns), `events` and `actions`.

    Each event or action is an object with its fields, and its name under `event` or `action`.
    """
    told = [{"event": type(event).__name__, **_fields_of(event)} for event in events]
    answered = [{"action": type(action).__name__, **_fields_of(action)} for action in actions]
    return json.dumps({"t": now_ns, "events": told, "actions": answered}, separators=(",", ":")) + "\n"


def _fields_of(item: Any) -> dict[str, Any]:
    fields: dict[str, Any] = (item[0] if type(item) in CARRIED else item)._asdict()
    return fields


def read(path: Path) -> Recording:
    """Return the recording at `path`. Raises BadInputError for an unreadable file, or for its first wrong line."""
    number = 0
    try:
        with path.open(encoding="utf-8") as file:
            header = json.loads(next(file, ""))
            if header["schema"] != SCHEMA:
                raise ValueError(f"schema {header['schema']!r}; this Trilane reads {SCHEMA}")
            recording = Recording(graph_of(header["graph"]), settings_of(header["settings"]))
            Core(recording.graph, recording.settings)  # raises an error that says what is wrong
            for number, line in enumerate(file, start=1):  # noqa: B007 - named in the message below
                row = json.loads(line)
                now_ns = row["t"]
                if type(now_ns) is not int or (recording.steps and now_ns < recording.steps[-1][0]):
                    raise UnexpectedValue(f"time {now_ns!r}", "ns that do not go back")
                events = events_of(_listed(each, "event", _EVENTS) for each in row["events"])
                actions = actions_of(_listed(each, "action", _ACTIONS) for each in row["actions"])
                recording.steps.append((now_ns, events, actions))
    except OSError as error:
        raise BadInputError.of_os_error(path, error, "a recorded run") from None
    except UnexpectedValue as error:
        raise BadInputError.at(f"{path}, line {number + 1}", error) from None
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise BadInputError(
            f"{path}, line {number + 1}", str(error) or type(error).__name__, "a recorded run"
        ) from None
    return recording


def replay(recording: Recording) -> Iterator[str]:
    """Feed the events to a new core, and yield one sentence for every step whose actions differ from the recorded ones.

    Raises BadInputError for events of unknown units or frames, and for events that cannot follow.
    """
    core = Core(recording.graph, recording.settings)
    for now_ns, events, actions in recording.steps:
        try:
            answer = core.step(now_ns, events).actions
        except KeyError as error:
            raise BadInputError(f"the recording at {now_ns} ns", str(error), "a unit and a frame of the run") from None
        except (UnitLifeError, ValueError) as error:
            raise BadInputError(f"the recording at {now_ns} ns", str(error), "events that can follow") from None
        if answer != actions:
            yield f"at {now_ns} ns: recorded {actions}, replayed {answer}"


def row_of(item: Event | Action) -> list[Any]:
    """Return an event or action as a row: its name, then the values of its fields.

    For `Dispatch` and `Finish`, these are the fields of the job and of the outcome.
    """
    row: Any = item
    return [type(item).__name__, *(row[0] if type(item) in CARRIED else row)]


def events_of(rows: Iterable[Sequence[Any]]) -> tuple[Event, ...]:
    """Return the events that were written as `rows`. Raises ValueError for a row that is no event."""
    return tuple(_parse(row, _EVENTS) for row in rows)


def actions_of(rows: Iterable[Sequence[Any]]) -> tuple[Action, ...]:
    """Return the actions that were written as `rows`. Raises ValueError for a row that is no action."""
    return tuple(_parse(row, _ACTIONS) for row in rows)


def _listed(row: Mapping[str, Any], key: str, forms: dict[str, tuple[Any, dict[str, Any]]]) -> list[Any]:
    """Return the row (`row_of`) of an event or action from its JSON object, whose key `key` has the name."""
    name = row[key]
    _, types = _form(name, forms)
    if row.keys() != {key, *types}:
        raise UnexpectedValue(f"{name} with {', '.join(row)}"[:80], f"{key}, {', '.join(types)}")
    return [name, *(row[field] for field in types)]


def _form(name: Any, forms: dict[str, tuple[Any, dict[str, Any]]]) -> tuple[Any, dict[str, Any]]:
    """Return the entry of `forms` for `name`. Raises UnexpectedValue for an unknown name."""
    if not isinstance(name, str) or name not in forms:
        raise UnexpectedValue(repr(str(name)[:80]), f"one of {', '.join(forms)}")
    return forms[name]


def _parse(row: Sequence[Any], forms: dict[str, tuple[Any, dict[str, Any]]]) -> Any:
    """Return the event or action that was written as `row` (`row_of`); `forms` has the known ones."""
    name, *fields = row
    kind, hints = _form(name, forms)
    types = list(hints.values())
    written = [str if issubclass(each, StrEnum) else each for each in types]
    if [type(field) for field in fields] != written:
        raise UnexpectedValue(str(row)[:80], f"fields of {', '.join(each.__name__ for each in written)}")
    values = [each(field) for each, field in zip(types, fields, strict=True)]
    return kind(CARRIED[kind](*values)) if kind in CARRIED else kind(*values)


def graph_of(data: Mapping[str, Any]) -> Graph:
    """Return the graph that `Graph.written` gave as `data`. Raises LookupError, TypeError or ValueError for others."""
    bypass = data["bypass"]
    ends = None if bypass is None else (bypass[0], bypass[1])
    stages = tuple(_stage_of(stage) for stage in data["stages"])
    return Graph(stages, tuple(data["edges"]), data["latency_to"], ends, data.get("from_release", False))


def _stage_of(data: Mapping[str, Any]) -> StageSpec:
    inputs = data.get("inputs")
    read = None if inputs is None else tuple(Input(**each) for each in inputs)
    return StageSpec(**{**data, "inputs": read})


def settings_of(data: Mapping[str, Any]) -> Settings:
    """Return the settings from `data`, their fields by name. Raises TypeError for other data."""
    fields: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in data.items()}
    return Settings(**fields)
