"""A frame is late by one rule, `due_ns`: the ledger, the figures of a live run and the trace count the same frames."""

from __future__ import annotations

import io
import random
from typing import Any

import pytest

from support.trace_reading import read_trace
from trilane.apps.explain.trace import write_trace
from trilane.apps.watch.live_figures import LiveFigures
from trilane.hw_profiles.application import application_graph
from trilane.pipeline.journal import SCHEMA, Begun, Record, journal_of, target_period_ns
from trilane.scheduler.events import NEVER, Hold, Settings
from trilane.scheduler.stats import due_ns
from trilane.scheduler.virtual import simulate

MS = 1_000_000
FPS_60 = {"config": {"scene": {"fps": 60}}}
HELD: dict[str, Any] = {"inputs": ((300 * MS, Hold(1)), (450 * MS, Hold(-1)))}
CASES: dict[str, tuple[Settings, int, dict[str, Any], dict[str, Any]]] = {
    "a target in the journal": (Settings(60), 17 * MS, {"target_period_ns": 17 * MS, **FPS_60}, {}),
    "held by a viewer": (Settings(60), 17 * MS, {"target_period_ns": 17 * MS}, HELD),
    "deadlines": (Settings(60, "latest", 15 * MS, deadline_ns=60 * MS), 0, {"target_period_ns": 0, **FPS_60}, {}),
    "a journal without the target": (Settings(60), round(1e9 / 60), FPS_60, {}),
    "a journal without a rate": (Settings(60), round(1e9 / 30), {}, {}),
    "deadlines in an older journal": (Settings(60, "latest", 15 * MS, deadline_ns=60 * MS), 0, FPS_60, {}),
}


@pytest.mark.parametrize("case", CASES)
def test_ledger_live_figures_and_trace_count_the_same_frames(case: str) -> None:
    settings, target_ns, facts, options = CASES[case]

    def service(stage: str, _unit: str, frame: int, _begin_ns: int) -> int:
        most_ms = 50 if frame % 7 == 0 else 20 if stage == "infer" else 8
        return random.Random(f"{stage} {frame}").randrange(MS, most_ms * MS)

    run = simulate(application_graph(), settings, service, keep=True, target_period_ns=target_ns, **options)
    assert run.recording is not None
    records: list[Record] = list(journal_of(run.recording, run.jobs, facts, run.report))
    misses = run.report["deadline_misses"]
    assert 0 < misses < run.report["frames"]["presented"] - 1
    assert isinstance(records[0], Begun)
    assert target_period_ns(records[0]) == target_ns
    figures = LiveFigures(records[0])
    for record in records[1:-1]:
        figures.add(record)
    verdict = figures.now().verdict
    assert verdict is not None
    assert f" {misses} of " in verdict["lines"][0][1]
    write_trace(records, file := io.BytesIO())
    actual = read_trace(file.getvalue()).of("Actual frames")
    assert sum(one.name.startswith("late") for one in actual) == misses


def test_when_a_frame_is_due() -> None:
    """A target replaces the deadline; a first frame has no frame time, so nothing says when it is due."""
    assert due_ns(7, 3, 0) == due_ns(7, None, 0) == 7
    assert due_ns(7, 3, 20) == 23
    assert due_ns(7, None, 20) == due_ns(NEVER, 3, 0) == NEVER


@pytest.mark.parametrize("written", [-1, "17", 1.5, True, NEVER])
def test_a_target_that_no_run_writes_does_not_count(written: object) -> None:
    begun = Begun(SCHEMA, application_graph(), Settings(1), {"target_period_ns": written, **FPS_60})
    assert target_period_ns(begun) == round(1e9 / 60)
