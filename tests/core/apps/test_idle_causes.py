"""The causes of idle time stand in one table, `CAUSES`; each list of causes elsewhere has exactly its rows."""

from __future__ import annotations

import re
from pathlib import Path

from trilane.apps.compare.comparison import WAITS
from trilane.apps.dashboard import page
from trilane.apps.dashboard.finished_view import CAUSE_NAMES
from trilane.pipeline.journal_values import ACCOUNTS
from trilane.pipeline.run_metrics import IdleShares
from trilane.pipeline.unit_history import MEANING, UNEXPLAINED
from trilane.scheduler.events import Graph, Input, StageSpec, chain
from trilane.scheduler.ledger import ASSIGNED, CAUSES, Ledger, idle_causes

PAGE = Path(page.__path__[0])
ROWS = [cause.name for cause in CAUSES]


def keys_of(file: str, table: str) -> dict[str, str]:
    """The keys of an object of the page's JavaScript, each with the text in quotes behind it."""
    text = (PAGE / file).read_text(encoding="utf-8")
    body = text.partition(f"const {table} = {{\n")[2].partition("\n};")[0]
    return dict(re.findall(r'^  (\w+): (?:"(.*)")?', body, re.MULTILINE))


def test_every_row_has_a_name_an_account_and_words_of_its_own() -> None:
    for of in ("name", "meaning", "told"):
        assert len({getattr(cause, of) for cause in CAUSES}) == len(CAUSES)
    accounts = [cause.account for cause in CAUSES if cause.account != ASSIGNED]
    assert sorted(accounts) == [*range(1, 1 + len(accounts))]
    assert set(MEANING) == set(ACCOUNTS) == {ASSIGNED, *accounts}


def test_every_list_of_causes_has_the_rows_of_the_table() -> None:
    assert list(IdleShares.model_fields) == list(WAITS) == list(idle_causes(joins=True)) == ROWS
    assert list(CAUSE_NAMES) == [*ROWS, UNEXPLAINED]


def test_the_ledger_reports_every_cause_of_a_unit() -> None:
    """`join` only for a unit with a stage of several inputs."""
    both = (Input("a"), Input("b"))
    specs = (StageSpec("a", "u", ()), StageSpec("b", "u", ()), StageSpec("c", "v", both))
    report = Ledger(Graph(specs, ("double", "double"), "c")).report(clock="virtual", requested=0, not_begun=0)
    assert list(report["units"]["v"]["idle"]) == ROWS
    without = [cause.name for cause in CAUSES if not cause.joins]
    assert list(report["units"]["u"]["idle"]) == without != ROWS
    line = Ledger(chain((("a", "u"),), "single", "a")).report(clock="virtual", requested=0, not_begun=0)
    assert list(line["units"]["u"]["idle"]) == without


def test_the_page_has_words_a_pattern_and_a_colour_for_every_cause() -> None:
    meanings = keys_of("slices.js", "CAUSE_MEANINGS")
    assert {name: meanings[name] for name in ROWS} == {cause.name: cause.meaning for cause in CAUSES}
    assert list(meanings) == list(keys_of("patterns.js", "STROKES")) == [*ROWS, UNEXPLAINED]
    styles = (PAGE / "style.css").read_text(encoding="utf-8")
    colours = dict(re.findall(r"--cause-(\w+): (light-dark\([^)]*\))", styles))
    assert list(colours) == [*ROWS, UNEXPLAINED]
    assert len(set(colours.values())) == len(colours)
