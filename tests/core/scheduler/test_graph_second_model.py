"""A second scheduler, written from the rules of graphs and not from the code, must do the same on random graphs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import pytest

from support.plain_graph_scheduler import PlainGraphScheduler, PlainUnit, drawn
from support.plain_scheduler import RESTART_NS, service_of
from trilane.scheduler.events import Dispatch, Graph, SetDuty, unpacked
from trilane.scheduler.virtual import VirtualDriver

CAUSES = ("starved", "blocked", "throttled", "join", "overhead")


@pytest.mark.parametrize("yields", [False, True])
@pytest.mark.parametrize("seed", range(110))
def test_the_core_does_on_graphs_what_a_plain_reading_of_the_rules_does(seed: int, yields: bool) -> None:
    """Jobs of one instant have no order: the rules do not say which unit is served first."""
    graph, settings, delay_ns, faults, duties = drawn(seed, yields)
    model = PlainGraphScheduler(graph, settings, service_of(seed), delay_ns, faults, duties)
    model.run()
    driver = VirtualDriver(
        graph,
        settings,
        service_of(seed),
        message_delay_ns=delay_ns,
        restart_ns=RESTART_NS,
        faults=faults,
        inputs=[(0, SetDuty(name, duty)) for name, duty in duties.items()],
        keep=True,
    )
    driver.run()
    assert driver.recording is not None
    assert sorted(dispatched(graph, driver.recording.steps), key=repr) == sorted(
        (row[:5] for row in model.jobs), key=repr
    )
    assert [(job.stage, job.frame, job.begin_ns, job.end_ns) for job in driver.jobs] == model.ended
    assert {job[:7] for job in driver.jobs} <= {(*row[1:4], *row[5]) for row in model.jobs}
    ledger = driver.core.ledger
    assert list(zip(ledger.presented_frames, ledger.presented_ns, strict=True)) == model.presented
    assert list(ledger.latency_ns) == model.latencies
    assert ledger.lost_by_cause == dict(model.lost)
    assert drops(ledger.dropped_by_cause, settings.policy) == drops(model.dropped, settings.policy)
    report = driver.core.report(clock="virtual")
    for unit in model.units:
        check_account(report["units"][unit.name], unit, model.now_ns)


def dispatched(graph: Graph, steps: Any) -> list[tuple[Any, ...]]:
    """Each job with the frames that lie in its input slots; None for no frame."""
    inputs = {stage.name: stage.inputs or () for stage in graph.stages}
    written: dict[tuple[str, int], int] = {}
    found = []
    for now_ns, _, actions in steps:
        for job in [action.job for action in actions if isinstance(action, Dispatch)]:
            read = inputs[job.stage]
            slots = unpacked(job.slot_in, len(read)) if read else []
            frames = [written.get((each.stage, slot)) for each, slot in zip(read, slots, strict=True)]
            found.append((now_ns, job.stage, job.unit, job.frame, tuple(frames)))
            written[job.stage, job.slot_out] = job.frame
    return found


def drops(counts: Mapping[str, int], policy: str) -> dict[str, int]:
    """By edge and cause; a late frame that waits for several stages is dropped before that which is looked at first."""
    found = Counter[str]()
    for key, count in counts.items():
        found[key.partition(":")[2] if policy == "deadline" else key] += count
    return dict(found)


def check_account(row: dict[str, Any], unit: PlainUnit, total_ns: int) -> None:
    busy_ns, until_ns = 0, 0
    for begin_ns, end_ns in sorted(unit.busy):
        busy_ns += max(0, end_ns - max(begin_ns, until_ns))
        until_ns = max(until_ns, end_ns)
    idle = {cause: unit.times_ns[cause] / total_ns for cause in CAUSES[:4]}
    idle["overhead"] = (unit.times_ns["assigned"] - busy_ns) / total_ns
    assert row["busy"] == pytest.approx(busy_ns / total_ns)
    assert {cause: row["idle"].get(cause, 0) for cause in CAUSES} == pytest.approx(idle, abs=1e-12)
    assert row["jobs"] == len(unit.busy)
