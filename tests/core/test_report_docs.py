"""docs/report.md names every key that a run writes, and none that it does not.

Rule: what runs write is in tests/process/json_keys.toml, which a test of that folder compares with real runs.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from dataclasses import fields
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from trilane.scheduler import events
from trilane.scheduler.events import DropCause, LossKind, Outcome, OutcomeKind
from trilane.scheduler.policy import POLICIES
from trilane.transport.slots import RULES

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "report.md").read_text(encoding="utf-8")
PARTS = tomllib.loads((ROOT / "tests" / "process" / "json_keys.toml").read_text(encoding="utf-8"))["parts"]
REPORTS = ("report_with_caps", "report_with_pace", "report_with_check")


def expanded(text: str) -> Iterator[str]:
    """`a.{b,c}` as `a.b` and `a.c`."""
    pieces = re.split(r"\{(.*?)\}", text)
    for chosen in product(*(piece.split(",") if place % 2 else [piece] for place, piece in enumerate(pieces))):
        yield "".join(chosen)


def with_those_above(path: str) -> Iterator[str]:
    names = path.split(".")
    yield from (".".join(names[:count]).removesuffix("[]") for count in range(1, len(names) + 1))


def listed(part: str) -> Iterator[str]:
    """Every key of a part of json_keys.toml that is no object: `a.b.c`."""
    for line in PARTS[part]:
        for path in expanded(line):
            above, _, inner = path.rpartition("@")
            yield from (
                [above.replace("?", "") + end for end in listed(inner)]
                if inner and "@" in path
                else [path.replace("?", "")]
            )


def rows(heading: str) -> list[list[str]]:
    """The cells of the rows of all tables below a heading, up to the next of its level."""
    level = heading.split(" ")[0]
    section = re.split(rf"^{level} ", PAGE[PAGE.index(f"\n{heading}\n") + len(heading) + 2 :], flags=re.MULTILINE)[0]
    lines = [line for line in section.splitlines() if line.startswith("| `")]
    return [re.split(r" *\| *", line)[1:-1] for line in lines]


def documented() -> set[str]:
    return {path for cells in rows("## report.json") for path in expanded(cells[0].strip("` "))}


def written() -> set[str]:
    """Keys of reports, those of the baseline but for its own first level: below it they mean what they mean above."""
    paths = {path.removesuffix("[]") for part in REPORTS for path in listed(part)}
    above = {name for path in paths for name in list(with_those_above(path))[:-1]}
    paths -= above  # what is an object is explained by its keys
    return {re.sub(r"^(baseline\.\w+)\..*", r"\1", path) for path in paths}


def test_every_key_that_a_run_writes_is_explained() -> None:
    assert len(written()) > 150
    assert sorted(written() - documented()) == []


def test_no_key_is_explained_that_no_run_writes() -> None:
    known = {above for path in written() for above in with_those_above(path)}
    assert sorted(path.removesuffix("[]") for path in documented() if path.removesuffix("[]") not in known) == []


def test_a_unit_of_time_in_a_name_is_the_one_of_its_row() -> None:
    endings = {"_ms": "ms", "_s": "s", "_ns": "ns", "_w": "W", "_bytes": "bytes"}
    for path, unit, *_ in rows("## report.json"):
        for name in expanded(path.strip("`")):
            wanted = {said for ending, said in endings.items() if name.replace(".*", "").endswith(ending)}
            assert not wanted or unit in wanted or name.startswith("baseline."), name


CARRIED: dict[Any, tuple[str, ...]] = {events.Dispatch: events.Job._fields, events.Finish: Outcome._fields}
FORMS = [[kind.__name__, *CARRIED.get(kind, kind._fields)] for kind in (*events.EVENTS, *events.ACTIONS)]


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form[0])
def test_every_event_and_action_stands_with_its_fields_in_order(form: list[str]) -> None:
    found = [cells[:2] for cells in rows("## events.jsonl") if cells[0] == f"`{form[0]}`"]
    assert found == [[f"`{form[0]}`", ", ".join(f"`{field}`" for field in form[1:])]]


def test_every_key_of_a_recording_is_explained() -> None:
    shown = {path for cells in rows("## events.jsonl") if len(cells) == 2 for path in expanded(cells[0].strip("`"))}
    settings = {f"settings.{field.name}" for field in fields(events.Settings)}
    stages = {f"graph.stages[].{field.name}" for field in fields(events.StageSpec)}
    graph = stages | {"graph.edges", "graph.latency_to", "graph.bypass", "graph.from_release"}
    assert shown == {"schema", "t", "events", "actions"} | settings | graph
    assert {f"graph.{field.name}" for field in fields(events.Graph)} == {
        "graph.stages" if path in stages else path for path in graph
    }


def test_every_policy_edge_and_cause_is_explained() -> None:
    assert [cells[0].strip("`") for cells in rows("## Policies")] == list(POLICIES)
    assert [cells[0].strip("`").removesuffix(":N") for cells in rows("## Edges")] == list(RULES)
    for name, cells in zip(RULES, rows("## Edges"), strict=True):
        assert re.search(rf"\b{RULES[name].slots}\b", cells[1]), name
    for cause in (*DropCause, *LossKind, *OutcomeKind):
        assert f"`{cause.value}`" in PAGE, cause
