"""What the core was told and what it answered. Rule: a replay gives the same actions, or says where not."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from trilane.errors import BadInputError
from trilane.scheduler.core import Core
from trilane.scheduler.events import (
    ACTIONS,
    EVENTS,
    Action,
    Dispatch,
    Event,
    Graph,
    Job,
    Settings,
    StageSpec,
)

SCHEMA = 2
_NAMED: dict[str, Any] = {kind.__name__: kind for kind in (*EVENTS, *ACTIONS)}


@dataclass
class Recording:
    """The steps of one run: (now_ns, events, actions)."""

    graph: Graph
    settings: Settings
    steps: list[tuple[int, tuple[Event, ...], tuple[Action, ...]]] = field(default_factory=list)

    def write(self, path: Path) -> None:
        """As JSON lines: a header, then a line per step with `t`, `events`, `actions`, each a [name, fields...]."""
        header = {"schema": SCHEMA, "graph": asdict(self.graph), "settings": asdict(self.settings)}
        with path.open("w", encoding="utf-8") as file:
            file.write(json.dumps(header) + "\n")
            for now_ns, events, actions in self.steps:
                row = {"t": now_ns, "events": [_row(e) for e in events], "actions": [_row(a) for a in actions]}
                file.write(json.dumps(row, separators=(",", ":")) + "\n")


def read(path: Path) -> Recording:
    """Raises BadInputError naming the line that is not part of a recording."""
    number = 0
    try:
        with path.open(encoding="utf-8") as file:
            header = json.loads(next(file, ""))
            if header["schema"] != SCHEMA:
                raise ValueError(f"schema {header['schema']!r}; this Trilane reads {SCHEMA}")
            recording = Recording(_graph(header["graph"]), Settings(**_tuples(header["settings"])))
            for number, line in enumerate(file, start=1):  # noqa: B007 - named in the message below
                row = json.loads(line)
                events = tuple(_parse(item) for item in row["events"])
                recording.steps.append((row["t"], events, tuple(_parse(item) for item in row["actions"])))
    except OSError as error:
        raise BadInputError(path, (error.strerror or str(error)).lower(), "a recorded run") from None
    except (ValueError, KeyError, TypeError) as error:
        raise BadInputError(
            f"{path}, line {number + 1}", str(error) or type(error).__name__, "a recorded run"
        ) from None
    return recording


def replay(recording: Recording) -> Iterator[str]:
    """Feed the events to a fresh core; one sentence for every step that is answered differently."""
    core = Core(recording.graph, recording.settings)
    for now_ns, events, actions in recording.steps:
        answer = core.step(now_ns, events).actions
        if answer != actions:
            yield f"at {now_ns} ns: recorded {actions}, replayed {answer}"


def _row(item: Any) -> list[Any]:
    fields = item.job if isinstance(item, Dispatch) else item
    return [type(item).__name__, *fields]


def _parse(row: list[Any]) -> Any:
    name, *fields = row
    return Dispatch(Job(*fields)) if name == "Dispatch" else _NAMED[name](*fields)


def _graph(data: dict[str, Any]) -> Graph:
    return Graph(tuple(StageSpec(**stage) for stage in data["stages"]), tuple(data["edges"]), data["latency_to"])


def _tuples(data: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in data.items()}
